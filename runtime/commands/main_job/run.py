"""The command ``run``: decisions and spikes, bit for bit the chip's."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import UNLABELLED
from spikeloom.runtime.commands.main_job.estimate import priced
from spikeloom.runtime.commands.options import add_detail, add_netlist, add_recordings
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import netlist_recordings
from spikeloom.runtime.machines.base import Price, machine_for
from spikeloom.runtime.machines.simulated import Account, Accounted
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text


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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_netlist(parser)
    add_recordings(parser, window=True)
    add_detail(parser, ("spikes", "counts", "cycle"), "spikes")
    parser.add_argument("--spikes", metavar="OUT.npz", help="write the spikes of every layer, aligned with the data")


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    keep = arguments.spikes is not None
    if keep:
        require_place(arguments.spikes, "--spikes", arguments)
    machine = machine_for(arguments.netlist)
    data = netlist_recordings(arguments, machine.netlist)
    account = Account(machine, data)
    price: Price | None = None
    if arguments.detail == "spikes":
        account.begin("spikes kept" if keep else "spikes")
        progress("running")
        done = machine.run(data.events, lengths=data.lengths, spikes=keep)
    else:
        account.begin(arguments.detail)
        done, price = priced(arguments, machine, data, spikes=keep)
    account.begin("no float")
    if done.spikes is not None:
        with write_atomically(arguments.spikes) as file:
            np.savez_compressed(file, **done.spikes)  # type: ignore[arg-type]
    found = Decisions(
        files=data.files,
        labels=data.labels,
        predictions=done.decisions,
        counts=done.votes,
        price=price,
        costs=None if price is None else price.outcome.result,
    )
    result = Accounted(result=found, explained_cost=account.explained(arguments.explain_cost))
    return Outcome(result, lambda result: sections(result.result))


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
