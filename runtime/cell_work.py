"""Make cells of the paper's tables: train or take over, measure, keep the figures."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compiler.frontends.systems import GCN, GRID_CNN, MLP, TACTILESGNET
from runtime import paper_table
from runtime.cells import FORMAT, SAME_PADDING, Row, write_cell
from runtime.inputs import progress
from runtime.training import Job

Json = dict[str, Any]

PACE = {TACTILESGNET: 1.0, GRID_CNN: 1.4, MLP: 0.25, GCN: 0.7, SAME_PADDING: 5.0}
"""How long an epoch of a system takes beside one of TactileSGNet; only the time that is left is told from it."""

BOTH = 1.8
"""Trainings of a cell: one on all of the training split, one on four fifths."""

MEASURING = 8.0
"""Epochs that measuring a network takes as long as."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Work:
    """A cell to make; crosses process borders.

    Parameters
    ----------
    row, seed : Row, int
        Which.
    job : Job
        Its training.
    place : Path
        Where its figures go.
    sha256 : str
        Of its recordings.
    """

    row: Row
    seed: int
    job: Job
    place: Path
    sha256: str

    @property
    def output(self) -> Path:
        """Checkpoint that it writes."""
        return self.job.output


def run_cell(work: Work) -> Json:
    """Train a cell, or take over its network; measure it and keep the figures."""
    from runtime.measured import measure
    from runtime.seeds import clear, finished
    from runtime.training import recall, run_job

    job = work.job
    clear(job)
    record, _ = recall(job) if finished(job) else run_job(job)
    found = {
        "format": FORMAT,
        "data": work.row.data,
        "system": work.row.system,
        "form": work.row.form,
        "epochs": work.row.epochs,
        "decay_epochs": job.recipe.decay_epochs,
        "seed": work.seed,
        "data_sha256": work.sha256,
        "checkpoint_sha256": record["sha256"],
        **{key: record[key] for key in ("command", "test_samples", "best", "last", "clean", "validation")},
        **{key: record[key] for key in ("spikeloom", "torch", "numpy", "device")},
        "chip": measure(job.output, job.training, job.test),
    }
    write_cell(work.place, found)
    return found


def make(
    work: Sequence[Work], folder: Path, *, there: int, planned: int, most: int | None, after: Callable[[], object]
) -> None:
    """Make cells side by side; a line on stderr tells of each, and how long the rest takes.

    Parameters
    ----------
    work : sequence of Work
        Cells to make, in this order.
    folder : Path
        Where they are kept, for messages.
    there, planned : int
        Cells that are there already, and all.
    most : int, optional
        Processes at a time; 1 stays in this one. As many as there are cores by default.
    after : callable
        Called when a cell is done.

    Raises
    ------
    SpikeloomError, OSError, MemoryError
        What ended a cell.
    KeyboardInterrupt
        On an interrupt or a request to end; its text says what is kept.
    """
    from runtime.seeds import finished, side_by_side
    from runtime.workers import ended_by_signal

    costs = [_cost(each, trained=finished(each.job)) for each in work]
    began, results = time.monotonic(), dict[int, Json]()
    taken = sum(finished(each.job) for each in work)
    _tell(f"{there} of {planned} cells are there; {taken} more networks to measure, {len(work) - taken} to train")

    def done(index: int) -> None:
        after()
        spent, whole = sum(costs[i] for i in results), sum(costs)
        left = (time.monotonic() - began) * (whole - spent) / spent
        line = f"{there + len(results)} of {planned} cells, {duration(left)} left: {work[index].place.stem}"
        _tell(f"{line} {_figures(results[index])}")

    try:
        with ended_by_signal():
            if most == 1 or len(work) == 1:
                for index, each in enumerate(work):
                    results[index] = run_cell(each)
                    done(index)
            else:
                side_by_side(work, range(len(work)), results, run_cell, most=most, fewer="--jobs", done=done)
    except KeyboardInterrupt as interrupt:
        kept = f"{there + len(results)} of {planned} cells and the epochs so far are kept in {folder}"
        raise KeyboardInterrupt(f"{kept}; go on with the same command and --resume") from interrupt


def _tell(line: str) -> None:
    progress("")
    sys.stderr.write(f"spikeloom: {line}\n")
    sys.stderr.flush()


def _figures(cell: Json) -> str:
    """Accuracies of a cell, for the line that says that it is done."""
    words = [f"{which} {100 * cell[which]['accuracy']:.2f}" for which in paper_table.PROTOCOLS]
    chip = cell["chip"]
    words += [
        "chip refuses" if "refused" in chip else f"chip {100 * chip['last']['correct'] / cell['test_samples']:.2f}"
    ]
    return ", ".join(words)


def _cost(work: Work, *, trained: bool) -> float:
    """How long a cell takes, in epochs of TactileSGNet on Objects."""
    pace = PACE[SAME_PADDING if work.row.form == SAME_PADDING else work.row.system]
    epochs = MEASURING + (0.0 if trained else BOTH * pace * work.row.epochs)
    return epochs * work.job.training.events.size


def duration(seconds: float) -> str:
    """Time for people.

    Examples
    --------
    >>> duration(3900.0), duration(59.6), duration(0.0)
    ('1 h 05 min', '1 min', '0 min')
    """
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"
