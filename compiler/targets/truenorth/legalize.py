"""Hold a network of crossbar cores against every limit of its chip: all that is wrong, at once.

Several offenders against one rule on one core share a line, which names the first. A float network is refused before
it is lowered, with every reason that no layout could avoid; one that breaks none of these may still not fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby

import numpy as np

from spikeloom.compiler.errors import CapacityError, Violation
from spikeloom.compiler.ir import Network, fan_in
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.netlist import RESET_NONE, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray

Offender = tuple[int, str, str]
"""Core (-1 for the chip), who on it, and what was found."""

Broken = tuple[Iterable[Offender], str, str, str]
"""Who breaks a rule, none where it holds; what is allowed, the rule, and what to do."""

RELAYS = "copy the neuron, or split its spikes by relays"


def faults(netlist: CrossbarNetlist, chip: Target) -> tuple[Violation, ...]:
    """Every rule that a network breaks, in the order of cores, axons, neurons, wires, feeds and clocks."""
    found = []
    for part in (_cores, _axons, _parameters, _targets, _wires, _feeds, _clocks):
        for broken, allowed, rule, remedy in part(netlist, chip):
            for core, group in groupby(broken, key=lambda offender: offender[0]):
                first, *others = group
                owner, name = _owner(core, first[1], len(others)), f"{chip.name}.{rule}"
                found.append(Violation(owner=owner, used=first[2], allowed=allowed, rule=name, remedy=remedy))
    return tuple(found)


def require_legal(netlist: CrossbarNetlist, chip: Target) -> None:
    """Refuse a network that breaks a rule; the CapacityError lists every fault."""
    found = faults(netlist, chip)
    if found:
        raise CapacityError(found)


def signed_range(bits: int) -> tuple[int, int]:
    """Smallest and largest number of so many bits with sign.

    Examples
    --------
    >>> signed_range(9)
    (-256, 255)
    """
    return -(1 << (bits - 1)), (1 << (bits - 1)) - 1


def _owner(core: int, who: str, others: int) -> str:
    """The first offender on a core, and how many more there are."""
    place = f"core {core}{', ' * bool(who)}" if core >= 0 else ""
    return f"{place}{who}" + (f" (and {others} more{' on this core' * (core >= 0)})" if others else "")


def _cores(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    places = list(zip(netlist.core_x.tolist(), netlist.core_y.tolist(), strict=True))
    named = [(core, f"at ({x}, {y})", places.index((x, y))) for core, (x, y) in enumerate(places)]
    off = [(core, "", where) for core, where, _ in named if not _inside(*places[core], chip)]
    yield off, _mesh(chip), "mesh", "place it on the mesh"
    double = [(core, "", f"{where} as core {first}") for core, where, first in named if first != core]
    yield double, "one core to a place", "mesh", "place it elsewhere"
    most = chip.limit("chip.cores")
    many = [(-1, "chip", f"{netlist.n_cores} cores")] if netlist.n_cores > most else []
    yield many, str(most), "chip.cores", "fewer neurons, inputs or copies"
    for what, bounds, remedy in (
        ("neurons", netlist.core_neurons, "use more cores"),
        ("axons", netlist.core_axons, "fewer inputs or copies of inputs, or more cores"),
    ):
        limit, held = chip.limit(f"core.{what}"), np.diff(bounds).tolist()
        full = [(core, "", f"{count} {what}") for core, count in enumerate(held) if count > limit]
        yield full, str(limit), f"core.{what}", remedy


def _inside(x: int, y: int, chip: Target) -> bool:
    return 0 <= x < chip.limit("mesh.width") and 0 <= y < chip.limit("mesh.height")


def _mesh(chip: Target) -> str:
    return f"x 0 … {chip.limit('mesh.width') - 1} and y 0 … {chip.limit('mesh.height') - 1}"


def _axons(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    lines, kinds = chip.limit("core.axons"), chip.limit("core.axon_types")
    off, odd, twice, other = [], [], [], []
    seen: dict[tuple[int, int], int] = {}
    rows = zip(netlist.core_of_axon().tolist(), netlist.axon_line.tolist(), netlist.axon_type.tolist(), strict=True)
    for core, line, kind in rows:
        who = f"axon {line}"
        if not 0 <= line < lines:
            off.append((core, who, f"line {line}"))
        if not 0 <= kind < kinds:
            odd.append((core, who, f"type {kind}"))
        if (core, line) not in seen:
            seen[core, line] = kind
        elif seen[core, line] == kind:
            twice.append((core, who, "there twice"))
        else:
            other.append((core, who, f"types {seen[core, line]} and {kind}"))
    yield off, f"0 … {lines - 1}", "core.axons", "use a line of the core"
    yield odd, f"0 … {kinds - 1}", "core.axon_types", "use one of the types"
    remedy = "a type belongs to an axon, for all neurons of its core: copy the input onto a second axon"
    yield other, "one type to an axon", "core.axon_types", remedy
    yield twice, "one axon to a line", "core.axons", "connect its neurons to one of them"


def _parameters(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    """Numbers that do not fit their registers."""
    unsigned = (0, (1 << chip.limit("neuron.threshold_bits")) - 1)
    signed = {what: signed_range(chip.limit(f"neuron.{what}_bits")) for what in ("weight", "leak", "reset", "membrane")}
    remedy = "a smaller scale, or the input on several axons"
    weights = [
        (f"weight of type {kind}", values, signed["weight"], "weight_bits", remedy)
        for kind, values in enumerate(netlist.weight.T)
    ]
    for name, values, (low, high), rule, mend in (
        *weights,
        ("leak", netlist.leak, signed["leak"], "leak_bits", "a smaller scale"),
        ("threshold", netlist.threshold, unsigned, "threshold_bits", "a smaller scale"),
        ("negative threshold", netlist.negative_threshold, unsigned, "threshold_bits", "a smaller scale"),
        ("reset value", netlist.reset, signed["reset"], "reset_bits", "reset nearer to zero"),
        ("initial membrane", netlist.initial, signed["membrane"], "membrane_bits", "start nearer to zero"),
        ("reset mode", netlist.reset_mode, (RESET_TO, RESET_NONE), "reset_mode", "use one of the modes"),
        ("leak reversal", netlist.leak_reversal, (0, 1), "leak_reversal", "use a flag"),
        ("saturation", netlist.negative_saturates, (0, 1), "negative_saturates", "use a flag"),
    ):
        bad = np.flatnonzero((values < low) | (values > high))
        found = [f"{name} {value}" for value in values[bad]]
        yield _on_cores(netlist, bad, found), f"{low} … {high}", f"neuron.{rule}", mend


def _on_cores(netlist: CrossbarNetlist, neurons: IntArray, found: list[str]) -> list[Offender]:
    """Neurons by their core and their number on it."""
    cores = netlist.core_of_neuron()[neurons]
    numbers = neurons - netlist.core_neurons[cores]
    return [(int(c), f"neuron {n}", what) for c, n, what in zip(cores, numbers, found, strict=True)]


def _targets(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    """Neurons with more than one target: an axon, or the way out of the chip."""
    limit = chip.limit("neuron.targets")
    ends = np.unique(np.stack([netlist.wire_neuron, netlist.wire_x, netlist.wire_y]), axis=1)
    wires, cores = (np.bincount(each, minlength=netlist.n_neurons) for each in (netlist.wire_neuron, ends[0]))
    fans = np.flatnonzero((wires > limit) & (cores > 1))
    within = np.flatnonzero((wires > limit) & (cores == 1))
    out = np.flatnonzero((wires > 0) & (netlist.readout_class >= 0))
    for neurons, found, remedy in (
        (fans, [f"targets on {cores[n]} cores without a splitter" for n in fans], RELAYS),
        (within, [f"{wires[n]} targets on one core" for n in within], f"let one axon reach all neurons, {RELAYS}"),
        (out, ["votes and has a target on the chip" for _ in out], RELAYS),
    ):
        yield _on_cores(netlist, neurons, found), str(limit), "neuron.targets", remedy


def _wires(netlist: CrossbarNetlist, chip: Target) -> Iterator[Broken]:
    longest, reach = chip.limit("neuron.delay"), chip.limit("mesh.reach")
    source = netlist.core_of_neuron()[netlist.wire_neuron]
    number = netlist.wire_neuron - netlist.core_neurons[source]
    aim = netlist.cores_at(netlist.wire_x, netlist.wire_y)
    axon = netlist.axons_at(aim, netlist.wire_line)
    far = np.maximum(np.abs(netlist.core_x[source] - netlist.wire_x), np.abs(netlist.core_y[source] - netlist.wire_y))
    late, off, nowhere, beyond = (list[Offender]() for _ in range(4))
    columns = netlist.wire_x, netlist.wire_y, netlist.wire_line, netlist.wire_delay, source, number, aim, axon, far
    rows = np.stack(columns, axis=1)[np.argsort(source, kind="stable")]
    for x, y, line, delay, core, neuron, end, found, distance in rows.tolist():
        who = core, f"neuron {neuron}"
        if not 1 <= delay <= longest:
            late.append((*who, f"delay {delay}"))
        if not _inside(x, y, chip):
            off.append((*who, f"target at ({x}, {y})"))
        elif end < 0:
            nowhere.append((*who, f"target at ({x}, {y}), where no core is"))
        elif found < 0:
            nowhere.append((*who, f"target line {line} of core {end}, which has no axon there"))
        elif distance > reach:
            beyond.append((*who, f"{distance} cores away"))
    yield late, f"1 … {longest} ticks", "neuron.delay", "add relays for longer ways"
    yield off, _mesh(chip), "mesh", "aim at a core of the mesh"
    yield nowhere, "an axon of a core", "target", "add the axon, or omit the wire"
    yield beyond, str(reach), "mesh.reach", "place the cores nearer to each other"


def _feeds(netlist: CrossbarNetlist, _chip: Target) -> Iterator[Broken]:
    columns = netlist.aims()[0], netlist.feed_channel, netlist.feed_core, netlist.feed_line, netlist.feed_tick
    rows = [(f"input channel {row[1]}", *row) for row in np.stack(columns, axis=1).tolist()]
    lost = [(-1, who, f"line {line} of core {core}") for who, axon, _, core, line, _ in rows if axon < 0]
    early = [(-1, who, f"tick {tick} of a data step") for who, *_, tick in rows if tick < 0]
    yield lost, "an axon of a core", "target", "add the axon, or omit the feed"
    yield early, "0 or later", "feed", "feed it when it is there"


def _clocks(netlist: CrossbarNetlist, _chip: Target) -> Iterator[Broken]:
    columns = netlist.aims()[1], netlist.clock_core, netlist.clock_line, netlist.clock_period, netlist.clock_phase
    rows = [(f"clock {row}", *entry) for row, entry in enumerate(np.stack(columns, axis=1).tolist())]
    still = [(-1, who, f"a period of {period} ticks") for who, _, _, _, period, _ in rows if period < 1]
    early = [(-1, who, f"phase {phase}") for who, *_, phase in rows if phase < 0]
    lost = [(-1, who, f"line {line} of core {core}") for who, axon, core, line, *_ in rows if axon < 0]
    yield still, "1 or more", "clock", "say every how many ticks it spikes"
    yield early, "0 or later", "clock", "start it with the recording"
    yield lost, "an axon of a core", "target", "add the axon, or omit the clock"


def needs(network: Network, chip: Target) -> tuple[Violation, ...]:
    """Every need that the chip does not meet, layer by layer."""
    return tuple(
        Violation(owner=owner, used=used, allowed=allowed, rule=f"{chip.name}.{rule}", remedy=remedy)
        for layer in range(len(network.populations))
        for owner, used, allowed, rule, remedy in _needs_of(network, layer, chip)
    )


def _needs_of(network: Network, layer: int, chip: Target) -> Iterator[tuple[str, str, str, str, str]]:
    """Owner, what is needed, what is allowed, the rule, and what to do."""
    population, axons = network.populations[layer], chip.limit("core.axons")
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
    distinct, allowed = _distinct_weights(network, layer), 2**copies - 1
    if distinct.max(initial=0) > allowed:
        where, found = _worst(name, distinct, allowed), f"{distinct.max():,} different weights"
        beside = f"{allowed} with {copies} axon{'s' * (copies > 1)} an input"
        remedy = "fewer weights, or each input on several axons of different types"
        yield where, found, beside, "neuron.weight_bits", remedy
    # spikes go to every core that holds neurons which receive them, and there to two axons of different types: with one
    # each, all neurons of a core would have to divide their inputs into the same four groups of equal weights
    receivers = [network.populations[each.post].size for each in network.projections if each.pre == layer]
    reached = sum(2 * -(-size // chip.limit("core.neurons")) for size in receivers)
    if reached > (targets := chip.limit("neuron.targets")):
        remedy = "copy the neurons, or split their spikes by relays"
        yield everyone, f"send spikes to {reached} axons at least", str(targets), "neuron.targets", remedy


def _distinct_weights(network: Network, layer: int) -> IntArray:
    """Number of different weights, zero left out, of each neuron of a layer; (neurons,) int64."""
    found = np.zeros(network.populations[layer].size, np.int64)
    for projection in network.projections:
        if projection.post == layer:
            rows = np.split(projection.weight.data, projection.weight.indptr[1:-1])
            found = np.maximum(found, [len(np.unique(row[row != 0])) for row in rows])
    return found


def _worst(name: str, amounts: IntArray, allowed: int) -> str:
    """The neuron with most, and how many more there are with too much."""
    more = int(np.count_nonzero(amounts > allowed)) - 1
    return f"{name}, neuron {int(np.argmax(amounts))}" + (f" (and {more:,} more)" if more else "")
