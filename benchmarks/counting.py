"""Two pictures of counting networks, from stored results: fewer taxels, and what breaks them beside TactileSGNet.

    python benchmarks/counting.py [FOLDER]

Draws ``counting-fewer.png`` from ``fewer-objects.json`` and ``fewer-containers.json``, and ``counting-stress.png``
from ``stress-counters.json`` and ``stress-objects.json``, means over seeds. Both hold the digest of what was drawn; the
tests draw them again and compare.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from spikeloom.runtime.studies.robustness.perturbations import SAMPLED

RESULTS = Path(__file__).parent / "results"
STYLES = ({"marker": "o", "color": "#0072b2"}, {"marker": "s", "color": "#e69f00", "ls": (0, (5, 2))})
"""Of the first and the second thing that a panel compares; they can be told apart without colours."""

NETWORKS = {"counting network": "stress-counters.json", "TactileSGNet": "stress-objects.json"}
WINDOWS = {"100": "whole recordings", "50": "first half"}
"""Parts of a recording, in %."""

COLUMNS = 6


def stored(name: str) -> Any:
    return json.loads((RESULTS / name).read_text("utf-8"))


def fewer() -> dict[str, Any]:
    """By recordings and part of a recording: taxels, accuracy in nested cross-validation and its interval, test."""
    found: dict[str, Any] = {
        name: {words: [] for words in WINDOWS.values()} for name in ("Objects", "Containers")
    }
    for name, lines in found.items():
        result = stored(f"fewer-{name.lower()}.json")
        for point, each in result["points"].items():
            taxels, window = re.findall(r"\d+", point)
            if window in WINDOWS:
                test = each["test_correct"] / result["test_samples"]
                lines[WINDOWS[window]].append((int(taxels), *each["accuracy"], test))
    return found


def stress() -> dict[str, Any]:
    """By perturbation and network: levels, and accuracy on the chip at each."""
    figures = {name: stored(file)["figures"] for name, file in NETWORKS.items()}
    return {
        kind: {
            name: {level: point["chip"] for level, point in each[kind]["levels"].items()}
            for name, each in figures.items()
        }
        for kind in figures["TactileSGNet"]
        if kind != "clean"
    }


def draw_fewer(found: dict[str, Any]) -> plt.Figure:
    """A panel for each set of recordings; crosses are of the test split."""
    figure, panels = plt.subplots(1, len(found), figsize=(9.2, 3.5), layout="constrained", sharey=True)
    for axes, (name, lines) in zip(panels, found.items(), strict=True):
        for style, (words, points) in zip(STYLES, lines.items(), strict=True):
            taxels = [point[0] for point in points]
            mean, low, high, test = 100 * np.array([point[1:] for point in points]).T
            span = (mean - low, high - mean)
            axes.errorbar(taxels, mean, span, ms=4, capsize=2, label=f"{words}, nested", **style)
            axes.plot(taxels, test, "x", color=style["color"], label=f"{words}, test split")
        axes.set(title=name, xlabel="taxels that are left")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("accuracy (%)")
    panels[0].legend(fontsize=8, loc="lower right")
    return figure


def draw_stress(found: dict[str, Any]) -> plt.Figure:
    """A panel for each perturbation."""
    rows = -(-len(found) // COLUMNS)
    size = (2 * COLUMNS, 1.7 * rows)
    figure, panels = plt.subplots(rows, COLUMNS, figsize=size, layout="constrained", sharey=True)
    for axes in panels.flat[len(found) :]:
        axes.set_axis_off()
    for axes, (kind, lines) in zip(panels.flat, found.items(), strict=False):
        for style, (name, levels) in zip(STYLES, lines.items(), strict=True):
            axes.plot(list(levels), [100 * share for share in levels.values()], ms=4, label=name, **style)
        axes.set_title(kind.replace("_", " "), fontsize=9)
        axes.set_xlabel(SAMPLED[kind].unit, fontsize=8)
        axes.set_ylim(-4, 104)
        axes.tick_params(labelsize=8)
        axes.grid(axis="y", alpha=0.3)
    figure.supylabel("test accuracy on the chip (%)", fontsize=10)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="lower right")
    return figure


PICTURES = {"counting-fewer.png": (fewer, draw_fewer), "counting-stress.png": (stress, draw_stress)}


def sources(found: dict[str, Any]) -> str:
    """Digest of what a picture shows."""
    return hashlib.sha256(json.dumps(found).encode()).hexdigest()


def draw(folder: Path) -> list[Path]:
    """Both pictures."""
    for name, (what, figure) in PICTURES.items():
        found = what()
        made = figure(found)
        made.savefig(folder / name, dpi=80, metadata={"Description": f"drawn from {sources(found)}"})
        plt.close(made)
    return [folder / name for name in PICTURES]


if __name__ == "__main__":
    print(*draw(Path(sys.argv[1]) if sys.argv[1:] else RESULTS), sep="\n")
