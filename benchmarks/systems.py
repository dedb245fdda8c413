"""Accuracy against energy of all systems, support vector machines marked: the figure that README leads with.

    python benchmarks/systems.py

Draws ``results/systems.png`` from stored results alone, and chooses nothing: the shipped networks of TactileSGNet at 8
bits, the joined ones at their last epoch (five of them, mean), what ``spikeloom smallest`` wrote, and as lines the
linear and the radial support vector machine that are best by cross-validation on the training split.
The picture holds the digest of what it was drawn from; the tests compare.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from spikeloom.runtime.report.numbers import wilson

RESULTS = Path(__file__).parent / "results"
PICTURE = RESULTS / "systems.png"
SOURCES = (
    "shipped.json",
    "joined-containers-100ms.json",
    *(f"smallest-{each}.json" for each in ("objects", "objects-budget", "containers")),
    *(f"features-{each}.json" for each in ("objects", "containers")),
)
SHIPPED = {
    "Objects": {"objects": "20 ms", "objects-200ms": "200 ms"},
    "Containers": {"containers": "20 ms"},
}
"""Rows of the shipped networks, with their bins."""

CHOSEN = {
    "Objects": {"objects": "smallest", "objects-budget": "smallest, under 8 µJ"},
    "Containers": {"containers": "smallest --levels 5"},
}
JOINED = "100 ms, five joined"
STYLES = {"TactileSGNet": ("o", "#1b6ca8"), "counters": ("s", "#c1440e")}
"""Marker and colour of a system."""

SVM = {"linear": ("linear SVM, no chip", "--"), "rbf": ("RBF SVM, no chip", ":")}
TICKS = (3, 10, 30, 100, 300)


def stored(name: str) -> Any:
    return json.loads((RESULTS / name).read_text("utf-8"))


def sources() -> str:
    """Digest of what the picture is drawn from."""
    return hashlib.sha256(b"".join((RESULTS / name).read_bytes() for name in SOURCES)).hexdigest()


def point(
    system: str, label: str, correct: float, interval: tuple[float, float], energy_j: Any
) -> dict[str, Any]:
    """A network: share of test recordings with its interval, and energies by both tables."""
    energies = [1e6 * energy_j[table] for table in ("davies2018", "sanafe")]
    return {"system": system, "label": label, "share": correct, "interval": interval, "energies": energies}


def points(data: str) -> list[dict[str, Any]]:
    """Of one set of recordings."""
    found = []
    figures = stored("shipped.json")["figures"]
    for name, label in SHIPPED[data].items():
        one = figures[name]
        samples = one["test_samples"]
        found.append(
            point(
                "TactileSGNet", label, one["chip"] / samples, wilson(one["chip"], samples), one["energy_j"]
            )
        )
    if data == "Containers":
        joined = stored("joined-containers-100ms.json")["last"]["5"]
        chip, networks = joined["mean"]["chip"], joined["networks"]
        energy_j = {
            table: sum(each["energy_j"][table] for each in networks) / len(networks)
            for table in networks[0]["energy_j"]
        }
        low, high = (end / 60 for end in chip["interval"])
        found.append(point("TactileSGNet", JOINED, chip["mean"] / 60, (low, high), energy_j))
    for name, label in CHOSEN[data].items():
        checked = stored(f"smallest-{name}.json")["checked"]
        right = checked["right"]
        interval = (right["low"], right["high"])
        found.append(point("counters", label, right["accuracy"], interval, checked["costs"]["energy_j"]))
    return found


def lines(axes: Any, data: str) -> None:
    """The support vector machine of each kernel that is best by cross-validation."""
    machines = stored(f"features-{data.lower()}.json")
    best = {
        kernel: max(
            (each for each in machines["machines"] if each["kernel"] == kernel),
            key=lambda each: each["cross_validation"],
        )
        for kernel in SVM
    }
    for kernel, one in best.items():
        words, line = SVM[kernel]
        share = 100 * one["correct"] / machines["test_samples"]
        axes.axhline(share, color="0.45", ls=line, lw=1)
        above = one["correct"] == max(each["correct"] for each in best.values())
        aside = {"xytext": (0, 2 if above else -2), "va": "bottom" if above else "top", "ha": "right"}
        axes.annotate(words, (850, share), textcoords="offset points", fontsize=8, color="0.35", **aside)


def draw() -> None:
    """One panel for each set of recordings, small labels beside each mark."""
    figure, panels = plt.subplots(2, figsize=(5.2, 6.4), layout="constrained")
    for axes, data in zip(panels, SHIPPED, strict=True):
        lines(axes, data)
        for each in points(data):
            marker, colour = STYLES[each["system"]]
            energies, share = each["energies"], 100 * each["share"]
            low, high = (100 * bound for bound in each["interval"])
            span = [[share - low], [high - share]]
            axes.errorbar(energies[0], share, span, color=colour, marker=marker, ms=5, lw=0.8)
            axes.plot(energies, [share] * 2, color=colour, lw=2.5, alpha=0.35)
            beside = {"xytext": (4, -11), "textcoords": "offset points", "fontsize": 8, "color": colour}
            axes.annotate(each["label"].replace(", ", "\n"), (energies[0], share), va="top", **beside)
        axes.set_xscale("log")
        axes.set(title=data, xlim=(2, 900), xticks=TICKS, xticklabels=TICKS)
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    panels[-1].set_xlabel("dynamic energy a decision (µJ): Davies; bar to SANA-FE")
    figure.supylabel("test accuracy (%), chip", fontsize=10)
    handles = [plt.Line2D([], [], color=c, marker=m, ls="", label=name) for name, (m, c) in STYLES.items()]
    panels[0].legend(handles=handles, fontsize=8, loc="lower left")
    figure.savefig(PICTURE, dpi=130, metadata={"Description": f"drawn from {sources()}"})


if __name__ == "__main__":
    draw()
