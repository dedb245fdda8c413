"""Put spiking layers and what lies between them together as a network, or say why the chip cannot have it.

What reads a network from elsewhere, an ONNX graph or a torch module, ends here: with layers, each with its
decay, its threshold and affine stages from other layers, and with how the output is counted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.ir import INPUT, Input, Network, Population, Projection, Readout, Sparse, depths
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.types import IntArray

N = TypeVar("N", bound=Network | IntegerNetwork)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReadNetwork(Generic[N]):
    """A network, and what was found about the file of another framework that it is from."""

    network: N
    facts: tuple[str, ...]  # what was read and what was assumed, for people
    sha256: str  # of the file, and of data beside it
    read_as: Mapping[str, Any] = field(
        default_factory=dict
    )  # beyond what the file says: the time step of a NIR file
    training: Mapping[str, Any] | None = None  # how it was fine-tuned, where the file says so


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer(Population):
    """A spiking layer: its neurons, and the weights from its sources.

    Those are known by their place in the sequence, or INPUT; from the own place come the spikes of the step
    before.
    """

    sources: Mapping[int, Sparse]


def class_of_each(counts: Sparse) -> IntArray | None:
    """Class that each neuron votes for, where the output adds up spikes so, else None.

    counts: csr_array (classes, neurons); what the output is, in terms of spikes.

    >>> from scipy import sparse
    >>> class_of_each(sparse.csr_array([[0.5, 0.5, 0.0], [0.0, 0.0, 0.5]])).tolist()
    [0, 0, 1]
    >>> class_of_each(sparse.csr_array([[1.0, -1.0]])) is None
    True
    """
    columns = counts.tocsc()
    one_each = np.all(np.diff(columns.indptr) == 1)
    if (
        not one_each
        or not columns.nnz
        or columns.data[0] <= 0
        or np.ptp(columns.data) > 1e-12 * columns.data[0]
    ):
        return None
    return np.asarray(columns.indices.astype(np.int64))


def by_depth(layers: Sequence[Layer]) -> list[list[int]]:
    """Places of the layers by how many others lie between them and the input at most.

    Raises ModelError if some feed each other in a circle.
    """
    left = {index: layer.sources.keys() - {INPUT, index} for index, layer in enumerate(layers)}
    ready = []
    while left:
        ready.append([index for index, sources in left.items() if not sources & left.keys()])
        if not ready[-1]:
            stuck = ", ".join(printable(layers[index].name) for index in left)
            raise ModelError(
                f"layers {stuck} feed each other in a circle; a layer may feed itself, no layer before it"
            )
        left = {index: sources for index, sources in left.items() if index not in ready[-1]}
    return ready


def assemble(layers: Sequence[Layer], sensor: Input, voters: int, label: IntArray, classes: int) -> Network:
    """Network of layers in any order; the spikes of `voters` are counted, `label` is the class of each of its neurons.

    Raises ModelError if the layers are in a circle, some are not reached from the input, skip a layer, or
    have constants or weights that no chip's neuron has.
    """
    order = [index for ready in by_depth(layers) for index in ready]
    place = {INPUT: INPUT} | {old: new for new, old in enumerate(order)}
    populations: list[Population] = []
    projections = []
    for layer in (layers[index] for index in order):
        _require_neuron(layer)
        post = len(populations)
        populations.append(
            Population(**{each.name: getattr(layer, each.name) for each in fields(Population)})
        )
        for source, weight in sorted(layer.sources.items(), key=lambda entry: place[entry[0]]):
            weight.sort_indices()
            projections.append(Projection(pre=place[source], post=post, weight=weight))
    network = Network(
        input=sensor,
        populations=tuple(populations),
        projections=tuple(projections),
        readout=Readout(population=place[voters], label=label),
        classes=classes,
    )
    _require_reach(network)
    return network


def _require_neuron(layer: Layer) -> None:
    numbers = (layer.bias, *(weight.data for weight in layer.sources.values()))
    rules = {
        f"keeps {layer.beta:g} of its membrane in a step, allowed are 0 to 1": 0 <= layer.beta <= 1,
        f"keeps {layer.alpha:g} of its current in a step, allowed is less than 1": 0 <= layer.alpha < 1,
        f"has the threshold {layer.theta:g}, allowed are numbers above 0": 0 < layer.theta < np.inf,
        "has weights or biases that are not finite": all(np.all(np.isfinite(values)) for values in numbers),
    }
    for fault in [words for words, holds in rules.items() if not holds]:
        raise ModelError(f"layer {printable(layer.name)}: {fault}; train it again")


def _require_reach(network: Network) -> None:
    """A spike takes one step on the chip, so all sources of a layer must lie equally deep."""
    names = [printable(population.name) for population in network.populations]
    depth = {INPUT: -1} | dict(enumerate(depths(network)))
    for post, name in enumerate(names):
        sources = [p.pre for p in network.projections if p.post == post != p.pre]
        if not sources:
            raise ModelError(f"layer {name}: receives nothing, so the input does not reach it; remove it")
        if len({depth[source] for source in sources}) > 1:
            received = " and ".join("the input" if source == INPUT else names[source] for source in sources)
            raise ModelError(
                f"layer {name}: receives {received}, which are at different depths; a spike takes one step on the chip "
                "and would arrive too early, so add a spiking layer to the shorter path"
            )
