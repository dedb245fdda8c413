"""Figures of one recording: spikes of both sides in one raster, membranes around a divergence."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

from spikeloom.runtime.page.text import trace_spikes, trace_title
from spikeloom.runtime.report.svg import WIDTH, Frame, drawing, legend, number, shape, words

Json = dict[str, Any]

LEFT, TOP, BOTTOM = 70.0, 30.0, 40.0

ROWS = 3000
"""Rows of a raster, at most; a screen shows fewer."""

MARK = 3.0
"""Half a mark of a difference, in units of the figure."""


def drawn(layer: Json) -> list[int]:
    """Neurons that have a row: all that fire, or `ROWS` of them at equal distances."""
    active: list[int] = layer["active"]
    return [active[i * len(active) // ROWS] for i in range(ROWS)] if len(active) > ROWS else active


def raster(name: str, layer: Json, steps: int) -> str:
    """Spikes of a layer: rows are the neurons that fire on either side, columns steps; differences are marked.

    The page's script reads the spikes back from the paths: ``M step row h steps`` where both fire, in cells, and marks
    around the centre of a cell where one side does.

    Parameters
    ----------
    name : str
        Id of the figure.
    layer : dict
        ``name``, ``active`` (neurons), and pairs of step and neuron: ``both``, ``float_only``, ``chip_only``.
    steps : int
        Of the recording.
    """
    active = drawn(layer)
    rows = {neuron: row for row, neuron in enumerate(active)}
    high = min(max(3.0 * len(rows), 90.0), 430.0)
    across, down = (WIDTH - LEFT - 12) / max(steps, 1), high / max(len(rows), 1)
    frame = Frame(
        left=LEFT, top=TOP, right=WIDTH - 12, bottom=TOP + high, x_from=0, x_to=steps, y_from=len(rows), y_to=0
    )
    content = [
        legend({"k-both": "both fire", "k-float": "float model only (–)", "k-chip": "chip only (|)"}, LEFT, 16),
        *_axes(frame, active, steps),
        f'<g class="both" transform="translate({number(LEFT)} {number(TOP)}) scale({across:.4f} {down:.4f})">',
        f'<path d="{_runs(layer["both"], rows)}" stroke-width="{max(0.9, 1.1 / down):.2f}"/></g>',
    ]
    for side, start, mark in (("float", (-MARK, 0.0), f"h{2 * MARK:g}"), ("chip", (0.0, -MARK), f"v{2 * MARK:g}")):
        marks = []
        for step, neuron in (pair for pair in layer[f"{side}_only"] if pair[1] in rows):
            x, y = LEFT + (step + 0.5) * across + start[0], TOP + (rows[neuron] + 0.5) * down + start[1]
            marks.append(f"M{number(x)} {number(y)}{mark}")
        content.append(f'<path class="only-{side}" d="{"".join(marks)}"/>' if marks else "")
    if not rows:
        what = "no channel has an event" if layer["name"] == "input" else f"no neuron of {layer['name']} fires"
        content.append(words(LEFT + 10, TOP + high / 2, what))
    figure = drawing(name, f"Spikes of {layer['name']}, float model and chip", TOP + high + BOTTOM, content)
    neurons = " ".join(map(str, active))
    facts = f'data-layer="{layer["name"]}" data-steps="{steps}" data-neurons="{neurons}"'
    box = f'data-left="{LEFT:g}" data-top="{TOP:g}" data-across="{across:.4f}" data-down="{down:.4f}"'
    return figure.replace("<svg ", f'<svg class="raster" {facts} {box} ', 1)


def _axes(frame: Frame, active: Sequence[int], steps: int) -> list[str]:
    """Steps below, some neurons' numbers at the left."""
    content = [
        shape(
            "rect", "frame", x=frame.left, y=frame.top, width=frame.right - frame.left, height=frame.bottom - frame.top
        )
    ]
    every = max(1, round(steps / 10 / 25) * 25) if steps > 40 else 5
    for step in range(0, steps, every):
        content.append(words(frame.x(step + 0.5), frame.bottom + 15, str(step), "small", "middle"))
    content.append(words((frame.left + frame.right) / 2, frame.bottom + 32, "step", "small", "middle"))
    shown = range(0, len(active), max(1, -(-len(active) * 12 // int(frame.bottom - frame.top))))
    content += [words(frame.left - 6, frame.y(row + 0.5) + 4, str(active[row]), "small", "end") for row in shown]
    return content


def _runs(pairs: Sequence[Sequence[int]], rows: dict[int, int]) -> str:
    """A path of cells in which both fire: one stroke for steps in a row."""
    path = []
    for row, cells in groupby(
        sorted((rows[neuron], step) for step, neuron in pairs if neuron in rows), key=lambda cell: cell[0]
    ):
        first = last = -2
        for _, step in cells:
            if step != last + 1:
                path.append(f"M{first} {row}.5h{last - first + 1}" if last >= 0 else "")
                first = step
            last = step
        path.append(f"M{first} {row}.5h{last - first + 1}")
    return "".join(path)


def membranes(traces: Sequence[Json]) -> str:
    """Membranes of both sides and their thresholds, a panel for each trace."""
    panel = 250.0
    names = {"l-float": "float model", "l-chip": "chip", "theta": "threshold"}
    content = [
        legend(names, 78, 16, strokes=True),
        words(WIDTH - 15, 16, "▲ float model fires   ▼ chip fires", "small", "end"),
    ]
    for place, trace in enumerate(traces):
        content += _membrane(trace, 30 + place * panel, panel)
    return drawing("membranes", trace_title(traces[0]), 30 + panel * len(traces), content)


def _membrane(trace: Json, top: float, panel: float) -> list[str]:
    values = [*trace["float"], *trace["chip"], trace["theta"], trace["chip_theta"]]
    spread = (max(values) - min(values)) or 1.0
    first, last = trace["first_step"], trace["first_step"] + len(trace["float"]) - 1
    frame = Frame(
        left=70,
        top=top + 40,
        right=WIDTH - 15,
        bottom=top + panel - 45,
        x_from=first - 0.5,
        x_to=last + 0.5,
        y_from=min(values) - 0.05 * spread,
        y_to=max(values) + 0.05 * spread,
    )
    wide = frame.x(1) - frame.x(0)
    content = [
        words(70, top + 14, trace_title(trace), "strong"),
        shape(
            "rect",
            "here",
            x=frame.x(trace["step"]) - wide / 2,
            y=top + 20,
            width=wide,
            height=frame.bottom - top - 20,
        ),
        *frame.axes("step; membranes are in the float model's units, before the reset", ""),
    ]
    for theta in dict.fromkeys([trace["theta"], trace["chip_theta"]]):
        content.append(shape("line", "theta", x1=frame.left, y1=frame.y(theta), x2=frame.right, y2=frame.y(theta)))
    content += [frame.line(trace["float"], "l-float", first), frame.line(trace["chip"], "l-chip", first)]
    for side, y, sign in (("float", top + 28, "▲"), ("chip", top + 38, "▼")):
        content += [words(frame.x(step), y, sign, f"fires f-{side}", "middle") for step in trace[f"{side}_spikes"]]
    tips = []
    for step in range(first, last + 1):
        fires = trace_spikes(trace, step) or "neither"
        ours, chip = trace["float"][step - first], trace["chip"][step - first]
        tips.append(f"step {step}: {ours:.6f} float model, {chip:.6f} chip; fires: {fires}")
    return [*content, frame.columns(tips, first)]
