"""A chart for people: which point to deploy, accuracy over costs, fronts, every point, and where all is from."""

import json
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from spikeloom.compiler.files import write_atomically
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report import html
from spikeloom.runtime.report.conditions import UNSEEN, worst_and_best
from spikeloom.runtime.report.drawing import Drawing, sheet, styled
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.numbers import si
from spikeloom.runtime.report.sections import Block, Code, Details, Figure, Section, Table, Text
from spikeloom.runtime.studies.chart.results import Chart, Point
from spikeloom.runtime.studies.chart.study import above_on_test
from spikeloom.runtime.studies.search.picture import Mark, draw_front
from spikeloom.runtime.studies.search.results import ChosenBy

LISTED = 20
"""Rows of a table that a terminal shows."""

MEANINGS = (
    "Expected: what the training reached on recordings that it left out, times the share of training accuracy that the "
    "point keeps; if a network does not know the former, training accuracy.\n"
    "Choice: by training energy the cheapest that fits the budgets and is expected to be at most a point less accurate "
    "than the best that fits; where an accuracy is wanted, the cheapest that fits.\n"
    "Front: no other point is right more often on the test split for the same cost. It describes, nothing is chosen by "
    "it.\n"
    "Certified: share of decisions, on up to 48 training recordings, that no single event alters.\n"
    "Storage: bits of a weight (b), times that a synapse is stored (p), scales in a layer (g).\n"
    "Large marks: the front, with 95 % intervals; ring: the choice."
)


def sections(chart: Chart) -> list[Section]:
    """All of a chart, in the order of its page."""
    figure = Figure(
        "chart", partial(picture, chart), "Test accuracy over energy and time of a mean inference."
    )
    points = chart.points
    return [
        Section("Which one to deploy", _choice(chart)),
        Section("Accuracy against cost", [figure, *_fronts(chart)]),
        Section(
            "Every point",
            [
                _table(points, chart.chosen_by, f"{len(points)} points", 0),
                Details("Commands of every point", _commands(points)),
                Text("\n".join(_refused(chart))),
            ],
        ),
        Section("Provenance", [Details("Words, files and tables", _provenance(chart), unfolded=True)]),
    ]


def printed(chart: Chart) -> list[Section]:
    """The same for a terminal, with the place of the files."""
    where = f"written: {chart.folder}/chart.html, .svg, .png, .json; netlists in {chart.folder}/netlists"
    return [*sections(chart), Section("", [Text(where)])]


def _choice(chart: Chart) -> list[Block]:
    """The point to deploy and its commands."""
    data = chart.data
    pick = chart.budget
    point = chart.chosen
    lines = [
        f"{number(len(chart.points), 'point')} of {number(len(chart.networks), 'network')} on {data.test} test and "
        f"{data.train} training recordings; chosen on the training split, test figures are reported beside"
    ]
    if pick.budgets:
        lines.append(
            f"{' and '.join(pick.budgets)}: {pick.fitting or 'none'} of {len(chart.points)} points fit"
        )
    lines.append(f"{'take' if pick.fits else 'the nearest is'} #{point.number} {point.label}")
    if better := ", ".join(f"#{each.number}" for each in above_on_test(chart)):
        lines += [
            f"on the test split its interval lies below those of {better}, which the training split did not show"
        ]
    accuracies = {name: each.accuracy for name, each in point.test.conditions.items()}
    if accuracies:
        lines.append(f"by condition of the test recordings: {worst_and_best(accuracies)}")
    else:
        lines.append(f"the recordings have no groups: {UNSEEN}")
    return [Text("\n".join(lines)), _table([point], chart.chosen_by, "The choice"), *_commands([point])]


def _fronts(chart: Chart) -> Iterator[Block]:
    for name in chart.chosen.front:
        on = sorted((p for p in chart.points if p.front[name]), key=lambda point: point.test.accuracy)
        words = Text(f"front of test accuracy and {name} (a description, no choice):")
        yield Section("", [words, _table(on, chart.chosen_by, f"Front of test accuracy and {name}", LISTED)])


def _refused(chart: Chart) -> Iterator[str]:
    for each in chart.refused[:LISTED]:
        yield f"does not fit: {each.network} {each.storage}, {each.cores}: {each.why[0]}"
    if len(chart.refused) > LISTED:
        yield f"does not fit: {len(chart.refused) - LISTED} more, see chart.json"


def _provenance(chart: Chart) -> list[Block]:
    files = [["recordings", chart.data.path, chart.data.sha256]]
    files += [[each.name, each.path, each.sha256] for each in chart.networks]
    titles = [
        [f"{kind}, {name}", title] for kind, tables in chart.tables.items() for name, title in tables.items()
    ]
    return [
        Text(MEANINGS),
        Table(["", "name", "sha256"], files, "Files", words=True),
        Table(["", "source"], titles, "Tables of prices and times", words=True),
        Text("Command that repeats this chart:"),
        Code([chart.command]),
    ]


def _head(by: ChosenBy, certified: bool) -> list[str]:
    timed = [] if by.time is None else [f"time ({by.time})"]
    stable = ["certified %"] if certified else []
    figures = [
        "expected %",
        "test %",
        "interval",
        "float %",
        "equal",
        f"dynamic energy ({by.energy})",
        *timed,
        *stable,
    ]
    return ["#", "configuration", *figures, "operations", "cores"]


def _row(by: ChosenBy, point: Point) -> list[str]:
    test = point.test
    return [
        str(point.number),
        point.label,
        f"{100 * point.expected:.2f}",
        f"{100 * test.accuracy:.2f}",
        f"{100 * test.low:.1f} … {100 * test.high:.1f}",
        f"{100 * test.model.accuracy:.2f}",
        f"{test.equal}",
        si(test.costs.energy_j[by.energy], "J"),
        *([] if by.time is None else [si(test.costs.time_s[by.time], "s")]),
        *([] if point.train.certified is None else [f"{100 * point.train.certified:.1f}"]),
        f"{test.costs.operations:,.0f}",
        str(point.n_cores),
    ]


def _table(points: Sequence[Point], by: ChosenBy, caption: str, most: int | None = None) -> Table:
    head = _head(by, any(point.train.certified is not None for point in points))
    return Table(head, [_row(by, point) for point in points], caption, most=most)


def _commands(points: Iterable[Point]) -> list[Block]:
    return [block for point in points for block in (Text(f"#{point.number}:"), Code(point.commands))]


def _tip(by: ChosenBy, point: Point) -> str:
    """What is said of a point; then the commands that make it."""
    named = list(zip(_head(by, point.train.certified is not None), _row(by, point), strict=True))[2:]
    figures = ", ".join(f"{name} {cell}" for name, cell in named)
    return "\n".join([f"#{point.number} {point.label}: {figures}", *point.commands])


@styled()
def picture(chart: Chart) -> Drawing:
    """Test accuracy over energy and, where the chip has a time table, over time."""
    by = chart.chosen_by
    name = chart.data.path.rstrip("/").rsplit("/", 1)[-1]
    title = f"{len(chart.points)} configurations, {chart.data.test} test recordings of {name}"
    axes = {
        "energy": ("J", f"dynamic energy of a mean inference ({by.energy})"),
        "time": ("s", f"time ({by.time})"),
    }
    costs = list(by.of(chart.chosen.test.costs))
    drawing = sheet(title, 3 * len(costs) + 1, width=6.4)
    panels = drawing.figure.subplots(len(costs), squeeze=False, sharey=True)[:, 0]
    for panel, cost in zip(panels, costs, strict=True):
        marks = _marks(chart, cost)
        draw_front(drawing, panel, marks, marks[chart.budget.point - 1], *axes[cost])
    drawing.figure.supylabel("test accuracy on the chip (%)", fontsize=9)
    handles, series = panels[0].get_legend_handles_labels()
    drawing.figure.legend(handles, series, loc="outside lower center", ncols=5, fontsize=8)
    drawing.figure.suptitle(drawing.title, fontsize=10)
    return drawing


def series_of(points: Sequence[Point]) -> str:
    """Which axis the colours and shapes are for: networks where there are several."""
    names = ("network", "storage", "cores", "window")
    return next((name for name in names if len({getattr(point, name) for point in points}) > 1), "network")


def _marks(chart: Chart, cost: str) -> list[Mark]:
    """Points over a cost, those on the front large."""
    by = chart.chosen_by
    series = series_of(chart.points)
    return [
        Mark(
            cost=by.of(point.test.costs)[cost],
            accuracy=point.test.accuracy,
            low=point.test.low,
            high=point.test.high,
            series=str(getattr(point, series)),
            large=point.front[cost],
            front=point.front[cost],
            tip=_tip(by, point),
        )
        for point in chart.points
    ]


def write_chart(folder: Path, chart: Chart) -> None:
    """Write ``chart.json``, ``.html``, ``.svg`` and ``.png``; the same bytes for the same chart."""
    drawn = picture(chart)
    files = {
        "chart.json": (json.dumps(encode(chart), indent=1, allow_nan=False) + "\n").encode(),
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
