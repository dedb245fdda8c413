"""Cut populations into chunks that fit a core and pack the chunks on as few cores as possible.

The integer network is not changed: which neuron sits where has no influence on any spike.

Synaptic memory, axons and compartments are all counted by the rules of the target; the split of a population decides
how many output axons the populations before it need, so populations are cut from the last to the first. A recurrent one
needs some for its own chunks, so it is cut again until they are enough.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise

import numpy as np

from spikeloom.compiler.errors import CapacityError, OptionError, Violation
from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, Core, Cores, Needs
from spikeloom.compiler.targets.loihi1.legalize import LimitUse, violation
from spikeloom.compiler.types import FloatArray

EXACT_CHUNKS = 10
"""Up to this many chunks the packing is searched exhaustively; above it, first fit."""


def _largest(low: int, high: int, fits: Callable[[int], bool]) -> int:
    """Largest value in ``low … high`` that fits, given that `low` does and that fitting is monotone.

    For chunks it is, in every limit but the synapse formats (all lists of the larger chunk may be dense); there a
    smaller chunk than the largest may come out, which fits as well.
    """
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


Cut = tuple[list[Chunk], list[Violation]]
"""Chunks of a population, or why one of its neurons fits no core."""


def cut_layer(needs: Needs, population: int, least: int | None = None) -> Cut:
    """Cut one population into full chunks, or as evenly as possible into at least `least`; or say why it cannot be.

    A recurrent one is cut until its neurons have output axons for its own chunks, too; finer chunks need more.
    OptionError if it needs more than `least` chunks.
    """

    def once() -> Cut:
        return _fill(needs, population) if least is None else _spread(needs, population, least)

    if not any(projection.pre == projection.post == population for projection in needs.network.projections):
        return once()
    others = needs.out_axons[population]
    charged = np.zeros_like(others)
    try:
        while True:
            needs.out_axons[population] = others + charged
            chunks, why = once()
            own = needs.source_axons(chunks).get(population, charged)
            if why or np.all(own <= charged):
                return chunks, why
            charged = np.maximum(charged, own)
    finally:
        needs.out_axons[population] = others


def _fill(needs: Needs, population: int) -> Cut:
    size = needs.network.populations[population].size
    chunks: list[Chunk] = []
    first = 0
    while first < size:
        one = Chunk(population=population, first=first, last=first + 1)
        if needs.excess((one,)):
            return [], _worst(needs, population)

        def fits(last: int, first: int = first) -> bool:
            tried = Chunk(population=population, first=first, last=last)
            fit = not needs.excess((tried,))
            needs.drop(tried)
            return fit

        most = min(size, first + needs.target.limit("core.compartments"))
        chunks.append(Chunk(population=population, first=first, last=_largest(first + 1, most, fits)))
        first = chunks[-1].last
    return chunks, []


def _worst(needs: Needs, population: int) -> list[Violation]:
    """For each limit that single neurons of a population break: the one that breaks it most."""
    found: dict[str, tuple[LimitUse, int]] = {}
    for neuron in range(needs.network.populations[population].size):
        for use in needs.excess((Chunk(population=population, first=neuron, last=neuron + 1),)):
            if use.name not in found or use.used > found[use.name][0].used:
                found[use.name] = use, neuron
    name = needs.network.populations[population].name
    return [violation(use, f"{name} neuron {neuron}", needs.target) for use, neuron in found.values()]


def order_on_core(needs: Needs, chunks: Core) -> Core:
    """Densest chunks first: a dense list must start low on its core, a sparse one need not."""

    def key(chunk: Chunk) -> tuple[float, Chunk]:
        spans = sum(int((lists.last - lists.first + 1).sum()) for lists in needs.lists(chunk))
        nonzero = sum(int(lists.nonzero.sum()) for lists in needs.lists(chunk))
        return -nonzero / max(spans, 1), chunk

    return tuple(sorted(chunks, key=key))


def core_bound(network: IntegerNetwork, target: Target) -> int:
    """Cores that compartments and synaptic memory need at least, however the network is cut."""
    compartments = sum(population.size for population in network.populations)
    # Cutting a list elsewhere moves header and index bits, so memory is bounded by the mantissas alone.
    payload = sum(int(p.weight.count_nonzero()) * p.bits for p in network.projections)
    memory = target.limit("synapse.word_bits") * target.limit("core.synapse_words")
    return max(-(-compartments // target.limit("core.compartments")), -(-payload // memory))


def _pack(needs: Needs, chunks: list[Chunk], traffic: Callable[[Chunk, Chunk], float]) -> list[Core]:
    """Put chunks on the fewest cores; among equals, keep most traffic within a core."""
    known: dict[frozenset[Chunk], bool] = {}

    def fits(group: Core) -> bool:
        key = frozenset(group)
        if key not in known:
            known[key] = not needs.excess(order_on_core(needs, group))
        return known[key]

    if len(chunks) > EXACT_CHUNKS:
        cores: list[Core] = []
        for chunk in sorted(chunks, key=lambda c: (-needs.stored(c, 0)[0], c)):
            for i, core in enumerate(cores):
                if fits((*core, chunk)):
                    cores[i] = (*core, chunk)
                    break
            else:
                cores.append((chunk,))
        return cores

    best: list[Core] = [(chunk,) for chunk in chunks]
    best_kept = 0.0

    def search(index: int, cores: list[Core], kept: float) -> None:
        nonlocal best, best_kept
        if len(cores) > len(best):
            return
        if index == len(chunks):
            if (len(cores), -kept) < (len(best), -best_kept):
                best, best_kept = list(cores), kept
            return
        chunk = chunks[index]
        for i, core in enumerate(cores):
            if fits((*core, chunk)):
                gained = sum(traffic(chunk, other) + traffic(other, chunk) for other in core)
                search(index + 1, [*cores[:i], (*core, chunk), *cores[i + 1 :]], kept + gained)
        search(index + 1, [*cores, (chunk,)], kept)

    search(0, [], 0.0)
    return best


def _spread(needs: Needs, population: int, least: int) -> Cut:
    name, size = needs.network.populations[population].name, needs.network.populations[population].size
    for parts in range(least, size + 1):
        bounds = [i * size // parts for i in range(parts + 1)]
        chunks = [Chunk(population=population, first=first, last=last) for first, last in pairwise(bounds)]
        if not any(needs.excess((chunk,)) for chunk in chunks):
            return chunks, []
        if parts == least:
            fewest, why = _fill(needs, population)
            if why:
                return [], why
            if least < len(fewest):
                raise OptionError(
                    f"--cores-for {name}={least}: {name} needs {len(fewest)} cores at least; give {len(fewest)} or more"
                )
    return [], _worst(needs, population)


def cut(needs: Needs, least: Mapping[int, int]) -> list[Chunk]:
    """Cut every population: evenly into at least so many chunks if it is in `least`, else into full ones.

    CapacityError lists every limit that a single neuron exceeds; OptionError if `least` is too few.
    """
    chunks: list[Chunk] = []
    violations: list[Violation] = []
    needs.forget()
    for population in reversed(range(len(needs.network.populations))):
        found, why = cut_layer(needs, population, least.get(population))
        violations = why + violations
        chunks += found
        needs.charge(needs.source_axons(found))
    if violations:
        raise CapacityError(tuple(violations))
    return sorted(chunks)


def chunks_of(chunks: Iterable[Chunk]) -> dict[int, int]:
    """Number of chunks of each population."""
    return dict(sorted(Counter(chunk.population for chunk in chunks).items()))


def arrange(needs: Needs, groups: Iterable[Core], chips: int = 1) -> Cores:
    """Put groups of chunks on cores, in order; CapacityError if the chips have too few cores."""
    cores = sorted((order_on_core(needs, group) for group in groups), key=min)
    used = LimitUse(name="chip.cores", used=len(cores), allowed=chips * needs.target.limit("chip.cores"), core=None)
    if used.used > used.allowed:
        owner = "chip" if chips == 1 else f"{chips} chips"
        raise CapacityError((violation(used, owner, needs.target),))
    return tuple(cores)


def partition(
    network: IntegerNetwork,
    target: Target,
    rates: tuple[FloatArray, ...] | None = None,
    *,
    cores_for: Mapping[int, int] | None = None,
    chips: int = 1,
) -> Cores:
    """Assign every neuron to a core, on as few as the cut into chunks allows if the densest of a core comes first.

    Populations in `cores_for` are cut as evenly as possible into so many chunks at least, each on a core of its own;
    the others into full ones. Among equal packings, searched exhaustively up to
    ``EXACT_CHUNKS`` chunks, the one that keeps most traffic within a core is taken; `rates` are spikes per step
    (neurons,) of each population, all equal without. CapacityError, with every violation, if a single neuron exceeds a
    limit or the chips have too few cores; OptionError if a population needs more cores than `cores_for` says.
    """
    needs = Needs(network, target)
    least = cores_for or {}
    chunks = cut(needs, least)

    def traffic(source: Chunk, receiver: Chunk) -> float:
        total = 0.0
        for lists in needs.lists(receiver):
            if network.projections[lists.projection].pre == source.population:
                inside = lists.source[(lists.source >= source.first) & (lists.source < source.last)]
                total += float(rates[source.population][inside].sum()) if rates is not None else len(inside)
        return total

    alone = [chunk for chunk in chunks if chunk.population in least]
    groups = _pack(needs, [chunk for chunk in chunks if chunk not in alone], traffic)
    return arrange(needs, [*groups, *((chunk,) for chunk in alone)], chips)
