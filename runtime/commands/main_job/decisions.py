"""What ``run`` finds: a decision for each recording, and the accuracy over those that have labels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import UNLABELLED
from spikeloom.runtime.machines.base import Price
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Section, Table, Text


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decisions:
    """Class (samples,) and votes (samples, classes) of each recording, int64; its label, or ``UNLABELLED``."""

    files: tuple[str, ...]
    labels: IntArray
    predictions: IntArray
    counts: IntArray
    price: Price | None = field(default=None, metadata=HIDDEN)
    costs: object = field(default=None, metadata=OPTIONAL)

    json_properties: ClassVar[tuple[str, ...]] = ("samples", "labelled", "accuracy")

    @property
    def samples(self) -> int:
        """Number of recordings."""
        return len(self.files)

    @property
    def labelled(self) -> int:
        """Those with a label."""
        return int(np.count_nonzero(self.labels != UNLABELLED))

    @property
    def accuracy(self) -> float | None:
        """Share of those that are decided as labelled, if there are any."""
        known = self.labels != UNLABELLED
        return float(np.mean(self.labels[known] == self.predictions[known])) if known.any() else None


def sections(found: Decisions) -> Iterator[Section]:
    """Accuracy, recordings that went wrong, decisions where no label is known, and costs."""
    rows = list(zip(found.files, found.labels.tolist(), found.predictions.tolist(), found.counts.tolist(), strict=True))
    unknown = [row for row in rows if row[1] == UNLABELLED]
    wrong = [row for row in rows if row[1] not in (UNLABELLED, row[2])]
    known = found.labelled
    blocks: list[Text | Table] = []
    if known:
        without = f", {len(unknown)} more without a label" if unknown else ""
        blocks.append(Text(f"chip accuracy: {percent(known - len(wrong), known)}{without}"))
    if wrong:
        cells = [
            [file, *map(str, (label, chosen, votes[label], votes[chosen]))] for file, label, chosen, votes in wrong
        ]
        blocks.append(Table(["decided wrongly", "label", "decision", "votes for label", "for decision"], cells))
    if unknown:
        cells = [[file, str(chosen), str(votes[chosen])] for file, _, chosen, votes in unknown]
        blocks.append(Table(["without a label" if known else "recording", "decision", "votes"], cells))
    yield Section("Decisions", blocks)
    if found.price is not None:
        yield from found.price.outcome.sections(found.price.outcome.result)
