"""What one chip step does, in literal numbers, for the plain simulator and both kernels of the fast one."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from oracles import refused
from random_netlists import SIMULATORS, Axon, Neuron, build

from spikeloom.compiler.errors import DataError, NumericRangeError
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1.trace import Trace, aligned

NEVER = 2**17 - 1

pytestmark = pytest.mark.parametrize("simulate", SIMULATORS)


def single(neuron: Neuron, *weights: tuple[int, int]) -> Netlist:
    """One neuron; channel i has one synapse of (mantissa, exponent) `weights[i]` to it."""
    axons = [Axon(source=i, exponent=e, targets=((0, mantissa),)) for i, (mantissa, e) in enumerate(weights)]
    return build([neuron], axons, n_inputs=max(1, len(weights)), depths=[0])


def events(*channels: str) -> np.ndarray:
    """Events from one string of digits per channel."""
    return np.array([[int(digit) for digit in channel] for channel in channels], np.uint8)


def membranes(trace: Trace) -> list[int]:
    return trace.membranes[:, 0].tolist()


def spikes(trace: Trace, compartment: int = 0) -> list[int]:
    return np.flatnonzero(trace.spikes[:, compartment]).tolist()


@pytest.mark.parametrize(("bias", "expected"), [(0, []), (1, [0]), (-1, [])])
def test_compare_is_strict(simulate, bias, expected):
    trace = simulate(single(Neuron(threshold=100, bias=bias), (100, 0)), events("1"))
    assert membranes(trace) == [6400 + bias]
    assert spikes(trace) == expected


PLAIN = -4095 * 128
COURSES = {
    # a current loses one 4096th more than its register says; below 4096 such a membrane forgets at once
    "current loses 1": ({"decay_u": 0, "decay_v": 4095}, [(32, 0)], ["1000"], [2048, 2047, 2046, 2045]),
    "negative current": (
        {"decay_u": 0, "decay_v": 4095},
        [(-32, 0)],
        ["1000"],
        [-2048, -2047, -2046, -2045],
    ),
    "current loses half": (
        {"decay_u": 2047, "decay_v": 4095},
        [(-32, 0)],
        ["1000"],
        [-2048, -1024, -512, -256],
    ),
    "current keeps 1": ({"decay_u": 4094, "decay_v": 4095}, [(128, 0)], ["1000"], [8192, 2 + 2, 0, 0]),
    "current keeps nothing": ({"decay_u": 4095, "decay_v": 4095}, [(128, 0)], ["1000"], [8192, 0 + 2, 0, 0]),
    # a membrane loses what its register says
    "membrane keeps all": ({"decay_v": 0}, [(64, 0)], ["100"], [4096, 4096, 4096]),
    "membrane loses 1": ({"decay_v": 1}, [(64, 0)], ["100"], [4096, 4095, 4094]),
    # rounding toward zero: -(1 * 2048 // 4096) is 0, where an arithmetic shift would say -1
    "rounding": ({"decay_v": 2048, "bias": -1}, [(2, -1)], ["100"], [63, 30, 14]),
    "rounding below zero": ({"decay_v": 2048, "bias": -1}, [], ["000"], [-1, -1, -1]),
    # biases are not shifted, exponents scale
    "exponents": (
        {"decay_v": 4095, "bias": -4095, "bias_exponent": 7},
        [(-256, -1), (254, 7)],
        ["0100", "0010"],
        [PLAIN, PLAIN - 127 - 128 * 64, PLAIN - 129 + 254 * 128 * 64, PLAIN + 379],
    ),
    "largest sums": (
        {},
        [(254, 7), (254, 0), (2, -1), (-254, 7), (-254, 0), (-2, -1)],
        ["10", "10", "10", "01", "01", "01"],
        [2097088, -2097088 + 419315],
    ),
}
"""A neuron, the weights of its channels, their events, and its membranes."""


@pytest.mark.parametrize(("neuron", "weights", "channels", "expected"), COURSES.values(), ids=COURSES)
def test_membranes_of_one_neuron(simulate, neuron, weights, channels, expected):
    trace = simulate(single(Neuron(threshold=NEVER, **neuron), *weights), events(*channels))
    assert membranes(trace) == expected


def test_reset_takes_the_membrane_and_leaves_the_current(simulate):
    neuron = Neuron(decay_u=2047, decay_v=0, threshold=100)
    trace = simulate(single(neuron, (128, 0)), events("1000"))
    assert membranes(trace) == [8192, 4096, 6144, 7168]
    assert spikes(trace) == [0, 3]


def test_layers_integrate_in_their_window_only(simulate):
    # the depths leave gaps; every neuron spikes from its bias alone in each step of its window
    neurons = [Neuron(layer=i, bias=1, threshold=0) for i in range(3)]
    netlist = build(neurons, [], n_inputs=1, depths=[0, 2, 5])
    trace = simulate(netlist, np.zeros((1, 3), np.uint8))
    assert trace.spikes.shape == trace.membranes.shape == (8, 3)
    assert [spikes(trace, c) for c in range(3)] == [[0, 1, 2], [2, 3, 4], [5, 6, 7]]
    assert_array_equal(trace.membranes, trace.spikes)
    for layer in range(3):
        assert aligned(netlist, trace.spikes, layer).tolist() == [[True], [True], [True]]
        assert aligned(netlist, trace.spikes[None], layer).shape == (1, 3, 1)


def two_layers() -> Netlist:
    """254 * 128 + 254 is 32766, the largest even sum that holds; the other 2 of channel 1 are too many."""
    axons = [
        Axon(core=1, source=0, exponent=7, targets=((0, 254),)),
        Axon(core=1, source=1, exponent=0, targets=((0, 254), (0, 2))),
        Axon(core=1, source=1, exponent=7, targets=((0, -254),)),  # in another order the sum would hold
    ]
    return build([Neuron(layer=1), Neuron(layer=0, core=1)], axons, n_inputs=2, depths=[0, 1])


@pytest.mark.parametrize(
    ("netlist", "channels", "found"),
    [
        (
            two_layers(),
            ("0101", "0001"),
            "core 1, chip step 3: synaptic sum 2097152 found, magnitudes up to 2097151",
        ),
        (
            single(Neuron(), (-254, 7), (-256, 0), (254, 7)),
            "111",
            "core 0, chip step 0: synaptic sum -2097152 found",
        ),
        # the current is -8320024 after four steps
        (
            single(Neuron(decay_u=0), (-254, 7)),
            ("111111",),
            "core 0, chip step 4: current -10398760 found, magnitudes up to 8388607",
        ),
        # a sum is checked before a current
        (
            single(Neuron(decay_u=0), (254, 7), (254, 7)),
            ("11111", "00001"),
            "core 0, chip step 4: synaptic sum 4161536 found",
        ),
    ],
    ids=["positive sum", "negative sum", "current", "sum before current"],
)
def test_overflows(simulate, netlist, channels, found):
    with pytest.raises(NumericRangeError, match=f"layer0 neuron 0 on {found}.*smaller scale for layer0"):
        simulate(netlist, events(*channels))


def test_wrong_number_of_channels(simulate):
    refused(
        DataError,
        "2 input channels found, the netlist has 1",
        simulate,
        single(Neuron()),
        np.zeros((2, 3), np.uint8),
    )
