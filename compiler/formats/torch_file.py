"""Read what ``torch.save`` writes as data, without torch: numbers, texts, lists, dicts, tensors.

A file is a pickle and the bytes of its tensors' storages: in a zip, or, before torch 1.6, one behind the other.
Pickle is a language of instructions. :mod:`pickletools` lists them and runs nothing; the few that plain tensors need
are followed here. A name of code is compared with those of `CODE` and never looked up.
"""

import io
import math
import pickletools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from spikeloom.compiler.archive import stored_members
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import FileFault
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.types import AnyArray

MOST_INSTRUCTIONS = 10**6
"""Of a pickle; a state dict has some twenty a tensor."""

NEWER = 4
"""A protocol of pickle: torch writes one before."""

MAGIC = (119547037146038801333356, 1001)
"""First two values of the format before torch 1.6."""

KINDS = {
    "Float": ("float32", "<f4"),
    "Double": ("float64", "<f8"),
    "Half": ("float16", "<f2"),
    "BFloat16": ("bfloat16", "<u2"),
    "Long": ("int64", "<i8"),
    "Int": ("int32", "<i4"),
    "Short": ("int16", "<i2"),
    "Char": ("int8", "i1"),
    "Byte": ("uint8", "u1"),
    "Bool": ("bool", "?"),
}
"""Kinds of numbers: as torch calls them, and numpy."""

STORAGES = {f"torch.{kind}Storage": kind for kind in KINDS}
"""Names of the code that stands for them."""

OTHERS = "another network comes as ONNX or NIR, or in Python as spikeloom.compile(module, example=…): docs/formats.md"
"""What to do with a file of torch that holds no network of ours."""


@dataclass(slots=True, eq=False)
class Storage:
    """Numbers that tensors are views of."""

    kind: str  # One of `KINDS`
    count: int
    content: bytes = b""  # Not there before the pickle ends

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.count * np.dtype(KINDS[self.kind][1]).itemsize

    def fill(self, content: bytes) -> None:
        """Take its bytes; FileFault if they are not as many as announced."""
        if len(content) != self.size:
            raise FileFault(f"is truncated or damaged ({len(content)} bytes of a tensor of {self.size})")
        self.content = content

    @property
    def values(self) -> AnyArray:
        """Its numbers, a vector."""
        values: AnyArray = np.frombuffer(self.content, KINDS[self.kind][1])
        if self.kind == "BFloat16":  # the first half of a float32
            return (values.astype("<u4") << 16).view("<f4")
        return values


@dataclass(frozen=True, slots=True, eq=False)
class Tensor:
    """A view of a storage; it may show a number many times, and so be larger than the file."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]  # In numbers

    @property
    def dtype(self) -> str:
        """Kind of its numbers, as torch calls it."""
        return KINDS[self.storage.kind][0]

    @property
    def array(self) -> AnyArray:
        """Read-only view of its numbers, bfloat16 as float32; FileFault if it reaches beyond the storage."""
        values = self.storage.values
        last = self.offset + sum((n - 1) * step for n, step in zip(self.shape, self.stride, strict=True))
        if math.prod(self.shape) and last >= len(values):
            raise FileFault("is truncated or damaged (a tensor reaches beyond its storage)")
        steps = [step * values.itemsize for step in self.stride]
        return np.lib.stride_tricks.as_strided(values[self.offset :], self.shape, steps, writeable=False)


def _tensor(storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> Tensor:
    numbers = (offset, *shape, *stride)
    if not isinstance(storage, Storage) or any(type(each) is not int or each < 0 for each in numbers):
        raise FileFault("is truncated or damaged (a tensor has no usable sizes)")
    return Tensor(storage, offset, tuple(shape), tuple(stride))


CODE: dict[str, Callable[..., Any]] = {
    "collections.OrderedDict": dict,
    "torch._utils._rebuild_tensor": _tensor,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": lambda tensor, *_: tensor,
}
"""Names of code that a file may call, and what is done instead."""


@dataclass(frozen=True, slots=True)
class _Name:
    """A name of code in a pickle."""

    name: str


def read_torch_file(content: bytes) -> Any:
    """The value that was saved: tensors are :class:`Tensor`, ordered dicts are dicts.

    ModelError if it names other code than that of plain tensors, or is a pickle of a newer protocol than torch
    writes; FileFault, or what parsing raises, if it is damaged.
    """
    storages: dict[str, Storage] = {}
    if content[:2] == b"PK":
        members = stored_members(content)
        folder = next(name for name in members if name.endswith("/data.pkl")).removesuffix("data.pkl")
        if members.get(f"{folder}byteorder", b"little") != b"little":
            raise FileFault("was written on a big-endian machine")
        value = _value(io.BytesIO(members[f"{folder}data.pkl"]), storages)
        for key, storage in storages.items():
            storage.fill(members[f"{folder}data/{key}"])
        return value
    file = io.BytesIO(content)
    magic = (_value(file, storages), _value(file, storages))
    if magic != MAGIC or not _value(file, storages)["little_endian"]:
        raise ValueError("no file of torch")
    value = _value(file, storages)
    for key in _value(file, {}):
        if int.from_bytes(file.read(8), "little") != storages[key].count:
            raise ValueError("a tensor has another size than announced")
        storages[key].fill(file.read(storages[key].size))
    return value


CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_TUPLE": tuple,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
}
"""Instructions that put something new on the stack."""

ARGUMENTS = ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE")
"""Those that put their argument there."""

TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def _instructions(file: BinaryIO) -> Iterator[tuple[str, Any]]:
    """Name and argument of each instruction of the pickle that comes next."""
    for done, (opcode, argument, _) in enumerate(pickletools.genops(file)):
        if done == MOST_INSTRUCTIONS:
            raise FileFault(f"has more than {MOST_INSTRUCTIONS:,} instructions, the limit of a pickle")
        if opcode.proto >= NEWER:
            raise ModelError(
                "is pickled with protocol 4 or newer, which is not read; save it with torch.save as it is by default"
            )
        yield opcode.name, argument


def _value(file: BinaryIO, storages: dict[str, Storage]) -> Any:  # noqa: PLR0912 - one for each instruction
    """What the pickle that comes next in a file describes; its storages are added, without their bytes."""
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def taken(at: int) -> list[Any]:
        top = stack[at:]
        del stack[at:]
        return top

    for instruction, argument in _instructions(file):
        match instruction:
            case "PROTO" | "STOP":
                pass
            case "MARK":
                marks.append(len(stack))
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case name if name in CONSTANTS:
                stack.append(CONSTANTS[name]())
            case name if name in ARGUMENTS:
                stack.append(argument)
            case "TUPLE":
                stack.append(tuple(taken(marks.pop())))
            case name if name in TUPLES:
                stack.append(tuple(taken(-TUPLES[name])))
            case "APPEND":
                _extend(stack[-2], taken(-1))
            case "APPENDS":
                at = marks.pop()
                _extend(stack[at - 1], taken(at))
            case "SETITEM":
                _set(stack[-3], taken(-2))
            case "SETITEMS":
                at = marks.pop()
                _set(stack[at - 1], taken(at))
            case "GLOBAL":
                stack.append(_named(argument))
            case "REDUCE":
                code, arguments = taken(-2)
                stack.append(CODE[code.name](*arguments))
            case "BUILD":  # attributes, which data need not have
                stack.pop()
            case "BINPERSID":
                stack.append(_storage(stack.pop(), storages))
            case name:
                raise ValueError(f"has the instruction {name}, which plain tensors do not need")
    return stack.pop()


def _extend(target: Any, values: list[Any]) -> None:
    if type(target) is not list:
        raise ValueError("appends to what is no list")
    target += values


def _set(target: Any, values: list[Any]) -> None:
    """Add keys and values by turns; a tuple of tuples as a key would take for ever to hash."""
    keys = values[::2]
    if type(target) is not dict or not all(type(key) in (str, int) for key in keys):
        raise ValueError("sets a key that is neither text nor a whole number")
    target.update(zip(keys, values[1::2], strict=True))


def _named(argument: str) -> _Name:
    name = argument.replace(" ", ".")
    if name not in CODE and name not in STORAGES:
        raise ModelError(
            f"is a pickle that calls {printable(name)}, allowed are plain tensors alone, since code in a file "
            f"could do anything; save the state_dict of a TactileSGNet and nothing else; {OTHERS}"
        )
    return _Name(name)


def _storage(described: Any, storages: dict[str, Storage]) -> Storage:
    """The storage that a pickle speaks of, the same one each time."""
    what, kind, key, _location, count, *views = described
    if what != "storage" or type(key) is not str or type(count) is not int or count < 0 or any(views):
        raise ValueError("speaks of something else than a storage")
    made = Storage(STORAGES[kind.name], count)
    known = storages.setdefault(key, made)
    if (known.kind, known.count) != (made.kind, made.count):
        raise ValueError("speaks of one storage in two ways")
    return known
