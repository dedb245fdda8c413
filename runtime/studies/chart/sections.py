"""A chart for people: which points to take, accuracy over every cost, fronts, every point, and where all is from."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spikeloom.compiler.files import write_atomically
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report import html
from spikeloom.runtime.report.drawing import COLOURS, GREY, WIDTH, Drawing, scale, sheet, styled
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Block, Code, Details, Facts, Figure, Section, Table, Text
from spikeloom.runtime.studies.chart.results import Axis, Chart, ChosenBy, Point, axes
from spikeloom.runtime.studies.fronts import UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = ("o", "s", "^", "D", "v", "P", "<", ">")

NAMES = {
    "cheapest": "cheapest within one sample of float",
    "fastest": "fastest within it, real time",
    "best": "best",
}
"""Recommended points in words."""

LISTED = 20
"""Rows of a table that a terminal shows."""

MEANINGS = (
    "Expected: what the training reached on recordings that it left out, times the share of training accuracy that the "
    "point keeps; choices are made by this alone.\n"
    "Front: no other point is right more often on the test split for the same cost. It describes, nothing is chosen by "
    "it.\n"
    "Storage: bits of a weight (b), times that a synapse is stored (p), scales in a layer (g).\n"
    "Larger marks have seen more of each recording; rings and lines: recommended points and their 95 % intervals."
)


def sections(chart: Chart) -> list[Section]:
    """All of a chart, in the order of its page."""
    refused = f", {number(len(chart.refused), 'more configuration')} refused" if chart.refused else ""
    data = chart.data
    summary = (
        f"{number(len(chart.points), 'point')} of {number(len(chart.networks), 'network')} on {data.test} test and "
        f"{data.train} training recordings{refused}\n"
        f"choices are made on the training split by what is expected: {chart.expected}; test figures are reported "
        "beside"
    )
    saving = Section("Less energy than the usual mapping", [saved(chart)])
    return [
        Section("Networks", [Text(summary), Section("", [_networks(chart)])]),
        Section("Which one to deploy", [Facts(_cards(chart)), Section("", taken(chart)), saving, *_budget(chart)]),
        Section(
            "Accuracy against cost",
            [*_figures(chart), *_fronts(chart), Details("What is drawn", [Text(MEANINGS)], unfolded=True)],
        ),
        Section(
            "Every point",
            [
                _table(chart.points, chart.chosen_by, f"{len(chart.points)} points", 0),
                Details("Commands of every point", _commands(chart.points)),
                *_refused(chart),
            ],
        ),
        Section("Provenance", [Details("Files, grid and tables", _provenance(chart), unfolded=True)]),
    ]


def printed(chart: Chart, folder: str) -> list[Section]:
    """The same for a terminal, with the place of the files."""
    where = f"written: {folder}/chart.html, .svg, .png, .csv, .json; netlists in {folder}/netlists"
    return [*sections(chart), Section("", [Text(where)])]


def taken(chart: Chart) -> list[Block]:
    """Recommended points, and the commands that make them."""
    named = [(name, number) for name, number in chart.recommended.items() if number is not None]
    rows = [[NAMES[name], *_cells(chart.chosen_by, chart.point(number))] for name, number in named]
    missing = [f"  {NAMES[name]}: no point" for name, number in chart.recommended.items() if number is None]
    return [
        Text("recommended:"),
        Table(["", *_head(chart.chosen_by)], rows, "Recommended points; test figures beside"),
        *(Text(line) for line in missing),
        *_commands(chart.point(number) for number in dict.fromkeys(number for _, number in named)),
    ]


@styled
def panels(chart: Chart, names: Sequence[str], title: str, *, across: int = 1) -> Drawing:
    """Accuracy over some costs, a panel for each; colours and shapes are for series."""
    costs, down = axes(chart), -(-len(names) // across)
    drawing = sheet(title, 4.5 * down, width=WIDTH if across == 1 else 7.2 * across)
    rows = drawing.figure.subplots(down, across, squeeze=False, sharey=True)
    for panel, name in zip(rows.flat, names, strict=False):
        _scatter(drawing, panel, chart, name, costs[name])
    for panel in rows.flat[len(names) :]:
        panel.set_visible(False)
    for row in rows:
        row[0].set_ylabel("test accuracy on the chip (%)")
    handles, series = rows.flat[0].get_legend_handles_labels()
    drawing.figure.legend(handles, series, loc="outside lower center", ncols=min(len(series), 6), fontsize=8)
    if across > 1:
        drawing.figure.suptitle(title, fontsize=10)
    return drawing


def picture(chart: Chart) -> Drawing:
    """All figures beside each other, to print."""
    name = chart.data.path.rstrip("/").rsplit("/", 1)[-1]
    title = (
        f"{len(chart.points)} configurations, {chart.data.test} test recordings of {name}; larger marks have seen more "
        "of each recording"
    )
    return panels(chart, list(axes(chart)), title, across=2)


# -- figures -----------------------------------------------------------------------------------------------------------


def series_of(points: Sequence[Point]) -> str:
    """Which axis the colours and shapes are for: networks where there are several."""
    names = ("network", "storage", "cores", "window")
    return next((name for name in names if len({getattr(point, name) for point in points}) > 1), "network")


def _scatter(drawing: Drawing, panel: Axes, chart: Chart, name: str, axis: Axis) -> None:
    """Points, the stairs of the front, the float model's level; rings and intervals around recommended points."""
    from matplotlib.ticker import LogLocator, NullFormatter

    points = [point for point in chart.points if axis.value(point) > 0]
    series = series_of(chart.points)

    def place(point: Point) -> tuple[float, float]:
        return axis.value(point), 100 * point.test.accuracy

    for index, value in enumerate(dict.fromkeys(str(getattr(point, series)) for point in points)):
        members = [point for point in points if str(getattr(point, series)) == value]
        colour, hollow = COLOURS[index % len(COLOURS)], index // len(COLOURS) % 2 == 1
        panel.scatter(
            [axis.value(point) for point in members],
            [100 * point.test.accuracy for point in members],
            s=[14 + 30 * point.window / 100 for point in members],
            marker=MARKERS[index % len(MARKERS)],
            facecolors="none" if hollow else colour,
            edgecolors=colour,
            linewidths=0.9,
            label=value,
            zorder=3,
        )
    front = sorted(place(point) for point in points if point.front.get(name))
    if len(front) > 1:
        panel.step(
            *zip(*front, strict=True),
            where="post",
            color=GREY,
            lw=1.0,
            ls=(0, (5, 2)),
            label="front on the test split",
            zorder=2,
        )
    network = max(chart.networks, key=lambda each: each.expected)
    level = f"float model of {network.file.name}"
    panel.axhline(100 * network.whole.accuracy, color=GREY, lw=0.9, ls=":", label=level, zorder=1)
    for index, point in enumerate(point for point in points if point.number in chart.taken):
        (x, y), low, high = place(point), 100 * point.test.low, 100 * point.test.high
        panel.plot([x, x], [low, high], color=GREY, lw=1.0, zorder=2)
        panel.plot(x, y, "o", ms=12, mfc="none", mec=GREY, mew=1.4, zorder=4)
        # in turn above and below the interval, where there are no marks
        at, shift = (low, -11) if index % 2 else (high, 4)
        words = f"#{point.number} {', '.join(chart.taken[point.number])}"
        offset: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "fontweight": "bold"}
        panel.annotate(words, (x, at), (0, shift), fontsize=8, zorder=5, **offset)
    drawing.tips += [(panel, *place(point), _tip(chart, point)) for point in sorted(points, key=axis.value)]
    panel.set_xscale("log")
    panel.set_xlabel(axis.words)
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.xaxis.set_minor_formatter(NullFormatter())
    scale(panel.xaxis, axis.unit)
    panel.grid(True)
    panel.margins(0.06, 0.08)


def _tip(chart: Chart, point: Point) -> str:
    """What is said of a point; then the commands that make it."""
    test = point.test
    costs = [f"{si(joules, 'J')} ({name})" for name, joules in test.energy_j.items()]
    costs += [f"{si(seconds, 's')} ({name})" for name, seconds in test.time_s.items()]
    right = f"test {100 * test.accuracy:.2f} % ({100 * test.low:.1f} … {100 * test.high:.1f})"
    right += f", float {100 * test.model.accuracy:.2f} %, expected {100 * point.expected:.2f} %"
    equal = f"{test.equal} of {chart.data.test} decisions equal"
    size = f"{test.synaptic_operations:,.0f} synaptic operations, {number(point.n_cores, 'core')}"
    return "\n".join([f"#{point.number} {point.label}: {right}, {equal}, {', '.join(costs)}, {size}", *point.commands])


def _figures(chart: Chart) -> list[Block]:
    """Test accuracy over each cost, one figure at a time, energy first."""
    figures = []
    for name, axis in axes(chart).items():
        title = f"Test accuracy over {axis.title}"
        figure = Figure(f"chart-{name}", partial(panels, chart, [name], title), f"{title}.")
        figures.append(Details(f"over {axis.title}", [figure], "cost", unfolded=name == "energy"))
    return [*figures]


# -- tables ------------------------------------------------------------------------------------------------------------


def _head(by: ChosenBy) -> list[str]:
    energy, time = by.energy, by.time
    timed = "time" if time is None else f"time ({time})"
    costs = [f"energy ({energy})", timed, "operations", "cores"]
    return ["#", "configuration", "expected %", "test %", "interval", "float %", "equal", *costs]


def _cells(by: ChosenBy, point: Point) -> list[str]:
    test = point.test
    return [
        str(point.number),
        point.label,
        f"{100 * point.expected:.2f}",
        f"{100 * test.accuracy:.2f}",
        f"{100 * test.low:.1f} … {100 * test.high:.1f}",
        f"{100 * test.model.accuracy:.2f}",
        f"{test.equal}",
        si(test.energy_j[by.energy], "J"),
        "–" if by.time is None else si(test.time_s[by.time], "s"),
        f"{test.synaptic_operations:,.0f}",
        str(point.n_cores),
    ]


def _networks(chart: Chart) -> Table:
    rows = [
        [
            network.file.name,
            network.file.graph,
            "–" if network.file.validation is None else f"{100 * network.file.validation:.2f}",
            f"{100 * network.float_training:.2f}",
            percent(network.whole.correct, chart.data.test),
        ]
        for network in chart.networks
    ]
    head = ["network", "graph", "validation %", "float, training %", "float, test"]
    return Table(head, rows, "Float models on whole recordings")


def _cards(chart: Chart) -> dict[str, tuple[str, str]]:
    cards = {}
    for name, index in chart.recommended.items():
        if index is None:
            cards[NAMES[name]] = "none", "no point is good enough"
            continue
        test, by = chart.point(index).test, chart.chosen_by
        costs = [si(test.energy_j[by.energy], "J"), *([] if by.time is None else [si(test.time_s[by.time], "s")])]
        cards[NAMES[name]] = f"#{index}: {', '.join(costs)}", f"test accuracy {100 * test.accuracy:.2f} %"
    return cards


def _commands(points: Iterable[Point]) -> list[Block]:
    return [block for point in points for block in (Text(f"#{point.number}:"), Code(point.commands))]


def _table(points: Sequence[Point], by: ChosenBy, caption: str, most: int | None = LISTED) -> Table:
    return Table(_head(by), [_cells(by, point) for point in points], caption, most=most)


def _fronts(chart: Chart) -> Iterator[Block]:
    for name in ("energy", "latency"):
        on = sorted((p for p in chart.points if p.front.get(name)), key=lambda point: point.test.accuracy)
        if on:
            words = Text(f"front of test accuracy and {name} (a description, no choice):")
            yield Section("", [words, _table(on, chart.chosen_by, f"Front of test accuracy and {name}")])


def _times(ratios: Mapping[str, float | None], what: str) -> str:
    return ", ".join(
        f"{'–' if ratio is None else f'{ratio:.2f}'} times less {what} ({name})" for name, ratio in ratios.items()
    )


def saved(chart: Chart) -> Text:
    """How much less energy than the usual mapping is needed, chosen cleanly and seen on the test split."""
    if chart.saving is None:
        return Text("the usual mapping (8 bits, one plane, whole recordings) is not in the grid: no saving to tell")
    usual = chart.point(chart.saving.usual)
    lines = [f"against {usual.label} (#{usual.number}), for at most a point of accuracy:"]
    for words, other in (
        ("chosen on the training split", chart.saving.chosen),
        ("least on the test split (seen, not chosen)", chart.saving.seen),
    ):
        lines.append(
            f"  {words}: #{other.point} {chart.point(other.point).label}: {_times(other.energy, 'energy')}, test "
            f"accuracy {100 * other.accuracy:+.2f} points"
        )
    return Text("\n".join(lines))


def _budget(chart: Chart) -> list[Block]:
    """The point that a budget picks, what it gives up, and its commands."""
    pick = chart.budget
    if pick is None:
        return []
    point, best, wanted = chart.point(pick.point), chart.point(pick.best), " and ".join(pick.budgets)
    if pick.fits:
        lines = [f"{wanted}: {pick.fitting} of {len(chart.points)} points fit; take #{point.number} {point.label}"]
    else:
        lines = [f"{wanted}: no point fits; the nearest is #{point.number} {point.label}"]
        lines += [f"  misses {_missed(what, **each)}" for what, each in pick.misses.items()]
    beside = "  it is the best of all points: nothing is given up"
    if point is not best:
        up = pick.given_up
        costs = [_times(up.energy, "energy"), *([_times(up.time, "time")] if up.time else [])]
        beside = (
            f"  beside the best, #{best.number} {best.label}: expected {100 * up.expected:+.2f} points, test "
            f"{100 * up.accuracy:+.2f} points, {', '.join(costs)}"
        )
    table = _table([point], chart.chosen_by, "The point that was picked", None)
    return [Section("Your budget", [Text("\n".join(lines)), table, Text(beside), *_commands([point])])]


def _missed(what: str, found: float, limit: float) -> str:
    if what == "accuracy":
        return f"{what}: expected are {100 * found:.2f} %, wanted {100 * limit:g} %"
    unit = next(iter(UNITS[what]))
    return f"{what}: it takes {si(found, unit)}, allowed {si(limit, unit)}"


def _refused(chart: Chart) -> list[Block]:
    lines = [f"does not fit: {each.network} {each.storage}, {each.cores}: {each.why[0]}" for each in chart.refused]
    left = len(lines) - LISTED
    more = [f"does not fit: {left} more, see chart.json"] if left > 0 else []
    return [Text("\n".join([*lines[:LISTED], *more]))] if lines else []


def _provenance(chart: Chart) -> list[Block]:
    networks = [network.file for network in chart.networks]
    files = [["recordings", chart.data.path, chart.data.sha256]]
    files += [[each.name, each.path, each.sha256] for each in networks]
    trained = [[each.name, each.system, each.trained_by or "not known"] for each in networks]
    grid = [[name, ", ".join(_value(value) for value in getattr(chart.grid, name))] for name in chart.grid.__slots__]
    titles = [[f"{kind}, {name}", title] for kind, tables in chart.tables.items() for name, title in tables.items()]
    return [
        Table(["", "name", "sha256"], files, "Files", words=True),
        Table(["network", "system", "trained by"], trained, "Trainings", words=True),
        Table(["axis", "values"], grid, "Grid", words=True),
        Table(["", "source"], titles, "Tables of prices and times", words=True),
        Text("Command that repeats this chart:"),
        Code([chart.command]),
    ]


def _value(value: object) -> str:
    return "+".join(map(str, value)) if isinstance(value, tuple) else str(value)


# -- files -------------------------------------------------------------------------------------------------------------


def write_chart(folder: Path, chart: Chart) -> None:
    """Write ``chart.json``, ``.csv``, ``.html``, ``.svg`` and ``.png``; the same bytes for the same chart."""
    drawn = picture(chart)
    files = {
        "chart.json": (json.dumps(encode(chart), indent=1, allow_nan=False) + "\n").encode(),
        "chart.csv": csv_text(chart).encode(),
        "chart.html": page(chart).encode(),
        "chart.svg": drawn.file("svg"),
        "chart.png": drawn.file("png"),
    }
    for name, content in files.items():
        with write_atomically(folder / name) as file:
            file.write(content)


def page(chart: Chart) -> str:
    """A chart as one HTML file."""
    name = chart.data.path.rstrip("/").rsplit("/", 1)[-1]
    about = "Point at a mark to read its figures and the commands that make it."
    return html.page(f"{len(chart.points)} configurations on {name}", about, sections(chart))


def csv_text(chart: Chart) -> str:
    """Every point as a line: what the JSON says of it, with names of nested values joined."""
    rows = [dict(_flat(encode(point))) for point in chart.points]
    columns = dict.fromkeys(name for row in rows for name in row)
    file = io.StringIO()
    out = csv.DictWriter(file, list(columns), lineterminator="\n")
    out.writeheader()
    out.writerows(rows)
    return file.getvalue()


def _flat(values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        match value:
            case dict():
                yield from ((f"{name}_{inner}", each) for inner, each in _flat(value))
            case list() if name == "commands":
                yield from zip(("compile", "run"), value, strict=True)
            case list():
                yield name, "+".join(map(str, value))
            case _:
                yield name, value
