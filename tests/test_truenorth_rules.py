"""The smallest network of crossbar cores that breaks each rule, what is said about it; and needs of float networks."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from random_crossbars import CHIP, relays, with_limit
from random_networks import chain

from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron
from spikeloom.compiler.targets.truenorth.legalize import faults, needs

SOURCE = "core 0, neuron 0"


def made(draft: Draft, **changes):
    netlist = draft.netlist(taxels=1, polarities=1, classes=1)
    return replace(netlist, **{name: np.array([value]) for name, value in changes.items()})


def broken(netlist, chip=CHIP) -> list[tuple[str, str, str]]:
    """Owner, what was found, and the rule."""
    return [(fault.owner, fault.used, fault.rule.removeprefix("truenorth.")) for fault in faults(netlist, chip)]


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
        ("mask_bits", 0, 18, "random bits", "mask_bits"),
        ("reset", -256, 255, "reset value", "reset_bits"),
        ("initial", -(2**19), 2**19 - 1, "initial membrane", "membrane_bits"),
        ("reset_mode", 0, 2, "reset mode", "reset_mode"),
        ("leak_reversal", 0, 1, "leak reversal", "leak_reversal"),
        ("negative_saturates", 0, 1, "saturation", "negative_saturates"),
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
    ("netlist", "faults"),
    [
        (made(relays()), []),
        *((made(relays(), wire_delay=n), [(SOURCE, f"delay {n}", "neuron.delay")]) for n in (0, 16, -1)),
        (made(relays(), wire_x=64), [(SOURCE, "target at (64, 0)", "mesh")]),
        (made(relays(), wire_y=6), [(SOURCE, "target at (1, 6), where no core is", "target")]),
        (made(relays(), wire_line=7), [(SOURCE, "target line 7 of core 1, which has no axon there", "target")]),
        (more(lambda d: d.wire((0, 0), 1, d.axon(1))), [(SOURCE, "2 targets on one core", "neuron.targets")]),
        (
            more(lambda d: d.wire((0, 0), d.core(2, 0), d.axon(2))),
            [(SOURCE, "targets on 2 cores without a splitter", "neuron.targets")],
        ),
        (
            more(lambda d: d.wire((1, 0), 0, 0)),
            [("core 1, neuron 0", "votes and has a target on the chip", "neuron.targets")],
        ),
        (more(lambda d: d.axon(0, 2, line=0)), [("core 0, axon 0", "types 0 and 2", "core.axon_types")]),
        (more(lambda d: d.axon(0, 0, line=0)), [("core 0, axon 0", "there twice", "core.axons")]),
        *((more(lambda d, n=n: d.axon(0, n)), [("core 0, axon 1", f"type {n}", "core.axon_types")]) for n in (4, -1)),
        (
            more(lambda d: d.axon(0), 256),
            [("core 0", "257 axons", "core.axons"), ("core 0, axon 256", "line 256", "core.axons")],
        ),
        (more(lambda d: d.core(0, 0)), [("core 2", "at (0, 0) as core 0", "mesh")]),
        (
            more(lambda d: d.core(len(d.cores) % 64, len(d.cores) // 64), 4095),
            [("core 4096", "at (0, 64)", "mesh"), ("chip", "4097 cores", "chip.cores")],
        ),
        (more(lambda d: d.clock(0, 0, period=0)), [("clock 0", "a period of 0 ticks", "clock")]),
        (more(lambda d: d.clock(1, 9, period=1)), [("clock 0", "line 9 of core 1", "target")]),
        (more(lambda d: d.feed(0, 0, 3)), [("input channel 0", "line 3 of core 0", "target")]),
        (more(lambda d: d.feed(0, 0, 0, tick=-1)), [("input channel 0", "tick -1 of a data step", "feed")]),
        (
            more(lambda d: d.neuron(0, Neuron(leak=300)), 3),
            [("core 0, neuron 1 (and 2 more on this core)", "leak 300", "neuron.leak_bits")],
        ),
    ],
)
def test_rules(netlist, faults):
    assert broken(netlist) == faults


def test_limits_are_parameters():
    assert broken(made(relays()), with_limit("mesh.reach", 0)) == [(SOURCE, "1 cores away", "mesh.reach")]
    assert broken(made(with_neuron(leak=2047)), with_limit("neuron.leak_bits", 12)) == []


# -- needs of float networks -------------------------------------------------------------------------------------------
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
    [(64, 15, False), (64, 16, True), (85, 7, False), (86, 7, True), (128, 3, False), (129, 1, False), (129, 2, True)],
)
def test_the_limit_of_levels_follows_the_axons_that_are_left(inputs, distinct, over):
    weight = np.resize(np.arange(1, distinct + 1), inputs)[None].astype(float)
    assert needed(chain(weight, beta=0.0)) == [(f"{distinct} different weights", "neuron.weight_bits")] * over


def test_zeros_are_no_level_and_the_worst_neuron_is_named():
    weight = np.zeros((3, 129))
    weight[0, :2], weight[2, :5] = 1, [1, 2, 3, 0, 4]
    (need,) = needs(chain(weight, beta=0.0), CHIP)
    assert (need.owner, need.used) == ("fc1, neuron 2", "4 different weights")


def test_a_lasting_current():
    network = wide(4, 2)
    lasting = replace(network, populations=(replace(network.populations[0], alpha=0.5),))
    assert needed(lasting) == [("keep 0.5 of their currents a step", "neuron.leak")]
