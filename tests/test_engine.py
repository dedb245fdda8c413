"""The fast simulator, step by step and layer by layer, is the plain one, bit for bit, on networks of any kind."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from made_files import sparse_events
from numpy.testing import assert_array_equal
from oracles import refused
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
    ungated,
)

from spikeloom.compiler import layer_kernel
from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1 import engine, kernel, spec
from spikeloom.runtime.machines.loihi1.block_kernel import Blocks
from spikeloom.runtime.machines.loihi1.blocks import lay_out_blocks
from spikeloom.runtime.machines.loihi1.trace import Charges, Trace, pack, unpack


def outcome(simulate, *arguments, **options) -> Trace | str:
    try:
        return simulate(*arguments, **options)
    except NumericRangeError as error:
        return str(error)


def random_batch(seed: int, channels: int, *, size: int = 6, length: int = 30) -> np.ndarray:
    return sparse_events(seed, size, channels, length, rate=0.15)


def assert_twins_agree(netlist, events, *, gated=True, blank=0) -> Trace | str:
    netlist = replace(netlist if gated else ungated(netlist), blank=blank and netlist.max_depth + blank)
    expected = outcome(spec.simulate, netlist, events)
    for options in ({}, {"stepwise": True}):
        found = outcome(by_engine, netlist, events, **options)
        if isinstance(expected, str):
            assert found == expected
        else:
            assert isinstance(found, Trace), found
            assert_equal(found, expected)
    return expected


@pytest.mark.parametrize(
    ("exponents", "length", "gated", "blank"),
    # few with small exponents overflow, so traces are compared and not messages
    [
        (None, 10, True, 0),
        (None, 10, False, 0),
        (None, 10, True, 1),
        ((-1, 0), 20, True, 0),
        ((-1, 0), 20, True, 3),
    ],
    ids=["any", "without windows", "free-running", "small exponents", "free-running, small exponents"],
)
@given(data=st.data())
def test_any_network(data, exponents, length, gated, blank):
    netlist = data.draw(netlists(weight_exponents=exponents or (-1, 0, 0, 0, 1, 3, 7)))
    events = data.draw(recordings(netlist, max_length=length))
    assert_twins_agree(netlist, events, gated=gated, blank=blank)


def test_any_number_but_zero_is_an_event():
    netlist = large_netlist(7, proved=True)
    events = (np.random.default_rng(0).random((2, netlist.n_inputs, 9)) < 0.3).astype(np.uint8)
    prepared = engine.prepare(netlist)
    wanted = engine.simulate(prepared, events).counts.spikes
    for other in (events * 255, events * np.int64(256), events * 0.5):
        assert_array_equal(engine.simulate(prepared, other).counts.spikes, wanted)


def test_blank_steps_of_an_empty_recording_do_not_vote():
    netlist = large_netlist(7, proved=True)
    netlist = replace(netlist, layers=tuple(replace(layer, depth=0) for layer in netlist.layers))
    nothing = np.zeros((netlist.n_inputs, 0), np.uint8)
    assert assert_twins_agree(netlist, nothing, blank=3).counts.spikes.any()


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


def test_only_what_is_asked_for_is_kept():
    netlist = large_netlist(7, proved=True)
    events = random_batch(8, netlist.n_inputs)
    everything = engine.simulate(netlist, events, **KEPT)
    counted = engine.simulate(netlist, events)
    assert all(getattr(counted, name) is None for name in KEPT)
    assert_array_equal(counted.counts.spikes, everything.spikes.sum(axis=1))
    assert_array_equal(counted.counts.inputs, events.sum(axis=2))
    assert_array_equal(
        counted.counts.updates[:, 0], everything.updated[..., netlist.layer == 0].sum(axis=(1, 2))
    )
    assert engine.simulate(netlist, events[:0], spikes=True).spikes.shape == (0, 33, 300)


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
        assert_array_equal(kept[name], getattr(whole, name), strict=True)
    assert_array_equal(state.spikes, whole.counts.spikes)


def test_the_first_recording_that_overflows_is_named():
    netlist = build(
        [Neuron()], [Axon(source=0, exponent=7, targets=((0, 254), (0, 254)))], n_inputs=1, depths=[0]
    )
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

    monkeypatch.setattr(layer_kernel.numba, "njit", njit)
    assert layer_kernel.compiled_and_cached(len) == (len, layer_kernel._KERNEL)


def pipeline(
    seed: int,
    *,
    inputs: int,
    sizes: tuple[tuple[int, ...], ...],
    density: float,
    largest: int = 6,
    biases: float = 0.7,
    lasting: float = 0.0,
) -> Netlist:
    """Layers of `sizes`, some at each depth, on random cores; each neuron receives the depth before."""
    rng = np.random.default_rng(seed)
    neurons, depths, axons = [], [], []
    cores = int(rng.integers(1, 4))
    placed: list[tuple[int, int]] = []  # layer, core
    for depth, layers in enumerate(sizes):
        for size in layers:
            placed += [(len(depths), int(core)) for core in np.sort(rng.integers(0, cores, size))]
            depths.append(depth)
    for layer, core in placed:
        drawn = {
            "decay_u": int(rng.choice([0, 204, 2047, 4094])) if rng.random() < lasting else 4095,
            "decay_v": int(rng.choice([3277, 3277, 3277, 4096, 2048])),
            "threshold": int(rng.integers(0, 12 * largest)),
            "bias": int(rng.integers(-300, 300)) if rng.random() < biases else 0,
        }
        neurons.append(Neuron(layer=layer, core=core, **drawn))
    order = sorted(range(len(neurons)), key=lambda i: neurons[i].core)
    compartment = {index: c for c, index in enumerate(order)}
    first_of_core = {core: sum(n.core < core for n in neurons) for core in range(cores)}
    for depth in range(len(sizes)):
        sources = (
            range(inputs)
            if depth == 0
            else [i for i, n in enumerate(neurons) if depths[n.layer] == depth - 1]
        )
        for source in sources:
            for core in range(cores):
                targets = [
                    (compartment[i] - first_of_core[core], int(rng.integers(-largest, largest + 1)))
                    for i, n in enumerate(neurons)
                    if n.core == core and depths[n.layer] == depth and rng.random() < density
                ]
                if targets:
                    axon = source if depth == 0 else inputs + compartment[source]
                    exponent = int(rng.integers(0, 2))
                    axons.append(Axon(source=axon, targets=tuple(targets), core=core, exponent=exponent))
    return build(neurons, axons, n_inputs=inputs, depths=depths)


def assert_kernels_agree(netlist: Netlist, events: np.ndarray) -> None:
    assert isinstance(lay_out_blocks(netlist), Blocks)
    expected = spec.simulate(netlist, events)
    assert_equal(by_engine(netlist, events), expected)
    assert_equal(by_steps(netlist, events), expected)
    rng = np.random.default_rng(events.size)
    rows = {"sources": netlist.n_inputs + netlist.n_compartments, "updates": netlist.n_compartments}
    sums = int(rng.choice([1, 16, 17]))
    largest = int(
        rng.choice([2**31, 2**20])
    )  # sums of the first leave 32 bits, those of the second never do
    charges = Charges(**{name: rng.integers(-largest, largest, (size, sums)) for name, size in rows.items()})
    if rng.random() < 0.5:
        charges.updates[:] = charges.updates[
            rng.integers(0, min(3, len(charges.updates)), len(charges.updates))
        ]
    wanted = (
        expected.spikes.astype(np.int64) @ charges.sources[netlist.n_inputs :]
        + expected.updated.astype(np.int64) @ charges.updates
    )
    wanted[: events.shape[1]] += events.T.astype(np.int64) @ charges.sources[: netlist.n_inputs]
    for stepwise in (False, True):
        prepared = engine.prepare(netlist, stepwise=stepwise)
        found = engine.simulate(prepared, events[None], packed=True, charges=charges)
        assert_array_equal(found.charged[0], wanted, strict=True)
        assert_array_equal(found.packed[0], pack(expected.spikes), strict=True)
        assert_array_equal(unpack(found.packed[0], netlist.n_compartments), expected.spikes, strict=True)


SHAPES = (((3,),), ((64,), (65,)), ((70, 5), (1,), (130,)), ((20,), (2, 3, 4), (6,)))


@given(
    st.integers(0, 10**6),
    st.sampled_from([1, 3, 64, 65, 130]),
    st.sampled_from(SHAPES),
    st.sampled_from([0.03, 0.3, 1.0]),
    st.sampled_from([0.0, 0.7, 1.0]),
    st.sampled_from([0.0, 0.02, 0.3, 1.0]),
    st.sampled_from([0.0, 0.3, 1.0]),
)
def test_any_pipeline(seed, inputs, sizes, density, biases, rate, lasting):
    netlist = pipeline(seed, inputs=inputs, sizes=sizes, density=density, biases=biases, lasting=lasting)
    assume(
        isinstance(lay_out_blocks(netlist), Blocks)
    )  # currents that last for ever may leave their registers
    rng = np.random.default_rng(seed)
    assert_kernels_agree(netlist, sparse_events(rng, inputs, 12, rate=rate))


def test_the_random_pipelines_reach_every_way_of_storage():
    found = [
        lay_out_blocks(pipeline(seed, inputs=130, sizes=SHAPES[2], density=density, largest=largest))
        for seed, (density, largest) in enumerate([(0.03, 6), (1.0, 6), (1.0, 80)])
    ]
    assert [blocks.weight.dtype for blocks in found] == [np.int8, np.int8, np.int16]
    assert [blocks.dense.tolist() for blocks in found[:2]] == [[False, False, True], [True] * 3]
    assert any(blocks.restful.any() for blocks in found)
    whole = lay_out_blocks(
        build([Neuron()] * 70, [Axon(source=0, targets=((0, 1),))], n_inputs=1, depths=[0])
    ).whole
    assert whole.tolist() == [0, 64]


@pytest.mark.parametrize("stepwise", [False, True])
def test_recordings_of_any_length_together_on_several_threads(stepwise):
    netlist = pipeline(3, inputs=20, sizes=SHAPES[3], density=0.5)
    events = sparse_events(4, 9, 20, 16, rate=0.2)
    lengths = np.array([16, 0, 1, 5, 16, 3, 2, 15, 8])
    prepared = engine.prepare(netlist, stepwise=stepwise)
    together = engine.simulate(prepared, events, lengths=lengths, threads=3, **KEPT)
    for index, length in enumerate(lengths):
        expected = spec.simulate(netlist, events[index, :, :length])
        found = recording_of(together, index)
        window = len(expected.spikes)
        for name in KEPT:
            assert_array_equal(getattr(found, name)[:window], getattr(expected, name), strict=True)
            assert not getattr(found, name)[window:].any()
        assert_array_equal(found.counts.updates, expected.counts.updates)
        assert_array_equal(found.counts.spikes, expected.counts.spikes)


@pytest.mark.parametrize("stepwise", [False, True])
def test_events_of_any_type_and_layout(stepwise):
    prepared = engine.prepare(pipeline(5, inputs=20, sizes=SHAPES[3], density=0.5), stepwise=stepwise)
    events = sparse_events(6, 3, 20, 16, rate=0.2)
    events.flags.writeable = False
    expected = engine.simulate(prepared, events, **KEPT)
    transposed = np.ascontiguousarray(events.transpose(2, 1, 0)).transpose(2, 1, 0)
    for same in (events * 7, events.astype(bool), np.asfortranarray(events), transposed):
        assert_equal(engine.simulate(prepared, same, **KEPT), expected)


def one_neuron(weights: list[int], **neuron) -> Netlist:
    axons = [Axon(source=i, targets=((0, weight),), exponent=0) for i, weight in enumerate(weights)]
    return build([Neuron(**neuron)], axons, n_inputs=len(weights), depths=[0])


FULL = [254] * 129 + [1]  # 32,767


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("threshold", [0, 32766, 32767, 40000])
def test_sums_at_the_end_of_sixteen_bits(sign, threshold):
    netlist = one_neuron([sign * w for w in FULL] + [-sign * w for w in FULL], threshold=threshold)
    rng = np.random.default_rng(0)
    events = np.zeros((260, 12), np.uint8)
    events[:130, 0] = events[130:, 2] = events[:, 4] = events[:130, 6:9] = 1
    events[:, 9:] = rng.random((260, 3)) < 0.5
    assert_kernels_agree(netlist, events)
    assert np.abs(spec.simulate(netlist, events).membranes).max() >= 32767 * 64


def test_a_sum_beyond_sixteen_bits_takes_the_other_kernel():
    netlist = one_neuron([*FULL, 1])
    assert lay_out_blocks(netlist).startswith("a sum may leave 16 bits")
    events = np.ones((131, 2), np.uint8)
    for simulate in (spec.simulate, by_engine):
        refused(NumericRangeError, "synaptic sum", simulate, netlist, events)


@pytest.mark.parametrize(
    ("neuron", "fits"),
    [
        ({"threshold": 81940, "decay_v": 3277}, True),  # 81,940 * 64 * 819 is just below 2**32
        ({"threshold": 81941, "decay_v": 3277}, False),
        ({"threshold": 16000, "decay_v": 0}, True),  # keeps everything, and never goes down
        ({"threshold": 16384, "decay_v": 0}, False),
        ({"threshold": 100, "decay_v": 0, "bias": -1}, False),  # without a limit from below
        ({"threshold": 100, "decay_u": 4094}, True),  # a current with a memory
        # 380 weight units a step, 24,320 membrane units, that add up to 24,320 * 4096 / 12 = 8,301,226 of 8,388,607
        ({"threshold": 1, "decay_u": 11, "decay_v": 4096}, True),
        (
            {"threshold": 1, "decay_u": 10, "decay_v": 4096},
            False,
        ),  # to 9,055,884: beyond the current's register
        ({"threshold": 2000, "decay_u": 11, "decay_v": 2048}, True),  # and 64,000 that the membrane keeps
        ({"threshold": 3000, "decay_u": 11, "decay_v": 2048}, False),  # and 96,000: it may saturate
    ],
)
def test_membranes_at_the_end_of_32_bits(neuron, fits):
    netlist = one_neuron([127, 127, 126], **neuron)
    assert isinstance(lay_out_blocks(netlist), Blocks) == fits
    events = np.ones((3, 400), np.uint8)
    events[:, 300:] = 0
    assert_equal(by_engine(netlist, events), spec.simulate(netlist, events))


def test_what_receives_more_than_the_depth_before_takes_the_other_kernel():
    neurons = [Neuron(layer=0), Neuron(layer=1)]
    for source, depths in (
        (1, [0, 0]),
        (0, [0, 1]),
        (2, [0, 1]),
        (1, [0, 2]),
    ):  # same depth, input, itself, skipped
        axons = [Axon(source=0, targets=((0, 10),)), Axon(source=source, targets=((1, 10),))]
        netlist = build(neurons, axons, n_inputs=1, depths=depths)
        assert lay_out_blocks(netlist).startswith("a layer is recurrent or receives from others")
        events = np.ones((1, 9), np.uint8)
        assert_equal(by_engine(netlist, events), spec.simulate(netlist, events))


def test_scattered_synapses_take_the_other_kernel():
    """One synapse in each of a hundred thousand rows of 64."""
    rng = np.random.default_rng(0)
    axons = [
        Axon(
            source=source,
            targets=tuple((int(c), 1) for c in np.unique(rng.integers(0, 1000, 200) // 64 * 64 % 1000)),
        )
        for source in range(6000)
    ]
    assert isinstance(
        lay_out_blocks(build([Neuron() for _ in range(1000)], axons, n_inputs=6000, depths=[0])), str
    )
