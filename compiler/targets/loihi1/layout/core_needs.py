"""Count what the core needs that holds given neurons: compartments, axons, words, slots.

Nothing is changed. Neurons are looked at in *chunks*, runs of neighbours of one population.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.ir import INPUT, Sparse
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerProjection
from spikeloom.compiler.targets.loihi1.legalize import list_words, stored_once
from spikeloom.compiler.types import IntArray

SPARSE_SHARE = 0.75
"""A list goes sparse when it stores at most this share of what the dense form would store and visit."""

ADDED = ("core.compartments", "core.axons_in", "core.axons_out")
"""Limits of which a core uses as much as its chunks do together."""

FEW = 16
"""Neurons of which the input axons are counted first."""

PLACE = np.int16
"""Type of a place on a core: it has few enough, and places are most of what is held."""

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


Core = tuple[Chunk, ...]
"""Chunks of one core, in their order on it."""

Cores = tuple[Core, ...]
"""Every neuron of a network on a core, first core first."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lists:
    """Synapse lists from one projection into one chunk, one per source neuron with a non-zero weight."""

    projection: int  # Index in the network
    source: IntArray  # (lists,) int64; neuron of the source population
    nonzero: IntArray  # (lists,) int64; non-zero synapses of each list
    row: IntArray  # (synapses,) int16; neuron within the chunk, ascending in each list
    mantissa: IntArray  # (synapses,); non-zero weight
    first: IntArray  # (lists,) int64; first row of each list
    last: IntArray  # (lists,) int64; last row of each list


def sources_of(weight: Sparse, chunk: Chunk) -> IntArray:
    """Neurons that a chunk hears through some weights, (sources,) int64."""
    synapses = slice(*weight.indptr[[chunk.first, chunk.last]].tolist())
    heard = np.zeros(weight.shape[1], np.bool_)
    heard[weight.indices[synapses][weight.data[synapses] != 0]] = True
    return np.flatnonzero(heard)


def lists_into(network: IntegerNetwork, chunk: Chunk) -> tuple[Lists, ...]:
    """Collect the synapse lists that a chunk's core has to store, zero weights left out."""
    collected = []
    for index, projection in enumerate(network.projections):
        if projection.post == chunk.population:
            part = projection.weight[chunk.first : chunk.last].tocsc()
            part.eliminate_zeros()
            bounds = part.indptr.astype(np.int64)
            row = part.indices.astype(PLACE)
            source = np.flatnonzero(np.diff(bounds))
            into = Lists(
                projection=index,
                source=source,
                nonzero=np.diff(bounds)[source],
                row=row,
                mantissa=part.data,
                first=row[bounds[source]].astype(np.int64),
                last=row[bounds[source + 1] - 1].astype(np.int64),
            )
            collected.append(into)
    return tuple(collected)


def lists_of_first(lists: Lists, size: int) -> Lists:
    """What is left of the lists into a chunk for its first neurons."""
    kept = lists.row < size
    nonzero = np.add.reduceat(kept, np.cumsum(lists.nonzero) - lists.nonzero, dtype=np.int64)
    some = nonzero > 0
    row = lists.row[kept]
    return Lists(
        projection=lists.projection,
        source=lists.source[some],
        nonzero=nonzero[some],
        row=row,
        mantissa=lists.mantissa[kept],
        first=lists.first[some],
        last=row[np.cumsum(nonzero[some]) - 1].astype(np.int64),
    )


def index_bits(highest: int, target: Target) -> int:
    """Narrowest sparse index that reaches compartment `highest` of a core."""
    return min(bits for bits in target.choices["synapse.index_bits"] if bits and highest < 1 << bits)


def choose_dense(
    lists: Lists, projection: IntegerProjection, base: int, size: int, *, lean: bool, target: Target
) -> tuple[IntArray, IntArray]:
    """Decide the form of each list of a chunk that starts at compartment `base` of its core: 1 for dense, and words.

    A `lean` core prefers few visited synapses (sparse unless nearly full) to few words.
    """
    span = lists.last - lists.first + 1
    sparse_words = list_words(lists.nonzero, projection.bits, index_bits(base + size - 1, target), target)
    dense_words = list_words(span, projection.bits, 0, target)
    possible = base + lists.first <= target.limit("core.dense_base")
    wanted = lists.nonzero > SPARSE_SHARE * span if lean else dense_words < sparse_words
    dense = possible & wanted
    return dense.astype(np.int64), np.where(dense, dense_words, sparse_words)


class Needs:
    """What chunks need, computed once per chunk and base."""

    def __init__(self, network: IntegerNetwork, target: Target) -> None:
        self.network = network
        self.target = target
        self.forget()
        self._lists: dict[Chunk, tuple[Lists, ...]] = {}
        self._longest: tuple[Chunk, tuple[Lists, ...]] | None = None
        self._stored: dict[tuple[Chunk, int, bool, bool], tuple[int, frozenset[SynapseFormat]]] = {}
        self._lean: dict[Core, bool] = {}

    def lists(self, chunk: Chunk) -> tuple[Lists, ...]:
        """Synapse lists of a chunk."""
        if chunk not in self._lists:
            self._lists[chunk] = self._first_of_longest(chunk) or lists_into(self.network, chunk)
        return self._lists[chunk]

    def too_long(self, longest: Chunk) -> int:
        """A size from which on chunks that begin as this one have too many input axons; counted without lists."""
        limit = self.target.limit("core.axons_in")
        weights = [each.weight for each in self.network.projections if each.post == longest.population]
        size = FEW
        while size <= longest.size:
            chunk = replace(longest, last=longest.first + size)
            if sum(len(sources_of(weight, chunk)) for weight in weights) > limit:
                return size
            size *= 2
        return longest.size + 1

    def look_ahead(self, longest: Chunk) -> None:
        """Chunks that begin as this one and are shorter are asked about next."""
        self._longest = longest, lists_into(self.network, longest)

    def _first_of_longest(self, chunk: Chunk) -> tuple[Lists, ...]:
        """Synapse lists of a chunk, if it is the beginning of the one that was looked ahead to."""
        if self._longest is None:
            return ()
        longest, lists = self._longest
        if (chunk.population, chunk.first) != (
            longest.population,
            longest.first,
        ) or chunk.size > longest.size:
            return ()
        return tuple(lists_of_first(each, chunk.size) for each in lists)

    def drop(self, chunk: Chunk) -> None:
        """Forget the lists of a chunk that was only tried."""
        self._lists.pop(chunk, None)

    def stored(
        self, chunk: Chunk, base: int, *, lean: bool = False, unrolled: bool = False
    ) -> tuple[int, frozenset[SynapseFormat]]:
        """Words and synapse formats of a chunk's lists if it starts at compartment `base` of its core.

        `unrolled` are words as if no axons shared a list, which is counted faster.
        """
        key = (chunk, base, lean, unrolled)
        if key not in self._stored:
            words = 0
            formats = set()
            for lists in self.lists(chunk):
                projection = self.network.projections[lists.projection]
                dense, taken = choose_dense(
                    lists, projection, base, chunk.size, lean=lean, target=self.target
                )
                if not unrolled:
                    taken = taken[
                        stored_once(dense, lists.nonzero, lists.row + base, lists.mantissa, self.target)
                    ]
                words += int(taken.sum())
                index = index_bits(base + chunk.size - 1, self.target)
                formats |= {
                    (projection.bits, projection.exponent, 0 if flag else index) for flag in np.unique(dense)
                }
            self._stored[key] = words, frozenset(formats)
        return self._stored[key]

    def added(self, chunk: Chunk) -> tuple[int, int, int]:
        """What a chunk adds to the limits in ``ADDED``, whatever else its core holds."""
        out_axons = self.out_axons[chunk.population][chunk.first : chunk.last]
        return chunk.size, sum(len(lists.source) for lists in self.lists(chunk)), int(out_axons.sum())

    def uses(self, chunks: Core, *, lean: bool = False, unrolled: bool = False) -> dict[str, int]:
        """Use of each limit by a core that holds these chunks in this order."""
        base = words = 0
        thresholds: set[int] = set()
        decays: set[tuple[int, int]] = set()
        formats: set[SynapseFormat] = set()
        for chunk in chunks:
            more, used = self.stored(chunk, base, lean=lean, unrolled=unrolled)
            words += more
            formats |= used
            base += chunk.size
            population = self.network.populations[chunk.population]
            thresholds |= set(np.unique(population.threshold[chunk.first : chunk.last]).tolist())
            decays.add((population.decay_u, population.decay_v))
        added = zip(*map(self.added, chunks), strict=True)
        return {
            **dict(zip(ADDED, map(sum, added), strict=True)),
            "core.synapse_words": words,
            "core.threshold_slots": len(thresholds),
            "core.synapse_formats": len(formats),
            "core.compartment_configs": len(decays),
        }

    def excess(self, chunks: Core, *, lean: bool = False, unrolled: bool = False) -> dict[str, int]:
        """Use of the limits that such a core breaks."""
        uses = self.uses(chunks, lean=lean, unrolled=unrolled).items()
        return {rule: used for rule, used in uses if used > self.target.limit(rule)}

    def fits(self, chunks: Core) -> bool:
        """Whether such a core keeps every limit; shared lists are looked for only where all depends on them."""
        broken = self.excess(chunks, unrolled=True).keys()
        return not broken or (broken == {"core.synapse_words"} and not self.excess(chunks))

    def lean(self, chunks: Core) -> bool:
        """Whether such a core has room for lists of few visited synapses; its output axons do not matter."""
        if chunks not in self._lean:
            self._lean[chunks] = any(
                self.excess(chunks, lean=True, unrolled=unrolled).keys() <= {"core.axons_out"}
                for unrolled in (True, False)
            )
        return self._lean[chunks]

    def forget(self) -> None:
        """Charge no source with any output axon."""
        self.out_axons = [np.zeros(population.size, np.int64) for population in self.network.populations]

    def source_axons(self, chunks: Iterable[Chunk]) -> dict[int, IntArray]:
        """Output axons that the sources of chunks need, one for each of their lists, by population."""
        axons: dict[int, IntArray] = {}
        for chunk in chunks:
            for lists in self.lists(chunk):
                pre = self.network.projections[lists.projection].pre
                if pre != INPUT:
                    axons.setdefault(pre, np.zeros(self.network.populations[pre].size, np.int64))[
                        lists.source
                    ] += 1
        return axons

    def charge(self, axons: dict[int, IntArray]) -> None:
        """Charge sources with output axons, by population."""
        for pre, more in axons.items():
            self.out_axons[pre] += more
