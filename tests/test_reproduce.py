"""The reproduce command: cells trained, taken over and measured, tables from whatever is there."""

import csv
import io
import itertools
import json
import math
import os
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import RUNTIME
from hypothesis import given, settings
from hypothesis import strategies as st
from made_cells import CAPACITY, kept, made_cell
from scipy import stats

import spikeloom.models.training.train
from spikeloom.compiler.errors import CapacityError, Violation
from spikeloom.compiler.formats.checkpoint import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.compilation import compile_network, without
from spikeloom.models.graphs import build_graph
from spikeloom.models.networks.networks import Architecture
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.recordings.release import write_released
from spikeloom.runtime.cli import main
from spikeloom.runtime.inputs.network import propagation
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.studies.jobs.cluster import ClusterLostError
from spikeloom.runtime.studies.jobs.workers import ProcessDied
from spikeloom.runtime.studies.paper import noise as paper_noise
from spikeloom.runtime.studies.paper import picture as paper_picture
from spikeloom.runtime.studies.paper import table as paper_table
from spikeloom.runtime.studies.paper import text as paper_text
from spikeloom.runtime.studies.paper.cells import GRAPHS, SAME_AS, Row, in_turn, plan, read_cells
from spikeloom.runtime.studies.paper.published import Published

ROOT = Path(__file__).resolve().parents[1]

SMALL = {"features": 4, "hidden": (12, 8)}


@pytest.fixture
def data(tmp_path, monkeypatch) -> Path:
    """A small data set in the released layout, small networks, scales from weights alone, which takes no seconds.

    The working folder is where the data is.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("spikeloom.models.networks.networks.Architecture", small)
    monkeypatch.setattr("spikeloom.runtime.studies.paper.measured.compile_network", uncalibrated)
    monkeypatch.setattr("spikeloom.runtime.studies.paper.picture.DPI", 30)
    made(tmp_path / "Ev-Grasps")
    return tmp_path


def small(**given):
    return Architecture(**(given | SMALL))


def uncalibrated(network, training_events=None):
    return compile_network(network)


def made(folder: Path, first: int = 1) -> None:
    splits = [
        replace(synthetic_grasps(per_class=3, steps=14, seed=seed), split=split)
        for split, seed in (("train", first), ("test", first + 1))
    ]
    write_released(folder, splits)


WORDS = ("reproduce", "--data", "Ev-Grasps", "--jobs", "1", "-o", "out")
METHODS = (*WORDS, "--table", "methods", "--seeds", "1", "--epochs", "3")
GCN_NAME = "grasps-gcn-manual-e3-s0"


def as_json(capsys, *words, code=0):
    assert main([*words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def refused(capsys, *words) -> str:
    capsys.readouterr()
    assert main([*words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err.removeprefix("spikeloom: ").removesuffix("\n")


def test_the_table_of_methods_from_nothing(data, capsys):
    assert main([*METHODS, "--same-padding", "--json"]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    names = [f"grasps-{name}-e3-s0" for name in ("tactilesgnet-manual", "grid-cnn-none", "grid-cnn-same", "mlp-none")]
    names.append(GCN_NAME)
    assert sorted(path.stem for path in Path("out/cells").iterdir()) == sorted(names)
    assert sorted(path.stem for path in Path("out/networks").iterdir()) == sorted(names)
    assert [row["cells"] for row in report["methods"]] == [[name] for name in names]
    assert (report["planned"], report["finished"], report["missing"], report["elsewhere"]) == (5, 5, [], 0)
    assert report["files"] == [f"out/methods.{kind}" for kind in ("csv", "md", "png")]
    assert all(Path(name).stat().st_size > 500 for name in report["files"])
    lines = err.splitlines()
    assert lines[0] == "spikeloom: 0 of 5 cells are there; 0 more networks to measure, 5 to train"
    assert [line.split(" min left: ")[1].split()[0] for line in lines[1:]] == names
    assert lines[-1].startswith(f"spikeloom: 5 of 5 cells, 0 min left: {GCN_NAME} best ")
    for row, name in zip(report["methods"], names, strict=True):
        cell = json.loads(Path(f"out/cells/{name}.json").read_text())
        record = read_checkpoint(f"out/networks/{name}.pt").training
        assert cell["decay_epochs"] == 40
        assert "recipe" not in record  # the released one
        for which in ("best", "last", "clean"):
            assert cell[which] == record[which]
            assert row[which]["values"] == [100 * record[which]["accuracy"]]
        assert row["paper"] is None
        for which in ("last", "clean"):
            assert cell["chip"][which]["epoch"] == record[which]["epoch"]
            assert cell["chip"][which]["float_correct"] == record[which]["correct"]


def test_figures_are_those_of_compile_verify_and_estimate(data, capsys, monkeypatch):
    monkeypatch.setattr("spikeloom.runtime.studies.paper.measured.compile_network", compile_network)
    monkeypatch.setattr("spikeloom.runtime.studies.paper.cells.METHODS", (("gcn", "manual"),))
    as_json(capsys, *METHODS)
    network = f"out/networks/{GCN_NAME}.pt"
    found = json.loads(Path(f"out/cells/{GCN_NAME}.json").read_text())["chip"]
    for which in ("last", "clean"):
        as_json(capsys, "compile", network, "--weights", which, "--calibrate", "Ev-Grasps", "-o", "x.loom")
        checked = ("--checkpoint", network, "--weights", which, "--data", "Ev-Grasps", "--require", "E0")
        verdict = as_json(capsys, "verify", "x.loom", *checked)
        costs = as_json(capsys, "estimate", "x.loom", "--data", "Ev-Grasps")
        ours = found[which]
        assert ours["correct"] == round(verdict["accuracy"]["chip"] * 18)
        assert ours["float_correct"] == round(verdict["accuracy"]["float"] * 18)
        assert ours["equal"] == round(verdict["decision_agreement"] * 18)
        assert ours["synaptic_operations"] == costs["per_inference"]["synaptic_operations"]
        assert ours["energy_j"] == pytest.approx(costs["per_inference"]["energy_j"])
        assert ours["first_layer_operations"] == costs["layers"][0]["synaptic_operations"]
        assert ours["first_layer_energy_j"] == pytest.approx(costs["layers"][0]["energy_j"])
        assert ours["cores"] == as_json(capsys, "inspect", "x.loom")["cores"]
        first, lean = ours["first_layer"], ours["without_quiet"]
        assert first["neurons"] == 39 * 4
        assert 0 <= first["quiet_in_both"] <= first["quiet_in_training"] < 39 * 4 - first["cannot_fire"]
        assert lean["first_layer_operations"] <= ours["first_layer_operations"]
        assert lean["neurons"] == ours["neurons"] - first["quiet_in_training"]


def test_leaving_out_what_never_fired_moves_no_other_spike(data, capsys):
    as_json(capsys, *METHODS)
    checkpoint = read_checkpoint("out/networks/grasps-tactilesgnet-manual-e3-s0.pt")
    _, adjacency = propagation(checkpoint, None, "")
    compilation = compile_network(expand(checkpoint, adjacency))
    netlist = compilation.netlist
    events = synthetic_grasps(per_class=2, steps=40, seed=5).events.reshape(12, -1, 40)
    whole = engine.simulate(netlist, events).counts.spikes
    unused = tuple(np.zeros(population.size, np.bool_) for population in compilation.integer.populations)
    held = netlist.compartments_of(0)
    quiet = netlist.neuron[held[whole[:, held].sum(axis=0) == 0]]
    assert len(quiet) > 3
    unused[0][quiet] = True
    lean = without(compilation, unused)
    rest = engine.simulate(lean, events).counts.spikes
    assert lean.n_compartments == netlist.n_compartments - len(quiet)
    for layer in range(len(netlist.layers)):
        ids, left = netlist.compartments_of(layer), lean.compartments_of(layer)
        by_neuron = {
            neuron: spikes.tolist() for neuron, spikes in zip(netlist.neuron[ids], whole[:, ids].T, strict=True)
        }
        for neuron, spikes in zip(lean.neuron[left], rest[:, left].T, strict=True):
            assert spikes.tolist() == by_neuron[neuron]
    np.testing.assert_array_equal(class_counts(lean, rest), class_counts(netlist, whole))


@pytest.mark.parametrize(("axons", "calibrated"), [(15808, False), (4100, True)])
def test_a_network_that_the_chip_refuses_is_trained_and_says_why(data, capsys, monkeypatch, axons, calibrated):
    line = f"core 0 (fc1): {axons} used, 4096 allowed (loihi1.core.axons_in); fewer inputs to the layer"

    tried = []

    def refusing(network, training_events=None):
        if network.populations[0].size == 13 * 19 * 4:  # which a trained one of full size does by itself
            tried.append(training_events is not None)
            owner, remedy = "core 0 (fc1)", "fewer inputs to the layer"
            rule = "loihi1.core.axons_in"
            raise CapacityError((Violation(owner=owner, rule=rule, used=axons, allowed=4096, remedy=remedy),))
        return compile_network(network)

    monkeypatch.setattr("spikeloom.runtime.studies.paper.measured.compile_network", refusing)
    monkeypatch.setattr("spikeloom.runtime.studies.paper.cells.METHODS", (("mlp", "none"), ("mlp", "none")))
    report = as_json(capsys, *WORDS, "--table", "methods", "--seeds", "1", "--epochs", "1", "--same-padding")
    rows = {row["form"]: row for row in report["methods"]}
    assert rows["none"]["refused"] is None
    assert rows["same"]["refused"] == [line]
    assert tried == [False, True][: 1 + calibrated]
    assert rows["same"]["chip"] is None
    assert rows["same"]["last"]["n"] == 1
    text = Path("out/methods.md").read_text()
    assert f"- grid-based CNN, same padding: Loihi 1 refuses it: {line}" in text
    assert "| grid-based CNN, same padding | refused |" in text


def test_the_table_of_graphs(data, capsys):
    words = (*WORDS, "--table", "graphs", "--graph", "knn:2", "--graph", "mst:2.0", "--seeds", "2", "--epochs", "1")
    report = as_json(capsys, *words)
    assert [(row["form"], row["seeds"]) for row in report["graphs"]] == [("knn:2", [0, 1]), ("mst:2", [0, 1])]
    assert report["files"] == [f"out/graphs{end}" for end in (".csv", ".md", ".png", "-costs.png", "-quiet.png")]
    assert read_checkpoint("out/networks/grasps-tactilesgnet-mst-2-e1-s1.pt").graph == "mst:2"
    assert report["schedule"][0]["short"] is None
    assert "Not shown everywhere yet: two seeds that both lengths have are needed." in Path("out/graphs.md").read_text()


def test_both_tables_share_their_cells_and_run_the_first_seed_of_all_rows_first():
    parts = plan(["objects"], ("methods", "graphs"))
    assert [(part.table, part.epochs, len(part.cells())) for part in parts] == [
        ("methods", 100, 18),
        ("graphs", 60, 45),
    ]
    same = plan(["objects"], ("methods", "graphs"), epochs=7, seeds=2)
    cells = in_turn(same)
    assert len(cells) == 2 * (4 + 15) - 2
    assert [seed for _, seed in cells] == [0] * 18 + [1] * 18
    full = plan(["objects", "containers"], ("methods", "graphs"), full=True, same_padding=True)
    assert {row.epochs for part in full for row in part.seeds} == {100}
    assert [len(part.cells()) for part in full] == [2 * 5 * 10, 2 * 15 * 10]
    assert GRAPHS == (
        *("manual", "knn:1", "knn:2", "knn:3", "knn:4", "knn:5", "knn:6", "knn:7", "knn:8"),
        *("mst:0", "mst:2", "mst:2.5", "mst:3", "mst:3.5", "mst:4"),
    )


def test_one_row_stands_for_graphs_of_the_same_edges(data, capsys):
    def edges(name):
        return set(map(tuple, build_graph(name).edges))

    assert {name: edges(name) == edges(same) for name, same in SAME_AS.items()} == {"mst:1.5": True}
    assert len({frozenset(edges(name)) for name in GRAPHS}) == len(GRAPHS)
    words = (*WORDS, "--table", "graphs", "--graph", "mst:1.50", "--graph", "mst:0", "--seeds", "1", "--epochs", "1")
    report = as_json(capsys, *words)
    assert [row["form"] for row in report["graphs"]] == ["mst:0"]
    assert "| mst:0, mst:1.5 | 1 | not available here |" in Path("out/graphs.md").read_text()
    assert not list(Path("out/networks").glob("*1.5*"))


# --- what is there already --------------------------------------------------------------------------------------------


def test_a_cell_is_what_train_writes_and_a_finished_network_is_taken_over(data, capsys):
    Path("out/networks").mkdir(parents=True)
    network = Path(f"out/networks/{GCN_NAME}.pt")
    trained = ("--system", "gcn", "--graph", "manual", "--epochs", "3", "--seed", "0")
    as_json(capsys, "train", "--data", "Ev-Grasps", *trained, "-o", str(network))
    content, when = network.read_bytes(), network.stat().st_mtime_ns
    assert refused(capsys, *METHODS) == (
        "-o out: holds 0 of these cells and 1 more that are begun; go on with --resume, or give another folder"
    )
    report = as_json(capsys, *METHODS, "--resume")
    assert report["finished"] == 4
    assert network.stat().st_mtime_ns == when
    cell = json.loads(Path(f"out/cells/{GCN_NAME}.json").read_text())
    network.unlink()
    Path(f"out/cells/{GCN_NAME}.json").unlink()
    assert as_json(capsys, *METHODS, "--resume") == report
    assert network.read_bytes() == content
    assert json.loads(Path(f"out/cells/{GCN_NAME}.json").read_text()) == cell
    assert cell["command"] == ("spikeloom train --data Ev-Grasps --system gcn --graph manual --epochs 3 --seed 0")


def test_a_network_of_another_training_is_not_taken_over(data, capsys):
    Path("out/networks").mkdir(parents=True)
    network = f"out/networks/{GCN_NAME}.pt"
    trained = ("--system", "gcn", "--graph", "manual", "--epochs", "2", "--seed", "4")
    as_json(capsys, "train", "--data", "Ev-Grasps", *trained, "-o", network)
    capsys.readouterr()
    assert main([*METHODS, "--resume"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"spikeloom: {network}: holds another training (other epochs, seed); give its options, or another -o"
    )
    assert len(list(Path("out/cells").iterdir())) == 3


def test_interrupted_it_goes_on_to_the_same_bytes(data, capsys, monkeypatch):
    words = [word if word != "out" else "whole" for word in METHODS]
    whole = as_json(capsys, *words)
    epochs = iter(range(9))
    train_epoch = spikeloom.models.training.train._train_epoch

    def interrupted(*arguments, **options):
        if next(epochs) == 8:
            raise KeyboardInterrupt
        return train_epoch(*arguments, **options)

    monkeypatch.setattr("spikeloom.models.training.train._train_epoch", interrupted)
    assert main([*METHODS]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        "spikeloom: interrupted; 1 of 4 cells and the epochs so far are kept in out; go on with the same command and "
        "--resume"
    )
    text = Path("out/methods.md").read_text()
    assert "| grid-based CNN | 0 of 1 | not available here | missing |" in text
    assert "\nMissing: 3 trainings; " in text
    assert list(Path("out/networks").glob("*.state.validation"))
    assert refused(capsys, *METHODS) == (
        "-o out: holds 1 of these cells and 1 more that are begun; go on with --resume, or give another folder"
    )
    monkeypatch.setattr("spikeloom.models.training.train._train_epoch", train_epoch)
    report = as_json(capsys, *METHODS, "--resume")
    assert report["methods"] == whole["methods"]
    for kind in ("cells/*", "networks/*", "methods.*"):
        ours, theirs = ({file.name: file.read_bytes() for file in Path(name).glob(kind)} for name in ("out", "whole"))
        assert ours == theirs


def test_without_training_it_measures_what_is_finished_and_says_what_is_missing(data, capsys):
    Path("out/networks").mkdir(parents=True)
    trained = ("--system", "gcn", "--graph", "manual", "--epochs", "3")
    as_json(capsys, "train", "--data", "Ev-Grasps", *trained, "-o", f"out/networks/{GCN_NAME}.pt")
    report = as_json(capsys, *METHODS, "--no-train", code=1)
    assert report["finished"] == 1
    assert report["missing"] == [
        f"grasps-{name}-e3-s0" for name in ("tactilesgnet-manual", "grid-cnn-none", "mlp-none")
    ]
    assert [file.stem for file in Path("out/networks").iterdir()] == [GCN_NAME]
    again = as_json(capsys, *(word for word in METHODS if word not in ("--data", "Ev-Grasps")), "--no-train", code=1)
    assert again == report
    assert main([*METHODS, "--no-train"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["TactileSGNet,", "manual", "graph", "0", "of", "1", "—", *["missing"] * 4, "—"]
    assert lines[-2] == (
        "1 of 4 trainings are there; missing: grasps-tactilesgnet-manual-e3-s0, grasps-grid-cnn-none-e3-s0, "
        "grasps-mlp-none-e3-s0"
    )


def test_tables_show_data_sets_that_were_made_before(data, capsys):
    kept(Path("out"), made_cell("objects", "mlp", "none", 3, 0, (1, 1, 1), chip=(1, 1)))
    report = as_json(capsys, *METHODS, "--seeds", "2", "--no-train", code=1)
    assert [(row["data"], row["system"], len(row["seeds"]), row["planned"]) for row in report["methods"]] == [
        (name, system, int(name == "objects" and system == "mlp"), 2)
        for name in ("objects", "grasps")
        for system in ("tactilesgnet", "grid-cnn", "mlp", "gcn")
    ]
    assert report["planned"] == 8  # of the data set that was asked for


def test_cells_of_another_length_are_not_shown_but_told_of(tmp_path, capsys):
    kept(tmp_path, made_cell("objects", "mlp", "none", 2, 0, (1, 1, 1), chip=(1, 1)))
    assert main(["reproduce", "--no-train", "--table", "methods", "-o", str(tmp_path)]) == 1
    assert "1 more cells in the folder are of other tables or lengths" in capsys.readouterr().out


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="signals as POSIX has them")
def test_in_processes_of_its_own_it_keeps_what_it_has(data):
    words = ["reproduce", "--data", "Ev-Grasps", "--table", "methods", "--epochs", "5000", "-o", "out", "--jobs", "2"]
    process = subprocess.Popen(
        [*RUNTIME, *words],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while len(list(data.glob("out/networks/*.state.*"))) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err.splitlines()[-1] == (
        "spikeloom: interrupted; 0 of 18 cells and the epochs so far are kept in out; go on with the same command and "
        "--resume"
    )
    assert not list(data.glob("out/networks/.*")), "half-written files are left"


@pytest.mark.parametrize(
    ("ending", "line"),
    [
        (ProcessDied("its process ended early (exit code -9)", 3), None),
        (ClusterLostError("tcp://h:1"), "--scheduler tcp://h:1: was lost"),
    ],
)
def test_cells_that_are_lost_are_told_and_can_be_gone_on_with(data, capsys, monkeypatch, ending, line):
    def losing(points, run, **_where):
        yield points[0], run(points[0].payload)
        if isinstance(ending, ClusterLostError):
            raise ending
        yield points[1], ending

    monkeypatch.setattr("spikeloom.runtime.studies.paper.cells.METHODS", (("mlp", "none"), ("gcn", "manual")))
    monkeypatch.setattr("spikeloom.runtime.studies.paper.cell_work.spread", losing)
    assert main([*METHODS]) == 1
    died = f"{GCN_NAME}: its process ended early (exit code -9), 3 times, perhaps for lack of memory; left out"
    assert capsys.readouterr().err.splitlines()[-3:] == [
        f"spikeloom: {line or died}",
        "spikeloom: 1 of 2 cells and the epochs so far are kept in out",
        f"spikeloom: go on with: spikeloom {' '.join(METHODS)} --resume",
    ]
    monkeypatch.undo()
    assert "grasps" in Path(data / "out/methods.md").read_text()


# --- statistics -------------------------------------------------------------------------------------------------------


def test_means_and_intervals():
    found = paper_table.spread([88.0, 90.0, 92.0, 94.0])
    assert found["mean"] == 91.0
    assert found["std"] == pytest.approx(math.sqrt(20 / 3))
    reach = 3.182446305284263 * math.sqrt(20 / 3) / 2  # Student's t, 3 degrees of freedom
    assert (found["low"], found["high"]) == pytest.approx((91 - reach, 91 + reach))


@pytest.mark.parametrize(("mean", "within"), [(92.0, True), (87.05, True), (86.9, False), (95.2, False)])
def test_a_mean_is_reproduced_within_two_combined_standard_errors(mean, within):
    ours = paper_table.spread([88.0, 90.0, 92.0, 94.0])
    found = paper_table.compare(ours, Published(mean=mean, std=5.0))
    assert found["combined_se"] == pytest.approx(math.sqrt(20 / 3 / 4 + 25 / 10))
    assert found["difference"] == pytest.approx(91 - mean)
    assert found["within"] == within


def test_a_comparison_needs_two_seeds_and_a_known_deviation():
    two = paper_table.spread([1.0, 2.0])
    assert paper_table.compare(paper_table.spread([1.0]), Published(mean=1.0, std=1.0)) is None
    assert paper_table.compare(two, Published(mean=1.0, std=None)) is None
    assert paper_table.compare(two, None) is None
    assert paper_table.compare(None, Published(mean=1.0, std=1.0)) is None


def test_a_shorter_training_is_compared_where_both_lengths_have_two_seeds():
    made = [
        made_cell("objects", "tactilesgnet", "manual", 60, seed, (130, right, 127))
        for seed, right in enumerate((126, 128))
    ]
    made += [
        made_cell("objects", "tactilesgnet", "manual", 100, seed, (130, right, 127))
        for seed, right in enumerate((127, 131))
    ]
    entries = paper_table.schedules(dict(enumerate(made)), 60)
    by_protocol = {entry["protocol"]: entry for entry in entries}
    last = by_protocol["last"]
    assert last["difference"] == pytest.approx(100 * (127 - 129) / 144)
    assert last["se"] == pytest.approx(100 / 144 * math.sqrt(8 / 2))
    assert last["within"]
    assert by_protocol["best"]["within"]
    assert not paper_table.schedules(dict(enumerate(made)), 100)
    (alone, *_) = paper_table.schedules(dict(enumerate(made[:3])), 60)
    assert "within" not in alone


def made_row(table, form, values, operations, data="objects"):
    spread = paper_table.spread(values)
    chip = {"last": spread, "first_layer_operations": operations}
    row = {"table": table, "data": data, "form": form, "chip": chip, "refused": None}
    return row | {"best": spread, "last": None, "clean": spread}


def test_rows_that_differ_by_more_than_seeds():
    values = [[90.0, 92.0], [80.0, 82.0], [85.0, 87.0], [84.0]]
    rows = [made_row("graphs", str(n), each, n) for n, each in enumerate(values)]
    best, last, _, chip = paper_noise.differences(rows)
    assert (best["reading"], last["reading"], chip["reading"]) == ("best", "last", "chip")
    assert best["between"] == chip["between"] == paper_noise.analysis(values[:3])
    assert best["between"]["rows"] == 3
    assert best["between"]["within"] == pytest.approx(math.sqrt(2))
    assert best["between"]["expected"] == pytest.approx(1.0), "two seeds a row"
    assert best["between"]["between"] == pytest.approx(5.0)
    assert best["between"]["f"] == pytest.approx(25.0)
    assert best["between"]["p"] == pytest.approx(0.0134, abs=1e-4)
    assert best["with_operations"]["rho"] == pytest.approx(-0.4)
    assert (last["between"], last["with_operations"]) == (None, None)
    assert [
        each["with_operations"] for each in paper_noise.differences([row | {"table": "methods"} for row in rows])
    ] == [None] * 4


@given(st.lists(st.lists(st.integers(0, 60), min_size=2, max_size=4), min_size=2, max_size=6))
def test_analysis_of_variance_is_that_of_scipy(groups):
    found = paper_noise.analysis(groups)
    if found is None:
        assert all(len(set(group)) == 1 for group in groups)
    else:
        assert (found["f"], found["p"]) == pytest.approx(tuple(stats.f_oneway(*groups)), rel=1e-6, abs=1e-9)


def test_ranks_are_those_of_counts():
    sums = [0.1 + 0.2 + 0.3, 0.3 + 0.2 + 0.1, 1.0, 2.0]
    assert sums[0] != sums[1]
    assert paper_noise.rank_correlation(sums, [1, 2, 3, 4]) == paper_noise.rank_correlation(
        [6, 6, 10, 20], [1, 2, 3, 4]
    )


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=4, max_size=6))
def test_few_rows_are_told_by_every_order(pairs):
    values, others = zip(*pairs, strict=True)
    found = paper_noise.rank_correlation(values, others)
    if found is None:
        assert len(set(values)) == 1 or len(set(others)) == 1
        return
    rhos = [stats.spearmanr(order, others).statistic for order in itertools.permutations(values)]
    low, high = (np.mean([sign * (rho - found["rho"]) >= -1e-9 for rho in rhos]) for sign in (-1, 1))
    assert found["p"] == pytest.approx(min(1, 2 * min(low, high)))


def test_more_rows_are_told_by_the_distribution():
    rng = np.random.default_rng(0)
    values, others = rng.normal(size=(2, paper_noise.COUNTED + 1))
    assert paper_noise.rank_correlation(values, others)["p"] == pytest.approx(stats.spearmanr(values, others).pvalue)


def test_a_chip_that_takes_some_seeds(tmp_path, capsys):
    """Figures of those that fit are shown as such, and count in no statistics of the chip."""
    cells = [
        made_cell("objects", system, form, 100, seed, (127 - seed, 125 + seed, 126 - seed), chip=chip)
        for system, form in (("mlp", "none"), ("grid-cnn", "none"), ("tactilesgnet", "manual"))
        for seed, chip in enumerate([(119, 120), (120, 121), (118, 119) if system != "grid-cnn" else None])
    ]
    kept(tmp_path, *cells)
    report = as_json(capsys, "reproduce", "--no-train", "-o", str(tmp_path), code=1)
    text = (tmp_path / "methods.md").read_text("utf-8")
    words = "- grid-based CNN: Loihi 1 refuses 1 of 3 seeds, the figures are of the others: "
    assert words + CAPACITY in text
    between = {each["reading"]: each["between"]["rows"] for each in report["methods_differences"]}
    assert between == {"best": 3, "last": 3, "clean": 3, "chip": 2}
    assert main(["reproduce", "--no-train", "-o", str(tmp_path)]) == 1
    assert "82.99 (0.49), 2 of 3 fit" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("values", "others"), [([1, 2, 3], [1, 2, 3]), ([1, 1, 1, 1], [1, 2, 3, 4]), ([1, 2, 3, 4], [1, 1, 1, 1])]
)
def test_no_rank_correlation_of_too_little(values, others):
    assert paper_noise.rank_correlation(values, others) is None


def made_folder(folder: Path) -> Path:
    """Cells of some methods and graphs, not all."""
    cells = [
        made_cell("objects", "tactilesgnet", "manual", 100, seed, (131 - seed, 127 + seed, 126), chip=(126, 127))
        for seed in range(5)
    ]
    cells += [made_cell("objects", "mlp", "none", 100, 0, (124, 120, 121), chip=(119, 121), scale=0.1)]
    cells += [made_cell("objects", "grid-cnn", "same", 100, seed, (127, 125, 126 - seed)) for seed in range(2)]
    cells += [
        made_cell("containers", "tactilesgnet", "manual", 60, seed, (40, 35 + seed, 37), chip=(36, 36))
        for seed in range(3)
    ]
    cells += [
        made_cell("containers", "tactilesgnet", "manual", 100, seed, (41, 36 + seed, 37), chip=(36, 36))
        for seed in range(2)
    ]
    cells += [
        made_cell("containers", "tactilesgnet", "knn:4", 60, seed, (39 + seed, 36, 37), chip=(36, 35), scale=1.3)
        for seed in range(2)
    ]
    cells += [made_cell("containers", "tactilesgnet", "released:knn:4", 60, 0, (40, 36, 37), chip=(36, 35))]
    kept(folder, *cells)
    return folder


def test_markdown_and_csv(tmp_path, golden, capsys):
    assert main(["reproduce", "--no-train", "-o", str(made_folder(tmp_path))]) == 1
    for name in ("methods.md", "methods.csv", "graphs.md", "graphs.csv"):
        golden(name, (tmp_path / name).read_text("utf-8"))


def test_csv_holds_the_figures(tmp_path, capsys):
    report = as_json(capsys, "reproduce", "--no-train", "-o", str(made_folder(tmp_path)), code=1)
    lines = list(csv.DictReader(io.StringIO((tmp_path / "methods.csv").read_text())))
    first, row = lines[0], report["methods"][0]
    assert (first["data"], first["system"], first["form"], first["seeds"]) == (
        "objects",
        "tactilesgnet",
        "manual",
        "0 1 2 3 4",
    )
    assert (float(first["paper_mean"]), float(first["paper_std"])) == (89.44, 0.55)
    assert float(first["best_mean"]) == pytest.approx(row["best"]["mean"], abs=1e-3)
    assert first["within"] == "True"
    assert first["energy_davies2018_j"] == "0.0002"
    missing = next(line for line in lines if line["system"] == "gcn" and line["data"] == "objects")
    assert (missing["seeds"], missing["best_mean"], missing["synaptic_operations"]) == ("", "", "")
    same = next(line for line in lines if line["form"] == "same")
    assert same["chip_refused"] == CAPACITY
    assert len({tuple(line) for line in lines}) == 1


def test_pictures_show_what_is_there_and_are_equal_for_equal_cells(tmp_path, monkeypatch):
    monkeypatch.setattr("spikeloom.runtime.studies.paper.picture.DPI", 30)
    cells = read_cells(made_folder(tmp_path))
    parts = plan(["objects", "containers"], ("methods", "graphs"))
    for part in parts:
        rows = paper_table.rows(part, cells)
        found = paper_picture.pictures(part.table, rows)
        assert found == paper_picture.pictures(part.table, rows)
        assert all(content[:4] == b"\x89PNG" for content in found.values())
        nothing = paper_picture.pictures(part.table, paper_table.rows(part, {}))
        assert all(content != nothing[name] for name, content in found.items())
    assert paper_picture.pictures("graphs", []) == {}


def test_the_paper_is_compared_on_its_recordings_only(tmp_path, capsys):
    for seed in range(2):
        kept(
            tmp_path, made_cell("objects", "mlp", "none", 100, seed, (124, 120, 121), chip=(119, 121), sha256="0" * 64)
        )
    report = as_json(capsys, "reproduce", "--no-train", "--table", "methods", "-o", str(tmp_path), code=1)
    row = next(row for row in report["methods"] if row["system"] == "mlp")
    assert row["paper"] is None
    assert row["comparison"] is None
    assert paper_text.paper_words(row) == "not available here"


# --- mistakes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--seeds", "0"], "--seeds 0: allowed are 1 or more; choose another"),
        (["--epochs", "0"], "--epochs 0: allowed are 1 or more; choose another"),
        (["--jobs", "-1"], "--jobs -1: allowed are 1 or more; choose another"),
        (
            ["--scheduler", "tcp://h:1"],
            "--jobs 1: counts processes on this machine, --scheduler has workers of its own; leave one away",
        ),
        (["--scheduler", "h:1"], "--scheduler h:1: is no address; give one as in tcp://10.0.0.1:8786"),
        (["--full", "--seeds", "3"], "--seeds 3: --full says how many; leave one of them away"),
        (["--full", "--epochs", "3"], "--epochs 3: --full says how many; leave one of them away"),
        (["--table", "x"], "--table x: unknown; choose from methods, graphs"),
        (
            ["--table", "methods", "--graph", "knn:1"],
            "--graph: chooses rows of the table of graphs; leave it or --table methods away",
        ),
        (
            ["--table", "graphs", "--same-padding"],
            "--same-padding: adds a row to the table of methods; leave it or --table graphs away",
        ),
        (
            ["--graph", "knn:9"],
            "graph 'knn:9': K is '9', allowed are whole numbers 1..8; choose another K",
        ),
        (
            ["--data", "more/Ev-Grasps"],
            "--data more/Ev-Grasps: is called grasps as Ev-Grasps is; give each data set once",
        ),
        (["--device", "tpu"], "--device tpu: unknown; allowed: cpu, cuda"),
        (
            ["--data", "none.zip"],
            "none.zip: no such file or folder; give the folder or zip that holds train/ and test/",
        ),
    ],
)
def test_wrong_options(data, capsys, words, line):
    assert refused(capsys, *WORDS, *words) == line
    assert not Path("out").exists()


def test_wrong_places_and_no_data(data, capsys):
    assert refused(capsys, "reproduce", "-o", "out") == "reproduce: no data set; name one or more with --data"
    assert refused(capsys, "reproduce", "--no-train", "-o", "out") == (
        "-o out: holds no cells to make tables of; name a data set with --data"
    )
    Path("file").write_text("")
    assert refused(capsys, "reproduce", "--data", "Ev-Grasps", "-o", "file") == (
        "-o file: is not a folder; give the name of one"
    )
    assert refused(capsys, "reproduce", "--data", "Ev-Grasps", "-o", "none/out") == (
        "-o none/out: the folder that it shall be in does not exist; make it first"
    )


def test_cells_of_other_recordings_are_not_mixed(data, capsys):
    as_json(capsys, *METHODS)
    Path("others").mkdir()
    made(data / "others" / "Ev-Grasps", first=7)
    words = [word if word != "Ev-Grasps" else "others/Ev-Grasps" for word in METHODS]
    assert refused(capsys, *words, "--resume") == (
        f"out/cells/{GCN_NAME}.json: is of other recordings named grasps; give those, or another -o"
    )


def test_damaged_cells_are_named(tmp_path, capsys):
    cell = made_cell("objects", "mlp", "none", 100, 0, (1, 1, 1), chip=(1, 1))
    kept(tmp_path, cell)
    (file,) = (tmp_path / "cells").iterdir()
    line = f"{file}: no cell of that name, or one of another version; delete it to measure anew"
    last, chip = cell["last"], cell["chip"]
    others = [{"seed": 1}, {"format": 2}, {"decay_epochs": 12}]
    others += [{"last": last | {"correct": correct}} for correct in ("x", 9999, -1, 2, 1.0)]
    others += [
        {"chip": chip | {"last": chip["last"] | {"energy_j": {"sanafe": 1.0}}}},
        {"chip": {"last": chip["last"]}},
    ]
    for content in ("", "[]", "{}", '{"format": 1}', *(json.dumps(cell | other) for other in others)):
        file.write_text(content)
        assert refused(capsys, "reproduce", "--no-train", "-o", str(tmp_path)) == line


def test_cells_of_two_data_sets_of_one_name_are_refused(tmp_path, capsys):
    one = made_cell("objects", "mlp", "none", 100, 0, (1, 1, 1), chip=(1, 1))
    kept(
        tmp_path, one, made_cell("objects", "mlp", "none", 100, 1, (1, 1, 1), chip=(1, 1), samples=60, sha256="0" * 64)
    )
    first, second = sorted((tmp_path / "cells").iterdir())
    assert refused(capsys, "reproduce", "--no-train", "-o", str(tmp_path)) == (
        f"{second}: is of other recordings named objects than {first.stem}; keep those of one data set"
    )


def test_names_of_cells_are_those_of_files():
    row = Row(data="objects", system="tactilesgnet", form="released:mst:3.5", epochs=60)
    assert row.cell(0) == "objects-tactilesgnet-released-mst-3.5-e60-s0"
    assert row.words() == ["--graph", "released:mst:3.5", "--epochs", "60"]
    same = Row(data="objects", system="grid-cnn", form="same", epochs=100)
    assert same.words() == ["--system", "grid-cnn", "--padding", "same", "--epochs", "100"]
