"""Another float network stored on the scales of a netlist, so that nothing changes but what the other network changes.

The result is a netlist to simulate, not one to load: its cores may need more than there is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX, round_half_even
from spikeloom.compiler.ir import (
    Form,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    Network,
    Population,
    Projection,
)
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.storage.weight_storage import loads, round_population


def store_alike(netlist: Netlist, network: Network, *, coarser: int = 1) -> Netlist:
    """Another float network of the same sizes, stored as the netlist stores its own.

    Widths, exponents and thresholds are the netlist's, weights are rounded to the nearest; a neuron that the netlist
    does not hold gets its layer's median threshold. With `coarser` scales, and thresholds with them, are so many times
    smaller; so they are where a register could overflow otherwise.

    Raises
    ------
    OptionError
        If a bias has no register value at this scale.
    """
    filled = np.flatnonzero(np.diff(netlist.axon_synapses))
    receiver = netlist.layer[netlist.synapse_compartment()[netlist.axon_synapses[filled]]]
    exponents = netlist.format_exponent[netlist.axon_format[filled]]
    populations, projections = list[IntegerPopulation](), list[IntegerProjection]()
    for post, (population, layer) in enumerate(zip(network.populations, netlist.layers, strict=True)):
        ids = netlist.compartments_of(post)
        threshold = np.full(layer.neurons, round(float(np.median(netlist.threshold[ids]))))
        threshold[netlist.neuron[ids]] = netlist.threshold[ids]
        threshold = np.maximum(round_half_even(threshold / coarser), 1)
        used = tuple(sorted(set(exponents[receiver == post].tolist()))) or (0,)
        form = Form(bits=layer.weight_bits, exponents=used, threshold=threshold)
        into = tuple(projection for projection in network.projections if projection.post == post)
        try:
            integer, planes = _fitted(population, into, form)
        except ValueError as error:
            raise OptionError(f"{population.name}: {error}; omit this perturbation") from error
        populations.append(integer)
        projections += planes
    whole = IntegerNetwork(
        input=network.input,
        populations=tuple(populations),
        projections=tuple(projections),
        readout=network.readout,
        classes=network.classes,
    )
    return unplaced(whole, netlist)


def _fitted(
    population: Population, into: tuple[Projection, ...], form: Form
) -> tuple[IntegerPopulation, tuple[IntegerProjection, ...]]:
    """Round to a form, with thresholds so much smaller that no register can overflow where one could."""
    while True:
        integer, planes = round_population(population, into, form)
        fullest = float(loads(integer, planes).max(initial=0))
        smaller = np.maximum(np.floor(form.threshold * (ONE_STEP_SUM_MAX / max(fullest, 1.0))), 1).astype(np.int64)
        if fullest <= ONE_STEP_SUM_MAX or np.array_equal(smaller, form.threshold):
            return integer, planes
        form = replace(form, threshold=smaller)


def unplaced(network: IntegerNetwork, like: Netlist) -> Netlist:
    """A netlist to simulate, not to load: cores hold as many compartments as they can, whatever these need."""
    target = load_target(like.target)
    most = target.limit("core.compartments")
    cores = tuple(
        (Chunk(population=post, first=first, last=min(first + most, population.size)),)
        for post, population in enumerate(network.populations)
        for first in range(0, population.size, most)
    )
    return emit(network, cores, tuple(range(len(cores))), target, like.provenance)
