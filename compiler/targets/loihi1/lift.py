"""Read a netlist back as an integer network: the inverse of :mod:`loihi1.emit`, cores forgotten.

Synapses of weight zero are stored by chance (inside dense lists) and are left out. A layer whose weights all
rounded to zero stores no synapse; it is given an empty projection from the layer before. Neurons that the
chip does not hold come back without synapses or bias, so that they never fire.
"""

from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.ir import INPUT, Input, Readout
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerPopulation, IntegerProjection
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import THRESHOLD_MANTISSA_MAX
from spikeloom.compiler.types import AnyArray


def _one(netlist: Netlist, layer: int, field: str) -> int:
    values = np.unique(getattr(netlist, field)[netlist.compartments_of(layer)])
    if len(values) != 1:
        raise FormatError(
            f"layer {netlist.layers[layer].name}: has {len(values)} values of {field}, one is allowed; compile it again"
        )
    return int(values[0])


def _population(netlist: Netlist, index: int) -> IntegerPopulation:
    """Neurons of a layer; those that the chip does not hold have no bias and the highest threshold."""
    layer = netlist.layers[index]
    ids = netlist.compartments_of(index)

    def whole(values: AnyArray, missing: float) -> Any:
        array = np.full(layer.neurons, missing, values.dtype)
        array[netlist.neuron[ids]] = values[ids]
        return array

    return IntegerPopulation(
        name=layer.name,
        beta=layer.beta,
        theta=layer.theta,
        alpha=layer.alpha,
        scale=whole(netlist.scale, 1.0),
        decay_u=_one(netlist, index, "decay_u"),
        decay_v=_one(netlist, index, "decay_v"),
        threshold=whole(netlist.threshold, THRESHOLD_MANTISSA_MAX),
        bias_mantissa=whole(netlist.bias_mantissa, 0),
        bias_exponent=whole(netlist.bias_exponent, 0),
    )


def _projections(netlist: Netlist) -> list[IntegerProjection]:
    """Synapses, one projection for each pair of layers and weight format."""
    axon = netlist.axon_of_synapse()
    source = netlist.axon_source[axon]
    form = netlist.axon_format[axon]
    target = netlist.synapse_compartment()
    pre = np.concatenate([np.full(netlist.n_inputs, INPUT), netlist.layer])[source]
    column = np.concatenate([np.arange(netlist.n_inputs), netlist.neuron])[source]
    post = netlist.layer[target]
    row = netlist.neuron[target]
    exponent = netlist.format_exponent[form]
    bits = netlist.format_weight_bits[form]
    sizes = {INPUT: netlist.n_inputs} | {i: layer.neurons for i, layer in enumerate(netlist.layers)}
    projections = []
    code = (
        (post * (len(netlist.layers) + 1) + pre + 1) * 64 + exponent + 32
    ) * 16 + bits  # one number sorts faster
    for first in np.unique(code, return_index=True)[1]:
        stored = (code == code[first]) & (netlist.synapse_weight != 0)
        to, origin, power, width = (int(each[first]) for each in (post, pre, exponent, bits))
        mantissa = netlist.synapse_weight[stored].astype(np.int64)
        weight = sparse.csr_array(
            (mantissa, (row[stored], column[stored])), shape=(sizes[to], sizes[origin])
        )
        weight.sum_duplicates()
        projections.append(IntegerProjection(pre=origin, post=to, weight=weight, exponent=power, bits=width))
    reached = {projection.post for projection in projections if projection.pre != projection.post}
    for index, layer in enumerate(netlist.layers):
        if index not in reached:
            before = next(
                (i for i, other in enumerate(netlist.layers) if other.depth == layer.depth - 1), INPUT
            )
            none = sparse.csr_array((layer.neurons, sizes[before]), dtype=np.int64)
            projections += [
                IntegerProjection(pre=before, post=index, weight=none, exponent=0, bits=layer.weight_bits)
            ]
    return projections


def lift(netlist: Netlist) -> IntegerNetwork:
    """Collect compartments to populations and axons to projections, one per pair of layers and weight format.

    FormatError if a layer has different decays or synapses of a later one, or several layers vote, which the
    network form cannot say.
    """
    populations = tuple(_population(netlist, index) for index in range(len(netlist.layers)))
    projections = _projections(netlist)
    for projection in projections:
        if projection.pre > projection.post:
            post, pre = (netlist.layers[index].name for index in (projection.post, projection.pre))
            raise FormatError(
                f"layer {post}: has synapses of layer {pre}, which comes after it; compile it again"
            )
    voting = np.unique(netlist.layer[netlist.voters])
    if len(voting) != 1:
        raise FormatError(f"{len(voting)} layers vote for classes, one is allowed; compile it again")
    return IntegerNetwork(
        input=Input(
            taxels=netlist.taxels, polarities=netlist.polarities, clocks=netlist.clocks, bins=netlist.bins
        ),
        populations=populations,
        projections=tuple(projections),
        readout=Readout(
            population=int(voting[0]), label=netlist.readout_class[netlist.compartments_of(int(voting[0]))]
        ),
        classes=netlist.classes,
    )
