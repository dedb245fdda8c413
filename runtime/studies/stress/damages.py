"""What may happen to a network on its chip, done to the netlist and to the float network alike.

A damage takes a :class:`Pair` and hands back another. What is stored in integers is changed there; the float weight
moves by as much in its own units, which is the same relative change up to rounding. Compartments alone are damaged: a
neuron that the chip does not hold stays as it is in the float network.
"""

from dataclasses import replace

import numpy as np
from scipy import sparse

from spikeloom.compiler import Netlist, fixedpoint
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.types import AnyArray, BoolArray, FloatArray, IntArray
from spikeloom.runtime.studies.stress.pair import Pair, perturbation

HIDDEN = "share of hidden neurons"


def with_weights(pair: Pair, weight: AnyArray) -> Pair:
    """Store other mantissas (synapses,); float weights move by as many weight units.

    Entries in which nothing changes keep their float weight, bit for bit.
    """
    netlist, network = pair.netlist, pair.network
    stored = replace(netlist, synapse_weight=fixedpoint.frozen(weight.astype(netlist.synapse_weight.dtype)))
    moved = np.flatnonzero(weight != netlist.synapse_weight)
    axon = netlist.axon_of_synapse()[moved]
    units = stored.effective_weight()[moved] - netlist.effective_weight()[moved]
    target = netlist.synapse_compartment()[moved]
    source = netlist.axon_source[axon]
    inner = source >= netlist.n_inputs
    sender = np.where(inner, source - netlist.n_inputs, 0)
    pre = np.where(inner, netlist.layer[sender], INPUT)
    column = np.where(inner, netlist.neuron[sender], source)
    post, row, step = netlist.layer[target], netlist.neuron[target], units / netlist.scale[target]
    projections = []
    for projection in network.projections:
        here = (post == projection.post) & (pre == projection.pre)
        more = sparse.csr_array((step[here], (row[here], column[here])), shape=projection.weight.shape)
        projections.append(replace(projection, weight=projection.weight + more if here.any() else projection.weight))
    return Pair(netlist=stored, network=replace(network, projections=tuple(projections), convolution=None))


def _codes(netlist: Netlist) -> tuple[IntArray, IntArray]:
    """Stored weights in steps of their format, and the width of each; both (synapses,) int64."""
    bits = netlist.format_weight_bits[netlist.axon_format[netlist.axon_of_synapse()]]
    return netlist.synapse_weight.astype(np.int64) // weight_steps(bits), bits


def weight_steps(bits: IntArray) -> IntArray:
    """Distance of neighbouring mantissas of each width; as :func:`fixedpoint.weight_step`."""
    return np.array([0, 0, *(fixedpoint.weight_step(width) for width in range(2, 9))])[bits]


@perturbation("probability", (1e-4, 1e-3, 0.01, 0.05))
def weight_bit_flips(pair: Pair, share: float, rng: np.random.Generator) -> Pair:
    """Each stored bit of a weight flips with a probability.

    Of synaptic memory; weights in two's complement.
    """
    code, bits = _codes(pair.netlist)
    last = np.cumsum(bits)
    total = int(last[-1]) if len(last) else 0
    bit = np.unique(rng.integers(0, max(total, 1), rng.binomial(total, share)))
    synapse = np.searchsorted(last, bit, side="right")
    flips = np.zeros(len(code), np.int64)
    np.bitwise_or.at(flips, synapse, np.int64(1) << (last[synapse] - 1 - bit))
    half = np.int64(1) << (bits - 1)
    flipped = (((code + 2 * half) ^ flips) & (2 * half - 1)) + half
    return with_weights(pair, ((flipped & (2 * half - 1)) - half) * weight_steps(bits))


def relays(pair: Pair) -> BoolArray:
    """Compartments that relay a clock; (compartments,)."""
    first = np.array([population.size - population.relays for population in pair.network.populations])
    return np.asarray(first[pair.netlist.layer] <= pair.netlist.neuron)


def hidden(pair: Pair) -> IntArray:
    """Compartments that neither vote nor relay a clock; (…,) int64."""
    return np.asarray(np.flatnonzero((pair.netlist.readout_class < 0) & ~relays(pair)))


@perturbation(HIDDEN, (0.05, 0.1, 0.25, 0.5))
def neurons_silent(pair: Pair, share: float, rng: np.random.Generator) -> Pair:
    """Random hidden neurons never fire."""
    return stick_neurons(pair, share, rng, firing=False)


@perturbation(HIDDEN, (0.005, 0.02, 0.05, 0.1))
def neurons_firing(pair: Pair, share: float, rng: np.random.Generator) -> Pair:
    """Random hidden neurons fire in every step."""
    return stick_neurons(pair, share, rng, firing=True)


def stick_neurons(pair: Pair, share: float, rng: np.random.Generator, *, firing: bool) -> Pair:
    """Some hidden neurons never fire, or fire in every step, whatever reaches them."""
    netlist = pair.netlist
    among = hidden(pair)
    stuck = np.zeros(netlist.n_compartments, np.bool_)
    stuck[rng.permutation(among)[: round(share * len(among))]] = True
    target = netlist.synapse_compartment()
    held = replace(
        netlist,
        synapse_weight=fixedpoint.frozen(
            np.where(stuck[target], 0, netlist.synapse_weight).astype(netlist.synapse_weight.dtype)
        ),
        bias_mantissa=fixedpoint.read_only(np.where(stuck, int(firing), netlist.bias_mantissa)),
        bias_exponent=fixedpoint.read_only(np.where(stuck, 0, netlist.bias_exponent)),
        threshold=fixedpoint.read_only(np.where(stuck & firing, 0, netlist.threshold)),
    )

    return Pair(
        netlist=held, network=inputs_scaled(pair, np.where(stuck, 0.0, 1.0), np.where(stuck, 2.0 * firing, 0.0))
    )


def with_thresholds(pair: Pair, threshold: IntArray) -> Pair:
    """Other threshold mantissas (compartments,); in the float network they change by the same factor.

    A neuron with another threshold fires as one with the old one whose weights and bias are divided by the factor.
    """
    netlist = pair.netlist
    held = np.where(relays(pair), netlist.threshold, np.clip(threshold, 1, fixedpoint.THRESHOLD_MANTISSA_MAX))
    factor = np.maximum(netlist.threshold, 1) / np.maximum(held, 1)
    network = inputs_scaled(pair, factor, np.zeros(len(factor)))
    return Pair(netlist=replace(netlist, threshold=fixedpoint.read_only(held)), network=network)


def inputs_scaled(pair: Pair, factor: FloatArray, more: FloatArray) -> Network:
    """The float network with weights and bias of each compartment's neuron times a factor, and `more` thresholds."""
    netlist, populations, factors = pair.netlist, [], []
    for number, population in enumerate(pair.network.populations):
        ids = netlist.compartments_of(number)
        scale, bias = np.ones(population.size), population.bias.copy()
        scale[netlist.neuron[ids]] = factor[ids]
        bias[netlist.neuron[ids]] = bias[netlist.neuron[ids]] * factor[ids] + population.theta * more[ids]
        factors.append(scale)
        populations.append(replace(population, bias=bias))
    projections = []
    for projection in pair.network.projections:
        weight = projection.weight.copy()
        weight.data *= np.repeat(factors[projection.post], np.diff(weight.indptr))
        projections.append(replace(projection, weight=weight))
    changed = replace(pair.network, populations=tuple(populations), projections=tuple(projections))
    return replace(changed, convolution=None)


def scale_thresholds(pair: Pair, factor: FloatArray | float) -> Pair:
    """Multiply all thresholds by a factor, or each by its own (compartments,); rounded to what registers hold."""
    return with_thresholds(pair, np.rint(pair.netlist.threshold * np.asarray(factor)).astype(np.int64))


@perturbation("standard deviation, share", (0.05, 0.1, 0.2, 0.4))
def threshold_spread(pair: Pair, spread: float, rng: np.random.Generator) -> Pair:
    """Each threshold drifts by a factor of its own.

    Normal around 1, not below a twentieth.
    """
    drift = rng.standard_normal(pair.netlist.n_compartments)
    return scale_thresholds(pair, np.maximum(1 + spread * drift, 0.05))


@perturbation("times", (1.05, 1.1, 1.25, 1.5, 2), least=1, most=1000)
def threshold_raised(pair: Pair, factor: float) -> Pair:
    """All thresholds rise: towards a silent network."""
    return scale_thresholds(pair, factor)


@perturbation("times", (0.95, 0.9, 0.75, 0.5))
def threshold_lowered(pair: Pair, factor: float) -> Pair:
    """All thresholds fall: towards a saturated network."""
    return scale_thresholds(pair, factor)


@perturbation("units", (1, 2), most=1000)
def ties_fire(pair: Pair, units: int) -> Pair:
    """Thresholds fall by register units: at 1, more than every tie fires (>= for >)."""
    return with_thresholds(pair, pair.netlist.threshold - units)


def no_windows(pair: Pair) -> str | None:
    """Why layers cannot be late."""
    return "its layers have no windows" if pair.netlist.blank else None


@perturbation("steps", (1, 2, 5, 25), most=1000, unless=no_windows)
def layers_late(pair: Pair, steps: int) -> Pair:
    """Layers after the first open their windows late, off by one and more.

    They miss the first steps of their input. The float network needs no change: it takes depths from the netlist.
    """
    layers = tuple(replace(layer, depth=layer.depth + steps) if layer.depth else layer for layer in pair.netlist.layers)
    return Pair(netlist=replace(pair.netlist, layers=layers), network=pair.network)


def several_planes(pair: Pair) -> str | None:
    """Why a stored weight has no bits of its own."""
    netlist = pair.netlist
    exponent = netlist.format_exponent[netlist.axon_format[netlist.axon_of_synapse()]]
    kinds = {*zip(netlist.layer[netlist.synapse_compartment()].tolist(), exponent.tolist(), strict=True)}
    return "weights are stored in several planes" if len(kinds) > len({layer for layer, _ in kinds}) else None


@perturbation("bits", (6, 5, 4, 3, 2), least=2, most=8, unless=several_planes)
def fewer_bits(pair: Pair, width: int) -> Pair:
    """Weights keep fewer bits on the scale that they have."""
    code, bits = _codes(pair.netlist)
    factor = np.int64(1) << np.maximum(bits - width, 0)
    most = (np.int64(1) << (np.minimum(bits, width) - 1)) - 1
    kept = np.clip(np.rint(code / factor).astype(np.int64), -most, most) * factor
    return with_weights(pair, kept * weight_steps(bits))


@perturbation("times the decay", (0.75, 0.5, 0.25, 0))
def shorter_decay(pair: Pair, factor: float) -> Pair:
    """Membranes and lasting currents keep a smaller share."""
    netlist = pair.netlist
    registers = np.array(
        [fixedpoint.decay_registers(layer.beta * factor, layer.alpha * factor) for layer in netlist.layers]
    )
    decay_u, decay_v = registers[netlist.layer].T
    changed = replace(netlist, decay_u=fixedpoint.read_only(decay_u), decay_v=fixedpoint.read_only(decay_v))
    one = 1 << fixedpoint.DECAY_BITS
    populations = tuple(
        replace(population, beta=(one - v) / one, alpha=(one - 1 - u) / one)
        for population, (u, v) in zip(pair.network.populations, registers.tolist(), strict=True)
    )
    return Pair(netlist=changed, network=replace(pair.network, populations=populations))
