"""Faults on purpose: in a netlist, in the checkpoint or graph that it is compiled from, in a copy of the simulator.

An injection is drawn from a seed. It counts only if at least one spike is not the intact chip's.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from random_networks import compiled, random_checkpoint

from spikeloom.compiler import Options, Recipe, compile_network, lift
from spikeloom.compiler.errors import SpikeloomError
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.storage.quantize import round_to_forms
from spikeloom.compiler.targets.loihi1.storage.weight_storage import Form
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.runtime.commands.check.explain import left_out
from spikeloom.runtime.equivalence.causes import Explanation, Observed, explain
from spikeloom.runtime.equivalence.suspects import (
    BETA,
    BIAS,
    GRAPH,
    SATURATION,
    SKEW,
    STATE,
    THRESHOLD,
    TIE,
    TRANSPOSED,
    TRUNCATION,
    WEIGHTS,
)
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Base:
    """An intact chip and what it was made from.

    Parameters
    ----------
    edges : (e, 2) int64
        Directed edges, repeats count.
    events : (2, taxels, polarities, steps) uint8
        The recording before, and the one to explain.
    integer : IntegerNetwork
        The netlist, lifted.
    intact : Observed
        What the simulator shows of the recording.
    """

    checkpoint: Checkpoint
    edges: np.ndarray
    recipe: Recipe
    calibration: np.ndarray | None
    netlist: Netlist
    events: np.ndarray
    integer: IntegerNetwork
    intact: Observed

    @property
    def adjacency(self) -> np.ndarray:
        return normalised_adjacency(self.edges, self.checkpoint.taxels)

    def compile(self, *, checkpoint: Checkpoint | None = None, edges: np.ndarray | None = None) -> Netlist:
        """Compile something else in the same way."""
        checkpoint = self.checkpoint if checkpoint is None else checkpoint
        adjacency = normalised_adjacency(self.edges if edges is None else edges, checkpoint.taxels)
        return compile_network(
            expand(checkpoint, adjacency), Options(recipes=(self.recipe,), training_events=self.calibration)
        ).netlist


def base_of(checkpoint, edges, recipe, events, calibration=None) -> Base:
    adjacency = normalised_adjacency(edges, checkpoint.taxels)
    netlist = compile_network(
        expand(checkpoint, adjacency), Options(recipes=(recipe,), training_events=calibration)
    ).netlist
    return Base(
        checkpoint=checkpoint,
        edges=edges,
        recipe=recipe,
        calibration=calibration,
        netlist=netlist,
        events=events,
        integer=lift(netlist),
        intact=observe(netlist, events[1]),
    )


RECIPES = (
    Recipe(bits=8, planes=2, groups=8),
    Recipe(bits=8, planes=2, groups=8),
    Recipe(bits=8),
    Recipe(bits=6, planes=2),
    Recipe(bits=4),
)


def small_base(rng: np.random.Generator, *, coarse: bool = False) -> Base:
    """A small network; in a `coarse` one thresholds are a few weight units, so that every unit of a register counts."""
    taxels, features = int(rng.integers(5, 9)), int(rng.integers(4, 7))
    checkpoint = random_checkpoint(
        taxels=taxels,
        features=features,
        hops=int(rng.integers(2, 4)),
        sizes=(int(rng.integers(8, 14)), 8, 8, 4),
        seed=int(rng.integers(2**31)),
        beta=float(rng.choice([0.2, 0.2, 0.5, 0.9])),
        theta=float(rng.choice([0.5, 0.5, 1.0])),
    )
    recipe = RECIPES[rng.integers(len(RECIPES))]
    shape = taxels, 2, int(rng.integers(60, 120))
    events = (rng.random((2, *shape)) < rng.choice([0.1, 0.25])).astype(np.uint8)
    calibration = None
    if not coarse and rng.random() < 0.2:
        calibration = (rng.random((6, *shape)) < 0.2).astype(np.uint8)
    edges = random_edges(rng, taxels)
    base = base_of(checkpoint, edges, recipe, events, calibration)
    if not coarse:
        return base
    network = expand(checkpoint, base.adjacency)
    forms = [Form(bits=8, exponents=(0,), threshold=np.full(p.size, rng.integers(2, 9))) for p in network.populations]
    netlist = compiled(round_to_forms(network, forms)[0])
    return dataclasses.replace(base, netlist=netlist, integer=lift(netlist), intact=observe(netlist, events[1]))


def random_edges(rng: np.random.Generator, taxels: int) -> np.ndarray:
    """A chain and some more, both ways."""
    pairs = {(i, i + 1) for i in range(taxels - 1)}
    while len(pairs) < taxels + 2:
        a, b = sorted(rng.choice(taxels, 2, replace=False).tolist())
        pairs.add((a, b))
    one = np.array(sorted(pairs))
    return np.concatenate([one, one[:, ::-1]])


# -- a copy of the simulator, with switches ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A chip in numpy, layer after layer; the defaults are intact.

    Parameters
    ----------
    layers : tuple of int, optional
        Layers that are faulty; by default all.
    rounding : str
        ``zero``, ``floor``, ``nearest`` or ``away``, of the decayed membrane.
    at_least : bool
        Fire at the threshold too.
    delay : int
        Steps by which the inputs of a layer come late (negative: early).
    ungated : bool
        Layers integrate from the first chip step on, though their data comes later.
    reset : bool
        Whether the membrane is zeroed between two recordings.
    register, bits, wraps
        ``sum`` or ``membrane`` register, its width without sign, and whether it wraps rather than saturates.
    """

    layers: tuple[int, ...] | None = None
    rounding: str = "zero"
    at_least: bool = False
    delay: int = 0
    ungated: bool = False
    reset: bool = True
    register: str | None = None
    bits: int = 23
    wraps: bool = False

    def hold(self, name: str, value: np.ndarray) -> np.ndarray:
        """What a register makes of a value."""
        bits = self.bits if name == self.register else 23 if name == "membrane" else None
        if bits is None:
            return value
        if name == self.register and self.wraps:
            return (value + (1 << bits)) % (1 << bits + 1) - (1 << bits)
        return np.clip(value, 1 - (1 << bits), (1 << bits) - 1)

    def decayed(self, value: np.ndarray, keep: int) -> np.ndarray:
        product = value * keep
        if self.rounding == "floor":
            return product >> 12
        if self.rounding == "nearest":
            return (product + 2048) >> 12
        magnitude = (np.abs(product) + (4095 if self.rounding == "away" else 0)) >> 12
        return np.sign(product) * magnitude


def run_machine(integer: IntegerNetwork, recordings: np.ndarray, machine: Machine) -> Observed:
    """Run recordings (2, steps, channels), one after the other; return what is seen of the second, aligned."""
    steps, depth = recordings.shape[1], len(integer.populations) - 1
    lead = depth if machine.ungated else 0
    pad = np.zeros((lead, recordings.shape[2]), bool)
    source = np.concatenate([pad, recordings[1]] if machine.reset else [*recordings])
    spikes, membranes = [], []
    for post, population in enumerate(integer.populations):
        here = machine if machine.layers is None or post in machine.layers else Machine()
        weight = sum(p.effective() for p in integer.projections if p.post == post)
        arrived = np.zeros((len(source), population.size), np.int64)
        late, early = max(here.delay, 0), max(-here.delay, 0)
        arrived[late : len(source) - early] = (source.astype(np.int64) @ weight.T)[early : len(source) - late]
        arrived = here.hold("sum", arrived * 64)
        v = np.zeros(population.size, np.int64)
        fired = np.zeros((len(source), population.size), bool)
        kept = np.zeros((len(source), population.size), np.int64)
        first = lead - post if here.ungated else lead
        if not here.reset:
            first = 0
        for t in range(first, len(source)):
            if machine.reset is False and here.reset and t == steps:
                v[:] = 0
            v = here.decayed(v, 4096 - population.decay_v) + arrived[t] + population.bias
            v = kept[t] = here.hold("membrane", v)
            limit = population.threshold * 64
            fired[t] = v >= limit if here.at_least else v > limit
            v = np.where(fired[t], 0, v)
        source = fired
        spikes.append(fired[-steps:])
        membranes.append(kept[-steps:])
    return Observed(spikes=tuple(spikes), membranes=tuple(membranes))


def observe(netlist: Netlist, events: np.ndarray) -> Observed:
    """What the simulator shows of one recording."""
    trace = engine.simulate(netlist, events.reshape(1, -1, events.shape[-1]), spikes=True, membranes=True, threads=1)
    layers = range(len(netlist.layers))
    return Observed(
        spikes=tuple(aligned(netlist, trace.spikes, i)[0] for i in layers),
        membranes=tuple(aligned(netlist, trace.membranes, i)[0] for i in layers),
    )


# -- injections --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Injection:
    """A fault that moved spikes: the chip as it is now, and what it did."""

    kind: str
    what: str
    base: Base
    netlist: Netlist
    observed: Observed
    moved: int


def explain_base(base: Base, netlist: Netlist, observed: Observed) -> Explanation:
    """Explain the second recording."""
    absent, unheard = left_out(netlist)
    return explain(
        expand(base.checkpoint, base.adjacency),
        base.integer if netlist is base.netlist else lift(netlist),
        channels_last(base.events)[1],
        observed,
        convolution=(base.adjacency, base.checkpoint.hops.astype(np.float64)),
        may_compensate=base.calibration is not None,
        absent=absent,
        unheard=unheard,
    )


def change_layer(netlist: Netlist, layer: int, **fields: Callable[[np.ndarray], np.ndarray]) -> Netlist:
    """Change registers of one layer's compartments."""
    ids = netlist.compartments_of(layer)
    changed = {}
    for name, change in fields.items():
        values = getattr(netlist, name).copy()
        values[ids] = change(values[ids])
        changed[name] = values
    return dataclasses.replace(netlist, **changed)


def _layer(rng: np.random.Generator, netlist: Netlist) -> int:
    return int(rng.integers(len(netlist.layers)))


def _some_layers(rng: np.random.Generator, netlist: Netlist) -> tuple[int, ...] | None:
    return None if rng.random() < 0.5 else (_layer(rng, netlist),)


def bad_weights(rng: np.random.Generator, base: Base) -> tuple[str, Netlist]:
    """Weights coarser than their storage, or without the low plane, or rounded toward zero."""
    layer, netlist = _layer(rng, base.netlist), base.netlist
    target = netlist.layer[netlist.synapse_compartment()] == layer
    weight = netlist.synapse_weight.copy()
    exponent = netlist.format_exponent[netlist.axon_format[netlist.axon_of_synapse()]]
    used = np.unique(exponent[target])
    ways = ["toward zero", "fewer bits", *(["low plane lost"] if len(used) > 1 else [])]
    way = str(rng.choice(ways))
    if way == "low plane lost":
        weight[target & (exponent == used[0])] = 0
    elif way == "fewer bits":
        step = 512 >> netlist.layers[layer].weight_bits
        coarse = step * int(rng.choice([4, 8]))
        held = target & (exponent == used[0])
        weight[held] = np.clip(np.rint(weight[held] / coarse) * coarse, -256 + step, 256 - step)
    else:
        weight = _toward_zero(base, layer)
    return f"layer {layer}: {way}", dataclasses.replace(netlist, synapse_weight=weight)


def _toward_zero(base: Base, layer: int) -> np.ndarray:
    """Mantissas of all synapses; those into a layer that were rounded away from zero are a step smaller."""
    netlist, integer = base.netlist, base.integer
    axon, target = netlist.axon_of_synapse(), netlist.synapse_compartment()
    source = netlist.axon_source[axon]
    column = np.where(layer == 0, source, netlist.neuron[np.maximum(source - netlist.n_inputs, 0)])
    exponent = netlist.format_exponent[netlist.axon_format[axon]]
    into = netlist.layer[target] == layer
    finest = into & (exponent == exponent[into].min())
    place = netlist.neuron[target][finest], column[finest]
    stored = sum(p.effective() for p in integer.projections if p.post == layer).toarray()
    projection = expand(base.checkpoint, base.adjacency).projections[layer]
    ideal = projection.weight.toarray() * integer.populations[layer].scale[:, None]
    weight, step = netlist.synapse_weight.copy(), 512 >> netlist.layers[layer].weight_bits
    over = np.abs(stored[place]) > np.abs(ideal[place])
    weight[finest] -= np.where(over, np.sign(stored[place]), 0).astype(np.int64) * step
    return np.clip(weight, step - 256, 256 - step)


def bad_bias(rng: np.random.Generator, base: Base) -> tuple[str, Netlist]:
    """Biases in whole weight units, or in coarser ones, or with a low mantissa."""
    layer = _layer(rng, base.netlist)
    unit = int(rng.choice([64, 256, 1024]))

    def coarse(mantissa: np.ndarray) -> np.ndarray:
        bias = np.rint((mantissa << exponent) / unit).astype(np.int64) * unit
        return np.clip(bias >> exponent, -4095, 4095)

    exponent = base.netlist.bias_exponent[base.netlist.compartments_of(layer)]
    return f"layer {layer}: whole multiples of {unit}", change_layer(base.netlist, layer, bias_mantissa=coarse)


def bad_threshold(rng: np.random.Generator, base: Base) -> tuple[str, Netlist]:
    """Thresholds that are off by a little, or whole multiples of something."""
    layer = _layer(rng, base.netlist)
    off, unit = int(rng.choice([-2, -1, 1, 2])), int(rng.choice([1, 8, 32]))
    if unit == 1:
        return f"layer {layer}: off by {off}", change_layer(base.netlist, layer, threshold=lambda t: t + off)
    return f"layer {layer}: multiples of {unit}", change_layer(
        base.netlist, layer, threshold=lambda t: np.maximum(1, np.rint(t / unit).astype(np.int64)) * unit
    )


def bad_decay(rng: np.random.Generator, base: Base) -> tuple[str, Netlist]:
    """A decay register that is off, or a current that is not forgotten."""
    layer = _layer(rng, base.netlist)
    if rng.random() < 0.25:
        u = int(rng.choice([4094, 4079, 3500]))
        return f"layer {layer}: decay_u {u}", change_layer(base.netlist, layer, decay_u=lambda d: d * 0 + u)
    off = int(rng.choice([-40, -10, -1, 1, 10, 40]))
    return f"layer {layer}: decay_v off by {off}", change_layer(
        base.netlist, layer, decay_v=lambda d: np.clip(d + off, 0, 4095)
    )


def bad_graph(rng: np.random.Generator, base: Base) -> tuple[str, Netlist]:
    """Edges listed twice, edges left out, another graph."""
    taxels, edges = base.checkpoint.taxels, base.edges
    way = str(rng.choice(["twice", "missing", "more", "other"]))
    half = edges[edges[:, 0] < edges[:, 1]]
    if way == "other":
        half = random_edges(rng, taxels)[: taxels + 2]
    elif way == "missing":
        half = half[rng.permutation(len(half))[:-1]]
    elif way == "more":
        half = np.concatenate([half, [sorted(rng.choice(taxels, 2, replace=False))]])
    else:
        half = np.concatenate([half, half[rng.permutation(len(half))[: 1 + len(half) // 3]]])
    return f"edges: {way}", base.compile(edges=np.concatenate([half, half[:, ::-1]]))


def bad_order(rng: np.random.Generator, base: Base) -> tuple[str, Netlist]:
    """Weights read in another order."""
    checkpoint = base.checkpoint
    taxels, features = checkpoint.taxels, checkpoint.hops.shape[1]
    way = str(rng.choice(["square", "reshaped", "channels", "feature-major", "filters"]))
    dense = list(checkpoint.dense)

    def changed(index: int, weight: np.ndarray) -> Checkpoint:
        dense[index] = dataclasses.replace(dense[index], weight=np.ascontiguousarray(weight))
        return dataclasses.replace(checkpoint, dense=tuple(dense))

    if way == "square":
        square = [i for i, d in enumerate(dense) if d.weight.shape[0] == d.weight.shape[1]]
        if square:
            return "square matrix", base.compile(checkpoint=changed(square[0], dense[square[0]].weight.T))
        way = "reshaped"
    if way == "reshaped":
        index = int(rng.integers(len(dense)))
        weight = dense[index].weight
        return f"{dense[index].name} column by column", base.compile(
            checkpoint=changed(index, weight.T.reshape(weight.shape))
        )
    if way == "feature-major":
        weight = dense[0].weight
        other = weight.reshape(len(weight), taxels, features).transpose(0, 2, 1).reshape(weight.shape)
        return "fc1 feature-major", base.compile(checkpoint=changed(0, other))
    hops = checkpoint.hops
    other = hops[:, :, ::-1] if way == "channels" else hops.transpose(0, 2, 1).reshape(hops.shape)
    return f"hop filters: {way}", base.compile(
        checkpoint=dataclasses.replace(checkpoint, hops=np.ascontiguousarray(other))
    )


def _machine(kind: str, rng: np.random.Generator, base: Base) -> Machine:
    layers = _some_layers(rng, base.netlist)
    if kind == TIE:
        return Machine(layers=layers, at_least=True)
    if kind == TRUNCATION:
        return Machine(layers=layers, rounding=str(rng.choice(["floor", "nearest", "away"])))
    if kind == SKEW:
        if rng.random() < 0.2:
            return Machine(ungated=True)
        return Machine(layers=(_layer(rng, base.netlist),), delay=int(rng.choice([-1, 1, 1, 2])))
    if kind == STATE:
        return Machine(layers=layers, reset=False)
    layer = _layer(rng, base.netlist)
    register = str(rng.choice(["sum", "membrane"]))
    peak = int(np.abs(base.intact.membranes[layer]).max(initial=1))
    bits = max(6, peak.bit_length() - int(rng.integers(1, 3)))
    return Machine(layers=(layer,), register=register, bits=bits, wraps=bool(rng.random() < 0.5))


NETLIST_FAULTS = {
    WEIGHTS: bad_weights,
    BIAS: bad_bias,
    THRESHOLD: bad_threshold,
    BETA: bad_decay,
    GRAPH: bad_graph,
    TRANSPOSED: bad_order,
}
MACHINE_FAULTS = (TRUNCATION, SATURATION, TIE, SKEW, STATE)
KINDS = (*NETLIST_FAULTS, *MACHINE_FAULTS)


def inject(kind: str, rng: np.random.Generator, base: Base) -> Injection | None:
    """Draw a fault of a kind; None if it moves no spike, or the chip refuses it."""
    netlist = base.netlist
    try:
        if kind in NETLIST_FAULTS:
            what, netlist = NETLIST_FAULTS[kind](rng, base)
            observed = observe(netlist, base.events[1])
        else:
            machine = _machine(kind, rng, base)
            what = str(machine)
            observed = run_machine(base.integer, channels_last(base.events), machine)
    except SpikeloomError:  # a register would overflow: the chip says so by itself
        return None
    moved = sum(int(np.count_nonzero(a != b)) for a, b in zip(base.intact.spikes, observed.spikes, strict=True))
    if not moved:
        return None
    return Injection(kind=kind, what=what, base=base, netlist=netlist, observed=observed, moved=moved)


RELEASED_KINDS = tuple(kind for kind in KINDS if kind != TRUNCATION)
"""Kinds that move a spike of the released network: what rounding drops there is a millionth of a threshold."""
