"""Every rule of the intermediate representation, one function each, grouped by stage.

A broken rule is a defect of a pass, not of the user: :class:`errors.VerifyError`. What a user can cause is
refused by the front-ends and by the target's ``legalize`` before it gets here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.fixedpoint import BIAS_EXPONENT_MAX, BIAS_MANTISSA_MAX, THRESHOLD_MANTISSA_MAX, weight_step
from spikeloom.compiler.ir import (
    INPUT,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    Network,
    Population,
    Projection,
    depths,
)

Faults = Iterator[str]


def _names_are_unique(network: Network | IntegerNetwork) -> Faults:
    names = [population.name for population in network.populations]
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield f"two populations are called {name!r}"


def _projections_fit(network: Network | IntegerNetwork) -> Faults:
    populations: tuple[Population | IntegerPopulation, ...] = network.populations
    sizes = {INPUT: network.input.size} | {i: population.size for i, population in enumerate(populations)}
    projections: tuple[Projection | IntegerProjection, ...] = network.projections
    for i, projection in enumerate(projections):
        expected = (sizes.get(projection.post), sizes.get(projection.pre))
        if projection.post == INPUT or projection.weight.shape != expected:
            yield f"projection {i} has shape {projection.weight.shape}, its populations ask for {expected}"
        if not projection.weight.has_canonical_format:
            yield f"projection {i} has unsorted or repeated synapses"


def _populations_exist(network: Network | IntegerNetwork) -> bool:
    """Whether every projection joins populations that there are; :func:`_projections_fit` says which does not."""
    count = len(network.populations)
    return all(INPUT <= p.pre < count and 0 <= p.post < count for p in network.projections)


def _runs_forward(network: Network | IntegerNetwork) -> Faults:
    projections: tuple[Projection | IntegerProjection, ...] = network.projections
    for i, projection in enumerate(projections):
        if projection.pre > projection.post:
            yield f"projection {i} runs from population {projection.pre} to {projection.post}, not forward"


def _no_layer_is_skipped(network: Network | IntegerNetwork) -> Faults:
    if not _populations_exist(network):
        return
    depth = {INPUT: -1} | dict(enumerate(depths(network)))
    projections: tuple[Projection | IntegerProjection, ...] = network.projections
    for i, projection in enumerate(projections):
        if projection.pre == projection.post:
            continue  # what a step fires arrives in the next, on the chip and here
        early = depth[projection.post] - depth[projection.pre] - 1
        if early > 0:
            yield f"projection {i} skips a layer: a spike takes one step on the chip, so it would arrive {early} early"


def _everything_is_reached(network: Network | IntegerNetwork) -> Faults:
    if not _populations_exist(network):
        return
    reached = {INPUT}
    for post, pre in sorted((p.post, p.pre) for p in network.projections):  # a recurrent one after the others
        reached |= {post} if pre in reached else set()
    for post in sorted(set(range(len(network.populations))) - reached):
        yield f"population {network.populations[post].name!r} is not reached from the input"


def _readout_fits(network: Network | IntegerNetwork) -> Faults:
    label = network.readout.label
    if not 0 <= network.readout.population < len(network.populations):
        yield f"the read-out names population {network.readout.population}"
    elif label.shape != (network.populations[network.readout.population].size,):
        yield f"the read-out has {label.size} labels for another number of neurons"
    elif label.size and not (0 <= label.min() and label.max() < network.classes):
        yield f"the read-out has labels outside 0 … {network.classes - 1}"


def _values_are_finite(network: Network) -> Faults:
    for population in network.populations:
        if not np.all(np.isfinite(population.bias)):
            yield f"population {population.name!r} has biases that are not finite"
        if not (0 <= population.beta <= 1 and population.theta > 0):
            yield f"population {population.name!r} has beta {population.beta} or theta {population.theta} out of range"
        if not 0 <= population.alpha < 1:
            yield f"population {population.name!r} has alpha {population.alpha} out of range"
    for i, projection in enumerate(network.projections):
        if projection.weight.dtype != np.float64 or not np.all(np.isfinite(projection.weight.data)):
            yield f"projection {i} has weights that are not finite float64"


def _registers_hold(network: IntegerNetwork) -> Faults:
    for population in network.populations:
        name = population.name
        if not (0 <= population.decay_u <= 4095 and 0 <= population.decay_v <= 4095):
            yield f"population {name!r} has a decay outside 0 … 4095"
        if np.any(population.threshold < 0) or np.any(population.threshold > THRESHOLD_MANTISSA_MAX):
            yield f"population {name!r} has a threshold outside 0 … {THRESHOLD_MANTISSA_MAX}"
        if np.any(np.abs(population.bias_mantissa) > BIAS_MANTISSA_MAX):
            yield f"population {name!r} has a bias mantissa beyond {BIAS_MANTISSA_MAX}"
        if np.any(population.bias_exponent < 0) or np.any(population.bias_exponent > BIAS_EXPONENT_MAX):
            yield f"population {name!r} has a bias exponent outside 0 … {BIAS_EXPONENT_MAX}"


def _mantissas_hold(network: IntegerNetwork) -> Faults:
    for i, projection in enumerate(network.projections):
        step, data = weight_step(projection.bits), projection.weight.data
        if data.dtype.kind != "i" or np.any(data % step) or np.any(data < -256) or np.any(data > 256 - step):
            yield f"projection {i} has mantissas that {projection.bits} bits cannot hold"
        if projection.exponent < -1:
            yield f"projection {i} has exponent {projection.exponent}: below -1 its weights are no whole units"


_SHARED: tuple[Callable[[Network | IntegerNetwork], Faults], ...] = (
    _names_are_unique,
    _projections_fit,
    _runs_forward,
    _no_layer_is_skipped,
    _everything_is_reached,
    _readout_fits,
)


def verify(network: Network | IntegerNetwork) -> None:
    """Check every rule of the network's stage.

    Raises
    ------
    VerifyError
        Naming all broken rules.
    """
    faults = [fault for rule in _SHARED for fault in rule(network)]
    if isinstance(network, Network):
        faults += _values_are_finite(network)
    else:
        faults += [*_registers_hold(network), *_mantissas_hold(network)]
    if faults:
        raise VerifyError("; ".join(faults))
