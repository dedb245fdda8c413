"""Figures of the page that are of one kind: cores on the mesh, taxels on the fingertip, membranes of one neuron."""

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from spikeloom.compiler.types import FloatArray
from spikeloom.runtime.machines.core_map import CoreMap
from spikeloom.runtime.page.recording import Trace
from spikeloom.runtime.page.results import Taxels
from spikeloom.runtime.report.drawing import CHIP, COLOURS, DASHES, FLOAT, GREY, Drawing, sheet, styled

DETAILED = 1000
"""Taxels up to which their graph is drawn and each tells its values."""


Place = tuple[float, float]
"""Left and upper end of a core in tiles, which are as wide as high."""


@styled()
def mesh(cores: CoreMap) -> Drawing:
    """Used part of each chip's mesh: tiles, their cores, and how full the fullest limit is."""
    from matplotlib.patches import Rectangle

    places, size, tiles, chips = _places(cores)
    across = max(x for x, _ in tiles) + 1
    down = max(y for _, y in tiles) + 1
    drawing = sheet("Cores on the mesh and how full they are", max(2.8, 1.1 * down + 0.6))
    axes = drawing.figure.subplots()
    for (x, y), tile in tiles.items():
        axes.add_patch(Rectangle((x, y), 0.92, 0.9, fill=False, edgecolor=GREY, alpha=0.5))
        axes.text(x + 0.02, y + 0.06, f"tile {tile}", fontsize=7, va="center")
    for y, chip in chips.items():
        axes.text(0, y - 0.08, f"chip {chip}", fontsize=8)
    wide, high = size
    for core in cores.cores:
        x, y = places[core.core]
        level = high * min(core.fill[core.fullest].share, 1.0)
        axes.add_patch(Rectangle((x, y + high - level), wide, level, facecolor=CHIP, alpha=0.25))
        axes.add_patch(Rectangle((x, y), wide, high, fill=False, edgecolor=GREY))
        label = f"{core.core}: {' '.join(core.layers)}" if across <= 4 and wide > 0.3 else str(core.core)
        axes.text(x + wide / 2, y + 0.06, label, fontsize=7, ha="center", va="center")
        limits = ", ".join(f"{name} {100 * use.share:.0f} %" for name, use in core.fill.items())
        tip = f"core {core.core}, {' '.join(core.layers)}, {core.compartments:,} compartments; {limits}"
        drawing.tips.append((axes, x + wide / 2, y + high / 2, tip))
    axes.set(xlim=(-0.04, across), ylim=(down + 0.1, -0.15))
    axes.axis("off")
    return drawing


def _places(cores: CoreMap) -> tuple[dict[int, Place], Place, dict[Place, int], dict[float, int]]:
    """Place of each core, the size of all, tiles by place, and chips by their upper end, from top to bottom."""
    fullest = max(Counter(core.tile for core in cores.cores).values())
    columns = min(fullest, 2)
    wide = 0.88 / columns - 0.04
    high = 0.76 / -(-fullest // columns) - 0.03
    places: dict[int, Place] = {}
    tiles: dict[Place, int] = {}
    chips: dict[float, int] = {}
    top = 0.0
    numbers = sorted({core.chip for core in cores.cores})
    for chip in numbers:
        on_chip = [core for core in cores.cores if core.chip == chip]
        left = min(core.x for core in on_chip)
        upper = min(core.y for core in on_chip)
        chips |= {top: chip} if len(numbers) > 1 else {}
        slots: Counter[int] = Counter()
        for core in on_chip:
            x = float(core.x - left)
            y = top + core.y - upper
            tiles[x, y] = core.tile
            row, column = divmod(slots[core.tile], columns)
            slots[core.tile] += 1
            places[core.core] = x + 0.03 + column * (wide + 0.03), y + 0.12 + row * (high + 0.02)
        top += max(core.y for core in on_chip) - upper + 1.2
    return places, (wide, high), tiles, chips


@styled()
def fingertip(taxels: Taxels) -> Drawing:
    """Taxels where they lie, joined as the graph joins them; discs grow with events, and with first-layer spikes."""
    from matplotlib.patches import Circle

    n = len(taxels.events)
    turn = 2 * math.pi * np.arange(n) / n - math.pi / 2
    points = (
        np.stack([np.cos(turn), np.sin(turn)], axis=1)
        if taxels.positions_mm is None
        else taxels.positions_mm
    )
    panels = {"input events": taxels.events}
    if taxels.spikes is not None:
        panels[f"{taxels.layer} spikes on the chip"] = taxels.spikes
    drawing = sheet("Taxels, the graph over them and their activity", 4.6)
    largest = _reach(points)
    axes_of = np.ravel(drawing.figure.subplots(1, len(panels)))
    for axes, (name, values) in zip(axes_of, panels.items(), strict=True):
        if n <= DETAILED:
            for a, b in sorted({(min(pair), max(pair)) for pair in taxels.edges.tolist()}):
                axes.plot(points[[a, b], 0], points[[a, b], 1], color=GREY, lw=0.8, alpha=0.6, zorder=1)
            for taxel, ((x, y), value) in enumerate(zip(points.tolist(), values.tolist(), strict=True)):
                drawing.tips.append((axes, x, y, f"taxel {taxel}: {value:,.1f} {name} in a mean recording"))
        radii = largest * (0.25 + 0.75 * np.sqrt(values / (values.max() or 1.0)))
        for taxel, ((x, y), radius) in enumerate(zip(points.tolist(), radii, strict=True)):
            axes.add_patch(
                Circle((x, y), radius, facecolor=COLOURS[1], edgecolor=GREY, alpha=0.7, lw=0.6, zorder=2)
            )
            if n <= 100:
                axes.text(x, y, str(taxel), ha="center", va="center", fontsize=6, zorder=3)
        axes.set(title=f"{name}, mean recording", aspect="equal")
        axes.margins(0.08)
        axes.autoscale_view()
        axes.axis("off")
    return drawing


def _reach(points: FloatArray) -> float:
    """Largest radius of discs that keep apart."""
    from scipy.spatial import KDTree  # a tenth of a second that other commands need not wait

    span = float(np.ptp(points, axis=0).max()) or 1.0
    nearest = KDTree(points).query(points, k=2)[0][:, 1].min() if len(points) > 1 else span
    return float(min(max(0.5 * nearest, span / 300), span / 16))


@styled()
def membranes(traces: Sequence[Trace]) -> Drawing:
    """Membranes of both sides and their thresholds, a panel for each trace."""
    drawing = sheet(traces[0].title, 2.1 * len(traces) + 0.4)
    drawing.along = "x"
    for axes, trace in zip(np.ravel(drawing.figure.subplots(len(traces), 1)), traces, strict=True):
        steps = trace.first_step + np.arange(len(trace.model))
        axes.axvspan(trace.step - 0.5, trace.step + 0.5, color=COLOURS[1], alpha=0.25, lw=0)
        for theta in {trace.theta, trace.chip_theta}:
            axes.axhline(theta, color=GREY, ls=":", lw=1.2)
        axes.plot(steps, trace.model, color=FLOAT, lw=1.3, label="float model")
        axes.plot(steps, trace.chip, color=CHIP, lw=1.3, ls=DASHES[1], label="chip")
        top = max(trace.model.max(), trace.chip.max(), trace.theta, trace.chip_theta)
        low = min(trace.model.min(), trace.chip.min(), 0.0)
        for spikes, colour, marker, up in (
            (trace.float_spikes, FLOAT, "^", 0.16),
            (trace.chip_spikes, CHIP, "v", 0.07),
        ):
            height = np.full(len(spikes), top + up * (top - low))
            axes.plot(spikes, height, marker, color=colour, ms=4, label="fires" if marker == "^" else None)
        for step, ours, chip in zip(steps.tolist(), trace.model.tolist(), trace.chip.tolist(), strict=True):
            tip = f"step {step}: {ours:.6f} float model, {chip:.6f} chip; fires: {trace.fires(step) or 'neither'}"
            drawing.tips.append((axes, step, ours, tip))
        axes.set_title(trace.title, loc="left", fontweight="bold")
        axes.grid(axis="y")
        axes.margins(x=0.01)
        axes.locator_params(axis="x", integer=True)
    axes.set_xlabel("step; membranes are in the float model's units, before the reset")
    handles, labels = axes.get_legend_handles_labels()
    drawing.figure.legend(handles, labels, loc="outside upper left", ncols=3)
    return drawing
