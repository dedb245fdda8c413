"""The smallest network of crossbar cores that breaks each rule, what is said about it; and needs of float networks."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_files import own_file
from random_crossbars import CHIP, relays, with_limit
from random_networks import chain

from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron
from spikeloom.compiler.targets.truenorth.legalize import faults, require_legal
from spikeloom.compiler.targets.truenorth.needs import needs
from spikeloom.runtime import cli


def made(draft: Draft):
    return draft.netlist(taxels=1, polarities=1, classes=1)


def broken(draft: Draft, chip=CHIP) -> list[tuple[str, str, str]]:
    """Owner, what was found, and the rule."""
    return [(fault.owner, fault.used, fault.rule.removeprefix("truenorth.")) for fault in faults(made(draft), chip)]


def with_neuron(**changes) -> Draft:
    draft = relays()
    draft.cores[0].neurons[0] = (replace(Neuron(), **changes), 0, 0)
    return draft


def test_a_legal_network_has_no_fault():
    assert broken(relays()) == []
    require_legal(made(relays()), CHIP)


@pytest.mark.parametrize(
    ("changes", "found", "rule"),
    [
        ({"weights": (0, 256, 0, 0)}, "weight of type 1 256", "weight_bits"),
        ({"weights": (0, 0, 0, -257)}, "weight of type 3 -257", "weight_bits"),
        ({"leak": 256}, "leak 256", "leak_bits"),
        ({"leak": -257}, "leak -257", "leak_bits"),
        ({"threshold": 2**18}, "threshold 262144", "threshold_bits"),
        ({"threshold": -1}, "threshold -1", "threshold_bits"),
        ({"negative_threshold": 2**18}, "negative threshold 262144", "threshold_bits"),
        ({"mask_bits": 19}, "random bits 19", "mask_bits"),
        ({"reset": 256}, "reset value 256", "reset_bits"),
        ({"initial": 2**19}, "initial membrane 524288", "membrane_bits"),
        ({"reset_mode": 3}, "reset mode 3", "reset_mode"),
        ({"leak_reversal": 2}, "leak reversal 2", "leak_reversal"),
        ({"negative_saturates": 2}, "saturation 2", "negative_saturates"),
    ],
)
def test_parameters_beyond_their_registers(changes, found, rule):
    assert broken(with_neuron(**changes)) == [("core 0, neuron 0", found, f"neuron.{rule}")]


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
    assert broken(with_neuron(**changes)) == []


def more(change: Callable[[Draft], object], times: int = 1) -> Draft:
    draft = relays()
    for _ in range(times):
        change(draft)
    return draft


def rewired(aim: Callable[[Draft], object]) -> Draft:
    draft = relays()
    draft.wires.clear()
    aim(draft)
    return draft


def second_target(draft: Draft) -> None:
    draft.wire((0, 0), 1, draft.axon(1))


def third_core(draft: Draft) -> None:
    third = draft.core(2, 0)
    draft.wire((0, 0), third, draft.axon(third))


SOURCE = "core 0, neuron 0"


@pytest.mark.parametrize(
    ("draft", "faults"),
    [
        (rewired(lambda d: d.wire((0, 0), 1, 0, 15)), []),
        *(
            (rewired(lambda d, n=n: d.wire((0, 0), 1, 0, n)), [(SOURCE, f"delay {n}", "neuron.delay")])
            for n in (0, 16, -1)
        ),
        (rewired(lambda d: d.wire_to((0, 0), (64, 0), 0)), [(SOURCE, "target at (64, 0)", "mesh")]),
        (rewired(lambda d: d.wire_to((0, 0), (5, 6), 0)), [(SOURCE, "target at (5, 6), where no core is", "target")]),
        (
            rewired(lambda d: d.wire((0, 0), 1, 7)),
            [(SOURCE, "target line 7 of core 1, which has no axon there", "target")],
        ),
        (more(second_target), [(SOURCE, "2 targets on one core", "neuron.targets")]),
        (more(third_core), [(SOURCE, "targets on 2 cores without a splitter", "neuron.targets")]),
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
        (more(lambda d: d.neuron(0, Neuron()), 256), [("core 0", "257 neurons", "core.neurons")]),
        (more(lambda d: d.core(0, 0)), [("core 2", "at (0, 0) as core 0", "mesh")]),
        (
            more(lambda d: d.core(len(d.cores) % 64, len(d.cores) // 64), 4095),
            [("core 4096", "at (0, 64)", "mesh"), ("chip", "4097 cores", "chip.cores")],
        ),
        (more(lambda d: d.clock(0, 0, period=0)), [("clock 0", "a period of 0 ticks", "clock")]),
        (more(lambda d: d.clock(0, 0, period=1, phase=-1)), [("clock 0", "phase -1", "clock")]),
        (more(lambda d: d.clock(1, 9, period=1)), [("clock 0", "line 9 of core 1", "target")]),
        (more(lambda d: d.feed(0, 0, 3)), [("input channel 0", "line 3 of core 0", "target")]),
        (more(lambda d: d.feed(0, 0, 0, tick=-1)), [("input channel 0", "tick -1 of a data step", "feed")]),
        (
            more(lambda d: d.neuron(0, Neuron(leak=300)), 3),
            [("core 0, neuron 1 (and 2 more on this core)", "leak 300", "neuron.leak_bits")],
        ),
    ],
)
def test_rules(draft, faults):
    assert broken(draft) == faults


def test_a_splitter_mends_fan_out():
    def split(draft):
        third = draft.core(2, 0)
        draft.split((0, 0), [(1, 0), (third, draft.axon(third))], draft.core(0, 1))

    assert broken(rewired(split)) == []


def test_everything_at_once():
    draft = with_neuron(weights=(300, 0, 0, 0), threshold=2**18, leak=-999)
    draft.wires.clear()
    draft.wire((0, 0), 1, 0, 16)
    draft.wire_to((0, 0), (-1, 0), 0, 0)
    draft.axon(0, 1, line=0)
    draft.clock(0, 0, period=0)
    with pytest.raises(CapacityError) as caught:
        require_legal(made(draft), CHIP)
    assert [fault.rule.removeprefix("truenorth.") for fault in caught.value.violations] == [
        *("core.axon_types", "neuron.weight_bits", "neuron.leak_bits", "neuron.threshold_bits", "neuron.targets"),
        *("neuron.delay", "mesh", "clock"),
    ]
    assert "core 0, neuron 0: leak -999, -256 … 255 allowed (truenorth.neuron.leak_bits)" in str(caught.value)


def test_limits_are_parameters():
    assert broken(relays(), with_limit("mesh.reach", 0)) == [(SOURCE, "1 cores away", "mesh.reach")]
    assert broken(with_neuron(leak=2047), with_limit("neuron.leak_bits", 12)) == []


def test_hops_and_places():
    netlist = made(relays())
    assert netlist.hops().tolist() == [1]
    assert netlist.cores_at(np.array([1, 7]), np.array([0, 0])).tolist() == [1, -1]


# -- needs of float networks -------------------------------------------------------------------------------------------


def wide(inputs: int, *sizes: int, beta=0.2, same: bool = False):
    """A chain of full layers; all weights equal, or all different."""
    rng, widths = np.random.default_rng(0), (inputs, *sizes)
    drawn = [rng.normal(size=(after, before)) for before, after in pairwise(widths)]
    return chain(*(np.ones_like(weight) if same else weight for weight in drawn), beta=beta)


def needed(network) -> list[tuple[str, str]]:
    return [(need.used, need.rule.removeprefix("truenorth.")) for need in needs(network, CHIP)]


def test_every_need_of_every_layer():
    assert needed(wide(300, 5, 3)) == [
        ("keep 0.2 of their membranes a step", "neuron.leak"),
        ("300 inputs", "core.axons"),
        ("300 different weights", "neuron.weight_bits"),
        ("send spikes to 2 axons at least", "neuron.targets"),
        ("keep 0.2 of their membranes a step", "neuron.leak"),
    ]
    worst = needs(wide(300, 5, 3), CHIP)[2]
    assert worst.owner == "fc1, neuron 0 (and 4 more)"
    assert worst.allowed == "1 with 1 axon an input"


@pytest.mark.parametrize("inputs", [64, 256, 257, 300])
def test_the_limit_of_inputs(inputs):
    over = [(f"{inputs} inputs", "core.axons")] * (inputs > 256)
    assert needed(wide(inputs, 3, beta=0.0, same=True)) == over


@pytest.mark.parametrize(
    ("inputs", "distinct", "over"),
    [(64, 15, False), (64, 16, True), (85, 7, False), (86, 7, True), (128, 3, False), (129, 1, False), (129, 2, True)],
)
def test_the_limit_of_levels_follows_the_axons_that_are_left(inputs, distinct, over):
    weight = np.resize(np.arange(1, distinct + 1), inputs)[None].astype(float)
    found = [(f"{distinct} different weights", "neuron.weight_bits")] * over
    assert needed(chain(weight, beta=0.0)) == found


def test_zeros_are_no_level_and_the_worst_neuron_is_named():
    weight = np.zeros((3, 129))
    weight[0, :2], weight[2, :5] = 1, [1, 2, 3, 0, 4]
    (need,) = needs(chain(weight, beta=0.0), CHIP)
    assert (need.owner, need.used) == ("fc1, neuron 2", "4 different weights")


def test_a_lasting_current():
    network = wide(4, 2, beta=0.0, same=True)
    lasting = replace(network, populations=(replace(network.populations[0], alpha=0.5),))
    assert needed(lasting) == [("keep 0.5 of their currents a step", "neuron.leak")]


@pytest.mark.parametrize(("receivers", "axons"), [(256, 2), (257, 4)])
def test_targets_grow_with_the_cores_that_receive(receivers, axons):
    found = needed(wide(2, 2, receivers, beta=0.0, same=True))
    assert found == [(f"send spikes to {axons} axons at least", "neuron.targets")]


def test_compile_lists_what_does_not_fit_and_the_ways(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    own_file(tmp_path / "own.pt")
    words = ["compile", "own.pt", "--target", "truenorth", "-o", "x.loom"]
    assert cli.main(words) == 2
    err = capsys.readouterr().err
    assert "conv1, all 30 neurons: keep 0.2 of their membranes a step, an added leak allowed" in err
    assert "--in-time N" in err
    assert "spikeloom train --system tactilesgnet-truenorth" in err
    assert not (tmp_path / "x.loom").exists()
    assert cli.main([*words, "--weight-bits", "4"]) == 2
    assert "--weight-bits 4: is not for truenorth; omit it" in capsys.readouterr().err
