"""Time in graphs over whole recordings: how long they are, states at rest, spikes counted, a class chosen."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spikeloom.runtime.formats.onnx_nodes import Nodes, Port


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
