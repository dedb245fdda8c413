"""Round the weights of a layer so that the errors of its synapses cancel on what the layer usually gets.

Nearest rounding treats synapses one by one. Here they are rounded one after the other, see
:mod:`passes.rounding`; the bias takes up the mean that is left. No register, width or count changes.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.ir import Projection
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.passes.rounding import round_in_turn, shares
from spikeloom.compiler.targets.loihi1.registers import ONE_STEP_SUM_MAX, reach, step_units
from spikeloom.compiler.targets.loihi1.storage.scales import (
    FloatLayer,
    Rounded,
    rounded,
    spike_cost,
    with_spike_errors,
)
from spikeloom.compiler.targets.loihi1.storage.weight_storage import loads, nearest_steps, scales
from spikeloom.compiler.types import IntArray

AT_ONCE = 1 << 19
"""Weights that are rounded at a time; the last bits of their sums depend on it."""

INPUTS = 4096
"""The most active inputs of a neuron, whose errors cancel: no more fit a core. All others are rounded to nearest."""


def compensated(layer: FloatLayer, plain: Rounded, calibration: Calibration) -> Rounded | None:
    """Round one population as `plain`, which was judged, is stored; None where a bias has no register value.

    Weights that the range cuts off stay at its end: their errors are not passed on. The bias takes up what
    the mean sum is then off, also because layers before were rounded, but no more than the weights have
    lost. A neuron whose sums would leave the accumulator, or that keeps fewer of its spikes (one that fires
    from its bias alone, say), is rounded to nearest instead.
    """
    from spikeloom.compiler.layer_kernel import coincidences

    population = layer.population
    projections = layer.projections
    form = plain.form
    scale = scales(population, form)
    step = step_units(form.bits, form.exponents)
    limit = reach(form.bits, form.exponents)
    times = _spike_times(layer, calibration)
    rate, meant = (
        np.concatenate([source.rate(p.pre, layer.post) for p in projections])
        for source in (calibration, replace(calibration, sent=()))
    )
    nearest = [nearest_steps(population, p, form) for p in projections]
    steps = [each.copy() for each in nearest]
    errors = np.zeros(population.size)
    for neurons, inputs in _alike(layer):
        shown = np.argsort(-rate[inputs], kind="stable")[:INPUTS]
        shown = shown[rate[inputs[shown]] > 0]
        together = np.empty((len(shown), len(shown)))
        coincidences(times[inputs[shown]], together)
        share = shares(together)
        for rows in np.array_split(neurons, -(-len(neurons) * len(inputs) // AT_ONCE) or 1):
            places = [_places(p, rows) for p in projections]
            weight = np.concatenate(
                [p.weight.data[at] for p, at in zip(projections, places, strict=True)], axis=1
            )
            exact = np.clip(weight * (scale[rows] / step)[:, None], -limit, limit)
            whole = np.rint(exact)
            whole[:, shown] = np.clip(round_in_turn(exact[:, shown], share), -limit, limit)
            less = (exact - whole)[:, shown]
            wanted = exact @ meant[inputs] - whole @ rate[inputs]
            most = (np.sum(sign * np.maximum(sign * less, 0), axis=1) for sign in (-1, 1))
            errors[rows] = np.clip(wanted, *most) * step / scale[rows]
            ends = np.cumsum([at.shape[1] for at in places])[:-1]
            for each, at, part in zip(steps, places, np.split(whole, ends, axis=1), strict=True):
                each[at] = part
    errors[population.size - population.relays :] = 0  # a relay has no bias
    stored = rounded(layer, form, steps, population.bias + errors)
    if stored is None:
        return None
    before = plain.moved
    after = with_spike_errors(stored, layer.post, calibration).moved
    back = (spike_cost(after) > spike_cost(before)) | (
        loads(stored.population, stored.projections) > ONE_STEP_SUM_MAX
    )
    for p, each, instead in zip(projections, steps, nearest, strict=True):
        np.copyto(each, instead, where=np.repeat(back, np.diff(p.weight.indptr)))
    stored = rounded(layer, form, steps, population.bias + np.where(back, 0, errors))
    # judged without its loops, no neuron of a layer depends on another
    return stored and replace(stored, compensated=True, moved=np.where(back, before, after))


def _alike(layer: FloatLayer) -> Iterator[tuple[IntArray, IntArray]]:
    """Neurons with synapses from the same inputs, and these, numbered one projection after another."""
    weights = [p.weight for p in layer.projections]
    firsts = np.cumsum([0, *(weight.shape[1] for weight in weights)])
    kinds = defaultdict(list)
    for neuron in range(layer.population.size):
        inputs = [w.indices[w.indptr[neuron] : w.indptr[neuron + 1]] for w in weights]
        kinds[tuple(each.tobytes() for each in inputs)].append(neuron)
    for neurons in kinds.values():
        ends = [w.indptr[neurons[0] : neurons[0] + 2] for w in weights]
        inputs = [
            first + w.indices[slice(*end)] for w, first, end in zip(weights, firsts, ends, strict=False)
        ]
        yield np.array(neurons), np.concatenate(inputs)


def _places(projection: Projection, rows: IntArray) -> IntArray:
    """Where a projection holds the weights of equally many synapses of each row; (rows, synapses)."""
    begins = projection.weight.indptr[rows]
    return np.asarray(begins[:, None] + np.arange(projection.weight.indptr[rows[0] + 1] - begins[0]))


def _spike_times(layer: FloatLayer, calibration: Calibration) -> npt.NDArray[np.uint64]:
    """Steps in which each input of a layer spikes, a bit each; (inputs, words)."""
    times = []
    for rows in calibration.parts():
        sources = [calibration.source(p.pre, layer.post, rows) for p in layer.projections]
        spikes = np.concatenate(sources, axis=2)
        bits = np.packbits(spikes.reshape(-1, spikes.shape[2]), axis=0)
        times.append(np.pad(bits, ((0, -len(bits) % 8), (0, 0))).T)
    return np.ascontiguousarray(np.concatenate(times, axis=1)).view(np.uint64)
