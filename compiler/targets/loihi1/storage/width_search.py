"""Search the storage width of each layer: every combination, on the chip's own spikes.

Each layer is rounded once for each width, and every combination is run. Which of a layer's few best scales it gets is
decided beside other layers at full width; the compiler decides that for each combination anew. So the combinations on
the Pareto front are then settled as the compiler does, and built: their figures are those of the netlist that the
compiler makes, and the front is drawn anew until all that is on it was built. A combination that would do better than
it did here and so never came to the front is missed. The network is not changed.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import CapacityError, ModelError, OptionError
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.interpret import BoolArray, cut, run_float, vote
from spikeloom.compiler.ir import INPUT, IntegerNetwork, Network, Readout, recurrent
from spikeloom.compiler.passes.calibrate import calibrate, evenly_spaced
from spikeloom.compiler.passes.prune import Mask, compact, disconnect, either, never_fires, removable
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, choose_dense, lists_into
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.options import Recipe, check_recipes
from spikeloom.compiler.targets.loihi1.storage.branches import Offers, Path, Widths, offer_forms, settle, usual, votes

MAX_COMBINATIONS = 4096
"""Combinations that are searched at most: six widths in four layers are 1,296, five in five layers 3,125."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One combination of widths.

    Parameters
    ----------
    bits : tuple of int
        Width of each layer.
    words : int
        64-bit words of synaptic memory, each list in the smaller of its forms: estimated, or on the cores of the
        netlist. A netlist uses the larger form where a core has room for it and it saves synaptic operations.
    equal : int
        Recordings that are decided as the float64 model does.
    right : int or None
        Recordings that are decided right; None where a label is unknown.
    cores : int or None
        Cores of the netlist; None where none was built.
    """

    bits: Widths
    words: int
    equal: int
    right: int | None
    cores: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """All combinations, and the best of them as netlists.

    Parameters
    ----------
    samples : int
        Recordings that were decided.
    float_right : int or None
        Those of them that the float64 model decides right.
    points : tuple of Point
        Every combination, in the order of its widths; scales as a rule, memory estimated.
    built : tuple of Point
        Those on a front (accuracy or agreement against memory) that fit the chip, as the compiler builds them.
    """

    samples: int
    float_right: int | None
    points: tuple[Point, ...]
    built: tuple[Point, ...]


def check_widths(widths: Sequence[int], groups: int, layers: int, target: Target) -> Widths:
    """Widths to search, each once, narrowest first.

    Raises
    ------
    OptionError
        If the chip has no such storage, or there are too many combinations to try them all.
    """
    allowed = target.choices["synapse.weight_bits"]
    asked = f"--widths {','.join(map(str, widths))}"
    for width in widths:
        if width not in allowed:
            raise OptionError(
                f"{asked}: {target.title} does not store {width} bits; allowed: {', '.join(map(str, allowed))}"
            )
    check_recipes((Recipe(bits=widths[0], groups=groups),), layers, target)
    found = tuple(sorted(set(widths)))
    if len(found) ** layers > MAX_COMBINATIONS:
        most = max(count for count in range(1, len(found)) if count**layers <= MAX_COMBINATIONS)
        raise OptionError(
            f"{asked}: {len(found)} widths in {layers} layers are {len(found) ** layers:,} combinations, the search "
            f"tries them all up to {MAX_COMBINATIONS:,}; give {most} at most"
        )
    return found


def front(points: Iterable[Point], by: str) -> tuple[Point, ...]:
    """Points that no other one beats in memory and in ``equal`` or ``right``, least memory first.

    Examples
    --------
    >>> points = [Point(bits=(b,), words=w, equal=e, right=None) for b, w, e in ((2, 5, 1), (3, 6, 1), (4, 7, 3))]
    >>> [point.bits for point in front(points, "equal")]
    [(2,), (4,)]
    """
    found: list[Point] = []
    for point in sorted(points, key=lambda p: (p.words, -getattr(p, by), p.bits)):
        if not found or getattr(point, by) > getattr(found[-1], by):
            found.append(point)
    return tuple(found)


def search(
    network: Network,
    target: Target,
    events: BoolArray,
    labels: IntArray,
    *,
    widths: Sequence[int],
    groups: int = 1,
    samples: int = 96,
    lengths: IntArray | None = None,
    tell: Callable[[str], None] = lambda _stage: None,
) -> Found:
    """Try every combination of widths.

    Parameters
    ----------
    network : Network
        Float stage.
    target : Target
        Chip.
    events : (recordings, steps, channels) bool
        Training recordings. Those that the compiler calibrates on choose the scales; `samples` of them at most, evenly
        spaced, are decided.
    labels : (recordings,) int64
        Class of each, -1 where it is not known.
    widths : sequence of int
        Storage widths of a mantissa.
    groups : int
        Different scales in a layer, at most.
    samples : int
        Recordings to decide.
    lengths : (recordings,) int64, optional
        Steps of each recording that count.
    tell : callable, optional
        Called with what is being done.

    Raises
    ------
    DataError, OptionError
        If the recordings or the widths cannot be used.
    ModelError
        If a layer has no usable scale at any width, or hears itself.
    """
    if loops := recurrent(network):
        raise ModelError(
            f"{', '.join(loops)}: hears itself; combinations of widths are tried layer by layer, for networks without "
            "recurrence: compile with --weight-bits"
        )
    widths = check_widths(widths, groups, len(network.populations), target)
    tell("running the float model")
    calibration = calibrate(network, evenly_spaced(events))
    chosen = np.linspace(0, len(events) - 1, min(samples, len(events))).round().astype(np.int64)
    shown, known = events[chosen], labels[chosen]
    ends = None if lengths is None else lengths[chosen]
    labelled = bool(np.all(known >= 0))
    reference = run_float(network, shown).spikes[network.readout.population]
    wanted = _decide(cut(reference, ends).sum(axis=1), network.readout, network.classes)

    tell("rounding each layer to each width")
    network = disconnect(network, never_fires(network))
    offers = offer_forms(network, target, widths, groups, calibration)
    memory = _Memory(network, offers, target)
    decided: dict[Path, IntArray] = {}

    def decide(paths: Iterable[Path]) -> None:
        for path, counts in votes(network, offers, set(paths) - decided.keys(), shown, ends).items():
            decided[path] = _decide(counts, network.readout, network.classes)

    def point(bits: Widths, path: Path, words: int, cores: int | None = None) -> Point:
        equal, right = (int(np.count_nonzero(decided[path] == aim)) for aim in (wanted, known))
        return Point(bits=bits, words=words, equal=equal, right=right if labelled else None, cores=cores)

    forms = usual(network, offers, calibration)
    paths = {
        bits: tuple(known[width] for known, width in zip(forms, bits, strict=True))
        for bits in itertools.product(*offers.places)
    }
    tell(f"trying {len(paths):,} combinations")
    decide(paths.values())
    points = [point(bits, path, memory.words(path)) for bits, path in paths.items()]

    # the front is drawn anew with the figures of what was built, until all that is on it was built
    figures = ("equal", "right") if labelled else ("equal",)
    rates = tuple(spikes.mean(axis=(0, 1)) for spikes in calibration.spikes)
    current, built = {found.bits: found for found in points}, dict[Widths, Point | None]()
    while best := {found.bits for by in figures for found in front(current.values(), by)} - built.keys():
        tell(f"building the best of them: {len(built) + len(best)}")
        settled = settle(network, offers, best, calibration)
        decide(settled.values())
        for bits, path in settled.items():
            size = _size(offers.put_together(network, path), target, rates)
            built[bits] = None if size is None else point(bits, path, *size)
            if size is None:
                del current[bits]
            else:
                current[bits] = point(bits, path, current[bits].words)
    return Found(
        samples=len(chosen),
        float_right=int(np.count_nonzero(wanted == known)) if labelled else None,
        points=tuple(points),
        built=tuple(found for _, found in sorted(built.items()) if found is not None),
    )


def _decide(counts: IntArray, readout: Readout, classes: int) -> IntArray:
    """Class of each recording from the spikes of each voting neuron (samples, neurons)."""
    return vote(counts @ (readout.label[:, None] == np.arange(classes)).astype(np.int64))


class _Memory:
    """Estimates of synaptic memory: each layer on cores of its own, without the neurons that provably never fire."""

    def __init__(self, network: Network, offers: Offers, target: Target) -> None:
        self._network, self._offers, self._target = network, offers, target
        usual = tuple(0 for _ in offers.forms)
        self._fires: list[list[Mask]] = []
        self._words: list[list[dict[int, IntArray]]] = []  # words for each neuron of each source, by layer and form
        for post, forms in enumerate(offers.forms):
            networks = [offers.put_together(network, (*usual[:post], k, *usual[post + 1 :])) for k in range(len(forms))]
            self._fires.append([~removable(integer)[0][post] for integer in networks])
            pairs = zip(networks, self._fires[-1], strict=True)
            self._words.append([self._into(integer, post, fires) for integer, fires in pairs])

    def words(self, path: Path) -> int:
        """Words of one combination."""
        total = 0
        for post, form in enumerate(path):
            for pre, words in self._words[post][form].items():
                total += int(words.sum() if pre == INPUT else words[self._fires[pre][path[pre]]].sum())
        return total

    def _into(self, integer: IntegerNetwork, post: int, fires: Mask) -> dict[int, IntArray]:
        laid, _ = compact(integer, tuple(~fires if i == post else mask for i, mask in enumerate(_nobody(integer))))
        size, limit = laid.populations[post].size, self._target.limit("core.synapse_words")
        most = min(size, self._target.limit("core.compartments"))
        while True:
            found: dict[int, IntArray] = {}
            fullest = 0
            for first in range(0, size, most):
                chunk = Chunk(population=post, first=first, last=min(first + most, size))
                words = _chunk_words(laid, chunk, 0, self._target)
                fullest = max(fullest, sum(int(each.sum()) for each in words.values()))
                found = {pre: found.get(pre, 0) + each for pre, each in words.items()}
            if fullest <= limit or most == 1:
                return found
            most = max(1, most * limit // fullest)


def _nobody(network: IntegerNetwork) -> tuple[Mask, ...]:
    return tuple(np.zeros(population.size, np.bool_) for population in network.populations)


def _chunk_words(network: IntegerNetwork, chunk: Chunk, base: int, target: Target) -> dict[int, IntArray]:
    """Words that a chunk's lists take in their smaller form, for each neuron of each source population."""
    found: dict[int, IntArray] = {}
    for lists in lists_into(network, chunk):
        projection = network.projections[lists.projection]
        _, taken = choose_dense(lists, projection, base, chunk.size, lean=False, target=target)
        words = found.setdefault(projection.pre, np.zeros(projection.weight.shape[1], np.int64))
        words[lists.source] += taken
    return found


def _size(integer: IntegerNetwork, target: Target, rates: tuple[FloatArray, ...]) -> tuple[int, int] | None:
    """Words that a network needs and cores that it takes as the compiler lays it out; None if it does not fit."""
    laid, kept = compact(integer, either(*removable(integer)))
    try:
        parts = partition(laid, target, tuple(rate[ids] for rate, ids in zip(rates, kept, strict=True)))
    except CapacityError:
        return None
    words = 0
    for core in parts.cores:
        base = 0
        for chunk in core:
            words += sum(int(each.sum()) for each in _chunk_words(laid, chunk, base, target).values())
            base += chunk.size
    return words, len(parts.cores)
