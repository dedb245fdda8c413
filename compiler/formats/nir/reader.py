"""Read a spiking network from a NIR file: affine stages become weights, in float64, spiking nodes become layers."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse

from spikeloom.compiler.dynamics import MOST_STEPS, RELAY_WEIGHT, Clocks
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.assemble import Layer, assemble, class_of_each, in_order
from spikeloom.compiler.formats.names import printable, unique_names
from spikeloom.compiler.formats.nir.facts import SpikingNode, facts_of, hint, stated_step
from spikeloom.compiler.formats.nir.file import Graph, Node, read_graph
from spikeloom.compiler.formats.nir.neurons import CONVENTIONS, SPIKING, TOLERANCE, Steps, neurons_of, require_steps
from spikeloom.compiler.formats.nir.order import in_order as nodes_in_order
from spikeloom.compiler.formats.nir.order import loops
from spikeloom.compiler.formats.nir.stages import KNOWN, STAGES, Value, added, filtered, scaled, spikes_of
from spikeloom.compiler.ir import INPUT, Input, Network, Sparse
from spikeloom.compiler.sensor_layout import sensor_layout
from spikeloom.compiler.types import FloatArray, IntArray

SUFFIX = ".nir"

MOST_DECAYS = 16
"""Membrane decays within a node; each becomes a layer of its own. A core holds 32."""

AXES, ELEMENTS = 8, 2**20
"""Of an input."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NirNetwork:
    """A network, and what was found about the file that it is from."""

    network: Network  # In float64
    facts: tuple[str, ...]  # What was read and what was assumed, for people
    sha256: str  # Of the file
    steps: Steps  # How time constants were read


def read_nir(
    path: str | os.PathLike[str],
    *,
    dt: float | None = None,
    convention: str | None = None,
    polarities: int | None = None,
    polarities_first: bool | None = None,
) -> NirNetwork:
    """Read a network, in steps of `dt` seconds, by default those that the metadata of the file tell.

    The `convention` (``euler`` by default) says how time constants become decays, see :mod:`nir.neurons`; polarities
    are those of :func:`sensor_layout.sensor_layout`.

    Raises
    ------
    ModelError
        If the file cannot be read, or holds something else than a network that spikes, feed-forward but for recurrent
        layers; the message names the node.
    OptionError
        If there is no time step, or an option has no such value.
    """
    try:
        graph = read_graph(Path(path))
        dt = stated_step(graph) if dt is None else dt
        if dt is None:
            raise OptionError(f"{path}: NIR keeps no time step{hint(graph)}; give --dt SECONDS")
        steps = Steps(dt=dt, convention=convention or CONVENTIONS[0])
        require_steps(dt)
        with np.errstate(all="ignore"):  # what is not finite is refused at the end
            return network_of(graph, steps, polarities, polarities_first)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def network_of(
    graph: Graph, steps: Steps, polarities: int | None = None, polarities_first: bool | None = None
) -> NirNetwork:
    """Network of a graph that was read; parameters and errors as of :func:`read_nir`, without the path."""
    entry, end = graph.one("Input"), graph.one("Output")
    shape = entry.whole("shape") if entry.has("shape") else ()
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
    return NirNetwork(network=network, facts=tuple(facts), sha256=graph.sha256, steps=steps)


def _walk(graph: Graph, steps: Steps, shape: tuple[int, ...]) -> tuple[list[SpikingNode], Value]:
    """All spiking nodes in order, and what the output gets."""
    received: dict[str, list[str]] = {name: [] for name in graph.nodes}
    for source, target in graph.edges:
        received[target].append(source)
    values: dict[str, Value] = {}
    forward: dict[str, Value] = {}
    spiking: list[SpikingNode] = []
    result: Value | None = None
    late = loops(graph)
    for name in nodes_in_order(graph, late):
        node = graph.nodes[name]
        if node.type == "Input":
            if received[name]:
                raise node.fail("gets values from other nodes; remove these edges")
            values[name] = spikes_of(INPUT, shape)
            continue
        with node.named():
            value = added([values[source] for source in received[name] if source not in late.get(name, ())])
        if node.type in SPIKING:
            values[name] = spikes_of(len(spiking), value.shape)
            spiking.append(_spiking(node, value, steps))
            forward[name] = value
        elif node.type in STAGES:
            values[name] = STAGES[node.type](node, value, steps)
        else:
            known = ", ".join(sorted([*SPIKING, *STAGES]))
            raise node.fail(KNOWN.get(node.type, f"is of a type that is not known here, known are {known}; replace it"))
        if node.type == "Output":
            result = values[name]
    assert result is not None, "there is one output"
    for place, one in enumerate(spiking):
        name = one.node.name
        if name in late:
            with one.node.named():
                value = added([forward[name], *(values[source] for source in late[name])])
            spiking[place] = replace(_spiking(one.node, value, steps), recurrent=True)
            if len(one.groups) > 1:
                raise one.node.fail(
                    f"is recurrent and has {len(one.groups)} membrane time constants, which are layers of their own; "
                    "give it one"
                )
    return spiking, result


def _spiking(node: Node, value: Value, steps: Steps) -> SpikingNode:
    if not value.size:
        raise node.fail("has no neurons; export it again")
    neurons = neurons_of(node, value.size, value.shape, steps)
    own = scaled(value, neurons.gain)
    if neurons.alpha:
        with node.named():
            own = filtered(value, neurons.alpha, neurons.gain, np.zeros(value.size))
    decays = np.round(neurons.beta / TOLERANCE).astype(np.int64)
    different = np.unique(decays)
    if len(different) > MOST_DECAYS:
        raise node.fail(
            f"has {len(different)} different membrane time constants, {MOST_DECAYS} are allowed in a node; train with "
            "fewer"
        )
    groups = [np.flatnonzero(decays == decay) for decay in different]
    return SpikingNode(node=node, value=own, neurons=neurons, groups=groups, recurrent=False)


def _layers(spiking: Sequence[SpikingNode], positions: IntArray) -> tuple[list[Layer], list[FloatArray]]:
    """A layer for each decay of each node, and what flows into the currents of its neurons in every step."""
    first = np.cumsum([0, *(len(one.groups) for one in spiking)]).tolist()
    named = unique_names([one.node.name for one in spiking])
    layers: list[Layer] = []
    held = []
    for one, name in zip(spiking, named, strict=True):
        for number, rows in enumerate(one.groups, 1):
            place = len(layers)
            # Neurons of other thresholds are those of one, with their weights and biases in its units.
            theta = float(one.neurons.theta[rows[0]])
            units = theta / one.neurons.theta[rows]
            sources: dict[int, Sparse] = {}
            for source, weight in one.value.terms.items():
                own = _rows_scaled(weight[rows], units)
                if source == INPUT:
                    sources[INPUT] = own[:, positions]
                    continue
                for group, columns in enumerate(spiking[source].groups):
                    sources[first[source] + group] = own[:, columns]
            reached = {source: weight for source, weight in sources.items() if weight.nnz}
            if not reached.keys() - {place}:
                reached = sources
            for weight in reached.values():
                weight.sort_indices()
            layers.append(
                Layer(
                    name=name if len(one.groups) == 1 else f"{name}_{number}",
                    beta=float(one.neurons.beta[rows[0]]),
                    theta=theta,
                    bias=(one.value.bias + one.neurons.drive)[rows] * units,
                    sources=reached,
                    alpha=one.value.alpha,
                )
            )
            held.append(one.value.held[rows] * units)
    return layers, held


def _rows_scaled(weight: Sparse, factor: FloatArray) -> Sparse:
    scaled_rows = weight.copy()
    scaled_rows.data = scaled_rows.data * np.repeat(factor, np.diff(weight.indptr))
    scaled_rows.eliminate_zeros()
    return scaled_rows


def _with_held(layers: list[Layer], held: list[FloatArray], sensor: Input) -> tuple[list[Layer], Input]:
    """Let a channel that always has an event bring biases that go through a synaptic filter.

    The chip adds a bias past the current, where it acts in full from the first step on.
    """
    lasting = [index for index, values in enumerate(held) if np.any(values)]
    if not lasting:
        return layers, sensor
    depth: dict[int, int] = {INPUT: -1}
    for index in in_order(layers):
        depth[index] = max((depth[source] + 1 for source in layers[index].sources if source != index), default=0)
    clocked = replace(sensor, clocks=Clocks(channels=1, steps=MOST_STEPS))
    found = []
    relays = range(max(depth[index] for index in lasting))  # one a depth, on the way to the deepest
    for index, layer in enumerate(layers):
        sources = dict(layer.sources)
        own = held[index] if index in lasting else np.zeros(len(layer.bias))
        column = _column(own)
        if INPUT in sources:
            sources[INPUT] = _beside(sources[INPUT], _column(own if not depth[index] else 0 * own))
        elif not depth[index]:
            sources[INPUT] = _beside(_column(np.zeros(len(own)), sensor.size), column)
        if depth[index] and index in lasting:
            sources[len(layers) + depth[index] - 1] = column
        found.append(replace(layer, sources=sources))
    for step in relays:
        weight = _column(np.array([RELAY_WEIGHT]))
        if not step:
            weight = _beside(_column(np.zeros(1), sensor.size), weight)
        found.append(
            Layer(
                name=f"always{step + 1}",
                beta=0.0,
                theta=1.0,
                bias=np.zeros(1),
                sources={INPUT if not step else len(layers) + step - 1: weight},
                relays=1,
            )
        )
    return found, clocked


def _column(values: FloatArray, width: int = 1) -> Sparse:
    """csr_array whose first column is given, the others empty."""
    rows = np.flatnonzero(values)
    return sparse.csr_array((values[rows], (rows, np.zeros(len(rows), np.int64))), shape=(len(values), width))


def _beside(left: Sparse, right: Sparse) -> Sparse:
    both = sparse.csr_array(sparse.hstack([left, right], format="csr"))
    both.sort_indices()
    return both


def _readout(end: Node, result: Value, spiking: Sequence[SpikingNode]) -> tuple[int, IntArray]:
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
