"""Stable printed form of what passes make: for people, for ``--dump-after`` and for golden tests."""

import hashlib
from collections.abc import Mapping
from dataclasses import Field, fields, is_dataclass
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.types import AnyArray


def text(made: Any) -> str:
    """Print a network, a layout or a netlist, a field a line and an entry a line; equal text means equal content.

    Arrays appear as ranges and hashes; where something is from (mappings) is left out.
    """
    lines = [type(made).__name__]
    for field in _printed(made):
        value = getattr(made, field.name)
        entries = value if isinstance(value, tuple) else [value]
        lines += [f"  {field.name} {_shown(entry)}" for entry in entries if not isinstance(entry, Mapping)]
    return "\n".join(lines) + "\n"


def _printed(made: Any) -> list[Field[Any]]:
    """Fields that say something which the others do not."""
    return [field for field in fields(made) if field.repr]


def _shown(value: Any) -> str:
    if is_dataclass(value):
        return " ".join(f"({field.name} {_shown(getattr(value, field.name))})" for field in _printed(value))
    if sparse.issparse(value):
        shape = " x ".join(map(str, value.shape))
        return f"{shape}, {value.nnz} synapses {_span(value.data)} #{_digest(value.indptr, value.indices, value.data)}"
    if isinstance(value, np.ndarray):
        return f"{_span(value)} #{_digest(value)}"
    if isinstance(value, tuple):
        return ", ".join(map(_shown, value))
    return repr(value)


def _span(values: AnyArray) -> str:
    """Least and largest value."""
    if not values.size:
        return "none"
    low = values.min()
    high = values.max()
    return f"{low:.6g}" if low == high else f"{low:.6g}…{high:.6g}"


def _digest(*arrays: AnyArray) -> str:
    """A short hash of the values, whatever integer type holds them: stored numbers and indices come in several."""
    running = hashlib.sha256()
    for array in arrays:
        whole = array if array.dtype.kind == "f" else array.astype(np.int64)
        running.update(np.ascontiguousarray(whole).tobytes())
    return running.hexdigest()[:12]
