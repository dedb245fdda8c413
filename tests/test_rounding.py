"""Whether a netlist is its checkpoint, rounded: intact ones are; whatever is changed in one is found."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_files import TAXELS, events, own_file, recordings_folder, small_checkpoint, weights
from random_networks import chain

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.runtime.equivalence.rounding import check_rounding
from spikeloom.runtime.machines.integer import integer_machine_of


def compiled(network, **options):
    return compile_network(network, Options(**options)).netlist


def checked(netlist, network, **provenance):
    netlist = dataclasses.replace(netlist, provenance=netlist.provenance | provenance)
    return check_rounding(integer_machine_of(netlist), network)


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
    assert found.text == "every weight, bias, threshold and decay is the checkpoint's, rounded to the nearest"
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


def test_words(network):
    netlist = compiled(network, packings=(Packing(bits=8),), keep_all=True)

    def faults(changed):
        found = checked(changed, network)
        assert found.text.startswith("NOT the rounding of this checkpoint: ")
        return [fault for layer in found.layers.values() for fault in layer.faults]

    first = netlist.compartments_of(1)[0]
    (fault,) = faults(change(netlist, "threshold", first, 3))
    assert fault.startswith(f"fc1 neuron {netlist.neuron[first]} has threshold {netlist.threshold[first] + 3} instead")
    (fault,) = faults(change(netlist, "decay_v", netlist.compartments_of(2), -5))
    assert fault == "fc2 has decay registers 4095 and 3272 instead of 4095 and 3277"
    (fault,) = faults(change(netlist, "bias_mantissa", first, 40))
    assert fault == "fc1 has 1 of 9 biases that are not"
    largest = int(np.argmax(np.abs(netlist.synapse_weight)))
    (fault,) = faults(change(netlist, "synapse_weight", largest, -6 * np.sign(netlist.synapse_weight[largest])))
    assert "1 of " in fault
    assert "weights that are not the nearest, off by up to " in fault


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


@pytest.fixture
def place(tmp_path):
    own_file(tmp_path / "net.pt")
    own_file(tmp_path / "other.pt", last=weights(7))
    recordings_folder(tmp_path / "data")
    return tmp_path


def test_verify_fails_where_the_weights_are_not_the_checkpoints(spikeloom):
    assert spikeloom("compile", "net.pt", "-o", "net.loom")[0] == 0
    words = ("verify", "net.loom", "--data", "data", "--min-agreement", "0", "--checkpoint", "other.pt")
    code, out, _ = spikeloom(*words)
    assert code == 1
    assert "\nweights: NOT the rounding of this checkpoint: conv1 has " in out
    assert "\nmissed: weights: NOT the rounding" in out
