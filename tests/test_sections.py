"""Sections as text and as a page, results as JSON and back; and all that shows a chart."""

import json
import math
import re
from dataclasses import dataclass, field

import numpy as np
import pytest
from browser import browsed
from made_chart import made_chart

from spikeloom.runtime.report import drawing, html
from spikeloom.runtime.report.encode import OPTIONAL, decode, encode, key
from spikeloom.runtime.report.sections import Code, Details, Facts, Figure, Section, Table, Text, terminal
from spikeloom.runtime.studies.chart.sections import page, panels, printed, series_of

NUMBERS = Table(["layer", "spikes"], [["conv1", "12"], ["fc1", "3 < 4"]], "Spikes by layer")
CHAPTER = Section(
    "What was found",
    [
        Facts({"accuracy": ("90 %", "9 of 10")}),
        Text("first\nsecond"),
        Section(
            "Spikes", [Figure("spikes", lambda: drawing.bars("Spikes", {"conv1": [12]}, ["n"]), "By layer.", [NUMBERS])]
        ),
        Details("More", [Text("folded")], group="more"),
        Code(["spikeloom run 'a b'"]),
    ],
    chapter=True,
)


def test_text_shows_all_but_what_is_folded_or_for_the_eye():
    assert terminal([CHAPTER, Section("", [NUMBERS])]) == (
        "What was found\n--------------\nfirst\nsecond\n\n"
        "  layer  spikes\n  conv1      12\n  fc1     3 < 4\n\n"
        "$ spikeloom run 'a b'\n\n"
        "  layer  spikes\n  conv1      12\n  fc1     3 < 4"
    )


def test_a_page_is_whole_escaped_and_the_same_each_time():
    page = html.page("a <b>", "about", [CHAPTER])
    assert page == html.page("a <b>", "about", [CHAPTER])
    assert "<h1>a &lt;b&gt;</h1>" in page
    assert '<section id="what-was-found"><h2>What was found</h2>' in page
    assert "3 &lt; 4" in page
    assert '<details name="more">' in page
    values = json.loads(page.partition('<script type="application/json">')[2].partition("</script>")[0])
    ((_, _, tip),) = values["tips"]
    assert tip == "conv1, n: 12"


def test_values_of_a_drawing_lie_on_its_marks():
    drawn = drawing.bars("bars", {"a": [1.0], "b": [2.0], "c": [3.0]}, ["n"])
    drawn.svg("x")
    (left, high), (middle, _), (right, low) = (tip[:2] for tip in drawn.values()["tips"])
    assert left < middle < right <= 72 * drawing.WIDTH
    assert 0 <= high < low
    assert middle == pytest.approx((left + right) / 2, abs=0.2)


@dataclass(frozen=True)
class Inner:
    share: float
    name: str | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class Outer:
    json_properties = ("twice",)
    inner: tuple[Inner, ...]
    by_window: dict[int, float] = field(metadata=key("windows"))
    pair: tuple[str, int] = ("a", 1)

    @property
    def twice(self) -> int:
        return 2 * self.pair[1]


def test_a_result_is_written_as_json_and_read_back():
    result = Outer(inner=(Inner(0.5), Inner(1.0, "x")), by_window={50: 1.0})
    value = json.loads(json.dumps(encode(result)))
    wanted = {"inner": [{"share": 0.5}, {"share": 1.0, "name": "x"}], "windows": {"50": 1.0}, "pair": ["a", 1]}
    assert value == wanted | {"twice": 2}
    assert decode(Outer, value) == result
    for wrong in ({}, [], value | {"inner": [{"share": "much"}]}, value | {"pair": ["a"]}):
        with pytest.raises((TypeError, ValueError, KeyError)):
            decode(Outer, wrong)


def test_numbers_of_numpy_are_plain_and_what_has_no_form_is_refused():
    assert encode({"a": np.float32(0.5), "b": np.arange(2), "c": math.nan}) == {"a": 0.5, "b": [0, 1], "c": None}
    with pytest.raises(TypeError):
        encode(object())


PARTS = ["Networks", "Which one to deploy", "Accuracy against cost", "Every point", "Provenance"]


@pytest.fixture
def chart():
    return made_chart("energy=100uJ", "accuracy=80")


def told(chart):
    return terminal(printed(chart, "out")) + "\n"


# -- terminal and files ------------------------------------------------------------------------------------------------
def test_the_terminal_shows_choices_fronts_saving_and_budget(chart, golden):
    golden("chart.txt", told(chart))


# -- pictures ----------------------------------------------------------------------------------------------------------
def test_colours_are_for_networks_where_there_are_several_else_for_storage(chart):
    assert series_of(chart.points) == "network"
    assert series_of(chart.points[:6]) == "storage"
    assert series_of(chart.points[4:6]) == "window"


def test_every_point_is_a_mark_that_tells_its_figures_and_commands(chart):
    drawn = panels(chart, ["energy"], "a chart")
    tips = [tip for _, _, tip in drawn.values()["tips"]]
    assert sorted(int(tip[1:].split()[0]) for tip in tips) == [point.number for point in chart.points]
    (first,) = (tip for tip in tips if tip.startswith("#1 "))
    assert first.startswith("#1 grasps 2b, 50 %: test 68.00 % (58.3 … 76.3), float 70.00 %, expected ")
    assert first.splitlines()[1:] == list(chart.points[0].commands)


# -- page --------------------------------------------------------------------------------------------------------------
def test_the_page_needs_nothing_else_and_holds_every_command(chart):
    text = page(chart)
    assert not re.findall(r'(?:src|href)="(?!#)', text)
    assert not re.search(r"url\((?!#)|@import", text)
    assert "a <b>" not in text
    assert re.findall("<h2>(.*?)</h2>", text) == PARTS
    for point in chart.points:
        for command in point.commands:
            assert command.replace("<", "&lt;").replace(">", "&gt;").replace("'", "&#39;") in text
    assert page(made_chart("energy=100uJ", "accuracy=80")) == text


@pytest.fixture
def page_file(chart, tmp_path):
    file = tmp_path / "chart.html"
    file.write_text(page(chart), "utf-8")
    return file


def test_in_a_browser_keys_and_pointer_read_the_points(page_file):
    script = """
    const tips = JSON.parse(drawing("chart-energy").nextElementSibling.textContent).tips;
    const [x, y] = tips.find((tip) => tip[2].startsWith("#2 "));
    return [press("chart-energy", "ArrowRight"), press("chart-energy", "ArrowLeft"), point("chart-energy", x, y)];"""
    cheapest, dearest, second = browsed(page_file, script)
    assert cheapest.startswith("#7 grasps-knn1 2b, 50 %")
    assert dearest.startswith("#6 grasps 8b, 100 %")
    assert second.startswith("#2 grasps 2b, 100 %")


def test_the_page_fits_a_narrow_window_and_a_dark_scheme(page_file):
    script = "return [document.documentElement.scrollWidth, background];"
    wide, colour = browsed(page_file, script, width=500, scheme="dark")
    assert wide <= 500
    assert colour == "rgb(20, 23, 27)"
