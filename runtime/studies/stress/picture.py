"""Curves of ``stress`` as small multiples: both sides with their intervals, and where they break."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Literal

from spikeloom.runtime.studies.stress.verdicts import SIDES, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Json = dict[str, Any]

LOOKS: dict[str, tuple[str, str, Literal["-", "--"]]] = {
    "float": ("#D55E00", "o", "-"),
    "chip": ("#0072B2", "s", "--"),
}
"""Colour (vermilion and blue of Okabe and Ito), marker and dash."""

ACROSS = 5

LABELS = 6
"""Levels that are named below a panel at most."""

PANEL = (3.1, 2.35)
"""Inches."""

DPI = 110


def picture(report: Json) -> bytes:
    """A PNG with a panel for each perturbation."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    found = report["perturbations"]
    across = min(ACROSS, max(len(found), 2))
    down = max(-(-len(found) // across), 1)
    figure, panels = plt.subplots(
        down, across, figsize=(PANEL[0] * across, PANEL[1] * down + 0.9), layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(found) :]:
        axes.set_axis_off()
    for axes, (name, one) in zip(panels.flat, found.items(), strict=False):
        _panel(axes, name, one, report)
    for axes in panels[:, 0]:
        axes.set_ylabel("accuracy (%)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)
    seeds = report["seeds"]
    figure.suptitle(
        f"{report['provenance']['netlist']} on {report['recordings']} recordings of {report['provenance']['data']}, "
        f"{seeds} seed{'s' if seeds > 1 else ''}; vertical lines: where the mean leaves the clean interval",
        fontsize=11,
    )
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=DPI)
    plt.close(figure)
    return content.getvalue()


def _panel(axes: Axes, name: str, one: Json, report: Json) -> None:
    """One perturbation: levels side by side, the clean interval and chance behind."""
    from spikeloom.runtime.report.intervals import wilson

    clean = [100 * bound for bound in wilson(report["clean"]["right"]["chip"], report["recordings"])]
    axes.axhspan(*clean, color="0.88", label="clean on the chip, 95 % interval")
    axes.axhline(100 / report["classes"], color="0.3", linestyle=":", linewidth=1.2, label="chance")
    levels = [point["level"] for point in one["levels"]]
    for shift, side in zip((-0.05, 0.05), SIDES, strict=True):
        points = [point[side] for point in one["levels"]]
        at = [place + shift for place in range(len(levels))]
        mean = [100 * point["mean"] for point in points]
        reach = [
            [100 * (point["mean"] - point["low"]) for point in points],
            [100 * (point["high"] - point["mean"]) for point in points],
        ]
        colour, marker, dash = LOOKS[side]
        axes.errorbar(
            at,
            mean,
            yerr=[[max(r, 0.0) for r in row] for row in reach],
            color=colour,
            marker=marker,
            linestyle=dash,
            markersize=4,
            linewidth=1.4,
            elinewidth=1.0,
            capsize=2,
            label=side,
        )
        leaves = one["breaks"][side]["leaves"]
        if leaves is not None:
            place = levels.index(leaves) + 2 * shift
            axes.axvline(place, color=colour, linestyle=dash, linewidth=1.0, alpha=0.7, zorder=1.5)
    step = -(-len(levels) // LABELS)
    axes.set_xticks(range(0, len(levels), step), [shown(level) for level in levels[::step]], fontsize=8)
    axes.set_ylim(-3, 103)
    axes.set_xlim(-0.5, len(levels) - 0.5)
    axes.tick_params(axis="y", labelsize=8)
    axes.set_xlabel(one["unit"], fontsize=8)
    axes.set_title(f"{name}: {one['verdict']}", fontsize=9)
    axes.grid(axis="y", alpha=0.3)
