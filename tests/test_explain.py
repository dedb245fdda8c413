"""Why spikes differ: roots and what follows, one cause at a time, and the command ``explain``."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import CLASSES, FEATURES, STEPS, TAXELS, own_file, weights
from random_networks import chain, integer_chain, with_population

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.ir import Form
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.compiler.targets.loihi1.storage.choose_storage import round_to_forms
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.runtime import cli
from spikeloom.runtime.equivalence.explanation.causes import explain
from spikeloom.runtime.equivalence.explanation.roots import Root, find_roots
from spikeloom.runtime.machines.deviations import BETA, BIAS, LEFT_OUT, SATURATION, TIE, TRUNCATION, WEIGHTS
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.changes.deviations import LoihiDeviations
from spikeloom.runtime.machines.loihi1.trace import aligned


def steps(*words):
    """Booleans (steps, neurons or channels) from one word a step."""
    return np.array([[letter == "x" for letter in word] for word in words])


def test_an_entry_with_agreeing_inputs_is_a_root_and_those_that_drag_most_come_first():
    all_to_all = ((), ((0, np.ones((2, 2), bool)),))
    differs = [steps("xx", "..", ".x"), steps("..", "..", "x.")]
    found = find_roots(differs, [np.zeros_like(each) for each in differs], all_to_all)
    second, first = (
        Root(layer=0, neuron=1, step=0, begin=0, dragged=2, alone=1),
        Root(layer=0, neuron=0, step=0, begin=0, dragged=1, alone=0),
    )
    assert found == (second, first)


def test_a_synapse_counts_if_it_is_there_on_either_side():
    network = chain([[1.0, 1.0]], [[0.5]], [[0.0], [0.25]])
    integer = integer_chain([[2, 2]], [[0]], [[2], [0]])
    first, second, third = LoihiDeviations(network=network, integer=integer).sources
    assert first == ()
    assert [(pre, connected.tolist()) for pre, connected in second] == [(0, [[True]])]
    assert [(pre, connected.tolist()) for pre, connected in third] == [(1, [[True, True]])]


@st.composite
def difference_graphs(draw):
    """Layers that receive from the one before, some from themselves, too."""
    sizes = draw(st.lists(st.integers(1, 3), min_size=1, max_size=3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    density, connected = draw(st.sampled_from([0.1, 0.3, 0.6])), draw(st.sampled_from([0.5, 1.0]))
    differs = [rng.random((draw(st.integers(1, 7)), size)) < density for size in sizes[:1]]
    differs += [rng.random((len(differs[0]), size)) < density for size in sizes[1:]]
    resets = [(rng.random(d.shape) < 0.3) & ~d for d in differs]
    sources = [
        [(post, post)] * draw(st.booleans()) + [(post - 1, post)] * (post > 0) for post in range(len(sizes))
    ]
    return (
        differs,
        resets,
        tuple(
            tuple((pre, rng.random((sizes[pre], sizes[post])) < connected) for pre, post in sorted(into))
            for into in sources
        ),
    )


def by_definition(differs, resets, sources):
    """Roots of every entry, and the step from which it remembers, found by looking at all that it remembers."""
    roots, begins = {}, {}
    for step in range(len(differs[0])):
        for layer, differing in enumerate(differs):
            for neuron in np.flatnonzero(differing[step]).tolist():
                entry = layer, neuron, step
                since = begins[entry] = max(
                    [t + 1 for t in range(step) if resets[layer][t, neuron]], default=0
                )
                parents = [(layer, neuron, t) for t in range(since, step) if differing[t, neuron]]
                for pre, connected in sources[layer]:
                    # spikes of the layer itself arrive a step later
                    arriving = range(max(since - 1, 0), step) if pre == layer else range(since, step + 1)
                    parents += [
                        (pre, j, t)
                        for j in np.flatnonzero(connected[:, neuron]).tolist()
                        for t in arriving
                        if differs[pre][t, j]
                    ]
                roots[entry] = set().union(*(roots[p] for p in parents)) if parents else {entry}
    return roots, begins


@given(difference_graphs())
def test_one_pass_finds_what_the_definition_says(graph):
    expected, begins = by_definition(*graph)
    found = find_roots(*graph)
    assert {(r.layer, r.neuron, r.step): (r.begin, r.dragged, r.alone) for r in found} == {
        entry: (
            begins[entry],
            sum(entry in held for held in expected.values()) - 1,
            sum(held == {entry} for held in expected.values()) - 1,
        )
        for entry, held in expected.items()
        if entry in held
    }
    assert list(found) == sorted(found, key=lambda r: (-r.dragged, r.step, r.layer, r.neuron))


def stored_as(network, thresholds, exponents=(0,)):
    """Integer network with given thresholds, one for each population."""
    forms = [
        Form(bits=8, exponents=exponents, threshold=np.full(population.size, threshold))
        for population, threshold in zip(network.populations, thresholds, strict=True)
    ]
    return round_to_forms(network, forms)[0]


def explained(network, integer, events, compensated=(), **options):
    """Explain what an intact machine does with one recording."""
    deviations = LoihiDeviations(network=network, integer=integer, compensated=compensated)
    nobody = [np.zeros(population.size, np.bool_) for population in network.populations]
    known = {"absent": nobody, "unread": nobody, "pruned": False} | options
    return explain(network, deviations, events, run_integer(integer, events[None], membranes=True), **known)


def test_equal_spikes_have_no_diagnosis():
    network = chain([[1.0]])
    found = explained(network, stored_as(network, [2]), steps("x", "."))
    layer = found.layers[0]
    assert (layer.float_spikes, layer.chip_spikes, layer.different, layer.propagated) == (1, 1, 0, 0)
    assert (found.found, found.diagnosis, found.different) == ((), None, 0)


@pytest.mark.parametrize(
    ("network", "stored", "words", "cause", "step", "registers", "moved"),
    [
        # four units a membrane unit, weights in steps of two: 0.55 becomes 0.5, which is the threshold
        (chain([[0.55]]), ([2],), "x", WEIGHTS, 0, (128, 128), 0.05),
        # the range cuts the larger weight off
        (chain([[100.0, -70.0]]), ([2],), "xx", WEIGHTS, 0, (0, 128), 30),
        # 0.5005 is 128.128 of a register whose threshold is 128
        (chain([[0.0]], biases=[[0.5005]]), ([2],), ".", BIAS, 0, (128, 128), 0.0005),
        # 0.3 is realised as 1229/4096, a little more
        (
            chain([[0.49, 0.352]], beta=0.3, biases=[[97 / 128000]]),
            ([1000], (0, 7)),
            "x. .x",
            BETA,
            1,
            (64001, 64000),
            None,
        ),
        # 128, 32, 8, 2, and then nothing instead of a half
        (chain([[0.5]], beta=0.25), ([2],), "x . . . x", TRUNCATION, 4, (128, 128), 0.5 / 256),
        # the register ends at -65.5 membrane units, the float model goes down to -80
        (
            chain([[-16.0, 16.0]], beta=1.0),
            ([1000], (7,)),
            "x. x. x. x. x. .x .x .x .x .x",
            SATURATION,
            9,
            None,
            None,
        ),
        # 0.1 + 0.2 > 0.3 in float64; on the chip 10 + 20 are not more than 30
        (chain([[0.1, 0.2]], theta=0.3), ([30],), "xx", TIE, 0, (1920, 1920), None),
    ],
)
def test_the_only_deviation_is_the_cause(network, stored, words, cause, step, registers, moved):
    found = explained(network, stored_as(network, *stored), steps(*words.split()))
    (root,) = found.found
    assert found.diagnosis == root.cause == cause
    assert (root.step, root.remembers_from_step, root.held) == (step, 0, True)
    assert root.sufficient == (cause,) or cause == TIE
    assert root.clipped_weights == (network.projections[0].weight.max() == 100)
    assert registers is None or (root.chip_register, root.chip_threshold_register) == registers
    assert (
        (root.float_distance > 0) == root.float_fires == (root.chip_register <= root.chip_threshold_register)
    )
    assert root.chip_membrane - root.chip_theta == root.chip_distance
    if moved is not None:
        assert root.moved == {cause: pytest.approx(moved)}


def test_the_largest_of_several_deviations_is_the_cause():
    # either alone would do, the weight's share is larger
    network = chain([[0.55]], biases=[[0.0005]])
    (root,) = explained(network, stored_as(network, [2]), steps("x")).found
    assert (root.cause, root.sufficient) == (WEIGHTS, (WEIGHTS, BIAS))


def test_what_moved_most_is_named_where_no_single_change_is_enough():
    # 0.55 is stored as 0.5, and a bias of -30/256 is not the model's: without either the register stays below 128
    network = chain([[0.55]])
    integer = with_population(stored_as(network, [2]), 0, bias_mantissa=np.array([-30]))
    (root,) = explained(network, integer, steps("x")).found
    assert (root.cause, root.sufficient) == (BIAS, ())
    assert list(root.moved.items()) == [(BIAS, pytest.approx(30 / 256)), (WEIGHTS, pytest.approx(0.05))]
    # in a compensated layer the bias goes with the weights
    (together,) = explained(network, integer, steps("x"), compensated=["fc1"]).found
    assert together.moved == {WEIGHTS: pytest.approx(0.05 + 30 / 256)}


@pytest.mark.parametrize("fields", [{"decay_v": 2000}, {"decay_u": 3000}])
def test_a_decay_of_another_network_is_a_decay(fields):
    network = chain([[0.4]])
    integer = with_population(stored_as(network, [100]), 0, **fields)
    assert [root.cause for root in explained(network, integer, steps("x", "x")).found] == [BETA]


def test_roots_after_a_common_reset_start_from_rest():
    network = chain([[0.55, 2.0]])
    found = explained(network, stored_as(network, [2]), steps("x.", ".x", "x."))
    assert [(r.step, r.remembers_from_step, r.cause) for r in found.found] == [
        (0, 0, WEIGHTS),
        (2, 2, WEIGHTS),
    ]


def test_what_follows_is_no_root():
    network = chain([[0.55]], [[1.0]])
    found = explained(network, stored_as(network, [2, 2]), steps("x"))
    assert [(layer.different, layer.roots, layer.propagated) for layer in found.layers] == [
        (1, 1, 0),
        (1, 0, 1),
    ]
    (root,) = found.found
    assert (root.layer, root.dragged, root.dragged_alone) == ("fc1", 1, 1)
    (cause,) = found.causes
    assert (cause.roots, cause.layers, cause.from_clipped_weights) == (1, {"fc1": 1, "fc2": 0}, 0)


def test_a_neuron_that_was_left_out():
    network = chain([[1.0], [1.0]], [[0.3, 0.3]])
    integer = stored_as(network, [2, 4])
    zero = [p.weight.copy() for p in integer.projections]
    zero[0].data[1] = zero[1].data[1] = 0
    projections = tuple(
        dataclasses.replace(p, weight=w) for p, w in zip(integer.projections, zero, strict=True)
    )
    integer, absent = dataclasses.replace(integer, projections=projections), ([False, True], [False])
    absent = tuple(map(np.array, absent))
    silenced = explained(network, integer, steps("x"), absent=absent).found[0]
    assert (silenced.cause, silenced.held, silenced.chip_membrane) == (WEIGHTS, False, None)
    (root,) = explained(network, integer, steps("x"), absent=absent, pruned=True).found
    assert (root.cause, root.layer, root.neuron, root.dragged) == (LEFT_OUT, "fc1", 1, 1)
    assert explained(network, integer, steps("x"), absent=absent, unread=absent).layers[0].different == 0


EXPLAIN = ("explain", "net.loom", "--checkpoint", "net.pt", "--data", "data")
SIZES = {"conv1": TAXELS * FEATURES, "fc1": 9, "fc2": 8, "fc3": CLASSES}


@pytest.fixture(scope="module")
def place(place):
    """The folder with another checkpoint, and a netlist of 4 bits."""
    own_file(place / "other.pt", last=weights(7))
    words = [
        "compile",
        place / "net.pt",
        "--weight-bits",
        "4",
        "--keep-all",
        "-o",
        place / "net.loom",
        "--json",
    ]
    assert cli.main([str(word) for word in words]) == 0
    return place


@pytest.fixture
def report(as_json):
    return lambda *words: as_json(*EXPLAIN, *words)


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
    assert (found["split"], found["steps"], found["graph"], found["reference"]) == (
        "test",
        STEPS,
        "ring",
        "float64",
    )


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
        assert root["cause"] in (WEIGHTS, BIAS, BETA, TRUNCATION, SATURATION, TIE)
        assert root["change"]
        assert root["dragged"] >= root["dragged_alone"] >= 0


def test_the_first_recording_that_differs_and_its_first_roots(report):
    whole = report("--top", "1000")
    assert whole["different"]
    assert whole == report("--top", "1000", "--sample", "0")
    assert whole == report("--top", "1000", "--sample", "sample_0_label_0.npy")
    assert report("--top", "2")["top"] == whole["top"][:2]
