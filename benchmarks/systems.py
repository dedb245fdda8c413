"""Accuracy against energy of all systems, support vector machines marked: the figure that README leads with.

    python benchmarks/systems.py DATA OUT.json 'NAME=NETWORK[@TARGET]' …
    python benchmarks/systems.py --draw OUT.png OBJECTS.json CONTAINERS.json

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

import spikeloom
from spikeloom.compiler import __version__
from spikeloom.runtime.report.numbers import wilson

RESULTS = Path(__file__).parent / "results"
STYLES = {"TactileSGNet": ("o", "#1b6ca8"), "counters": ("s", "#c1440e"), "MLP": ("^", "#5c7f3a")}
"""Marker and colour by the first word of a name."""


def measured(name: str, network: str, data: Any) -> dict[str, Any]:
    """Decisions and dynamic energy of one network on the chip."""
    path, _, target = network.partition("@")
    options = {"target": target} if target else {"calibrate": None if "counters" in name else data.train}
    found = spikeloom.compile(path, **options).run(data.test, detail="counts").value
    correct = round(found.accuracy * found.samples)
    costs = found.costs
    about = {"name": name, "network": Path(path).name, "correct": correct, "samples": found.samples}
    amounts = {"operations": costs.per_inference.synaptic_operations, "cores": len(costs.cores)}
    return about | amounts | {"energy_j": dict(costs.per_inference.energy_j)}


def draw(place: str, files: list[str]) -> None:
    """One panel for each data set."""
    figure, panels = plt.subplots(1, len(files), figsize=(4.6 * len(files), 3.4), layout="constrained")
    for axes, file in zip(np.atleast_1d(panels), files, strict=True):
        found = json.loads(Path(file).read_text())
        machines = json.loads(
            (RESULTS / f"features-{found['data'].split('-')[1].split('.')[0].lower()}.json").read_text()
        )
        for kernel, line in (("linear", "--"), ("rbf", ":")):
            best = max((m for m in machines["machines"] if m["kernel"] == kernel), key=lambda m: m["cross_validation"])
            axes.axhline(100 * best["correct"] / machines["test_samples"], color="0.45", ls=line, lw=1)
            axes.annotate(
                f"{kernel} SVM, no chip",
                (1, 100 * best["correct"] / machines["test_samples"]),
                xycoords=("axes fraction", "data"),
                ha="right",
                va="bottom",
                fontsize=7,
                color="0.35",
            )
        for each in found["networks"]:
            marker, colour = STYLES[each["name"].split()[0].rstrip(",")]
            energies = 1e6 * np.array(list(each["energy_j"].values()))
            share = 100 * each["correct"] / each["samples"]
            low, high = (100 * bound for bound in wilson(each["correct"], each["samples"]))
            axes.errorbar(
                energies[0], share, [[share - low], [high - share]], color=colour, marker=marker, ms=5, lw=0.8
            )
            axes.plot(energies, [share] * len(energies), color=colour, lw=2.5, alpha=0.35)
            axes.annotate(
                each["name"].partition(", ")[2],
                (energies[0], share),
                xytext=(6, 4),
                textcoords="offset points",
                fontsize=7,
                color=colour,
            )
        axes.set_xscale("log")
        axes.set(xlabel="dynamic energy a decision (µJ)", title=found["data"].removesuffix(".zip").removeprefix("Ev-"))
        axes.grid(alpha=0.25)
    np.atleast_1d(panels)[0].set_ylabel("test accuracy (%)")
    handles = [plt.Line2D([], [], color=c, marker=m, ls="", label=n) for n, (m, c) in STYLES.items()]
    np.atleast_1d(panels)[0].legend(handles=handles[:2], fontsize=8, loc="lower left")
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
    command = " ".join(
        ["python benchmarks/systems.py", Path(source).name, Path(output).name, *(f"'{n}'" for n in networks)]
    )
    found = {"data": Path(source).name, "command": command, "spikeloom": __version__, "networks": rows}
    Path(output).write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
