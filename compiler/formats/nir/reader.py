"""Read a spiking network from a NIR file: affine stages become weights, in float64, spiking nodes become layers."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from scipy import sparse

from spikeloom.compiler.dynamics import MOST_STEPS, RELAY_WEIGHT, Clocks
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.affine import scaled
from spikeloom.compiler.formats.assemble import Layer, ReadNetwork, assemble, class_of_each, in_order
from spikeloom.compiler.formats.hdf5 import read_hdf5
from spikeloom.compiler.formats.names import printable, unique_names
from spikeloom.compiler.formats.nir import CONVENTIONS
from spikeloom.compiler.formats.nir.file import INPUT_NODE, OUTPUT_NODE, SPIKING, Graph, Node, graph_of, loops
from spikeloom.compiler.formats.nir.file import in_order as nodes_in_order
from spikeloom.compiler.formats.nir.neurons import Neurons, facts_of, neurons_of
from spikeloom.compiler.formats.nir.stages import (
    ALWAYS,
    KNOWN,
    STAGES,
    Steps,
    Value,
    added,
    require_step,
    spikes_of,
    stated_step,
    written_step,
)
from spikeloom.compiler.ir import INPUT, Input, Network, Sparse
from spikeloom.compiler.sensor_layout import sensor_layout
from spikeloom.compiler.types import IntArray

AXES, ELEMENTS = 8, 2**20
"""Of an input."""


def read_nir(
    path: str | os.PathLike[str],
    *,
    dt: float | None = None,
    convention: str | None = None,
    polarities: int | None = None,
    polarities_first: bool | None = None,
) -> ReadNetwork[Network]:
    """Read a network, in steps of `dt` seconds, by default those that the metadata of the file tell.

    The `convention` (``euler`` by default) says how time constants become decays, see :mod:`nir.stages`; polarities
    are those of :func:`sensor_layout.sensor_layout`.

    Raises ModelError if the file cannot be read, or holds something else than a network that spikes, feed-forward but
    for recurrent layers, naming the node; OptionError if there is no time step, or an option has no such value.
    """
    try:
        graph = graph_of(*read_hdf5(Path(path), "NIR file"))
        dt = stated_step(graph) if dt is None else dt
        if dt is None:
            written = written_step(graph)
            hint = "" if written is None else f", but its r is tau / {written:g}, as of steps of {written:g} s"
            raise OptionError(f"{path}: NIR keeps no time step{hint}; give --dt SECONDS")
        steps = Steps(dt=dt, convention=convention or CONVENTIONS[0])
        require_step(dt)
        with np.errstate(all="ignore"):  # what is not finite is refused at the end
            return network_of(graph, steps, polarities, polarities_first)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def network_of(
    graph: Graph, steps: Steps, polarities: int | None = None, polarities_first: bool | None = None
) -> ReadNetwork[Network]:
    """Network of a graph that was read; parameters and errors as of :func:`read_nir`, without the path."""
    entry, end = graph.one(INPUT_NODE), graph.one(OUTPUT_NODE)
    shape = tuple(entry.integers("shape").ravel().tolist()) if entry.has("shape") else ()
    if not shape or len(shape) > AXES or min(shape) < 1 or math.prod(shape) > ELEMENTS:
        raise entry.fail(f"has the shape {list(shape[:AXES])}, allowed are up to {ELEMENTS} values; export it again")
    sensor, positions, words = sensor_layout(shape, polarities=polarities, polarities_first=polarities_first)
    spiking, result = _walk(graph, steps, shape)
    if not spiking:
        raise ModelError("has no spiking neurons, so nothing can be counted; export a spiking network")
    voters, label = _readout(end, result, spiking)
    layers, held = _layers(spiking, positions)
    place = sum(len(other.groups) for other in spiking[:voters])
    layers, sensor = _with_held(layers, held, sensor)
    network = assemble(layers, sensor, place, label)
    facts = facts_of(graph, steps, spiking, f"input {printable(entry.name)}: {words}", sensor)
    facts.append(f"classes: the spikes of {printable(spiking[voters].node.name)} in output {printable(end.name)}")
    return ReadNetwork(network=network, facts=tuple(facts), sha256=graph.sha256, read_as=asdict(steps))


def _walk(graph: Graph, steps: Steps, shape: tuple[int, ...]) -> tuple[list[Neurons], Value]:
    """All spiking nodes in order, and what the output gets."""
    received: dict[str, list[str]] = {name: [] for name in graph.nodes}
    for source, target in graph.edges:
        received[target].append(source)
    values: dict[str, Value] = {}
    forward: list[Value] = []
    spiking: list[Neurons] = []
    late = loops(graph)
    for name in nodes_in_order(graph, late):
        node = graph.nodes[name]
        if node.type == INPUT_NODE:
            if received[name]:
                raise node.fail("gets values from other nodes; remove these edges")
            values[name] = spikes_of(INPUT, shape)
            continue
        with node.named():
            value = added([values[source] for source in received[name] if source not in late.get(name, ())])
        if node.type in SPIKING:
            values[name] = spikes_of(len(spiking), value.shape)
            spiking.append(neurons_of(node, value, steps))
            forward.append(value)
        elif node.type in STAGES:
            values[name] = STAGES[node.type](node, value, steps)
        else:
            known = ", ".join(sorted([*SPIKING, *STAGES]))
            raise node.fail(KNOWN.get(node.type, f"is of a type that is not known here, known are {known}; replace it"))
    for place, one in enumerate(spiking):
        if one.node.name in late:
            with one.node.named():
                value = added([forward[place], *(values[source] for source in late[one.node.name])])
            spiking[place] = neurons_of(one.node, value, steps)
            if len(one.groups) > 1:
                raise one.node.fail(
                    f"is recurrent and has {len(one.groups)} membrane time constants, which are layers of their own; "
                    "give it one"
                )
    return spiking, values[graph.one(OUTPUT_NODE).name]


def _layers(spiking: Sequence[Neurons], positions: IntArray) -> tuple[list[Layer], list[Sparse | None]]:
    """A layer for each decay of each node, and what flows into its currents in every step, (neurons, 1)."""
    first = np.cumsum([0, *(len(one.groups) for one in spiking)]).tolist()
    named = unique_names([one.node.name for one in spiking])
    layers: list[Layer] = []
    held = []
    for one, name in zip(spiking, named, strict=True):
        for number, rows in enumerate(one.groups, 1):
            # Neurons of other thresholds are those of one, with their weights and biases in its units.
            theta = float(one.theta[rows[0]])
            value = scaled(one.value, theta / one.theta)
            weights = {source: weight[rows] for source, weight in value.terms.items()}
            always = weights.pop(ALWAYS, None)
            sources: dict[int, Sparse] = {}
            for source, weight in weights.items():
                weight.eliminate_zeros()
                if source == INPUT:
                    sources[INPUT] = weight[:, positions]
                    continue
                for group, columns in enumerate(spiking[source].groups):
                    sources[first[source] + group] = weight[:, columns]
            reached = {source: weight for source, weight in sources.items() if weight.nnz}
            layers.append(
                Layer(
                    name=name if len(one.groups) == 1 else f"{name}_{number}",
                    beta=float(one.beta[rows[0]]),
                    theta=theta,
                    bias=value.bias[rows],
                    sources=reached if reached.keys() - {len(layers)} else sources,
                    alpha=value.alpha,
                )
            )
            held.append(always if always is not None and always.nnz else None)
    return layers, held


def _with_held(layers: list[Layer], held: list[Sparse | None], sensor: Input) -> tuple[list[Layer], Input]:
    """Let a channel that always has an event bring biases that go through a synaptic filter.

    The chip adds a bias past the current, where it acts in full from the first step on.
    """
    lasting = [index for index, channel in enumerate(held) if channel is not None]
    if not lasting:
        return layers, sensor
    depth: dict[int, int] = {INPUT: -1}
    for index in in_order(layers):
        depth[index] = max((depth[source] + 1 for source in layers[index].sources if source != index), default=0)

    def with_channel(size: int, weight: Sparse | None, channel: Sparse | None) -> Sparse:
        """Weights of the input into so many neurons, if there are any, and beside them those of the channel."""
        own = sparse.csr_array((size, sensor.size)) if weight is None else weight
        return sparse.hstack([own, sparse.csr_array((size, 1)) if channel is None else channel], format="csr")

    found = []
    for index, layer in enumerate(layers):
        sources, deep = dict(layer.sources), depth[index]
        if not deep or INPUT in sources:
            sources[INPUT] = with_channel(layer.size, sources.get(INPUT), None if deep else held[index])
        if deep and held[index] is not None:
            sources[len(layers) + deep - 1] = held[index]
        found.append(replace(layer, sources=sources))
    relay = sparse.csr_array([[RELAY_WEIGHT]])
    for step in range(max(depth[index] for index in lasting)):  # one a depth, on the way to the deepest
        source = len(layers) + step - 1 if step else INPUT
        weight = relay if step else with_channel(1, None, relay)
        name = f"always{step + 1}"
        found.append(Layer(name=name, beta=0.0, theta=1.0, bias=np.zeros(1), sources={source: weight}, relays=1))
    return found, replace(sensor, clocks=Clocks(channels=1, steps=MOST_STEPS))


def _readout(end: Node, result: Value, spiking: Sequence[Neurons]) -> tuple[int, IntArray]:
    """The spiking node whose spikes are counted, and the class of each of its neurons."""
    remedy = "end the network with a spiking layer, one neuron or one group of neurons a class"
    if result.alpha:
        raise end.fail(f"gets the membranes of a leaky integrator, a chip counts spikes; {remedy}")
    if len(result.terms) != 1 or INPUT in result.terms:
        raise end.fail(f"gets no count of the spikes of one layer; {remedy}")
    ((source, counts),) = result.terms.items()
    label = class_of_each(counts)
    if label is None or (result.bias.size and np.ptp(result.bias) > 0):
        raise end.fail(f"gets weighted spikes of {printable(spiking[source].node.name)}, a vote counts them; {remedy}")
    node = spiking[source].node
    if len(spiking[source].groups) > 1:
        raise node.fail(
            f"votes, and has {len(spiking[source].groups)} membrane time constants; give the last layer one"
        )
    return source, label
