"""Search the storage width of each layer on the chip's own spikes: coordinate descent from the widest to the narrowest.

From the widest storage the layer is narrowed whose next smaller width keeps most decisions, again and again until all
are at their narrowest; every combination on the way is a point. The best of these, on the Pareto front, are then
rounded as the compiler does and laid out: their figures are those of the netlist that the compiler makes, and the
front is drawn anew until all that is on it was built. The network is not changed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.errors import CapacityError, ModelError, OptionError
from spikeloom.compiler.interpret import cut, run_float, run_integer, vote
from spikeloom.compiler.ir import IntegerNetwork, Network
from spikeloom.compiler.passes.calibrate import Calibration, calibrate, evenly_spaced
from spikeloom.compiler.passes.prune import compact, disconnect, either, never_fires, removable
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.core_needs import Needs
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.options import Packing, check_packings
from spikeloom.compiler.targets.loihi1.storage.choose_storage import assemble, best_scale, choose_storage
from spikeloom.compiler.targets.loihi1.storage.scales import Rounded, layer_of
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

Widths = tuple[int, ...]
"""Storage width of each layer."""

Offers = list[dict[int, Rounded]]
"""Best scale of each layer by width, widest width first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WidthPoint:
    """One combination of widths."""

    bits: Widths  # Width of each layer
    # 64-bit words of synaptic memory: of the weights alone, or, of what was built, of all lists in the smaller of their
    # forms. A netlist uses the larger form where a core has room for it and it saves synaptic operations.
    words: int
    equal: int  # Recordings that are decided as the float64 model does
    right: int | None  # Recordings that are decided right; None where a label is unknown
    cores: int | None = None  # Cores of the netlist; None where none was built


@dataclass(frozen=True, slots=True, kw_only=True)
class WidthSearch:
    """Combinations that were tried, and the best of them as netlists."""

    samples: int  # Recordings that were decided
    float_right: int | None  # Those of them that the float64 model decides right
    points: tuple[WidthPoint, ...]  # Every combination that was tried, each layer at the scale that is best by itself
    # Those on a front (accuracy or agreement against memory) that fit the chip, as the compiler builds them
    built: tuple[WidthPoint, ...]


def check_widths(widths: Sequence[int], groups: int, layers: int, target: Target) -> Widths:
    """Widths to search, each once, narrowest first; OptionError if the chip has no such storage."""
    allowed = target.choices["synapse.weight_bits"]
    for width in widths:
        if width not in allowed:
            given = ",".join(map(str, widths))
            raise OptionError(
                f"--widths {given}: {target.title} does not store {width} bits; allowed: {', '.join(map(str, allowed))}"
            )
    check_packings((Packing(bits=widths[0], groups=groups),), layers, target)
    return tuple(sorted(set(widths)))


def widths_front(points: Iterable[WidthPoint], by: str) -> tuple[WidthPoint, ...]:
    """Points that no other one beats in memory and in ``equal`` or ``right``, least memory first.

    Examples
    --------
    >>> points = [WidthPoint(bits=(b,), words=w, equal=e, right=None) for b, w, e in ((2, 5, 1), (3, 6, 1), (4, 7, 3))]
    >>> [point.bits for point in widths_front(points, "equal")]
    [(2,), (4,)]
    """
    best: list[WidthPoint] = []
    for point in sorted(points, key=lambda p: (p.words, -getattr(p, by), p.bits)):
        if not best or getattr(point, by) > getattr(best[-1], by):
            best.append(point)
    return tuple(best)


def search_widths(
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
) -> WidthSearch:
    """Narrow one layer after the other, of storage `widths` with at most so many `groups` of scales.

    `events` (recordings, steps, channels) bool are training recordings, `labels` (recordings,) the class of each, -1
    where it is not known, `lengths` (recordings,) the steps that count. Those that the compiler calibrates on choose
    the scales; `samples` of them at most, evenly spaced, are decided. `tell` is called with what is being done.

    DataError, OptionError or ModelError if the recordings or the widths cannot be used, or a layer has no usable scale
    at any width.
    """
    widths = check_widths(widths, groups, len(network.populations), target)
    tell("running the float model")
    calibration = calibrate(network, evenly_spaced(events))
    chosen = np.linspace(0, len(events) - 1, min(samples, len(events))).round().astype(np.int64)
    shown, known = events[chosen], labels[chosen]
    ends = None if lengths is None else lengths[chosen]
    figures = ("equal", "right") if np.all(known >= 0) else ("equal",)
    label = (network.readout.label[:, None] == np.arange(network.classes)).astype(np.int64)

    def decide(spikes: BoolArray) -> IntArray:
        return vote(cut(spikes, ends).sum(axis=1, dtype=np.int64) @ label)

    wanted = decide(run_float(network, shown).spikes[network.readout.population])
    tell("rounding each layer to each width")
    network = disconnect(network, never_fires(network))
    offers = _offers(network, target, widths, groups, calibration)

    def point(bits: Widths, integer: IntegerNetwork, words: int, cores: int | None = None) -> WidthPoint:
        decided = decide(run_integer(integer, shown).spikes[network.readout.population])
        equal, right = (int(np.count_nonzero(decided == aim)) for aim in (wanted, known))
        return WidthPoint(bits=bits, words=words, equal=equal, right=right if "right" in figures else None, cores=cores)

    tried: dict[Widths, WidthPoint] = {}

    def attempt(bits: Widths) -> WidthPoint:
        if bits not in tried:
            tell(f"trying combination {len(tried) + 1}")
            integer = assemble(network, [offers[post][width] for post, width in enumerate(bits)])
            weights = sum(p.bits * p.weight.count_nonzero() for p in integer.projections)
            tried[bits] = point(bits, integer, -(-int(weights) // target.limit("synapse.word_bits")))
        return tried[bits]

    for figure in figures:
        at = attempt(tuple(next(iter(offer)) for offer in offers))
        while narrower := [attempt(bits) for bits in _narrower(at.bits, offers)]:
            at = max(narrower, key=lambda p: (getattr(p, figure), -p.words))

    # the front is drawn anew with the figures of what was built, until all that is on it was built
    rates = calibration.rates
    current, built = dict(tried), dict[Widths, WidthPoint | None]()
    while best := {p.bits for figure in figures for p in widths_front(current.values(), figure)} - built.keys():
        tell(f"building the best of them: {len(built) + len(best)}")
        for bits in sorted(best):
            packings = [Packing(bits=width, groups=groups) for width in bits]
            integer, _ = choose_storage(network, target, packings=packings, calibration=calibration)
            size = _size(integer, target, rates)
            del current[bits]
            built[bits] = made = None if size is None else point(bits, integer, *size)
            if made is not None:
                current[bits] = replace(made, words=tried[bits].words)
    return WidthSearch(
        samples=len(chosen),
        float_right=int(np.count_nonzero(wanted == known)) if "right" in figures else None,
        points=tuple(tried.values()),
        built=tuple(made for _, made in sorted(built.items()) if made is not None),
    )


def _offers(network: Network, target: Target, widths: Widths, groups: int, calibration: Calibration) -> Offers:
    """Scales of every layer at every width; a width at which a layer has none is left out for that layer."""
    exponents = target.choices["synapse.exponent"]
    offers: Offers = []
    for post in range(len(network.populations)):
        offer: dict[int, Rounded] = {}
        faults: list[ModelError] = []
        for bits in reversed(widths):
            try:
                packing = Packing(bits=bits, groups=groups)
                offer[bits] = best_scale(layer_of(network, post, calibration), packing, exponents)
            except ModelError as error:
                faults.append(error)
        if not offer:
            raise faults[0]
        offers.append(offer)
    return offers


def _narrower(bits: Widths, offers: Offers) -> list[Widths]:
    """Combinations in which one layer has its next smaller width."""
    steps = []
    for post, width in enumerate(bits):
        smaller = [other for other in offers[post] if other < width]
        steps += [(*bits[:post], max(smaller), *bits[post + 1 :])] if smaller else []
    return steps


def _size(integer: IntegerNetwork, target: Target, rates: tuple[FloatArray, ...]) -> tuple[int, int] | None:
    """Words that a network needs and cores that it takes as the compiler lays it out; None if it does not fit."""
    held, kept = compact(integer, either(*removable(integer)))
    try:
        cores = partition(held, target, tuple(rate[ids] for rate, ids in zip(rates, kept, strict=True)))
    except CapacityError:
        return None
    needs = Needs(held, target)
    return sum(needs.uses(core)["core.synapse_words"] for core in cores), len(cores)
