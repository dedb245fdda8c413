"""The paper's tables as pictures: accuracies beside the published ones, costs of graphs, neurons that never fire."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from spikeloom.runtime.studies.paper.text import counted, name_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Json = dict[str, Any]

SERIES = {
    "best": ("best epoch on test (the paper's protocol)", "C0", "o"),
    "last": ("last epoch", "C1", "s"),
    "clean": ("clean epoch, chosen on validation", "C2", "^"),
    "chip": ("last epoch on the chip, 8 bits", "C3", "D"),
}
"""Label, colour and marker."""

PAPER = ("paper: mean ± 2 standard errors", "0.35")

ENERGY = "davies2018"
"""Table by which energies are drawn."""

DPI = 110

WIDTH = 6.4
"""Of a panel, in inches."""


def pictures(kind: str, rows: Sequence[Json]) -> dict[str, bytes]:
    """PNG files of a table by name.

    Parameters
    ----------
    kind : str
        ``methods`` or ``graphs``.
    rows : sequence of dict
        See :func:`table.rows`; rows without cells are drawn as missing.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    by_data = {
        data: [row for row in rows if row["data"] == data] for data in dict.fromkeys(row["data"] for row in rows)
    }
    if not by_data:
        return {}
    found = {f"{kind}.png": _png(_accuracies(by_data))}
    if kind == "graphs":
        found |= {"graphs-costs.png": _png(_costs(by_data)), "graphs-quiet.png": _png(_quiet(by_data))}
    return found


def _png(figure: Figure) -> bytes:
    from matplotlib import pyplot as plt

    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=DPI)
    plt.close(figure)
    return content.getvalue()


def _panels(by_data: dict[str, list[Json]], down: int, height: float) -> tuple[Figure, Any]:
    from matplotlib import pyplot as plt

    size = (WIDTH * len(by_data), height * down)
    return plt.subplots(down, len(by_data), figsize=size, layout="constrained", squeeze=False)


def _accuracies(by_data: dict[str, list[Json]]) -> Figure:
    """One line for each row: every seed, means with intervals, and the paper's figure."""
    longest = max(len(rows) for rows in by_data.values())
    figure, (panels,) = _panels(by_data, 1, 1.5 + 0.62 * longest)
    for axes, (data, rows) in zip(panels, by_data.items(), strict=True):
        for place, row in enumerate(rows):
            _accuracy_row(axes, place, row)
        axes.set_yticks(range(len(rows)), [_counted(row) for row in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set(
            xlabel="accuracy (%)\nbar: 95 % interval of the mean, cut at the frame; dots: seeds",
            title=_titled(data, rows),
        )
        _keep_readable(axes, rows)
        axes.grid(axis="x", alpha=0.3)
        for place in range(1, len(rows)):
            axes.axhline(place - 0.5, color="0.9", linewidth=0.8)
    _legend(figure, panels)
    return figure


def _accuracy_row(axes: Axes, place: int, row: Json) -> None:
    paper = row["paper"]
    if paper is not None:
        label, colour = PAPER
        reach = 0.0 if paper["std"] is None else 2 * paper["std"] / paper["runs"] ** 0.5
        axes.fill_betweenx(
            [place - 0.44, place + 0.44], paper["mean"] - reach, paper["mean"] + reach, color=colour, alpha=0.18, lw=0
        )
        axes.plot([paper["mean"]] * 2, [place - 0.44, place + 0.44], color=colour, linewidth=1.6, label=label)
    spreads = _spreads(row)
    if not spreads:
        axes.text(0.02, place, "missing", transform=axes.get_yaxis_transform(), va="center", color="0.5")
    for offset, (key, spread) in zip((-0.3, -0.1, 0.1, 0.3), spreads.items(), strict=False):
        label, colour, marker = SERIES[key]
        at = place + offset
        axes.plot(spread["values"], [at] * spread["n"], ".", color=colour, alpha=0.45, markersize=5)
        if spread["low"] is not None:
            axes.plot([spread["low"], spread["high"]], [at, at], color=colour, linewidth=1.4)
        axes.plot([spread["mean"]], [at], marker, color=colour, markersize=5.5, label=label)


def _spreads(row: Json) -> dict[str, Json]:
    """What is known of a row, by series."""
    found = {key: row[key] for key in ("best", "last", "clean") if row[key]}
    return found | ({"chip": row["chip"]["last"]} if row["chip"] else {})


def _keep_readable(axes: Axes, rows: Sequence[Json]) -> None:
    """Limits by seeds and means: intervals of two or three seeds may reach far beyond them."""
    values = [value for row in rows for spread in _spreads(row).values() for value in spread["values"]]
    values += [row["paper"]["mean"] for row in rows if row["paper"]]
    if values:
        room = max(2.0, 0.25 * (max(values) - min(values)))
        axes.set_xlim(max(0.0, min(values) - room), min(100.0, max(values) + room))


def _counted(row: Json) -> str:
    return f"{name_of(row)}\n({counted(row)} seeds)" if row["missing"] else name_of(row)


def _titled(data: str, rows: Sequence[Json]) -> str:
    return f"{data}, {rows[0]['epochs']} epochs"


def _legend(figure: Figure, panels: Sequence[Axes], *, above: bool = False) -> None:
    """One legend under all panels, or above them; each label once."""
    entries: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        columns = 3 if figure.get_figwidth() > WIDTH else 2
        loc: Literal["outside upper center", "outside lower center"]
        loc = "outside upper center" if above else "outside lower center"
        figure.legend(list(entries.values()), list(entries), loc=loc, ncols=columns, fontsize=8)


def _costs(by_data: dict[str, list[Json]]) -> Figure:
    """Accuracy at the last epoch, as float model and on the chip, against first-layer operations and energy."""
    figure, panels = _panels(by_data, 2, 4.6)
    for column, (data, rows) in enumerate(by_data.items()):
        there = [row for row in rows if row["chip"]]
        operations = [row["chip"]["first_layer_operations"] / 1e6 for row in there]
        energy = [1e6 * row["chip"]["energy_j"][ENERGY] for row in there]
        for axes, costs in ((panels[0, column], operations), (panels[1, column], energy)):
            _against(axes, there, costs)
            axes.set_ylabel("accuracy at the last epoch (%); dots: seeds")
        panels[0, column].set(
            xlabel="first-layer synaptic operations an inference (million)", title=_titled(data, rows)
        )
        panels[1, column].set(xlabel=f"energy of an inference (µJ, {ENERGY})")
    _legend(figure, list(panels.flat))
    return figure


def _against(axes: Axes, rows: Sequence[Json], costs: Sequence[float]) -> None:
    """Float model and chip of each row over a cost, dots for seeds."""
    tops = []
    for row, cost in zip(rows, costs, strict=True):
        spreads = _spreads(row)
        seen = []
        for key in ("last", "chip"):
            label, colour, marker = SERIES[key]
            mean, values = spreads[key]["mean"], spreads[key]["values"]
            axes.plot([cost] * len(values), values, ".", color=colour, alpha=0.45, markersize=4)
            axes.plot([cost], [mean], marker, color=colour, markersize=4.5 if key == "chip" else 7, label=label)
            seen += values
        axes.plot([cost, cost], [min(seen), max(seen)], color="0.8", linewidth=0.8, zorder=0)
        tops.append(max(seen))
    axes.margins(0.08, 0.08)
    axes.grid(alpha=0.3)
    if rows:
        _name(axes, [name_of(row) for row in rows], costs, tops)
    else:
        axes.text(0.5, 0.5, "missing", transform=axes.transAxes, ha="center", va="center", color="0.5")
        axes.set(xticks=[], yticks=[])


def _name(axes: Axes, names: Sequence[str], costs: Sequence[float], tops: Sequence[float]) -> None:
    """Names in one row above all points, upright and apart, each tied to its point; equal points share theirs."""
    points: dict[tuple[float, float], list[str]] = {}
    for name, cost, top in zip(names, costs, tops, strict=True):
        points.setdefault((cost, top), []).append(name)
    order = sorted(points)
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    row, gap = high, 0.03 * (right - left)
    places = [cost for cost, _ in order]
    for index in range(1, len(places)):
        places[index] = max(places[index], places[index - 1] + gap)
    places[-1] = min(places[-1], right - gap / 2)
    for index in range(len(places) - 2, -1, -1):
        places[index] = min(places[index], places[index + 1] - gap)
    for place, (cost, top) in zip(places, order, strict=True):
        axes.plot([cost, place], [top, row], color="0.85", linewidth=0.8, zorder=0)
        axes.text(place, row, " " + ", ".join(points[cost, top]), ha="center", va="bottom", fontsize=7, rotation=90)
    axes.set_xlim(left, right)
    axes.set_ylim(low, high + 0.3 * (high - low))


def _quiet(by_data: dict[str, list[Json]]) -> Figure:
    """First-layer neurons by whether they fire, and what leaving out those that do not saves."""
    longest = max(len(rows) for rows in by_data.values())
    figure, panels = _panels(by_data, 2, 1.2 + 0.3 * longest)
    for column, (data, rows) in enumerate(by_data.items()):
        _neurons(panels[0, column], rows)
        panels[0, column].set(xlabel="neurons of the first layer, mean over seeds", title=_titled(data, rows))
        _savings(panels[1, column], rows)
        panels[1, column].set(xlabel="saved without neurons that fired in no training recording (%)")
    _legend(figure, [*panels[0]], above=True)
    panels[1, 0].legend(loc="center right", fontsize=8)
    return figure


def _neurons(axes: Axes, rows: Sequence[Json]) -> None:
    names = [name_of(row) for row in rows]
    layers = [row["chip"]["first_layer"] if row["chip"] else None for row in rows]
    parts = {
        "fire": [f["neurons"] - f["cannot_fire"] - f["unheard"] - f["quiet_in_training"] if f else 0.0 for f in layers],
        "fire in test only": [f["quiet_in_training"] - f["quiet_in_both"] if f else 0.0 for f in layers],
        "never fire on either split": [f["quiet_in_both"] if f else 0.0 for f in layers],
        "cannot fire (proven), left out by compile": [f["cannot_fire"] if f else 0.0 for f in layers],
    }
    left = [0.0] * len(rows)
    for (label, widths), colour in zip(parts.items(), ("C0", "C4", "C1", "0.75"), strict=True):
        axes.barh(range(len(rows)), widths, left=left, color=colour, label=label)
        left = [start + width for start, width in zip(left, widths, strict=True)]
    for place, layer in enumerate(layers):
        if layer is None:
            axes.text(0.02, place, "missing", transform=axes.get_yaxis_transform(), va="center", color="0.5")
    axes.set_yticks(range(len(rows)), names)
    axes.invert_yaxis()


def _savings(axes: Axes, rows: Sequence[Json]) -> None:
    shares: dict[str, list[float]] = {"first-layer operations": [], "all operations": [], f"energy ({ENERGY})": []}
    for row in rows:
        chip = row["chip"]
        for label, key in zip(shares, ("first_layer_operations", "synaptic_operations", "energy_j"), strict=True):
            before, after = _pair(chip, key) if chip else (0.0, 0.0)
            shares[label].append(100 * (1 - after / before) if before else 0.0)
    for offset, (label, widths), colour in zip((-0.27, 0.0, 0.27), shares.items(), ("C9", "C5", "C2"), strict=True):
        axes.barh([place + offset for place in range(len(rows))], widths, height=0.25, label=label, color=colour)
    for place, row in enumerate(rows):
        if not row["chip"]:
            axes.text(0.02, place, "missing", transform=axes.get_yaxis_transform(), va="center", color="0.5")
    axes.set_yticks(range(len(rows)), [name_of(row) for row in rows])
    axes.set_xlim(0, 1.5 * max(1.0, *(width for widths in shares.values() for width in widths)))  # room for a legend
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)


def _pair(chip: Json, key: str) -> tuple[float, float]:
    before, after = chip[key], chip["without_quiet"][key]
    return (before[ENERGY], after[ENERGY]) if key == "energy_j" else (before, after)
