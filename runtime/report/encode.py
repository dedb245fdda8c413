"""Results as JSON values, the one encoder of every ``--json``, and back from a file that a command wrote."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.files import read_whole, reading, write_atomically

Result = TypeVar("Result")

OPTIONAL: Mapping[str, bool] = {"optional": True}
"""Metadata of a field that is left out of the JSON where it is None."""

HIDDEN: Mapping[str, bool] = {"hidden": True}
"""Metadata of a field that the JSON does not show."""

INLINE: Mapping[str, bool] = {"inline": True}
"""Metadata of a field whose own fields stand in its place."""


def key(name: str) -> Mapping[str, str]:
    """Metadata of a field that has another name in JSON."""
    return {"key": name}


def encode(value: Any) -> Any:
    """A JSON value: dataclasses by field, and by the properties that their class lists in ``json_properties``.

    Arrays become lists, infinities and NaN become null. Raises TypeError if a value has no form in JSON.

    >>> encode({"spikes": np.arange(3), "left": (math.inf, None)})
    {'spikes': [0, 1, 2], 'left': [None, None]}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return value if math.isfinite(value) else None
        case Enum() | Path():
            return encode(value.value if isinstance(value, Enum) else value.as_posix())
        case Mapping():
            return {str(name): encode(each) for name, each in value.items()}
        case list() | tuple() | set() | frozenset():
            return [encode(each) for each in value]
    if not is_dataclass(value) or isinstance(value, type):
        raise TypeError(f"{type(value).__name__}: has no form in JSON")
    entries: dict[str, Any] = {}
    for field in fields(value):
        each = getattr(value, field.name)
        if field.metadata.get("hidden"):
            continue
        if field.metadata.get("inline"):
            entries |= {} if each is None else encode(each)
        elif each is not None or not field.metadata.get("optional"):
            entries[field.metadata.get("key", field.name)] = encode(each)
    return entries | {name: encode(getattr(value, name)) for name in getattr(value, "json_properties", ())}


def decode(kind: Any, value: Any) -> Any:  # noqa: PLR0911 - one for each kind
    """A value of a type hint from what :func:`encode` made of it; keys without a field are passed over.

    Hints are dataclasses, tuples, sequences, mappings, plain types, one of these or None, or Any. Raises
    TypeError, ValueError or KeyError if the value is not of this kind, for instance since another version
    wrote it.
    """
    origin = get_origin(kind)
    inner = get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        one = type(value) if type(value) in inner else next(each for each in inner if each is not NoneType)
        return None if one is NoneType else decode(one, value)
    if is_dataclass(kind):
        return _dataclass(kind, value)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {inner[0](name): decode(inner[1], each) for name, each in _plain(dict, value).items()}
    if isinstance(origin, type) and issubclass(origin, Sequence):
        alike = origin is not tuple or inner[-1] is Ellipsis
        kinds = inner[:1] * len(_plain(list, value)) if alike else inner
        return tuple(decode(each, part) for each, part in zip(kinds, value, strict=True))
    if kind is float and type(value) in (int, float) and math.isfinite(number := float(value)):
        return number
    return _plain(kind, value)


def _plain(kind: Any, value: Any) -> Any:
    if type(value) is not kind:
        raise TypeError(f"{value!r} is no {kind.__name__}")
    return value


def _dataclass(kind: Any, value: Any) -> Any:
    entries = {}
    hints = get_type_hints(kind)
    for field in fields(kind):
        name = field.metadata.get("key", field.name)
        if field.metadata.get("inline"):
            entries[field.name] = decode(hints[field.name], value)
        elif name in _plain(dict, value):
            entries[field.name] = decode(hints[field.name], value[name])
        elif field.default is MISSING and field.default_factory is MISSING:
            raise KeyError(name)
    return kind(**entries)


def write_json(path: str | None, result: Any) -> None:
    """Write a result as one JSON object, if a place is named."""
    if path is not None:
        with write_atomically(path) as file:
            file.write(json.dumps(encode(result)).encode())


def read_json(kind: type[Result], path: Path, option: str, command: str) -> Result:
    """What :func:`write_json` wrote; `option` named it, `command` makes it.

    Raises DataError if it is not there, something else, or of another version.
    """
    with reading(f"{option} {path}", DataError, f"write it with {command}"):
        found: Result = decode(kind, json.loads(read_whole(path, "result")))
    return found
