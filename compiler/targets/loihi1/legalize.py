"""Count what a netlist uses of each limit of its chip, and refuse one that uses too much.

Nothing is changed. Every violated limit is listed, with its owner and what would make it fit.
"""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitUse:
    """Amount of one limit that one core (or the chip, core None) uses."""

    name: str
    used: int
    allowed: int
    core: int | None


def list_words(entries: IntArray, weight_bits: IntArray | int, index_bits: IntArray | int, target: Target) -> IntArray:
    """Words of synaptic memory that lists of `entries` synapses take.

    A list is cut in blocks of up to 64 synapses; a block costs its entries and a header, rounded up to whole words
    (nengo-loihi, ``block.py``, ``Synapse.bits``).

    Examples
    --------
    >>> from spikeloom.compiler.targets.base import load_target
    >>> list_words(np.array([0, 43, 128]), 8, 0, load_target("loihi1")).tolist()
    [0, 6, 18]
    """
    block = target.limit("synapse.block")
    header = target.limit("synapse.block_header_bits")
    word = target.limit("synapse.word_bits")
    bits = np.asarray(weight_bits) + np.asarray(index_bits)
    full, rest = np.divmod(entries, block)
    whole = -(-(block * bits + header) // word)
    part = np.where(rest > 0, -(-(rest * bits + header) // word), 0)
    return np.asarray(full * whole + part)


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
    entries = np.diff(netlist.axon_synapses)
    index_bits = netlist.format_index_bits[netlist.axon_format]
    words = list_words(entries, netlist.format_weight_bits[netlist.axon_format], index_bits, target)
    dense = (index_bits == 0) & (entries > 0)
    base = np.zeros(cores, np.int64)
    np.maximum.at(base, core_of_axon[dense], netlist.synapse_target[netlist.axon_synapses[:-1][dense]])
    formats = np.unique(np.stack([core_of_axon, netlist.axon_format]), axis=1)
    used = {
        "core.compartments": np.diff(netlist.core_compartments),
        "core.axons_in": np.diff(netlist.core_axons),
        "core.axons_out": np.bincount(source_core, minlength=cores),
        "core.synapse_words": np.bincount(core_of_axon, words, cores).astype(np.int64),
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
    return (*uses, LimitUse(name="chip.cores", used=int(chips.max()), allowed=target.limit("chip.cores"), core=None))


def violation(target: Target, owner: str, rule: str, used: int) -> Violation:
    """Turn a use that is too large into the line that a user reads."""
    return target.exceeded(owner, rule, used, REMEDIES[rule])


def require_legal(netlist: Netlist, target: Target) -> tuple[LimitUse, ...]:
    """Measure every limit; CapacityError lists every one that is broken."""
    uses = measure(netlist, target)
    violations = []
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
