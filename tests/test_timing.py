"""The time models against their definition, against a published run to the decimal, and by hand."""

from dataclasses import replace

import numpy as np
import pytest
import timing_oracle
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import sparse_events
from numpy.testing import assert_allclose, assert_array_equal
from random_netlists import Axon, Neuron, build, by_engine, large_netlist, netlists, recordings, six_steps
from random_networks import LOIHI

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.targets.base import LATENCIES, Quantity
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost, timing

(SANAFE,) = LOIHI.time
PICO = 1000


def table(link_buffer=16, **latencies):
    """SANA-FE's table with other values."""
    return replace(
        SANAFE,
        latencies={
            event: Quantity(value=latencies.get(event, entry.value), unit="ns", source="test")
            for event, entry in SANAFE.latencies.items()
        },
        link_buffer=Quantity(value=link_buffer, unit="messages", source="test"),
    )


def both(netlist, trace, events, *, times=SANAFE):
    """Simple and detailed times of one recording."""
    latencies = timing.prepare(netlist, LOIHI, times)
    batch = trace.spikes[None], trace.updated[None], events[None]
    return timing_oracle.simple(latencies, *batch), timing.detailed(latencies, *batch)


def assert_as_defined(netlist, trace, events, *, times=SANAFE):
    """Every figure of both models is the definition's; returns what it says."""
    simple, detailed = both(netlist, trace, events, times=times)
    wanted = timing_oracle.Chip(netlist, LOIHI, times).run(trace.spikes, trace.updated, events)

    def column(name, scale=PICO):
        return np.array([[getattr(step, name) for step in wanted]]) / scale

    assert_array_equal(simple.duration_ns, column("simple"))
    cores = netlist.n_cores
    for name in ("generation", "processing"):
        total = [sum(getattr(step, name)[core] for step in wanted) / PICO for core in range(cores)]
        assert_array_equal(getattr(simple, f"{name}_ns"), [total])
    loads = [step.generation + step.processing for step in wanted]
    critical = [load.index(max(load)) for load in loads]
    assert_array_equal(simple.critical_core, [[core % cores for core in critical]])
    assert_array_equal(simple.receiving, [[core >= cores for core in critical]])
    for name, field in (
        ("detailed", "duration"),
        ("sent", "sent"),
        ("processed", "processed"),
        ("blocked", "blocked"),
    ):
        assert_array_equal(getattr(detailed, f"{field}_ns"), column(name), err_msg=name)
    assert_array_equal(detailed.critical_core, column("critical_core", 1))
    assert_array_equal(detailed.receiving, column("receiving", 1))
    assert_array_equal(detailed.peak_load, column("peak_load", 1))
    return wanted


DETAILED = [1058.8, 1068.7, 1039.7, 1058.8, 1068.7, 1078.4]
SIMPLE = [1047.2, 1054.5, 1039.7, 1047.2, 1054.5, 1054.5]


def test_the_published_times_to_the_decimal():
    netlist, events, trace = six_steps()
    assert np.argwhere(trace.spikes).tolist() == [[1, 0], [2, 2], [4, 0], [5, 1], [5, 2]]
    steps = timing_oracle.Chip(netlist, LOIHI, SANAFE, (0,)).run(trace.spikes, trace.updated, events)
    assert [round(step.detailed / PICO, 1) for step in steps] == DETAILED
    assert [step.simple / PICO for step in steps] == SIMPLE
    assert sum(step.detailed for step in steps) / PICO == pytest.approx(6373.1, abs=0.05)
    assert_as_defined(netlist, trace, events)


ENERGY_PJ = {
    "synapse": [142.0, 106.5, 0, 142.0, 106.5, 35.5],
    "soma": [153.6, 266.1, 287.7, 196.8, 266.1, 357.0],
    "network": [230.4, 229.2, 0, 230.4, 229.2, 114.0],
}


def test_the_published_energies_to_the_decimal():
    netlist, events, trace = six_steps()
    # each step as a recording of its own; a spike of the last step is sent and processed in it, as everywhere
    sent = np.column_stack([events[:, 1:], np.zeros(2, np.uint8)]).T
    counts = replace(trace.counts, inputs=sent, spikes=trace.spikes.astype(np.int64))
    updated = timing_oracle.updates(netlist, events[None], trace.spikes[None], trace.membranes[None])[0]
    # o fired in step 2 on what arrived; its current still holds that in step 3, and nothing else happens to it
    assert np.argwhere(trace.updated & ~updated).tolist() == [[3, 2]]
    parts = timing_oracle.parts_of_energy(netlist, LOIHI, counts, updated.sum(axis=1), 1, (0,))
    assert {
        part: (1e12 * joules.sum(axis=1)).round(1).tolist() for part, joules in parts.items()
    } == ENERGY_PJ


@st.composite
def cases(draw):
    """A network on any tiles, a recording, a table with large and small latencies."""
    netlist = draw(netlists(weight_exponents=(0,)))
    tile = st.sampled_from([0, 1, 8, 12, 31])
    tiles = draw(st.lists(tile, min_size=netlist.n_cores, max_size=netlist.n_cores))
    index_bits = draw(st.sampled_from([0, 10]))
    netlist = replace(
        netlist,
        core_tile=read_only(tiles),
        format_index_bits=read_only([index_bits] * len(netlist.format_index_bits)),
    )
    latency = st.sampled_from([0.0, 0.001, 1.0, 3.7, 500.0])
    chosen = {event: draw(latency) for event in LATENCIES}
    times = table(draw(st.sampled_from([0, 1, 16])), **chosen)
    events = draw(recordings(netlist, max_length=5))
    return netlist, events, times


@settings(max_examples=50)
@given(cases(), st.integers(0, 2**32 - 1))
def test_kernels_and_definition_agree_exactly(case, seed):
    netlist, events, times = case
    steps = events.shape[1] + 2
    rng = np.random.default_rng(seed)
    spikes = rng.random((steps, netlist.n_compartments)) < 0.5
    trace = forced(netlist, spikes, spikes | (rng.random(spikes.shape) < 0.5))
    assert_as_defined(netlist, trace, events, times=times)


@pytest.mark.parametrize("link_buffer", [0, 2, 16])
def test_kernels_and_definition_agree_on_a_crowded_mesh(link_buffer):
    netlist = replace(large_netlist(1, proved=True), core_tile=read_only([0, 0, 3, 17, 30]))
    rng = np.random.default_rng(2)
    spikes = rng.random((3, netlist.n_compartments)) < 0.3
    events = sparse_events(rng, netlist.n_inputs, 3, rate=0.5)
    trace = forced(netlist, spikes, spikes | (rng.random(spikes.shape) < 0.5))
    wanted = assert_as_defined(netlist, trace, events, times=table(link_buffer))
    assert (max(step.blocked for step in wanted) > 0) == (link_buffer < 16)


def pipe(tiles, targets=1, senders=1):
    """Neurons of a first core that each feed `targets` of a second one."""
    neurons = [Neuron() for _ in range(senders)] + [Neuron(core=1, layer=1) for _ in range(targets)]
    axons = [
        Axon(source=1 + i, core=1, targets=tuple((j, 2) for j in range(targets))) for i in range(senders)
    ]
    netlist = build(neurons, axons, n_inputs=1, depths=[0, 1])
    return replace(netlist, core_tile=read_only(tiles))


def forced(netlist, spikes, updated):
    """A trace with any spikes and updates: the models of time do not depend on where they come from."""
    nothing = by_engine(netlist, np.zeros((netlist.n_inputs, 0), np.uint8))
    return replace(nothing, spikes=spikes, updated=updated)


def fire(netlist, slots):
    """One step in which these compartments fire and no other has work to do."""
    spikes = np.isin(np.arange(netlist.n_compartments), slots)[None]
    return forced(netlist, spikes, spikes.copy())


NOTHING = np.zeros((1, 1), np.uint8)


@pytest.mark.parametrize(
    ("tiles", "flight", "barrier"), [((0, 0), 0, 600), ((0, 1), 4.1, 1000), ((11, 0), 3 * 4.1 + 6.5, 1000)]
)
def test_one_message(tiles, flight, barrier):
    netlist = pipe(tiles, targets=3)
    simple, detailed = both(netlist, fire(netlist, [0]), NOTHING)
    sent, received = 6 + 3.7 + 30 + 5.1, 16 + 3 * 4.7
    assert simple.duration_ns[0, 0] == pytest.approx(barrier + max(sent, received))
    assert detailed.duration_ns[0, 0] == pytest.approx(barrier + sent + flight + received)
    assert detailed.sent_ns[0, 0] == pytest.approx(sent)
    assert (detailed.critical_core[0, 0], detailed.receiving[0, 0]) == (1, True)
    hops = round(abs(tiles[0] % 8 - tiles[1] % 8) + abs(tiles[0] // 8 - tiles[1] // 8))
    assert detailed.peak_load[0, 0] == 1 / (hops + 2)


def test_input_cores_go_where_there_is_room():
    netlist, _, _ = six_steps()
    assert sanafe.input_tiles(netlist, LOIHI) == (8,)
    full = replace(
        netlist, core_tile=read_only([8] * 4 + [9] * 4), core_compartments=read_only([0, 2] + [3] * 7)
    )
    assert sanafe.input_tiles(full, LOIHI) == (0,)
    wide = replace(full, taxels=3000)
    assert sanafe.input_tiles(wide, LOIHI) == (0, 0, 0)
    one_left = replace(netlist, core_tile=read_only([*range(32)] * 3 + [*range(31)]))
    assert sanafe.input_tiles(one_left, LOIHI) == (31,)


def test_parts_and_cores_add_up_to_the_estimate():
    netlist = replace(large_netlist(3, proved=True), core_tile=read_only([0, 0, 3, 17, 30]))
    form = np.arange(len(netlist.format_index_bits)) % 2 * 10
    netlist = replace(netlist, format_index_bits=read_only(form))
    events = sparse_events(4, 3, netlist.n_inputs, 12, rate=0.3)
    lengths = np.array([12, 5, 0])
    trace = engine.simulate(netlist, events, lengths=lengths, spikes=True, updated=True)
    estimate = cost.price(cost.prepare(netlist, LOIHI), trace.counts, lengths + netlist.max_depth)
    counts = replace(trace.counts, updates=cost.updates_by_core(netlist, trace.updated))
    amounts = cost.price(cost.prepare(netlist, LOIHI, "core"), counts, lengths + netlist.max_depth).events
    assert all(amount.shape == (3, netlist.n_cores) for amount in amounts.values())
    for event, amount in amounts.items():
        assert_allclose(amount.sum(axis=1), estimate.events[event].sum(axis=1), err_msg=event)
        assert amount.any(), event
    for priced in LOIHI.energy:
        for found in (amounts, estimate.events):
            whole = sum(joules.sum(axis=1) for joules in cost.by_part(LOIHI, found)[priced.name].values())
            assert_allclose(whole, estimate.energy[priced.name].sum(axis=1), rtol=1e-12)


def test_amounts_of_a_core_are_its_own():
    netlist, _, trace = six_steps()
    updates = cost.updates_by_core(netlist, trace.updated[None])
    counts = replace(
        trace.counts, inputs=trace.counts.inputs[None], spikes=trace.counts.spikes[None], updates=updates
    )
    amounts = cost.count(cost.prepare(netlist, LOIHI, "core"), counts, 6)
    # h0 fires twice and h1 once, all to o; o fires twice, to nobody; six events reach two neurons each
    assert amounts["spike"].tolist() == [[3, 2]]
    assert amounts["packet"].tolist() == amounts["hop_east_west"].tolist() == [[3, 0]]
    assert amounts["hop_north_south"].tolist() == [[0, 0]]
    assert amounts["synaptic_operation_dense"].tolist() == [[12, 3]]
    assert amounts["neuron_active"].tolist() == updates.tolist()
    assert amounts["neuron_idle"].tolist() == [[12 - updates[0, 0], 6 - updates[0, 1]]]
