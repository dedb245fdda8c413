"""Run many storages of one network at once: what two combinations share at the front is run once.

Each layer is rounded once for each width, at the few scales that :func:`quantize.shortlist` finds.
Nothing of the network is changed.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.interpret import BATCH, BoolArray, cut, integer_recurrence
from spikeloom.compiler.ir import INPUT, IntegerNetwork, IntegerPopulation, Network
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.options import Recipe
from spikeloom.compiler.targets.loihi1.storage.quantize import Candidate, assemble, shortlist
from spikeloom.compiler.targets.loihi1.storage.scales import Rounded

STACKED = 2048
"""Neurons that run together at most: the storages of a small layer are one wide layer on the same input."""

Widths = tuple[int, ...]
"""Storage width of each layer."""

Path = tuple[int, ...]
"""Which of its forms each layer takes."""

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offers:
    """Storages of each layer.

    Parameters
    ----------
    forms : list of list of Rounded
        Layer by layer: for each width a few scales, best first.
    places : list of dict of int to range
        Where the scales of a width are in the forms of its layer.
    """

    forms: list[list[Rounded]]
    places: list[dict[int, range]]

    def first(self, bits: Widths) -> Path:
        """Best storage of each layer by itself."""
        return tuple(places[width][0] for places, width in zip(self.places, bits, strict=True))

    def put_together(self, network: Network, path: Path) -> IntegerNetwork:
        """The integer network of these storages."""
        return assemble(network, [forms[form] for forms, form in zip(self.forms, path, strict=True)])


def offer_forms(network: Network, target: Target, widths: Widths, groups: int, calibration: Calibration) -> Offers:
    """Round every layer to every width; one at which a layer has no usable scale is left out for that layer."""
    exponents = target.choices["synapse.exponent"]
    jobs = list(itertools.product(range(len(network.populations)), widths))

    def offer(job: tuple[int, int]) -> list[Candidate] | ModelError:
        post, bits = job
        try:
            return shortlist(network, post, Recipe(bits=bits, groups=groups), exponents, calibration, None)
        except ModelError as error:
            return error

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        offered = dict(zip(jobs, pool.map(offer, jobs), strict=True))
    forms: list[list[Rounded]] = [[] for _ in network.populations]
    places: list[dict[int, range]] = [{} for _ in network.populations]
    for (post, bits), found in offered.items():
        if not isinstance(found, ModelError):
            places[post][bits] = range(len(forms[post]), len(forms[post]) + len(found))
            forms[post] += [candidate.layer for candidate in found]
    for (post, _), found in reversed(offered.items()):
        if isinstance(found, ModelError) and not forms[post]:
            raise found
    return Offers(forms=forms, places=places)


def votes(
    network: Network, offers: Offers, paths: Iterable[Path], events: BoolArray, lengths: IntArray | None = None
) -> dict[Path, IntArray]:
    """Spikes of the voting neurons of several integer networks, (samples, neurons) each.

    Depth first, and a few recordings at a time, so that the spikes of one branch are all that is kept.
    """
    ordered = sorted(paths)
    dense = [
        {form: _dense(offers.forms[post][form]) for form in {path[post] for path in ordered}}
        for post in range(len(offers.forms))
    ]

    def batch(part: slice) -> dict[Path, IntArray]:
        counts: dict[Path, IntArray] = {}
        ends = None if lengths is None else lengths[part]

        def descend(branch: list[Path], done: list[BoolArray]) -> None:
            post = len(done)
            if post == len(offers.forms):
                counts[branch[0]] = cut(done[network.readout.population], ends).sum(axis=1, dtype=np.int64)
                return
            below = {form: list(group) for form, group in itertools.groupby(branch, key=lambda path: path[post])}
            size, forms = network.populations[post].size, list(below)
            together = max(1, STACKED // size)
            for first in range(0, len(forms), together):
                stack = forms[first : first + together]
                layers = [offers.forms[post][form] for form in stack]
                spikes = _run_stack(layers, [dense[post][form] for form in stack], events[part], done)
                for k, form in enumerate(stack):
                    descend(below[form], [*done, spikes[:, :, k * size : (k + 1) * size]])

        descend(ordered, [])
        return counts

    parts = [slice(start, start + BATCH) for start in range(0, len(events), BATCH)]
    if not ordered:
        return {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(batch, parts))
    return {path: np.concatenate([counts[path] for counts in found]) for path in ordered}


def _dense(layer: Rounded) -> dict[int, npt.NDArray[np.float32]]:
    """Weights from each source, in weight units; exact in float32, since proven sums stay below 2**16."""
    found: dict[int, npt.NDArray[np.float32]] = {}
    for p in layer.projections:
        weight = p.effective().toarray().astype(np.float32)
        found[p.pre] = found[p.pre] + weight if p.pre in found else weight
    return found


def _run_stack(
    layers: list[Rounded], dense: list[dict[int, npt.NDArray[np.float32]]], events: BoolArray, done: list[BoolArray]
) -> BoolArray:
    """Spikes of several storages of one layer on the same input, side by side; (samples, steps, all neurons)."""
    sums = np.zeros((*events.shape[:2], sum(layer.population.size for layer in layers)), np.float32)
    for pre in dense[0]:
        source = events if pre == INPUT else done[pre]
        sums += source.astype(np.float32) @ np.concatenate([weights[pre] for weights in dense]).T
    population = layers[0].population

    def side_by_side(name: str) -> npt.NDArray[np.int64]:
        return np.concatenate([getattr(layer.population, name) for layer in layers])

    stacked = IntegerPopulation(
        name=population.name,
        beta=population.beta,
        theta=population.theta,
        alpha=population.alpha,
        scale=np.concatenate([layer.population.scale for layer in layers]),
        decay_u=population.decay_u,
        decay_v=population.decay_v,
        threshold=side_by_side("threshold"),
        bias_mantissa=side_by_side("bias_mantissa"),
        bias_exponent=side_by_side("bias_exponent"),
    )
    return integer_recurrence(stacked, sums)[0]


def settle(
    network: Network, offers: Offers, combinations: Iterable[Widths], calibration: Calibration
) -> dict[Widths, Path]:
    """Pick one scale per layer, in order, as :mod:`storage.quantize` does; all combinations at once."""
    chosen = {bits: offers.first(bits) for bits in combinations}
    for post, places in enumerate(offers.places):
        trials = {bits: _variants(path, post, places[bits[post]]) for bits, path in chosen.items()}
        chosen |= _nearest(network, offers, trials, calibration)
    return chosen


def usual(network: Network, offers: Offers, calibration: Calibration) -> list[dict[int, int]]:
    """Which form each layer and width takes as a rule: the one that is settled on beside other layers at full width."""
    widest = offers.first(tuple(max(places) for places in offers.places))
    trials = {
        (post, bits): _variants(widest, post, forms)
        for post, places in enumerate(offers.places)
        for bits, forms in places.items()
    }
    nearest = _nearest(network, offers, trials, calibration)
    return [{bits: nearest[post, bits][post] for bits in places} for post, places in enumerate(offers.places)]


def _variants(path: Path, post: int, forms: Iterable[int]) -> list[Path]:
    return [(*path[:post], form, *path[post + 1 :]) for form in forms]


def _nearest(
    network: Network, offers: Offers, trials: dict[Key, list[Path]], calibration: Calibration
) -> dict[Key, Path]:
    """Of several networks, the first whose class counts move least from float64 on the calibration recordings."""
    wanted = calibration.spikes[network.readout.population].sum(axis=1, dtype=np.int64)
    paths = {path for options in trials.values() if len(options) > 1 for path in options}
    counts = votes(network, offers, paths, calibration.events)
    moved = {path: int(np.abs(spikes - wanted).sum()) for path, spikes in counts.items()}
    return {key: min(options, key=lambda path: moved.get(path, 0)) for key, options in trials.items()}
