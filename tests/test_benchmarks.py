"""Benchmarks: our netlist, references and the rivals' runners agree; results come out again, the paper's tables too."""

import importlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from random_netlists import SIMULATORS

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def module():
    """Import a benchmark by its name, as one that is run as a script finds its neighbours."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS / "paper"))
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module


@pytest.fixture(scope="module")
def workload(module):
    return module("workload")


@pytest.fixture(scope="module")
def busy(workload):
    """The busy network on random events: events, its layers in weight units, its netlist."""
    events = np.random.default_rng(5).random((6, 12, 78)) < 0.13
    layers = workload.build_chain(events)
    return events, layers, workload.place_chain(layers, taxels=39)


@pytest.mark.parametrize("run", SIMULATORS)
def test_recorded_runs_of_a_chip_are_ours(module, run):
    folder = os.environ.get("SPIKELOOM_SLAYER")
    if not folder:
        pytest.skip(
            "set SPIKELOOM_SLAYER to a checkout of slayerPytorch, whose licence keeps its recordings out of here"
        )
    found = module("recorded").compare(Path(folder), run)
    assert found == {"spikes": {"recorded": 641, "wrong": 0}, "voltages": {"recorded": 2032, "wrong": 0}}


@pytest.fixture(scope="module")
def task(module, workload, busy, tmp_path_factory):
    """What the workers read."""
    events, _, netlist = busy
    path = tmp_path_factory.mktemp("rivals") / "task.npz"
    module("rivals").write_task(path, netlist, events, workload.typical(events, 2))
    return module("worker").read_task(str(path))


@pytest.mark.parametrize(
    ("mode", "share"), [("spikes", "all"), ("totals", "few"), ("counts", "few"), ("cycle", "few")]
)
def test_our_runner_agrees_in_every_mode(module, task, mode, share):
    job = module("rival_ours").prepare_job(task, [mode, share])
    assert job.recordings == (6 if share == "all" else 2)
    assert job.differing([job.run(unit) for unit in range(job.units)]) == [0, 0, 0, 0]


def test_the_runner_of_onnxruntime_agrees(module, task):
    job = module("rival_onnx").prepare_job(task, ["few"])
    assert job.differing([job.run(unit) for unit in range(job.units)]) == [0, 0, 0, 0]


def test_both_loops_of_torch_give_nearly_our_spikes(module, task):
    found = []
    for loop in ("layers", "steps"):
        job = module("rival_torch").prepare_job(task, [loop, "few"])
        found.append([job.run(unit) for unit in range(job.units)])
        spikes = sum(int(task.expected("aligned", layer).sum()) for layer in range(4))
        # decay 0.2 for 819/4096, and no truncation
        assert sum(job.differing(found[-1])) < 0.1 * spikes
    for by_layers, by_steps in zip(*found, strict=True):
        assert all(bool((a == b).all()) for a, b in zip(by_layers, by_steps, strict=True))


def test_workers_run_in_pairs_and_those_that_cannot_are_skipped(module, task):
    rivals = module("rivals")

    def entry(name, mode, against=""):
        return rivals.Entry(
            name=name, rival="ours", options=(mode, "few"), computes="", together=False, against=against
        )

    entries = [
        entry("ours", "spikes"),
        entry("rival", "totals", "spikes"),
        entry("odd", "fastest", "counts"),
    ]
    found = rivals.measure(task.path, entries, {}, rounds=1)
    assert found["odd"]["skipped"].startswith("there is no mode fastest")
    assert found["rival"]["against"] == "ours"
    assert found["ours"]["differing_spikes"] == found["rival"]["differing_spikes"] == [0, 0, 0, 0]
    assert [found[name]["laps"] for name in ("ours", "rival")] == [1, 1]
    assert (
        0
        < found["rival"]["ratio"]["min"]
        <= found["rival"]["ratio"]["median"]
        <= found["rival"]["ratio"]["max"]
    )
    assert found["rival"]["peak_mb"] > 1


def test_a_wrong_spike_is_found(task):
    spikes = [task.expected("aligned", layer).copy() for layer in range(4)]
    spikes[2][1, 3, 4] ^= True
    assert task.differing("aligned", spikes) == [0, 0, 1, 0]


@pytest.fixture(scope="module")
def cells(module):
    return module("cells").read_cells(module("cells").RESULTS)


def test_stored_tables_are_those_of_the_stored_cells(module, cells):
    written = module("tables").files(cells, drawn=False)
    assert sorted(written) == ["graphs.csv", "graphs.md", "methods.csv", "methods.md", "statistics.json"]
    for name, content in written.items():
        assert content == (module("cells").RESULTS / name).read_bytes()


def test_every_planned_cell_is_there_and_adds_up(module, cells):
    planned = [module("cells").planned(table) for table in ("methods", "graphs")]
    assert {
        row.cell(seed) for rows in planned for row, seeds in rows.items() for seed in range(seeds)
    } == set(cells)
    for cell in cells.values():
        for which in ("last", "best", "clean"):
            assert cell[which]["accuracy"] == cell[which]["correct"] / cell["test_samples"]


def test_figures_of_later_work_are_what_its_abstract_gains(module):
    work = json.loads((module("cells").RESULTS / "later.json").read_text())["works"]["GGT-SNN"]
    for data, gain in zip(("objects", "containers"), work["gains"], strict=True):
        paper, _ = module("cells").PUBLISHED[data, module("cells").TACTILESGNET, "manual"]
        assert work[data] == pytest.approx(paper + gain)
        assert f"{gain} %" in work["quote"]


def test_a_price_weighs_as_much_as_its_events(module):
    more, less = {"synapse_dense": 4.0, "synapse_sparse": 2.0, "neuron": 3.0}, {"neuron": 3.0}
    ratio = module("sensitivity").ratio
    assert ratio(more, less, "synapse", 5) == pytest.approx(33 / 3)
    assert ratio(more, less, "neuron", 5) == pytest.approx(21 / 15)


def test_ratios_of_energies_are_those_of_another_result(module):
    results = module("sensitivity").RESULTS
    stored = json.loads((results / "sensitivity.json").read_text())["prices"]
    networks = json.loads((results / "processor-objects.json").read_text())["figures"]
    (low, high), (least, most) = (
        networks[name]["chip"]["dynamic_j"] for name in ("TactileSGNet", "counters")
    )
    assert stored["TactileSGNet / counters, davies2018"]["usual"] == pytest.approx(low / most)
    assert stored["TactileSGNet / counters, sanafe"]["usual"] == pytest.approx(high / least)
    chip, small = (networks["counters"][name]["pace_j"] for name in ("chip", "processor"))
    assert stored["chip / microcontroller"]["usual"] == pytest.approx(chip[0] / small[1])


@pytest.fixture
def stored(monkeypatch, tmp_path):
    """The list of stored results, over a copy that a test may change."""
    monkeypatch.syspath_prepend(str(BENCHMARKS.parent))
    found = importlib.import_module("benchmarks.__main__")
    shutil.copytree(found.RESULTS, tmp_path / "results", dirs_exist_ok=True)
    monkeypatch.setattr(found, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(found, "RUNS", tmp_path / "results" / "runs")
    return found


# 10 s of a quiet core together: one is the whole chain on real recordings, one the statistics that the docs quote
@pytest.mark.parametrize("name", ["longer-bins.json", "confusion-containers.json"])
def test_results_come_out_again(stored, name):
    assert stored.again(name) == []


def test_a_run_again_finds_nothing_that_was_finished_before(stored, tmp_path, monkeypatch):
    name, here, files, place = "longer-bins.json", tmp_path / "here", tmp_path / "files", tmp_path / "place"
    for file in (
        here / "results" / name,
        here / "results" / "x.parts.json",
        files / "work" / "1.json",
        files / "a.pt",
    ):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    seen = set()

    def stop(*_, cwd, **__):
        seen.update(file.name for file in cwd.rglob("*"))
        raise RuntimeError("before it begins")

    monkeypatch.setattr(stored, "HERE", here)
    monkeypatch.setattr(stored.subprocess, "run", stop)
    place.mkdir()
    with pytest.raises(RuntimeError, match="before it begins"):
        stored.run(name, place, [files])
    assert "a.pt" in seen
    assert seen.isdisjoint({"work", "1.json", "x.parts.json"})


def test_part_of_a_result_is_none(stored, tmp_path, monkeypatch):
    """A script that ends with an error may have written some of it."""
    here, place = tmp_path / "here", tmp_path / "place"
    here.mkdir()
    (here / "half.py").write_text(
        "import pathlib, sys\npathlib.Path(sys.argv[1]).write_text('{}')\nsys.exit('no more')\n"
    )
    (here / "results").mkdir()
    (here / "results" / "half.json").write_text("{}")
    (stored.RESULTS / "half.json").write_text('{"command": "python benchmarks/half.py half.json"}')
    monkeypatch.setattr(stored, "HERE", here)
    place.mkdir()
    with pytest.raises(RuntimeError, match="exit code 1\nno more"):
        stored.run("half.json", place, [])
    assert (place / "benchmarks" / "results" / "half.json").exists()


def test_what_a_run_wrote_is_none_of_its_sources(stored, tmp_path):
    (tmp_path / "benchmarks").mkdir()
    file = tmp_path / "benchmarks" / "made.py"
    shutil.copyfile(stored.HERE / "made.py", file)
    (tmp_path / "log").write_text(f"{file}\n")
    written = file.stat().st_mtime_ns
    assert stored.depends(tmp_path / "log", tmp_path, written) == {}
    assert list(stored.depends(tmp_path / "log", tmp_path, written + 1)["benchmarks"]) == ["made.py"]


def test_a_result_that_was_edited_differs_and_its_record_is_written(stored):
    name = "longer-bins.json"
    file = stored.RESULTS / name
    true = json.loads(file.read_text())
    file.write_text(json.dumps(true | {"figures": true["figures"] | {"validation_20ms": [0]}}))
    other = stored.RESULTS / "silicon.json"
    other.write_text("of another run")
    (found,) = stored.again(name, write=True)
    assert other.read_text() == "of another run"
    assert found.startswith("/figures/validation_20ms")
    assert json.loads(file.read_text())["figures"] == true["figures"]
    assert stored.state(name) == "up to date"
    read = stored.flat(stored.read(stored.RUNS / name)["files"])
    expected = {"benchmarks/figures.py", "benchmarks/results/paper/cells.json", "compiler/__init__.py"}
    assert expected <= read.keys()


def test_a_result_is_stale_when_what_its_command_read_does_something_else(stored, monkeypatch, tmp_path):
    (tmp_path / "code.py").write_text("def double(x):\n    return 2 * x\n")
    (tmp_path / "prices.toml").write_text("a = 1\n")
    monkeypatch.setattr(stored, "ROOT", tmp_path)
    files = ("code.py", "prices.toml")
    stored.digest.cache_clear()
    (stored.RUNS / "x.json").parent.mkdir(exist_ok=True)
    (stored.RUNS / "x.json").write_text(
        json.dumps({"files": {".": {each: stored.digest(each) for each in files}}})
    )
    states = []
    for name, text in [
        ("code.py", 'def double(x):\n    """Twice."""\n    return 2 * x  # of it\n'),
        ("code.py", "def double(x):\n    return 3 * x\n"),
        ("prices.toml", "a = 2\n"),
    ]:
        (tmp_path / name).write_text(text)
        stored.digest.cache_clear()
        states.append(stored.state("x.json"))
    stored.digest.cache_clear()
    assert states == ["up to date", "stale (code.py)", "stale (code.py, prices.toml)"]
    assert stored.state("fuzz.json") == "finished"  # No script of it is in this folder


def test_the_list_has_every_result(stored, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["benchmarks"])
    stored.main()
    text = capsys.readouterr().out
    assert all(f"{name}: " in text for name in stored.names())
    assert "anytime-objects.json: " in text
    assert "\n    python benchmarks/figures.py FOLDER anytime-objects\n" in text
