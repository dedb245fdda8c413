"""Round a network to chip integers: choose width, planes and scales of every population.

Spikes change. Which scale is best is decided on the calibration recordings, by the spikes of a layer that
differ from the float64 model's, and by how many more or fewer there are, when it receives what the rounded
layers before it send. Weights are then rounded so that their errors cancel, where that keeps more spikes,
and biases, which are 64 times finer, take up what is left. Without calibration the weights alone decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import Form, Network, Population, row_parts
from spikeloom.compiler.passes.calibrate import MANY, NUDGES, Calibration, fewer
from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.bounds import one_sided
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerPopulation, integer_layer
from spikeloom.compiler.targets.loihi1.legalize import stored_once
from spikeloom.compiler.targets.loihi1.options import check_packings
from spikeloom.compiler.targets.loihi1.registers import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    MEMBRANE_SHIFT,
    ONE_STEP_SUM_MAX,
    decay_registers,
    encode_bias,
    reach,
    step_units,
)
from spikeloom.compiler.targets.loihi1.storage.compensate import compensated
from spikeloom.compiler.targets.loihi1.storage.scales import (
    FloatLayer,
    Rounded,
    candidate,
    grouped,
    layer_of,
    rounded,
    spike_cost,
    with_spike_errors,
)
from spikeloom.compiler.targets.loihi1.storage.ties import ties_moved, without_memory
from spikeloom.compiler.targets.loihi1.storage.weight_storage import current_load, fullest
from spikeloom.compiler.types import FloatArray

CLIPPING = tuple(2 ** (k / 4) for k in range(21))
"""Factors by which a scale may exceed the one that just holds the largest weight; larger weights are clipped."""

FINALISTS = 4
"""Scales of a layer that are compared on all recordings, after all were on the first part of them."""


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
    compensated: (
        bool  # Whether weights were rounded so that their errors cancel, rather than each to the nearest
    )
    candidates: int  # Scales that were compared
    flips: int | None  # Calibration spikes that differ from float64; None without calibration
    spikes: int | None  # Calibration spikes of the float64 model
    ties: int  # Neurons whose sums can be exactly their threshold, and that decide this otherwise, see :mod:`ties`
    headroom: (
        float  # Share that the worst case leaves free of the register that it fills first, see ``Rounded``
    )


def _register(population: Population) -> str:
    """Register that the sums of a population fill first."""
    return (
        "current"
        if current_load(decay_registers(population.beta, population.alpha)[0]) > 1
        else "accumulator"
    )


def _repeats(stored: Rounded, target: Target) -> bool:
    """Whether a core that held a whole population would store half of its synapse lists at most."""
    stored_lists = 0
    lists = 0
    for projection in stored.projections:
        weight = projection.weight.tocsc()
        weight.eliminate_zeros()
        lengths = np.diff(weight.indptr)
        stored_lists += len(stored_once(0 * lengths, lengths, weight.indices, weight.data, target))
        lists += len(lengths)
    return 2 * stored_lists <= lists


def best_scale(
    layer: FloatLayer,
    packing: Packing,
    exponents: tuple[int, ...],
    *,
    clip: bool = True,
    shared: Target | None = None,
) -> Rounded:
    """Scale of one population that keeps most calibration spikes; ModelError if there is none.

    Without `clip` every weight must fit its planes. Lists that a core of `shared` stores once stay alike.
    """
    population = layer.population
    calibration = layer.calibration
    post = layer.post
    factors = CLIPPING if clip and calibration is not None and packing.planes == 1 else (1.0,)
    # one scale at two exponents is two candidates: mantissas and clipping differ
    scales = dict[tuple[tuple[int, ...], int], Rounded]()
    for factor in factors:
        stored, limited = candidate(layer, packing, factor, exponents)
        if stored is not None:
            scales[stored.form.exponents, int(stored.form.threshold[0])] = without_memory(layer, stored)
        if limited:
            break
    candidates = list(scales.values())
    if not candidates:
        register = _register(population)
        lasting = f" and its current, of which a step keeps {population.alpha:g}, within its register"
        raise ModelError(
            f"{population.name}: no scale at {packing.bits} bits keeps its threshold of at least one unit within the "
            f"accumulator ({ONE_STEP_SUM_MAX} units a step){lasting if register == 'current' else ''}; use more bits "
            "or smaller weights"
        )
    tried = len(candidates)
    if calibration is not None and tried > FINALISTS:
        candidates = sorted(candidates, key=lambda c: with_spike_errors(c, post, calibration, 1).cost)[
            :FINALISTS
        ]
    best = min(
        (with_spike_errors(stored, post, calibration) for stored in candidates), key=attrgetter("cost")
    )
    if packing.groups > 1:
        several = grouped(layer, best, packing.groups)
        if several is not None:
            best = min(with_spike_errors(several, post, calibration), best, key=attrgetter("cost"))
    if calibration is not None and not (shared and _repeats(best, shared)):
        best = compensated(layer, best, calibration) or best
    return replace(best, tried=tried)


def round_with_more(layer: FloatLayer, chosen: Rounded, calibration: Calibration) -> Rounded:
    """Let the errors of a layer cancel on ``MANY`` recordings at the storage that was chosen on ``FEW``.

    What keeps fewer spikes there is dropped.
    """
    many = fewer(calibration, MANY)
    plain = rounded(layer, chosen.form)
    stored = plain and compensated(layer, with_spike_errors(plain, layer.post, many), many)
    return min(with_spike_errors(chosen, layer.post, many), stored or chosen, key=attrgetter("cost"))


def adjust_biases(layer: FloatLayer, stored: Rounded, calibration: Calibration) -> Rounded:
    """Move the bias of each neuron by what keeps most of its calibration spikes, and their number."""
    before = stored.population
    relays = layer.population.relays
    unit = (before.threshold << MEMBRANE_SHIFT).astype(np.float64)
    most = BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX
    unit[before.size - relays :] = 0  # a relay has no bias

    def at(bias: FloatArray) -> IntegerPopulation:
        mantissa, exponent = encode_bias(np.clip(bias, -most, most))
        return replace(before, bias_mantissa=mantissa, bias_exponent=exponent)

    sums = one_sided(stored.projections, before.size)
    ready = integer_layer(before, stored.projections, loops=False)
    bias = before.bias.astype(np.float64)
    fewest = calibration.moved(ready, layer.post)
    for share in (sign * nudge for nudge in NUDGES for sign in (1, -1)):
        trial = at(bias + share * unit)
        moved = calibration.moved(ready.with_bias(trial.bias), layer.post)
        better = spike_cost(moved) < spike_cost(fewest)
        better &= fullest(trial, *sums) <= ONE_STEP_SUM_MAX
        bias = np.where(better, bias + share * unit, bias)
        fewest = np.where(better, moved, fewest)
    after = at(bias)
    shifted = bool(np.any(after.bias != before.bias))
    return replace(stored, population=after, moved=fewest, compensated=stored.compensated or shifted)


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
    form = chosen.form
    scale = chosen.population.scale
    limit = reach(form.bits, form.exponents) * step_units(form.bits, form.exponents)
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
            clipped += int(np.count_nonzero(units > limit * (1 + 1e-12)))
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
        flips=None if layer.calibration is None else chosen.flips,
        spikes=None if layer.calibration is None else layer.calibration.spikes[layer.post].total,
        ties=ties_moved(layer, chosen),
        headroom=1 - chosen.reached / ONE_STEP_SUM_MAX,
    )


def choose_storage(
    network: Network,
    target: Target,
    *,
    packings: Sequence[Packing] = (Packing(),),
    calibration: Calibration | None = None,
    share_lists: bool = False,
) -> tuple[IntegerNetwork, tuple[Choice, ...]]:
    """Choose the scales of each population and round weights, thresholds, biases and decays.

    To `share_lists`, errors cancel only in layers whose weights do not repeat, see
    :func:`legalize.stored_once`. ``calibrate.FEW`` recordings of the calibration choose, several planes use
    ``MANY``; without it scales come from the weights and the proven bounds alone. OptionError if there are
    no such packings; ModelError if populations have no usable scale.
    """
    packings = check_packings(packings, len(network.populations), target)
    layers = []
    chosen = []
    faults = []
    known = None if calibration is None else fewer(calibration)
    for post, packing in enumerate(packings):
        layer = layer_of(network, post, known)
        try:
            shared = target if share_lists else None
            best = best_scale(layer, packing, target.choices["synapse.exponent"], shared=shared)
        except ModelError as error:
            faults.append(str(error))
            calibration = known = None  # later layers can only be found faulty, too
            continue
        if calibration is not None and known is not None:
            if packing.planes > 1 and (best.compensated or not share_lists):
                best = round_with_more(layer, best, calibration)
            best = with_spike_errors(
                without_memory(layer, adjust_biases(layer, best, known)), layer.post, known
            )
            known = known.after(integer_layer(best.population, best.projections))
        else:
            best = without_memory(layer, best)
        layers.append(layer)
        chosen.append(best)
    if faults:
        raise ModelError("; ".join(faults))
    return assemble(network, chosen), tuple(map(explain_choice, layers, chosen))


def round_to_forms(
    network: Network, forms: Sequence[Form], calibration: Calibration | None = None
) -> tuple[IntegerNetwork, tuple[Choice, ...]]:
    """Round a network to storage that is already decided, as a quantisation-aware training left it.

    ModelError if a bias has no register value, or the accumulator may overflow.
    """
    layers = [layer_of(network, post, calibration) for post in range(len(network.populations))]
    chosen = []
    for layer, form in zip(layers, forms, strict=True):
        stored = rounded(layer, form)
        name = layer.population.name
        if stored is None or stored.reached > ONE_STEP_SUM_MAX:
            overflow = f"the {_register(layer.population)} may overflow"
            what = "a bias has no register value" if stored is None else overflow
            raise ModelError(f"{name}: at the scale that it was fine-tuned for, {what}; fine-tune it again")
        chosen.append(with_spike_errors(stored, layer.post, calibration))
    return assemble(network, chosen), tuple(map(explain_choice, layers, chosen))
