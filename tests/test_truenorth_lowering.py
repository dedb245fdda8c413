"""Networks on crossbar cores, in whole numbers: every spike is the model's."""

from dataclasses import replace

import numpy as np
import pytest
import random_crossbars as cores
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.dynamics import NO_CLOCKS, with_clocks
from spikeloom.compiler.errors import CapacityError, VerifyError
from spikeloom.compiler.targets.truenorth import legalize, native
from spikeloom.compiler.targets.truenorth.builder import crossing_points
from spikeloom.compiler.targets.truenorth.native import lower
from spikeloom.compiler.targets.truenorth.passes import compile_crossbars
from spikeloom.models.truenorth.network import run_network
from spikeloom.runtime.machines.truenorth import engine, spec
from spikeloom.runtime.machines.truenorth.twins import find_twins
from spikeloom.runtime.machines.votes import class_counts

NETWORKS = st.builds(
    cores.random_network,
    st.integers(0, 2**31),
    copies=st.sampled_from([2, 3, 4]),
    blocks=st.sampled_from([1, 2, 4]),
    hidden=st.sampled_from([(), (4,), (8, 4)]),
    clocks=st.integers(0, 3),
)


@pytest.mark.parametrize("weights", native.BASES.values())
def test_axons_of_an_input_make_every_level(weights):
    levels = np.arange(min(weights), sum(weight for weight in weights if weight > 0) + 1)
    points = crossing_points(levels, weights)
    assert set(np.unique(points)) == {0, 1}
    assert_array_equal(points @ np.array(weights), levels)


@given(NETWORKS, st.integers(0, 2**31))
def test_chip_and_model_and_definition_agree_in_every_spike(network, seed):
    assert native.faults(network) == []
    netlist = lower(network, cores.CHIP)
    assert legalize.faults(netlist, cores.CHIP) == ()
    events = cores.random_events(seed, network)
    channels = with_clocks(events, network.clocks)
    trace = engine.simulate(netlist, channels, spikes=True, membranes=True)
    cores.assert_equal(spec.simulate(netlist, channels[0]), cores.recording_of(trace))
    model = run_network(network, events)
    depths = {stage.name: depth for depth, stage in enumerate(network.stages)}
    for sample, recording in enumerate(events):
        defined = cores.defined_spikes(network, recording)
        for name, depth in depths.items():
            chosen = np.flatnonzero(netlist.layer == netlist.layers.index(name))
            assert set(netlist.neuron[chosen]) == set(range(defined[name].shape[1]))
            on_chip = trace.spikes[sample, depth : depth + 12][:, chosen]
            assert_array_equal(on_chip, defined[name][:, netlist.neuron[chosen]], name)
            assert_array_equal(model[name][sample], defined[name], name)
        votes = defined[list(depths)[-1]].sum(axis=0).reshape(-1, network.classes).sum(axis=0)
        assert_array_equal(class_counts(netlist, trace.counts.votes)[sample], votes)
    assert trace.counts.overflows.sum() == trace.counts.merged.sum() == 0


def test_leaks_rest_in_the_ticks_before_the_first_data():
    network = cores.random_network(3, hidden=(4, 4))
    steep = tuple(
        replace(stage, leak=native.steepest_leak(stage.threshold, depth) * (-1) ** np.arange(stage.neurons))
        for depth, stage in enumerate(network.stages)
    )
    network = replace(network, stages=steep)
    netlist = lower(network, cores.CHIP)
    nothing = np.zeros((1, netlist.n_inputs, 8), np.uint8)
    trace = engine.simulate(netlist, nothing, spikes=True, membranes=True)
    for depth, stage in enumerate(steep[1:], 1):
        chosen = netlist.layer == netlist.layers.index(stage.name)
        assert not trace.spikes[0, :depth, chosen].any()
        assert not trace.membranes[0, depth - 1, chosen].any()


def test_a_neuron_is_there_once_for_each_axon_that_it_reaches():
    # 300 voters take two cores, both of which receive all 120 neurons on 2 axons: 480, again two cores
    network = cores.random_network(
        0, copies=2, blocks=1, taxels=4, features=25, hidden=(120,), classes=150, clocks=0
    )
    netlist = lower(network, cores.CHIP)
    count = {name: np.bincount(netlist.neuron[netlist.layer == i]) for i, name in enumerate(netlist.layers)}
    assert set(count["fc2"]) == {1}
    assert set(count["fc1"]) == set(count["conv1"]) == {4}
    assert netlist.n_cores == 2 + 2 + 2
    assert len(find_twins(netlist).first_neuron) == 100 + 120 + 300


def test_networks_beyond_the_chip():
    network = cores.random_network(0, taxels=65, features=1, blocks=1, hidden=(), copies=2, clocks=0)
    refused(CapacityError, "core 1: 260 axons, 256 allowed |core.axons", compile_crossbars, network)
    network = cores.random_network(0, hidden=())
    assert lower(network, cores.CHIP).n_cores == 3
    refused(
        CapacityError,
        "chip: 3 used, 2 allowed |chip.cores|; train with fewer",
        lower,
        network,
        cores.with_limit("chip.cores", 2),
    )


def test_what_contradicts_itself_is_named():
    network = cores.random_network(0)
    first, *rest = network.stages

    def wrong(**changes):
        return native.faults(replace(network, stages=(replace(first, **changes), *rest)))

    assert native.faults(replace(network, copies=5)) == ["5 copies of an input, allowed are 2, 3, 4"]
    assert native.faults(replace(network, stages=())) == ["8 voting neurons for 3 classes"]
    assert wrong(level=first.level * 4)[0] == "conv1: levels beyond 3, the most of 3 copies"
    loud = replace(network, stages=(replace(first, level=first.level * 4), *rest))
    refused(VerifyError, "conv1: levels beyond 3", compile_crossbars, loud)
    assert wrong(threshold=0 * first.threshold)[0].endswith("outside 1 <= threshold <= floor <= 131072")
    assert wrong(leak=first.leak + 300) == ["conv1: leaks that the ticks before the first data cannot undo"]
    assert wrong(leak=first.leak[1:]) == ["conv1: 7 values of leak for 8 neurons"]
    assert wrong(inputs=first.inputs * 0) == ["conv1: 1 blocks do not share 8 inputs among them"]
    assert native.faults(replace(network, classes=5)) == ["12 voting neurons for 5 classes"]
    assert native.faults(replace(network, clocks=NO_CLOCKS)) == [
        f"{stage.name}: receives 2 clocks of 0" for stage in rest
    ]
