"""One seed of a training: trained by both protocols and written, or found finished."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.kinds import Plan, kind_of, seen_by
from spikeloom.models.training.recipes import RELEASED
from spikeloom.runtime.studies.training.report import Finished


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """One seed of a training; crosses process borders."""

    plan: Plan
    training: Recordings
    test: Recordings
    epochs: int
    seed: int
    device: str
    resume: bool
    output: Path
    keep: tuple[str, ...]  # Which of ``last``, ``best`` and ``clean`` to write
    command: str  # That repeats it
    draws: bool  # Whether predictions are needed, for a picture
    position: int  # Row of the progress bar

    @property
    def state(self) -> Path:
        """Stem of the files that hold the states of its two trainings."""
        return self.output.with_name(f"{self.output.name}.state")


def output_of(output: str, seed: int, seeds: int) -> Path:
    """File of one seed: the one that was asked for, or ``NAME-seedN.pt`` where there are several.

    Examples
    --------
    >>> output_of("a/x.pt", 3, 1).as_posix(), output_of("a/x.pt", 3, 5).as_posix()
    ('a/x.pt', 'a/x-seed3.pt')
    """
    path = Path(output)
    return path if seeds == 1 else path.with_name(f"{path.stem}-seed{seed}{path.suffix}")


def state_of(job: Job) -> tuple[Path, Path]:
    """Files that hold the states of its two trainings."""
    from spikeloom.models.training.protocols import state_files

    return state_files(job.state)


def run_job(job: Job) -> tuple[Finished, IntArray | None]:
    """Train one seed by both protocols and write its checkpoint; gives the decisions of the last epoch if drawn."""
    from spikeloom.models.training.protocols import train_both
    from spikeloom.models.training.record import training_record

    plan, kind = job.plan, kind_of(job.plan.system)
    reported = train_both(
        joined_bins(job.training, plan.bins),
        joined_bins(job.test, plan.bins),
        seen_by(plan),
        kind.architecture(plan),
        epochs=job.epochs,
        seed=job.seed,
        recipe=plan.recipe,
        device=job.device,
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
        version=__version__,
        device=job.device,
        recipe=None if plan.recipe == RELEASED else plan.recipe.to_json(),
    )
    trained = reported.trained
    assert trained.kept is not None, "the clean epoch is one of the epochs"
    held = {"last": trained.last, "best": trained.best, "clean": trained.kept}
    kept = {which: held[which] for which in WEIGHTS if which in job.keep}
    kind.save(job.output, kept, plan, record.to_json())
    for file in state_of(job):
        file.unlink(missing_ok=True)
    return _finished(job, record), kind.predict(trained.last, plan, job.test) if job.draws else None


def recall(job: Job) -> tuple[Finished, IntArray | None]:
    """What `run_job` returned when it wrote the checkpoint that is there.

    Raises
    ------
    ModelError, OptionError
        If the file is no checkpoint, of another training, or lacks the epoch that a picture or ``--keep`` needs.
    """
    from spikeloom.models.training.protocols import data_digest
    from spikeloom.models.training.record import read_record

    kind = kind_of(job.plan.system)
    found = kind.read(job.output)
    record = dict(found.training or {})
    wanted = {
        "epochs": job.epochs,
        "seed": job.seed,
        "data_sha256": data_digest(job.training, job.test),
        "device": job.device,
    }
    differing = [name.removesuffix("_sha256") for name, value in wanted.items() if record.get(name) != value]
    differing += kind.differing(found, job.plan)
    if record.get("recipe", RELEASED.to_json()) != job.plan.recipe.to_json():
        differing.append("recipe")
    if differing:
        raise OptionError(
            f"{job.output}: holds another training (other {', '.join(differing)}); give its options, or another -o"
        )
    if job.draws and "last" not in found.sets:
        raise OptionError(f"{job.output}: was written without its last epoch, which --picture draws; omit --picture")
    if not set(job.keep) <= set(found.sets):
        words = " ".join(f"--keep {which}" for which in found.sets)
        raise OptionError(f"{job.output}: holds only what {words} kept; give these, or another -o")
    decided = kind.predict_stored(found, job.plan, job.test) if job.draws else None
    return _finished(job, read_record(record)), decided


def _finished(job: Job, record: Any) -> Finished:
    values = {each.name: getattr(record, each.name) for each in fields(record)}
    return Finished(**values, file=job.output.name, sha256=sha256_of(job.output))
