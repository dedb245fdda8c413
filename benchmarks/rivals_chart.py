"""CPU time per recording as dots, one panel a workload, from the file that rivals.py writes.

Command: ``python benchmarks/rivals_chart.py rivals.json STEM``
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from growth_chart import save
from matplotlib import pyplot as plt

OURS, RIVAL = "#1b7f5c", "#5b6b7c"


def digits(value: float) -> str:
    """Three digits without an exponent.

    Examples
    --------
    >>> digits(0.57234), digits(18.06), digits(1061.4)
    ('0.572', '18.1', '1,061')
    """
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def draw(result: dict[str, Any], stem: str) -> None:
    """Write STEM.svg and STEM.png."""
    shown = {
        name: {entry: r for entry, r in facts["entries"].items() if "cpu_ms" in r}
        for name, facts in result["workloads"].items()
    }
    tallest = max(map(len, shown.values()))
    figure, panels = plt.subplots(
        1, len(shown), figsize=(8 * len(shown), 1.3 + 0.32 * tallest), squeeze=False, layout="constrained"
    )
    for panel, (name, entries) in zip(panels[0], shown.items(), strict=True):
        operations = result["workloads"][name]["synaptic_operations"]
        rows = sorted(entries.items(), key=lambda item: item[1]["cpu_ms"]["median"])
        for row, (entry, r) in enumerate(rows):
            colour, cpu = OURS if entry.startswith("spikeloom") else RIVAL, r["cpu_ms"]
            panel.plot(
                [cpu["min"], cpu["max"]], [row, row], color=colour, lw=3, alpha=0.4, solid_capstyle="butt"
            )
            panel.plot([cpu["median"]], [row], "o", color=colour, ms=6)
            ratio = f",  {digits(r['ratio']['median'])} × ours" if "ratio" in r else ""
            label = f"{digits(cpu['median'])} ms{ratio}"
            panel.text(cpu["max"] * 1.35, row, label, va="center", fontsize=8, color=colour)
        panel.set_yticks(range(len(rows)), [entry for entry, _ in rows], fontsize=9)
        panel.invert_yaxis()
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter(lambda value, _: f"{value:,.10g}")
        panel.set_xlim(rows[0][1]["cpu_ms"]["min"] / 2, rows[-1][1]["cpu_ms"]["max"] * 40)
        panel.grid(axis="x", color="#ddd", lw=0.6)
        panel.set_axisbelow(True)
        panel.set_xlabel("CPU ms per recording, one thread: median, least to largest", fontsize=9)
        panel.set_title(f"{name}: {operations / 1e6:.1f} M synaptic operations", fontsize=10)
        panel.spines[["top", "right"]].set_visible(False)
    save(figure, stem)


if __name__ == "__main__":
    draw(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")), sys.argv[2])
