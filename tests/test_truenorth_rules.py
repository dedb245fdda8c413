"""The smallest network of crossbar cores that breaks each rule, and what is said about it."""

from dataclasses import replace

import numpy as np
import pytest

from spikeloom.compiler.errors import RuleError
from spikeloom.compiler.targets.base import CROSSBARS, load_target
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron
from spikeloom.compiler.targets.truenorth.legalize import faults, require_legal

CHIP = load_target("truenorth", CROSSBARS)


def small() -> Draft:
    """Two cores; an input reaches neuron 0 of core 0, whose spikes reach neuron 0 of core 1, which votes."""
    draft = Draft()
    for x in (0, 1):
        draft.core(x, 0)
        draft.axon(x)
        draft.neuron(x, Neuron(), layer=f"layer{x}")
        draft.connect(x, 0, [0])
    draft.feed(0, 0, 0)
    draft.wire((0, 0), 1, 0)
    draft.vote((1, 0), 0)
    return draft


def made(draft: Draft):
    return draft.netlist(taxels=1, polarities=1, classes=1)


def told(draft: Draft) -> list[str]:
    return [str(fault) for fault in faults(made(draft), CHIP)]


def with_neuron(**changes) -> Draft:
    draft = small()
    draft.cores[0].neurons[0] = (replace(Neuron(), **changes), 0, 0)
    return draft


def with_wire(*, core: int = 1, line: int = 0, delay: int = 1) -> Draft:
    draft = small()
    draft.wires.clear()
    draft.wire((0, 0), core, line, delay)
    return draft


def test_a_legal_network_has_no_fault():
    assert told(small()) == []
    require_legal(made(small()), CHIP)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"weights": (0, 256, 0, 0)},
            "weight of type 1 256, allowed -256 … 255 (truenorth.neuron.weight_bits); "
            "a smaller scale, or the input on several axons",
        ),
        (
            {"weights": (0, 0, 0, -257)},
            "weight of type 3 -257, allowed -256 … 255 (truenorth.neuron.weight_bits); "
            "a smaller scale, or the input on several axons",
        ),
        ({"leak": 256}, "leak 256, allowed -256 … 255 (truenorth.neuron.leak_bits); a smaller scale"),
        ({"leak": -257}, "leak -257, allowed -256 … 255 (truenorth.neuron.leak_bits); a smaller scale"),
        (
            {"threshold": 2**18},
            "threshold 262144, allowed 0 … 262143 (truenorth.neuron.threshold_bits); a smaller scale",
        ),
        ({"threshold": -1}, "threshold -1, allowed 0 … 262143 (truenorth.neuron.threshold_bits); a smaller scale"),
        (
            {"negative_threshold": 2**18},
            "negative threshold 262144, allowed 0 … 262143 (truenorth.neuron.threshold_bits); a smaller scale",
        ),
        ({"mask_bits": 19}, "random bits 19, allowed 0 … 18 (truenorth.neuron.mask_bits); fewer bits"),
        ({"reset": 256}, "reset value 256, allowed -256 … 255 (truenorth.neuron.reset_bits); reset nearer to zero"),
        (
            {"initial": 2**19},
            "initial membrane 524288, allowed -524288 … 524287 (truenorth.neuron.membrane_bits); start nearer to zero",
        ),
        ({"reset_mode": 3}, "reset mode 3, allowed 0 … 2 (truenorth.neuron.reset_mode); use one of the modes"),
        ({"leak_reversal": 2}, "leak reversal 2, allowed 0 … 1 (truenorth.neuron.leak_reversal); use a flag"),
        (
            {"negative_saturates": 2},
            "saturation 2, allowed 0 … 1 (truenorth.neuron.negative_saturates); use a flag",
        ),
    ],
)
def test_parameters_beyond_their_registers(changes, line):
    assert told(with_neuron(**changes)) == [f"core 0, neuron 0: {line}"]


@pytest.mark.parametrize(
    "changes",
    [
        {"weights": (255, -256, 255, -256)},
        {"leak": 255},
        {"leak": -256},
        {"threshold": 2**18 - 1},
        {"threshold": 0},
        {"negative_threshold": 2**18 - 1},
        {"mask_bits": 18},
        {"reset": -256},
        {"initial": -(2**19)},
        {"reset_mode": 2},
    ],
)
def test_parameters_at_the_ends_of_their_registers(changes):
    assert told(with_neuron(**changes)) == []


@pytest.mark.parametrize("delay", [0, 16, -1])
def test_delay(delay):
    assert told(with_wire(delay=delay)) == [
        f"core 0, neuron 0: delay {delay}, allowed 1 … 15 ticks (truenorth.neuron.delay); add relays for longer ways"
    ]
    assert told(with_wire(delay=15)) == []


def test_target_off_the_grid():
    draft = small()
    draft.wires.clear()
    draft.wire_to((0, 0), (64, 0), 0)
    assert told(draft) == [
        "core 0, neuron 0: target at (64, 0), allowed x 0 … 63 and y 0 … 63 (truenorth.mesh); aim at a core of the mesh"
    ]


def test_target_without_core_or_axon():
    draft = small()
    draft.wires.clear()
    draft.wire_to((0, 0), (5, 6), 0)
    end = "allowed an axon of a core (truenorth.target); add the axon, or leave the wire away"
    assert told(draft) == [f"core 0, neuron 0: target at (5, 6), where no core is, {end}"]
    assert told(with_wire(line=7)) == [f"core 0, neuron 0: target line 7 of core 1, which has no axon there, {end}"]


def test_target_out_of_reach():
    near = replace(CHIP, limits=CHIP.limits | {"mesh.reach": replace(CHIP.limits["mesh.reach"], value=0)})
    assert [str(fault) for fault in faults(made(small()), near)] == [
        "core 0, neuron 0: 1 cores away, allowed 0 (truenorth.mesh.reach); place the cores nearer to each other"
    ]


def test_two_targets_on_one_core():
    draft = small()
    draft.axon(1)
    draft.wire((0, 0), 1, 1)
    assert told(draft) == [
        "core 0, neuron 0: 2 targets on one core, allowed 1 (truenorth.neuron.targets); "
        "let one axon reach all neurons, copy the neuron, or split its spikes by relays"
    ]


def test_fan_out_without_a_splitter_and_with_one():
    draft = small()
    third = draft.core(2, 0)
    draft.axon(third)
    draft.wire((0, 0), third, 0)
    assert told(draft) == [
        "core 0, neuron 0: targets on 2 cores without a splitter, allowed 1 (truenorth.neuron.targets); "
        "copy the neuron, or split its spikes by relays"
    ]
    draft.wires.clear()
    draft.split((0, 0), [(1, 0), (third, 0)], draft.core(0, 1))
    assert told(draft) == []


def test_a_neuron_that_votes_has_no_other_target():
    draft = small()
    draft.wire((1, 0), 0, 0)
    assert told(draft) == [
        "core 1, neuron 0: votes and has a target on the chip, allowed 1 (truenorth.neuron.targets); "
        "copy the neuron, or split its spikes by relays"
    ]


def test_axon_type_conflict():
    draft = small()
    draft.axon(0, 2, line=0)
    assert told(draft) == [
        "core 0, axon 0: types 0 and 2, allowed one type to an axon (truenorth.core.axon_types); "
        "a type belongs to an axon, for all neurons of its core: copy the input onto a second axon"
    ]


def test_an_axon_twice():
    draft = small()
    draft.axon(0, 0, line=0)
    assert told(draft) == [
        "core 0, axon 0: there twice, allowed one axon to a line (truenorth.core.axons); "
        "connect its neurons to one of them"
    ]


@pytest.mark.parametrize("kind", [4, -1])
def test_axon_types(kind):
    draft = small()
    draft.axon(0, kind)
    assert told(draft) == [
        f"core 0, axon 1: type {kind}, allowed 0 … 3 (truenorth.core.axon_types); use one of the types"
    ]


def test_too_many_axons():
    draft = small()
    for _ in range(256):
        draft.axon(0)
    assert told(draft) == [
        "core 0: 257 axons, allowed 256 (truenorth.core.axons); fewer inputs or copies of inputs, or more cores",
        "core 0, axon 256: line 256, allowed 0 … 255 (truenorth.core.axons); use a line of the core",
    ]


def test_too_many_neurons():
    draft = small()
    for _ in range(256):
        draft.neuron(0, Neuron())
    assert told(draft) == ["core 0: 257 neurons, allowed 256 (truenorth.core.neurons); use more cores"]


def test_too_many_cores():
    draft = small()
    for core in range(2, 4097):
        draft.core(core % 64, core // 64)
    assert told(draft) == [
        "core 4096: at (0, 64), allowed x 0 … 63 and y 0 … 63 (truenorth.mesh); place it on the mesh",
        "chip: 4097 cores, allowed 4096 (truenorth.chip.cores); fewer neurons, inputs or copies",
    ]


def test_two_cores_on_one_place():
    draft = small()
    draft.core(0, 0)
    assert told(draft) == [
        "core 2: at (0, 0) as core 0, allowed one core to a place (truenorth.mesh); place it elsewhere"
    ]


@pytest.mark.parametrize(
    ("clock", "lines"),
    [
        (
            (0, 0, 0, 0),
            ["clock 0: a period of 0 ticks, allowed 1 or more (truenorth.clock); say every how many ticks it spikes"],
        ),
        (
            (0, 0, 1, -1),
            ["clock 0: phase -1, allowed 0 or later (truenorth.clock); start it with the recording"],
        ),
        (
            (1, 9, 1, 0),
            [
                "clock 0: line 9 of core 1, allowed an axon of a core (truenorth.target); "
                "add the axon, or leave the clock away"
            ],
        ),
    ],
)
def test_clocks(clock, lines):
    draft = small()
    draft.clocks.append(clock)
    assert told(draft) == lines


def test_feeds():
    draft = small()
    draft.feed(0, 0, 3)
    draft.feed(0, 0, 0, tick=-1)
    assert told(draft) == [
        "input channel 0: line 3 of core 0, allowed an axon of a core (truenorth.target); "
        "add the axon, or leave the feed away",
        "input channel 0: tick -1 of a data step, allowed 0 or later (truenorth.feed); feed it when it is there",
    ]


def test_offenders_on_a_core_share_a_line():
    draft = small()
    for _ in range(3):
        draft.neuron(0, Neuron(leak=300))
    assert told(draft) == [
        "core 0, neuron 1 (and 2 more on this core): leak 300, allowed -256 … 255 (truenorth.neuron.leak_bits); "
        "a smaller scale"
    ]


def test_everything_is_told_at_once():
    draft = with_neuron(weights=(300, 0, 0, 0), threshold=2**18, leak=-999)
    draft.wires.clear()
    draft.wire((0, 0), 1, 0, 16)
    draft.wire_to((0, 0), (-1, 0), 0, 0)
    draft.axon(0, 1, line=0)
    draft.clock(0, 0, period=0)
    netlist = made(draft)
    with pytest.raises(RuleError) as caught:
        require_legal(netlist, CHIP)
    found = [fault.rule.removeprefix("truenorth.") for fault in caught.value.faults]
    assert found == [
        *("core.axon_types", "neuron.weight_bits", "neuron.leak_bits", "neuron.threshold_bits", "neuron.targets"),
        *("neuron.delay", "mesh", "clock"),
    ]
    assert str(caught.value).splitlines() == [str(fault) for fault in faults(netlist, CHIP)]


def test_unverified_limits_are_parameters():
    wide = replace(CHIP, limits=CHIP.limits | {"neuron.leak_bits": replace(CHIP.limits["neuron.leak_bits"], value=12)})
    netlist = made(with_neuron(leak=2047))
    assert faults(netlist, wide) == ()
    assert len(faults(netlist, CHIP)) == 1


def test_hops_and_places():
    netlist = made(small())
    assert netlist.hops().tolist() == [1]
    assert netlist.cores_at(np.array([1, 7]), np.array([0, 0])).tolist() == [1, -1]
