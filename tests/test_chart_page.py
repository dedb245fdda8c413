"""What shows a chart: terminal, pictures, page, and the page of a report."""

import copy
import json
import re

import pytest
from browser import Page
from made_chart import made_chart
from made_files import own_file, recordings_folder

from spikeloom.runtime import cli
from spikeloom.runtime.studies.chart.figure import SERIES, SHAPES, scatter, series_of
from spikeloom.runtime.studies.chart.page import chart_page
from spikeloom.runtime.studies.chart.picture import COLOURS, MARKERS, pictures
from spikeloom.runtime.studies.chart.text import chart_text, csv_text


@pytest.fixture
def chart():
    return made_chart("energy=100uJ", "accuracy=80")


# -- terminal ----------------------------------------------------------------------------------------------------------


def test_the_terminal_shows_choices_fronts_saving_and_budget(chart, golden):
    golden("chart.txt", chart_text(chart, "out") + "\n")


def test_a_budget_that_nothing_fits_on_the_terminal(golden):
    golden("chart-nearest.txt", chart_text(made_chart("energy=1uJ", "accuracy=99"), "out") + "\n")


def test_without_the_usual_mapping_there_is_no_saving_to_tell(chart):
    chart["saving"] = None
    told = chart_text(chart, "out")
    assert "the usual mapping (8 bits, one plane, whole recordings) is not in the grid: no saving to tell" in told


def test_a_line_for_every_point(chart):
    lines = csv_text(chart).splitlines()
    assert len(lines) == 1 + len(chart["points"])
    assert lines[0].startswith("number,network,graph,bits,planes,groups,prune,fine_tuned,cores,window,n_cores,")
    assert lines[0].endswith(",front_energy,front_latency,compile,run,measured_recordings_per_s")
    assert lines[1].startswith("1,grasps,manual,2,1,1,False,False,cores,50,5,2580,385000,")


# -- pictures ----------------------------------------------------------------------------------------------------------


def test_pictures_are_the_same_for_the_same_chart(chart):
    first, second = pictures(chart), pictures(copy.deepcopy(chart))
    assert first.keys() == {"chart.svg", "chart.png"}
    assert first == second
    chart["points"][0]["test"]["energy_j"]["one"] *= 2
    assert pictures(chart) != first


def test_series_differ_in_shape_as_well_as_in_colour():
    assert len(set(COLOURS)) == len(set(MARKERS)) == len(set(SHAPES)) == SERIES


def test_colours_are_for_networks_where_there_are_several_else_for_storage(chart):
    assert series_of(chart["points"]) == ("network", ["grasps", "grasps-knn1"])
    assert series_of(chart["points"][:6]) == ("storage", ["2b", "4b", "8b"])
    assert series_of(chart["points"][4:6]) == ("window", ["50", "100"])


def test_every_point_is_a_mark_with_its_figures(chart):
    drawn = scatter(chart, "energy")
    marks = re.findall(r'<(?:circle|polygon) class="mark c\d v"[^>]*data-n="(\d+)"[^>]*><title>([^<]+)</title>', drawn)
    assert [int(number) for number, _ in marks] == [point["number"] for point in chart["points"]]
    assert marks[0][1].startswith("#1 grasps 2b, 50 %: test 68.00 % (58.3 … 76.3), float 70.00 %, expected ")
    assert drawn.count('class="taken"') == len(set(chart["recommended"].values()))


def test_a_single_point_and_many_series_can_be_drawn(chart):
    one = chart | {"points": chart["points"][:1], "recommended": {"cheapest": None, "fastest": None, "best": 1}}
    assert scatter(one, "latency").count("data-n") == 1
    many = copy.deepcopy(chart)
    for point in many["points"]:
        point["network"] = f"net{point['number']}"
    assert "hollow" in scatter(many, "energy")
    assert pictures(one).keys() == pictures(many).keys()


# -- page --------------------------------------------------------------------------------------------------------------


def test_the_page_needs_nothing_else_and_holds_every_command(chart):
    page = chart_page(chart)
    assert not re.findall(r'(?:src|href)="(?!#)', page)
    assert "url(" not in page
    assert "@import" not in page
    assert "a <b>" not in page
    for point in chart["points"]:
        for command in point["commands"]:
            assert command.replace("<", "&lt;").replace(">", "&gt;").replace("'", "&#x27;") in page
    held = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    assert held["1"]["commands"] == chart["points"][0]["commands"]
    assert chart_page(copy.deepcopy(chart)) == page


@pytest.fixture
def page_file(chart, tmp_path):
    file = tmp_path / "chart.html"
    file.write_text(chart_page(chart), "utf-8")
    return file


def test_in_a_browser_filters_keys_and_pointer_work(page_file, chart, tmp_path):
    with Page(tmp_path / "browser", page_file) as page:
        assert page.console == []
        assert page.requested[1:] == []
        shown = "document.querySelectorAll('#chart-energy .v:not(.gone)').length"
        rows = "document.querySelectorAll('#points tr[data-n]:not(.gone)').length"
        assert (page.run(shown), page.run(rows)) == (12, 12)
        page.run("document.querySelector('input[data-axis=storage][value=\"8b\"]').click()")
        page.run("document.querySelector('input[data-axis=graph][value=\"knn:1\"]').click()")
        assert (page.run(shown), page.run(rows)) == (4, 4)
        assert page.run("document.getElementById('shown').textContent") == "4 of 12 points"
        page.run("document.getElementById('chart-energy').focus()")
        readout = "document.querySelector('#chart figure .readout').textContent"
        page.press("ArrowRight")
        assert page.run(readout).startswith("#1 grasps 2b, 50 %")
        page.press("ArrowLeft")  # round to the dearest
        assert page.run(readout).startswith("#4 grasps 4b, 100 %")
        page.press("Enter")
        kept = "document.getElementById('chosen').textContent"
        assert all(command in page.run(kept) for command in chart["points"][3]["commands"])
        page.run("document.getElementById('chart-energy').scrollIntoView()")
        mark = "document.querySelector('#chart-energy [data-n=\"2\"]').getBoundingClientRect()"
        page.point(
            *(page.run(f"{mark}.{side} + {mark}.{length} / 2") for side, length in (("x", "width"), ("y", "height")))
        )
        page.run("new Promise(requestAnimationFrame)")
        assert page.run(readout).startswith("#2 grasps 2b, 100 %")
        page.run("document.querySelector('button[data-n=\"12\"]').click()")
        assert chart["points"][11]["commands"][0] in page.run(kept)
        assert page.run("document.querySelectorAll('.mark.kept').length") == 5
        visible = "[...document.querySelectorAll('#chart figure:not([hidden]) svg')].map((svg) => svg.id).join()"
        assert page.run(visible) == "chart-energy"
        page.run(
            "document.getElementById('axis').value = 'chart-cores';"
            "document.getElementById('axis').dispatchEvent(new Event('change'))"
        )
        assert page.run(visible) == "chart-cores"
        assert page.console == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1100, 420])
def test_the_page_fits_any_width_and_scheme(page_file, tmp_path, width, scheme):
    with Page(tmp_path / "browser", page_file, width=width) as page:
        page.media(scheme=scheme)
        assert page.run("document.documentElement.scrollWidth") <= width
        assert len(page.picture()) > 20_000
        colour = page.run("getComputedStyle(document.body).backgroundColor")
        assert colour == ("rgb(255, 255, 255)" if scheme == "light" else "rgb(20, 23, 27)")


def test_without_scripts_the_page_is_complete(page_file, tmp_path):
    with Page(tmp_path / "browser", page_file, script=False) as page:
        assert page.console == []
    text = page_file.read_text("utf-8").partition("<script")[0]
    assert text.count("<tr data-n=") == 12
    assert text.count("data-n=") == 12 * 7  # a mark in each of five figures, a row, a button


# -- the page of a report ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    recordings_folder(folder / "data")
    own_file(folder / "net.pt")
    assert cli.main(["compile", str(folder / "net.pt"), "-o", str(folder / "net.loom"), "--json"]) == 0
    return folder


REPORT = ("report", "net.loom", "--checkpoint", "net.pt", "--data", "data", "--spec-samples", "1", "-o", "out.html")


@pytest.fixture
def reported(capsys, place, monkeypatch):
    monkeypatch.chdir(place)

    def command(*words):
        capsys.readouterr()
        code = cli.main([*REPORT, *words])
        return code, *capsys.readouterr()

    return command


def with_sha(chart, place):
    from spikeloom.compiler.formats.checkpoint import read_checkpoint

    chart["networks"][0]["sha256"] = read_checkpoint(place / "net.pt").sha256
    (place / "charted").mkdir(exist_ok=True)
    (place / "charted" / "chart.json").write_text(json.dumps(chart))


def test_a_report_shows_the_chart_of_its_network(reported, chart, place):
    with_sha(chart, place)
    code, out, err = reported("--chart", "charted")
    assert (code, err) == (0, "")
    page = (place / "out.html").read_text("utf-8")
    assert page.count("<h2 id=") == 8
    assert '<h2 id="configurations-h">Configurations</h2>' in page
    drawn = [name for name in re.findall(r'<svg id="([^"]+)"', page) if name.startswith("pareto")]
    assert drawn == ["pareto-energy", "pareto-latency", "pareto-operations", "pareto-cores"]
    assert "Configurations\n--------------\nrecommended:" in out
    reported()
    assert 'id="configurations' not in (place / "out.html").read_text("utf-8")


def test_a_report_refuses_a_chart_of_other_networks(reported, chart, place):
    (place / "other.json").write_text(json.dumps(chart))
    code, out, err = reported("--chart", "other.json")
    assert (code, out) == (2, "")
    assert err == (
        "spikeloom: --chart other.json: is of grasps, grasps-knn1, not of net.pt; give a chart that this network is "
        "in\n"
    )


@pytest.mark.parametrize("content", ["", "[]", '{"format": 99}', '{"format": 1, "points": []}', "\x00"])
def test_a_report_refuses_what_is_no_chart(reported, place, content):
    (place / "bad.json").write_text(content)
    told = "spikeloom: --chart bad.json: is no chart, or one of another version; make it anew with spikeloom chart\n"
    assert reported("--chart", "bad.json")[::2] == (2, told)


def test_a_report_asks_for_a_chart_that_is_there(reported):
    told = "spikeloom: --chart no.json: no such file; give the chart.json that spikeloom chart wrote\n"
    assert reported("--chart", "no.json")[::2] == (2, told)
