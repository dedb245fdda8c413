"""Hold a network of crossbar cores against every limit of its chip: all that is wrong, at once.

Several offenders against one rule on one core share a line, which names the first. A float network is
refused before it is lowered, with every reason that no layout could avoid; one that breaks none of these may
still not fit.
"""

from collections.abc import Callable, Iterator

import numpy as np

from spikeloom.compiler.errors import CapacityError, Violation
from spikeloom.compiler.ir import Network, fan_in
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.types import BoolArray, IntArray

Words = Callable[[int], str]
"""Says something of a row of a table."""

Broken = tuple[BoolArray, Words, str, str, str]
"""Rows of a table that break a rule, what is found in one; what is allowed, the rule, and what to do."""

RELAYS = "copy the neuron, or split its spikes by relays"


def faults(netlist: CrossbarNetlist, chip: Target) -> tuple[Violation, ...]:
    """Every limit that a network breaks, in the order of cores, axons, neurons and wires, then of the chip."""
    core_of = netlist.core_of_neuron()
    number = np.arange(netlist.n_neurons) - netlist.core_neurons[core_of]
    wire = netlist.wire_neuron
    violations = []
    tables: tuple[tuple[IntArray, Words, Iterator[Broken]], ...] = (
        (np.arange(netlist.n_cores), lambda _: "", _cores(netlist, chip)),
        (netlist.core_of_axon(), lambda row: f", axon {netlist.axon_line[row]}", _axons(netlist, chip)),
        (core_of, lambda row: f", neuron {number[row]}", _neurons(netlist, chip)),
        (core_of[wire], lambda row: f", neuron {number[wire[row]]}", _wires(netlist, chip)),
    )
    for core, who, rules in tables:
        for broken, used, allowed, rule, remedy in rules:
            rows = np.flatnonzero(broken)
            for place in np.unique(core[rows]).tolist():
                first, *others = rows[core[rows] == place].tolist()
                owner = f"core {place}{who(first)}" + f" (and {len(others)} more on this core)" * bool(
                    others
                )
                name = f"{chip.name}.{rule}"
                violations.append(
                    Violation(owner=owner, used=used(first), allowed=allowed, rule=name, remedy=remedy)
                )
    if netlist.n_cores > chip.limit("chip.cores"):
        violations.append(
            chip.exceeded("chip", "chip.cores", netlist.n_cores, "fewer neurons, inputs or copies")
        )
    return tuple(violations)


def require_legal(netlist: CrossbarNetlist, chip: Target) -> None:
    """Refuse a network that breaks a rule; the CapacityError lists every fault."""
    if found := faults(netlist, chip):
        raise CapacityError(found)


def signed_range(bits: int) -> tuple[int, int]:
    """Smallest and largest number of so many bits with sign.

    >>> signed_range(9)
    (-256, 255)
    """
    return -(1 << (bits - 1)), (1 << (bits - 1)) - 1


def _beyond(values: IntArray, low: int, high: int) -> BoolArray:
    """Which values are outside ``low … high``."""
    return (values < low) | (values > high)


def _cores(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    x = netlist.core_x
    y = netlist.core_y
    right = chip.limit("mesh.width") - 1
    top = chip.limit("mesh.height") - 1
    off = _beyond(x, 0, right) | _beyond(y, 0, top)
    mesh = f"x 0 … {right} and y 0 … {top}"
    yield off, lambda core: f"at ({x[core]}, {y[core]})", mesh, "mesh", "place it on the mesh"
    neurons = np.diff(netlist.core_neurons)
    axons = np.diff(netlist.core_axons)
    most = chip.limit("core.neurons")
    yield (
        neurons > most,
        lambda core: f"{neurons[core]} neurons",
        str(most),
        "core.neurons",
        "use more cores",
    )
    most = chip.limit("core.axons")
    remedy = "fewer inputs or copies of inputs, or more cores"
    yield axons > most, lambda core: f"{axons[core]} axons", str(most), "core.axons", remedy


def _axons(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    line = netlist.axon_line
    kind = netlist.axon_type
    lines = chip.limit("core.axons") - 1
    kinds = chip.limit("core.axon_types") - 1
    off = _beyond(line, 0, lines)
    odd = _beyond(kind, 0, kinds)
    yield off, lambda axon: f"line {line[axon]}", f"0 … {lines}", "core.axons", "use a line of the core"
    yield odd, lambda axon: f"type {kind[axon]}", f"0 … {kinds}", "core.axon_types", "use one of the types"


def _neurons(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    """Numbers that do not fit their registers; neurons with more than one target: an axon, or the way out."""
    unsigned = (0, (1 << chip.limit("neuron.threshold_bits")) - 1)
    signed = {
        what: signed_range(chip.limit(f"neuron.{what}_bits"))
        for what in ("weight", "leak", "reset", "membrane")
    }
    remedy = "a smaller scale, or the input on several axons"
    weights = [
        (f"weight of type {kind}", each, "weight", remedy) for kind, each in enumerate(netlist.weight.T)
    ]
    for name, values, register, mend in (
        *weights,
        ("leak", netlist.leak, "leak", "a smaller scale"),
        ("threshold", netlist.threshold, "threshold", "a smaller scale"),
        ("negative threshold", netlist.negative_threshold, "threshold", "a smaller scale"),
        ("reset value", netlist.reset, "reset", "reset nearer to zero"),
        ("initial membrane", netlist.initial, "membrane", "start nearer to zero"),
    ):
        low, high = signed.get(register, unsigned)

        def used(neuron: int, name: str = name, values: IntArray = values) -> str:
            return f"{name} {values[neuron]}"

        yield _beyond(values, low, high), used, f"{low} … {high}", f"neuron.{register}_bits", mend
    limit = chip.limit("neuron.targets")
    ends = np.unique(np.stack([netlist.wire_neuron, netlist.wire_x, netlist.wire_y]), axis=1)
    wires, cores = (
        np.bincount(each, minlength=netlist.n_neurons) for each in (netlist.wire_neuron, ends[0])
    )
    one = str(limit), "neuron.targets"
    many = wires > limit
    out = (wires > 0) & (netlist.readout_class >= 0)
    yield many & (cores > 1), lambda n: f"targets on {cores[n]} cores without a splitter", *one, RELAYS
    one_axon = f"let one axon reach all neurons, {RELAYS}"
    yield many & (cores == 1), lambda n: f"{wires[n]} targets on one core", *one, one_axon
    yield out, lambda _: "votes and has a target on the chip", *one, RELAYS


def _wires(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    delay = netlist.wire_delay
    longest = chip.limit("neuron.delay")
    late = _beyond(delay, 1, longest)
    ticks = f"1 … {longest} ticks"
    yield late, lambda wire: f"delay {delay[wire]}", ticks, "neuron.delay", "add relays for longer ways"
    source = netlist.core_of_neuron()[netlist.wire_neuron]
    reach = chip.limit("mesh.reach")
    across = netlist.core_x[source] - netlist.wire_x
    up = netlist.core_y[source] - netlist.wire_y
    far = np.maximum(np.abs(across), np.abs(up))
    remedy = "place the cores nearer to each other"
    yield far > reach, lambda wire: f"{far[wire]} cores away", str(reach), "mesh.reach", remedy


def needs(network: Network, chip: Target) -> tuple[Violation, ...]:
    """Every need that the chip does not meet, layer by layer."""
    return tuple(
        Violation(owner=owner, used=used, allowed=allowed, rule=f"{chip.name}.{rule}", remedy=remedy)
        for layer in range(len(network.populations))
        for owner, used, allowed, rule, remedy in _needs_of(network, layer, chip)
    )


def _needs_of(network: Network, layer: int, chip: Target) -> Iterator[tuple[str, str, str, str, str]]:
    """Owner, what is needed, what is allowed, the rule, and what to do."""
    population = network.populations[layer]
    axons = chip.limit("core.axons")
    name = population.name
    everyone = f"{name}, all {population.size:,} neurons"
    if 0 < population.beta < 1:
        kept = f"keep {population.beta:g} of their membranes a step"
        yield everyone, kept, "an added leak", "neuron.leak", "forget within a step, or leak by a constant"
    if population.alpha:
        kept = f"keep {population.alpha:g} of their currents a step"
        yield everyone, kept, "no current", "neuron.leak", "omit the current"
    inputs = fan_in(network, layer)
    most = int(inputs.max(initial=0))
    if most > axons:
        remedy = "split the sum, or give the layer fewer inputs"
        yield _worst(name, inputs, axons), f"{most:,} inputs", str(axons), "core.axons", remedy
    copies = min(max(axons // max(most, 1), 1), chip.limit("core.axon_types"))
    distinct = _distinct_weights(network, layer)
    allowed = 2**copies - 1
    if distinct.max(initial=0) > allowed:
        where = _worst(name, distinct, allowed)
        what = f"{distinct.max():,} different weights"
        beside = f"{allowed} with {copies} axon{'s' * (copies > 1)} an input"
        remedy = "fewer weights, or each input on several axons of different types"
        yield where, what, beside, "neuron.weight_bits", remedy
    # spikes go to every core that holds neurons which receive them, and there to two axons of different
    # types: with one each, all neurons of a core would have to divide their inputs into the same four groups
    # of equal weights
    receivers = [network.populations[each.post].size for each in network.projections if each.pre == layer]
    reached = sum(2 * -(-size // chip.limit("core.neurons")) for size in receivers)
    if reached > (targets := chip.limit("neuron.targets")):
        remedy = "copy the neurons, or split their spikes by relays"
        yield everyone, f"send spikes to {reached} axons at least", str(targets), "neuron.targets", remedy


def _distinct_weights(network: Network, layer: int) -> IntArray:
    """Number of different weights, zero left out, of each neuron of a layer; (neurons,) int64."""
    size = network.populations[layer].size
    most = np.zeros(size, np.int64)
    for weight in (
        projection.weight.tocoo() for projection in network.projections if projection.post == layer
    ):
        pairs = np.unique(np.stack([weight.coords[0], weight.data])[:, weight.data != 0], axis=1)
        most = np.maximum(most, np.bincount(pairs[0].astype(np.int64), minlength=size))
    return most


def _worst(name: str, amounts: IntArray, allowed: int) -> str:
    """The neuron with most, and how many more there are with too much."""
    more = int(np.count_nonzero(amounts > allowed)) - 1
    return f"{name}, neuron {int(np.argmax(amounts))}" + (f" (and {more:,} more)" if more else "")
