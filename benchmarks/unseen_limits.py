"""Who breaks first on a scene of textures: pace, pressure and lost taxels, for counters, small networks and a ridge.

    python benchmarks/unseen_limits.py ntp-textures.zip OUT.json --picture OUT.png

Every system is trained without one speed (`unseen.write_events`), compiled, and decides the recordings of that speed
as they are and changed: events at other times (pace: twice as fast has half the steps), a share of events kept
(pressure), random taxels without events (mean of several draws). Beside it: the share of decisions that no single event
alters, and what is decided after half of each recording.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from unseen import TAXELS, write_events, write_taxels

import spikeloom
from spikeloom.compiler import __version__
from spikeloom.compiler.files import sha256_of
from spikeloom.models.recordings.evtouch import Recordings, first_part
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.studies.robustness.exhaustive import share_robust_to_one_event
from spikeloom.runtime.studies.smallest.baselines import RIDGE, features, machine
from spikeloom.runtime.studies.smallest.space import Candidate

COMMAND = "python benchmarks/unseen_limits.py ntp-textures.zip OUT.json --picture OUT.png"
CONDITION = "speed=3600"

NETWORKS: dict[str, dict[str, Any]] = {
    "counters": {"system": "counters", "thresholds": "1,2,3,5,8", "parts": 3, "window": "50%"},
    "MLP 32, 32": {"system": "mlp", "features": 32, "hidden": "32"},
    "TactileSGNet 16, 64": {"features": 16, "hops": 1, "hidden": "64", "spike_penalty": 0.3},
    "TactileSGNet 64, 128, 256": {"features": 64, "hops": 3, "hidden": "128,256"},
}
"""Options of ``train``; those of gradients are trained for 48 epochs by the recipe ``rates``."""

PACES = (0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0)
KEPT = (1.0, 0.9, 0.75, 0.5, 0.25)
LOST = (0, 1, 2, 3)
DRAWS = 10
"""Sets of lost taxels, or of kept events."""

RIDGE_PENALTY = 10.0

Decide = Callable[[Recordings], np.ndarray[Any, Any]]


def at_pace(data: Recordings, pace: float) -> Recordings:
    """Recordings whose events come at step / pace, and that are as much shorter or longer."""
    steps = np.maximum(1, np.ceil(data.step_counts / pace)).astype(np.int64)
    events = np.zeros((*data.events.shape[:3], int(steps.max())), np.uint8)
    sample, taxel, polarity, step = np.nonzero(data.events)
    events[sample, taxel, polarity, np.minimum((step / pace).astype(np.int64), steps[sample] - 1)] = 1
    return replace(data, held=events, lengths=steps)


def with_events_kept(data: Recordings, share: float, draw: np.random.Generator) -> Recordings:
    """Each event stays with this probability."""
    return replace(data, held=data.events * (draw.random(data.events.shape) < share))


def without_taxels(data: Recordings, count: int, draw: np.random.Generator) -> Recordings:
    """Recordings in which some taxels, the same in all, send nothing."""
    events = data.events.copy()
    events[:, draw.permutation(data.taxels)[:count]] = 0
    return replace(data, held=events)


def accuracies(decide: Decide, test: Recordings) -> dict[str, list[float]]:
    """Per cent of right decisions by perturbation, in the order of its levels."""

    def right(data: Recordings) -> float:
        return 100 * float(np.mean(decide(data) == test.labels))

    def mean(change: Callable[[Recordings, Any, np.random.Generator], Recordings], level: Any) -> float:
        return float(
            np.mean([right(change(test, level, np.random.default_rng(seed))) for seed in range(DRAWS)])
        )

    return {
        "pace": [right(at_pace(test, pace)) for pace in PACES],
        "events kept": [mean(with_events_kept, share) for share in KEPT],
        "taxels lost": [mean(without_taxels, count) for count in LOST],
        "half, at each pace": [right(first_part(at_pace(test, pace), 50)) for pace in PACES],
    }


def network(options: dict[str, Any], folder: Path, taxels: Path, scratch: Path) -> Any:
    """The machine of a network that is trained on a folder."""
    file = str(scratch / "network.pt")
    counts = options.get("system") == "counters"
    known = {} if counts else {"recipe": "rates", "epochs": 48, "taxels": str(taxels)}
    known |= {"graph": "knn:4"} if "hops" in options else {}
    spikeloom.train(str(folder), file, **known, **options)
    compiled = spikeloom.compile(file, **({} if counts else {"calibrate": str(folder), "weight_bits": 8}))
    compiled.save(str(scratch / "network.loom"))
    return machine_for(str(scratch / "network.loom"))


def ridge(training: Recordings) -> Decide:
    """Decisions of a quadratic ridge on counts and rates."""
    candidate = Candidate(system=RIDGE, options={"counts": "log", "parts": 1})
    fitted = machine(RIDGE, RIDGE_PENALTY).fit(features(training, candidate), training.labels)
    return lambda data: np.asarray(fitted.predict(features(data, candidate)))


def of_machine(chip: Any) -> Decide:
    """Decisions of a chip; recordings of a counting network are as long as it counts."""

    def decide(data: Recordings) -> np.ndarray[Any, Any]:
        length = chip.netlist.clocks.length
        if length is None:
            return np.asarray(chip.run(data.events, lengths=data.lengths).decisions)
        from spikeloom.models.recordings.events import of_length

        return np.asarray(chip.run(of_length(data, length).events).decisions)

    return decide


def draw(results: dict[str, Any], file: Path) -> None:
    """Three panels, accuracy over each perturbation."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    levels = {"pace": PACES, "events kept": KEPT, "taxels lost": LOST}
    labels = {
        "pace": "pace, times that of the recordings",
        "events kept": "share of events kept",
        "taxels lost": "taxels lost, of nine",
    }
    figure, panels = plt.subplots(1, 3, figsize=(11, 3.6), sharey=True, layout="constrained")
    for panel, (kind, values) in zip(panels, levels.items(), strict=True):
        for (name, found), marker in zip(results.items(), "osv^D", strict=True):
            panel.plot(values, found[kind], marker=marker, ms=5, label=name)
        panel.set_xlabel(labels[kind])
        panel.grid(alpha=0.4)
    panels[0].set_xscale("log")
    panels[0].set_xticks(PACES, [f"{pace:g}" for pace in PACES])
    panels[0].minorticks_off()
    panels[1].invert_xaxis()
    panels[2].set_xticks(LOST)
    panels[0].set_ylabel("right decisions (%)")
    panels[0].set_ylim(0, 100)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    figure.savefig(file, dpi=110)


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "data")
        taxels = write_taxels(Path(scratch, "taxels.csv"))
        write_events(options.archive, folder, CONDITION)
        training, test = (
            recordings(str(folder), split, classes=None, taxels=TAXELS) for split in ("train", "test")
        )
        results: dict[str, Any] = {}
        for name, about in NETWORKS.items():
            chip = network(about, folder, taxels, Path(scratch))
            results[name] = accuracies(of_machine(chip), test)
            if chip.netlist.clocks.length is None:
                results[name]["no event alters"] = 100 * share_robust_to_one_event(chip, test)
        results["quadratic ridge"] = accuracies(ridge(training), test)
    head = {"command": COMMAND, "spikeloom": __version__, "data_sha256": sha256_of(options.archive)}
    levels = {"pace": PACES, "events kept": KEPT, "taxels lost": LOST, "left out": CONDITION, "draws": DRAWS}
    options.output.write_text(
        json.dumps(head | {"levels": levels, "networks": NETWORKS, "results": results}, indent=1) + "\n"
    )
    if options.picture:
        draw(results, options.picture)


if __name__ == "__main__":
    main()
