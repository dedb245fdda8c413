"""Count what a netlist uses of each limit of its chip, and refuse one that uses too much.

Nothing is changed. Every violated limit is listed, with its owner and what would make it fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import CapacityError, Violation
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import IntArray

REMEDIES = {
    "core.compartments": "split the layer over more cores",
    "core.axons_in": "fewer inputs to the layer: fewer features, taxels or a grouped layer",
    "core.axons_out": "split the layers that it feeds over fewer cores, or this one over more",
    "core.synapse_words": "fewer weight bits, fewer synapses or more cores",
    "core.threshold_slots": "fewer different thresholds on the core",
    "core.synapse_formats": "fewer different weight formats on the core",
    "core.compartment_configs": "fewer different decays on the core",
    "core.dense_base": "place the dense layer first on its core",
    "chip.cores": "fewer neurons or weight bits, a sparser graph or more --chips",
}


WEIGHT_BITS = 9
"""Width of a signed mantissa."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitUse:
    """Amount of one limit that one core (or the chip, core None) uses."""

    name: str
    used: int
    allowed: int
    core: int | None


def list_words(
    entries: IntArray, weight_bits: IntArray | int, index_bits: IntArray | int, target: Target
) -> IntArray:
    """Words of synaptic memory that lists of `entries` synapses take.

    A list is cut in blocks of up to 64 synapses; a block costs its entries and a header, rounded up to whole
    words (nengo-loihi, ``block.py``, ``Synapse.bits``).
    """
    block = target.limit("synapse.block")
    header = target.limit("synapse.block_header_bits")
    word = target.limit("synapse.word_bits")
    bits = np.asarray(weight_bits) + np.asarray(index_bits)
    full, rest = np.divmod(entries, block)
    whole = -(-(block * bits + header) // word)
    part = np.where(rest > 0, -(-(rest * bits + header) // word), 0)
    return np.asarray(full * whole + part)


def stored_once(
    form: IntArray, lengths: IntArray, place: IntArray, weight: IntArray, target: Target
) -> IntArray:
    """Which lists of a core synaptic memory holds: a list that several axons share is there once; (stored lists,).

    An input axon points to a list and adds a base to its places, so axons share a list if format and weights
    are the same and all places are shifted alike. The base has an end: for lists that start farther up,
    memory holds another, with a part of the shift in its places (nengo-loihi, ``conv.py`` and
    ``hardware/builder.py``). `form` and `lengths` (lists,) are formats and numbers of entries, `place`
    (compartment on the core) and `weight` (entries,) those of all lists in turn.

    >>> from spikeloom.compiler.targets.base import load_target
    >>> place, weight = np.array([0, 2, 5, 7, 3, 300, 302]), np.array([8, -4, 8, -4, 8, 8, -4])
    >>> stored_once(np.ones(4, int), np.array([2, 2, 1, 2]), place, weight, load_target("loihi1")).tolist()
    [0, 2, 3]
    """
    bounds = np.append(0, np.cumsum(lengths))
    place = place.astype(np.int32)
    first = np.minimum.reduceat(
        np.append(place, np.int32(1 << 30)), bounds[:-1]
    )  # Of an empty list anything
    alike = (place - np.repeat(first, lengths) << WEIGHT_BITS) + weight
    content = alike.astype(np.int32).tobytes()
    size = 4 * bounds
    seen: dict[tuple[int, int, bytes], int] = {}
    copy = first // (target.limit("core.dense_base") + 1)
    columns = (form, copy, size[:-1], size[1:])
    for i, (kind, above, begin, end) in enumerate(
        zip(*(column.tolist() for column in columns), strict=True)
    ):
        seen.setdefault((kind, above, content[begin:end]), i)
    return np.array([*seen.values()], np.int64)


def _first_and_entries(netlist: Netlist) -> tuple[IntArray, IntArray]:
    """First place of each list, and its entries in memory: a dense one has all from first to last; (axons,) each."""
    entries = np.diff(netlist.axon_synapses)
    some = np.flatnonzero(entries)
    first = np.zeros_like(entries)
    if some.size:
        starts = netlist.axon_synapses[some]
        first[some], last = (f.reduceat(netlist.synapse_target, starts) for f in (np.minimum, np.maximum))
        dense = netlist.format_index_bits[netlist.axon_format[some]] == 0
        span = np.where(dense, last - first[some] + 1, 0)
        entries[some] = np.maximum(span, entries[some])
    return first, entries


def words_of_axons(netlist: Netlist, target: Target) -> IntArray:
    """Words of the list of each axon, (axons,): the memory that a netlist would take if no axons shared any."""
    form = netlist.axon_format
    widths = netlist.format_weight_bits[form], netlist.format_index_bits[form]
    return list_words(_first_and_entries(netlist)[1], *widths, target)


def _stored_words(netlist: Netlist, core: int, entries: IntArray, target: Target) -> int:
    """Words of the lists that the memory of a core holds, each once."""
    axons = slice(*netlist.core_axons[core : core + 2].tolist())
    ends = netlist.axon_synapses[axons.start : axons.stop + 1]
    place, weight = (
        column[ends[0] : ends[-1]] for column in (netlist.synapse_target, netlist.synapse_weight)
    )
    form = netlist.axon_format[axons]
    stored = stored_once(form, np.diff(ends), place, weight, target)
    widths = netlist.format_weight_bits[form[stored]], netlist.format_index_bits[form[stored]]
    return int(list_words(entries[axons][stored], *widths, target).sum())


def _distinct_per_core(netlist: Netlist, *columns: IntArray) -> IntArray:
    """Number of distinct rows of `columns` among the compartments of each core."""
    rows = np.unique(np.stack([netlist.core_of_compartment(), *columns]), axis=1)
    return np.bincount(rows[0], minlength=netlist.n_cores)


def measure(netlist: Netlist, target: Target) -> tuple[LimitUse, ...]:
    """Use of every limit by every core, in the order of the target file, and the cores of the fullest chip."""
    cores = netlist.n_cores
    core_of_axon = netlist.core_of_axon()
    from_compartment = netlist.axon_source >= netlist.n_inputs
    source_core = netlist.core_of_compartment()[netlist.axon_source[from_compartment] - netlist.n_inputs]
    first, entries = _first_and_entries(netlist)
    dense = netlist.format_index_bits[netlist.axon_format] == 0
    base = np.zeros(cores, np.int64)
    np.maximum.at(base, core_of_axon[dense], first[dense])
    formats = np.unique(np.stack([core_of_axon, netlist.axon_format]), axis=1)
    used = {
        "core.compartments": np.diff(netlist.core_compartments),
        "core.axons_in": np.diff(netlist.core_axons),
        "core.axons_out": np.bincount(source_core, minlength=cores),
        "core.synapse_words": np.array(
            [_stored_words(netlist, core, entries, target) for core in range(cores)]
        ),
        "core.threshold_slots": _distinct_per_core(netlist, netlist.threshold),
        "core.synapse_formats": np.bincount(formats[0], minlength=cores),
        "core.compartment_configs": _distinct_per_core(netlist, netlist.decay_u, netlist.decay_v),
        "core.dense_base": base,
    }
    uses = [
        LimitUse(name=rule, used=int(amount), allowed=target.limit(rule), core=core)
        for rule, amounts in used.items()
        for core, amount in enumerate(amounts)
    ]
    chips = np.bincount(netlist.core_tile // (target.limit("mesh.width") * target.limit("mesh.height")))
    return (
        *uses,
        LimitUse(name="chip.cores", used=int(chips.max()), allowed=target.limit("chip.cores"), core=None),
    )


def violation(target: Target, owner: str, rule: str, used: int) -> Violation:
    """Turn a use that is too large into the line that a user reads."""
    return target.exceeded(owner, rule, used, REMEDIES[rule])


def _faults(netlist: Netlist, target: Target) -> Iterator[Violation]:
    """Rules that are no amounts on a core: tiles, formats, and what lists of these formats cannot hold."""
    again = "compile it again"
    tiles = np.bincount(netlist.core_tile)
    for tile in np.flatnonzero(tiles > target.limit("mesh.tile_cores")).tolist():
        yield target.exceeded(f"tile {tile}", "mesh.tile_cores", int(tiles[tile]), again)
    columns = {
        "synapse.weight_bits": netlist.format_weight_bits,
        "synapse.index_bits": netlist.format_index_bits,
        "synapse.exponent": netlist.format_exponent,
    }
    for rule, column in columns.items():
        allowed = target.choices[rule]
        for value in np.setdiff1d(column, allowed).tolist():
            name = f"{target.name}.{rule}"
            words = ", ".join(map(str, allowed))
            yield Violation(owner="synapse formats", rule=name, used=str(value), allowed=words, remedy=again)
    step = 1 << WEIGHT_BITS - netlist.format_weight_bits
    beyond: dict[str, list[IntArray]] = {"synapse.weight_bits": [], "synapse.index_bits": []}
    for axons in map(slice, netlist.core_axons[:-1].tolist(), netlist.core_axons[1:].tolist()):
        ends = netlist.axon_synapses[axons.start : axons.stop + 1]
        part = slice(ends[0], ends[-1])
        form = np.repeat(netlist.axon_format[axons], np.diff(ends))
        index = netlist.format_index_bits[form]
        wide = netlist.synapse_weight[part] % step[form] != 0
        far = (index > 0) & (netlist.synapse_target[part] >> index > 0)
        for rule, broken in zip(beyond, (wide, far), strict=True):
            beyond[rule].append(ends[0] + np.flatnonzero(broken))
    values = {"synapse.weight_bits": netlist.synapse_weight, "synapse.index_bits": netlist.synapse_target}
    for rule, parts in beyond.items():
        places = np.concatenate(parts)
        if len(places):
            first = int(places[0])
            axon = np.searchsorted(netlist.axon_synapses, first, side="right") - 1
            yield Violation(
                owner=f"synapse {first} (and {len(places) - 1} more)",
                rule=f"{target.name}.{rule}",
                used=str(values[rule][first]),
                allowed=f"what {columns[rule][netlist.axon_format[axon]]} bits hold",
                remedy=again,
            )


def require_legal(netlist: Netlist, target: Target) -> tuple[LimitUse, ...]:
    """Measure every limit; CapacityError lists every one that is broken."""
    uses = measure(netlist, target)
    violations = [*_faults(netlist, target)]
    for use in uses:
        if use.used > use.allowed:
            owner = "chip"
            if use.core is not None:
                first, last = netlist.core_compartments[use.core : use.core + 2]
                names = [netlist.layers[i].name for i in np.unique(netlist.layer[first:last])]
                owner = f"core {use.core} ({', '.join(names)})"
            violations.append(violation(target, owner, use.name, use.used))
    if violations:
        raise CapacityError(tuple(violations))
    return uses
