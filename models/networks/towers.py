"""Take a joined network apart into its towers, each of which computes what it computes alone.

A tower's float32 sums depend on their order, which the zeros of a matrix for all towers would change.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from spikeloom.compiler.checkpoint import merge, neurons_of
from spikeloom.compiler.ir import INPUT, Convolution, Network, Projection
from spikeloom.compiler.types import AnyArray, IntArray


def by_tower(network: Network, run: Callable[[Network], Sequence[AnyArray]]) -> dict[str, AnyArray]:
    """Values of the neurons of each layer by its name, (..., neurons), as `run` gives them of each tower by layer."""
    names = [population.name for population in network.populations]
    parts = [run(tower) for tower in split(network)]
    owners = () if network.convolution is None else network.convolution.towers
    return dict(zip(names, merge(owners, parts) if owners else parts[0], strict=True))


def split(network: Network) -> tuple[Network, ...]:
    """The networks that one was joined from, or the one that it is."""
    convolution = network.convolution
    if convolution is None or not convolution.towers:
        return (network,)
    filters = np.split(convolution.filters, 1 + int(convolution.towers[0].max()), axis=1)
    biases = np.split(convolution.bias, len(filters))
    return tuple(
        _tower(network, tower, replace(convolution, filters=own, bias=bias, towers=()), convolution.towers)
        for tower, (own, bias) in enumerate(zip(filters, biases, strict=True))
    )


def _tower(network: Network, tower: int, convolution: Convolution, owners: Sequence[IntArray]) -> Network:
    chosen = [neurons_of(tower, owner) for owner in owners]

    def own(projection: Projection) -> Projection:
        weight = projection.weight[chosen[projection.post]]
        return replace(
            projection, weight=weight if projection.pre == INPUT else weight[:, chosen[projection.pre]]
        )

    forms = network.forms
    if forms is not None:
        forms = tuple(
            replace(form, threshold=form.threshold[keep]) for form, keep in zip(forms, chosen, strict=True)
        )
    populations = zip(network.populations, chosen, strict=True)
    return replace(
        network,
        populations=tuple(
            replace(population, bias=population.bias[keep]) for population, keep in populations
        ),
        projections=tuple(map(own, network.projections)),
        readout=replace(network.readout, label=network.readout.label[chosen[network.readout.population]]),
        forms=forms,
        convolution=convolution,
    )
