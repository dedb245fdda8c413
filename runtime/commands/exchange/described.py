"""What ``data describe`` says of recordings and draws: rates by taxel and polarity and over time, broken taxels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.counts import EventCounts, number
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings
from spikeloom.runtime.report.drawing import COLOURS, DASHES, GREY, Drawing, sheet, styled
from spikeloom.runtime.report.encode import HIDDEN
from spikeloom.runtime.report.sections import Section, Table, Text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HOT = 5.0
"""A taxel is hot if its rate is above this many times the median over taxels that are not dead."""

RULES = {
    "dead": "no event in any of these recordings",
    "one-sided": "events of one polarity only",
    "hot": f"more than {HOT:g} times the median rate of the taxels that are not dead",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Duration:
    """Of recordings, in seconds."""

    shortest: float
    median: float
    longest: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """Events per second by polarity."""

    falling: float
    rising: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorRate(Rate):
    """Events per second by polarity, of the sensor and of each taxel, over the time that was recorded."""

    taxels: tuple[Rate, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Described:
    """Statistics of one split under the keys that scripts rely on; polarity 0 is falling, 1 is rising."""

    source: str
    split: str
    recordings: int
    taxels: int
    bin_s: float
    steps: int
    duration_s: Duration
    events: int  # Those that share taxel, polarity and bin count once
    found: EventCounts | None
    labels: Mapping[int, int]
    unlabelled: int
    rate: SensorRate
    dead: tuple[int, ...]
    one_sided: tuple[int, ...]
    hot: tuple[int, ...]
    rules: Mapping[str, str]
    picture: str | None
    # (steps, 2); events per second of the whole sensor, mean over the recordings that last so long
    course: FloatArray = field(metadata=HIDDEN)


def describe(recordings: Recordings, bin_s: float, picture: str | None = None) -> Described:
    """Count the events of one split, whose bins are so many seconds wide."""
    lengths = np.array([recordings.steps_of(index) for index in range(len(recordings))])
    per_taxel = recordings.events.sum(axis=(0, 3), dtype=np.int64)
    per_step = recordings.events.sum(axis=(0, 1), dtype=np.int64).T
    running = (lengths[:, None] > np.arange(recordings.steps)).sum(axis=0)
    total = per_taxel.sum(axis=1)
    alive = total > 0
    middle = float(np.median(total[alive])) if alive.any() else 0.0
    rate = per_taxel / (lengths.sum() * bin_s)
    falling, rising = (float(rate[:, polarity].sum()) for polarity in (0, 1))
    labels = dict(zip(*(found.tolist() for found in np.unique(recordings.labels, return_counts=True)), strict=True))
    shortest, median, longest = (float(of(lengths) * bin_s) for of in (np.min, np.median, np.max))
    return Described(
        source=recordings.source,
        split=recordings.split,
        recordings=len(recordings),
        taxels=recordings.taxels,
        bin_s=bin_s,
        steps=recordings.steps,
        duration_s=Duration(shortest=shortest, median=median, longest=longest),
        events=int(total.sum()),
        found=recordings.counts,
        unlabelled=labels.pop(UNLABELLED, 0),
        labels=labels,
        rate=SensorRate(
            falling=falling,
            rising=rising,
            taxels=tuple(Rate(falling=low, rising=high) for low, high in rate.tolist()),
        ),
        dead=tuple(np.flatnonzero(~alive).tolist()),
        one_sided=tuple(np.flatnonzero((per_taxel > 0).sum(axis=1) == 1).tolist()),
        hot=tuple(np.flatnonzero(total > HOT * middle).tolist()),
        rules=RULES,
        picture=picture,
        course=per_step / (running[:, None] * bin_s),
    )


def described_sections(result: Described) -> Iterable[Section]:
    """Statistics for people."""
    duration, rate, labels = result.duration_s, result.rate, result.labels
    short, middle, long = (f"{seconds:g}" for seconds in (duration.shortest, duration.median, duration.longest))
    lasts = f"{long} s" if short == long else f"{short} … {long} s (median {middle} s)"
    each = sorted(set(labels.values()))
    spread = number(each[0], "recording") if len(each) == 1 else f"{each[0]} … {each[-1]} recordings" if each else ""
    lines = [
        f"{result.source}, {result.split}: {number(result.recordings, 'recording')}, "
        f"{number(result.taxels, 'taxel')}, {lasts} in bins of {result.bin_s:g} s",
        f"  labels: {number(len(labels), 'class') + f', {spread} each' if labels else 'none'}"
        + (f"; {number(result.unlabelled, 'recording')} without" if labels and result.unlabelled else ""),
        f"  events: {result.events:,} after binning; {rate.falling:.1f} falling and {rate.rising:.1f} rising "
        "per second",
    ]
    lines += [] if result.found is None else [f"  found: {result.found}"]
    broken = {"dead": result.dead, "one-sided": result.one_sided, "hot": result.hot}
    for kind, taxels in broken.items():
        lines.append(f"  {kind} taxels: {', '.join(map(str, taxels)) or 'none'} ({result.rules[kind]})")
    lines += [] if result.picture is None else [f"  picture: {result.picture}"]
    yield Section("Recordings", [Text("\n".join(lines))])
    rows = []
    for taxel, one in enumerate(rate.taxels):
        looks = ", ".join(kind for kind, taxels in broken.items() if taxel in taxels)
        rows.append([str(taxel), f"{one.falling:.2f}", f"{one.rising:.2f}", looks])
    yield Section("Taxels", [Table(["taxel", "falling/s", "rising/s", "looks"], rows)])


# -- the picture -------------------------------------------------------------------------------------------------------

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
