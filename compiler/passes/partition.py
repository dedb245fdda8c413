"""Cut populations into chunks that fit a core and pack the chunks on as few cores as possible.

The integer network is not changed: which neuron sits where has no influence on any spike.

Synaptic memory, axons and compartments are all counted by the rules of the target; the split of a population decides
how many output axons the populations before it need, so populations are cut from the last to the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from compiler.errors import CapacityError, Violation
from compiler.fixedpoint import FloatArray, IntArray
from compiler.ir import INPUT, IntegerNetwork, IntegerProjection
from compiler.passes.legalize import LimitUse, list_words, violation
from compiler.targets import Target

EXACT_CHUNKS = 10
"""Up to this many chunks the packing is searched exhaustively; above it, first fit."""

SPARSE_SHARE = 0.75
"""A list goes sparse when it stores at most this share of what the dense form would store and visit."""

SynapseFormat = tuple[int, int, int]
"""Weight bits, exponent and index bits (0 if dense)."""


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Chunk:
    """Neurons ``first … last - 1`` of one population."""

    population: int
    first: int
    last: int

    @property
    def size(self) -> int:
        """Number of neurons."""
        return self.last - self.first


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lists:
    """Synapse lists from one projection into one chunk, one per source neuron with a non-zero weight.

    Parameters
    ----------
    projection : int
        Index in the network.
    source : (lists,) int64
        Neuron of the source population.
    nonzero : (lists,) int64
        Non-zero synapses of each list.
    first, last : (lists,) int64
        First and last neuron of the chunk (counted within it) with a non-zero weight.
    """

    projection: int
    source: IntArray
    nonzero: IntArray
    first: IntArray
    last: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Partition:
    """Chunks of each core, in their order on it.

    Parameters
    ----------
    cores : tuple of tuple of Chunk
        First core first.
    bound : int
        No legal partition can use fewer cores than this.
    """

    cores: tuple[tuple[Chunk, ...], ...]
    bound: int


def lists_into(network: IntegerNetwork, chunk: Chunk) -> tuple[Lists, ...]:
    """Collect the synapse lists that a chunk's core has to store, zero weights left out."""
    found = []
    for index, projection in enumerate(network.projections):
        if projection.post == chunk.population:
            part = projection.weight[chunk.first : chunk.last].tocoo()
            keep = part.data != 0
            row, column = part.coords[0][keep], part.coords[1][keep]
            pre = projection.weight.shape[1]
            nonzero = np.bincount(column, minlength=pre)
            first = np.full(pre, chunk.size)
            last = np.zeros(pre, np.int64)
            np.minimum.at(first, column, row)
            np.maximum.at(last, column, row)
            source = np.flatnonzero(nonzero)
            found.append(
                Lists(
                    projection=index,
                    source=source,
                    nonzero=nonzero[source],
                    first=first[source],
                    last=last[source],
                )
            )
    return tuple(found)


def index_bits(highest: int, target: Target) -> int:
    """Narrowest sparse index that reaches compartment `highest` of a core."""
    return min(bits for bits in target.choices["synapse.index_bits"] if bits and highest < 1 << bits)


def choose_dense(
    lists: Lists, projection: IntegerProjection, base: int, size: int, *, lean: bool, target: Target
) -> tuple[IntArray, IntArray]:
    """Decide the form of each list of a chunk that starts at compartment `base` of its core.

    Parameters
    ----------
    lean : bool
        Prefer few visited synapses (sparse unless nearly full) to few words.

    Returns
    -------
    dense : (lists,) bool as int64
        1 where the list is stored dense.
    words : (lists,) int64
        Words that it takes.
    """
    span = lists.last - lists.first + 1
    sparse_words = list_words(lists.nonzero, projection.bits, index_bits(base + size - 1, target), target)
    dense_words = list_words(span, projection.bits, 0, target)
    possible = base + lists.first <= target.limit("core.dense_base")
    wanted = lists.nonzero > SPARSE_SHARE * span if lean else dense_words < sparse_words
    dense = possible & wanted
    return dense.astype(np.int64), np.where(dense, dense_words, sparse_words)


class _Costs:
    """What chunks need, computed once per chunk and base."""

    def __init__(self, network: IntegerNetwork, target: Target) -> None:
        self.network = network
        self.target = target
        self.out_axons = [np.zeros(population.size, np.int64) for population in network.populations]
        self._lists: dict[Chunk, tuple[Lists, ...]] = {}
        self._stored: dict[tuple[Chunk, int, bool], tuple[int, frozenset[SynapseFormat]]] = {}

    def lists(self, chunk: Chunk) -> tuple[Lists, ...]:
        if chunk not in self._lists:
            self._lists[chunk] = lists_into(self.network, chunk)
        return self._lists[chunk]

    def stored(self, chunk: Chunk, base: int, *, lean: bool = False) -> tuple[int, frozenset[SynapseFormat]]:
        """Words and synapse formats of a chunk's lists if it starts at compartment `base` of its core."""
        key = (chunk, base, lean)
        if key not in self._stored:
            words, formats = 0, set()
            for lists in self.lists(chunk):
                projection = self.network.projections[lists.projection]
                dense, taken = choose_dense(lists, projection, base, chunk.size, lean=lean, target=self.target)
                words += int(taken.sum())
                index = index_bits(base + chunk.size - 1, self.target)
                formats |= {(projection.bits, projection.exponent, 0 if flag else index) for flag in np.unique(dense)}
            self._stored[key] = words, frozenset(formats)
        return self._stored[key]

    def uses(self, chunks: tuple[Chunk, ...], *, lean: bool = False) -> dict[str, int]:
        """Use of each limit by a core that holds these chunks in this order."""
        base = words = 0
        thresholds: set[int] = set()
        decays: set[tuple[int, int]] = set()
        formats: set[SynapseFormat] = set()
        for chunk in chunks:
            more, used = self.stored(chunk, base, lean=lean)
            words += more
            formats |= used
            base += chunk.size
            population = self.network.populations[chunk.population]
            thresholds |= set(np.unique(population.threshold[chunk.first : chunk.last]).tolist())
            decays.add((population.decay_u, population.decay_v))
        return {
            "core.compartments": base,
            "core.axons_in": sum(len(lists.source) for chunk in chunks for lists in self.lists(chunk)),
            "core.axons_out": int(sum(self.out_axons[c.population][c.first : c.last].sum() for c in chunks)),
            "core.synapse_words": words,
            "core.threshold_slots": len(thresholds),
            "core.synapse_formats": len(formats),
            "core.compartment_configs": len(decays),
        }

    def excess(self, chunks: tuple[Chunk, ...], *, lean: bool = False) -> list[LimitUse]:
        uses = self.uses(chunks, lean=lean)
        return [
            LimitUse(name=rule, used=used, allowed=self.target.limit(rule), core=None)
            for rule, used in uses.items()
            if used > self.target.limit(rule)
        ]

    def listen(self, chunk: Chunk) -> None:
        """Charge the sources of a chunk with one output axon for each of its lists."""
        for lists in self.lists(chunk):
            pre = self.network.projections[lists.projection].pre
            if pre != INPUT:
                self.out_axons[pre][lists.source] += 1


def _largest(low: int, high: int, fits: Callable[[int], bool]) -> int:
    """Largest value in ``low … high`` that fits, given that `low` does and that fitting is monotone.

    For chunks it is, in every limit but the synapse formats (all lists of the larger chunk may be dense); there a
    smaller chunk than the largest may come out, which fits as well.
    """
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def _cut(costs: _Costs, population: int) -> tuple[list[Chunk], list[Violation]]:
    """Cut one population greedily into chunks that fit an empty core; or say why one neuron does not."""
    size = costs.network.populations[population].size
    chunks: list[Chunk] = []
    first = 0
    while first < size:
        one = Chunk(population=population, first=first, last=first + 1)
        if costs.excess((one,)):
            return [], _worst(costs, population)

        def fits(last: int, first: int = first) -> bool:
            return not costs.excess((Chunk(population=population, first=first, last=last),))

        most = min(size, first + costs.target.limit("core.compartments"))
        chunks.append(Chunk(population=population, first=first, last=_largest(first + 1, most, fits)))
        first = chunks[-1].last
    return chunks, []


def _worst(costs: _Costs, population: int) -> list[Violation]:
    """For each limit that single neurons of a population break: the one that breaks it most."""
    found: dict[str, tuple[LimitUse, int]] = {}
    for neuron in range(costs.network.populations[population].size):
        for use in costs.excess((Chunk(population=population, first=neuron, last=neuron + 1),)):
            if use.name not in found or use.used > found[use.name][0].used:
                found[use.name] = use, neuron
    name = costs.network.populations[population].name
    return [violation(use, f"{name} neuron {neuron}", costs.target) for use, neuron in found.values()]


def _order_on_core(costs: _Costs, chunks: tuple[Chunk, ...]) -> tuple[Chunk, ...]:
    """Densest chunks first: a dense list must start low on its core, a sparse one need not."""

    def key(chunk: Chunk) -> tuple[float, Chunk]:
        spans = sum(int((lists.last - lists.first + 1).sum()) for lists in costs.lists(chunk))
        nonzero = sum(int(lists.nonzero.sum()) for lists in costs.lists(chunk))
        return -nonzero / max(spans, 1), chunk

    return tuple(sorted(chunks, key=key))


def _core_bound(costs: _Costs, chunks: list[Chunk]) -> int:
    """Cores that compartments and synaptic memory need at least, however the network is cut."""
    compartments = sum(chunk.size for chunk in chunks)
    # Cutting a list elsewhere moves header and index bits, so memory is bounded by the mantissas alone.
    payload = sum(
        int(lists.nonzero.sum()) * costs.network.projections[lists.projection].bits
        for chunk in chunks
        for lists in costs.lists(chunk)
    )
    memory = costs.target.limit("synapse.word_bits") * costs.target.limit("core.synapse_words")
    return max(-(-compartments // costs.target.limit("core.compartments")), -(-payload // memory))


def _pack(costs: _Costs, chunks: list[Chunk], traffic: Callable[[Chunk, Chunk], float]) -> list[tuple[Chunk, ...]]:
    """Put chunks on the fewest cores; among equals, keep most traffic within a core."""
    known: dict[frozenset[Chunk], bool] = {}

    def fits(group: tuple[Chunk, ...]) -> bool:
        key = frozenset(group)
        if key not in known:
            known[key] = not costs.excess(_order_on_core(costs, group))
        return known[key]

    if len(chunks) > EXACT_CHUNKS:
        cores: list[tuple[Chunk, ...]] = []
        for chunk in sorted(chunks, key=lambda c: (-costs.stored(c, 0)[0], c)):
            for i, core in enumerate(cores):
                if fits((*core, chunk)):
                    cores[i] = (*core, chunk)
                    break
            else:
                cores.append((chunk,))
        return cores

    best: list[tuple[Chunk, ...]] = [(chunk,) for chunk in chunks]
    best_kept = 0.0

    def search(index: int, cores: list[tuple[Chunk, ...]], kept: float) -> None:
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


def partition(network: IntegerNetwork, target: Target, rates: tuple[FloatArray, ...] | None = None) -> Partition:
    """Assign every neuron to a core.

    Parameters
    ----------
    network : IntegerNetwork
        Integer stage.
    target : Target
        Limits of a core and of the chip.
    rates : tuple of (neurons,) float64, optional
        Spikes per step of each population, to prefer packings that keep traffic within a core; all equal without.

    Returns
    -------
    Partition
        Fewest cores that the cut into full chunks allows if the densest chunk of a core comes first, searched
        exhaustively up to ``EXACT_CHUNKS`` chunks.

    Raises
    ------
    CapacityError
        If a single neuron exceeds a limit or the chip has too few cores; lists every violation.
    """
    costs = _Costs(network, target)
    chunks: list[Chunk] = []
    violations: list[Violation] = []
    for population in reversed(range(len(network.populations))):
        cut, why = _cut(costs, population)
        violations = why + violations
        chunks += cut
        for chunk in cut:
            costs.listen(chunk)
    if violations:
        raise CapacityError(tuple(violations))

    def traffic(source: Chunk, listener: Chunk) -> float:
        total = 0.0
        for lists in costs.lists(listener):
            if network.projections[lists.projection].pre == source.population:
                inside = lists.source[(lists.source >= source.first) & (lists.source < source.last)]
                total += float(rates[source.population][inside].sum()) if rates is not None else len(inside)
        return total

    chunks.sort()
    cores = sorted(_order_on_core(costs, core) for core in _pack(costs, chunks, traffic))
    cores.sort(key=min)
    used = LimitUse(name="chip.cores", used=len(cores), allowed=target.limit("chip.cores"), core=None)
    if used.used > used.allowed:
        raise CapacityError((violation(used, "chip", target),))
    return Partition(cores=tuple(cores), bound=_core_bound(costs, chunks))


def lean_fits(network: IntegerNetwork, target: Target, chunks: tuple[Chunk, ...]) -> bool:
    """Whether a core still holds its chunks when lists prefer few visited synapses to few words."""
    return not _Costs(network, target).excess(chunks, lean=True)
