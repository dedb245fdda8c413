"""What the seeds of a training reached, at three epochs, for people and as a picture."""

import statistics
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.models.training.recipes import MSE
from spikeloom.models.training.record import Reached, TrainingRecord
from spikeloom.runtime.report.drawing import COLOURS, Drawing, plain_logarithm, sheet, styled
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.studies.left_out import LeftOut, left_out_blocks

TITLES = {"last": "last epoch", "best": "best epoch on test", "clean": "clean epoch, chosen on validation"}
"""What the epochs of ``WEIGHTS`` are called where people read of them."""

WIDTH = 118


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished(TrainingRecord):
    """A training and the checkpoint that holds it."""

    file: str
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracies:
    """Statistics over seeds; a single seed has no deviation."""

    mean: float
    std: float | None
    min: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class TrainingReport(Shown):
    """All seeds, and their accuracies by epoch (JSON calls these protocols)."""

    runs: Sequence[Finished]
    protocols: Mapping[str, Accuracies]
    left_out: LeftOut | None = field(default=None, metadata=OPTIONAL)


def summary(records: Sequence[TrainingRecord]) -> dict[str, Accuracies]:
    """Accuracies of all seeds, by epoch."""
    result: dict[str, Accuracies] = {}
    for protocol in WEIGHTS:
        values = [getattr(record, protocol).accuracy for record in records]
        spread = statistics.stdev(values) if len(values) > 1 else None
        result[protocol] = Accuracies(
            mean=statistics.fmean(values), std=spread, min=min(values), max=max(values)
        )
    return result


def training_sections(result: TrainingReport) -> Iterable[Section]:
    """Every seed at every epoch of ``WEIGHTS``, then the means."""
    total = result.runs[0].test_samples
    rows = []
    for run in result.runs:
        for which in WEIGHTS:
            epoch: Reached = getattr(run, which)
            low, high = wilson(epoch.correct, total)
            interval = f"{100 * low:.1f} … {100 * high:.1f}"
            name = f"seed {run.seed}, {TITLES[which]}"
            accuracy = f"{100 * epoch.correct / total:.2f} %"
            rows.append([name, str(epoch.epoch), f"{epoch.correct} of {total}", accuracy, interval])
    command, seed = result.runs[0].command.rsplit(" --seed ", 1)
    typed = f"{command} --seed {seed}"
    lines = []
    if len(result.runs) > 1:
        typed += f" --seeds {len(result.runs)}"
        last, best, clean = (
            f"{100 * s.mean:.2f} % ± {100 * (s.std or 0.0):.2f}" for s in result.protocols.values()
        )
        lines.append(f"  mean of {len(result.runs)} seeds: last {last}, best on test {best}, clean {clean}")
    files = ", ".join(run.file for run in result.runs)
    lines += textwrap.wrap(f"written: {files}", WIDTH, initial_indent="  ", subsequent_indent="    ")
    table = Table(["", "epoch", "correct", "accuracy", "95 % interval"], rows)
    yield Section(
        "Training", [Text(typed), table, Text("\n".join(lines)), *left_out_blocks(result.left_out)]
    )


@styled()
def picture(records: Sequence[Finished]) -> Drawing:
    """Learning curves of all seeds."""
    drawing = sheet("trainings", 4.2)
    left, right = drawing.figure.subplots(1, 2)
    for index, record in enumerate(records):
        training, test, correct = np.array(record.history).T
        epochs = np.arange(1, len(correct) + 1)
        colour = COLOURS[index % len(COLOURS)]
        marker = "." if len(epochs) == 1 else ""  # a line of one point is none
        left.semilogy(epochs, training, marker=marker, color=colour)
        left.semilogy(epochs, test, marker=marker, color=colour, linestyle="--")
        right.plot(epochs, 100 * correct / record.test_samples, color=colour, label=f"seed {record.seed}")
        clean = record.clean
        right.plot(clean.epoch, 100 * clean.accuracy, "o", color=colour, markeredgecolor="black")
    loss = (records[0].recipe or {}).get("loss", MSE)
    measured = "squared error of spike rates" if loss == MSE else loss
    left.set(xlabel="epoch", ylabel=measured, title="loss: training solid, test dashed")
    right.set(xlabel="epoch", ylabel="test accuracy (%)", title="accuracy; circle: clean epoch")
    right.legend(loc="lower right")
    plain_logarithm(left.yaxis)
    for axes in (left, right):
        axes.locator_params(axis="x", integer=True)
        axes.grid()
    return drawing
