"""Add planes and scales, layer by layer, until every calibration spike is the float64 model's.

Each layer is judged on the float64 model's own input, so that one layer's errors do not hide another's: if
no layer moves a spike, the whole network does not. Where spikes still move, it is said which limit of the
chip is in the way.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.interpret import float_layer
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.calibrate import Calibration, fewer
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.registers import (
    THRESHOLD_MANTISSA_MAX,
    decay_registers,
    kept_shares,
    reach,
    step_units,
)
from spikeloom.compiler.targets.loihi1.storage.choose_storage import (
    Choice,
    assemble,
    best_scale,
    explain_choice,
    round_with_more,
)
from spikeloom.compiler.targets.loihi1.storage.ladder import coarsest_first
from spikeloom.compiler.targets.loihi1.storage.scales import (
    FloatLayer,
    Rounded,
    finest_thresholds,
    layer_of,
    with_spike_errors,
)
from spikeloom.compiler.targets.loihi1.storage.ties import without_memory
from spikeloom.compiler.targets.loihi1.storage.weight_storage import current_load
from spikeloom.compiler.types import BoolArray

SHARED = 0.8
"""A neuron whose threshold is below this share of its own finest is held back by those it shares the threshold with."""

AT_LIMIT = 0.99
"""A register counts as full from this share on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exactness:
    """What was tried for one population, and what is in the way of exactness."""

    layer: str  # Population
    # In order, on ``calibrate.FEW`` recordings; the best was taken, and rounded anew on ``calibrate.MANY``
    tried: tuple[tuple[int, int, int], ...]
    flips: int  # Spikes that move in what was taken, on all calibration recordings
    spikes: int  # All spikes of the float64 model
    limits: tuple[
        tuple[str, int], ...
    ]  # Spikes that still move, by what keeps their neuron's scale from being finer
    decay: int  # Spikes that move if nothing but the 12-bit decay deviates


def make_exact(
    network: Network, target: Target, calibration: Calibration, *, bits: int = 8
) -> tuple[IntegerNetwork, tuple[Choice, ...], tuple[Exactness, ...]]:
    """Choose planes and scales of every population by float64 spikes on all training recordings.

    ModelError if a population has no usable scale at so many `bits` of a mantissa.
    """
    slots = target.limit("core.threshold_slots")
    exponents = target.choices["synapse.exponent"]
    few = fewer(calibration)
    layers = []
    chosen = []
    reports = []
    for post in range(len(network.populations)):
        layer = layer_of(network, post, few)
        best = None
        tried: list[tuple[int, int, int]] = []
        for packing in coarsest_first(target, bits):
            if packing.planes > 2 and best is not None and not _full_range(layer, best).any():
                break  # the planes hold every weight already
            candidate = best_scale(layer, packing, exponents, clip=False)
            tried.append((packing.planes, packing.groups, candidate.flips))
            if best is None or candidate.flips <= best.flips:
                best = candidate
            if not candidate.flips and not with_spike_errors(candidate, post, calibration).flips:
                break
        assert best is not None, "the ladder has steps"
        if best.flips:
            best = round_with_more(layer, best, calibration)
        best = with_spike_errors(without_memory(layer, best), post, calibration)
        layer = replace(layer, calibration=calibration)
        layers.append(layer)
        chosen.append(best)
        reports.append(
            Exactness(
                layer=layer.population.name,
                tried=tuple(tried),
                spikes=calibration.spikes[post].total,
                flips=best.flips,
                limits=_limits(layer, best, slots) if best.flips else (),
                decay=_decay_flips(layer, calibration) if best.flips else 0,
            )
        )
    return assemble(network, chosen), tuple(map(explain_choice, layers, chosen)), tuple(reports)


def _full_range(layer: FloatLayer, candidate: Rounded) -> BoolArray:
    """Whether the largest weight of each neuron fills the planes; shape (neurons,)."""
    form = candidate.form
    scale = candidate.population.scale
    steps = layer.peaks * scale / step_units(form.bits, form.exponents)
    return steps >= AT_LIMIT * reach(form.bits, form.exponents)


def _limits(layer: FloatLayer, stored: Rounded, slots: int) -> tuple[tuple[str, int], ...]:
    """Spikes that still move, by what keeps their neuron's scale from being finer, most first."""
    form = stored.form
    finest = finest_thresholds(layer, form.bits, form.exponents)
    fullest = "24-bit current" if current_load(stored.population.decay_u) > 1 else "21-bit accumulator"
    cause = np.full(layer.population.size, fullest, dtype=object)
    cause[_full_range(layer, stored)] = "range of the planes"
    cause[form.threshold >= AT_LIMIT * THRESHOLD_MANTISSA_MAX] = "17-bit threshold"
    cause[form.threshold < SHARED * finest] = f"{slots} thresholds a core"
    counted = Counter[str]()
    for name, count in zip(cause, stored.moved[0].tolist(), strict=True):
        counted[name] += count
    return tuple((name, count) for name, count in counted.most_common() if count)


def _decay_flips(layer: FloatLayer, calibration: Calibration) -> int:
    """Spikes that move if nothing but the decays is rounded."""
    alpha, beta = kept_shares(*decay_registers(layer.population.beta, layer.population.alpha))
    realised = replace(layer.population, alpha=alpha, beta=beta)
    return int(calibration.moved(float_layer(realised, layer.projections, loops=False), layer.post)[0].sum())
