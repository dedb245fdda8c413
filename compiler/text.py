"""Stable printed form of networks: for people, for ``--dump-after`` and for golden tests."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.ir import (
    INPUT,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    Network,
    Population,
    Sparse,
)
from spikeloom.compiler.types import FloatArray, IntArray


def span(values: IntArray | FloatArray) -> str:
    """Least and largest value."""
    if not len(values):
        return "none"
    low, high = values.min(), values.max()
    return f"{low:.6g}" if low == high else f"{low:.6g}…{high:.6g}"


def digest(*arrays: IntArray | FloatArray) -> str:
    """A short hash of the values, whatever integer type holds them."""
    found = hashlib.sha256()
    for array in arrays:
        whole = array if array.dtype.kind == "f" else array.astype(np.int64)  # integers come in several widths
        found.update(np.ascontiguousarray(whole).tobytes())
    return found.hexdigest()[:12]


def _indices(weight: Sparse) -> tuple[IntArray, IntArray]:
    """Row bounds and columns of a csr_array in one type: scipy picks the index type by size and history."""
    return weight.indptr.astype(np.int64), weight.indices.astype(np.int64)


def _population(population: Population | IntegerPopulation) -> str:
    head = f"{population.name} (neurons {population.size}) (beta {population.beta!r}) (theta {population.theta!r})"
    head += f" (alpha {population.alpha!r})" if population.alpha else ""
    if isinstance(population, Population):
        return f"{head} (bias {span(population.bias)} #{digest(population.bias)})"
    return (
        f"{head} (scale {span(population.scale)} #{digest(population.scale)}) "
        f"(decay_u {population.decay_u}) (decay_v {population.decay_v}) "
        f"(threshold {span(population.threshold)} #{digest(population.threshold)}) "
        f"(bias {span(population.bias)} #{digest(population.bias_mantissa, population.bias_exponent)})"
    )


def sensor(taxels: int, polarities: int, clocks: Clocks) -> str:
    """Input channels in words."""
    timed = f", {clocks.channels} clocks of {clocks.steps} steps" if clocks.channels else ""
    return f"{taxels} taxels x {polarities}{timed}"


def _network_lines(network: Network | IntegerNetwork) -> Iterator[str]:
    stage = "float" if isinstance(network, Network) else "integer"
    given = network.input
    yield f"({stage} network (input {sensor(given.taxels, given.polarities, given.clocks)}) (classes {network.classes})"
    for population in network.populations:
        yield f"  (population {_population(population)})"
    for projection in network.projections:
        pre = "input" if projection.pre == INPUT else network.populations[projection.pre].name
        weight = projection.weight
        numbers = f"(weight {span(weight.data)} #{digest(*_indices(weight), weight.data)})"
        if isinstance(projection, IntegerProjection):
            numbers = f"(bits {projection.bits}) (exponent {projection.exponent}) {numbers}"
        post = network.populations[projection.post].name
        yield f"  (projection {pre} -> {post} (synapses {weight.nnz}) {numbers})"
    voters, label = network.populations[network.readout.population].name, network.readout.label
    yield f"  (readout {voters} (label {span(label)} #{digest(label)})))"


def text(network: Network | IntegerNetwork) -> str:
    """Print a network; equal text means equal content (arrays appear as ranges and hashes)."""
    return "\n".join(_network_lines(network)) + "\n"
