"""Trainings side by side: one process a seed, all ended together, each continued from where it was interrupted."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import remove_leftovers
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.studies import jobs as processes
from spikeloom.runtime.studies.jobs import ProcessDied, ended_by_signal, only_one
from spikeloom.runtime.studies.training.report import Finished
from spikeloom.runtime.studies.training.training import Job, recall, run_job, state_of

Result = tuple[Finished, IntArray | None]


def train_seeds(jobs: Sequence[Job], *, resume: bool) -> list[Result]:
    """Train several seeds, side by side on the cores where there are several; results are those of `run_job`.

    With `resume`, finished seeds are left alone, interrupted ones go on, and the rest is started.

    Raises
    ------
    OptionError
        If there is something to resume and `resume` is false, or the reverse; if a file holds another training; or if
        a training ended without a result; if another process works on a file.
    KeyboardInterrupt
        On an interrupt or a request to end; its text says what is kept.
    """
    with ExitStack() as locks:
        for job in jobs:
            locks.enter_context(only_one(job.output))
        return _train(jobs, resume=resume)


def _train(jobs: Sequence[Job], *, resume: bool) -> list[Result]:
    results: dict[int, Result] = {}
    for index, job in enumerate(jobs):
        if resume and finished(job):
            results[index] = recall(job)
    _require_right_start(jobs, resume=resume, some_finished=bool(results))
    for index, job in enumerate(jobs):
        clear(job)
        if index in results:
            sys.stderr.write(f"spikeloom: {job.output}: is finished, not trained again\n")
        elif resume and not states(job):
            sys.stderr.write(f"spikeloom: {job.output}: was not begun, trained from the start\n")
    waiting = [index for index in range(len(jobs)) if index not in results]
    try:
        with ended_by_signal():
            _side_by_side(jobs, waiting, results)
    except KeyboardInterrupt as interrupt:
        for job in jobs:
            clear(job)
        done = [jobs[index] for index in waiting if index in results]
        raise KeyboardInterrupt(_kept(done, jobs)) from interrupt
    return [results[index] for index in range(len(jobs))]


def finished(job: Job) -> bool:
    """Whether its checkpoint is there and nothing is left to go on with."""
    return not states(job) and job.output.exists()


def clear(job: Job) -> None:
    """Remove what a killed process left half-written."""
    for file in (job.output, *state_of(job)):
        remove_leftovers(file)


def states(job: Job) -> list[Path]:
    """Files of an interrupted training, as far as they are there."""
    return [file for file in state_of(job) if file.exists()]


def _require_right_start(jobs: Sequence[Job], *, resume: bool, some_finished: bool) -> None:
    """Neither lose an interrupted training nor begin anew in silence."""
    kept = [file for job in jobs for file in states(job)]
    if kept and not resume:
        raise OptionError(
            f"{', '.join(map(str, kept))}: an interrupted training is kept here; go on with --resume, or delete "
            f"{'it' if len(kept) == 1 else 'them'} to train anew"
        )
    if resume and not kept and not some_finished:
        raise OptionError(
            f"--resume: nothing was interrupted, neither {jobs[0].output} nor {state_of(jobs[0])[0]} exists; "
            "omit --resume"
        )


def _kept(done: Sequence[Job], jobs: Sequence[Job]) -> str:
    """What an interrupt left, and how to go on; empty if nothing."""
    written = [str(job.output) for job in done]
    kept = [str(file) for job in jobs for file in states(job)]
    parts = [f"{', '.join(written)} {'is' if len(written) == 1 else 'are'} finished"] if written else []
    if kept:
        parts.append(f"the epochs so far are kept in {', '.join(kept)}")
    return f"{' and '.join(parts)}; go on with the same command and --resume" if parts else ""


def _side_by_side(jobs: Sequence[Job], waiting: Sequence[int], results: dict[int, Result]) -> None:
    """Run jobs in processes of their own; whatever ends this ends them all."""
    there = [jobs[index] for index in waiting]
    if len(there) > 1:  # processes may be in another folder
        there = [replace(job, output=job.output.absolute()) for job in there]
    for place, found in processes.side_by_side(there, run_job):
        if isinstance(found, ProcessDied):
            raise OptionError(f"{found}; go on with --resume, and with fewer --seeds")
        if isinstance(found, Exception):
            raise found
        results[waiting[place]] = found
