"""The ``train`` command: one seed trained and written, reported by both protocols."""

from __future__ import annotations

import hashlib
import statistics
import textwrap
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spikeloom.compiler.checkpoint import WEIGHTS, Checkpoint
from spikeloom.compiler.dynamics import clocks_over
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.formats.checkpoint import read_checkpoint
from spikeloom.compiler.formats.towers import arrays_of
from spikeloom.compiler.systems import TACTILESGNET, Grid
from spikeloom.compiler.targets.truenorth.native import SYSTEM as NATIVE
from spikeloom.compiler.targets.truenorth.native import USUAL_COPIES
from spikeloom.compiler.targets.truenorth.native_file import Trained, read_trained, write_trained
from spikeloom.models.graphs import Graph
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import HOPS, filters_of, propagation_of
from spikeloom.models.training.recipes import RELEASED, Recipe
from spikeloom.runtime.report.intervals import wilson
from spikeloom.runtime.report.tables import table

if TYPE_CHECKING:
    from spikeloom.models.training.train import Sizes

LAYERS = ("conv1", "fc1", "fc2", "fc3")
"""Layers of the networks that are trained."""

TITLES = {
    "last": "last epoch",
    "best": "paper protocol: best on test",
    "clean": "clean protocol: epoch chosen on validation",
}
"""What the epochs of ``WEIGHTS`` are called where people read of them."""

WIDTH = 118


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """One seed of a training; crosses process borders.

    Parameters
    ----------
    output : Path
        Checkpoint to write.
    keep : tuple of str
        Which of ``last``, ``best`` and ``clean`` to write.
    facts : mapping
        JSON values to store beside the training record.
    draws : bool
        Whether predictions are needed, for a picture.
    position : int
        Row of the progress bar.
    system : str
        One of :data:`spikeloom.compiler.systems.SYSTEMS`, or the one for TrueNorth.
    grid : Grid, optional
        Of a grid-based CNN.
    recipe : Recipe
        How it is trained.
    copies : int
        Of an input, for TrueNorth.
    bins : int
        Bins of the recordings that a step joins.
    """

    training: Recordings
    test: Recordings
    graph: Graph
    epochs: int
    seed: int
    device: str
    resume: bool
    output: Path
    keep: tuple[str, ...]
    command: str
    facts: Mapping[str, Any]
    draws: bool
    position: int
    system: str = TACTILESGNET
    grid: Grid | None = None
    recipe: Recipe = RELEASED
    copies: int = USUAL_COPIES
    bins: int = 1

    def heard(self) -> tuple[Recordings, Recordings]:
        """Training and test recordings in the steps of the network."""
        return joined_bins(self.training, self.bins), joined_bins(self.test, self.bins)

    def propagation(self) -> FloatArray:
        """What the first layer sees."""
        taxels, system = self.graph.n_taxels, TACTILESGNET if self.system == NATIVE else self.system
        return propagation_of(system, self.graph.edges, taxels, self.grid, filters_of(system, taxels, HOPS))

    def architecture(self) -> Sizes:
        """Sizes and dynamics of the network, which the recordings decide, too."""
        if self.system == NATIVE:
            return self._native()
        from spikeloom.models.networks.networks import Architecture

        plain = Architecture(
            taxels=self.graph.n_taxels,
            classes=int(self.training.labels.max()) + 1,
            system=self.system,
            features=self.recipe.features,
            hops=self.recipe.hops,
        )
        return replace(plain, dynamics=self.recipe.dynamics(LAYERS, plain.beta, -(-self.training.steps // self.bins)))

    def _native(self) -> Sizes:
        from spikeloom.models.truenorth.network import sized

        return sized(
            taxels=self.graph.n_taxels,
            classes=int(self.training.labels.max()) + 1,
            hops=self.recipe.hops,
            features=self.recipe.features,
            copies=self.copies,
            clocks=clocks_over(self.recipe.clocks, self.training.steps),
        )


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

    return state_files(_stem(job))


def _stem(job: Job) -> Path:
    return job.output.with_name(f"{job.output.name}.state")


def run_job(job: Job) -> tuple[dict[str, Any], IntArray | None]:
    """Train one seed by both protocols and write its checkpoint.

    Returns
    -------
    record : dict
        JSON values: the training record, file and hash.
    predictions : (test samples,) int64, or None
        Of the last epoch, where they are drawn.
    """
    from spikeloom.models.networks.checkpoint import save_checkpoint, training_record
    from spikeloom.models.training.protocols import train_both
    from spikeloom.models.truenorth.network import NativeArchitecture, native_network

    architecture = job.architecture()
    reported = train_both(
        *job.heard(),
        job.propagation(),
        architecture,
        epochs=job.epochs,
        seed=job.seed,
        recipe=job.recipe,
        device=job.device,
        state=_stem(job),
        resume=job.resume,
        position=job.position,
    )
    record = training_record(reported, job.training, job.test, command=job.command, seed=job.seed) | dict(job.facts)
    if job.recipe != RELEASED:
        record["recipe"] = job.recipe.to_json()
    trained = reported.trained
    assert trained.kept is not None, "the clean epoch is one of the epochs"
    held = {"last": trained.last, "best": trained.best, "clean": trained.kept}
    kept = {which: held[which] for which in WEIGHTS if which in job.keep}
    if isinstance(architecture, NativeArchitecture):
        networks = {which: native_network(architecture, arrays) for which, arrays in kept.items()}
        write_trained(job.output, networks, graph=job.graph.name, edges=job.graph.edges, training=record)
    else:
        save_checkpoint(
            job.output,
            kept,
            job.graph,
            beta=architecture.beta,
            theta=architecture.theta,
            training=record,
            system=job.system,
            grid=job.grid,
            dynamics=architecture.dynamics,
            bins=job.bins,
        )
    for file in state_of(job):
        file.unlink(missing_ok=True)
    return _with_file(job, record), _predictions(job, trained.last) if job.draws else None


def recall(job: Job) -> tuple[dict[str, Any], IntArray | None]:
    """What `run_job` returned when it wrote the checkpoint that is there.

    Raises
    ------
    ModelError
        If the file is no checkpoint.
    OptionError
        If it holds another training, or lacks the epoch that a picture needs.
    """
    found: Checkpoint | Trained = read_trained(job.output) if job.system == NATIVE else read_checkpoint(job.output)
    record = dict(found.training or {})
    differing = _differing(job, record, found)
    if isinstance(found, Trained):
        differing += ["copies"] if found.network.copies != job.copies else []
    else:
        ours, theirs = (None if grid is None else grid.to_json() for grid in (job.grid, found.grid))
        differing += ["system"] if found.system != job.system or ours != theirs else []
        differing += ["bins"] if found.bins != job.bins else []
    _require_same(job, differing, found.sets)
    if not job.draws:
        return _with_file(job, record), None
    if isinstance(found, Trained):
        from spikeloom.models.truenorth.network import predict

        return _with_file(job, record), predict(found.network, job.test)
    return _with_file(job, record), _predictions(job, arrays_of(found))


def _differing(job: Job, record: Mapping[str, Any], found: Checkpoint | Trained) -> list[str]:
    """In what a finished training is another one."""
    from spikeloom.models.training.protocols import data_digest

    wanted = {
        "epochs": job.epochs,
        "seed": job.seed,
        "data_sha256": data_digest(job.training, job.test),
        "device": job.device,
    }
    differing = [name.removesuffix("_sha256") for name, value in wanted.items() if record.get(name) != value]
    if found.graph != job.graph.name or found.edges is None or not np.array_equal(found.edges, job.graph.edges):
        differing.append("graph")
    if record.get("recipe", RELEASED.to_json()) != job.recipe.to_json():
        differing.append("recipe")
    return differing


def _require_same(job: Job, differing: list[str], sets: Collection[str]) -> None:
    """Refuse another training, and one without an epoch that a picture or ``--keep`` needs."""
    if differing:
        raise OptionError(
            f"{job.output}: holds another training (other {', '.join(differing)}); give its options, or another -o"
        )
    if job.draws and "last" not in sets:
        raise OptionError(
            f"{job.output}: was written without its last epoch, which --picture draws; leave --picture away"
        )
    if not set(job.keep) <= set(sets):
        words = " ".join(f"--keep {which}" for which in sets)
        raise OptionError(f"{job.output}: holds only what {words} kept; give these, or another -o")


def _with_file(job: Job, record: Mapping[str, Any]) -> dict[str, Any]:
    sha256 = hashlib.sha256(job.output.read_bytes()).hexdigest()
    return dict(record) | {"file": job.output.name, "sha256": sha256}


def _predictions(job: Job, weights: Mapping[str, Any]) -> IntArray:
    from spikeloom.models.networks.networks import Architecture, SpikingNet
    from spikeloom.models.training.train import predict
    from spikeloom.models.truenorth.network import native_network
    from spikeloom.models.truenorth.network import predict as predict_native

    architecture = job.architecture()
    if not isinstance(architecture, Architecture):
        return predict_native(native_network(architecture, weights), job.test)
    network = SpikingNet(architecture, job.propagation())
    network.load_weights(weights)
    return predict(network, job.heard()[1])


def check_seeds(seeds: int) -> None:
    """Refuse a number of seeds below one.

    Raises
    ------
    OptionError
        If there is none.
    """
    if seeds < 1:
        raise OptionError(f"--seeds {seeds}: at least 1 is needed; give a positive number")


def summary(records: list[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Mean and standard deviation of the accuracy over seeds, by protocol; one seed has no deviation."""
    result: dict[str, dict[str, float | None]] = {}
    for protocol in WEIGHTS:
        values = [record[protocol]["accuracy"] for record in records]
        spread = statistics.stdev(values) if len(values) > 1 else None
        result[protocol] = {"mean": statistics.fmean(values), "std": spread, "min": min(values), "max": max(values)}
    return result


def training_text(report: dict[str, Any]) -> str:
    """A finished training for people: every seed by every protocol, then the means."""
    runs = report["runs"]
    total = runs[0]["test_samples"]
    rows = []
    for run in runs:
        for which in WEIGHTS:
            right = run[which]["correct"]
            low, high = wilson(right, total)
            interval = f"{100 * low:.1f} … {100 * high:.1f}"
            accuracy = f"{100 * right / total:.2f} %"
            name = f"seed {run['seed']}, {TITLES[which]}"
            rows.append([name, str(run[which]["epoch"]), f"{right} of {total}", accuracy, interval])
    command, seed = runs[0]["command"].rsplit(" --seed ", 1)
    several = [f"--seeds {len(runs)}"] if len(runs) > 1 else []
    files = ", ".join(run["file"] for run in runs)
    lines = [
        " ".join([command, f"--seed {seed}", *several]),
        table(["", "epoch", "correct", "accuracy", "95 % interval"], rows),
    ]
    if len(runs) > 1:
        means = [f"{100 * s['mean']:.2f} % ± {100 * s['std']:.2f}" for s in report["protocols"].values()]
        lines.append(f"  mean of {len(runs)} seeds: last {means[0]}, paper {means[1]}, clean {means[2]}")
    written = textwrap.wrap(f"written: {files}", WIDTH, initial_indent="  ", subsequent_indent="    ")
    return "\n".join([*lines, *written])
