"""The fast simulator is the plain one, bit for bit, on networks of any kind; and its own promises."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from random_netlists import (
    KEPT,
    Axon,
    Neuron,
    assert_equal,
    build,
    by_engine,
    by_steps,
    large_netlist,
    netlists,
    recording_of,
    recordings,
)

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.runtime.machines.loihi1 import engine, kernel, spec
from spikeloom.runtime.machines.loihi1.trace import Trace

REPEATABLE = settings(max_examples=40, deadline=None, derandomize=True)


def outcome(simulate, *arguments, **options) -> Trace | str:
    try:
        return simulate(*arguments, **options)
    except NumericRangeError as error:
        return str(error)


def random_batch(seed: int, channels: int, *, size: int = 6, length: int = 30) -> np.ndarray:
    return (np.random.default_rng(seed).random((size, channels, length)) < 0.15).astype(np.uint8)


def assert_twins_agree(netlist, events, *, gated=True) -> Trace | str:
    expected = outcome(spec.simulate, netlist, events, gated=gated)
    for options in ({}, {"stepwise": True}):
        found = outcome(by_engine, netlist, events, gated=gated, **options)
        if isinstance(expected, str):
            assert found == expected
        else:
            assert isinstance(found, Trace), found
            assert_equal(found, expected)
    return expected


@pytest.mark.parametrize(
    ("exponents", "length", "gated"),
    # few with small exponents overflow, so traces are compared and not messages
    [((-1, 0, 0, 0, 1, 3, 7), 10, True), ((-1, 0, 0, 0, 1, 3, 7), 10, False), ((-1, 0), 20, True)],
    ids=["any", "without windows", "small exponents"],
)
@REPEATABLE
@given(data=st.data())
def test_any_network(data, exponents, length, gated):
    netlist = data.draw(netlists(weight_exponents=exponents))
    events = data.draw(recordings(netlist, max_length=length))
    assert_twins_agree(netlist, events, gated=gated)


def test_large_networks_reach_every_regime():
    saturations = 0
    for seed, proved in itertools.product(range(3), (True, False)):
        netlist = large_netlist(seed, proved=proved)
        events = random_batch(seed, netlist.n_inputs, size=1)[0]
        trace = spec.simulate(netlist, events)
        assert_equal(by_steps(netlist, events), trace)
        neuron_steps = netlist.n_compartments * events.shape[1]
        assert neuron_steps // 10 < np.count_nonzero(trace.membranes < 0)
        assert neuron_steps // 10 < trace.counts.spikes.sum() < neuron_steps * 9 // 10
        assert neuron_steps // 2 < trace.counts.updates.sum() < neuron_steps
        saturations += trace.counts.saturations.sum()
    assert saturations > 0


def test_ties_at_the_threshold():
    # weights and thresholds from the same few numbers, no bias: a membrane often lands on its threshold
    rng = np.random.default_rng(5)
    neurons = [Neuron(decay_v=4095, threshold=int(rng.choice([2, 4, 6]))) for _ in range(40)]
    axons = [
        Axon(source=s, targets=tuple((int(t), int(rng.choice([-2, 2, 4]))) for t in rng.permutation(40)[:10]))
        for s in range(50)
    ]
    netlist = build(neurons, axons, n_inputs=10, depths=[0])
    trace = assert_twins_agree(netlist, random_batch(6, 10, size=1, length=200)[0])
    ties = trace.membranes == 64 * netlist.threshold
    assert np.count_nonzero(ties) > 100
    assert not trace.spikes[ties].any()


def test_sums_that_would_not_fit_beside_each_other():
    # all 2000 synapses at once overflow by far, the few that are hit at once do not
    axons = [Axon(source=i, exponent=7, targets=((0, 254 if i % 2 else -254), (1, 2))) for i in range(2000)]
    netlist = build([Neuron(threshold=1000), Neuron(decay_u=100)], axons, n_inputs=2000, depths=[0])
    events = np.zeros((2000, 60), np.uint8)
    events[np.random.default_rng(0).integers(2000, size=50), np.arange(50)] = 1
    assert isinstance(assert_twins_agree(netlist, events), Trace)
    events[:, 30] = 1
    assert isinstance(assert_twins_agree(netlist, events), str)


def test_threads_and_batches_do_not_matter():
    netlist = large_netlist(7, proved=True)
    prepared = engine.prepare(netlist)
    events = random_batch(8, netlist.n_inputs)
    one = engine.simulate(prepared, events, **KEPT, threads=1)
    assert_equal(one, engine.simulate(netlist, events.astype(np.bool_), **KEPT, threads=3))
    for index in range(len(events)):  # each alone, so nothing leaks from one into the next
        alone = engine.simulate(prepared, events[index : index + 1], **KEPT)
        assert_equal(recording_of(one, index), recording_of(alone, 0))


def test_only_what_is_asked_for_is_kept():
    netlist = large_netlist(7, proved=True)
    events = random_batch(8, netlist.n_inputs)
    everything = engine.simulate(netlist, events, **KEPT)
    counted = engine.simulate(netlist, events)
    assert all(getattr(counted, name) is None for name in KEPT)
    np.testing.assert_array_equal(counted.counts.spikes, everything.spikes.sum(axis=1))
    np.testing.assert_array_equal(counted.counts.inputs, events.sum(axis=2))
    np.testing.assert_array_equal(
        counted.counts.updates[:, 0], everything.updated[..., netlist.layer == 0].sum(axis=(1, 2))
    )
    assert engine.simulate(netlist, events[:0], spikes=True).spikes.shape == (0, 33, 300)


@settings(REPEATABLE, max_examples=25)
@given(st.lists(st.integers(0, 33), max_size=8), st.integers(0, 100))
@example(list(range(34)), 11)
def test_any_split_into_steps_is_the_batch(cuts, seed):
    netlist = large_netlist(9, proved=True)
    events = random_batch(seed, netlist.n_inputs, size=1)
    prepared, state = engine.prepare(netlist, stepwise=True), kernel.state_of(netlist)
    whole = recording_of(engine.simulate(prepared, events, **KEPT), 0)
    kept = {name: np.zeros_like(getattr(whole, name)) for name in KEPT}
    for begin, end in itertools.pairwise(sorted({0, *cuts, 30 + netlist.max_depth})):
        part = {name: array[begin:end] for name, array in kept.items()}
        engine.advance(prepared, state, events[0, :, begin:end], length=30, steps=end - begin, **part)
        assert state.counter[0] == end
    for name in KEPT:
        np.testing.assert_array_equal(kept[name], getattr(whole, name), strict=True)
    np.testing.assert_array_equal(state.spikes, whole.counts.spikes)


def test_the_first_recording_that_overflows_is_named():
    netlist = build([Neuron()], [Axon(source=0, exponent=7, targets=((0, 254), (0, 254)))], n_inputs=1, depths=[0])
    events = np.zeros((40, 1, 5), np.uint8)
    events[30, 0, 1] = events[12, 0, 3] = 1
    with pytest.raises(NumericRangeError) as caught:
        engine.simulate(netlist, events, threads=2)
    assert str(caught.value) == outcome(spec.simulate, netlist, events[12])
    assert caught.value.__notes__ == ["recording 12 of 40, counted from 0"]


def test_the_kernel_compiles_where_nothing_can_be_cached(monkeypatch):
    def njit(**options):
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: (function, options)

    monkeypatch.setattr(kernel, "njit", njit)
    assert kernel.compiled_and_cached(len) == (len, {"nogil": True})
