"""What ``train --system counters`` does: choose the strength of the rule, fit it, and read the test split once."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.counters import Counters
from spikeloom.compiler.formats.counters import counting_network, write_counters
from spikeloom.compiler.interpret import channels_last, float_simulation
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import Recordings, data_digest
from spikeloom.models.training.counters import Plan, counters_of, fit, run_counters
from spikeloom.models.training.folds import Fold
from spikeloom.models.training.record import Held
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.studies.left_out import LeftOut, counters_left_out, left_out_blocks

PART = 64
"""Recordings whose spikes are held at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CountersRecord:
    """How a counting network was made, and what it reached."""

    command: str
    spikeloom: str
    data: str
    data_sha256: str
    plan: Plan
    strength: float  # Of the rule, chosen by cross-validation
    cross_validation: Mapping[
        str, float
    ]  # Accuracy of each strength on training recordings that it did not see
    counters: int
    validation: Held  # What cross-validation classified correctly, at this strength
    test_correct: int
    test_samples: int
    train_sha256: str | None = field(default=None, metadata=OPTIONAL)  # Of the events that trained it
    bin_s: float | None = field(
        default=None, metadata=OPTIONAL
    )  # Seconds of a bin, where the recordings were events
    class_names: tuple[str, ...] | None = field(default=None, metadata=OPTIONAL)
    positions_mm: list[list[float]] | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CountersReport(Shown):
    """A counting network that was trained and written."""

    file: str
    sha256: str
    record: CountersRecord
    left_out: LeftOut | None = field(default=None, metadata=OPTIONAL)


def decisions_of(counters: Counters, data: Recordings) -> IntArray:
    """Class of each recording, as the spiking network decides."""
    network = counting_network(counters)
    ready = float_simulation(network)
    decided = []
    steps = of_length(joined_bins(data, counters.bins), counters.clocks.length)
    for first in range(0, len(data), PART):
        events = channels_last(steps.events[first : first + PART], counters.clocks)
        votes = ready.run(events).spikes[network.readout.population]
        decided.append(readout_counts(network.readout, network.classes, votes).argmax(axis=1))
    return np.concatenate(decided)


def train_counters(
    plan: Plan,
    training: Recordings,
    test: Recordings,
    command: str,
    output: str,
    folds: Sequence[Fold] = (),
    positions_mm: list[list[float]] | None = None,
) -> CountersReport:
    """Train a counting network, write it, and read the test split.

    `folds` are conditions to leave out, `positions_mm` those of the taxels where they were given.
    """
    progress("cross-validation")
    classes = int(training.labels.max()) + 1
    data = run_counters(training, plan)
    fitted = fit(data, classes)
    made = counters_of(data, fitted, training, classes)
    progress("test split")
    record = CountersRecord(
        command=command,
        spikeloom=__version__,
        data=training.source,
        data_sha256=data_digest(training, test),
        plan=plan,
        strength=fitted.strength,
        cross_validation={f"{each:g}": accuracy for each, accuracy in fitted.accuracy.items()},
        counters=len(made.counter),
        validation=Held(
            correct=round(fitted.accuracy[fitted.strength] * len(training)), samples=len(training)
        ),
        test_correct=int(np.sum(decisions_of(made, test) == test.labels)),
        test_samples=len(test),
        train_sha256=training.events_sha256,
        bin_s=training.bin_s,
        class_names=training.names,
        positions_mm=positions_mm,
    )
    known = {name: value for name, value in asdict(record).items() if value is not None}
    sha256 = write_counters(output, made.trained(known))
    left_out = None
    if folds:
        progress("leaving out conditions")
        left_out = counters_left_out(data, classes, fitted.strength, record.validation, folds)
    return CountersReport(file=Path(output).name, sha256=sha256, record=record, left_out=left_out)


def counters_sections(report: CountersReport) -> Iterator[Section]:
    """What was trained, for people."""
    made = report.record
    rows = [[strength, f"{100 * share:.1f} %"] for strength, share in made.cross_validation.items()]
    chosen = f"strength {made.strength:g}, by cross-validation in {made.validation.samples} recordings"
    lines = [
        f"{made.counters} counters; {chosen}",
        f"test accuracy: {percent(made.test_correct, made.test_samples)}",
        f"written: {report.file}, sha256 {report.sha256}",
    ]
    table = Table(["strength", "right when left out"], rows)
    blocks = left_out_blocks(report.left_out)
    yield Section("Training", [Text(made.command), table, *map(Text, lines), *blocks])
