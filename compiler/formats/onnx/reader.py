"""Read a spiking network from an ONNX file: one step with its state as inputs and outputs, or all steps unrolled.

The graph is run on values that vary, in float64: what is affine between two spiking layers becomes weights, what is
held against a threshold becomes a layer, and everything else is refused by name.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.assemble import Layer, ReadNetwork, assemble
from spikeloom.compiler.formats.names import printable, unique_names
from spikeloom.compiler.formats.onnx.affine import INPUT_ATOM, Affine, Table, as_affine, require_finite
from spikeloom.compiler.formats.onnx.file import BOOL, DOUBLE, Declared, Graph, read_graph
from spikeloom.compiler.formats.onnx.lif import Neurons, is_output, neurons_of
from spikeloom.compiler.formats.onnx.run import inner, run
from spikeloom.compiler.formats.onnx.steps import Unrolled, group, readout
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.sensor_layout import sensor_layout

OPEN_STEPS = 3
"""Steps that are run where a file leaves their number open: two show what carries on, a third that it goes on so."""


def read_onnx(
    path: str | os.PathLike[str], *, polarities: int | None = None, polarities_first: bool | None = None
) -> ReadNetwork[Network]:
    """Read a network; polarities are as of :func:`sensor_layout.sensor_layout`.

    Data that the file keeps beside itself must lie in its folder.

    Raises ModelError if the file cannot be read, or holds something else than a feed-forward network of leaky
    integrate-and-fire neurons with affine stages, naming the operator; OptionError if there are no such polarities.
    """
    try:
        # A constant may divide by zero on its way, as degrees of lonely taxels do; what counts is checked at the end.
        with np.errstate(all="ignore"):
            return _network(read_graph(Path(path)), polarities, polarities_first)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def _network(file: Graph, polarities: int | None, polarities_first: bool | None) -> ReadNetwork[Network]:
    table = Table(opset=file.opset)
    facts: list[str] = []
    graph = _undecided(file, facts)
    loops = any(node.op == "Scan" for node in graph.nodes)
    shapes: dict[int, tuple[int, ...]] = {}
    given = {}
    for declared in graph.inputs:
        shape = _fixed(declared, graph, facts, loops=loops)
        atom = table.atom(INPUT_ATOM, declared.name, math.prod(table.room(shape)), binary=declared.kind == BOOL)
        shapes[atom], given[declared.name] = shape, table.value(atom, shape)
    results = zip(graph.outputs, run(graph, {}, given, table), strict=True)
    outputs = {name: as_affine(value) for name, value in results}
    for name, value in outputs.items():
        require_finite(value, f"output {printable(name)}: ")
    found = group(table, neurons_of(table, outputs), shapes)
    voters, label, counted = readout(table, found, outputs)
    sensor, positions, words = sensor_layout(found.shape, polarities=polarities, polarities_first=polarities_first)
    names = _names(graph, table, found)
    double = any(declared.kind == DOUBLE for declared in graph.inputs)
    layers = [
        Layer(
            name=name,
            beta=layer[-1].beta or 0.0,
            theta=_threshold(layer[0], double=double),
            bias=layer[0].bias,
            sources={source: weight[:, positions] if source == INPUT else weight for source, weight in sources.items()},
        )
        for name, layer, sources in zip(names, found.layers, found.sources, strict=True)
    ]
    network = assemble(layers, sensor, voters, label)
    facts += _facts(file, table, found, outputs, names, words)
    facts.append(f"classes: the spikes of {names[voters]} in output {printable(counted)}")
    return ReadNetwork(network=network, facts=tuple(facts), sha256=file.sha256)


def _fixed(declared: Declared, graph: Graph, facts: list[str], *, loops: bool) -> tuple[int, ...]:
    """Shape of an input; an open size in front is the batch's, or time and batch of a graph that loops over steps."""
    meanings = (f"time, read as {OPEN_STEPS} steps", "the batch's, read as 1") if loops else ("the batch's, read as 1",)
    shape: list[int] = []
    for axis, size in enumerate(declared.shape):
        if isinstance(size, int):
            shape.append(size)
            continue
        alone = all(size not in (*other.shape[:axis], *other.shape[axis + 1 :]) for other in graph.inputs)
        if axis >= len(meanings) or (size and not alone):
            raise ModelError(
                f"input {printable(declared.name)}: has an open size {size or '?'!r}, allowed are fixed ones; export "
                "without dynamic axes"
            )
        fact = f"the open size {size or '?'!r} is {meanings[axis]}"
        facts += [] if fact in facts else [fact]
        shape.append(OPEN_STEPS if loops and axis == 0 else 1)
    return tuple(shape)


def _undecided(graph: Graph, facts: list[str]) -> Graph:
    """The graph with what a decision is taken from in place of the decision: of most spikes, the lowest on a tie."""
    makers = {name: node for node in graph.nodes for name in node.outputs}
    outputs = []
    for output in graph.outputs:
        name, node = output, makers.get(output)
        if node is not None and node.op == "ArgMax" and node.inputs and not node.attributes.get("select_last_index", 0):
            facts.append(f"output {printable(name)}: the class of the largest of {printable(node.inputs[0])}")
            name = node.inputs[0]
        outputs += [] if name in outputs else [name]
    return replace(graph, outputs=tuple(outputs))


def _threshold(neurons: Neurons, *, double: bool) -> float:
    """Threshold of a strict comparison: of ``u >= theta`` the next number below, in the arithmetic of the file."""
    if neurons.strict:
        return neurons.theta
    if double:
        return float(np.nextafter(neurons.theta, -np.inf))
    return float(np.nextafter(np.float32(neurons.theta), np.float32(-np.inf)))


def _names(graph: Graph, table: Table, found: Unrolled) -> tuple[str, ...]:
    """Names of the modules that the layers' weights belong to, as far as the file keeps them."""
    graphs, makers = [graph], {}
    for each in graphs:
        makers.update({name: node for node in each.nodes for name in node.outputs})
        graphs += [part for node in each.nodes for part in inner(node)]
    parameters = {name for each in graphs for name in each.constants if re.search(r"[./]", name)}
    ends = {table.atoms[n.membrane].label for layer in found.layers for n in layer}
    names = []
    for layer in found.layers:
        seen: set[str] = set()
        pending = [table.atoms[layer[0].membrane].label]
        owners: list[list[str]] = []
        while pending:
            name = pending.pop()
            if name in parameters:
                owners.append(re.split(r"[./]", name)[:-1])
            if name in seen or name not in makers or (name in ends and seen):
                continue
            seen.add(name)
            pending += makers[name].inputs
        shared = [words[0] for words in zip(*owners, strict=False) if len(set(words)) == 1]
        names.append(shared[-1] if shared and not shared[-1].isdecimal() else "")
    return unique_names(names)


def _facts(
    file: Graph, table: Table, found: Unrolled, outputs: Mapping[str, Affine], names: tuple[str, ...], words: str
) -> list[str]:
    """What a reader of the file would want to check."""
    steps = len(found.layers[0])
    form = "one step, state in and out from zero" if steps == 1 else f"{steps} steps unrolled"
    facts = [
        f"{file.producer or 'unknown producer'}, operators of version {file.opset}: {form}",
        f"input {table.atoms[found.data]}: {words}",
    ]
    used = {found.data}
    for name, layer in zip(names, found.layers, strict=True):
        n, beta = layer[0], layer[-1].beta or 0.0
        sign = ">" if n.strict else ">="
        line = f"layer {name}: {len(n.bias)} neurons, decay {beta:g}, fires at u {sign} {n.theta:g}"
        if n.previous is not None:
            held = is_output(outputs, {n.membrane: 1.0}) or "after the reset"
            line += f", membrane {table.atoms[n.previous]} -> {printable(held)}"
            used |= {n.previous} | ({n.gate} if n.gate is not None else set())
        if not n.strict:
            line += "; >= is read as > the next number below"
        facts.append(line)
    ignored = [
        printable(atom.label) for index, atom in enumerate(table.atoms) if atom.kind == INPUT_ATOM and index not in used
    ]
    return facts + ([f"inputs without effect on a spike: {', '.join(ignored)}"] if ignored else [])
