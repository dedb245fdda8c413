"""Round a network to chip integers: choose width, planes and scales of every population.

Spikes change. Which scale is best is decided on the calibration recordings: first by the spikes of a layer that differ
from the float64 model's when it gets the float model's own input; among the few best by how far the class counts of
the whole integer network move. Weights are then rounded so that their errors cancel, where that keeps more spikes.
Without calibration the weights alone decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX, FloatArray, decay_registers, reach, step_units
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.ir import Form, IntegerNetwork, Network, Population, Projection, row_parts
from spikeloom.compiler.passes.calibrate import MANY, Calibration, fewer
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.options import MARGIN, RANGES, Recipe, check_recipes
from spikeloom.compiler.targets.loihi1.storage.compensate import compensated
from spikeloom.compiler.targets.loihi1.storage.scales import Rounded, candidate, flips, grouped, observed_sums, rounded
from spikeloom.compiler.targets.loihi1.storage.weight_storage import current_load

CLIPPING = tuple(2 ** (k / 4) for k in range(21))
"""Factors by which a scale may exceed the one that just holds the largest weight; larger weights are clipped."""

SHORTLIST, SHORTLIST_RATIO = 3, 1.25
"""Scales of a layer that are compared within the whole network, and by how much they may exceed the fewest flips."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The storage that was chosen for one population, and why.

    Parameters
    ----------
    layer : str
        Population.
    bits, planes, groups : int
        Width of a mantissa, times that a synapse is stored at most, different scales.
    exponent : int
        Exponent of the finest plane.
    scale, finest_scale : float
        Weight units (mantissa times 2**exponent) per membrane unit of the model, of the coarsest and of the finest
        group.
    clipped, zeroed, weights : int
        Weights that the range cuts off, those that round to zero, and all that are not zero.
    compensated : bool
        Whether weights were rounded so that their errors cancel, rather than each to the nearest.
    candidates : int
        Scales that were compared.
    flips, spikes : int or None
        Calibration spikes that differ from float64, and how many the float64 model has; None without calibration.
    headroom : float
        Share of the accumulator that the worst case (proven) or the largest observed step leaves free; of the
        current's register where a current that outlasts its step fills that sooner.
    """

    layer: str
    bits: int
    planes: int
    groups: int
    exponent: int
    scale: float
    finest_scale: float
    clipped: int
    zeroed: int
    weights: int
    compensated: bool
    candidates: int
    flips: int | None
    spikes: int | None
    headroom: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A layer at one scale, its calibration flips, how many scales were compared, and how it was rounded."""

    layer: Rounded
    flips: int | None
    tried: int
    compensated: bool = False


def incoming(network: Network, post: int) -> tuple[Projection, ...]:
    """Projections into a population."""
    return tuple(p for p in network.projections if p.post == post)


def _register(population: Population) -> str:
    """Register that the sums of a population fill first."""
    full = current_load(decay_registers(population.beta, population.alpha)[0]) > 1
    return "current" if full else "accumulator"


def _current_words(population: Population) -> str:
    if _register(population) == "accumulator":
        return ""
    return f" and its current, of which a step keeps {population.alpha:g}, within its register"


def shortlist(
    network: Network,
    post: int,
    recipe: Recipe,
    exponents: tuple[int, ...],
    calibration: Calibration | None,
    observed: FloatArray | None,
    *,
    clip: bool = True,
) -> list[Candidate]:
    """Scales of one population worth a closer look, best first; a single one without calibration.

    Without `clip` every weight must fit its planes.

    Raises
    ------
    ModelError
        If there is none.
    """
    population, projections = network.populations[post], incoming(network, post)
    factors = CLIPPING if clip and calibration is not None and recipe.planes == 1 else (1.0,)
    fitted = [candidate(population, projections, recipe.bits, recipe.planes, f, exponents, observed) for f in factors]
    # one scale at two exponents is two candidates: mantissas and clipping differ
    found = list({(c.form.exponents, int(c.form.threshold[0])): c for c in fitted if c is not None}.values())
    if not found:
        raise ModelError(
            f"{population.name}: no scale at {recipe.bits} bits keeps its threshold of at least one unit within the "
            f"accumulator ({ONE_STEP_SUM_MAX} units a step){_current_words(population)}; use more bits or smaller "
            "weights"
        )
    if calibration is None:
        counted = [Candidate(layer=found[0], flips=None, tried=1)]
    else:
        counted = [Candidate(layer=c, flips=int(flips(c, post, calibration).sum()), tried=len(found)) for c in found]
        counted.sort(key=lambda c: c.flips or 0)
    if recipe.groups > 1:
        best = grouped(population, projections, post, counted[0].layer, recipe.groups, factors, calibration, observed)
        if best is not None:
            moved = None if calibration is None else int(flips(best, post, calibration).sum())
            counted.insert(0, Candidate(layer=best, flips=moved, tried=counted[0].tried))
            counted.sort(key=lambda c: c.flips or 0)
            counted = counted[:1]
    if calibration is not None:
        form, tried = counted[0].layer.form, counted[0].tried
        other = compensated(population, projections, form, post, calibration, observed)
        moved = None if other is None else int(flips(other, post, calibration).sum())
        if other is not None and moved is not None and moved < (counted[0].flips or 0):
            counted.insert(0, Candidate(layer=other, flips=moved, tried=tried, compensated=True))
    worst = SHORTLIST_RATIO * (counted[0].flips or 0)
    return [c for c in counted[:SHORTLIST] if (c.flips or 0) <= worst]


def round_with_more(
    network: Network, post: int, candidate: Candidate, calibration: Calibration, observed: FloatArray | None = None
) -> Candidate:
    """Let the errors of a layer cancel on ``MANY`` recordings at the storage that was chosen on ``FEW``.

    What keeps fewer spikes there is dropped.
    """
    many = fewer(calibration, MANY)
    layer = compensated(network.populations[post], incoming(network, post), candidate.layer.form, post, many, observed)
    if layer is None or flips(layer, post, many).sum() > flips(candidate.layer, post, many).sum():
        return candidate
    return replace(candidate, layer=layer, flips=int(flips(layer, post, fewer(many)).sum()), compensated=True)


def settle(network: Network, shortlists: list[list[Candidate]], calibration: Calibration) -> list[Candidate]:
    """Pick one scale per population, in order, by how far the whole network's class counts move from float64."""
    wanted = calibration.spikes[network.readout.population].sum(axis=1, dtype=np.int64)
    chosen = [candidates[0] for candidates in shortlists]
    for post, candidates in enumerate(shortlists):
        if len(candidates) > 1:
            distances = []
            for trial in candidates:
                layers = [trial.layer if i == post else kept.layer for i, kept in enumerate(chosen)]
                spikes = run_integer(assemble(network, layers), calibration.events).spikes[network.readout.population]
                distances.append(int(np.abs(spikes.sum(axis=1, dtype=np.int64) - wanted).sum()))
            chosen[post] = candidates[distances.index(min(distances))]
    return chosen


def assemble(network: Network, layers: Sequence[Rounded]) -> IntegerNetwork:
    """Put rounded populations together, one for each of the network."""
    return IntegerNetwork(
        input=network.input,
        populations=tuple(layer.population for layer in layers),
        projections=tuple(projection for layer in layers for projection in layer.projections),
        readout=network.readout,
        classes=network.classes,
    )


def explain_choice(network: Network, post: int, chosen: Candidate, calibration: Calibration | None) -> Choice:
    """Say what was chosen for a population."""
    form, scale = chosen.layer.form, chosen.layer.population.scale
    clipped = zeroed = weights = 0
    for p in incoming(network, post):
        held = reach(form.bits, form.exponents) * step_units(form.bits, form.exponents)
        planes = [plane for plane in chosen.layer.projections if plane.pre == p.pre]
        for rows in row_parts(p.weight):
            weight = p.weight[rows]
            stored = (abs(replace(plane, weight=plane.weight[rows]).effective()) for plane in planes)
            kept = sum(stored, start=0 * weight)
            weights += int(weight.count_nonzero())
            zeroed += int(weight.count_nonzero() - kept.multiply(weight != 0).count_nonzero())
            units = np.abs(weight.data) * np.repeat(scale[rows], np.diff(weight.indptr))
            clipped += int(np.count_nonzero(units > held * (1 + 1e-12)))
    return Choice(
        layer=network.populations[post].name,
        bits=form.bits,
        planes=len({p.exponent for p in chosen.layer.projections}),
        groups=len(np.unique(form.threshold)),
        exponent=form.exponents[0],
        scale=float(scale.min()),
        finest_scale=float(scale.max()),
        clipped=clipped,
        zeroed=zeroed,
        weights=weights,
        compensated=chosen.compensated,
        candidates=chosen.tried,
        flips=chosen.flips,
        spikes=None if calibration is None else int(np.count_nonzero(calibration.spikes[post])),
        headroom=1 - chosen.layer.reached / ONE_STEP_SUM_MAX,
    )


def quantize(
    network: Network,
    target: Target,
    *,
    recipes: Sequence[Recipe] = (Recipe(),),
    calibration: Calibration | None = None,
    ranges: str = "proven",
    margin: float = MARGIN,
) -> tuple[IntegerNetwork, tuple[Choice, ...]]:
    """Choose the scales of each population and round weights, thresholds, biases and decays.

    Parameters
    ----------
    network : Network
        Float stage.
    target : Target
        Permitted widths and exponents.
    recipes : sequence of Recipe
        Storage of each population, or one for all.
    calibration : Calibration, optional
        Float spikes on training recordings: ``calibrate.FEW`` of them choose, several planes use ``MANY``. Without it
        scales come from the weights and the proven bounds alone.
    ranges : {"proven", "observed"}
        ``proven`` keeps the accumulator in range for any input; ``observed`` only for what the calibration
        recordings bring, plus `margin`, and leaves the check to the simulator.
    margin : float
        Share added to an observed range.

    Returns
    -------
    IntegerNetwork
        Integer stage.
    tuple of Choice
        One per population.

    Raises
    ------
    OptionError
        If the recipes or `ranges` do not exist, or ``observed`` lacks a calibration.
    ModelError
        If a population has no usable scale.
    """
    recipes = check_recipes(recipes, len(network.populations), target)
    if ranges not in RANGES:
        raise OptionError(f"--ranges {ranges}: unknown; allowed: {', '.join(RANGES)}")
    if ranges == "observed" and calibration is None:
        raise OptionError("--ranges observed: nothing was observed; give --calibrate, or use --ranges proven")
    exponents = target.choices["synapse.exponent"]
    few = None if calibration is None else fewer(calibration)
    limits: list[FloatArray | None] = [None] * len(recipes)
    if ranges == "observed" and few is not None:
        limits = [
            observed_sums(population, incoming(network, post), post, few) * (1 + margin)
            for post, population in enumerate(network.populations)
        ]
    shortlists, faults = [], []
    for post, (recipe, observed) in enumerate(zip(recipes, limits, strict=True)):
        try:
            shortlists.append(shortlist(network, post, recipe, exponents, few, observed))
        except ModelError as error:
            faults.append(str(error))
    if faults:
        raise ModelError("\n".join(faults))
    if calibration is None or few is None:
        chosen = [candidates[0] for candidates in shortlists]
    else:
        chosen = settle(network, shortlists, few)
        chosen = [
            candidate if recipe.planes == 1 else round_with_more(network, post, candidate, calibration, observed)
            for post, (candidate, recipe, observed) in enumerate(zip(chosen, recipes, limits, strict=True))
        ]
    choices = tuple(explain_choice(network, post, c, few) for post, c in enumerate(chosen))
    return assemble(network, [c.layer for c in chosen]), choices


def round_to_forms(
    network: Network, forms: Sequence[Form], calibration: Calibration | None = None
) -> tuple[IntegerNetwork, tuple[Choice, ...]]:
    """Round a network to storage that is already decided, as a quantisation-aware training left it.

    Raises
    ------
    ModelError
        If a bias has no register value, or the accumulator may overflow.
    """
    chosen = []
    for post, (population, form) in enumerate(zip(network.populations, forms, strict=True)):
        layer = rounded(population, incoming(network, post), form)
        if layer is None or layer.reached > ONE_STEP_SUM_MAX:
            what = "a bias has no register value" if layer is None else f"the {_register(population)} may overflow"
            raise ModelError(f"{population.name}: at the scale that it was fine-tuned for, {what}; fine-tune it again")
        moved = None if calibration is None else int(flips(layer, post, calibration).sum())
        chosen.append(Candidate(layer=layer, flips=moved, tried=1))
    choices = tuple(explain_choice(network, post, c, calibration) for post, c in enumerate(chosen))
    return assemble(network, [c.layer for c in chosen]), choices
