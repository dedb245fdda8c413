"""Stable printed form of networks and netlists: for people, for ``--dump-after`` and for golden tests."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.ir import (
    INPUT,
    Input,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    Network,
    Population,
    Sparse,
)
from spikeloom.compiler.targets.loihi1.netlist import Netlist

_COMPARTMENT_FIELDS = (
    "layer",
    "neuron",
    "decay_u",
    "decay_v",
    "threshold",
    "bias_mantissa",
    "bias_exponent",
    "scale",
    "readout_class",
)


def _span(values: IntArray | FloatArray) -> str:
    if not len(values):
        return "none"
    low, high = values.min(), values.max()
    return f"{low:.6g}" if low == high else f"{low:.6g}…{high:.6g}"


def _digest(*arrays: IntArray | FloatArray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        whole = array if array.dtype.kind == "f" else array.astype(np.int64)  # integers come in several widths
        digest.update(np.ascontiguousarray(whole).tobytes())
    return digest.hexdigest()[:12]


def _indices(weight: Sparse) -> tuple[IntArray, IntArray]:
    """Row bounds and columns of a csr_array in one type: scipy picks the index type by size and history."""
    return weight.indptr.astype(np.int64), weight.indices.astype(np.int64)


def _population(population: Population | IntegerPopulation) -> str:
    head = f"{population.name} (neurons {population.size}) (beta {population.beta!r}) (theta {population.theta!r})"
    head += f" (alpha {population.alpha!r})" if population.alpha else ""
    if isinstance(population, Population):
        return f"{head} (bias {_span(population.bias)} #{_digest(population.bias)})"
    return (
        f"{head} (scale {_span(population.scale)} #{_digest(population.scale)}) "
        f"(decay_u {population.decay_u}) (decay_v {population.decay_v}) "
        f"(threshold {_span(population.threshold)} #{_digest(population.threshold)}) "
        f"(bias {_span(population.bias)} #{_digest(population.bias_mantissa, population.bias_exponent)})"
    )


def _sensor(of: Input | Netlist) -> str:
    clocks = f", {of.clocks.channels} clocks of {of.clocks.steps} steps" if of.clocks.channels else ""
    return f"{of.taxels} taxels x {of.polarities}{clocks}"


def _network_lines(network: Network | IntegerNetwork) -> Iterator[str]:
    stage = "float" if isinstance(network, Network) else "integer"
    yield f"({stage} network (input {_sensor(network.input)}) (classes {network.classes})"
    for population in network.populations:
        yield f"  (population {_population(population)})"
    for projection in network.projections:
        pre = "input" if projection.pre == INPUT else network.populations[projection.pre].name
        weight = projection.weight
        numbers = f"(weight {_span(weight.data)} #{_digest(*_indices(weight), weight.data)})"
        if isinstance(projection, IntegerProjection):
            numbers = f"(bits {projection.bits}) (exponent {projection.exponent}) {numbers}"
        post = network.populations[projection.post].name
        yield f"  (projection {pre} -> {post} (synapses {weight.nnz}) {numbers})"
    voters, label = network.populations[network.readout.population].name, network.readout.label
    yield f"  (readout {voters} (label {_span(label)} #{_digest(label)})))"


def _netlist_lines(netlist: Netlist) -> Iterator[str]:
    yield f"(netlist {netlist.target} (input {_sensor(netlist)}) (classes {netlist.classes})"
    for layer in netlist.layers:
        alpha = f"(alpha {layer.alpha!r}) " if layer.alpha else ""
        yield (
            f"  (layer {layer.name} (neurons {layer.neurons}) (depth {layer.depth}) (beta {layer.beta!r}) "
            f"(theta {layer.theta!r}) {alpha}(bits {layer.weight_bits}) "
            f"(synapses {layer.synapses}) (fan_in {layer.max_fan_in}))"
        )
    formats = zip(netlist.format_weight_bits, netlist.format_exponent, netlist.format_index_bits, strict=True)
    for i, (bits, exponent, index_bits) in enumerate(formats):
        yield f"  (format {i} (bits {bits}) (exponent {exponent}) (index_bits {index_bits}))"
    for core in range(netlist.n_cores):
        first, last = netlist.core_compartments[core : core + 2]
        axons = slice(*netlist.core_axons[core : core + 2])
        synapses = slice(*netlist.axon_synapses[list(netlist.core_axons[core : core + 2])])
        held = [
            f"{netlist.layers[i].name} {_span(netlist.neuron[first:last][netlist.layer[first:last] == i])}"
            for i in np.unique(netlist.layer[first:last])
        ]
        inside = [getattr(netlist, name)[first:last] for name in _COMPARTMENT_FIELDS]
        ends = netlist.axon_synapses[axons.start : axons.stop + 1]
        yield (
            f"  (core {core} (tile {netlist.core_tile[core]}) "
            f"(compartments {last - first}: {', '.join(held)} #{_digest(*inside)}) "
            f"(axons {axons.stop - axons.start} "
            f"#{_digest(netlist.axon_source[axons], netlist.axon_format[axons], ends)}) "
            f"(synapses {synapses.stop - synapses.start} "
            f"#{_digest(netlist.synapse_target[synapses], netlist.synapse_weight[synapses])}))"
        )
    yield ")"


def text(artefact: Network | IntegerNetwork | Netlist) -> str:
    """Print a network or a netlist; equal text means equal content (arrays appear as ranges and hashes).

    The provenance of a netlist is left out.
    """
    lines = _netlist_lines(artefact) if isinstance(artefact, Netlist) else _network_lines(artefact)
    return "\n".join(lines) + "\n"
