"""Train several seeds side by side, one process each: all stop together, and each resumes where it stopped."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.errors import OptionError, UnfinishedError
from spikeloom.compiler.files import remove_leftovers, sha256_of
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings, data_digest
from spikeloom.models.training.plan import Plan, seen_by
from spikeloom.models.training.recipes import RELEASED
from spikeloom.runtime.report.console import Progress, tell
from spikeloom.runtime.studies.cluster import cluster
from spikeloom.runtime.studies.jobs import only_one, side_by_side
from spikeloom.runtime.studies.training.results import Finished


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """One seed of a training; crosses process borders."""

    plan: Plan
    training: Recordings
    test: Recordings
    epochs: int
    seed: int
    resume: bool
    output: Path
    keep: tuple[str, ...]  # Which of ``last``, ``best`` and ``clean`` to write
    command: str  # That repeats it
    position: int  # Row of the progress bar
    window: int | None  # Per cent of each recording that trains, where it is a part
    positions_mm: list[list[float]] | None  # Of the taxels, where they were given

    @property
    def state(self) -> Path:
        """Stem of the files that hold the states of its two trainings."""
        return self.output.with_name(f"{self.output.name}.state")


def output_of(output: str, seed: int, seeds: int) -> Path:
    """File of one seed: the one that was asked for, or ``NAME-seedN.pt`` where there are several.

    >>> output_of("a/x.pt", 3, 1).as_posix(), output_of("a/x.pt", 3, 5).as_posix()
    ('a/x.pt', 'a/x-seed3.pt')
    """
    path = Path(output)
    return path if seeds == 1 else path.with_name(f"{path.stem}-seed{seed}{path.suffix}")


def state_of(job: Job) -> tuple[Path, Path]:
    """Files that hold the states of its two trainings."""
    from spikeloom.models.training.train import state_files

    return state_files(job.state)


def run_job(job: Job) -> Finished:
    """Train one seed, read at its last, best and clean epoch, and write its checkpoint."""
    from spikeloom.models.network_kinds import kind_of  # torch, so only here
    from spikeloom.models.training.record import training_record
    from spikeloom.models.training.train import train_both

    plan = job.plan
    kind = kind_of(plan.system)
    reported = train_both(
        joined_bins(job.training, plan.bins),
        joined_bins(job.test, plan.bins),
        seen_by(plan),
        kind.architecture(plan),
        epochs=job.epochs,
        seed=job.seed,
        recipe=plan.recipe,
        state=job.state,
        resume=job.resume,
        position=job.position,
    )
    record = training_record(
        reported,
        job.training,
        job.test,
        command=job.command,
        seed=job.seed,
        recipe=None if plan.recipe == RELEASED else plan.recipe.to_json(),
        window=job.window,
        positions_mm=job.positions_mm,
    )
    trained = reported.trained
    assert trained.kept is not None, "the clean epoch is one of the epochs"
    weights = {"last": trained.last, "best": trained.best, "clean": trained.kept}
    kept = {which: weights[which] for which in WEIGHTS if which in job.keep}
    kind.save(job.output, kept, plan, record.to_json())
    for file in state_of(job):
        file.unlink(missing_ok=True)
    return _finished(job, record)


def recall(job: Job) -> Finished:
    """What `run_job` returned when it wrote the checkpoint that is there; refused if that is of another training."""
    from spikeloom.models.network_kinds import kind_of  # torch, so only here
    from spikeloom.models.training.record import read_record

    kind = kind_of(job.plan.system)
    stored = kind.read(job.output)
    record = dict(stored.training or {})
    wanted = {"epochs": job.epochs, "seed": job.seed, "data_sha256": data_digest(job.training, job.test)}
    differing = [name.removesuffix("_sha256") for name, value in wanted.items() if record.get(name) != value]
    differing += kind.differing(stored, job.plan)
    if record.get("recipe", RELEASED.to_json()) != job.plan.recipe.to_json():
        differing.append("recipe")
    if differing:
        raise OptionError(
            f"{job.output}: holds another training (other {', '.join(differing)}); give its options, or another -o"
        )
    if not set(job.keep) <= set(stored.sets):
        words = " ".join(f"--keep {which}" for which in stored.sets)
        raise OptionError(f"{job.output}: holds only what {words} kept; give these, or another -o")
    return _finished(job, read_record(record))


def _finished(job: Job, record: Any) -> Finished:
    values = {each.name: getattr(record, each.name) for each in fields(record)}
    return Finished(**values, file=job.output.name, sha256=sha256_of(job.output))


def train_seeds(jobs: Sequence[Job], *, resume: bool) -> list[Finished]:
    """Train several seeds, side by side on the cores where there are several; results are those of `run_job`.

    With `resume`, finished seeds are left alone, interrupted ones go on, and the rest is started;
    OptionError if there is something to resume and `resume` is false, or the reverse. The text of a
    KeyboardInterrupt says what is kept.
    """
    with ExitStack() as locks:
        for job in jobs:
            locks.enter_context(only_one(job.output))
        results = {job: recall(job) for job in jobs if resume and finished(job)}
        _require_right_start(jobs, resume=resume, some_finished=bool(results))
        for job in jobs:
            clear(job)
            if job in results:
                tell(f"{job.output}: is finished, not trained again")
            elif resume and not states(job):
                tell(f"{job.output}: was not begun, trained from the start")
        waiting = [job for job in jobs if job not in results]
        progress = Progress(len(waiting))
        try:
            if cluster() is not None:
                progress(0, "training")
            for done, (place, found) in enumerate(side_by_side(waiting, run_job), 1):
                results[waiting[place]] = found
                if cluster() is not None:  # here each has a bar of its own
                    progress(done, "training")
        except UnfinishedError as error:
            raise OptionError(f"{error}; go on with --resume, and with fewer --seeds") from error
        except KeyboardInterrupt as interrupt:
            for job in jobs:
                clear(job)
            written = [str(job.output) for job in waiting if job in results]
            raise KeyboardInterrupt(_kept(written, jobs)) from interrupt
        return [results[job] for job in jobs]


def finished(job: Job) -> bool:
    """Whether its checkpoint exists and no interrupted state is left."""
    return not states(job) and job.output.exists()


def clear(job: Job) -> None:
    """Remove what a killed process left half-written."""
    for file in (job.output, *state_of(job)):
        remove_leftovers(file)


def states(job: Job) -> list[Path]:
    """Files of an interrupted training that exist."""
    return [file for file in state_of(job) if file.exists()]


def _require_right_start(jobs: Sequence[Job], *, resume: bool, some_finished: bool) -> None:
    """Refuse to overwrite an interrupted training, or to resume one that does not exist."""
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


def _kept(written: Sequence[str], jobs: Sequence[Job]) -> str:
    """What an interrupt left, and how to go on; empty if nothing."""
    kept = [str(file) for job in jobs for file in states(job)]
    parts = [f"{', '.join(written)} {'is' if len(written) == 1 else 'are'} finished"] if written else []
    if kept:
        parts.append(f"the epochs so far are kept in {', '.join(kept)}")
    return f"{' and '.join(parts)}; go on with the same command and --resume" if parts else ""
