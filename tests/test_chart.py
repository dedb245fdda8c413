"""The command ``chart`` on small networks; grids as written, and fronts, the choice and budgets on made-up points."""

import hashlib
import json
import shlex
import shutil
from dataclasses import replace

import made_files
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_chart import BY, made_figures, made_network, made_point, stored
from made_files import events, own_file, recordings_folder, ring, weights
from oracles import refused
from zoo import STORAGE, tuned

from spikeloom.compiler.errors import CapacityError, OptionError, Violation
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.compiler.storage import Fixed
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import data_digest, first_part
from spikeloom.runtime.studies.chart import results, study
from spikeloom.runtime.studies.chart import work as chart_work
from spikeloom.runtime.studies.chart.grid import Grid, parse_grid
from spikeloom.runtime.studies.search.budgets import Budget, parse_budgets
from spikeloom.runtime.studies.search.choice import front

GRID = "bits=4,8,window=50-100%:50,cores=cores/fc1:2"
VIOLATION = Violation(
    owner="core 0", rule="loihi1.core.axons_in", used=5, allowed=4, remedy="use fewer inputs"
)

CHART = ("chart", "ring.pt", "--data", "data", "--grid", GRID, "--jobs", "1")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings and checkpoints."""
    folder = tmp_path_factory.mktemp("chart")
    train = np.concatenate([events(1, samples=12), events(3, samples=4, rate=0.05)])
    recordings_folder(folder / "data", train=train, test=events(2, samples=8))
    digest = data_digest(load_data(folder / "data", "train"), load_data(folder / "data", "test"))
    known = {
        "data_sha256": digest,
        "validation": {"correct": 3, "samples": 4},
        "command": "spikeloom train …",
    }
    own_file(folder / "ring.pt", training=known)
    forms = tuned(read_checkpoint(folder / "ring.pt")).forms
    constants = {"beta": 0.2, "theta": 0.5, "training": known, "forms": forms}
    save_checkpoint(folder / "tuned.pt", {"last": weights()}, **made_files.graph_facts(ring()), **constants)
    own_file(folder / "elsewhere.pt", training={"data_sha256": "0" * 64, "data": "Grasps.zip"})
    return folder


@pytest.fixture
def made(as_json, place):
    """A chart of one network, made once."""
    if not (place / "out" / "chart.json").exists():
        assert as_json(*CHART, "-o", "out") == json.loads((place / "out" / "chart.json").read_text())
    return json.loads((place / "out" / "chart.json").read_text())


def test_every_point_of_the_grid_is_there(made, place):
    found = [(p["bits"], p["cores"], p["window"]) for p in made["points"]]
    assert found == [(b, c, w) for b in ([4], [8]) for c in ("cores", "fc1:2") for w in (50, 100)]
    assert [point["number"] for point in made["points"]] == list(range(1, 9))
    assert made["refused"] == []
    assert (made["data"]["train"], made["data"]["test"], made["data"]["steps"]) == (16, 8, 24)
    (network,) = made["networks"]
    assert network["validation"] == 0.75
    whole = made["points"][1]["train"]["float"]["accuracy"]
    decided = {}
    for point in made["points"]:
        assert point["expected"] == pytest.approx(0.75 * point["train"]["accuracy"] / whole)
        assert point["test"]["low"] <= point["test"]["accuracy"] <= point["test"]["high"]
        figures = [point[split][key] for split in ("train", "test") for key in ("correct", "equal")]
        assert decided.setdefault((str(point["bits"]), point["window"]), figures) == figures, (
            "layouts decide alike"
        )
    assert any(point["front"]["energy"] for point in made["points"])
    assert len({point["n_cores"] for point in made["points"]}) > 1
    assert (place / "out" / "chart.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (place / "out" / "chart.svg").read_text("utf-8").startswith("<?xml")
    assert (place / "out" / "chart.html").read_text("utf-8").startswith("<!DOCTYPE html>")


def test_windows_are_of_whole_recordings_whatever_part_trained_the_network(as_json, place):
    splits = (load_data(place / "data", split) for split in ("train", "test"))
    known = {"window": 50, "data_sha256": data_digest(*(first_part(each, 50) for each in splits))}
    own_file(place / "half.pt", training=known)
    grid = "bits=4,window=50-100%:50,cores=cores"
    found = as_json("chart", "half.pt", "--data", "data", "--grid", grid, "--jobs", "1", "-o", "halves")
    half, whole = found["points"]
    for point in (half, whole):
        compiled, ran, priced = (shlex.split(command) for command in point["commands"])
        as_json(*compiled[1:])
        assert (place / compiled[-1]).read_bytes() == (place / "halves" / point["netlist"]).read_bytes()
        assert as_json(*ran[1:])["accuracy"] == point["test"]["accuracy"]
        assert as_json(*priced[1:])["per_inference"]["synaptic_operations"] == point["test"]["operations"]
    assert half["test"]["operations"] < whole["test"]["operations"]
    usual = as_json("estimate", compiled[-1], "--data", "data")["per_inference"]["synaptic_operations"]
    assert usual == half["test"]["operations"]


@pytest.mark.parametrize("number", [4, 7])
def test_the_commands_of_a_point_give_its_netlist_and_its_figures(made, as_json, place, number):
    point = made["points"][number - 1]
    compiled, ran, priced = (shlex.split(command) for command in point["commands"])
    as_json(*compiled[1:])
    netlist = (place / compiled[-1]).read_bytes()
    assert netlist == (place / "out" / point["netlist"]).read_bytes()
    assert hashlib.sha256(netlist).hexdigest() == point["netlist_sha256"]
    assert as_json(*ran[1:])["accuracy"] == point["test"]["accuracy"]
    costs = as_json(*priced[1:])
    mean = costs["per_inference"]
    assert mean["energy_j"] == pytest.approx(point["test"]["energy_j"], rel=1e-12)
    assert mean["synaptic_operations"] == point["test"]["operations"]
    (clock,) = costs["time"]
    assert {clock["table"]: clock["inference_s"]["mean"]} == pytest.approx(
        point["test"]["time_s"], rel=1e-12
    )
    assert costs["chip_steps"] == point["test"]["steps"] + read_netlist(place / compiled[-1]).max_depth
    words = (
        "--checkpoint",
        "ring.pt",
        "--data",
        "data",
        "--window",
        f"{point['window']}%",
        "--spec-samples",
        "1",
    )
    found = as_json("verify", compiled[-1], *words, codes=(0, 1))
    assert found["accuracy"]["float"] == point["test"]["float"]["accuracy"]
    assert found["decision_agreement"] == point["test"]["equal"] / 8


def test_once_more_nothing_is_measured_and_one_more_width_nothing_else(made, spikeloom, place, monkeypatch):
    worked, measure = [], chart_work.measure
    monkeypatch.setattr(chart_work, "measure", lambda work: worked.append(work) or measure(work))
    shutil.copytree(place / "out", place / "again")
    before = {file.name: file.read_bytes() for file in (place / "out").glob("chart.*")}
    left = [place / "out" / name for name in (".chart.json.0123abcd.part", "netlists/.x.loom.0123abcd.part")]
    for part in left:
        part.touch()
    assert spikeloom(*CHART, "-o", "out", "--json")[0] == 0
    assert worked == []
    assert not any(part.exists() for part in left), "what a killed one has left stays"
    assert {file.name: file.read_bytes() for file in (place / "out").glob("chart.*")} == before
    words = [word.replace("bits=4,8", "bits=4,6,8") for word in CHART]
    assert spikeloom(*words, "-o", "again", "--json")[0] == 0
    assert [work.storage.bits for work in worked] == [(6,)]
    points = json.loads((place / "again" / "chart.json").read_text())["points"]
    assert [point["test"] for point in points if point["bits"] != [6]] == [
        point["test"] for point in made["points"]
    ]


def test_what_the_chip_refuses_is_listed(as_json, refusal, place, monkeypatch):
    refused, to_integers = {4}, chart_work.to_integers

    def picky(network, options, target):
        if isinstance(options.storage, Fixed) and options.storage.packings[0].bits in refused:
            raise CapacityError((VIOLATION,))
        return to_integers(network, options, target)

    monkeypatch.setattr("spikeloom.runtime.studies.chart.work.to_integers", picky)
    words = ("chart", "ring.pt", "--data", "data", "--jobs", "1", "--grid")
    found = as_json(*words, "bits=4,3,window=100%", "-o", "refused")
    assert [(each["bits"], each["why"]) for each in found["refused"]] == [([4], [str(VIOLATION)])]
    refused |= {5, 6}
    line = refusal(*words, "bits=5-6,window=100%", "-o", "nothing")
    assert line.endswith(f"refuses all 2 configurations; the first: {VIOLATION}")
    assert not (place / "nothing" / "chart.json").exists()


def test_a_fine_tuned_network_keeps_its_storage(as_json):
    words = ("chart", "tuned.pt", "--data", "data", "--jobs", "1", "-o", "tuned", "--grid")
    points = as_json(*words, "bits=2-6,8,window=50%,100%")["points"]
    found = [(tuple(point["bits"]), point["fine_tuned"], point["window"]) for point in points]
    widths = tuple(bits for bits, _ in STORAGE)
    assert found == [(widths, True, 50), (widths, True, 100)]
    assert "--weight-bits" not in points[0]["commands"][0]


def test_recordings_that_it_was_not_trained_on_are_refused(refusal, place):
    line = refusal("chart", "elsewhere.pt", "--data", "data", "-o", "bad")
    assert "elsewhere.pt: was trained on other recordings (Grasps.zip) than data" in line
    assert not (place / "bad").exists()


def point(number, train, test, energy, time, *, bits=4, **about):
    """Right of 400 training and of 100 test recordings, µJ and ms of both splits."""
    figures = {
        "train": made_figures(train, 400, energy, time),
        "test": made_figures(test, 100, energy, time),
    }
    return made_point(number, stored=stored(bits), **figures, **about)


@pytest.fixture
def points():
    made = [
        point(1, 400, 88, 200, 4.0, bits=8),
        point(2, 398, 90, 120, 3.0),
        point(3, 396, 70, 60, 2.0, bits=3),
        point(4, 394, 89, 40, 2.5, bits=2),
        point(5, 400, 60, 300, 1.0, cores="fc1:6"),
    ]
    return study.with_fronts(study.with_expectations(made, [made_network()]), BY)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=12))
def test_the_front_is_what_no_other_point_beats(pairs):
    gains, costs = [float(gain) for gain, _ in pairs], [float(cost) for _, cost in pairs]
    wanted = [
        not any(other[0] >= gain and other[1] <= cost and other != (gain, cost) for other in pairs)
        for gain, cost in pairs
    ]
    assert front(gains, costs) == wanted


def test_fronts_are_of_test_accuracy_and_each_cost(points):
    assert [each.front["energy"] for each in points] == [False, True, False, True, False]
    assert [each.front["time"] for each in points] == [False, True, True, True, True]


def test_expected_is_validation_times_what_is_kept_on_training_recordings():
    made = [
        point(1, 380, 50, 1, 1),
        point(2, 190, 50, 1, 1, window=50),
    ]  # the float model has 8 more on whole ones
    assert [each.expected for each in study.with_expectations(made, [made_network()])] == pytest.approx(
        [0.9 * 380 / 388, 0.9 * 190 / 388]
    )
    # where one checkpoint knows no validation, training figures stand for all
    networks = [made_network(), made_network("other", validation=None)]
    assert [each.expected for each in study.with_expectations(made, networks)] == pytest.approx(
        [0.95, 0.475]
    )


def test_the_choice_does_not_look_at_the_test_split(points):
    blind = [replace(each, test=made_figures(1, 100, 1, 1)) for each in points]
    for budgets in ((), ("energy=100uJ",), ("accuracy=89",)):
        wanted = parse_budgets(budgets)
        assert study.pick(blind, wanted, BY) == study.pick(points, wanted, BY)


@pytest.mark.parametrize(
    ("budgets", "number", "fitting"),
    [
        ([], 3, 5),  # the cheapest within a point of the best: expected at least 89 %, or 395.6 of 400
        (["energy=50uJ"], 4, 1),
        (["energy=150uJ"], 4, 3),  # within a point of the best that fits
        (["accuracy=89"], 3, 4),  # an accuracy is reached as cheaply as can be
        (["accuracy=50"], 4, 5),
        (["accuracy=89.2"], 2, 3),
        (["accuracy=90"], 1, 2),
        (["energy=150uJ", "time=2.2ms"], 3, 1),
        (["accuracy=88", "time=1.5ms"], 5, 1),
    ],
)
def test_the_point_that_fits_all_budgets(points, budgets, number, fitting):
    assert study.pick(points, parse_budgets(budgets), BY) == results.Pick(
        budgets=tuple(budgets), fits=True, fitting=fitting, point=number
    )


def test_a_budget_of_decisions_that_no_event_alters(points):
    shares = (0.5, 0.9, None, 0.8, 0.95)
    points = [
        replace(each, train=replace(each.train, certified=certified))
        for each, certified in zip(points, shares, strict=True)
    ]
    found = study.pick(points, parse_budgets(["certified=80"]), BY)
    assert (found.fits, found.fitting, found.point) == (True, 3, 2)


def test_a_chart_that_certifies_measures_what_certify_finds(place, as_json):
    words = ("chart", "ring.pt", "--data", "data", "--jobs", "1", "--grid", "bits=8,window=50-100%:50")
    plain = as_json(*words, "-o", "certifies")["points"]
    found = as_json(*words, "--budget", "certified=1", "-o", "certifies", codes=(0, 1))["points"]
    shares = [each["train"].pop("certified") for each in found]
    assert found == plain
    assert all("certified" not in each["test"] for each in found)
    netlist = str(place / "certifies" / found[1]["netlist"])
    told = as_json("certify", netlist, "--data", "data", "--split", "train", "--most", "1")["certificates"]
    stand = [each["at_least"] >= 1 for each in told]
    assert shares[1] == sum(stand) / len(stand)
    assert len(set(shares)) == 2


@pytest.mark.parametrize(
    ("budgets", "number"), [(["energy=20uJ"], 4), (["energy=50uJ", "time=2ms"], 3), (["accuracy=95"], 1)]
)
def test_the_nearest_point_of_budgets_that_nothing_fits(points, budgets, number):
    found = study.pick(points, parse_budgets(budgets), BY)
    assert (found.fits, found.fitting, found.point) == (False, 0, number)
    refused(
        OptionError,
        "--budget time=1ms: |no time table",
        study.pick,
        points,
        parse_budgets(["time=1ms"]),
        replace(BY, time=None),
    )


@pytest.mark.parametrize(
    ("words", "limit"),
    [
        *((f"energy={value}", 1e-4) for value in ("0.1mJ", "100uJ", "100 µJ", "100μJ", "1e-4J")),
        ("time=5ms", 5e-3),
        ("time= .5us", 5e-7),
        ("accuracy=88", 0.88),
        ("accuracy=88.5%", 0.885),
    ],
)
def test_a_budget_in_units(words, limit):
    (budget,) = parse_budgets([words])
    assert budget == Budget(what=words.partition("=")[0], limit=pytest.approx(limit), words=words)


@pytest.mark.parametrize(
    "words",
    [
        "power=1W",
        *(f"energy{value}" for value in ("", "=0.1", "=1ms", "=0mJ")),
        *(f"time={value}" for value in ("", "-1ms")),
        *(f"accuracy={value}" for value in ("101", "x")),
    ],
)
def test_a_budget_that_is_none(words):
    refused(OptionError, f"--budget {words}: ", parse_budgets, [words])
    twice = ["time=1ms", "time=2ms"]
    refused(OptionError, "--budget time=2ms: time is limited twice; give it once", parse_budgets, twice)


def parsed(text):
    return parse_grid(text, load_target("loihi1"))


@pytest.mark.parametrize(
    ("text", "axes"),
    [
        ("", {"bits": ((2,), (3,), (4,), (5,), (6,), (8,)), "window": (25, 50, 75, 100)}),
        ("bits=2-6,8,planes=1-2,prune=0/1", {"planes": (1, 2), "prune": (0, 1)}),
        ("cores=cores/fc1:6+conv1:4,groups=2", {"cores": ("cores", "fc1:6+conv1:4"), "groups": (2,)}),
        # in their order, each once
        ("bits=8,2-4,3,4+4+4+4", {"bits": ((8,), (2,), (3,), (4,))}),
        ("bits=8+4+4+8/8", {"bits": ((8, 4, 4, 8), (8,))}),
        ("groups=2 / 1,planes=3/ 1 , cores=cores", {"groups": (2, 1), "planes": (3, 1)}),
        *((f"window={text}", {"window": (50,)}) for text in ("50", "50%")),
        *((f"window={text}", {"window": (25, 50, 75, 100)}) for text in ("25-100%", "25%-100%")),
        ("window=40-100%:20", {"window": (40, 60, 80, 100)}),
        ("window=40-100%:50%", {"window": (40, 90, 100)}),
        ("window=100-100", {"window": (100,)}),
    ],
)
def test_values_of_axes(text, axes):
    assert (parsed(text) if text else Grid()) == Grid(**axes)


@pytest.mark.parametrize(
    ("text", "telling"),
    [
        *((f"bits={value}", f"bits={value}: allowed are 2, 3, 4, 5, 6, 8") for value in ("2-x", "7", "")),
        *((f"bits={value}", "or a width for each layer as in 8+4+4+8") for value in ("8+4+9", "6-2")),
        ("bits=3,", "bits=: allowed are 2"),
        ("bits=3,bits=4", "bits: give each of bits, planes, groups, prune, cores, window once"),
        ("planes=1, colour=2", "colour: give each of bits, planes"),
        ("3,4", "3: belongs to no axis; begin with one"),
        ("", ": belongs to no axis; begin with one"),
        ("planes=4", "planes=4: allowed are 1 to 3 planes"),
        ("groups=0", "groups=0: allowed are 1 to 8 scale groups"),
        ("prune=2", "prune=2: allowed are 0 (keep) and 1 (leave out)"),
        *(
            (f"window={value}", "1 to 100 per cent")
            for value in ("50-101%", "0", "80-20%", "20-80%:0", "50%:5")
        ),
        *((f"cores={value}", "cores, or LAYER:N") for value in ("fast", "a:2+:3", "a:2+a:3", "a:0")),
    ],
)
def test_a_mistake_names_the_value_and_what_is_allowed(text, telling):
    refused(OptionError, f"--grid |{telling}", parsed, text)
