"""ONNX graphs under construction: nodes, constants, named inputs and outputs, and the model's bytes.

Operator set 17 with IR version 8, which onnxruntime reads since 1.13. Equal graphs give equal bytes.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import __version__
from spikeloom.compiler.formats.onnx.file import PRODUCER
from spikeloom.compiler.types import AnyArray

OPSET = 17
IR_VERSION = 8

INNER = "step/"
"""Names inside the loop over steps start with this."""

END = 2**63 - 1
"""A slice with this end reaches to the end of its axis."""

Constant = AnyArray | np.generic

Proto = Any
"""A message of the onnx package, which ships no types."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Port:
    """A named input or output; `shape` holds sizes and names of sizes, `kind` is a numpy type."""

    name: str
    kind: npt.DTypeLike
    shape: tuple[int | str, ...]

    def __str__(self) -> str:
        return f"{self.name} {np.dtype(self.kind).name} ({', '.join(map(str, self.shape))})"


def one_each(values: AnyArray, kind: npt.DTypeLike) -> Constant:
    """One number for each neuron, or a single number where all are the same."""
    return (values[0] if np.all(values == values[0]) else values).astype(kind)


@dataclass(slots=True)
class Nodes:
    """Nodes in order, and the constants that they read."""

    nodes: list[Proto] = field(default_factory=list)
    constants: dict[str, AnyArray] = field(default_factory=dict)

    def constant(self, name: str, value: Constant) -> str:
        """Hold an array for several nodes; returns its name."""
        self.constants[name] = np.asarray(value, order="C")
        return name

    def add(self, operator: str, inputs: Sequence[str | Constant], output: str, **attributes: Any) -> str:
        """Append a node with one output; constants among its inputs are held. Returns the output's name."""
        names = [
            given if isinstance(given, str) else self.constant(f"{output}/input{place}", given)
            for place, given in enumerate(inputs)
        ]
        self.nodes.append(_onnx().helper.make_node(operator, names, [output], name=output, **attributes))
        return output

    def cast(self, source: str, output: str, kind: npt.DTypeLike) -> str:
        """Append a conversion to a numpy type."""
        return self.add("Cast", [source], output, to=_type(kind))

    def filled(self, name: str, value: Constant, sizes: Sequence[str | Constant]) -> str:
        """Append an array of one number everywhere."""
        return self.add("Expand", [value, self.add("Concat", sizes, f"{name}/shape", axis=0)], name)

    def graph(self, name: str, inputs: Sequence[Port], outputs: Sequence[Port]) -> Proto:
        """All of it as a message."""
        onnx = _onnx()
        ends = [
            [
                onnx.helper.make_tensor_value_info(port.name, _type(port.kind), list(port.shape))
                for port in side
            ]
            for side in (inputs, outputs)
        ]
        constants = [onnx.numpy_helper.from_array(array, key) for key, array in self.constants.items()]
        return onnx.helper.make_graph(self.nodes, name, *ends, constants)


Model = tuple[Nodes, list[Port], list[Port]]
"""Nodes, inputs and outputs. Inputs of the form ``step`` are ``events`` (batch, channels), ``length``, then states."""


def _onnx() -> Any:
    """The package, which loads slowly, so only where it is needed."""
    import onnx

    return onnx


def _type(kind: npt.DTypeLike) -> int:
    return int(_onnx().helper.np_dtype_to_tensor_dtype(np.dtype(kind)))


def whole_recordings(step: Model, layers: Mapping[str, tuple[int, int]], classes: int) -> Model:
    """The form ``scan`` of a form ``step``: a loop over its steps, as many more as the deepest layer lags behind.

    step: with ``LAYER/fired`` (bool) in its nodes; may read ``length``, the data steps.
    layers: neurons and depth of each layer by name; its spikes are shifted back by its depth.
    classes: for the votes.
    """
    onnx = _onnx()
    nodes, inputs, left = step
    states = inputs[2:]
    channels = inputs[0].shape[1]
    drain = max(depth for _, depth in layers.values())
    graph = Nodes()
    sequence = "events"
    graph.add("Shape", ["events"], "duration", start=0, end=1)
    graph.add("Shape", ["events"], "batch", start=1, end=2)
    graph.add("Squeeze", ["duration"], "length")
    if drain:
        tail = graph.filled("tail", np.uint8(0), [np.array([drain]), "batch", np.array([channels])])
        sequence = graph.add("Concat", ["events", tail], "filled", axis=0)
    begun = [
        graph.filled(f"{state.name}/rest", np.zeros((), state.kind), ["batch", np.array(state.shape[1:])])
        if state.shape
        else graph.constant(f"{state.name}/rest", np.zeros((), state.kind))
        for state in states
    ]
    kept = [
        Port(name=f"{name}/fired", kind=np.bool_, shape=("batch", size))
        for name, (size, _) in layers.items()
    ]
    body = nodes.graph("steps", [*states, inputs[0]], [*left, *kept])
    graph.nodes.append(
        onnx.helper.make_node(
            "Scan",
            [*begun, sequence],
            [*(port.name if port.name == "votes" else f"{port.name}/last" for port in states)]
            + [f"{port.name}/steps" for port in kept],
            name="steps",
            num_scan_inputs=1,
            body=onnx.compose.add_prefix_graph(body, INNER),
        )
    )
    outputs = []
    for name, (size, depth) in layers.items():
        trains = f"{name}/fired/steps"
        if drain:
            ends = np.array([depth]), np.array([depth - drain or END])
            trains = graph.add("Slice", [trains, *ends], f"{name}/trains")
        graph.cast(trains, f"{name}.spikes", np.uint8)
        outputs += [
            Port(name=f"{name}.spikes", kind=np.uint8, shape=("time", "batch", size)),
            Port(name=_counted(graph, name, size), kind=np.int32, shape=("batch", size)),
        ]
    if any(state.name == "votes" for state in states):
        graph.add("ArgMax", ["votes"], "class", axis=1, keepdims=0)  # the lowest on a tie
        outputs.append(Port(name="votes", kind=np.int32, shape=("batch", classes)))
        outputs.append(Port(name="class", kind=np.int64, shape=("batch",)))
    return graph, [Port(name="events", kind=np.uint8, shape=("time", "batch", channels))], outputs


def _counted(graph: Nodes, name: str, size: int) -> str:
    """Spikes of a recording. A product with ones adds up bytes ten times faster than ReduceSum, which wants int32."""
    ones = graph.filled(f"{name}/ones", np.uint8(1), [np.array([1]), "duration"])
    flat = graph.add("Reshape", [f"{name}.spikes", np.array([0, -1])], f"{name}/flat")
    total = graph.add("MatMulInteger", [ones, flat], f"{name}/total")
    return graph.add("Reshape", [total, np.array([-1, size])], f"{name}.counts")


def model_bytes(model: Model, *, name: str, about: str, facts: Mapping[str, Any]) -> bytes:
    """Content of a model file; it has passed the checker of the ``onnx`` package.

    name, about: of the graph; what it says about itself.
    facts: JSON values for the metadata, beside the version of this program.
    """
    onnx = _onnx()
    nodes, inputs, outputs = model
    message = onnx.helper.make_model(
        nodes.graph(name, inputs, outputs),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name=PRODUCER,
        producer_version=__version__,
        doc_string=about.replace("``", ""),
    )
    facts = {"version": __version__, **facts}
    words = {
        k: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        for k, value in facts.items()
    }
    onnx.helper.set_model_props(message, dict(sorted(words.items())))
    onnx.checker.check_model(message, full_check=True)
    content: bytes = message.SerializeToString(deterministic=True)
    return content
