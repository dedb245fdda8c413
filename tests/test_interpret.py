import dataclasses
from dataclasses import replace
from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
import random_networks as nets
from hypothesis import given
from hypothesis import strategies as st
from made_files import sparse_events
from numpy.testing import assert_array_equal
from oracles import refused
from scipy import sparse

import spikeloom.runtime.studies.robustness.pair
from spikeloom.compiler import invariants
from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.formats.text import text
from spikeloom.compiler.interpret import run_float
from spikeloom.compiler.ir import INPUT, Network, Projection, Readout, depths, fan_in, recurrent
from spikeloom.compiler.targets.loihi1 import integers
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.studies.robustness.pair import Inputs, Pair, evaluate, float_layers


def weights_hit(incoming, spikes, post, neuron, t):
    """Weights that a step brings to a neuron; of its own population, by what fired in the step before."""
    for pre, weight in incoming:
        heard = t - (pre == post)
        if heard >= 0:
            yield from (w for w, spike in zip(weight[neuron], spikes[pre][heard], strict=True) if spike)


def simulate(network, events, weights, step):
    """Spikes and membranes, one neuron and one step at a time; `step` gives a neuron's next state, both after it."""
    spikes, membranes = {INPUT: events.tolist()}, {}
    for post, population in enumerate(network.populations):
        spikes[post] = [[False] * population.size for _ in events]
        membranes[post] = [[0] * population.size for _ in events]
        incoming = [(pre, weight.tolist()) for pre, weight in weights(post).items()]
        states = [(0, 0)] * population.size
        for t in range(len(events)):
            for i in range(population.size):
                arrived = sum(weights_hit(incoming, spikes, post, i, t))
                states[i], membranes[post][t][i], spikes[post][t][i] = step(
                    population, i, arrived, states[i]
                )
    return spikes, membranes


def simulate_float(network, events):
    """In Python floats."""

    def step(population, i, arrived, state):
        u, fired = state
        u = population.beta * u * (1 - fired) + (arrived + float(population.bias[i]))
        return (u, u > population.theta), u, u > population.theta

    def weights(post):
        return {p.pre: p.weight.toarray() for p in network.projections if p.post == post}

    return simulate(network, events, weights, step)


def decayed(value, lost):
    kept = abs(value) * (4096 - lost) // 4096
    return kept if value >= 0 else -kept


def simulate_integer(network, events):
    """In Python integers: the rule of hardware references, layers aligned."""

    def step(population, i, arrived, state):
        u, v = state
        u = decayed(u, population.decay_u + 1) + 64 * arrived
        bias = int(population.bias_mantissa[i]) * 2 ** int(population.bias_exponent[i])
        v = max(-(2**23 - 1), min(2**23 - 1, decayed(v, population.decay_v) + u + bias))
        fired = v > 64 * int(population.threshold[i])
        return (u, 0 if fired else v), v, fired

    return simulate(network, events, lambda post: nets.dense_weights(network, post), step)


@pytest.mark.parametrize(
    ("networks", "run", "slowly"),
    [
        (nets.float_networks(), run_float, simulate_float),
        (nets.integer_networks(exponents=(-1, 0, 1, 3, 7)), run_integer, simulate_integer),
    ],
)
@given(data=st.data())
def test_a_run_is_the_step_by_step_loop(networks, run, slowly, data):
    network = data.draw(networks)
    events = data.draw(nets.recordings_for(network.input.size))
    activity = run(network, events, membranes=True)
    for sample in range(len(events)):
        spikes, membranes = slowly(network, events[sample])
        for post in range(len(network.populations)):
            assert_array_equal(activity.spikes[post][sample], spikes[post])
            assert_array_equal(activity.membranes[post][sample], membranes[post])


def test_a_membrane_that_dies_away_is_flushed():
    events = np.zeros((1, 64, 1), bool)
    events[0, 0] = True
    membranes = run_float(nets.chain([[0.4]]), events, membranes=True).membranes[0][0, :, 0]
    assert membranes[40] == pytest.approx(0.4 * 0.2**40)
    assert membranes[48] == 0  # 0.2**47 is below 1e-30


def test_saturation_can_be_left_out():
    network = nets.integer_chain([[-256]], exponent=7)
    still = dataclasses.replace(network.populations[0], decay_v=0)
    network = dataclasses.replace(network, populations=(still,))
    events = np.ones((1, 6, 1), bool)
    held = run_integer(network, events, membranes=True).membranes[0][0, :, 0]
    free = run_integer(network, events, membranes=True, saturates=False).membranes[0][0, :, 0]
    assert held.tolist() == [-2097152, -4194304, -6291456, -8388607, -8388607, -8388607]
    assert free.tolist() == [-2097152 * k for k in range(1, 7)]


def lively(weights=3, seed=0, sizes=(8, 6, 5, 4)):
    rng = np.random.default_rng(seed)
    matrices = [rng.normal(0, 1.0, (after, before)) for before, after in pairwise(sizes)]
    return nets.chain(
        *matrices[:weights], biases=[rng.normal(0, 0.1, len(m)) for m in matrices[:weights]], polarities=2
    )


def random_inputs(channels, seed=0, samples=4, steps=30, rate=0.3):
    return sparse_events(seed, samples, channels, steps, rate=rate)


def as_they_are(events):
    """Inputs of whole recordings."""
    samples, _, steps = events.shape
    return Inputs(
        channels=lambda rows: events[rows], lengths=np.full(samples, steps), begin=np.zeros(samples, int)
    )


def float_spikes(network, events):
    return run_float(network, events.transpose(0, 2, 1).astype(bool), dtype=np.float32).spikes


def test_neurons_that_the_chip_leaves_out_are_compared_if_others_receive_them():
    network = lively(seed=2)
    never = nets.with_population(
        network, 0, bias=np.where(np.arange(6) == 4, -100, network.populations[0].bias)
    )
    netlist = compile_network(never).netlist
    assert 4 not in netlist.neuron[netlist.compartments_of(0)]
    events = random_inputs(network.input.size, 2)
    ours = float_spikes(network, events)[0]
    theirs = next(iter(machine_of(netlist).run(events[:, :, None], spikes=True).spikes.values()))
    assert ours[..., 4].any()
    unread = replace(netlist, layers=(replace(netlist.layers[0], unread=(4,)), *netlist.layers[1:]))
    for each, compared in ((netlist, np.arange(6) >= 0), (unread, np.arange(6) != 4)):
        found = evaluate(Pair(netlist=each, network=network), as_they_are(events)).spikes[0].tolist()
        assert found == [int(side[..., compared].sum()) for side in (ours, theirs, ours != theirs)]


def test_shorter_recordings_and_late_beginnings(monkeypatch):
    monkeypatch.setattr(
        spikeloom.runtime.studies.robustness.pair, "HELD", 1000
    )  # so that there are several parts
    network = lively(seed=4)
    pair = Pair(netlist=compile_network(network, Options(keep_all=True)).netlist, network=network)
    events, lengths, begin = (
        random_inputs(network.input.size, 4),
        np.array([30, 11, 1, 20]),
        np.array([0, 5, 0, 19]),
    )
    found = evaluate(pair, Inputs(channels=lambda rows: events[rows], lengths=lengths, begin=begin))
    wanted = np.zeros((3, 3), int)
    for i, (length, first) in enumerate(zip(lengths.tolist(), begin.tolist(), strict=True)):
        alone = events[i : i + 1, :, :length]
        chip = pair.chip.run(alone[:, :, None], spikes=True).spikes.values()
        for layer, (ours, theirs) in enumerate(zip(float_spikes(network, alone), chip, strict=True)):
            counts = ours[:, first:], theirs[:, first:], ours[:, first:] != theirs[:, first:]
            wanted[layer] += [each.sum() for each in counts]
        for side, spikes in (("float", counts[0]), ("chip", counts[1])):
            votes = readout_counts(network.readout, network.classes, spikes)[0]
            assert_array_equal(found.votes[side][i], votes)
    assert_array_equal(found.spikes, wanted)


def test_a_window_that_opens_late_misses_the_first_steps():
    network = lively(weights=2, seed=6)
    netlist = compile_network(network, Options(keep_all=True)).netlist
    late = replace(
        netlist, layers=(netlist.layers[0], replace(netlist.layers[1], depth=netlist.layers[1].depth + 3))
    )
    events = random_inputs(network.input.size, 6)
    first, second = float_spikes(network, events)
    alone = nets.chain(network.projections[1].weight.toarray(), biases=[network.populations[1].bias])
    missed = np.zeros_like(first)
    missed[:, :-3] = first[:, 3:]
    wanted = run_float(alone, missed).spikes[0]
    _, found = float_layers(Pair(netlist=late, network=network), events, np.full(4, 30))
    assert_array_equal(found, wanted)
    assert not np.array_equal(wanted, second)


def small() -> Network:
    """Two layers, 3 -> 2 -> 2."""
    return nets.chain([[1, 2, 3], [4, 5, 6]], [[1, 0], [0, 1]])


def with_projection(network, index, **changes):
    projections = list(network.projections)
    projections[index] = replace(projections[index], **changes)
    return replace(network, projections=tuple(projections))


def test_a_recurrent_population_is_no_deeper_for_it():
    network = more(1, 1, (2, 2))(small())
    invariants.verify(network)
    assert depths(network) == (0, 1)
    assert recurrent(network) == ("fc2",)


def projected(index, **changes):
    return lambda network: with_projection(network, index, **changes)


def more(*arguments):
    """Add a projection of ones: from, to, shape."""
    pre, post, shape = arguments
    added = Projection(pre=pre, post=post, weight=nets.stored(np.ones(shape)))
    return lambda network: replace(network, projections=(*network.projections, added))


def voting(population, *label):
    return lambda network: replace(network, readout=Readout(population=population, label=np.array(label)))


def populated(index, **changes):
    return lambda network: nets.with_population(network, index, **changes)


TWICE = sparse.csr_array((np.ones(2), np.array([1, 1]), np.array([0, 2, 2])), shape=(2, 3))
FLOATS = [
    (populated(1, name="fc1"), "two populations are called 'fc1'"),
    (projected(0, weight=nets.stored(np.ones((2, 4)))), "projection 0 has shape (2, 4)|(2, 3)"),
    (projected(1, pre=7), "projection 1 has shape (2, 2)|(2, None)"),
    (projected(1, pre=-2), "projection 1 has shape (2, 2)|(2, None)"),
    (projected(1, post=2), "projection 1 has shape (2, 2)|(None, 2)"),
    (
        projected(1, post=INPUT, weight=nets.stored(np.ones((3, 2)))),
        "projection 1 runs from population 0 to -1",
    ),
    (projected(0, weight=TWICE), "projection 0 has unsorted or repeated synapses"),
    (
        more(1, 0, (2, 2)),
        "projection 2 runs from population 1 to 0, not forward; projection 0 skips a layer|1 early",
    ),
    (more(INPUT, 1, (2, 3)), "projection 2 skips a layer|1 early"),
    (lambda n: replace(n, projections=n.projections[1:]), "'fc1' is not reached|'fc2' is not reached"),
    (
        lambda n: replace(more(1, 1, (2, 2))(n), projections=more(1, 1, (2, 2))(n).projections[::2]),
        "'fc2' is not",
    ),
    (voting(2, 0, 1), "names population 2"),
    (voting(-1, 0, 1), "names population -1"),
    (voting(1, 0, 1, 2), "3 labels"),
    (voting(1, 0, 2), "outside 0 … 1"),
    (voting(1, -1, 0), "outside 0 … 1"),
    (lambda n: nets.with_population(populated(1, name="fc1")(n), 1, theta=0.0), "two populations|theta 0.0"),
    *((populated(0, bias=np.array([0.0, value])), "'fc1' has biases") for value in (np.nan, np.inf)),
    *((populated(0, beta=beta), f"'fc1' has beta {beta}") for beta in (-0.1, 1.1, np.nan)),
    *((populated(0, theta=theta), f"theta {theta} out of range") for theta in (0.0, -1.0, np.nan)),
    *((populated(0, alpha=alpha), f"'fc1' has alpha {alpha}") for alpha in (-0.1, 1.0)),
    (
        projected(0, weight=nets.stored(np.full((2, 3), np.nan))),
        "projection 0 has weights that are not finite float64",
    ),
    (projected(0, weight=nets.stored(np.ones((2, 3), np.float32))), "projection 0 has weights"),
    (projected(0, weight=nets.stored(np.ones((2, 3), int))), "projection 0 has weights"),
]


@pytest.mark.parametrize(("change", "words"), FLOATS)
def test_a_float_network_that_breaks_a_rule(change, words):
    refused(VerifyError, words, invariants.verify, change(small()))


@pytest.mark.parametrize(
    ("field", "good", "bad", "words"),
    [
        ("decay_u", (0, 4095), (-1, 4096), "decay outside 0 … 4095"),
        ("decay_v", (0, 4095), (-1, 4096), "decay outside 0 … 4095"),
        ("threshold", (0, 131071), (-1, 131072), "threshold outside 0 … 131071"),
        ("bias_mantissa", (-4095, 4095), (-4096, 4096), "bias mantissa outside -4095 … 4095"),
        ("bias_exponent", (0, 7), (-1, 8), "bias exponent outside 0 … 7"),
    ],
)
def test_registers_at_their_ends_and_one_past_them(field, good, bad, words):
    network = nets.integer_chain([[2, 4]])

    def changed(value):
        return nets.with_population(
            network, 0, **{field: value if field.startswith("decay") else np.array([value])}
        )

    for value in good:
        integers.verify(changed(value))
    for value in bad:
        refused(VerifyError, f"'fc1'|{words}", integers.verify, changed(value))


@pytest.mark.parametrize(
    ("bits", "good", "bad"),
    [(8, (-256, 254), (-258, 256, 3)), (4, (-256, 224), (256, 16)), (2, (128, -256), (256, 64))],
)
def test_mantissas_of_each_width(bits, good, bad):
    for value in good:
        integers.verify(nets.integer_chain([[value]], bits=bits, exponent=-1))
    for value in bad:
        refused(
            VerifyError,
            f"projection 0|{bits} bits",
            integers.verify,
            nets.integer_chain([[value]], bits=bits),
        )
    floats = with_projection(nets.integer_chain([[2]]), 0, weight=nets.stored(np.array([[2.0]])))
    refused(VerifyError, "projection 0|8 bits", integers.verify, floats)
    refused(VerifyError, "exponent -2|below -1", integers.verify, nets.integer_chain([[0]], exponent=-2))


def test_fan_in_counts_stored_zeros():
    weight = nets.stored([[1.0, 0.0, 2.0], [0.0, 0.0, 0.0]], np.array([[1, 1, 1], [0, 1, 0]]))
    network = with_projection(small(), 0, weight=weight)
    assert fan_in(network, 0).tolist() == [3, 1]
    assert fan_in(network, 1).tolist() == [2, 2]
    # and a synapse once, whatever its planes
    again = Projection(
        pre=INPUT, post=0, weight=nets.stored(np.ones((2, 3)), np.array([[1, 0, 0], [1, 1, 0]]))
    )
    twice = replace(small(), projections=(*small().projections, again))
    assert fan_in(twice, 0).tolist() == [3, 3]


def test_texts_are_as_recorded(golden):
    golden("float.txt", text(nets.chain([[0.5, -0.25, 0.0]], [[1.0], [-1.0]], biases=[[0.125], [0.0, 0.5]])))
    layers = [[2, -4, 0], [6, 8, 254]], [[2, 4]]
    golden("integer.txt", text(nets.integer_chain(*layers, thresholds=[[3, 5], 7], exponent=1)))
    golden("netlist.txt", text(nets.compiled(nets.integer_chain(*layers, thresholds=[[3, 5], 7]))))


@given(nets.integer_networks())
def test_depths_are_the_longest_paths(network):
    graph = nx.DiGraph((p.pre, p.post) for p in network.projections if p.pre != p.post)
    assert max(depths(network)) == nx.dag_longest_path_length(graph) - 1
