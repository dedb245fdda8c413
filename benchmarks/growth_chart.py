"""Charts of the file that growth.py writes; command: ``python benchmarks/growth_chart.py growth.json STEM``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import NullFormatter

OURS, GUIDE = "#1b7f5c", "#9aa5b1"

AXES = {
    "activity": ("input_density", "share of channels with an event in a step (layers spike about as often)"),
    "steps": ("steps", "steps of a recording"),
    "synapses": ("synapses", "synapses"),
}
"""What lies along the bottom of the charts with two logarithmic axes, and its label."""


def save(figure: Any, stem: str) -> None:
    """Write STEM.svg and STEM.png; the same figures give the same files."""
    with mpl.rc_context({"svg.hashsalt": "spikeloom"}):
        figure.savefig(Path(f"{stem}.svg"), metadata={"Date": None})
    figure.savefig(Path(f"{stem}.png"), dpi=120)
    plt.close(figure)


def _finish(figure: Any, panel: Any, stem: str) -> None:
    panel.grid(which="major", color="#ddd", lw=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    save(figure, stem)


def draw(result: dict[str, Any], stem: str) -> None:
    """Write STEM-activity, STEM-steps, STEM-synapses and STEM-threads, each as .svg and .png."""
    for name, (key, label) in AXES.items():
        along = np.array([row[key] for row in result[name]], np.float64)
        cost = np.array([row["ms"] for row in result[name]])
        figure, panel = plt.subplots(figsize=(5.6, 4), layout="constrained")
        panel.loglog(along, cost[-1] * along / along[-1], "--", color=GUIDE, lw=1, label="proportional")
        panel.loglog(along, cost, "o-", color=OURS, label="measured")
        panel.set_xlabel(label, fontsize=9)
        panel.set_ylabel("CPU ms per recording, one thread", fontsize=9)
        panel.set_ylim(cost.min() / 3, cost.max() * 2)
        panel.xaxis.set_major_formatter(lambda value, _: f"{value:,.10g}")
        panel.yaxis.set_major_formatter(lambda value, _: f"{value:,.10g}")
        panel.legend(frameon=False, fontsize=9)
        _finish(figure, panel, f"{stem}-{name}")
    threads = [row["threads"] for row in result["threads"]]
    speed = [1e3 / row["ms"] for row in result["threads"]]
    figure, panel = plt.subplots(figsize=(5.6, 4), layout="constrained")
    panel.plot(
        [0, *threads], [0, *(speed[0] * n for n in threads)], "--", color=GUIDE, lw=1, label="proportional"
    )
    panel.plot(threads, speed, "o-", color=OURS, label="measured")
    panel.set_xticks(threads)
    panel.set_xlim(0, threads[-1] + 0.5)
    panel.set_ylim(0, 1.2 * max(speed[0] * threads[-1], *speed))
    panel.set_xlabel("threads", fontsize=9)
    panel.set_ylabel("recordings per second (wall time)", fontsize=9)
    panel.legend(frameon=False, fontsize=9)
    _finish(figure, panel, f"{stem}-threads")


def draw_skins(result: dict[str, Any], stem: str) -> None:
    """Write STEM.svg and STEM.png: times, of the file that skins.py writes."""
    rows = result["skins"]
    synapses = np.array([row["synapses"] for row in rows], np.float64)
    figure, panel = plt.subplots(figsize=(5.2, 3.6), layout="constrained")
    for key, label, colour, mark in (
        ("compile_s", "compile", OURS, "o"),
        ("prepare_s", "prepare the engine", "#3b6fb5", "s"),
        ("run_s", "run a recording of 50 steps", "#c2571a", "^"),
    ):
        cost = np.array([row["run_ms"] / 1e3 if key == "run_s" else row[key] for row in rows])
        panel.loglog(synapses, cost[-1] * synapses / synapses[-1], "--", color=GUIDE, lw=1)
        panel.loglog(synapses, cost, f"{mark}-", color=colour)
        panel.annotate(
            label, (synapses[1], cost[1]), (6, -12), textcoords="offset points", color=colour, fontsize=9
        )
    panel.set(ylabel="seconds (dashed: in proportion)", xlabel="synapses", xticks=[2e6, 5e6, 1e7, 3e7, 1e8])
    panel.xaxis.set_major_formatter(lambda value, _: f"{value / 1e6:g} M")
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.grid(which="major", color="#ddd", lw=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    _finish(figure, panel, stem)


if __name__ == "__main__":
    draw(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")), sys.argv[2])
