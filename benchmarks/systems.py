"""Accuracy against energy of all systems, support vector machines marked: the figure that README leads with.

    python benchmarks/systems.py DATA OUT.json 'NAME=NETWORK[@TARGET]' …
    python benchmarks/systems.py --draw OUT.png OBJECTS.json CONTAINERS.json

Counters of longer bins are trained by `spikeloom train --data Ev-Objects.zip --system counters --ramp 16` with
`--join 5 --parts 2 --thresholds 1,4,16` (100 ms) and `--join 10 --thresholds 1,2,4,8,16` (200 ms); the joined network
by the commands of `docs/training.md`.

Each network is compiled with --calibrate DATA and decides and prices the test split once. The lines are the machines of
`benchmarks/results/features-*.json`, which `python benchmarks/features.py` made: the linear and the radial one that are
best by cross-validation on the training split.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from made import made

import spikeloom
from spikeloom.runtime.report.numbers import wilson

RESULTS = Path(__file__).parent / "results"
WORDS = {"linear": "linear", "rbf": "RBF"}
STYLES = {"TactileSGNet": ("o", "#1b6ca8"), "counters": ("s", "#c1440e")}
"""Marker and colour of a system."""

SVM = {"linear": ("linear SVM, no chip", "--"), "rbf": ("RBF SVM, no chip", ":")}
TICKS = (1, 3, 10, 30, 100, 300)


def measured(name: str, network: str, data: Any) -> dict[str, Any]:
    """Decisions and dynamic energy of one network on the chip."""
    path, _, target = network.partition("@")
    options = {"target": target} if target else {"calibrate": None if "counters" in name else data.train}
    netlist = spikeloom.compile(path, **options)
    found = netlist.run(data.test)
    correct = round(found.accuracy * found.samples)
    costs = netlist.estimate(data.test).details
    about = {"name": name, "network": Path(path).name, "correct": correct, "samples": found.samples}
    amounts = {"operations": costs.per_inference.synaptic_operations, "cores": len(costs.cores)}
    return about | amounts | {"energy_j": dict(costs.per_inference.energy_j)}


def draw(place: str, files: list[str]) -> None:
    """One panel for each data set, small labels beside each mark."""
    figure, panels = plt.subplots(
        len(files), figsize=(5.2, 3.2 * len(files)), layout="constrained", squeeze=False
    )
    for axes, file in zip(panels[:, 0], files, strict=True):
        found = json.loads(Path(file).read_text())
        title = found["data"].removesuffix(".zip").removeprefix("Ev-")
        machines = json.loads((RESULTS / f"features-{title.lower()}.json").read_text())
        best = {
            kernel: max(
                (m for m in machines["machines"] if m["kernel"] == kernel),
                key=lambda m: m["cross_validation"],
            )
            for kernel in SVM
        }
        for kernel, one in best.items():
            words, line = SVM[kernel]
            share = 100 * one["correct"] / machines["test_samples"]
            axes.axhline(share, color="0.45", ls=line, lw=1)
            above = one["correct"] == max(each["correct"] for each in best.values())
            aside = {"xytext": (0, 2 if above else -2), "va": "bottom" if above else "top", "ha": "center"}
            axes.annotate(words, (80, share), textcoords="offset points", fontsize=8, color="0.35", **aside)
        for each in found["networks"]:
            name, _, label = each["name"].partition(", ")
            marker, colour = STYLES[name]
            energies = 1e6 * np.array(list(each["energy_j"].values()))
            share = 100 * each["correct"] / each["samples"]
            low, high = (100 * bound for bound in wilson(each["correct"], each["samples"]))
            span = [[share - low], [high - share]]
            axes.errorbar(energies[0], share, span, color=colour, marker=marker, ms=5, lw=0.8)
            axes.plot(energies, [share] * len(energies), color=colour, lw=2.5, alpha=0.35)
            beside = {"xytext": (4, -11), "textcoords": "offset points", "fontsize": 8, "color": colour}
            axes.annotate(label.replace(", ", "\n"), (energies[0], share), va="top", **beside)
        axes.set_xscale("log")
        axes.set(title=title, xlim=(1, 600), xticks=TICKS, xticklabels=TICKS)
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    panels[-1, 0].set_xlabel("dynamic energy a decision (µJ); bar: the other price table")
    figure.supylabel("test accuracy (%)", fontsize=10)
    handles = [plt.Line2D([], [], color=c, marker=m, ls="", label=name) for name, (m, c) in STYLES.items()]
    panels[0, 0].legend(handles=handles, fontsize=8, loc="lower left")
    figure.savefig(place, dpi=130)


def main() -> None:
    """Measure, or draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draw", metavar="OUT.png")
    parser.add_argument("files", nargs="+")
    arguments = parser.parse_args()
    if arguments.draw:
        draw(arguments.draw, arguments.files)
        return
    source, output, *networks = arguments.files
    data = spikeloom.recordings(source)
    rows = [measured(*each.split("=", 1), data) for each in networks]
    found = made(data.train, data.test) | {"data": Path(source).name, "networks": rows}
    Path(output).write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
