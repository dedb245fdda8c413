"""Slow and simple definitions that the product is held against."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from random_networks import LOIHI, dense_weights

from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.compiler.formats.onnx.writer import plan
from spikeloom.models.networks.surrogate import FAST_SIGMOID
from spikeloom.runtime.machines.loihi1 import engine, onnx_engine, spec
from spikeloom.runtime.machines.loihi1.costs import cost


def probed(stage, channels):
    """Weights (outputs, channels) and bias of an affine stage, by its responses to unit vectors."""
    bias = stage(np.zeros((1, channels)))[0]
    return (stage(np.eye(channels)) - bias).T, bias


def assert_same_network(found, expected):
    """Equal in everything but names, scales, stored zeros and the division into projections."""
    assert found.input == expected.input
    assert found.classes == expected.classes
    assert found.readout.population == expected.readout.population
    assert_array_equal(found.readout.label, expected.readout.label)
    for ours, theirs in zip(found.populations, expected.populations, strict=True):
        for name in ("beta", "theta", "decay_u", "decay_v"):
            assert getattr(ours, name) == getattr(theirs, name), name
        for name in ("threshold", "bias_mantissa", "bias_exponent"):
            assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    for post in range(len(expected.populations)):
        ours, theirs = dense_weights(found, post), dense_weights(expected, post)
        for pre in set(ours) | set(theirs):
            nothing = np.zeros(1, np.int64)
            assert_array_equal(*np.broadcast_arrays(ours.get(pre, nothing), theirs.get(pre, nothing)))


def load_weights(network, weights):
    """Give a TactileSGNet the weights of a checkpoint."""
    network.gains = ()
    network.load_state_dict(
        {n: torch.tensor(w.T if n.endswith(".weight") else w) for n, w in weights.items()}
    )


def refused(error, words, call, *given, **options):
    """Check that a call raises `error` and that its message holds each of the words, separated by ``|``."""
    with pytest.raises(error) as caught:
        call(*given, **options)
    message = str(caught.value)
    for word in words.split("|"):
        assert word in message
    return message


def surrogate_spike(surrogate):
    class Spike(torch.autograd.Function):
        @staticmethod
        def forward(ctx, membrane, theta):
            ctx.save_for_backward(membrane)
            ctx.theta = theta
            return membrane.gt(theta).to(membrane.dtype)

        @staticmethod
        def backward(ctx, gradient):
            (membrane,) = ctx.saved_tensors
            distance = (membrane - ctx.theta).abs()
            if surrogate.shape == FAST_SIGMOID:
                return gradient / (1 + distance / surrogate.width) ** 2, None
            return gradient * (distance < surrogate.width), None

    return Spike.apply


DAVIES = {"synaptic_operation": 23.6, "neuron_idle": 52, "neuron_active": 81, "packet": 1.7}


DAVIES |= {"hop_east_west": 3, "hop_north_south": 4}


SANAFE = {"synaptic_operation_dense": 35.5, "synaptic_operation_sparse": 33.6, "neuron_idle": 51.2}


SANAFE |= {"neuron_active": 72.8, "spike": 69.3, "packet": 111, "hop_east_west": 3, "hop_north_south": 4.2}


PICOJOULES = {"davies2018": DAVIES, "sanafe": SANAFE}


def brute_force(netlist, recording, trace=None):
    """Amounts per layer as plain lists, by visiting every synapse for every spike of the specification's run."""
    trace = trace or spec.simulate(netlist, recording)
    steps = recording.shape[1]
    layers = range(len(netlist.layers))
    found = {name: [0] * len(layers) for name in (*cost.EVENTS, "zeros")}
    core_of_axon, core_of = netlist.core_of_axon(), netlist.core_of_compartment()
    for t in range(steps + netlist.max_depth):
        channels = np.flatnonzero(recording[:, t]) if t < steps else []
        fired = np.flatnonzero(trace.spikes[t])
        for compartment in fired:
            found["spike"][netlist.layer[compartment]] += 1
        for source in [*channels, *(fired + netlist.n_inputs)]:
            for axon in np.flatnonzero(netlist.axon_source == source):
                core = core_of_axon[axon]
                form = "sparse" if netlist.format_index_bits[netlist.axon_format[axon]] else "dense"
                for synapse in range(netlist.axon_synapses[axon], netlist.axon_synapses[axon + 1]):
                    into = netlist.layer[netlist.core_compartments[core] + netlist.synapse_target[synapse]]
                    found[f"synaptic_operation_{form}"][into] += 1
                    found["zeros"][into] += int(netlist.synapse_weight[synapse] == 0)
                if source >= netlist.n_inputs:
                    sender = source - netlist.n_inputs
                    here, there = (divmod(int(netlist.core_tile[c]), 8) for c in (core_of[sender], core))
                    found["packet"][netlist.layer[sender]] += 1
                    found["hop_east_west"][netlist.layer[sender]] += abs(here[1] - there[1])
                    found["hop_north_south"][netlist.layer[sender]] += abs(here[0] - there[0])
    of_both_forms = found["synaptic_operation_dense"], found["synaptic_operation_sparse"]
    found["synaptic_operation"] = np.sum(of_both_forms, axis=0).tolist()
    for layer in layers:
        found["neuron_active"][layer] = int(trace.counts.updates[layer])
        held = int(np.count_nonzero(netlist.layer == layer))
        found["neuron_idle"][layer] = held * (steps + netlist.max_depth) - int(trace.counts.updates[layer])
    return found


def check_costs(netlist, recordings, traces=None):
    """Hold the counts and energies of a batch against the brute force; returns the costs."""
    trace = engine.simulate(netlist, recordings)
    costs = cost.price(cost.prepare(netlist, LOIHI), trace.counts, recordings.shape[2] + netlist.max_depth)
    for sample, recording in enumerate(recordings):
        expected = brute_force(netlist, recording, traces and traces[sample])
        for name in cost.EVENTS:
            assert costs.events[name][sample].tolist() == expected[name], name
        assert costs.zeros[sample].tolist() == expected["zeros"]
        for table, prices in PICOJOULES.items():
            for layer in range(len(netlist.layers)):
                by_hand = sum(amount * expected[name][layer] for name, amount in prices.items()) * 1e-12
                assert costs.energy[table][sample, layer] == pytest.approx(by_hand, rel=1e-12)
    assert set(costs.energy) == set(PICOJOULES)
    assert costs.unpriced == {}
    assert costs.steps == recordings.shape[2] + netlist.max_depth
    return costs


def by_scan(netlist, events, **options):
    return onnx_engine.simulate(onnx_engine.prepare(netlist), events, **options)


def by_name(session, given):
    names = [port.name for port in session.get_outputs()]
    return dict(zip(names, session.run(names, given), strict=True))


def by_steps(netlist, events):
    """Spikes, membranes after the reset and votes of recordings in the form ``step``."""
    session = onnx_engine.open_session(onnx_writer.export(netlist, "step")[0])
    samples, _, length = events.shape
    given = {
        port.name: np.zeros(
            [samples if size == "batch" else size for size in port.shape], port.type[len("tensor(") : -1]
        )
        for port in session.get_inputs()
    }
    given["length"][...] = length
    steps = np.pad(events, ((0, 0), (0, 0), (0, netlist.max_depth))).transpose(2, 0, 1)
    spikes = np.zeros((samples, len(steps), netlist.n_compartments), np.bool_)
    membranes = spikes.astype(np.int64)
    for step, now in enumerate(steps):
        found = by_name(session, given | {"events": now})
        given |= {
            name.removesuffix("_next"): array for name, array in found.items() if name.endswith("_next")
        }
        for layer in plan(netlist):
            spikes[:, step, layer.ids] = given[f"{layer.name}.spikes"]
            membranes[:, step, layer.ids] = given[f"{layer.name}.membrane"]
    return spikes, membranes, given.get("votes", np.zeros((samples, netlist.classes)))


def assert_as_specified(netlist, events, expected=None):
    """Both forms do what the specification does on one recording."""
    expected = expected or spec.simulate(netlist, events)
    spikes, membranes, votes = by_steps(netlist, events[None])
    assert_array_equal(spikes[0], expected.spikes)
    assert_array_equal(membranes[0], np.where(expected.spikes, 0, expected.membranes))
    spikes, counts = by_scan(netlist, events[None])
    assert_array_equal(spikes[0], expected.spikes)
    due = [expected.counts.spikes[netlist.readout_class == label].sum() for label in range(netlist.classes)]
    assert counts[0].tolist() == votes[0].tolist() == due
