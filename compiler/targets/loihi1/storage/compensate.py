"""Round the weights of a layer so that the errors of its synapses cancel on what the layer usually gets.

Nearest rounding treats synapses one by one. Here they are rounded one after the other, and what one gains or loses is
made up for by those still to come, as far as their inputs spike together; the bias takes up the mean that is left.
No register, width or count changes.

References
----------
.. [1] B. Hassibi, D. Stork, "Second order derivatives for network pruning: Optimal Brain Surgeon", NIPS 1992.
.. [2] E. Frantar et al., "GPTQ: Accurate post-training quantization for generative pre-trained transformers", 2022,
   arXiv:2210.17323: the order-by-order update through a Cholesky factor.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular

from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX, reach, step_units
from spikeloom.compiler.ir import Form
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.targets.loihi1.storage.scales import FloatLayer, Rounded, flips, rounded
from spikeloom.compiler.targets.loihi1.storage.weight_storage import loads, scales
from spikeloom.compiler.types import FloatArray, IntArray

DAMPING = 1e-3
"""Share of the mean activity that is added to each input's own: inputs that never spiked are rounded to nearest."""

BLOCK = 64
"""Columns whose errors are passed on to all later ones at once: the same sums, as one matrix product."""


def compensated(layer: FloatLayer, form: Form, calibration: Calibration) -> Rounded | None:
    """Round one population with compensation; None where a bias has no register value.

    Weights that the range cuts off stay at its end: their errors are not passed on. A neuron whose sums would leave
    the accumulator, or that keeps fewer of its spikes (one that fires from its bias alone, say), is rounded to
    nearest instead.
    """
    population, projections, post = layer.population, layer.projections, layer.post
    scale, step = scales(population, form), step_units(form.bits, form.exponents)
    offset, width = 0, sum(p.weight.shape[1] for p in projections)
    wanted, connected = np.zeros((population.size, width)), np.zeros((population.size, width), np.bool_)
    places, sources = [], []
    limit = reach(form.bits, form.exponents)
    for p in projections:
        row = np.repeat(np.arange(population.size), np.diff(p.weight.indptr))
        place = row, offset + p.weight.indices
        wanted[place] = p.weight.data * scale[row] / step
        connected[place] = True
        places.append(place)
        sources.append(calibration.source(p.pre, post).reshape(-1, p.weight.shape[1]))
        offset += p.weight.shape[1]
    held = np.clip(wanted, -limit, limit)
    active = sparse.csr_array(np.concatenate(sources, axis=1), dtype=np.float32)
    together = (active.T @ active).toarray().astype(np.float64) / active.shape[0]
    rate = np.diag(together)
    steps = np.zeros(wanted.shape, np.int64)
    kinds, kind = np.unique(connected, axis=0, return_inverse=True)
    for index, inputs in enumerate(kinds):  # neurons with synapses from the same inputs are rounded together
        columns = np.flatnonzero(inputs)
        part = np.ix_(np.flatnonzero(kind == index), columns)
        steps[part] = np.clip(_round_in_turn(held[part], together[np.ix_(columns, columns)]), -limit, limit)

    def stored_as(steps: IntArray, errors: FloatArray) -> Rounded | None:
        return rounded(layer, form, [steps[place] for place in places], population.bias + errors)

    nearest = np.rint(held).astype(np.int64)
    plain = stored_as(nearest, np.zeros(population.size))
    errors = (held - steps) @ rate * step / scale
    errors[population.size - population.relays :] = 0  # a relay has no bias
    found = stored_as(steps, errors)
    if found is None or plain is None:
        return None
    back = flips(found, post, calibration) > flips(plain, post, calibration)
    back |= loads(found.population, found.projections) > ONE_STEP_SUM_MAX
    steps[back], errors[back] = nearest[back], 0
    found = stored_as(steps, errors)
    return None if found is None else replace(found, compensated=True)


def _round_in_turn(weight: FloatArray, together: FloatArray) -> FloatArray:
    """Round columns one after the other, the most active first, each error passed on to the columns that follow.

    Weights (neurons, inputs) are in steps; `together` (inputs, inputs) is the mean of ``x x^T``.
    """
    inputs = weight.shape[1]
    order = np.argsort(-np.diag(together), kind="stable")
    follow = _follow(
        together[np.ix_(order, order)] + np.eye(inputs) * (DAMPING * np.trace(together) / max(inputs, 1) + 1e-12)
    )
    left = weight[:, order]
    rounded = np.empty_like(left)
    for start in range(0, inputs, BLOCK):
        end = min(start + BLOCK, inputs)
        errors = np.empty((len(left), end - start))
        for j in range(start, end):
            rounded[:, j] = np.rint(left[:, j])
            errors[:, j - start] = left[:, j] - rounded[:, j]
            left[:, j + 1 : end] -= np.outer(errors[:, j - start], follow[j, j + 1 : end])
        left[:, end:] -= errors @ follow[start:end, end:]
    back = np.empty_like(rounded)
    back[:, order] = rounded
    return back


def _follow(together: FloatArray) -> FloatArray:
    """Share of each input's error that each later one makes up for: the Cholesky factor of the inverse, rows scaled.

    The factor is that of the reversed matrix, inverted and turned round, so that the inverse itself is never formed.
    """
    lower = np.linalg.cholesky(together[::-1, ::-1])
    upper: FloatArray = solve_triangular(lower, np.eye(len(lower)), lower=True)[::-1, ::-1]
    return upper / np.diag(upper)[:, None]
