"""onnxruntime on the integer graph: every spike and membrane of the specification."""

import builtins
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from random_netlists import Axon, Neuron, build, large_netlist, netlists, recordings

from compiler.errors import DataError, ModelError, NumericRangeError, OptionError
from compiler.netlist import read_only
from compiler.pipeline import compile_network
from compiler.serialize import write_netlist
from runtime import engine, onnx_engine, onnx_graph, onnx_nodes, onnx_plan, spec

FORMS = onnx_graph.FORMS


def by_onnx(netlist, events, form, **options):
    return onnx_engine.simulate(onnx_engine.prepare(netlist, form=form), events, **options)


def left(trace):
    """Membranes after the reset."""
    return np.where(trace.spikes, 0, trace.membranes)


def assert_as_specified(netlist, events):
    """Both forms do what the specification does on one recording, or stop where it stops."""
    try:
        expected = spec.simulate(netlist, events)
    except NumericRangeError:
        for form in FORMS:
            with pytest.raises(NumericRangeError, match="a register overflows"):
                by_onnx(netlist, events[None], form)
        return
    steps = by_onnx(netlist, events[None], "step", membranes=True)
    np.testing.assert_array_equal(steps.spikes[0], expected.spikes)
    np.testing.assert_array_equal(steps.membranes[0], left(expected))
    scan = by_onnx(netlist, events[None], "scan")
    np.testing.assert_array_equal(scan.spikes[0], expected.spikes)
    votes = [expected.counts.spikes[netlist.readout_class == label].sum() for label in range(netlist.classes)]
    assert scan.votes[0].tolist() == steps.votes[0].tolist() == votes


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data())
def test_random_networks_are_the_specification(data):
    netlist = data.draw(netlists())
    labels = data.draw(st.lists(st.integers(-1, 2), min_size=netlist.n_compartments, max_size=netlist.n_compartments))
    netlist = replace(netlist, classes=3, readout_class=read_only(labels))
    assert_as_specified(netlist, data.draw(recordings(netlist)))


def pipelined(netlist):
    """Only those axons that come from the layer before, of layers renumbered by depth: a pipeline."""
    depth = np.append(np.full(netlist.n_inputs, -1), [netlist.layers[layer].depth for layer in netlist.layer])
    axon = netlist.axon_of_synapse()
    fits = depth[netlist.axon_source[axon]] == depth[netlist.n_inputs + netlist.synapse_compartment()] - 1
    return replace(netlist, synapse_weight=read_only(np.where(fits, netlist.synapse_weight, 0)))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data())
def test_random_pipelines_are_the_specification(data):
    netlist = pipelined(data.draw(netlists(weight_exponents=(-1, 0, 1, 3))))
    assert_as_specified(netlist, data.draw(recordings(netlist)))


@pytest.mark.parametrize("proved", [True, False])
def test_a_large_network_is_the_engine(proved):
    netlist = large_netlist(3, proved=proved)
    events = (np.random.default_rng(4).random((5, netlist.n_inputs, 30)) < 0.05).astype(np.uint8)
    lengths = np.array([30, 12, 30, 0, 12])
    try:
        expected = engine.simulate(netlist, events, lengths=lengths, spikes=True)
    except NumericRangeError:
        assert not proved
        with pytest.raises(NumericRangeError):
            by_onnx(netlist, events, "scan", lengths=lengths)
        return
    for form in FORMS:
        done = []
        found = by_onnx(netlist, events, form, lengths=lengths, batch=2, progress=done.append)
        np.testing.assert_array_equal(found.spikes, expected.spikes)
        assert done == [2, 4]
