"""Read an ONNX file as plain data, trusting nothing in it: no size, no path, no order.

Numbers are widened to float64, so that whatever the file computes from constants is recomputed there. A number that
stood in the program's text, a constant without dimensions or an attribute, is read as the shortest decimal that is
that float32 (0.2, not 0.200000003); the float32 model is the same, the float64 one is the one that was meant.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable

Array = npt.NDArray[Any]
"""float64, int64 or bool."""

SIZE_LIMIT = 2**28
"""Bytes that a file and its external data may have together: 256 MiB, as of a checkpoint."""

OPSETS = range(9, 27)
"""Versions of the operator set whose operators are known here."""

NODE_LIMIT = 200_000
DIMENSIONS = 16
NESTING = 8
"""Nodes of a file, dimensions of a value, and graphs within graphs that are read."""

BOOL, DOUBLE = 9, 11
NUMBERS = range(1, 14)
"""Element types by their number in the format."""

STRING = 8

SAME = {"MatMulInteger": "MatMul"}
"""Operators that are another one once their numbers are widened."""

_EXTERNAL = 1
DAMAGED = "is truncated or damaged; export it again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Declared:
    """An input as the file declares it; a word or None stands for a size that is not fixed."""

    name: str
    kind: int
    shape: tuple[int | str | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Node:
    """One operator. Attributes are int, float, str, arrays, lists of these, or a :class:`Graph`."""

    name: str
    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]

    def __str__(self) -> str:
        return f"node {printable(self.name)} ({printable(self.op)})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Graph:
    """A graph of operators; `constants` are its initialisers."""

    nodes: tuple[Node, ...]
    inputs: tuple[Declared, ...]
    outputs: tuple[str, ...]
    constants: Mapping[str, Array]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model:
    """A file: its graph, the version of its operators and the hash of all its bytes."""

    graph: Graph
    opset: int
    producer: str
    sha256: str


def decimal(value: Any) -> float:
    """The shortest decimal that is this float32.

    Examples
    --------
    >>> decimal(np.float32(0.2)), float(np.float32(0.2))
    (0.2, 0.20000000298023224)
    """
    return float(str(np.float32(value)))


def _text(value: str | bytes) -> str:
    """A name; protobuf gives bytes where it is no text."""
    return value.decode("utf-8", "backslashreplace") if isinstance(value, bytes) else value


def _texts(values: Iterable[str | bytes]) -> tuple[str, ...]:
    return tuple(_text(value) for value in values)


class _Content:
    """Bytes of a file and of the files beside it that it names, counted together."""

    def __init__(self, path: Path) -> None:
        self.folder = path.absolute().parent
        self.left = SIZE_LIMIT
        self.digest = hashlib.sha256()
        self.files: dict[str, bytes] = {}
        self.main = self._bytes(path, "")

    def external(self, name: str, entries: Iterable[Any]) -> bytes:
        """The part of a file beside this one that holds a tensor."""
        stated = {_text(entry.key): _text(entry.value) for entry in entries}
        location = stated.get("location", "")
        what = f"tensor {printable(name)}: its data lies in {printable(location)!r}"
        place = Path(location)
        # Links are followed before the folder is compared, so that none leads out of it.
        inside = location and not place.is_absolute() and "\0" not in location and "\\" not in location
        real = Path(os.path.realpath(self.folder / place)) if inside else place
        if not inside or not real.is_relative_to(os.path.realpath(self.folder)):
            raise ModelError(f"{what}, outside the folder of this file; allowed are files in it, do not trust this one")
        if location not in self.files:
            if not real.is_file():
                raise ModelError(f"{what}, which is not there; copy it beside this file")
            self.files[location] = self._bytes(real, f"{printable(location)}: ")
        content = self.files[location]
        try:
            offset = int(stated.get("offset", "0"))
            length = int(stated.get("length", str(len(content) - offset)))
        except ValueError as error:
            raise ModelError(f"{what} at an unreadable place; {DAMAGED}") from error
        if offset < 0 or length < 0 or offset + length > len(content):
            raise ModelError(f"{what} beyond its {len(content)} bytes; copy both files again")
        return content[offset : offset + length]

    def _bytes(self, path: Path, which: str) -> bytes:
        try:
            with path.open("rb") as file:
                content = file.read(self.left + 1)
        except OSError as error:
            raise ModelError(f"{which}cannot be read ({error.strerror or error}); check its permissions") from error
        self.left -= len(content)
        if self.left < 0:
            raise ModelError(f"{which}more than {SIZE_LIMIT} bytes, the limit of a network; export a smaller one")
        self.digest.update(content)
        return content


def read_model(path: Path) -> Model:
    """Read a file.

    Raises ModelError if it is no ONNX file, or names, sizes, types or places in it cannot be right; the message lacks
    the path.
    """
    from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
    from onnx import ModelProto

    if not path.is_file():
        raise ModelError("no such file; give a file of torch.onnx.export")
    content = _Content(path)
    proto = ModelProto()
    try:
        proto.ParseFromString(content.main)
    except (DecodeError, ValueError) as error:
        raise ModelError(f"is not an ONNX file, or {DAMAGED}") from error
    if not proto.HasField("graph"):
        raise ModelError("holds no graph, so it is not an ONNX file; give a file of torch.onnx.export")
    versions = [entry.version for entry in proto.opset_import if _text(entry.domain) in ("", "ai.onnx")]
    opset = versions[0] if versions else 1
    if opset not in OPSETS:
        raise ModelError(
            f"has operators of version {opset}, allowed are {OPSETS.start} to {OPSETS.stop - 1}; "
            "export it with opset_version=20"
        )
    counted = [NODE_LIMIT]
    graph = _graph(proto.graph, content, counted, NESTING)
    return Model(
        graph=graph, opset=opset, producer=printable(_text(proto.producer_name)), sha256=content.digest.hexdigest()
    )


def _graph(proto: Any, content: _Content, left: list[int], nesting: int) -> Graph:
    left[0] -= len(proto.node)
    if nesting == 0 or left[0] < 0:
        what = f"more than {NODE_LIMIT} nodes" if left[0] < 0 else f"graphs nested deeper than {NESTING}"
        raise ModelError(f"has {what}; export one step of the network instead of all")
    if len(proto.sparse_initializer) or len(proto.quantization_annotation):
        raise ModelError("has sparse or quantised constants; export the float network")
    constants: dict[str, Array] = {}
    for tensor in proto.initializer:
        if _text(tensor.name) in constants:
            raise ModelError(f"tensor {printable(_text(tensor.name))} is there twice; {DAMAGED}")
        constants[_text(tensor.name)] = _array(tensor, content)
    return Graph(
        nodes=tuple(_node(node, content, left, nesting) for node in proto.node),
        inputs=tuple(_declared(value) for value in proto.input if _text(value.name) not in constants),
        outputs=tuple(_text(value.name) for value in proto.output),
        constants=constants,
    )


def _declared(proto: Any) -> Declared:
    kind = proto.type.tensor_type
    shape: list[int | str | None] = []
    for dimension in kind.shape.dim:
        which = dimension.WhichOneof("value")
        size = None if which is None else getattr(dimension, which)
        shape.append(_text(size) if isinstance(size, bytes) else size)
    if len(shape) > DIMENSIONS or any(isinstance(size, int) and size < 0 for size in shape):
        raise ModelError(
            f"input {printable(_text(proto.name))}: has an impossible shape {tuple(shape[:DIMENSIONS])}; {DAMAGED}"
        )
    return Declared(name=_text(proto.name), kind=kind.elem_type, shape=tuple(shape))


def _node(proto: Any, content: _Content, left: list[int], nesting: int) -> Node:
    named = _text(proto.name or (proto.output[0] if proto.output else "?"))
    node = Node(
        name=named,
        op=SAME.get(_text(proto.op_type), _text(proto.op_type)),
        inputs=_texts(proto.input),
        outputs=_texts(proto.output),
        attributes={},
    )
    if _text(proto.domain) not in ("", "ai.onnx"):
        raise ModelError(
            f"{node}: is of the domain {printable(_text(proto.domain))}, allowed are the operators of ONNX itself; "
            "export without custom operators"
        )
    attributes = {}
    for entry in proto.attribute:
        match entry.type:
            case entry.FLOAT:
                value: Any = decimal(entry.f)
            case entry.INT:
                value = int(entry.i)
            case entry.STRING:
                value = entry.s.decode("utf-8", "replace")
            case entry.TENSOR:
                value = _array(entry.t, content)
            case entry.GRAPH:
                value = _graph(entry.g, content, left, nesting - 1)
            case entry.FLOATS:
                value = [decimal(number) for number in entry.floats]
            case entry.INTS:
                value = [int(number) for number in entry.ints]
            case _:
                raise ModelError(
                    f"{node}: attribute {printable(_text(entry.name))} is of a kind that is not known; {DAMAGED}"
                )
        attributes[_text(entry.name)] = value
    if node.op == "Dropout":  # passes on what it gets, outside training
        return replace(node, op="Identity", inputs=node.inputs[:1], outputs=node.outputs[:1])
    return replace(node, attributes=attributes)


def _array(proto: Any, content: _Content) -> Array:
    """A tensor, widened to float64, int64 or bool; its declared size is held against what the file has."""
    from onnx import helper, numpy_helper

    what = f"tensor {printable(_text(proto.name)) or '(no name)'}"
    if proto.data_type not in NUMBERS or proto.data_type == STRING:
        raise ModelError(f"{what}: has element type {proto.data_type}, allowed are numbers and truth values; {DAMAGED}")
    kind, shape = helper.tensor_dtype_to_np_dtype(proto.data_type), tuple(int(size) for size in proto.dims)
    if len(shape) > DIMENSIONS or any(size < 0 for size in shape):
        raise ModelError(f"{what}: has an impossible shape {shape[:DIMENSIONS]}; {DAMAGED}")
    if proto.data_location == _EXTERNAL:
        proto.raw_data = content.external(_text(proto.name), proto.external_data)
        proto.data_location = 0
    listed = getattr(proto, helper.tensor_dtype_to_field(proto.data_type))
    held = len(proto.raw_data) / kind.itemsize if proto.HasField("raw_data") else len(listed)
    if math.prod(shape) != held:
        raise ModelError(f"{what}: claims {math.prod(shape)} values, the file holds {held:g}; {DAMAGED}")
    try:
        return widened(numpy_helper.to_array(proto), what)
    except (OverflowError, TypeError, ValueError) as error:
        raise ModelError(f"{what}: holds numbers that its type cannot; {DAMAGED}") from error


def widened(array: Array, what: str) -> Array:
    """The same numbers as float64, int64 or bool."""
    if array.dtype == np.float32 and array.ndim == 0:
        return np.array(decimal(array))
    if array.dtype.kind == "f":
        return array.astype(np.float64)
    if array.dtype.kind == "b":
        return array.astype(np.bool_)
    if array.dtype == np.uint64 and np.any(array > np.iinfo(np.int64).max):
        raise ModelError(f"{what}: holds integers above 2**63; {DAMAGED}")
    return array.astype(np.int64)
