"""Results as JSON values: the one encoder of every ``--json``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

OPTIONAL: Mapping[str, bool] = {"optional": True}
"""Metadata of a field that is left out of the JSON where it is None."""


def key(name: str) -> Mapping[str, str]:
    """Metadata of a field that has another name in JSON."""
    return {"key": name}


def encode(value: Any) -> Any:
    """A JSON value: dataclasses by field, and by the properties that their class lists in ``json_properties``.

    Arrays become lists, infinities and NaN become null.

    Raises
    ------
    TypeError
        If a value has no form in JSON.

    Examples
    --------
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
    found = {}
    for field in fields(value):
        each = getattr(value, field.name)
        if each is not None or not field.metadata.get("optional"):
            found[field.metadata.get("key", field.name)] = encode(each)
    return found | {name: encode(getattr(value, name)) for name in getattr(value, "json_properties", ())}
