"""Read a spiking network from an ONNX file: one step with its state as inputs and outputs, or all steps unrolled.

The graph is run on values that vary, in float64: what is affine between two spiking layers becomes weights,
what is held against a threshold becomes a layer, and everything else is refused by name.
"""

import math
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import reading
from spikeloom.compiler.formats.affine import Affine
from spikeloom.compiler.formats.assemble import Layer, ReadNetwork, assemble
from spikeloom.compiler.formats.names import printable, unique_names
from spikeloom.compiler.formats.onnx.atoms import INPUT_ATOM, Table, as_affine, require_finite
from spikeloom.compiler.formats.onnx.file import BOOL, DOUBLE, Declared, Graph, read_graph
from spikeloom.compiler.formats.onnx.lif import Neurons, Unrolled, group, is_output, neurons_of, readout
from spikeloom.compiler.formats.onnx.operators import run
from spikeloom.compiler.formats.sensor_layout import order_of, sensor_layout
from spikeloom.compiler.ir import INPUT, Network, Sparse


def read_onnx(
    path: str | os.PathLike[str], *, polarities: int | None = None, polarities_first: bool | None = None
) -> ReadNetwork[Network]:
    """Read a network; polarities are as of :func:`sensor_layout.sensor_layout`.

    Data that the file keeps beside itself must lie in its folder.

    Raises ModelError if the file cannot be read, or holds something else than a feed-forward network of
    leaky integrate-and-fire neurons with affine stages, naming the operator; OptionError if there are no
    such polarities.
    """
    # A constant may divide by zero on its way, as degrees of lonely taxels do; what counts is checked at the
    # end.
    with reading(path, ModelError, "export it again"), np.errstate(all="ignore"):
        return _network(read_graph(Path(path)), polarities, polarities_first)


def _network(file: Graph, polarities: int | None, polarities_first: bool | None) -> ReadNetwork[Network]:
    table = Table(opset=file.opset)
    facts: list[str] = []
    graph, decided = _undecided(file, facts)
    shapes: dict[int, tuple[int, ...]] = {}
    given = {}
    for declared in graph.inputs:
        shape = _fixed(declared, facts)
        atom = table.atom(
            INPUT_ATOM, declared.name, math.prod(table.room(shape)), binary=declared.kind == BOOL
        )
        shapes[atom], given[declared.name] = shape, table.value(atom, shape)
    results = zip(graph.outputs, run(graph, given, table), strict=True)
    outputs = {name: as_affine(value) for name, value in results}
    for name, value in outputs.items():
        if (
            name in decided
            and value.shape
            and value.shape[decided[name] % len(value.shape)] != len(value.bias)
        ):
            raise ModelError(
                f"{printable(name)}: ArgMax along axis {decided[name]} of {list(value.shape)} is no decision; "
                "take it along the classes"
            )
        require_finite(value, f"output {printable(name)}: ")
    groups = group(table, neurons_of(table, outputs), shapes)
    _require_one_recording(groups, shapes)
    voters, label, counted = readout(table, groups, outputs)
    sensor, positions, words = sensor_layout(
        groups.shape, polarities=polarities, polarities_first=polarities_first
    )
    names = _names(graph, table, groups)
    double = any(declared.kind == DOUBLE for declared in graph.inputs)
    layers = [
        Layer(
            name=name,
            beta=layer[-1].beta or 0.0,
            theta=_threshold(layer[0], double=double),
            bias=layer[0].bias,
            sources={
                source: weight[:, positions] if source == INPUT else weight
                for source, weight in sources.items()
            },
        )
        for name, layer, sources in zip(names, groups.layers, groups.sources, strict=True)
    ]
    network = assemble(layers, sensor, voters, label, len(outputs[counted].bias))
    facts += _facts(file, table, groups, outputs, names, words)
    facts.append(f"classes: the spikes of {names[voters]} in output {printable(counted)}")
    read_as = order_of(sensor, positions)
    return ReadNetwork(network=network, facts=tuple(facts), sha256=file.sha256, read_as=read_as)


def _fixed(declared: Declared, facts: list[str]) -> tuple[int, ...]:
    """Shape of an input; an open size in front is the batch's."""
    if unknown := [size or "?" for size in declared.shape[1:] if not isinstance(size, int)]:
        raise ModelError(
            f"input {printable(declared.name)}: has an open size {unknown[0]!r}, allowed are fixed ones; export "
            "without dynamic axes"
        )
    for size in declared.shape[:1]:
        fact = f"the open size {size or '?'!r} is the batch's, read as 1"
        facts += [] if isinstance(size, int) or fact in facts else [fact]
    return tuple(size if isinstance(size, int) else 1 for size in declared.shape)


def _require_one_recording(found: Unrolled, shapes: Mapping[int, tuple[int, ...]]) -> None:
    """Refuse a batch: inputs of one size in front, and weights that mix none of its parts."""
    batches = {shape[0] if len(shape) > 1 else 1 for shape in shapes.values()}
    batch = max(batches)
    if len(shapes) == 1 or len(batches) > 1 or batch == 1:
        return
    weights = [weight for sources in found.sources for weight in sources.values()]
    if all(_is_apart(weight, batch) for weight in weights):
        raise ModelError(f"all inputs hold {batch} recordings; export it with a batch of 1")


def _is_apart(weight: Sparse, parts: int) -> bool:
    """Whether a matrix is block-diagonal, of so many blocks of one size."""
    if any(size % parts for size in weight.shape):
        return False
    rows, columns = weight.nonzero()
    return np.array_equal(rows * parts // weight.shape[0], columns * parts // weight.shape[1])


def _undecided(graph: Graph, facts: list[str]) -> tuple[Graph, dict[str, int]]:
    """The graph with what a decision is taken from in place of the decision: of most spikes, the lowest on a tie.

    Beside it the axis of each decision, by what it is taken from.
    """
    decided = {}
    makers = {name: node for node in graph.nodes for name in node.outputs}
    outputs = []
    for output in graph.outputs:
        name = output
        node = makers.get(output)
        if (
            node is not None
            and node.op == "ArgMax"
            and node.inputs
            and not node.attributes.get("select_last_index", 0)
        ):
            facts.append(
                f"output {printable(name)}: the class of the largest of {printable(node.inputs[0])}"
            )
            name = node.inputs[0]
            decided[name] = int(node.attributes.get("axis", 0))
        outputs += [] if name in outputs else [name]
    return replace(graph, outputs=tuple(outputs)), decided


def _threshold(neurons: Neurons, *, double: bool) -> float:
    """Threshold of a strict comparison: of ``u >= theta`` the next number below, in the arithmetic of the file."""
    if neurons.strict:
        return neurons.theta
    kind = np.float64 if double else np.float32
    return float(np.nextafter(kind(neurons.theta), kind(-np.inf)))


def _names(graph: Graph, table: Table, found: Unrolled) -> tuple[str, ...]:
    """Names of the modules that the layers' weights belong to, as far as the file keeps them."""
    makers = {name: node for node in graph.nodes for name in node.outputs}
    ends = {table.atoms[n.membrane].label for layer in found.layers for n in layer}
    names = []
    for layer in found.layers:
        pending = [table.atoms[layer[0].membrane].label]
        owners = []
        seen: set[str] = set()
        for name in pending:
            if name in graph.constants and re.search(r"[./]", name):
                owners.append(re.split(r"[./]", name)[:-1])
            if name in makers and name not in seen and not (name in ends and seen):
                seen.add(name)
                pending += makers[name].inputs
        shared = [words[0] for words in zip(*owners, strict=False) if len(set(words)) == 1]
        names.append(shared[-1] if shared and not shared[-1].isdecimal() else "")
    return unique_names(names)


def _facts(
    file: Graph,
    table: Table,
    found: Unrolled,
    outputs: Mapping[str, Affine],
    names: tuple[str, ...],
    words: str,
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
        n = layer[0]
        beta = layer[-1].beta or 0.0
        sign = ">" if n.strict else ">="
        line = f"layer {name}: {len(n.bias)} neurons, decay {beta:g}, fires at u {sign} {n.theta:g}"
        if n.previous is not None:
            reset_state = is_output(outputs, {n.membrane: 1.0}) or "after the reset"
            line += f", membrane {table.atoms[n.previous]} -> {printable(reset_state)}"
            used |= {n.previous} | ({n.gate} if n.gate is not None else set())
        if not n.strict:
            line += "; >= is read as > the next number below"
        facts.append(line)
    ignored = [
        printable(atom.label)
        for n, atom in enumerate(table.atoms)
        if atom.kind == INPUT_ATOM and n not in used
    ]
    return facts + ([f"inputs without effect on a spike: {', '.join(ignored)}"] if ignored else [])
