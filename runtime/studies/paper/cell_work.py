"""Make cells of the paper's tables: train or take over, measure, keep the figures."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError, UnfinishedError
from spikeloom.compiler.systems import GCN, GRID_CNN, MLP, TACTILESGNET
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies.jobs.cluster import ClusterLostError
from spikeloom.runtime.studies.jobs.locks import only_one
from spikeloom.runtime.studies.jobs.sweep import Point, left_out, spread
from spikeloom.runtime.studies.jobs.workers import ProcessDied, ended_by_signal
from spikeloom.runtime.studies.paper import table as paper_table
from spikeloom.runtime.studies.paper.cells import FORMAT, SAME_PADDING, Row, write_cell
from spikeloom.runtime.studies.training.training import Job

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
    data : str
        Its recordings, as another process may name them.
    sha256 : str
        Of its recordings.
    """

    row: Row
    seed: int
    job: Job
    place: Path
    data: str
    sha256: str

    @property
    def output(self) -> Path:
        """Checkpoint that it writes."""
        return self.job.output


def run_cell(work: Work) -> Json:
    """Train a cell, or take over its network; measure it and keep the figures."""
    from spikeloom.runtime.studies.paper.measured import measure
    from spikeloom.runtime.studies.training.seeds import clear, finished
    from spikeloom.runtime.studies.training.training import recall, run_job

    job = work.job
    with only_one(job.output):
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


def run_cell_elsewhere(work: Work) -> Json:
    """What `run_cell` does, of a cell that came without its recordings, see `_for_elsewhere`."""
    training, test = splits_on_worker(work.data, work.sha256)
    return run_cell(replace(work, job=replace(work.job, training=training, test=test)))


@lru_cache(maxsize=2)
def splits_on_worker(data: str, sha256: str) -> tuple[Recordings, Recordings]:
    """Recordings as a worker finds them.

    Raises
    ------
    DataError
        If they are not those of everybody else.
    """
    from spikeloom.models.graphs import NEUTOUCH
    from spikeloom.models.recordings.events import BIN_S
    from spikeloom.models.training.protocols import data_digest
    from spikeloom.runtime.commands.training.train import both_splits

    training, test = both_splits(data, len(NEUTOUCH), BIN_S)
    if data_digest(training, test) != sha256:
        raise DataError(f"{data}: holds other recordings on a worker than here; share the folder, or copy it there")
    return training, test


def _for_elsewhere(work: Work) -> Work:
    """A cell that fits through a network: paths that hold on every machine of a shared folder, no recordings."""
    training, test = (
        replace(each, events=each.events[:0], labels=each.labels[:0], files=(), lengths=None)
        for each in (work.job.training, work.job.test)
    )
    job = replace(work.job, training=training, test=test, output=work.job.output.absolute(), position=0)
    data = str(Path(work.data).absolute()) if Path(work.data).exists() else work.data
    return replace(work, job=job, place=work.place.absolute(), data=data)


def make(
    work: Sequence[Work],
    folder: Path,
    *,
    there: int,
    planned: int,
    jobs: int | None,
    scheduler: str | None,
    after: Callable[[], object],
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
    jobs : int, optional
        Processes at a time; 1 stays in this one. As many as there are cores by default.
    scheduler : str, optional
        Of a Dask cluster, on whose workers to make them instead.
    after : callable
        Called when a cell is done.

    Raises
    ------
    SpikeloomError, OSError, MemoryError
        What ended a cell.
    UnfinishedError
        If cells ended their process too often, or the scheduler was lost.
    KeyboardInterrupt
        On an interrupt or a request to end; its text says what is kept.
    """
    from spikeloom.runtime.studies.training.seeds import finished

    costs = {each.place.stem: _cost(each, trained=finished(each.job)) for each in work}
    began, spent, made = time.monotonic(), 0.0, 0
    taken = sum(finished(each.job) for each in work)
    _tell(f"{there} of {planned} cells are there; {taken} more networks to measure, {len(work) - taken} to train")
    run, prepare = (run_cell, _as_it_is) if scheduler is None else (run_cell_elsewhere, _for_elsewhere)
    points = [Point(key=each.place.stem, label=each.place.stem, payload=prepare(each)) for each in work]
    lost = []

    def kept() -> str:
        return f"{there + made} of {planned} cells and the epochs so far are kept in {folder}"

    try:
        with ended_by_signal(), closing(spread(points, run, jobs=jobs, scheduler=scheduler)) as cells:
            for point, found in cells:
                if isinstance(found, ProcessDied):
                    lost.append(left_out(point, found))
                elif isinstance(found, Exception):
                    raise found
                else:
                    made += 1
                    spent += costs[point.key]
                    after()
                    left = (time.monotonic() - began) * (sum(costs.values()) - spent) / spent
                    line = f"{there + made} of {planned} cells, {duration(left)} left: {point.label}"
                    _tell(f"{line} {_figures(found)}")
    except ClusterLostError as error:
        lost.append(str(error))
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(f"{kept()}; go on with the same command and --resume") from interrupt
    if lost:
        raise UnfinishedError("\n".join([*lost, kept()]), resume=("--resume",))


def _as_it_is(work: Work) -> Work:
    return work


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
