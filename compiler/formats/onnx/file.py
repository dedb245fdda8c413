"""Read an ONNX file as plain data, trusting nothing in it: no size, no path, no order.

Numbers are widened to float64, so that whatever the file computes from constants is recomputed there. A
number that stood in the program's text, a constant without dimensions or an attribute, is read as the
shortest decimal that is that float32 (0.2, not 0.200000003); the float32 model is the same, the float64 one
is the one that was meant.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import FileFault, read_whole, require_size
from spikeloom.compiler.formats.names import named, printable
from spikeloom.compiler.types import AnyArray

PRODUCER = "spikeloom"
"""Producer of the files that are written here, from netlists."""

OPSETS = range(9, 27)
"""Versions of the operator set whose operators are known here."""

NODE_LIMIT = 200_000
"""Nodes of a file."""

BOOL = 9
DOUBLE = 11
"""Element types by their number in the format."""

DAMAGED = "is truncated or damaged; export it again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Declared:
    """An input as the file declares it."""

    name: str
    kind: int
    shape: tuple[int | str | None, ...]  # a word or None stands for a size that is not fixed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Node:
    """One operator. Attributes are int, float, str, arrays, or lists of these."""

    name: str
    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]

    def __str__(self) -> str:
        return f"node {printable(self.name)} ({printable(self.op)})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Graph:
    """The operators of a file; `constants` are its initialisers."""

    nodes: tuple[Node, ...]
    inputs: tuple[Declared, ...]
    outputs: tuple[str, ...]
    constants: Mapping[str, AnyArray]  # float64, int64 or bool
    opset: int  # version of its operators
    producer: str
    sha256: str  # of all its bytes


def decimal(value: Any) -> float:
    """The shortest decimal that is this float32.

    >>> decimal(np.float32(0.2)), float(np.float32(0.2))
    (0.2, 0.20000000298023224)
    """
    return float(str(np.float32(value)))


def _text(value: str | bytes) -> str:
    """A name; protobuf gives bytes where it is no text."""
    return value.decode("utf-8", "backslashreplace") if isinstance(value, bytes) else value


def read_graph(path: Path) -> Graph:
    """Read a file.

    Raises ModelError if it is no ONNX file, or names, sizes, types or places in it cannot be right; the
    message lacks the path.
    """
    from onnx import ModelProto

    content = read_whole(path, "network")
    proto = ModelProto()
    proto.ParseFromString(content)
    if not proto.HasField("graph"):
        raise ModelError("holds no graph, so it is not an ONNX file; give a file of torch.onnx.export")
    if proto.producer_name == PRODUCER:
        raise ModelError("was written by spikeloom export; use the netlist that it was written from")
    versions = [entry.version for entry in proto.opset_import if _text(entry.domain) in ("", "ai.onnx")]
    opset = versions[0] if versions else 1
    if opset not in OPSETS:
        raise ModelError(
            f"has operators of version {opset}, allowed are {OPSETS.start} to {OPSETS.stop - 1}; "
            "export it with opset_version=20"
        )
    graph = proto.graph
    if len(graph.node) > NODE_LIMIT:
        raise ModelError(f"has more than {NODE_LIMIT} nodes; export one step of the network instead of all")
    if graph.sparse_initializer:
        raise ModelError("keeps constants as sparse tensors, which are not read; export it with dense ones")
    digest = hashlib.sha256(content)
    _bring_data(graph, path.absolute().parent, digest)
    _check(proto)
    constants = {_text(tensor.name): _array(tensor) for tensor in graph.initializer}
    return Graph(
        nodes=tuple(map(_node, graph.node)),
        inputs=tuple(_declared(value) for value in graph.input if _text(value.name) not in constants),
        outputs=tuple(_text(value.name) for value in graph.output),
        constants=constants,
        opset=opset,
        producer=printable(_text(proto.producer_name)),
        sha256=digest.hexdigest(),
    )


def _bring_data(graph: Any, folder: Path, digest: Any) -> None:
    """Put data that lie beside the file into its tensors; the onnx package refuses places outside the folder."""
    from onnx.external_data_helper import load_external_data_for_tensor

    total = 0
    tensors = (attribute.t for node in graph.node for attribute in node.attribute if attribute.HasField("t"))
    for tensor in chain(graph.initializer, tensors):
        if tensor.data_location != tensor.EXTERNAL:
            continue
        entries = {entry.key: entry.value for entry in tensor.external_data}
        location, length = (entries.get(key, "") for key in ("location", "length"))
        with named(
            f"tensor {printable(_text(tensor.name))} in {printable(_text(location))!r} beside the file"
        ):
            if not (place := folder / _text(location)).is_file():  # onnx would wait for a pipe
                raise FileFault("no such file")
            total += (
                int(length) if length.isdecimal() else 0
            ) or place.stat().st_size  # many may share a file
            require_size(total, "network")
            load_external_data_for_tensor(tensor, str(folder))
        digest.update(tensor.raw_data)


def _check(proto: Any) -> None:
    """Refuse what ONNX's own checker does: names that nothing makes, operators out of order, tensors cut short."""
    from onnx import checker

    for output in proto.graph.output:  # their shapes may be unknown
        output.type.tensor_type.shape.SetInParent()
    checker.check_model(proto)


def _declared(proto: Any) -> Declared:
    kind = proto.type.tensor_type
    shape: list[int | str | None] = []
    for dimension in kind.shape.dim:
        which = dimension.WhichOneof("value")
        size = None if which is None else getattr(dimension, which)
        shape.append(_text(size) if isinstance(size, bytes) else size)
    return Declared(name=_text(proto.name), kind=kind.elem_type, shape=tuple(shape))


def _node(proto: Any) -> Node:
    node = Node(
        name=_text(proto.name or (proto.output[0] if proto.output else "?")),
        op=_text(proto.op_type),
        inputs=tuple(map(_text, proto.input)),
        outputs=tuple(map(_text, proto.output)),
        attributes={},
    )
    with named(node):
        if _text(proto.domain) not in ("", "ai.onnx"):
            raise ModelError(
                f"is of the domain {printable(_text(proto.domain))}, allowed are the operators of ONNX itself; "
                "export without custom operators"
            )
        return replace(node, attributes={_text(entry.name): _attribute(entry) for entry in proto.attribute})


def _attribute(entry: Any) -> Any:
    match entry.type:
        case entry.FLOAT:
            return decimal(entry.f)
        case entry.INT:
            return int(entry.i)
        case entry.STRING:
            return entry.s.decode("utf-8", "replace")
        case entry.TENSOR:
            return _array(entry.t)
        case entry.GRAPH:
            raise ModelError("holds a graph, a loop or a choice; export one step, or unroll all of them")
        case entry.FLOATS:
            return [decimal(number) for number in entry.floats]
        case entry.INTS:
            return [int(number) for number in entry.ints]
    raise ModelError(f"attribute {printable(_text(entry.name))} is of a kind that is not known; {DAMAGED}")


def _array(proto: Any) -> AnyArray:
    """A tensor, its numbers widened to float64, int64 or bool."""
    from onnx import numpy_helper

    what = f"tensor {printable(_text(proto.name)) or '(no name)'}"
    with named(what):
        array = numpy_helper.to_array(proto)
    if array.dtype.kind not in "bfiu":
        raise ModelError(
            f"{what}: has element type {proto.data_type}, allowed are numbers and truth values; {DAMAGED}"
        )
    if array.dtype.kind == "f":
        return (
            array.astype(np.float64) if array.ndim or array.dtype != np.float32 else np.array(decimal(array))
        )
    if array.dtype == np.uint64 and np.any(array > np.iinfo(np.int64).max):
        raise ModelError(f"{what}: holds integers above 2**63; {DAMAGED}")
    return array.astype(np.bool_ if array.dtype.kind == "b" else np.int64)
