"""A network in the integers of the chip, not yet on cores: populations, projections, what they mean and their rules.

What a step means stands in :mod:`machines.loihi1.spec`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.interpret import Activity, Layer, Simulation, synapses_of
from spikeloom.compiler.invariants import Faults, graph_faults, require_none
from spikeloom.compiler.ir import Form, Input, Readout, Sparse, with_data
from spikeloom.compiler.targets.loihi1.registers import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    DECAY_ONE,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    THRESHOLD_MANTISSA_MAX,
    kept_shares,
    weight_step,
)
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

MANTISSA = np.int16
"""Type that mantissas are stored in."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntegerPopulation:
    """Neurons of a population in the chip's registers; units as in :class:`netlist.Netlist`."""

    name: str  # Unique in the network
    beta: float  # Of the float model, as theta and alpha
    theta: float
    scale: FloatArray  # (neurons,) float64; weight units per membrane unit of the float model
    decay_u: int  # Decay register of the current
    decay_v: int  # Decay register of the membrane
    threshold: IntArray  # (neurons,) int64; threshold mantissas
    bias_mantissa: IntArray  # (neurons,) int64
    bias_exponent: IntArray  # (neurons,) int64
    alpha: float = 0.0

    @property
    def size(self) -> int:
        """Number of neurons."""
        return len(self.threshold)

    @property
    def bias(self) -> IntArray:
        """``mantissa * 2**exponent``, membrane units; shape (neurons,)."""
        return self.bias_mantissa << self.bias_exponent

    @property
    def realised_beta(self) -> float:
        """Decay factor of the membrane register."""
        return float(kept_shares(self.decay_u, self.decay_v)[1])

    @property
    def realised_alpha(self) -> float:
        """Decay factor of the current register."""
        return float(kept_shares(self.decay_u, self.decay_v)[0])

    @property
    def realised_theta(self) -> FloatArray:
        """Thresholds in the float model's units; shape (neurons,)."""
        return self.threshold / self.scale


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntegerProjection:
    """Synapses as stored: mantissas of `bits` bits with a common exponent."""

    # pre, post: Population indices; `pre` may be ``INPUT``
    pre: int
    post: int
    weight: Sparse  # Signed mantissas, usually ``MANTISSA``
    exponent: int  # A synapse adds ``mantissa * 2**exponent`` weight units
    bits: int  # Storage width of a mantissa

    def effective(self) -> Sparse:
        """Weights in weight units, csr_array of int32; exact, since mantissas are even."""
        units = self.weight.data.astype(np.int32)
        if self.exponent < 0:
            units >>= 1
        else:
            units <<= self.exponent
        return with_data(self.weight, units)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntegerNetwork:
    """A spiking network in chip integers, not yet on cores."""

    input: Input
    populations: tuple[IntegerPopulation, ...]
    projections: tuple[IntegerProjection, ...]
    readout: Readout
    classes: int

    @property
    def forms(self) -> tuple[Form, ...]:
        """How each population is stored."""
        forms = []
        for post, population in enumerate(self.populations):
            planes = [p for p in self.projections if p.post == post]
            exponents = tuple(sorted({p.exponent for p in planes}))
            forms.append(Form(bits=planes[0].bits, exponents=exponents, threshold=population.threshold))
        return tuple(forms)


def integer_layer(
    population: IntegerPopulation,
    projections: Sequence[IntegerProjection],
    *,
    saturates: bool = True,
    loops: bool = True,
) -> Layer:
    """A population on the chip with all projections to it; the machine's ``spec`` holds the definition.

    With `saturates` off the membrane has no limits, which tells what saturation does; `loops` as of
    :func:`float_layer`.
    """
    keep_u, keep_v = (
        round(kept * DECAY_ONE) for kept in (population.realised_alpha, population.realised_beta)
    )
    weights = [(p, p.effective() * (1 << MEMBRANE_SHIFT)) for p in projections]
    largest = sum(abs(weight).sum(axis=1).max(initial=0) for _, weight in weights)
    largest += MEMBRANE_MAX + (
        BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX
    )  # of any bias: `Layer.with_bias` changes it
    # 32 bits are as exact, and twice as fast, where membranes have limits and no current outlasts its step
    dtype = np.int32 if saturates and not keep_u and largest < 2**31 else np.int64
    limit = MEMBRANE_MAX if saturates else 2**62
    pres, synapses = synapses_of(weights, dtype, loops=loops)
    threshold = (population.threshold << MEMBRANE_SHIFT).astype(dtype)
    registers = threshold, *(dtype(value) for value in (keep_u, keep_v, limit))
    return Layer(
        pres=pres, size=population.size, fixed=(*synapses, population.bias.astype(dtype), registers)
    )


def integer_simulation(network: IntegerNetwork, *, saturates: bool = True) -> Simulation:
    """The integer stage; `saturates` as of :func:`integer_layer`."""
    into = [[p for p in network.projections if p.post == post] for post in range(len(network.populations))]
    layers = zip(network.populations, into, strict=True)
    return Simulation(layers=tuple(integer_layer(*each, saturates=saturates) for each in layers))


def run_integer(
    network: IntegerNetwork, events: BoolArray, *, membranes: bool = False, saturates: bool = True
) -> Activity:
    """Run the integer stage, aligned with the data; membranes are register values."""
    return integer_simulation(network, saturates=saturates).run(events, membranes=membranes)


def _registers_hold(network: IntegerNetwork) -> Faults:
    for population in network.populations:
        for what, values, low, high in (
            ("decay", np.array([population.decay_u, population.decay_v]), 0, 4095),
            ("threshold", population.threshold, 0, THRESHOLD_MANTISSA_MAX),
            ("bias mantissa", population.bias_mantissa, -BIAS_MANTISSA_MAX, BIAS_MANTISSA_MAX),
            ("bias exponent", population.bias_exponent, 0, BIAS_EXPONENT_MAX),
        ):
            if np.any((values < low) | (values > high)):
                yield f"population {population.name!r} has a {what} outside {low} … {high}"


def _mantissas_hold(network: IntegerNetwork) -> Faults:
    for i, projection in enumerate(network.projections):
        step = weight_step(projection.bits)
        data = projection.weight.data
        if data.dtype.kind != "i" or np.any(data % step) or np.any(data < -256) or np.any(data > 256 - step):
            yield f"projection {i} has mantissas that {projection.bits} bits cannot hold"
        if projection.exponent < -1:
            yield f"projection {i} has exponent {projection.exponent}: below -1 its weights are no whole units"


def verify(network: IntegerNetwork) -> None:
    """Check every rule; VerifyError names all that are broken."""
    require_none([*graph_faults(network), *_registers_hold(network), *_mantissas_hold(network)])
