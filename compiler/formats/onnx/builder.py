"""ONNX graphs under construction: nodes, constants, named inputs and outputs, and the model's bytes.

Operator set 17 with IR version 8, which onnxruntime reads since 1.13. Equal graphs give equal bytes.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import ModelError, OptionError

OPSET = 17
IR_VERSION = 8

SIZE_LIMIT = 2**31 - 2**20
"""Bytes of weights that a file of this format can hold, a little below protobuf's 2 GiB."""

Proto = Any
"""A message of the onnx package, which ships no types."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Port:
    """A named input or output; `shape` holds sizes and names of sizes, `kind` is a numpy type."""

    name: str
    kind: npt.DTypeLike
    shape: tuple[int | str, ...]


@dataclass(slots=True)
class Nodes:
    """Nodes in order, and the constants that they read; a body shares the constants of the graph around it."""

    nodes: list[Proto] = field(default_factory=list)
    constants: dict[str, npt.NDArray[Any]] = field(default_factory=dict)

    def inner(self) -> Nodes:
        """Nodes of a body, with the constants of this graph."""
        return Nodes(constants=self.constants)

    def constant(self, name: str, value: npt.ArrayLike, kind: npt.DTypeLike) -> str:
        """Hold an array under a name of its own; returns the name."""
        self.constants[name] = np.ascontiguousarray(value, dtype=kind).reshape(np.shape(value))
        return name

    def column(self, name: str, values: npt.NDArray[Any], kind: npt.DTypeLike) -> str:
        """Hold one number for each neuron, or a single number where all are the same; returns the name."""
        return self.constant(name, values[0] if np.all(values == values[0]) else values, kind)

    def add(
        self, operator: str, inputs: Sequence[str], output: str, attributes: Mapping[str, Any] | None = None
    ) -> str:
        """Append a node with one output; returns the output's name."""
        self.nodes.append(
            onnx_package().helper.make_node(operator, inputs, [output], name=output, **(attributes or {}))
        )
        return output

    def cast(self, source: str, output: str, kind: npt.DTypeLike) -> str:
        """Append a conversion to a numpy type."""
        return self.add("Cast", [source], output, {"to": proto_type(kind)})

    def scan(
        self,
        body: Nodes,
        states: Sequence[tuple[str, Port, str, str]],
        given: Sequence[tuple[str, Port]],
        kept: Sequence[tuple[Port, str]],
        name: str,
    ) -> None:
        """Append a loop over the first axis.

        body: what one iteration does.
        states: sequence of (start, port, next, last); what goes from one iteration to the next: its first value, what
            the body calls it, what the body leaves, and the name of what the last iteration leaves.
        given: sequence of (array, port); arrays that are cut along the first axis, and what the body calls a slice.
        kept: sequence of (port, array); what the body yields, and the name of all of them stacked.
        name: of the node and its body.
        """
        onnx = onnx_package()
        inputs = [value(port) for _, port, _, _ in states] + [value(port) for _, port in given]
        outputs = [value(Port(name=after, kind=port.kind, shape=port.shape)) for _, port, after, _ in states]
        outputs += [value(port) for port, _ in kept]
        self.nodes.append(
            onnx.helper.make_node(
                "Scan",
                [start for start, _, _, _ in states] + [array for array, _ in given],
                [last for _, _, _, last in states] + [array for _, array in kept],
                name=name,
                num_scan_inputs=len(given),
                body=onnx.helper.make_graph(body.nodes, f"{name}.body", inputs, outputs),
            )
        )


def package(name: str) -> Any:
    """Import ``onnx`` or ``onnxruntime``, which load slowly, when it is first needed.

    Raises OptionError if it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise OptionError(f"{name}: the package is not installed; install it with pip install {name}") from error


def onnx_package() -> Any:
    """The package ``onnx``."""
    return package("onnx")


def proto_type(kind: npt.DTypeLike) -> int:
    """Number that ONNX gives to a numpy type."""
    return int(onnx_package().helper.np_dtype_to_tensor_dtype(np.dtype(kind)))


def value(port: Port) -> Proto:
    """An input or output as a message."""
    return onnx_package().helper.make_tensor_value_info(port.name, proto_type(port.kind), list(port.shape))


def require_room(size: int) -> None:
    """Refuse weights that no file of this format can hold.

    Raises ModelError if they are more than ``SIZE_LIMIT`` bytes.
    """
    if size > SIZE_LIMIT:
        raise ModelError(
            f"onnx: the weights need {size} bytes as dense matrices, a file holds {SIZE_LIMIT}; "
            "export a smaller network"
        )


def model_bytes(
    graph: Nodes, inputs: Sequence[Port], outputs: Sequence[Port], *, name: str, about: str, facts: Mapping[str, Any]
) -> bytes:
    """Content of a model file; it has passed the checker of the ``onnx`` package.

    graph: nodes and constants.
    inputs, outputs: what the model takes and gives.
    name, about: of the graph; what it says about itself.
    facts: JSON values for the metadata, beside the version of this program.
    """
    onnx = onnx_package()
    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            name,
            [value(port) for port in inputs],
            [value(port) for port in outputs],
            [onnx.numpy_helper.from_array(array, key) for key, array in graph.constants.items()],
        ),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="spikeloom",
        producer_version=__version__,
        doc_string=about,
    )
    facts = {"version": __version__, **facts}
    for key in sorted(facts):
        entry = model.metadata_props.add()
        entry.key = key
        entry.value = facts[key] if isinstance(facts[key], str) else json.dumps(facts[key], sort_keys=True)
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString(deterministic=True)
    return content


def port_words(content: bytes) -> tuple[list[str], list[str]]:
    """Inputs and outputs of a model for people, such as ``events uint8 (time, batch, 78)``."""
    onnx = onnx_package()
    graph = onnx.load_from_string(content).graph

    def words(ports: Any) -> list[str]:
        found = []
        for port in ports:
            kind = onnx.helper.tensor_dtype_to_np_dtype(port.type.tensor_type.elem_type)
            sizes = [str(size.dim_param or size.dim_value) for size in port.type.tensor_type.shape.dim]
            found.append(f"{port.name} {kind.name} ({', '.join(sizes)})")
        return found

    return words(graph.input), words(graph.output)


def read_sizes(graph: Nodes) -> None:
    """Read ``duration`` and ``batch`` from the ``events`` (time, batch, channels); one number each."""
    graph.add("Shape", ["events"], "duration", {"start": 0, "end": 1})
    graph.add("Shape", ["events"], "batch", {"start": 1, "end": 2})


def rest(graph: Nodes, port: Port) -> str:
    """Zeros for a state, (batch, neurons) or a scalar, at the start of recordings."""
    if not port.shape:
        return graph.constant(f"{port.name}/rest", 0, port.kind)
    size = graph.constant(f"{port.name}/size", port.shape[1:], np.int64)
    return zeros(graph, f"{port.name}/rest", port.kind, ["batch", size])


def zeros(graph: Nodes, name: str, kind: npt.DTypeLike, sizes: list[str]) -> str:
    """Zeros of these sizes."""
    return _filled(graph, name, graph.constant(f"{name}/zero", 0, kind), sizes)


def _filled(graph: Nodes, name: str, value: str, sizes: list[str]) -> str:
    return graph.add("Expand", [value, graph.add("Concat", sizes, f"{name}/shape", {"axis": 0})], name)


def counted(graph: Nodes, name: str, size: int) -> list[Port]:
    """Count the spikes of a layer, whose trains have its name; returns trains and counts as outputs."""
    trains = Port(name=f"{name}.spikes", kind=np.uint8, shape=("time", "batch", size))
    counts = Port(name=f"{name}.counts", kind=np.int32, shape=("batch", size))
    # a product with ones adds up bytes ten times faster than ReduceSum, which wants them as int32
    row = [graph.constant("single", [1], np.int64), "duration"]
    ones = _filled(graph, f"{name}/ones", graph.constant("one", 1, np.uint8), row)
    flat = graph.add("Reshape", [trains.name, graph.constant("flat", [0, -1], np.int64)], f"{name}/flat")
    total = graph.add("MatMulInteger", [ones, flat], f"{name}/total")
    graph.add("Reshape", [total, graph.constant(f"{name}.counts/form", [-1, size], np.int64)], counts.name)
    return [trains, counts]


def decided(graph: Nodes, classes: int) -> list[Port]:
    """Choose the class with most ``votes``, the lowest on a tie; returns both as outputs."""
    graph.add("ArgMax", ["votes"], "class", {"axis": 1, "keepdims": 0})
    return [
        Port(name="votes", kind=np.int32, shape=("batch", classes)),
        Port(name="class", kind=np.int64, shape=("batch",)),
    ]
