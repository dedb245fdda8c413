"""Sections as text and as a page, results as JSON and back; the pages of ``report`` and of a chart."""

import csv
import dataclasses
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
from dataclasses import dataclass, field
from functools import partial
from html import unescape

import nir
import numpy as np
import pytest
from commands import as_json, run
from made_chart import made_chart
from made_files import CLASSES, FEATURES, STEPS, TAXELS, events, own_file, recordings_folder, weights
from made_nir import affine, chain, lif
from matplotlib import rc_context
from numpy.testing import assert_allclose, assert_array_equal
from oracles import refused
from zoo import specimen

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.models.networks.reference import float_membranes, float_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime import cli
from spikeloom.runtime.equivalence.verdict import LEVELS
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.report import drawing, html
from spikeloom.runtime.report.encode import OPTIONAL, decode, encode, key
from spikeloom.runtime.report.sections import Code, Details, Facts, Figure, Section, Table, Text, terminal
from spikeloom.runtime.studies.chart.sections import page, picture, printed

REPORT = ("report", "net.loom", "--checkpoint", "net.pt", "--data", "data", "-o", "out.html")
HEADINGS = [
    "Verdict",
    "Decisions",
    "Cores",
    "Taxels",
    "One recording",
    "Energy and time",
    "Provenance",
    "Words",
]
LAYERS = ("conv1", "fc1", "fc2", "fc3")
RASTERS = [f"raster-{place}" for place in range(1 + len(LAYERS))]  # of the input and of the layers
FIGURES = {*RASTERS}
FIGURES |= {
    "confusion",
    "cores-map",
    "taxels-map",
    "membranes",
    "energy-layers",
    "energy-parts",
    "time-cores",
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, checkpoints, a 4-bit netlist, its page and the page's data."""
    folder = tmp_path_factory.mktemp("report")
    recordings_folder(folder / "data")
    own_file(folder / "net.pt", training={"seed": 17})
    words = [
        "compile",
        folder / "net.pt",
        "--weight-bits",
        "4",
        "--keep-all",
        "-o",
        folder / "net.loom",
        "--json",
    ]
    assert cli.main([str(word) for word in words]) == 0
    return folder


@pytest.fixture
def made(spikeloom, place):
    """The page and its data, made once."""
    if not (place / "out.json").exists():
        code, out, err = spikeloom(*REPORT, "--json")
        assert (code, err) == (0, "")
        (place / "out.json").write_text(out)
    return (place / "out.html").read_text("utf-8"), json.loads((place / "out.json").read_text())


# -- the page ----------------------------------------------------------------------------------------------------------
def drawings(page):
    return set(re.findall('<div class="drawing" id="([^"]+)"', page))


def values(page, name):
    """What the script reads of a drawing."""
    content = page.partition(f'<div class="drawing" id="{name}"')[2].partition(
        '<script type="application/json">'
    )[2]
    return json.loads(content.partition("</script>")[0])


def test_every_chapter_and_figure_is_there_captioned_and_in_numbers(made):
    page = made[0]
    assert re.findall("<h2>(.*?)</h2>", page) == HEADINGS
    assert drawings(page) == FIGURES
    for figure in re.findall("<figure>.*?</figure>", page, re.DOTALL):
        assert re.search("<figcaption>.+</figcaption>", figure)
        assert re.search('role="img" aria-label=".+"', figure)
        assert len(re.findall("<(?:path|use|g)[ >]", figure)) >= 5
        assert "<table" in figure or 'id="raster-0"' in figure, "whose spikes cannot differ"


def test_it_begins_with_a_sentence_and_explains_each_level(made):
    assert re.search(
        r"<p>The netlist is its checkpoint, rounded; the chip decides as .* on \d of 6 recordings", made[0]
    )
    assert (
        "<p>A TactileSGNet, graph ring, on 1 core, compared with its float model on 6 recordings.</p>"
        in made[0]
    )
    words = made[0].partition("<h2>Words</h2>")[2]
    assert all(f'<th scope="row">{level}</th>' in words for level in LEVELS)


def test_a_recording_that_is_decided_differently_is_drawn(made):
    apart = [
        row[0] for row in re.findall(r"<caption><span>Decided differently.*?</table>", made[0], re.DOTALL)
    ]
    decided = made[1]["recording"]["decision"]
    assert (decided["float"] != decided["chip"]) == bool(apart)


def test_the_page_needs_nothing_else_and_is_the_same_each_time(spikeloom, made, place):
    assert not re.search(r"url\((?!#)|@import|fetch\(|XMLHttpRequest|import\(", made[0])
    assert not re.search(r"<(?:link|img|iframe|object|embed)\b", made[0])
    # the only addresses are the name spaces of shapes
    assert not re.search(r"https?://(?!www\.w3\.org/)", made[0])
    assert spikeloom(*REPORT[:-1], "again.html")[0] == 0
    assert (place / "again.html").read_bytes() == (place / "out.html").read_bytes()


def test_the_raster_marks_every_difference(made):
    for layer in made[1]["recording"]["layers"]:
        held = values(made[0], f"raster-{1 + LAYERS.index(layer['name'])}")
        assert held["cells"]["columns"] == STEPS
        assert held["cells"]["rows"] == [f"neuron {neuron}" for neuron in layer["active"]]
        wanted = [
            f"neuron {neuron}, step {step}: only the {name} fires"
            for side, name in (("float", "float model"), ("chip", "chip"))
            for step, neuron in layer[f"{side}_only"]
        ]
        assert sorted(tip for _, _, tip in held["tips"]) == sorted(wanted)


# -- its data ----------------------------------------------------------------------------------------------------------
def test_spikes_and_membranes_are_those_of_both_sides(made, place):
    recording = made[1]["recording"]
    netlist, checkpoint = read_netlist(place / "net.loom"), read_checkpoint(place / "net.pt")
    data = load_data(str(place / "data"), "test")
    one = data.events[recording["index"]][None]
    seen = normalised_adjacency(checkpoint.edges, TAXELS)
    ours = float_spikes(expand(checkpoint, seen), one)
    trace = engine.simulate(netlist, one.reshape(1, -1, STEPS), spikes=True, membranes=True)
    for i, layer in enumerate(recording["layers"]):
        chip = aligned(netlist, trace.spikes, i)[0]
        for side, wanted in (("float", ours[layer["name"]][0]), ("chip", chip)):
            pairs = np.array(layer["both"] + layer[f"{side}_only"])
            found = np.zeros_like(wanted)
            found[tuple(pairs.T)] = True
            assert_array_equal(found, wanted)
            assert layer[f"{side}_spikes"] == wanted.sum()
        assert layer["different"] == (ours[layer["name"]][0] != chip).sum() > 0
    membranes = float_membranes(expand(checkpoint, seen), one)
    for shown in recording["membranes"]:
        window = slice(shown["first_step"], shown["first_step"] + len(shown["float"]))
        assert_array_equal(shown["float"], membranes[shown["layer"]][0, window, shown["neuron"]])
        index = LAYERS.index(shown["layer"])
        register = aligned(netlist, trace.membranes, index)[0, window, shown["neuron"]]
        (own,) = np.flatnonzero((netlist.layer == index) & (netlist.neuron == shown["neuron"]))
        assert_allclose(shown["chip"], register / (64 * netlist.scale[own]))
        fires = shown["step"] in shown["float_spikes"], shown["step"] in shown["chip_spikes"]
        assert sum(fires) == 1
    assert [shown["step"] for shown in recording["membranes"]] == sorted(
        s["step"] for s in recording["membranes"]
    )
    first, shown = made[1]["verify"]["first_divergence"], recording["membranes"][0]
    assert (first["file"], first["layer"], first["neuron"]) == (
        recording["file"],
        shown["layer"],
        shown["neuron"],
    )


def test_decisions_cores_and_taxels_agree_with_the_rest(made, place):
    report = made[1]
    netlist, data = read_netlist(place / "net.loom"), load_data(str(place / "data"), "test")
    for side in ("float", "chip"):
        matrix = np.array(report["decisions"]["matrices"][side])
        assert_array_equal(matrix.sum(axis=1), np.bincount(data.labels, minlength=CLASSES))
        assert np.trace(matrix) / len(data) == report["verify"]["accuracy"][side]
    sent = [way["packets"] for way in report["cores"]["traffic"] if way["from"] is not None]
    assert_allclose(sum(sent), report["costs"]["per_inference"]["packets"])
    assert [core["core"] for core in report["cores"]["cores"]] == list(range(netlist.n_cores))
    for core in report["cores"]["cores"]:
        assert 0 < core["fill"][core["fullest"]]["share"] <= 1
    taxels = report["taxels"]
    assert_allclose(taxels["events"], data.events.mean(axis=0).sum(axis=(1, 2)))
    fired = engine.simulate(netlist, data.events.reshape(len(data), -1, STEPS)).counts.spikes[
        :, netlist.layer == 0
    ]
    assert_allclose(taxels["spikes"], fired.mean(axis=0).reshape(TAXELS, FEATURES).sum(axis=1))
    assert sorted(map(tuple, taxels["edges"])) == sorted(
        map(tuple, read_checkpoint(place / "net.pt").edges.tolist())
    )
    assert (taxels["graph"], taxels["positions_mm"]) == ("ring", None)


def test_where_it_is_from_and_how_to_repeat_it(made, place, spikeloom):
    origin = made[1]["provenance"]
    for name, file in (("netlist", "net.loom"), ("checkpoint", "net.pt")):
        assert origin[name]["sha256"] == hashlib.sha256((place / file).read_bytes()).hexdigest()
        assert origin[name]["sha256"] in made[0]
    assert origin["checkpoint"]["training"]["seed"] == 17
    commands = origin["commands"]
    before = (place / "net.loom").read_bytes()
    for command in commands.values():
        assert command in made[0]
        assert spikeloom(*command.split()[1:])[0] in (0, 1)
    assert (place / "net.loom").read_bytes() == before
    assert (place / "report.html").read_bytes() == (place / "out.html").read_bytes()


def test_where_no_spike_differs_the_widest_membranes_are_shown(spikeloom, place):
    """Weights too small for a spike, so that every raster is empty, too."""
    own_file(place / "quiet.pt", last=weights(gain=0.05))
    assert spikeloom("compile", "quiet.pt", "--keep-all", "-o", "quiet.loom")[0] == 0
    words = ("report", "quiet.loom", "--checkpoint", "quiet.pt", "--data", "data", "-o", "quiet.html")
    found = json.loads(spikeloom(*words, "--json")[1])
    assert found["verify"]["first_divergence"] is None
    (shown,) = found["recording"]["membranes"]
    assert not shown["diverges"]
    assert max(abs(np.array(shown["float"]) - shown["chip"])) > 0
    assert drawings((place / "quiet.html").read_text("utf-8")) == FIGURES


# -- other networks ----------------------------------------------------------------------------------------------------
def report_of(made, folder):
    """The page of a network of the zoo, and its data."""
    words = ("report", made.netlist, "--checkpoint", made.network, *made.reading, "--data", made.data)
    found = as_json(*words, "-o", folder / "x.html")
    return (folder / "x.html").read_text("utf-8"), found


def test_networks_without_a_graph_show_their_taxels(tmp_path):
    made = specimen("onnx")
    text, found = report_of(made, tmp_path)
    taxels, sensor = found["taxels"], made.machine.netlist.taxels
    assert (taxels["graph"], taxels["spikes"], taxels["edges"]) == (None, None, [])
    assert (taxels["sensor"], len(taxels["positions_mm"] or ())) == (
        ("NeuTouch", 39) if sensor == 39 else (None, 0)
    )
    assert len(values(text, "taxels-map")["tips"]) == sensor
    assert drawings(text) >= FIGURES - {*RASTERS[1:]} - {"time-cores"}


def test_clocks_and_lasting_currents_have_their_page(tmp_path):
    made = specimen("timed")
    text, found = report_of(made, tmp_path)
    assert found["provenance"]["checkpoint"]["dynamics"]["clocks"] == {"channels": 3, "steps": 4}
    assert "Decays by layer, and clocks" in text
    channels = {channel for _, channel in found["recording"]["input"]}
    assert channels >= {78, 79, 80}  # the clocks' come after those of 39 taxels
    netlist = made.machine.netlist
    counts = engine.simulate(netlist, with_clocks(made.events, netlist.clocks)).counts
    received = (netlist.layer == 0) & (netlist.neuron < 39 * read_checkpoint(made.network).hops.shape[1])
    assert len(found["taxels"]["spikes"]) == 39
    assert_allclose(sum(found["taxels"]["spikes"]), counts.spikes[:, received].sum(axis=1).mean())


def test_several_chips_are_drawn_one_below_the_other(spikeloom, place):
    """Links between chips are not timed, so the page has no times."""
    assert spikeloom("compile", "net.pt", "--cores-for", "conv1=3,fc1=2", "-o", "wide.loom")[0] == 0
    netlist = read_netlist(place / "wide.loom")
    tiles = np.arange(netlist.n_cores) * 20
    write_netlist(dataclasses.replace(netlist, core_tile=tiles), place / "wide.loom")
    words = [word.replace("net.loom", "wide.loom").replace("out.html", "wide.html") for word in REPORT]
    code, out, err = spikeloom(*words, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert [core["chip"] for core in found["cores"]["cores"]] == (tiles // 32).tolist()
    figures = drawings((place / "wide.html").read_text("utf-8"))
    assert figures == FIGURES - {"time-cores"}


# -- in headless Chromium: Debian's, or what the environment variable CHROMIUM names ---------------------------------
BEFORE = """<script>
const complaints = [];
addEventListener("error", (event) => complaints.push(event.message));
for (const kind of ["error", "warn"]) console[kind] = (...words) => complaints.push(words.join(" "));
</script>"""

HELPERS = """
const drawing = (id) => document.getElementById(id);
const readout = (id) => document.querySelector(`#${id} ~ .readout`).textContent;
const press = (id, key) => { drawing(id).dispatchEvent(new KeyboardEvent("keydown", { key })); return readout(id); };
const point = (id, x, y) => {  // in units of the drawing
  const svg = drawing(id).querySelector("svg"), place = new DOMPoint(x, y).matrixTransform(svg.getScreenCTM());
  svg.dispatchEvent(new PointerEvent("pointermove", { clientX: place.x, clientY: place.y, bubbles: true }));
  return readout(id);
};
const background = getComputedStyle(document.body).backgroundColor;
"""


def browsed(page, script, *, width=1100, scheme="light"):
    """What a script returns in a copy of a page, which loads nothing and complains about nothing."""
    command = os.environ.get("CHROMIUM") or shutil.which("chromium")
    if not command:
        pytest.skip("no browser on this machine (install Debian's package chromium, or set CHROMIUM)")
    loaded = "performance.getEntriesByType('resource').map((each) => each.name)"
    found = f"JSON.stringify([complaints, {loaded}, (() => {{ {HELPERS} {script} }})()])"
    copy = page.with_name(f"{page.stem}-browsed.html")
    text = page.read_text("utf-8").replace("<head>", f"<head>{BEFORE}")
    copy.write_text(text.replace("</body>", f"<script>document.title = {found};</script></body>"), "utf-8")
    words = [command, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    words += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={width},900"]
    words += ["--blink-settings=preferredColorScheme=0"] if scheme == "dark" else []
    done = subprocess.run(
        [*words, "--dump-dom", copy.as_uri()], capture_output=True, text=True, timeout=60, check=True
    )
    title = re.search("<title>(.*?)</title>", done.stdout, re.DOTALL)
    assert title is not None
    complaints, requests, value = json.loads(unescape(title[1]))
    assert (complaints, requests) == ([], [])
    return value


# -- in a browser ------------------------------------------------------------------------------------------------------
def test_a_browser_shows_every_figure_and_unfolds_one_raster_at_a_time(made, place):
    script = """
    const shown = () => [...document.querySelectorAll(".drawing")].filter((d) => d.checkVisibility()).map((d) => d.id);
    const before = shown();
    [...document.querySelectorAll("summary")].find((s) => s.textContent == "fc1").parentElement.open = true;
    return [before, shown()];"""
    before, after = browsed(place / "out.html", script)
    assert set(before) == FIGURES - {*RASTERS} | {"raster-1"}
    assert set(after) == set(before) - {"raster-1"} | {"raster-2"}


def test_arrow_keys_walk_through_the_differences_and_the_pointer_reads_cells(made, place):
    held, layer = values(made[0], "raster-1"), made[1]["recording"]["layers"][0]
    tips, cells = [tip for _, _, tip in held["tips"]], held["cells"]
    (left, top), (right, bottom) = cells["from"], cells["to"]
    y = top + 0.5 * (bottom - top) / len(cells["rows"])
    script = f"""
    const walked = ["Right", "Right", "Left", "Left"].map((way) => press("raster-1", `Arrow${{way}}`));
    const cell = (step) => point("raster-1", {left} + (step + 0.5) * {right - left} / {STEPS}, {y});
    return [walked, Array.from({{length: {STEPS}}}, (_, step) => cell(step)), press("energy-layers", "ArrowRight")];"""
    walked, pointed, energy = browsed(place / "out.html", script)
    assert walked == [tips[index] for index in (0, 1, 0, -1)]
    found = [
        said.startswith(f"neuron {layer['active'][0]}, step {step}") for step, said in enumerate(pointed)
    ]
    assert any(found)
    assert all(cell or said in tips for cell, said in zip(found, pointed, strict=True))
    assert energy.startswith("conv1, davies2018: ")


NUMBERS = Table(["layer", "spikes"], [["conv1", "12"], ["fc1", "3 < 4"]], "Spikes by layer")
CHAPTER = Section(
    "What was found",
    [
        Facts({"accuracy": ("90 %", "9 of 10")}),
        Text("first\nsecond"),
        Section(
            "Spikes",
            [
                Figure(
                    "spikes", lambda: drawing.bars("Spikes", {"conv1": [12]}, ["n"]), "By layer.", [NUMBERS]
                )
            ],
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


def test_names_from_a_file_run_no_script_and_tear_no_drawing(tmp_path, monkeypatch):
    """The network of a NIR file whose nodes have names that a page must not take for its own."""
    monkeypatch.chdir(tmp_path)
    names = ['x"onload="alert(1)', "<img src=x onerror=alert(1)>", r"$\frac{<script>alert(1)</script>"[:39]]
    rng, nodes, before = np.random.default_rng(0), [], TAXELS * 2
    for size in (9, 8, CLASSES):
        nodes += [affine(rng, size, before), lif(size)]
        before = size
    graph = chain(*nodes)
    called = {f"n{2 * place + 1}": name.replace("/", "") for place, name in enumerate(names)}
    graph.nodes = {called.get(name, name): node for name, node in graph.nodes.items()}
    graph.edges = [tuple(called.get(name, name) for name in edge) for edge in graph.edges]
    nir.write("net.nir", graph)
    recordings_folder(tmp_path / "data")
    assert run("compile", "net.nir", "--dt", "0.02", "-o", "net.loom")[0] == 0
    words = [
        "report",
        "net.loom",
        "--checkpoint",
        "net.nir",
        "--dt",
        "0.02",
        "--data",
        "data",
        "-o",
        "out.html",
    ]
    code, out, err = run(*words)
    assert (code, err) == (0, "")
    assert names[1] in out
    text = (tmp_path / "out.html").read_text("utf-8")
    assert drawings(text) >= {*RASTERS[: 1 + len(names)]}
    assert "<img" not in text
    assert "<script>alert" not in text
    script = "return [document.images.length, document.querySelectorAll('[onload], [onerror]').length]"
    assert browsed(tmp_path / "out.html", script) == [0, 0]


def test_names_of_recordings_and_classes_do_no_harm(tmp_path, monkeypatch):
    """Nor what a file's name does to the text around it: turning it round, or a line of its own."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "<img src=x onerror=alert(3)>"
    classes = ["<script>alert(1)", 'a" onload="alert(2)', "\u202esteel", "two\nspikeloom: lines"]
    rows = [("file", "label", "<i>speed")]
    for split, samples in (("train", 12), ("test", 8)):
        (folder / split).mkdir(parents=True)
        for index, recording in enumerate(events(samples, samples=samples)):
            name = f"{split}/touch {index} \u202e'\"<b>&amp;.npy"
            np.save(folder / name, recording)
            rows.append((name, classes[index % 4], ("<u>fast", "slow")[index % 2]))
    with (folder / "recordings.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    for line in (
        ["train", "--system", "counters", "-o", "net.pt"],
        ["compile", "net.pt", "-o", "net.loom"],
        ["run", "net.loom"],
        ["report", "net.loom", "--checkpoint", "net.pt", "-o", "out.html"],
    ):
        code, out, err = run(*line, *([] if line[0] == "compile" else ["--data", folder]))
        assert code == 0, err
        assert "\u202e" not in out + err
        assert not [said for said in out.splitlines() if said.startswith("spikeloom: lines")]
    text = (tmp_path / "out.html").read_text("utf-8")
    assert "two spikeloom: lines" in text
    assert not [bad for bad in ("<script>alert", "<img", "<u>", "<i>speed", "<b>", "\u202e") if bad in text]
    script = (
        "return [document.images.length, document.querySelectorAll('[onload], [onerror], u, b, i').length]"
    )
    assert browsed(tmp_path / "out.html", script) == [0, 0]


def test_pictures_are_the_same_whatever_the_users_style():
    figure = partial(drawing.bars, "bars", {"a": [1.0], "b": [2.0]}, ["n"])
    before = figure().file("svg")
    with rc_context({"figure.facecolor": "red", "font.size": 30, "axes.grid": True, "lines.linewidth": 9}):
        assert figure().file("svg") == before


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
    wanted = {
        "inner": [{"share": 0.5}, {"share": 1.0, "name": "x"}],
        "windows": {"50": 1.0},
        "pair": ["a", 1],
    }
    assert value == wanted | {"twice": 2}
    assert decode(Outer, value) == result
    for wrong in ({}, [], value | {"inner": [{"share": "much"}]}, value | {"pair": ["a"]}):
        refused((TypeError, ValueError, KeyError), "", decode, Outer, wrong)


def test_numbers_of_numpy_are_plain_and_what_has_no_form_is_refused():
    assert encode({"a": np.float32(0.5), "b": np.arange(2), "c": math.nan}) == {
        "a": 0.5,
        "b": [0, 1],
        "c": None,
    }
    refused(TypeError, "", encode, object())


@pytest.fixture
def chart():
    return made_chart("energy=100uJ", "accuracy=80")


def told(chart):
    return terminal(printed(chart)) + "\n"


# -- terminal and files ------------------------------------------------------------------------------------------------
def test_the_terminal_shows_the_choice_and_fronts(chart, golden):
    golden("chart.txt", told(chart))


def test_a_choice_that_others_surpass_on_test_says_so(chart):
    below = "on the test split its interval lies below those of "
    assert below not in told(chart)  # those above it exceed the budget
    assert f"{below}#6, #12, which" in told(made_chart("accuracy=80"))


# -- pictures ----------------------------------------------------------------------------------------------------------


def test_every_point_is_a_mark_that_tells_its_figures_and_commands(chart):
    tips = [tip for _, _, tip in picture(chart).values()["tips"]]
    for panel in (tips[:12], tips[12:]):  # over energy and over time
        assert sorted(int(tip[1:].split()[0]) for tip in panel) == [point.number for point in chart.points]
    first = next(tip for tip in tips if tip.startswith("#1 "))
    assert first.startswith(
        "#1 grasps 2b, 50 %: expected % 83.40, test % 68.00, interval 58.3 … 76.3, float % 70.00, "
    )
    assert first.splitlines()[1:] == list(chart.points[0].commands)


# -- page --------------------------------------------------------------------------------------------------------------


def test_a_chart_in_a_narrow_window_and_a_dark_scheme(chart, tmp_path):
    (tmp_path / "chart.html").write_text(page(chart), "utf-8")
    script = 'return [document.documentElement.scrollWidth, background, press("chart", "ArrowRight")];'
    wide, colour, cheapest = browsed(tmp_path / "chart.html", script, width=500, scheme="dark")
    assert wide <= 500
    assert colour == "rgb(20, 23, 27)"
    assert cheapest.startswith("#7 grasps-knn1 2b, 50 %")
