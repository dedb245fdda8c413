"""A picture of recordings: where the sensor speaks, when, and which taxels look broken."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.describe import Description

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

# Okabe and Ito's palette and cividis keep their contrast for all kinds of colour vision.
_RISING, _FALLING, _BROKEN = "#0072B2", "#E69F00", "#D55E00"
_COLOURS = "cividis"
_DPI = 150
_POINTS = 300  # of a line; more of them are a smear
_NAMES = 4  # broken taxels that a line lists


def draw(path: str | os.PathLike[str], description: Description, coordinates: FloatArray | None, *, title: str) -> None:
    """Write a PNG: a map of the taxels where their positions are known, rates over time, rates by taxel.

    Parameters
    ----------
    path : path
        Equal input and equal library versions give equal bytes.
    description : Description
        What to draw.
    coordinates : (taxels, 2 or 3) float64, optional
        Millimetres; the map shows x and y.
    title : str
        What the recordings are called.
    """
    from matplotlib.figure import Figure  # the object interface: no global state, no window

    figure = Figure(figsize=(11.0 if coordinates is not None else 7.0, 5.4), dpi=_DPI, layout="constrained")
    figure.suptitle(_heading(description, title), parse_math=False, fontsize=12)
    if coordinates is None:
        above, below = figure.subplots(2, 1)
    else:
        axes: dict[str, Axes] = figure.subplot_mosaic([["map", "course"], ["map", "bars"]], width_ratios=[1, 1.15])
        _draw_map(figure, axes["map"], description, coordinates)
        above, below = axes["course"], axes["bars"]
    _draw_course(above, description)
    _draw_bars(below, description)
    with write_atomically(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})


def _heading(description: Description, title: str) -> str:
    """What the picture shows, in one line."""
    longest = description.duration_s[2]
    recordings = f"{description.recordings:,} recording{'' if description.recordings == 1 else 's'}"
    events = f"{description.events:,} event{'' if description.events == 1 else 's'}"
    plain = "".join(letter if " " <= letter <= "~" else "?" for letter in title)  # what the font surely has
    return f"{plain}: {recordings} of {longest:.3g} s, {events}"


def _draw_map(figure: Figure, axes: Axes, description: Description, coordinates: FloatArray) -> None:
    """Taxels as discs at their places, coloured by rate."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle
    from matplotlib.ticker import MaxNLocator

    place, rate = coordinates[:, :2], description.rate.sum(axis=1)
    span = float(np.ptp(place, axis=0).max()) or 1.0
    radius = min(max(0.46 * _nearest(place), span / 100), span / 16)
    discs = PatchCollection([Circle((x, y), radius) for x, y in place.tolist()], cmap=_colours(), zorder=2)
    usual = np.delete(rate, description.hot)  # a hot taxel would leave no colours to the others
    discs.set_clim(0, float(usual.max()) or 1.0)
    discs.set_edgecolor([_edge(description, taxel) for taxel in range(len(rate))])
    discs.set_linewidth([2.0 if _is_broken(description, taxel) else 0.4 for taxel in range(len(rate))])
    discs.set_array(np.ma.masked_array(rate, np.isin(np.arange(len(rate)), description.dead)))
    axes.add_collection(discs)
    points = 72 * 4.2 * 2 * radius / (span + 2 * radius)  # width of a disc on paper
    if points >= 9:
        for taxel, (x, y) in enumerate(place.tolist()):
            light = taxel in description.dead or np.dot(discs.to_rgba(rate[taxel])[:3], (0.299, 0.587, 0.114)) > 0.5
            size = min(8.0, points / 2.4)
            axes.text(
                x, y, str(taxel), ha="center", va="center", fontsize=size, color="black" if light else "white", zorder=3
            )
    axes.set_aspect("equal")
    axes.margins(0.04)
    axes.autoscale_view()
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(7))
    notes = [note for note, taxels in (("dead: white", description.dead), ("hot: ringed", description.hot)) if taxels]
    axes.set_title("; ".join(["each taxel at its place", *notes]), fontsize=9, loc="left")
    above = "max" if description.hot else "neither"
    figure.colorbar(discs, ax=axes, label="events per second, both polarities", shrink=0.8, extend=above)


def _draw_course(axes: Axes, description: Description) -> None:
    """Rates of the whole sensor over time."""
    group = -(-len(description.course) // _POINTS)
    starts = np.arange(0, len(description.course), group)
    sizes = np.diff(starts, append=len(description.course))
    course = np.add.reduceat(description.course, starts, axis=0) / sizes[:, None]
    time = starts * description.bin_s
    lines: tuple[tuple[int, str, str, Any], ...] = ((1, "rising", _RISING, "-"), (0, "falling", _FALLING, (0, (4, 1))))
    for polarity, name, colour, style in lines:
        axes.plot(time, course[:, polarity], color=colour, linestyle=style, linewidth=1.3, label=name)
    axes.set_xlim(0, max(float(time[-1]), description.bin_s))
    axes.set_ylim(bottom=0)
    width = f", mean of {group * description.bin_s:g} s" if group > 1 else ""
    axes.set(xlabel=f"time in the recording (s){width}", ylabel="events per second")
    axes.set_title("whole sensor, mean over recordings", fontsize=9, loc="left")
    _tidy(axes)
    axes.legend(frameon=False, fontsize=9, ncols=2, loc="upper right", bbox_to_anchor=(1.0, 1.14), borderpad=0)


def _draw_bars(axes: Axes, description: Description) -> None:
    """Rate of each taxel, polarities on top of each other."""
    from matplotlib.ticker import MaxNLocator

    taxels = np.arange(len(description.rate))
    rising, falling = description.rate[:, 1], description.rate[:, 0]
    axes.bar(taxels, rising, width=0.8, color=_RISING)
    axes.bar(taxels, falling, width=0.8, bottom=rising, color=_FALLING)
    high = float((rising + falling).max()) or 1.0
    for marker, broken in (("x", description.dead), ("v", description.hot)):
        top = (rising + falling)[list(broken)] + 0.04 * high
        axes.scatter(broken, top, marker=marker, s=28, color=_BROKEN, zorder=3)
    axes.set_xlim(-0.7, len(taxels) - 0.3)
    axes.set_ylim(0, 1.12 * high)
    axes.set(xlabel="taxel", ylabel="events per second")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title(f"each taxel; {_verdict(description)}", fontsize=9, loc="left")
    _tidy(axes)


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", linewidth=0.4, color="#cccccc")
    axes.set_axisbelow(True)


def _nearest(place: FloatArray) -> float:
    """Least distance between two taxels, millimetres."""
    if len(place) < 2:
        return 1.0
    least = np.inf
    for index in range(1, len(place)):
        least = min(least, float(np.min(np.hypot(*(place[:index] - place[index]).T))))
    return least


def _colours() -> Colormap:
    """Colours of rates; white where there is none."""
    import matplotlib

    return matplotlib.colormaps[_COLOURS].with_extremes(bad="white")


def _is_broken(description: Description, taxel: int) -> bool:
    return taxel in description.dead or taxel in description.hot


def _edge(description: Description, taxel: int) -> str:
    return _BROKEN if _is_broken(description, taxel) else "#404040"


def _verdict(description: Description) -> str:
    """Taxels that look broken, in a line."""
    parts = []
    kinds = ("dead (×)", description.dead), ("one-sided", description.one_sided), ("hot (▼)", description.hot)
    for name, taxels in kinds:
        more = f" and {len(taxels) - _NAMES} more" if len(taxels) > _NAMES else ""
        if taxels:
            parts.append(f"{name}: {', '.join(map(str, taxels[:_NAMES]))}{more}")
    return "; ".join(parts) or "no taxel is dead, one-sided or hot"
