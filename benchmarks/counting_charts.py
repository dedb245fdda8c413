"""Figures of counting networks: what they reach, with fewer taxels, and where they break beside other networks.

    python benchmarks/counting_charts.py stress OUT.png 'counters=counters.json' 'TactileSGNet=tactilesgnet.json'
    python benchmarks/counting_charts.py fewer OUT.png fewer-objects.json fewer-containers.json

The files are those of `spikeloom stress -o` and `benchmarks/fewer.py`.
"""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from spikeloom.compiler.files import write_atomically
from spikeloom.runtime.report.drawing import COLOURS, DASHES, GREY, MARKERS, STYLE
from spikeloom.runtime.report.numbers import wilson

Json = dict[str, Any]

ACROSS = 6
PALETTE = 64


def stress(names: Sequence[str], results: Sequence[Json]) -> Figure:
    """Accuracy of each network on the chip over the level of each perturbation."""
    panels = list(results[0]["perturbations"])
    down = -(-len(panels) // ACROSS)
    figure, rows = plt.subplots(down, ACROSS, figsize=(13, 1.75 * down + 0.5), sharey=True, layout="constrained")
    for axes in rows.flat[len(panels) :]:
        axes.set_visible(False)
    for axes, panel in zip(rows.flat, panels, strict=False):
        for index, result in enumerate(results):
            if panel not in result["perturbations"]:
                continue
            levels = result["perturbations"][panel]["levels"]
            mean, low, high = (
                100 * np.array([each["chip"][key] for each in levels]) for key in ("mean", "low", "high")
            )
            at = np.arange(len(levels)) + 0.07 * index
            look = {"color": COLOURS[index], "marker": MARKERS[index], "ls": DASHES[index], "ms": 3, "lw": 1.2}
            reach = np.maximum([mean - low, high - mean], 0)
            axes.errorbar(at, mean, yerr=reach, elinewidth=0.8, **look, label=names[index])
            right, samples = result["clean"]["right"]["chip"], result["recordings"]
            axes.axhspan(*(100 * each for each in wilson(right, samples)), color=COLOURS[index], alpha=0.1, lw=0)
        axes.axhline(100 / results[0]["classes"], color=GREY, ls=":", lw=0.8)
        axes.set_xticks(range(len(levels)), [f"{each['level']:g}" for each in levels], fontsize=7)
        axes.set_title(panel.replace("_", " "), fontsize=9, pad=3)
        axes.set_xlabel(results[0]["perturbations"][panel]["unit"].partition(",")[0], fontsize=7, labelpad=1)
        axes.set(ylim=(-3, 103), xlim=(-0.4, len(levels) - 0.4))
        axes.grid(axis="y", alpha=0.3)
    figure.supylabel("test accuracy on the chip, %", fontsize=9)
    figure.legend(*rows.flat[0].get_legend_handles_labels(), loc="lower right", fontsize=9, ncols=len(names))
    return figure


def fewer(results: Sequence[Json]) -> Figure:
    """Accuracy over the number of taxels, of whole recordings and of half ones."""
    figure, rows = plt.subplots(1, len(results), figsize=(4.2 * len(results), 3.2), sharey=True, layout="constrained")
    for axes, result in zip(np.atleast_1d(rows), results, strict=True):
        for index, (window, words) in enumerate(((100, "whole recordings"), (50, "first half"))):
            points = {
                int(name.split()[0]): each for name, each in result["points"].items() if name.endswith(f" {window} %")
            }
            taxels = sorted(points)
            mean, low, high = 100 * np.array([points[each]["accuracy"] for each in taxels]).T
            test = [100 * points[each]["test_correct"] / result["test_samples"] for each in taxels]
            look = {"color": COLOURS[index], "marker": MARKERS[index], "ls": DASHES[index], "ms": 4}
            axes.errorbar(taxels, mean, yerr=[mean - low, high - mean], capsize=2, label=f"{words}, nested", **look)
            axes.plot(taxels, test, "x", color=COLOURS[index], ms=5, label=f"{words}, test split")
        axes.set(title=result["data"].removesuffix(".zip"), xlabel="taxels that are left", ylim=(25, 100))
        axes.grid(alpha=0.3)
    first = np.atleast_1d(rows)[0]
    first.set_ylabel("accuracy, %")
    first.legend(fontsize=8, loc="lower right")
    return figure


def main() -> None:
    """Read, draw, write with a palette."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("stress", "fewer"))
    parser.add_argument("output", type=Path)
    parser.add_argument("files", nargs="+", metavar="[NAME=]FILE")
    arguments = parser.parse_args()
    parts = [each.rpartition("=") for each in arguments.files]
    results = [json.loads(Path(path).read_text()) for _, _, path in parts]
    plt.rcParams.update(STYLE)
    figure = stress([name for name, _, _ in parts], results) if arguments.what == "stress" else fewer(results)
    drawn, content = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, dpi=110, format="png")
    Image.open(drawn).convert("RGB").quantize(PALETTE).save(content, "PNG", optimize=True)
    with write_atomically(arguments.output) as file:
        file.write(content.getvalue())


if __name__ == "__main__":
    main()
