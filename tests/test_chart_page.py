"""What shows a chart: terminal, pictures and page."""

import json
import re

import pytest
from browser import browsed
from made_chart import made_chart

from spikeloom.runtime.report.encode import decode, encode
from spikeloom.runtime.report.sections import terminal
from spikeloom.runtime.studies.chart.results import Chart
from spikeloom.runtime.studies.chart.sections import page, panels, printed, series_of

PARTS = ["Networks", "Which one to deploy", "Accuracy against cost", "Every point", "Provenance"]


@pytest.fixture
def chart():
    return made_chart("energy=100uJ", "accuracy=80")


def told(chart):
    return terminal(printed(chart, "out")) + "\n"


# -- terminal and files ------------------------------------------------------------------------------------------------
def test_the_terminal_shows_choices_fronts_saving_and_budget(chart, golden):
    golden("chart.txt", told(chart))


def test_a_chart_is_read_back_as_it_was(chart):
    assert decode(Chart, json.loads(json.dumps(encode(chart)))) == chart


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
