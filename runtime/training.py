"""The ``train`` command: one or several seeds side by side, resumable, reported by both protocols, with pictures."""

from __future__ import annotations

import os
import statistics
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from compiler.errors import OptionError
from compiler.fixedpoint import IntArray
from models.evtouch import Recordings
from models.graphs import Graph, normalised_adjacency
from runtime.tables import percent, table

PICTURES = (".png", ".svg", ".pdf")
"""Kinds of picture that `draw_training` writes."""

PROTOCOLS = ("last", "best", "clean")


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
    position : int
        Row of the progress bar.
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
    position: int


def output_of(output: str, seed: int, seeds: int) -> Path:
    """File of one seed: the one that was asked for, or ``NAME-seedN.pt`` where there are several.

    Examples
    --------
    >>> output_of("a/x.pt", 3, 1).as_posix(), output_of("a/x.pt", 3, 5).as_posix()
    ('a/x.pt', 'a/x-seed3.pt')
    """
    path = Path(output)
    return path if seeds == 1 else path.with_name(f"{path.stem}-seed{seed}{path.suffix}")


def run_job(job: Job) -> tuple[dict[str, Any], IntArray]:
    """Train one seed by both protocols and write its checkpoint.

    Returns
    -------
    record : dict
        JSON values: the training record, file and hash.
    predictions : (test samples,) int64
        Of the last epoch.
    """
    import hashlib

    from models.checkpoint import save_checkpoint, training_record
    from models.networks import Architecture, TactileSGNet
    from models.protocols import state_files, train_both
    from models.train import predict

    architecture = Architecture(taxels=job.graph.n_taxels, classes=int(job.training.labels.max()) + 1)
    adjacency = normalised_adjacency(job.graph.edges, job.graph.n_taxels)
    state = job.output.with_name(f"{job.output.name}.state")
    reported = train_both(
        job.training,
        job.test,
        adjacency,
        architecture,
        epochs=job.epochs,
        seed=job.seed,
        device=job.device,
        state=state,
        resume=job.resume,
        position=job.position,
    )
    record = training_record(reported, job.training, job.test, command=job.command, seed=job.seed) | dict(job.facts)
    trained = reported.trained
    assert trained.kept is not None, "the clean epoch is one of the epochs"
    held = {"last": trained.last, "best": trained.best, "clean": trained.kept}
    save_checkpoint(
        job.output,
        {which: held[which] for which in PROTOCOLS if which in job.keep},
        job.graph,
        beta=architecture.beta,
        theta=architecture.theta,
        training=record,
    )
    for file in state_files(state):
        file.unlink(missing_ok=True)
    network = TactileSGNet(architecture, adjacency)
    network.load_weights(trained.last)
    sha256 = hashlib.sha256(job.output.read_bytes()).hexdigest()
    return record | {"file": job.output.name, "sha256": sha256}, predict(network, job.test)


def train_seeds(jobs: list[Job]) -> list[tuple[dict[str, Any], IntArray]]:
    """Run jobs, side by side on the cores where there are several.

    Raises
    ------
    OptionError
        If an output exists whose training is to be resumed though nothing was interrupted, see the jobs.
    """
    if len(jobs) == 1:
        return [run_job(jobs[0])]
    # spawned, not forked: torch and its thread pools do not survive a fork
    with ProcessPoolExecutor(min(len(jobs), os.cpu_count() or 1), mp_context=get_context("spawn")) as pool:
        return list(pool.map(run_job, jobs))


def check_seeds(seeds: int) -> None:
    """Refuse a number of seeds below one.

    Raises
    ------
    OptionError
        If there is none.
    """
    if seeds < 1:
        raise OptionError(f"--seeds {seeds}: at least 1 is needed; give a positive number")


def summary(records: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean and standard deviation of the accuracy over seeds, by protocol."""
    result = {}
    for protocol in PROTOCOLS:
        values = [record[protocol]["accuracy"] for record in records]
        spread = statistics.stdev(values) if len(values) > 1 else 0.0
        result[protocol] = {"mean": statistics.fmean(values), "std": spread, "min": min(values), "max": max(values)}
    return result


def training_text(report: dict[str, Any]) -> str:
    """A finished training for people: every seed by every protocol, then the means."""
    total = report["runs"][0]["test_samples"]
    rows = [
        [
            f"seed {run['seed']}",
            *(f"{percent(run[p]['correct'], total)}, epoch {run[p]['epoch']}" for p in PROTOCOLS),
            run["file"],
        ]
        for run in report["runs"]
    ]
    lines = [
        report["runs"][0]["command"],
        table(["", "last epoch", "paper protocol: best on test", "clean: epoch chosen on validation", "file"], rows),
    ]
    if len(rows) > 1:
        means = [f"{100 * s['mean']:.2f} % ± {100 * s['std']:.2f}" for s in report["protocols"].values()]
        lines.append(f"  mean of {len(rows)} seeds: last {means[0]}, paper {means[1]}, clean {means[2]}")
    return "\n".join(lines)


def draw_training(path: str, records: list[dict[str, Any]], labels: IntArray, predictions: list[IntArray]) -> None:
    """Draw learning curves of all seeds and the confusion matrix of their last epochs, summed.

    Parameters
    ----------
    path : str
        PNG, SVG or PDF to write, whole or not at all.
    records : list of dict
        Training records.
    labels : (samples,) int64
        True classes.
    predictions : list of (samples,) int64
        One per record.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import MaxNLocator

    from compiler.atomic import write_atomically

    classes = int(max(labels.max(), *(p.max() for p in predictions))) + 1
    confusion = np.zeros((classes, classes), np.int64)
    for predicted in predictions:
        np.add.at(confusion, (labels, predicted), 1)
    samples = records[0]["test_samples"]
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(13, 4.2), layout="constrained", width_ratios=(1, 1, 1.05)
    )
    for index, record in enumerate(records):
        history = np.array(record["history"])
        epochs = np.arange(1, len(history) + 1)
        colour = f"C{index}"
        left.semilogy(epochs, history[:, 0], color=colour, label=f"seed {record['seed']}")
        left.semilogy(epochs, history[:, 1], color=colour, linestyle="--")
        middle.plot(epochs, 100 * history[:, 2] / samples, color=colour, label=f"seed {record['seed']}")
        clean = record["clean"]
        middle.plot(clean["epoch"], 100 * clean["accuracy"], "o", color=colour, markeredgecolor="black")
    left.set(xlabel="epoch", ylabel="squared error of spike rates", title="loss: training solid, test dashed")
    middle.set(xlabel="epoch", ylabel="test accuracy (%)", title="accuracy; circle: epoch of the clean protocol")
    for axes in (left, middle):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    middle.legend(loc="lower right")
    image = right.imshow(confusion, cmap="cividis")
    right.set(xlabel="decision", ylabel="class", title="confusion, last epoch")
    right.xaxis.set_major_locator(MaxNLocator(integer=True))
    right.yaxis.set_major_locator(MaxNLocator(integer=True))
    figure.colorbar(image, ax=right, label="test recordings")
    with write_atomically(path) as file:
        figure.savefig(file, format=Path(path).suffix.removeprefix(".") or "png", dpi=120, metadata=_no_date(path))
    plt.close(figure)


def _no_date(path: str) -> dict[str, Any]:
    """Metadata that keeps equal pictures equal: SVG and PDF would store the date."""
    return {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(Path(path).suffix, {})
