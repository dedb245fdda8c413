"""Stable printed form of networks and netlists: for people, for ``--dump-after`` and for golden tests."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from compiler.fixedpoint import FloatArray, IntArray
from compiler.ir import INPUT, IntegerNetwork, IntegerPopulation, IntegerProjection, Network, Population
from compiler.netlist import Netlist


def _span(values: IntArray | FloatArray) -> str:
    if not len(values):
        return "none"
    low, high = values.min(), values.max()
    return f"{low:.6g}" if low == high else f"{low:.6g}…{high:.6g}"


def _digest(*arrays: IntArray | FloatArray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:12]


def _population(population: Population | IntegerPopulation) -> str:
    head = f"{population.name} (neurons {population.size}) (beta {population.beta:.6g}) (theta {population.theta:.6g})"
    if isinstance(population, Population):
        return f"{head} (bias {_span(population.bias)} #{_digest(population.bias)})"
    return (
        f"{head} (scale {population.scale:.9g}) (decay_u {population.decay_u}) (decay_v {population.decay_v}) "
        f"(threshold {_span(population.threshold)}) (bias {_span(population.bias)} #{_digest(population.bias)})"
    )


def _network_lines(network: Network | IntegerNetwork) -> Iterator[str]:
    stage = "float" if isinstance(network, Network) else "integer"
    sensor = network.input
    yield f"({stage} network (input {sensor.taxels} taxels x {sensor.polarities}) (classes {network.classes})"
    for population in network.populations:
        yield f"  (population {_population(population)})"
    for projection in network.projections:
        pre = "input" if projection.pre == INPUT else network.populations[projection.pre].name
        weight = projection.weight
        numbers = f"(weight {_span(weight.data)} #{_digest(weight.indptr, weight.indices, weight.data)})"
        if isinstance(projection, IntegerProjection):
            numbers = f"(bits {projection.bits}) (exponent {projection.exponent}) {numbers}"
        post = network.populations[projection.post].name
        yield f"  (projection {pre} -> {post} (synapses {weight.nnz}) {numbers})"
    yield f"  (readout {network.populations[network.readout.population].name}))"


def _netlist_lines(netlist: Netlist) -> Iterator[str]:
    yield f"(netlist {netlist.target} (inputs {netlist.n_inputs}) (classes {netlist.classes})"
    for layer in netlist.layers:
        yield (
            f"  (layer {layer.name} (neurons {layer.neurons}) (depth {layer.depth}) (scale {layer.scale:.9g}) "
            f"(bits {layer.weight_bits}) (synapses {layer.synapses}))"
        )
    for core in range(netlist.n_cores):
        first, last = netlist.core_compartments[core : core + 2]
        axons = slice(*netlist.core_axons[core : core + 2])
        synapses = slice(*netlist.axon_synapses[list(netlist.core_axons[core : core + 2])])
        held = [
            f"{netlist.layers[i].name} {_span(netlist.neuron[first:last][netlist.layer[first:last] == i])}"
            for i in np.unique(netlist.layer[first:last])
        ]
        yield (
            f"  (core {core} (tile {netlist.core_tile[core]}) (compartments {last - first}: {', '.join(held)}) "
            f"(axons {axons.stop - axons.start}) (synapses {synapses.stop - synapses.start} "
            f"#{_digest(netlist.synapse_target[synapses], netlist.synapse_weight[synapses])}))"
        )
    yield ")"


def text(artefact: Network | IntegerNetwork | Netlist) -> str:
    """Print a network or a netlist; equal text means equal content (arrays appear as ranges and hashes)."""
    lines = _netlist_lines(artefact) if isinstance(artefact, Netlist) else _network_lines(artefact)
    return "\n".join(lines) + "\n"
