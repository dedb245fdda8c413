"""The command ``explain``: what it prints, and what it refuses."""

import json

import numpy as np
import pytest
from made_files import CLASSES, FEATURES, STEPS, TAXELS, own_file, recordings_folder, weights

from spikeloom.compiler import Options, Recipe, compile_network
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime import cli
from spikeloom.runtime.equivalence.explanation.causes import RootCause, explain, observe
from spikeloom.runtime.equivalence.explanation.deviations import (
    BETA,
    BIAS,
    CAUSES,
    LEFT_OUT,
    SATURATION,
    THRESHOLD,
    TIE,
    TRUNCATION,
    UNKNOWN,
    WEIGHTS,
)
from spikeloom.runtime.equivalence.explanation.roots import Root
from spikeloom.runtime.equivalence.explanation.summary import remedy
from spikeloom.runtime.machines.integer import integer_machine_of
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned

EXPLAIN = ("explain", "net.loom", "--checkpoint", "net.pt", "--data", "data")
SIZES = {"conv1": TAXELS * FEATURES, "fc1": 9, "fc2": 8, "fc3": CLASSES}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, two checkpoints, and a 4-bit netlist of the first."""
    folder = tmp_path_factory.mktemp("explain")
    recordings_folder(folder / "data")
    own_file(folder / "net.pt")
    own_file(folder / "other.pt", last=weights(7))
    own_file(folder / "wide.pt", last=weights(sizes=(10, 8, CLASSES)))
    words = ["compile", folder / "net.pt", "--weight-bits", "4", "--keep-all", "-o", folder / "net.loom", "--json"]
    assert cli.main([str(word) for word in words]) == 0
    return folder


@pytest.fixture
def report(spikeloom):
    """Explain with ``--json``; returns the object."""

    def command(*words):
        code, out, err = spikeloom(*EXPLAIN, *words, "--json")
        assert (code, err) == (0, "")
        assert out.count("\n") == 1
        return json.loads(out)

    return command


def test_the_report_counts_what_the_engine_and_the_float64_model_do(report, place):
    found = report("--sample", "sample_2_label_2.npy")
    netlist, checkpoint = read_netlist(place / "net.loom"), read_checkpoint(str(place / "net.pt"))
    recording = np.load(place / "data" / "test" / "sample_2_label_2.npy").astype(np.uint8)[None]
    network = expand(checkpoint, normalised_adjacency(checkpoint.edges, checkpoint.taxels))
    truth = run_float(network, channels_last(recording)).spikes
    trace = engine.simulate(netlist, recording.reshape(1, -1, STEPS), spikes=True)
    for i, layer in enumerate(found["layers"]):
        chip = aligned(netlist, trace.spikes, i)
        assert layer["name"] == netlist.layers[i].name
        assert (layer["float_spikes"], layer["chip_spikes"]) == (truth[i].sum(), chip.sum())
        assert layer["different"] == (truth[i] != chip).sum() == layer["roots"] + layer["propagated"]
    assert found["different"] == sum(layer["different"] for layer in found["layers"])
    assert found["roots"] == sum(cause["roots"] for cause in found["causes"])
    assert (found["sample"], found["recording"], found["searched"]) == ("sample_2_label_2.npy", 2, 1)
    assert (found["split"], found["steps"], found["graph"], found["reference"]) == ("test", STEPS, "ring", "float64")


def test_every_root_says_where_how_close_why_and_what_to_do(report):
    found = report("--top", "1000")
    assert len(found["top"]) == found["roots"] > 3
    dragged = [root["dragged"] for root in found["top"]]
    assert dragged == sorted(dragged, reverse=True)
    for root in found["top"]:
        assert 0 <= root["neuron"] < SIZES[root["layer"]]
        assert 0 <= root["remembers_from_step"] <= root["step"] < STEPS
        if root["layer"] == "conv1":
            assert root["taxel"] * FEATURES + root["feature"] == root["neuron"]
        else:
            assert (root["taxel"], root["feature"]) == (None, None)
        assert (root["float_distance"] > 0) == root["float_fires"] == (root["chip_distance"] <= 0)
        assert (root["chip_register"] > root["chip_threshold_register"]) != root["float_fires"]
        assert root["float_membrane"] - root["float_distance"] == pytest.approx(root["theta"])
        assert root["cause"] in CAUSES
        assert root["change"]
        assert root["dragged"] >= root["dragged_alone"] >= 0


def test_the_first_recording_that_differs_and_its_first_roots(report):
    whole = report("--top", "1000")
    assert whole["different"]
    assert whole == report("--top", "1000", "--sample", "sample_0_label_0.npy")
    assert report("--top", "2")["top"] == whole["top"][:2]


def test_the_text_fits_a_terminal(spikeloom):
    code, out, err = spikeloom(*EXPLAIN, "--top", "3")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "sample_0_label_0.npy (test split, recording 0 counted from 0)"
    assert all(len(line) < 120 for line in lines)
    assert "diagnosis: weight rounding" in lines
    assert sum(line.startswith("     cause    weight rounding") for line in lines) == 3


def test_equal_spikes_are_said_to_be_equal(spikeloom, tmp_path):
    silent = weights()
    silent = {name: np.zeros_like(array) if "bias" in name else array for name, array in silent.items()}
    own_file(tmp_path / "silent.pt", last=silent)
    recordings_folder(tmp_path / "empty", test=np.zeros((3, TAXELS, 2, STEPS), np.uint8))
    net = tmp_path / "silent.loom"
    assert spikeloom("compile", tmp_path / "silent.pt", "-o", net)[0] == 0
    words = ("explain", net, "--checkpoint", tmp_path / "silent.pt", "--data", tmp_path / "empty")
    end = "every spike of the chip is the float64 model's; nothing to explain\n"
    assert spikeloom(*words) == (0, f"the first 3 recordings of the test split: {end}", "")
    code, out, _ = spikeloom(*words, "--sample", "sample_1_label_1.npy")
    assert (code, out) == (0, f"sample_1_label_1.npy (test split, recording 1 counted from 0): {end}")


def test_a_netlist_of_another_checkpoint_is_said_to_be_one(spikeloom, report):
    code, out, err = spikeloom("explain", "net.loom", "--checkpoint", "other.pt", "--data", "data", "--top", "1")
    assert (code, err) == (0, "spikeloom: warning: the netlist was compiled from another checkpoint file\n")
    assert all(len(line) < 120 for line in out.splitlines())
    assert "\nFAULT of the netlist: fc1 has " in out
    assert not report()["faults"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--top", "0"], ["--top 0", "at least 1"]),
        (["--sample", "sample_9_label_1.npy"], ["among 6 of split test", "near are sample_5_label_1.npy"]),
        (["--sample", "sample_5_label_1.npy", "--limit", "1"], ["among 1 of split test", "near are sample_0_label_0"]),
        (["--checkpoint", "wide.pt"], ["netlist and checkpoint disagree", "fc1 9", "fc1 10"]),
    ],
)
def test_mistakes_are_one_line(spikeloom, words, said):
    code, out, err = spikeloom(*EXPLAIN, *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert all(word in err for word in said)


# -- words -------------------------------------------------------------------------------------------------------------


def root_of(cause, *, clipped=False, held=True) -> RootCause:
    return RootCause(
        root=Root(layer=0, neuron=0, step=0, begin=0, dragged=0, alone=0),
        cause=cause,
        held=held,
        clipped=clipped,
        sufficient=(),
        moved=(),
        float_fires=True,
        float_membrane=0.5,
        chip_membrane=0.5,
        theta=0.5,
        chip_theta=0.5,
        chip_register=1,
        chip_threshold=1,
    )


@pytest.mark.parametrize(
    ("root", "bits", "planes", "words"),
    [
        (root_of(WEIGHTS), 8, 1, "its weights are too coarse: compile fc1 with --planes 2"),
        (root_of(WEIGHTS), 4, 1, "its weights are too coarse: compile fc1 with --weight-bits 8 or --planes 2"),
        (
            root_of(WEIGHTS),
            8,
            3,
            "its weights are too coarse: compile fc1 with --scale-groups 8, as far as the accumulator lets it",
        ),
        (root_of(WEIGHTS, clipped=True), 8, 1, "the range cuts off its largest weights: compile fc1 with --planes 2"),
        (
            root_of(WEIGHTS, held=False),
            8,
            1,
            "no input can make it fire with its rounded weights: compile fc1 with --planes 2",
        ),
        (root_of(LEFT_OUT, held=False), 8, 1, "compile without --prune-unused"),
        (root_of(TIE), 8, 1, "none: the order of a sum in float64 decides here, either spike is right"),
        (root_of(UNKNOWN), 8, 1, "none is known"),
    ],
)
def test_what_would_remove_a_root(root, bits, planes, words):
    assert remedy(root, "fc1", bits=bits, planes=planes) == words


@pytest.mark.parametrize("cause", [BIAS, THRESHOLD, BETA, TRUNCATION, SATURATION, LEFT_OUT])
def test_every_cause_has_a_change(cause):
    assert remedy(root_of(cause), "fc1", bits=8, planes=1) != "none is known"


# -- the released network ----------------------------------------------------------------------------------------------


@pytest.mark.recordings
def test_a_released_recording_is_explained(released_checkpoint, objects_zip):
    checkpoint = read_checkpoint(released_checkpoint)
    adjacency = normalised_adjacency(build_graph("manual").edges, checkpoint.taxels)
    netlist = compile_network(expand(checkpoint, adjacency), Options(recipes=(Recipe(),))).netlist
    recording = load_data(objects_zip, "test", limit=4)[0].events[3:4]
    network, machine = expand(checkpoint, adjacency), integer_machine_of(netlist)
    found = explain(
        network,
        machine.integer,
        channels_last(recording)[0],
        observe(machine, recording),
        absent=machine.absent,
        unused=machine.unused,
    )
    assert sum(found.different) > 1000
    assert {root.cause for root in found.roots} <= set(CAUSES)
    weights = sum(root.cause == WEIGHTS for root in found.roots)
    assert weights > 0.9 * len(found.roots)
