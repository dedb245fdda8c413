"""What a verdict says: levels, gates, ways to fail by name, and whether a netlist is its checkpoint, rounded."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_files import CLASSES, TAXELS, events, own_file, small_checkpoint, weights
from random_networks import chain

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.passes.expand import Factored, expand
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.runtime.equivalence.breakdowns import breakdowns
from spikeloom.runtime.equivalence.rounding import Rounding, check_rounding
from spikeloom.runtime.equivalence.verdict import (
    LayerSpikes,
    Level,
    levels_of,
    mcnemar,
    parse_requirements,
    spike_agreement,
    unmet,
)
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.machines.base import machine_of
from spikeloom.runtime.machines.integer import integer_machine


# -- levels ------------------------------------------------------------------------------------------------------------
def layer(float_: int, chip: int, different: int) -> LayerSpikes:
    return LayerSpikes(float=float_, chip=chip, different=different, ill_posed=0)


def verdict(**changes):
    base = {
        "files": ("a", "b", "c", "d"),
        "labels": np.array([0, 1, 1, 0]),
        "float_predictions": np.array([0, 1, 0, 0]),
        "chip_predictions": np.array([0, 1, 1, 1]),
        "float_counts": np.array([[3, 0], [1, 2], [2, 1], [4, 0]]),
        "chip_counts": np.array([[3, 0], [1, 3], [1, 2], [1, 2]]),
        "spikes": {"conv1": layer(60, 40, 20), "fc1": layer(10, 10, 1)},
        "spec_samples": 3,
        "spec_equals_engine": True,
        "decision_agreement": 0.5,
        "quantised_different": None,
        "engine": "spikeloom",
        "engine_different": None,
        "weights": Rounding(layers={}),
    }
    return SimpleNamespace(**(base | changes))


def test_levels_of_a_verdict():
    for changes, e0, e1 in (
        ({}, 1.0, None),
        ({"spec_equals_engine": False}, 0.0, None),
        ({"quantised_different": 3}, 1, 0),
    ):
        levels = {level.name: level.share for level in levels_of(verdict(**changes))}
        assert levels == {"EN": 1.0, "E0": e0, "E1": e1, "E2": 0.8, "E3": 0.5}
    assert levels_of(verdict(quantised_different=0))[2].share == 1.0
    text = levels_of(verdict())[4].text
    assert "right on float only 1, on chip only 1 (exact McNemar p = 1); class votes moved: 8 of 13" in text
    silent, disjoint = layer(0, 0, 0), layer(5, 5, 10)
    assert (spike_agreement(silent), spike_agreement(disjoint)) == (1.0, 0.0)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=30))
def test_the_paired_test_is_symmetric_and_a_probability(pairs):
    labels = np.zeros(len(pairs), int)
    first, second = (np.array([not pair[i] for pair in pairs], int) for i in (0, 1))
    a, b, p = mcnemar(labels, first, second)
    assert (b, a, p) == mcnemar(labels, second, first)
    assert 0 < p <= 1
    assert a == sum(x and not y for x, y in pairs)
    if a == b:
        assert p == 1


def test_requirements_are_read_and_held_against_levels():
    assert parse_requirements("E0,E1,E2=0.99,E3=1") == {"E0": 1.0, "E1": 1.0, "E2": 0.99, "E3": 1.0}
    levels = (Level(name="E1", share=None, text="not applicable"), Level(name="E2", share=0.98, text=""))
    assert unmet(levels, {"E1": 1.0, "E2": 0.99}) == ["E1: not applicable", "E2: 0.9800 reached, 0.99 required"]
    assert unmet(levels, {"E2": 0.98}) == []
    assert unmet(levels, {}) == []


@pytest.mark.parametrize(
    ("words", "why"),
    [
        *((words, "give each of EN, E0, E1, E2=SHARE, E3=SHARE once at most") for words in ("E4", "E0,E0")),
        ("E2", "needs a share, as in E2=0.98"),
        ("E0=1", "takes no share"),
        *((f"E3={share}", "give a number from 0 to 1") for share in ("2", "nan")),
    ],
)
def test_gates_that_cannot_be_read(words, why):
    with pytest.raises(OptionError, match=f"^--require {words}: '{words.split(',')[-1]}': .*{why}"):
        parse_requirements(words)


# -- breakdowns --------------------------------------------------------------------------------------------------------

FILES = tuple("abcdef")
LABELS = np.arange(6) % CLASSES


def found(before, after, *, votes=None):
    """Breakdowns of one layer ``fc`` whose neurons 0 and 2 to 4 are compared."""
    votes = votes or (np.array([[3, 1], [1, 3]]), np.array([[3, 1], [1, 3]]))
    compared = [np.array([0, 2, 3, 4])]
    made = breakdowns(["fc"], [before], [after], compared, votes, FILES[: len(votes[0])])
    return [(b.kind, b.layer, b.count, b.text) for b in made]


def spikes(*counts):
    """Of each of the four, over all recordings."""
    return np.array([*counts, *[0] * (4 - len(counts))])


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ((20, 0, 3, 1), (20, 0, 3, 1), []),
        ((9, 0, 5, 0), (), [("silent layer", "fc", 14)]),
        ((9,), (), []),  # too few to speak of
        ((11, 9, 20, 0), (0, 0, 0, 10), [("silenced neurons", "fc", 2), ("woken neurons", "fc", 1)]),
    ],
)
def test_neurons_that_fall_silent_or_wake_up(before, after, expected):
    made = found(spikes(*before), spikes(*after))
    assert [breakdown[:3] for breakdown in made] == expected
    if len(made) == 2:  # neurons by their numbers in the layer, the busiest first
        assert made[0][3].endswith(": 3 (20 times), 0 (11 times)")
        assert made[1][3].endswith(": 4 (10 times)")


VOTED = np.array([[3, 1], [1, 3], [0, 2], [2, 0]])


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (VOTED[:3], [[1, 2], [1, 3], [0, 2]], [("one class", None, 3)]),
        (VOTED[1:3], VOTED[1:3], []),  # as the float model does
        (VOTED, [[0, 0], [1, 3], [0, 2], [2, 2]], [("no vote", None, 1), ("tied votes", None, 1)]),
    ],
)
def test_votes_that_decide_little(before, after, expected):
    made = found(spikes(), spikes(), votes=(before, np.array(after)))
    assert [breakdown[:3] for breakdown in made] == expected
    assert len(made) < 2 or (made[0][3].endswith("(a)") and made[1][3].endswith("(d)"))


def verified(folder, arrays, recordings, packing, **options):
    checkpoint, adjacency = small_checkpoint(folder, last=arrays)
    netlist = compile_network(expand(checkpoint, adjacency), Options(packings=(packing,), **options)).netlist
    made = verify(netlist, Factored(checkpoint, adjacency), recordings, LABELS, FILES)
    return {breakdown.kind: breakdown for breakdown in made.breakdowns}


@pytest.mark.parametrize("bits", [4, 8])
def test_a_neuron_that_fires_by_a_hair_from_its_bias_alone(tmp_path, bits):
    """Bias 0.400005 ends at 0.500006, above the threshold: eight bits find a scale that keeps it, four do not."""
    arrays = weights()
    arrays["fc2.weight"][3], arrays["fc2.bias"][3] = 0, 0.400005
    recordings = events(2, steps=60)
    kinds = verified(tmp_path, arrays, recordings, Packing(bits=bits), keep_all=True, training_events=events(1))
    assert ("silenced neurons" in kinds) == (bits == 4)
    assert bits == 8 or "fc2 neurons that fire in the float model" in kinds["silenced neurons"].text


def test_a_network_that_rounding_silences(tmp_path):
    """A weight that never sees a spike sets the scale; at two bits nothing is left beside it."""
    arrays = weights()
    arrays["fc3.weight"][:, 0] = 60.0
    arrays["fc2.weight"][0], arrays["fc2.bias"][0] = 0, 0
    kinds = verified(tmp_path, arrays, events(2), Packing(bits=2), keep_all=True)
    assert kinds["silent layer"].layer == "fc3"
    assert kinds["no vote"].count == 6


def compiled(network, **options):
    return compile_network(network, Options(**options)).netlist


def checked(netlist, network, **provenance):
    netlist = dataclasses.replace(netlist, provenance=netlist.provenance | provenance)
    return check_rounding(integer_machine(machine_of(netlist)), network)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    return expand(*small_checkpoint(tmp_path_factory.mktemp("small")))


@pytest.fixture(scope="module", params=[2, 8])
def netlist(request, network):
    return compiled(network, packings=(Packing(bits=request.param),))


PACKINGS = [Packing(bits=b, planes=p, groups=g) for b, p, g in [(2, 1, 1), (3, 3, 1), (5, 2, 4), (8, 1, 8), (8, 2, 1)]]


@pytest.mark.parametrize(("packing", "keep_all"), [*zip(PACKINGS, [True, False] * 3, strict=False)])
def test_what_the_compiler_makes_is_the_rounding_of_what_it_got(network, packing, keep_all):
    netlist = compiled(network, packings=(packing,), keep_all=keep_all)
    found = checked(netlist, network)
    assert found.holds
    assert (
        found.text == "every connection, weight, bias, threshold and decay is the checkpoint's, rounded to the nearest"
    )
    for layer, population in zip(found.layers.values(), network.populations, strict=True):
        assert 0 < layer.nearest == layer.weights <= population.size**2 * 20
        assert 0 < layer.farthest_steps <= 0.5 + 1e-9 or packing.planes > 1


@pytest.mark.parametrize("options", [{}, {"spike_exact": True}, {"prune_unused": True}])
def test_rounding_on_recordings_need_not_be_the_nearest(network, options):
    netlist = compiled(network, training_events=events(1, samples=40), provenance=options, **options)
    found = checked(netlist, network)
    assert found.holds
    moved = [name for name, layer in found.layers.items() if layer.nearest < layer.weights]
    assert moved == [name for name, layer in found.layers.items() if layer.compensated]
    assert all(f"{name} " in found.text for name in moved)
    assert moved or options.get("spike_exact")
    assert checked(netlist, network, compensated=[]).holds == (not moved)


def test_weights_that_the_range_cuts_off_are_at_its_end(tmp_path):
    network = chain([[1.0, 0.3, -0.2]])
    netlist = compiled(network)
    clipped = chain([[1000.0, 0.3, -0.2]])  # at the same scale
    assert checked(netlist, network).holds
    assert checked(netlist, clipped).holds == (np.abs(netlist.synapse_weight).max() == 254)


def change(netlist, field, place, by):
    values = getattr(netlist, field).copy()
    values[place] += by
    return dataclasses.replace(netlist, **{field: read_only(values)})


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(st.data())
def test_every_single_change_is_found(netlist, network, data):
    field = data.draw(st.sampled_from(["synapse_weight", "bias_mantissa", "threshold", "decay_v", "decay_u"]))
    values = getattr(netlist, field)
    if field.startswith("decay"):
        layer = data.draw(st.integers(0, len(netlist.layers) - 1))
        place = netlist.compartments_of(layer)
        by = -1 if values[place[0]] == 4095 else data.draw(st.sampled_from([-1, 1]))
    else:
        place = data.draw(st.integers(0, len(values) - 1))
        step = 512 >> netlist.layers[0].weight_bits if field == "synapse_weight" else 1
        by = step * (-1 if values[place] > 0 else 1)
    assert not checked(change(netlist, field, place, by), network).holds


def test_in_a_compensated_layer_biases_make_up_for_no_more_than_the_weights_lose(network):
    netlist = compiled(network, training_events=events(1, samples=40), keep_all=True)
    layers = checked(netlist, network).layers
    index, _ = next((i, each) for i, each in enumerate(layers.values()) if each.compensated)
    place = netlist.compartments_of(index)[0]
    changed = change(netlist, "bias_mantissa", place, 4095 - netlist.bias_mantissa[place])
    assert checked(netlist, network).holds
    assert not checked(changed, network).holds


@pytest.mark.parametrize("calibrated", [False, True])
def test_another_checkpoint_graph_or_neuron_model(tmp_path, calibrated):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    training = events(1, samples=40) if calibrated else None
    netlist = compiled(expand(checkpoint, adjacency), training_events=training)
    other, _ = small_checkpoint(tmp_path, last=weights(9))
    edges = np.array([[0, 2], [2, 0], [1, 3], [3, 1], [4, 5], [5, 4]])
    for network in (
        expand(other, adjacency),
        expand(checkpoint, normalised_adjacency(edges, TAXELS)),
        expand(dataclasses.replace(checkpoint, beta=0.3), adjacency),
        expand(dataclasses.replace(checkpoint, theta=0.4), adjacency),
    ):
        assert not checked(netlist, network).holds


def test_verify_fails_where_the_weights_are_not_the_checkpoints(spikeloom, place):
    own_file(place / "other.pt", last=weights(7))
    words = ("verify", "net.loom", "--data", "data", "--min-agreement", "0", "--checkpoint", "other.pt")
    code, out, _ = spikeloom(*words)
    assert code == 1
    assert "\nEN  NOT the rounding of this checkpoint: conv1 has " in out
    assert "\nmissed: EN: NOT the rounding" in out
