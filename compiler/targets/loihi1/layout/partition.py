"""Cut populations into chunks that fit a core and pack the chunks on few cores.

The integer network is not changed: which neuron sits where has no influence on any spike.

Synaptic memory, axons and compartments are all counted by the rules of the target; the split of a population
decides how many output axons the populations before it need, so populations are cut from the last to the
first. A recurrent one needs some for its own chunks, so it is cut again until they are enough.
"""

from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from spikeloom.compiler.errors import CapacityError, OptionError, Violation
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.layout.core_needs import ADDED, Chunk, Core, Cores, Needs
from spikeloom.compiler.targets.loihi1.layout.place import core_traffic
from spikeloom.compiler.targets.loihi1.legalize import violation
from spikeloom.compiler.types import FloatArray

EXACT_CHUNKS = 10
"""Up to this many chunks the packing is searched exhaustively; above it, first fit."""


def cut_layer(needs: Needs, population: int, least: int | None = None) -> list[Chunk]:
    """Cut one population into full chunks, or as evenly as possible into at least `least`.

    A recurrent one is cut until its neurons have output axons for its own chunks, too; finer chunks need
    more. CapacityError if one of its neurons fits no core, OptionError if it needs more than `least` chunks.
    """

    def once() -> list[Chunk]:
        return _fill(needs, population) if least is None else _spread(needs, population, least)

    if not any(projection.pre == projection.post == population for projection in needs.network.projections):
        return once()
    others = needs.out_axons[population]
    charged = np.zeros_like(others)
    try:
        while True:
            needs.out_axons[population] = others + charged
            chunks = once()
            incoming = needs.source_axons(chunks).get(population, charged)
            if np.all(incoming <= charged):
                return chunks
            charged = np.maximum(charged, incoming)
    finally:
        needs.out_axons[population] = others


def _fill(needs: Needs, population: int) -> list[Chunk]:
    size = needs.network.populations[population].size
    chunks: list[Chunk] = []
    first = 0
    while first < size:
        ends = range(first + 1, min(size, first + needs.target.limit("core.compartments")) + 1)
        too_long = needs.too_long(Chunk(population=population, first=first, last=ends.stop - 1))
        longest = min(ends.stop, first + too_long) - 1
        needs.look_ahead(Chunk(population=population, first=first, last=longest))

        def exceeds(last: int, first: int = first, too_long: int = too_long) -> bool:
            if last - first >= too_long:
                return True
            tried = Chunk(population=population, first=first, last=last)
            broken = not needs.fits((tried,))
            needs.drop(tried)
            return broken

        # A larger chunk needs more of every limit but synapse formats (all its lists may be dense) and
        # memory (more of them may be alike); there a smaller chunk than the largest may come out, which fits
        # as well.
        fitting = bisect_left(ends, True, key=exceeds)
        if not fitting:
            raise CapacityError(_worst(needs, population))
        chunks.append(Chunk(population=population, first=first, last=ends[fitting - 1]))
        needs.lists(chunks[-1])  # now, while those that they begin are there
        first = chunks[-1].last
    return chunks


def _worst(needs: Needs, population: int) -> tuple[Violation, ...]:
    """Of each limit that single neurons of a population break, the violation by the neuron that breaks it most."""
    worst: dict[str, tuple[int, int]] = {}
    for neuron in range(needs.network.populations[population].size):
        for rule, used in needs.excess(
            (Chunk(population=population, first=neuron, last=neuron + 1),)
        ).items():
            if rule not in worst or used > worst[rule][0]:
                worst[rule] = used, neuron
    name = needs.network.populations[population].name
    return tuple(
        violation(needs.target, f"{name} neuron {n}", rule, used) for rule, (used, n) in worst.items()
    )


def order_on_core(needs: Needs, chunks: Core) -> Core:
    """Densest chunks first: a dense list must start low on its core, a sparse one need not."""

    def key(chunk: Chunk) -> tuple[float, Chunk]:
        spans = sum(int((lists.last - lists.first + 1).sum()) for lists in needs.lists(chunk))
        nonzero = sum(int(lists.nonzero.sum()) for lists in needs.lists(chunk))
        return -nonzero / max(spans, 1), chunk

    return tuple(sorted(chunks, key=key))


def core_bound(network: IntegerNetwork, target: Target) -> int:
    """Cores that compartments and input axons need at least, however the network is cut.

    Memory sets no bound: any lists may turn out to be alike, the shorter they are cut the more.
    """
    compartments = sum(population.size for population in network.populations)
    axons = sum(int((abs(p.weight).sum(axis=0) > 0).sum()) for p in network.projections)
    return max(
        -(-compartments // target.limit("core.compartments")),
        -(-axons // target.limit("core.axons_in")),
    )


def _pack(needs: Needs, chunks: list[Chunk], rates: tuple[FloatArray, ...] | None) -> list[Core]:
    """Put chunks on the fewest cores; among equals, keep most traffic within a core."""
    known: dict[frozenset[Chunk], bool] = {}

    def fits(group: Core) -> bool:
        key = frozenset(group)
        if key not in known:
            known[key] = needs.fits(order_on_core(needs, group))
        return known[key]

    if len(chunks) > EXACT_CHUNKS:
        cores: list[Core] = []
        allowed = [needs.target.limit(rule) for rule in ADDED]
        used = np.zeros((len(chunks), len(ADDED)), np.int64)  # by core
        for chunk in sorted(chunks, key=lambda c: (-needs.stored(c, 0, unrolled=True)[0], c)):
            more = needs.added(chunk)
            roomy = np.flatnonzero(np.all(used[: len(cores)] + more <= allowed, axis=1)).tolist()
            place = next((i for i in roomy if fits((*cores[i], chunk))), len(cores))
            if place == len(cores):
                cores.append(())
            cores[place] = (*cores[place], chunk)
            used[place] += more
        return cores

    alone: list[Core] = [(chunk,) for chunk in chunks]
    traffic = core_traffic(needs.network, tuple(alone), rates)
    best = alone
    best_kept = 0.0

    def search(index: int, cores: list[Core], kept: float) -> None:
        nonlocal best, best_kept
        if len(cores) > len(best):
            return
        if index == len(chunks):
            if (len(cores), -kept) < (len(best), -best_kept):
                best = list(cores)
                best_kept = kept
            return
        chunk = chunks[index]
        for i, core in enumerate(cores):
            if fits((*core, chunk)):
                others = [chunks.index(other) for other in core]
                gained = float(sum(traffic[index, at] + traffic[at, index] for at in others))
                search(index + 1, [*cores[:i], (*core, chunk), *cores[i + 1 :]], kept + gained)
        search(index + 1, [*cores, (chunk,)], kept)

    search(0, [], 0.0)
    return best


def _spread(needs: Needs, population: int, least: int) -> list[Chunk]:
    name = needs.network.populations[population].name
    size = needs.network.populations[population].size
    for parts in range(least, size + 1):
        bounds = [i * size // parts for i in range(parts + 1)]
        chunks = [Chunk(population=population, first=first, last=last) for first, last in pairwise(bounds)]
        if all(needs.fits((chunk,)) for chunk in chunks):
            return chunks
        if parts == least < (fewest := len(_fill(needs, population))):
            raise OptionError(
                f"--cores-for {name}={least}: {name} needs {fewest} cores at least; give {fewest} or more"
            )
    raise CapacityError(_worst(needs, population))


def cut(needs: Needs, least: Mapping[int, int]) -> list[Chunk]:
    """Cut every population: evenly into at least so many chunks if it is in `least`, else into full ones.

    CapacityError lists every limit that a single neuron exceeds; OptionError if `least` is too few.
    """
    chunks: list[Chunk] = []
    violations: tuple[Violation, ...] = ()
    needs.forget()
    for population in reversed(range(len(needs.network.populations))):
        try:
            pieces = cut_layer(needs, population, least.get(population))
        except CapacityError as error:
            violations = error.violations + violations
        else:
            chunks += pieces
            needs.charge(needs.source_axons(pieces))
    if violations:
        raise CapacityError(violations)
    return sorted(chunks)


def arrange(needs: Needs, groups: Iterable[Core], chips: int = 1) -> Cores:
    """Put groups of chunks on cores, in order; CapacityError if the chips have too few cores."""
    cores = sorted((order_on_core(needs, group) for group in groups), key=min)
    allowed = chips * needs.target.limit("chip.cores")
    if len(cores) > allowed:
        excess = violation(
            needs.target, "chip" if chips == 1 else f"{chips} chips", "chip.cores", len(cores)
        )
        raise CapacityError((replace(excess, allowed=allowed),))
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

    Populations in `cores_for` are cut as evenly as possible into so many chunks at least, each on a core of
    its own; the others into full ones. Among equal packings, searched exhaustively up to ``EXACT_CHUNKS``
    chunks, the one that keeps most traffic within a core is taken; `rates` are spikes per step (neurons,) of
    each population, all equal without. CapacityError, with every violation, if a single neuron exceeds a
    limit or the chips have too few cores; OptionError if a population needs more cores than `cores_for`
    says.
    """
    needs = Needs(network, target)
    least = cores_for or {}
    chunks = cut(needs, least)

    alone = [chunk for chunk in chunks if chunk.population in least]
    groups = _pack(needs, [chunk for chunk in chunks if chunk not in alone], rates)
    return arrange(needs, [*groups, *((chunk,) for chunk in alone)], chips)
