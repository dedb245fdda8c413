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

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX, decay_registers, reach, step_units
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.ir import Form, IntegerNetwork, Network, Population, row_parts
from spikeloom.compiler.passes.calibrate import MANY, Calibration, fewer
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.options import Packing, check_packings
from spikeloom.compiler.targets.loihi1.storage.compensate import compensated
from spikeloom.compiler.targets.loihi1.storage.scales import (
    FloatLayer,
    Rounded,
    candidate,
    flips,
    grouped,
    layer_of,
    rounded,
)
from spikeloom.compiler.targets.loihi1.storage.weight_storage import current_load

CLIPPING = tuple(2 ** (k / 4) for k in range(21))
"""Factors by which a scale may exceed the one that just holds the largest weight; larger weights are clipped."""

SHORTLIST, SHORTLIST_RATIO = 3, 1.25
"""Scales of a layer that are compared within the whole network, and by how much they may exceed the fewest flips."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The storage that was chosen for one population, and why."""

    layer: str  # Population
    bits: int  # Width of a mantissa
    planes: int  # Times that a synapse is stored at most
    groups: int  # Different scales
    exponent: int  # Exponent of the finest plane
    scale: float  # Weight units (mantissa times 2**exponent) per membrane unit of the model, of the coarsest group
    finest_scale: float  # The same of the finest group
    clipped: int  # Weights that the range cuts off
    zeroed: int  # Weights that round to zero
    weights: int  # All that are not zero
    compensated: bool  # Whether weights were rounded so that their errors cancel, rather than each to the nearest
    candidates: int  # Scales that were compared
    flips: int | None  # Calibration spikes that differ from float64; None without calibration
    spikes: int | None  # Calibration spikes of the float64 model
    # Share of the accumulator that the worst case leaves free; of the current's register where a current that outlasts
    # its step fills that sooner
    headroom: float


def _register(population: Population) -> str:
    """Register that the sums of a population fill first."""
    return "current" if current_load(decay_registers(population.beta, population.alpha)[0]) > 1 else "accumulator"


def _counted(stored: Rounded, layer: FloatLayer, *, tried: int) -> Rounded:
    """The same with the calibration spikes that differ from float64, where there is a calibration."""
    moved = None if layer.calibration is None else int(flips(stored, layer.post, layer.calibration).sum())
    return replace(stored, flips=moved, tried=tried)


def shortlist(layer: FloatLayer, packing: Packing, exponents: tuple[int, ...], *, clip: bool = True) -> list[Rounded]:
    """Scales of one population worth a closer look, best first; a single one without calibration, else ModelError.

    Without `clip` every weight must fit its planes.
    """
    population = layer.population
    factors = CLIPPING if clip and layer.calibration is not None and packing.planes == 1 else (1.0,)
    fitted = [candidate(layer, packing, factor, exponents) for factor in factors]
    # one scale at two exponents is two candidates: mantissas and clipping differ
    found = list({(c.form.exponents, int(c.form.threshold[0])): c for c in fitted if c is not None}.values())
    if not found:
        register = _register(population)
        lasting = f" and its current, of which a step keeps {population.alpha:g}, within its register"
        raise ModelError(
            f"{population.name}: no scale at {packing.bits} bits keeps its threshold of at least one unit within the "
            f"accumulator ({ONE_STEP_SUM_MAX} units a step){lasting if register == 'current' else ''}; use more bits "
            "or smaller weights"
        )
    tried = len(found)
    counted = sorted((_counted(stored, layer, tried=tried) for stored in found), key=lambda c: c.fewest)
    if packing.groups > 1:
        several = grouped(layer, counted[0], packing.groups, factors[-1])
        if several is not None:
            counted = [min(_counted(several, layer, tried=tried), counted[0], key=lambda c: c.fewest)]
    if layer.calibration is not None:
        other = compensated(layer, counted[0].form, layer.calibration)
        if other is not None and (other := _counted(other, layer, tried=tried)).fewest < counted[0].fewest:
            counted.insert(0, other)
    return [c for c in counted[:SHORTLIST] if c.fewest <= SHORTLIST_RATIO * counted[0].fewest]


def round_with_more(layer: FloatLayer, candidate: Rounded, calibration: Calibration) -> Rounded:
    """Let the errors of a layer cancel on ``MANY`` recordings at the storage that was chosen on ``FEW``.

    What keeps fewer spikes there is dropped.
    """
    many = fewer(calibration, MANY)
    stored = compensated(layer, candidate.form, many)
    if stored is None or flips(stored, layer.post, many).sum() > flips(candidate, layer.post, many).sum():
        return candidate
    return replace(stored, flips=int(flips(stored, layer.post, fewer(many)).sum()), tried=candidate.tried)


def settle(network: Network, shortlists: list[list[Rounded]], calibration: Calibration) -> list[Rounded]:
    """Pick one scale per population, in order, by how far the whole network's class counts move from float64."""
    wanted = calibration.spikes[network.readout.population].sum(axis=1, dtype=np.int64)
    chosen = [candidates[0] for candidates in shortlists]
    for post, candidates in enumerate(shortlists):
        if len(candidates) > 1:
            distances = []
            for trial in candidates:
                layers = [trial if i == post else kept for i, kept in enumerate(chosen)]
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


def explain_choice(layer: FloatLayer, chosen: Rounded) -> Choice:
    """Say what was chosen for a population."""
    form, scale = chosen.form, chosen.population.scale
    held = reach(form.bits, form.exponents) * step_units(form.bits, form.exponents)
    clipped = zeroed = weights = 0
    for p in layer.projections:
        planes = [plane for plane in chosen.projections if plane.pre == p.pre]
        for rows in row_parts(p.weight):
            weight = p.weight[rows]
            stored = (abs(replace(plane, weight=plane.weight[rows]).effective()) for plane in planes)
            kept = sum(stored, start=0 * weight)
            weights += int(weight.count_nonzero())
            zeroed += int(weight.count_nonzero() - kept.multiply(weight != 0).count_nonzero())
            units = np.abs(weight.data) * np.repeat(scale[rows], np.diff(weight.indptr))
            clipped += int(np.count_nonzero(units > held * (1 + 1e-12)))
    return Choice(
        layer=layer.population.name,
        bits=form.bits,
        planes=len({p.exponent for p in chosen.projections}),
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
        spikes=None if layer.calibration is None else int(np.count_nonzero(layer.calibration.spikes[layer.post])),
        headroom=1 - chosen.reached / ONE_STEP_SUM_MAX,
    )


def choose_storage(
    network: Network,
    target: Target,
    *,
    packings: Sequence[Packing] = (Packing(),),
    calibration: Calibration | None = None,
) -> tuple[IntegerNetwork, tuple[Choice, ...]]:
    """Choose the scales of each population and round weights, thresholds, biases and decays.

    ``calibrate.FEW`` recordings of the calibration choose, several planes use ``MANY``; without it scales come from the
    weights and the proven bounds alone. OptionError if there are no such packings; ModelError, with a line for each, if
    populations have no usable scale.
    """
    packings = check_packings(packings, len(network.populations), target)
    exponents = target.choices["synapse.exponent"]
    few = None if calibration is None else fewer(calibration)
    layers = [layer_of(network, post, few) for post in range(len(packings))]
    shortlists, faults = [], []
    for layer, packing in zip(layers, packings, strict=True):
        try:
            shortlists.append(shortlist(layer, packing, exponents))
        except ModelError as error:
            faults.append(str(error))
    if faults:
        raise ModelError("\n".join(faults))
    if calibration is None or few is None:
        chosen = [candidates[0] for candidates in shortlists]
    else:
        settled = zip(layers, settle(network, shortlists, few), packings, strict=True)
        chosen = [c if packing.planes == 1 else round_with_more(layer, c, calibration) for layer, c, packing in settled]
    choices = tuple(map(explain_choice, layers, chosen))
    return assemble(network, chosen), choices


def round_to_forms(
    network: Network, forms: Sequence[Form], calibration: Calibration | None = None
) -> tuple[IntegerNetwork, tuple[Choice, ...]]:
    """Round a network to storage that is already decided, as a quantisation-aware training left it.

    ModelError if a bias has no register value, or the accumulator may overflow.
    """
    layers = [layer_of(network, post, calibration) for post in range(len(network.populations))]
    chosen = []
    for layer, form in zip(layers, forms, strict=True):
        stored, name = rounded(layer, form), layer.population.name
        if stored is None or stored.reached > ONE_STEP_SUM_MAX:
            overflow = f"the {_register(layer.population)} may overflow"
            what = "a bias has no register value" if stored is None else overflow
            raise ModelError(f"{name}: at the scale that it was fine-tuned for, {what}; fine-tune it again")
        chosen.append(_counted(stored, layer, tried=1))
    return assemble(network, chosen), tuple(map(explain_choice, layers, chosen))
