"""A picture of recordings: where the sensor speaks, when, and which taxels look broken."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.commands.exchange.described import Described
from spikeloom.runtime.report.drawing import COLOURS, DASHES, GREY, Drawing, sheet, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RISING, _FALLING, _BROKEN = COLOURS[0], COLOURS[1], COLOURS[4]
_POINTS = 300  # of a line; more of them are a smear
_NAMES = 4  # broken taxels that a line lists


@styled
def picture(description: Described, coordinates: FloatArray | None) -> Drawing:
    """A map of the taxels where their positions are known, in millimetres, rates over time, rates by taxel."""
    title = f"{description.source}, {description.split}"
    drawing = sheet(title, 5.4, width=11.0 if coordinates is not None else 7.0)
    plain = "".join(letter if " " <= letter <= "~" else "?" for letter in title)  # what the font surely has
    recordings, events = number(description.recordings, "recording"), number(description.events, "event")
    heading = f"{plain}: {recordings} of {description.duration_s.longest:.3g} s, {events}"
    drawing.figure.suptitle(heading, parse_math=False, fontsize=12)
    if coordinates is None:
        above, below = drawing.figure.subplots(2, 1)
    else:
        axes = drawing.figure.subplot_mosaic([["map", "course"], ["map", "bars"]], width_ratios=[1, 1.15])
        _draw_map(axes["map"], description, coordinates[:, :2])
        above, below = axes["course"], axes["bars"]
    _draw_course(above, description)
    _draw_bars(below, description)
    return drawing


def _draw_map(axes: Axes, description: Described, place: FloatArray) -> None:
    """Taxels as discs at their places, coloured by rate; white where there is none, ringed where it is too high."""
    import matplotlib
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle

    rate = np.array([taxel.falling + taxel.rising for taxel in description.rate.taxels])
    span = float(np.ptp(place, axis=0).max()) or 1.0
    apart = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1)) + np.diag(np.full(len(place), np.inf))
    radius = min(max(0.46 * float(min(apart.min(), span)), span / 100), span / 16)
    colours = matplotlib.colormaps["cividis"].with_extremes(bad="white")
    discs = PatchCollection([Circle((x, y), radius) for x, y in place.tolist()], cmap=colours, zorder=2)
    usual = np.delete(rate, description.hot)  # a hot taxel would leave no colours to the others
    discs.set_clim(0, float(usual.max()) or 1.0)
    broken = np.isin(np.arange(len(rate)), [*description.dead, *description.hot])
    discs.set_edgecolor([_BROKEN if odd else GREY for odd in broken])
    discs.set_linewidth([2.0 if odd else 0.4 for odd in broken])
    discs.set_array(np.ma.masked_array(rate, np.isin(np.arange(len(rate)), description.dead)))
    axes.add_collection(discs)
    points = 72 * 4.2 * 2 * radius / (span + 2 * radius)  # width of a disc on paper
    for taxel, (x, y) in enumerate(place.tolist() if points >= 9 else []):
        light = taxel in description.dead or np.dot(discs.to_rgba(rate[taxel])[:3], (0.299, 0.587, 0.114)) > 0.5
        colour = "black" if light else "white"
        axes.text(x, y, str(taxel), ha="center", va="center", fontsize=min(8.0, points / 2.4), color=colour, zorder=3)
    axes.set_aspect("equal")
    axes.margins(0.04)
    axes.autoscale_view()
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    notes = [note for note, taxels in (("dead: white", description.dead), ("hot: ringed", description.hot)) if taxels]
    axes.set_title("; ".join(["each taxel at its place", *notes]), loc="left")
    above = "max" if description.hot else "neither"
    axes.figure.colorbar(discs, ax=axes, label="events per second, both polarities", shrink=0.8, extend=above)


def _draw_course(axes: Axes, description: Described) -> None:
    """Rates of the whole sensor over time."""
    group = -(-len(description.course) // _POINTS)
    starts = np.arange(0, len(description.course), group)
    sizes = np.diff(starts, append=len(description.course))
    course = np.add.reduceat(description.course, starts, axis=0) / sizes[:, None]
    time = starts * description.bin_s
    for polarity, name, colour, dash in ((1, "rising", _RISING, DASHES[0]), (0, "falling", _FALLING, DASHES[1])):
        axes.plot(time, course[:, polarity], color=colour, linestyle=dash, linewidth=1.3, label=name)
    axes.set_xlim(0, max(float(time[-1]), description.bin_s))
    axes.set_ylim(bottom=0)
    width = f", mean of {group * description.bin_s:g} s" if group > 1 else ""
    axes.set(xlabel=f"time in the recording (s){width}", ylabel="events per second")
    axes.set_title("whole sensor, mean over recordings", loc="left")
    axes.grid(axis="y")
    axes.legend(ncols=2, loc="upper right", bbox_to_anchor=(1.0, 1.14), borderpad=0)


def _draw_bars(axes: Axes, description: Described) -> None:
    """Rate of each taxel, polarities on top of each other."""
    falling, rising = np.array([[taxel.falling, taxel.rising] for taxel in description.rate.taxels]).T
    taxels = np.arange(len(rising))
    axes.bar(taxels, rising, width=0.8, color=_RISING)
    axes.bar(taxels, falling, width=0.8, bottom=rising, color=_FALLING)
    high = float((rising + falling).max()) or 1.0
    for marker, broken in (("x", description.dead), ("v", description.hot)):
        top = (rising + falling)[list(broken)] + 0.04 * high
        axes.scatter(broken, top, marker=marker, s=28, color=_BROKEN, zorder=3)
    axes.set_xlim(-0.7, len(taxels) - 0.3)
    axes.set_ylim(0, 1.12 * high)
    axes.set(xlabel="taxel", ylabel="events per second")
    axes.locator_params(axis="x", integer=True)
    kinds = {"dead (×)": description.dead, "one-sided": description.one_sided, "hot (▼)": description.hot}
    parts = [
        f"{name}: {', '.join(map(str, odd[:_NAMES]))}" + (f" and {len(odd) - _NAMES} more" if odd[_NAMES:] else "")
        for name, odd in kinds.items()
        if odd
    ]
    axes.set_title(f"each taxel; {'; '.join(parts) or 'no taxel is dead, one-sided or hot'}", loc="left")
    axes.grid(axis="y")
