"""Crossbar cores: the specification against values worked out by hand, the engine against the specification; the
smallest network that breaks each rule, what is said about it, and needs of float networks.
"""

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import sparse_events
from random_crossbars import CHIP, alone, both, crossbars, events, recording_of, relays, with_limit
from random_netlists import assert_equal
from random_networks import chain

from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, history_free
from spikeloom.compiler.targets.truenorth.legalize import faults, needs
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_NONE, RESET_TO, inconsistencies
from spikeloom.runtime.machines.truenorth import engine, spec


def lives(neuron: Neuron, arrivals: list[int]) -> tuple[list[int], list[int]]:
    """Membranes at the ends of ticks and ticks with spikes of a neuron to which weights of type 0 arrive."""
    state = spec.Neuron(
        **{each.name: getattr(neuron, each.name, neuron.initial) for each in fields(spec.Neuron)}
    )
    held, spikes = [], []
    for tick, arrived in enumerate(arrivals):
        spiked, _ = spec.neuron_tick(state, max(arrived, 0), max(-arrived, 0), 20)
        held.append(state.membrane)
        spikes += [tick] * spiked
    return held, spikes


@pytest.mark.parametrize(
    ("neuron", "arrivals", "held", "spikes"),
    [
        # at least the threshold, not above it; leak comes before the comparison
        (Neuron(threshold=3), [2, 1, 5], [2, 0, 0], [1, 2]),
        (Neuron(threshold=3, leak=1), [2, 0, 1], [0, 1, 0], [0, 2]),
        # three resets
        (Neuron(threshold=3, reset_mode=RESET_TO, reset=2), [7, 0, 0], [2, 2, 2], [0]),
        (Neuron(threshold=3, reset_mode=RESET_LINEAR), [7, 0, 0], [4, 1, 1], [0, 1]),
        (Neuron(threshold=3, reset_mode=RESET_NONE), [7, 0, -5], [7, 7, 2], [0, 1]),
        # below the negative threshold: the same resets with the other sign, or saturation; at it nothing happens
        (Neuron(threshold=9, negative_threshold=4, reset=2), [-4, -1], [-4, -2], []),
        (Neuron(threshold=9, negative_threshold=4, reset_mode=RESET_LINEAR), [-7, 0], [-3, -3], []),
        (Neuron(threshold=9, negative_threshold=4, reset_mode=RESET_NONE), [-7, 0], [-7, -7], []),
        (Neuron(threshold=9, negative_threshold=4, negative_saturates=True), [-7, 1], [-4, -3], []),
        # leak: one direction, or by the sign of the membrane, which it does not change
        (Neuron(threshold=9, leak=-2, negative_threshold=99), [3, 0, 0], [1, -1, -3], []),
        (Neuron(threshold=9, leak=-2, leak_reversal=True, negative_threshold=99), [3, 0, 0], [1, 0, 0], []),
        (
            Neuron(threshold=9, leak=-2, leak_reversal=True, negative_threshold=99),
            [-5, 0, 0],
            [-3, -1, 0],
            [],
        ),
        (
            Neuron(threshold=9, leak=2, leak_reversal=True, negative_threshold=99),
            [-1, 0, 0],
            [-3, -5, -7],
            [],
        ),
        (Neuron(threshold=9, leak=2, leak_reversal=True, negative_threshold=99), [0, 0], [0, 0], []),
        # history-free: the threshold is the leak
        (history_free((1, 0, 0, 0), 3), [2, 2, 3, 0, -9, 4], [0] * 6, [2, 5]),
        # the register saturates at both ends
        (
            Neuron(threshold=2**18 - 1, reset_mode=RESET_NONE, initial=2**19 - 1),
            [5, -3],
            [524287, 524284],
            [0, 1],
        ),
        (Neuron(negative_threshold=2**18 - 1, reset_mode=RESET_NONE, initial=-(2**19)), [-5], [-524288], []),
    ],
)
def test_a_neuron_by_hand(neuron, arrivals, held, spikes):
    assert lives(neuron, arrivals) == (held, spikes)


def test_a_register_that_some_order_would_leave_is_counted():
    neuron = spec.Neuron(0, False, 2**18 - 1, RESET_NONE, 0, 0, True, 524_280)
    assert spec.neuron_tick(neuron, 10, 10, 20) == (True, True)
    assert neuron.membrane == 524_280
    assert spec.neuron_tick(neuron, 7, 10, 20) == (True, False)


@pytest.mark.parametrize("delay", [1, 2, 15])
def test_when_spikes_arrive(delay):
    netlist = relays(delay=delay, tick=2, first=20).netlist(taxels=1, polarities=1, classes=1, bin_ticks=3)
    trace = both(netlist, np.array([[1, 0, 1]], np.uint8))
    assert int(trace.counts.ticks) == 3 * 3 + 20
    assert [np.flatnonzero(row).tolist() for row in trace.spikes.T] == [[2, 8], [2 + delay, 8 + delay]]


@pytest.mark.parametrize(("first", "votes"), [(0, 2), (1, 3), (2, 2), (3, 2), (4, 1), (5, 0)])
def test_votes_count_in_their_window_only(first, votes):
    netlist = relays(first=first).netlist(taxels=1, polarities=1, classes=1)
    assert both(netlist, np.array([[1, 0, 1, 1]], np.uint8)).counts.votes.tolist() == [0, votes]


@settings(max_examples=80)
@given(crossbars(), st.integers(0, 2**31))
def test_engine_equals_specification(netlist, seed):
    assert faults(netlist, CHIP) == ()
    recordings, lengths = events(seed, 3, 20, samples=3), np.array([20, 7, 1])
    batch = engine.simulate(netlist, recordings, lengths=lengths, spikes=True, membranes=True)
    for sample, steps in enumerate(lengths):
        assert_equal(spec.simulate(netlist, recordings[sample, :, :steps]), recording_of(batch, sample))


def large():
    """Ten full cores of history-free neurons that feed each other: 2,500 neurons, every line in use."""
    rng, draft = np.random.default_rng(7), Draft()
    for core in range(10):
        draft.core(core, 0)
        for number in range(250):
            neuron = Neuron(
                leak=-1, leak_reversal=True, threshold=9, reset_mode=RESET_LINEAR, negative_threshold=50
            )
            weights = tuple(int(weight) for weight in rng.integers(-3, 5, 4))
            draft.neuron(
                core, history_free(weights, 6) if core % 2 else neuron, layer="layer0", number=number
            )
        for _ in range(256):
            draft.axon(core, int(rng.integers(4)), rng.choice(250, 60, replace=False).tolist())
        for line in range(78):
            draft.feed(line, core, line)
    for core in range(10):
        for number in range(250):
            if number % 50 == 0:
                draft.vote((core, number), core % 3)
            else:
                draft.wire((core, number), int(rng.integers(10)), 78 + number % 178, 1 + number % 15)
    return draft.netlist(taxels=39, polarities=2, classes=3)


@pytest.mark.parametrize("scale", [np.uint8(255), np.int64(256), 0.5])
def test_any_number_but_zero_is_an_event(scale):
    netlist = made(relays())
    events = np.ones((netlist.n_inputs, 5), np.uint8)
    assert (
        both(netlist, events * scale).counts.spikes.tolist() == both(netlist, events).counts.spikes.tolist()
    )


def test_full_cores_and_many_ticks():
    netlist, recording = large(), sparse_events(1, 78, 60, rate=0.05)
    assert faults(netlist, CHIP) == ()
    assert 1000 < both(netlist, recording).counts.spikes.sum() < 2500 * 60


def test_a_membrane_that_climbs_to_the_end_of_its_register():
    """A neuron that is given more in every tick than a spike takes from it."""
    draft = alone(
        Neuron(weights=(255, 0, 0, 0), reset_mode=RESET_LINEAR, negative_saturates=True), channels=0
    )
    draft.vote((0, 0), 0)
    draft.clock(0, 0, period=1)
    netlist = draft.netlist(taxels=1, polarities=1, classes=1)
    assert (
        both(netlist, np.zeros((1, 2100), np.uint8)).counts.overflows.sum() > 0
    )  # 254 a tick, 2**19 after 2,064
    assert [
        engine.prepare(netlist, careful=careful).wiring.steady.shape[1] for careful in (False, True)
    ] == [1, 0]


SOURCE = "core 0, neuron 0"


def made(draft: Draft, **changes):
    netlist = draft.netlist(taxels=1, polarities=1, classes=1)
    return replace(netlist, **{name: np.array([value]) for name, value in changes.items()})


def broken(netlist, chip=CHIP) -> list[tuple[str, str, str]]:
    """Owner, what was found, and the rule."""
    return [
        (fault.owner, fault.used, fault.rule.removeprefix("truenorth.")) for fault in faults(netlist, chip)
    ]


def with_neuron(**changes) -> Draft:
    draft = relays()
    draft.cores[0].neurons[0] = (replace(Neuron(), **changes), 0, 0)
    return draft


@pytest.mark.parametrize(
    ("name", "low", "high", "found", "rule"),
    [
        ("leak", -256, 255, "leak", "leak_bits"),
        ("threshold", 0, 2**18 - 1, "threshold", "threshold_bits"),
        ("negative_threshold", 0, 2**18 - 1, "negative threshold", "threshold_bits"),
        ("reset", -256, 255, "reset value", "reset_bits"),
        ("initial", -(2**19), 2**19 - 1, "initial membrane", "membrane_bits"),
        ("weights", -256, 255, "weight of type 1", "weight_bits"),
    ],
)
def test_parameters_and_their_registers(name, low, high, found, rule):
    for value in (low - 1, low, high, high + 1):
        expected = [] if low <= value <= high else [(SOURCE, f"{found} {value}", f"neuron.{rule}")]
        assert broken(made(with_neuron(**{name: (0, value) if name == "weights" else value}))) == expected


def more(change, times: int = 1):
    draft = relays()
    for _ in range(times):
        change(draft)
    return made(draft)


@pytest.mark.parametrize(
    ("netlist", "found"),
    [
        (made(relays()), []),
        *((made(relays(), wire_delay=n), [(SOURCE, f"delay {n}", "neuron.delay")]) for n in (0, 16, -1)),
        (
            more(lambda d: d.wire((0, 0), 1, d.axon(1))),
            [(SOURCE, "2 targets on one core", "neuron.targets")],
        ),
        (
            more(lambda d: d.wire((0, 0), d.core(2, 0), d.axon(2))),
            [(SOURCE, "targets on 2 cores without a splitter", "neuron.targets")],
        ),
        (
            more(lambda d: d.wire((1, 0), 0, 0)),
            [("core 1, neuron 0", "votes and has a target on the chip", "neuron.targets")],
        ),
        *(
            (more(lambda d, n=n: d.axon(0, n)), [("core 0, axon 1", f"type {n}", "core.axon_types")])
            for n in (4, -1)
        ),
        (
            more(lambda d: d.axon(0), 256),
            [("core 0", "257 axons", "core.axons"), ("core 0, axon 256", "line 256", "core.axons")],
        ),
        (
            more(lambda d: d.core(len(d.cores) % 64, len(d.cores) // 64), 4095),
            [("core 4096", "at (0, 64)", "mesh"), ("chip", 4097, "chip.cores")],
        ),
        (
            more(lambda d: d.neuron(0, Neuron(leak=300)), 3),
            [("core 0, neuron 1 (and 2 more on this core)", "leak 300", "neuron.leak_bits")],
        ),
    ],
)
def test_rules(netlist, found):
    assert broken(netlist) == found


@pytest.mark.parametrize(
    ("netlist", "words"),
    [
        *((made(with_neuron(reset_mode=n)), "reset_mode has values outside 0 … 2") for n in (-1, 3)),
        *((made(with_neuron(leak_reversal=n)), "leak_reversal has values outside 0 … 1") for n in (-1, 2)),
        *(
            (made(with_neuron(negative_saturates=n)), "negative_saturates has values outside 0 … 1")
            for n in (-1, 2)
        ),
        *(
            (made(relays(), **change), "wire 0 leads to no axon")
            for change in ({"wire_y": 6}, {"wire_line": 7})
        ),
        *(
            (more(lambda d, n=n: d.axon(0, n, line=0)), "two axons are on one line of a core")
            for n in (0, 2)
        ),
        (more(lambda d: d.core(0, 0)), "two cores are at one place"),
        (more(lambda d: d.clock(0, 0, period=0)), "clock_period has values outside 1"),
        (more(lambda d: d.clock(0, 0, period=1, phase=-1)), "clock_phase has values outside 0"),
        (more(lambda d: d.clock(1, 9, period=1)), "clock 0 leads to no axon"),
        (more(lambda d: d.feed(0, 0, 3)), "feed 1 leads to no axon"),
        (more(lambda d: d.feed(0, 0, 0, tick=-1)), "feed_tick has values outside 0"),
    ],
)
def test_what_no_network_of_cores_is(netlist, words):
    (fault,) = inconsistencies(netlist)
    assert fault.startswith(words)
    assert inconsistencies(made(relays())) == []


def test_limits_are_parameters():
    assert broken(made(relays()), with_limit("mesh.reach", 0)) == [(SOURCE, "1 cores away", "mesh.reach")]
    assert broken(made(with_neuron(leak=2047)), with_limit("neuron.leak_bits", 12)) == []


def wide(inputs: int, *sizes: int, beta=0.0):
    """A chain of full layers of equal weights."""
    return chain(*(np.ones((after, before)) for before, after in pairwise((inputs, *sizes))), beta=beta)


def needed(network) -> list[tuple[str, str]]:
    return [(need.used, need.rule.removeprefix("truenorth.")) for need in needs(network, CHIP)]


def test_every_need_of_every_layer():
    rng = np.random.default_rng(0)
    network = chain(rng.normal(size=(5, 300)), rng.normal(size=(3, 5)), beta=0.2)
    assert needed(network) == [
        ("keep 0.2 of their membranes a step", "neuron.leak"),
        ("300 inputs", "core.axons"),
        ("300 different weights", "neuron.weight_bits"),
        ("send spikes to 2 axons at least", "neuron.targets"),
        ("keep 0.2 of their membranes a step", "neuron.leak"),
    ]
    worst = needs(network, CHIP)[2]
    assert (worst.owner, worst.allowed) == ("fc1, neuron 0 (and 4 more)", "1 with 1 axon an input")


@pytest.mark.parametrize(
    ("network", "found"),
    [
        (wide(256, 3), []),
        (wide(257, 3), [("257 inputs", "core.axons")]),
        (wide(2, 2, 256), [("send spikes to 2 axons at least", "neuron.targets")]),
        (wide(2, 2, 257), [("send spikes to 4 axons at least", "neuron.targets")]),
    ],
)
def test_limits_of_inputs_and_targets(network, found):
    assert needed(network) == found


@pytest.mark.parametrize(
    ("inputs", "distinct", "over"),
    [
        (64, 15, False),
        (64, 16, True),
        (85, 7, False),
        (86, 7, True),
        (128, 3, False),
        (129, 1, False),
        (129, 2, True),
    ],
)
def test_the_limit_of_levels_follows_the_axons_that_are_left(inputs, distinct, over):
    weight = np.resize(np.arange(1, distinct + 1), inputs)[None].astype(float)
    assert (
        needed(chain(weight, beta=0.0)) == [(f"{distinct} different weights", "neuron.weight_bits")] * over
    )


def test_zeros_are_no_level_and_the_worst_neuron_is_named():
    weight = np.zeros((3, 129))
    weight[0, :2], weight[2, :5] = 1, [1, 2, 3, 0, 4]
    (need,) = needs(chain(weight, beta=0.0), CHIP)
    assert (need.owner, need.used) == ("fc1, neuron 2", "4 different weights")


def test_a_lasting_current():
    network = wide(4, 2)
    lasting = replace(network, populations=(replace(network.populations[0], alpha=0.5),))
    assert needed(lasting) == [("keep 0.5 of their currents a step", "neuron.leak")]
