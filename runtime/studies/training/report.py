"""What ``train`` says of the seeds that it trained, and what it draws."""

from __future__ import annotations

import statistics
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.types import IntArray
from spikeloom.models.training.recipes import MSE
from spikeloom.models.training.record import Reached, TrainingRecord
from spikeloom.runtime.report.drawing import COLOURS, Drawing, sheet, styled
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.report.sections import Section, Table, Text

TITLES = {
    "last": "last epoch",
    "best": "paper protocol: best on test",
    "clean": "clean protocol: epoch chosen on validation",
}
"""What the epochs of ``WEIGHTS`` are called where people read of them."""

WIDTH = 118


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished(TrainingRecord):
    """A training and the checkpoint that holds it."""

    file: str
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracies:
    """Over seeds; one seed has no deviation."""

    mean: float
    std: float | None
    min: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingReport:
    """All seeds, and their accuracies by protocol."""

    runs: Sequence[Finished]
    protocols: Mapping[str, Accuracies]


def reached(record: TrainingRecord, which: str) -> Reached:
    """What the epoch of a protocol reached."""
    found: Reached = getattr(record, which)
    return found


def summary(records: Sequence[TrainingRecord]) -> dict[str, Accuracies]:
    """Accuracies over seeds by protocol."""
    result: dict[str, Accuracies] = {}
    for protocol in WEIGHTS:
        values = [reached(record, protocol).accuracy for record in records]
        spread = statistics.stdev(values) if len(values) > 1 else None
        result[protocol] = Accuracies(mean=statistics.fmean(values), std=spread, min=min(values), max=max(values))
    return result


def training_sections(result: TrainingReport) -> Iterable[Section]:
    """Every seed by every protocol, then the means."""
    total = result.runs[0].test_samples
    rows = []
    for run in result.runs:
        for which in WEIGHTS:
            epoch = reached(run, which)
            low, high = wilson(epoch.correct, total)
            interval = f"{100 * low:.1f} … {100 * high:.1f}"
            name = f"seed {run.seed}, {TITLES[which]}"
            accuracy = f"{100 * epoch.correct / total:.2f} %"
            rows.append([name, str(epoch.epoch), f"{epoch.correct} of {total}", accuracy, interval])
    command, seed = result.runs[0].command.rsplit(" --seed ", 1)
    several = [f"--seeds {len(result.runs)}"] if len(result.runs) > 1 else []
    lines = []
    if several:
        means = (f"{100 * s.mean:.2f} % ± {100 * (s.std or 0.0):.2f}" for s in result.protocols.values())
        last, paper, clean = means
        lines.append(f"  mean of {len(result.runs)} seeds: last {last}, paper {paper}, clean {clean}")
    files = ", ".join(run.file for run in result.runs)
    lines += textwrap.wrap(f"written: {files}", WIDTH, initial_indent="  ", subsequent_indent="    ")
    yield Section(
        "Training",
        [
            Text(" ".join([command, f"--seed {seed}", *several])),
            Table(["", "epoch", "correct", "accuracy", "95 % interval"], rows),
            Text("\n".join(lines)),
        ],
    )


@styled
def picture(records: Sequence[TrainingRecord], labels: IntArray, predictions: Sequence[IntArray]) -> Drawing:
    """Learning curves of all seeds and the confusion matrix of their last epochs, summed.

    `labels` are the true classes of the test recordings, `predictions` has for each record what it decided.
    """
    classes = int(max(labels.max(), *(p.max() for p in predictions))) + 1
    confusion = np.zeros((classes, classes), np.int64)
    for predicted in predictions:
        np.add.at(confusion, (labels, predicted), 1)
    drawing = sheet("trainings", 4.2, width=13.0)
    left, middle, right = drawing.figure.subplots(1, 3, width_ratios=(1, 1, 1.05))
    for index, record in enumerate(records):
        training, test, correct = np.array(record.history).T
        epochs = np.arange(1, len(correct) + 1)
        colour, marker = COLOURS[index % len(COLOURS)], "." if len(epochs) == 1 else ""  # a line of one point is none
        left.semilogy(epochs, training, marker=marker, color=colour)
        left.semilogy(epochs, test, marker=marker, color=colour, linestyle="--")
        middle.plot(epochs, 100 * correct / record.test_samples, color=colour, label=f"seed {record.seed}")
        clean = record.clean
        middle.plot(clean.epoch, 100 * clean.accuracy, "o", color=colour, markeredgecolor="black")
    loss = (records[0].recipe or {}).get("loss", MSE)
    measured = "squared error of spike rates" if loss == MSE else loss
    left.set(xlabel="epoch", ylabel=measured, title="loss: training solid, test dashed")
    middle.set(xlabel="epoch", ylabel="test accuracy (%)", title="accuracy; circle: epoch of the clean protocol")
    middle.legend(loc="lower right")
    image = right.imshow(confusion, cmap="cividis")
    right.set(xlabel="decision", ylabel="class", title="confusion, last epoch")
    drawing.figure.colorbar(image, ax=right, label="test recordings")
    for axes in (left, middle):
        axes.locator_params(axis="x", integer=True)
        axes.grid()
    right.locator_params(integer=True)
    return drawing
