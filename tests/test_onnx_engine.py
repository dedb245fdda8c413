"""onnxruntime on the integer graph: every spike and membrane of the specification."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from random_netlists import Axon, Neuron, build, large_netlist, netlists, recordings

from compiler.errors import NumericRangeError
from compiler.netlist import read_only
from runtime import engine, onnx_engine, onnx_graph, onnx_plan, spec

FORMS = onnx_graph.FORMS
SETTINGS = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


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


@SETTINGS
@given(st.data())
def test_random_networks_are_the_specification(data):
    netlist = data.draw(netlists())
    labels = data.draw(st.lists(st.integers(-1, 2), min_size=netlist.n_compartments, max_size=netlist.n_compartments))
    netlist = replace(netlist, classes=3, readout_class=read_only(labels))
    assert_as_specified(netlist, data.draw(recordings(netlist)))


@st.composite
def pipelines(draw):
    """Networks in which each layer hears the one before it only, on two cores, with registers in range."""
    sizes = draw(st.lists(st.integers(1, 6), min_size=1, max_size=3))
    n_inputs = draw(st.integers(1, 4))
    weight = st.integers(-127, 127).map(lambda half: 2 * half)
    neurons, axons, before = [], [], range(n_inputs)
    for layer, size in enumerate(sizes):
        core = layer % 2
        first = sum(neuron.core == core for neuron in neurons)
        neuron = st.builds(
            Neuron,
            layer=st.just(layer),
            core=st.just(core),
            decay_u=st.sampled_from([4095, 4095, 2048]),
            decay_v=st.sampled_from([3277, 3277, 100, 4095]),
            threshold=st.sampled_from([0, 1, 60, 254, 2000]),
            bias=st.sampled_from([0, -300, 64, 4095]),
            bias_exponent=st.sampled_from([0, 0, 7]),
        )
        neurons += draw(st.lists(neuron, min_size=size, max_size=size))
        for source in before:
            targets = tuple((first + i, draw(weight)) for i in range(size))
            axons.append(Axon(source=source, core=core, targets=targets, exponent=draw(st.sampled_from([-1, 0, 3]))))
        axons.append(Axon(source=before[0], core=core, targets=((first, 2),)))
        before = [(layer, i) for i in range(size)]
    # compartments are numbered core after core
    order = [i for core in (0, 1) for i, neuron in enumerate(neurons) if neuron.core == core]
    ids = {}
    for place, i in enumerate(order):
        layer = neurons[i].layer
        ids[layer, sum(neuron.layer == layer for neuron in neurons[:i])] = n_inputs + place
    axons = [replace(axon, source=ids.get(axon.source, axon.source)) for axon in axons]
    return build(neurons, axons, n_inputs=n_inputs, depths=list(range(len(sizes))))


@SETTINGS
@given(st.data())
def test_random_pipelines_are_the_specification(data):
    netlist = data.draw(pipelines())
    layers = onnx_plan.plan(netlist)
    assert not any(layer.checked for layer in layers)
    assume(onnx_plan.is_pipeline(netlist, layers))  # weights may cancel in the one synapse of a layer
    assert b"chip/" not in onnx_graph.export(netlist, "scan")
    wide = data.draw(st.sampled_from([1, onnx_graph.WIDE]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_graph, "WIDE", wide)
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
