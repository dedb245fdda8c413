import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_networks import chain, dense_weights, float_networks, integer_chain, integer_networks, recordings_for

from spikeloom.compiler.interpret import channels_last, run_float, run_integer, vote
from spikeloom.compiler.ir import INPUT


def weights_hit(incoming, spikes, post, neuron, t):
    """Weights that a step brings to a neuron; of its own population, by what fired in the step before."""
    for pre, weight in incoming:
        heard = t - (pre == post)
        if heard >= 0:
            yield from (w for w, spike in zip(weight[neuron], spikes[pre][heard], strict=True) if spike)


def simulate_float(network, events):
    """One neuron and one step at a time, in Python floats."""
    spikes = {INPUT: events.tolist()}
    membranes = {}
    for post, population in enumerate(network.populations):
        steps = len(events)
        spikes[post] = [[False] * population.size for _ in range(steps)]
        membranes[post] = [[0.0] * population.size for _ in range(steps)]
        incoming = [(p.pre, p.weight.toarray().tolist()) for p in network.projections if p.post == post]
        u, s = [0.0] * population.size, [0] * population.size
        for t in range(steps):
            for i in range(population.size):
                current = sum(weights_hit(incoming, spikes, post, i, t))
                u[i] = population.beta * u[i] * (1 - s[i]) + (current + float(population.bias[i]))
                s[i] = int(u[i] > population.theta)
                spikes[post][t][i], membranes[post][t][i] = bool(s[i]), u[i]
    return spikes, membranes


def decayed(value, lost):
    kept = abs(value) * (4096 - lost) // 4096
    return kept if value >= 0 else -kept


def simulate_integer(network, events):
    """One neuron and one step at a time, in Python integers: the rule of hardware references, layers aligned."""
    spikes = {INPUT: events.tolist()}
    membranes = {}
    for post, population in enumerate(network.populations):
        steps = len(events)
        spikes[post] = [[False] * population.size for _ in range(steps)]
        membranes[post] = [[0] * population.size for _ in range(steps)]
        incoming = [(pre, weight.tolist()) for pre, weight in dense_weights(network, post).items()]
        u, v = [0] * population.size, [0] * population.size
        bias = [int(m) * 2 ** int(e) for m, e in zip(population.bias_mantissa, population.bias_exponent, strict=True)]
        for t in range(steps):
            for i in range(population.size):
                arrived = sum(weights_hit(incoming, spikes, post, i, t))
                u[i] = decayed(u[i], population.decay_u + 1) + 64 * arrived
                v[i] = decayed(v[i], population.decay_v) + u[i] + bias[i]
                v[i] = max(-(2**23 - 1), min(2**23 - 1, v[i]))
                spikes[post][t][i], membranes[post][t][i] = v[i] > 64 * int(population.threshold[i]), v[i]
                if spikes[post][t][i]:
                    v[i] = 0
    return spikes, membranes


@pytest.mark.parametrize(
    ("networks", "run", "slowly"),
    [
        (float_networks(), run_float, simulate_float),
        (integer_networks(exponents=(-1, 0, 1, 3, 7)), run_integer, simulate_integer),
    ],
)
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_a_run_is_the_step_by_step_loop(networks, run, slowly, data):
    network = data.draw(networks)
    events = data.draw(recordings_for(network.input.size))
    activity = run(network, events, membranes=True)
    for sample in range(len(events)):
        spikes, membranes = slowly(network, events[sample])
        for post in range(len(network.populations)):
            np.testing.assert_array_equal(activity.spikes[post][sample], spikes[post])
            np.testing.assert_array_equal(activity.membranes[post][sample], membranes[post])


@settings(deadline=None, max_examples=5)
@given(st.data())
def test_a_recording_runs_the_same_alone_and_in_another_batch(data):
    network = data.draw(integer_networks())
    events = data.draw(recordings_for(network.input.size, samples=20, most=4))
    together = run_integer(network, events).spikes
    for sample in range(len(events)):
        alone = run_integer(network, events[sample : sample + 1]).spikes
        assert all(np.array_equal(a[0], b[sample]) for a, b in zip(alone, together, strict=True))


def test_a_tie_at_the_threshold_does_not_spike():
    events = np.ones((1, 1, 2), bool)
    assert run_float(chain([[0.25, 0.25], [0.25, 0.25 + 1e-15]]), events).spikes[0].tolist() == [[[False, True]]]
    assert run_integer(integer_chain([[50, 50], [50, 52]]), events).spikes[0].tolist() == [[[False, True]]]


def test_a_membrane_that_dies_away_is_flushed():
    events = np.zeros((1, 64, 1), bool)
    events[0, 0] = True
    membranes = run_float(chain([[0.4]]), events, membranes=True).membranes[0][0, :, 0]
    assert membranes[40] == pytest.approx(0.4 * 0.2**40)
    assert membranes[48] == 0  # 0.2**47 is below 1e-30


def test_saturation_can_be_left_out():
    network = integer_chain([[-256]], exponent=7)
    still = dataclasses.replace(network.populations[0], decay_v=0)
    network = dataclasses.replace(network, populations=(still,))
    events = np.ones((1, 6, 1), bool)
    held = run_integer(network, events, membranes=True).membranes[0][0, :, 0]
    free = run_integer(network, events, membranes=True, saturates=False).membranes[0][0, :, 0]
    assert held.tolist() == [-2097152, -4194304, -6291456, -8388607, -8388607, -8388607]
    assert free.tolist() == [-2097152 * k for k in range(1, 7)]


def test_channels_are_taxel_major():
    events = np.zeros((1, 3, 2, 5))
    events[0, 2, 1, 4] = 1
    found = channels_last(events)
    assert (found.shape, found.dtype) == ((1, 5, 6), np.bool_)
    assert np.argwhere(found).tolist() == [[0, 4, 5]]


def test_the_lowest_class_wins_a_tie():
    assert vote(np.array([[0, 2, 2], [0, 0, 0], [1, 0, 3]])).tolist() == [1, 0, 2]
