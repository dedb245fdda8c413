"""Every rule of the intermediate representation, one function each, grouped by stage.

A broken rule is a defect of a pass, not of the user: :class:`errors.VerifyError`. What a user can cause is
refused by the front-ends and by the target's ``legalize`` before it gets here.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from spikeloom.compiler import ir
from spikeloom.compiler.errors import VerifyError

Faults = Iterator[str]


def _names_are_unique(network: ir.Graph) -> Faults:
    names = [population.name for population in network.populations]
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield f"two populations are called {name!r}"


def _projections_fit(network: ir.Graph) -> Faults:
    sizes = {i: population.size for i, population in enumerate(network.populations)} | {
        ir.INPUT: network.input.size
    }
    for i, p in enumerate(network.projections):
        expected = (sizes.get(p.post), sizes.get(p.pre))
        if p.post == ir.INPUT or p.weight.shape != expected:
            yield f"projection {i} has shape {p.weight.shape}, its populations ask for {expected}"
        if not p.weight.has_canonical_format:
            yield f"projection {i} has unsorted or repeated synapses"
        if p.pre > p.post:
            yield f"projection {i} runs from population {p.pre} to {p.post}, not forward"


def _steps_are_kept(network: ir.Graph) -> Faults:
    count = len(network.populations)
    projections = network.projections
    if not all(ir.INPUT <= p.pre < count and 0 <= p.post < count for p in projections):
        return  # to populations that there are not, which is said above
    depth = {ir.INPUT: -1} | dict(enumerate(ir.depths(network)))
    for i, p in enumerate(projections):
        early = depth[p.post] - depth[p.pre] - 1
        if (
            p.pre != p.post and early > 0
        ):  # of a recurrent one, what a step fires arrives in the next here, too
            yield f"projection {i} skips a layer: a spike takes one step on the chip, so it would arrive {early} early"
    reached = {ir.INPUT}
    for post, pre in sorted((p.post, p.pre) for p in projections):  # a recurrent one after the others
        reached |= {post} if pre in reached else set()
    for post in sorted(set(range(count)) - reached):
        yield f"population {network.populations[post].name!r} is not reached from the input"


def _readout_fits(network: ir.Graph) -> Faults:
    label = network.readout.label
    if not 0 <= network.readout.population < len(network.populations):
        yield f"the read-out names population {network.readout.population}"
    elif label.shape != (network.populations[network.readout.population].size,):
        yield f"the read-out has {label.size} labels for another number of neurons"
    elif label.size and not (0 <= label.min() and label.max() < network.classes):
        yield f"the read-out has labels outside 0 … {network.classes - 1}"


def _values_are_finite(network: ir.Network) -> Faults:
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


def graph_faults(network: ir.Graph) -> Faults:
    """Rules that a network in any kind of numbers breaks."""
    yield from _names_are_unique(network)
    yield from _projections_fit(network)
    yield from _steps_are_kept(network)
    yield from _readout_fits(network)


def verify(network: ir.Network) -> None:
    """Check every rule; VerifyError names all that are broken."""
    require_none([*graph_faults(network), *_values_are_finite(network)])


def require_none(faults: Sequence[str]) -> None:
    """Refuse broken rules with a VerifyError that names all of them."""
    if faults:
        raise VerifyError("; ".join(faults))
