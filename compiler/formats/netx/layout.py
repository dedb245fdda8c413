"""The layout of lava-dl's ``.net`` files, and reading one as a list of layers.

``layer/0`` … each have ``type`` and ``shape``; ``dense`` and ``conv`` have ``weight`` (to, from) or (filters, channels,
height, width), maybe ``bias``, and ``neuron`` with ``iDecay``, ``vDecay``, ``vThMant``, ``refDelay``. Shapes of images
are (channels, height, width), as torch has them, and kernels are not turned round. Numbers are the chip's registers,
but for three: ``iDecay`` is one more than the register of the current's decay, biases count whole weight steps, and
weights of both signs are even.

References
----------
.. [1] lava-dl 0.6.0, ``netx/README.md``, ``netx/hdf5.py`` and ``slayer/block/base.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.hdf5 import Part, Tree, read_hdf5
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.types import IntArray

SUFFIX = ".net"

REMEDY = "export it again"

BIAS_EXPONENT = 6
"""Biases are in whole weight steps."""

DEFAULT_INPUT_WEIGHT = 64

LAYER_LIMIT = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block(Part):
    """One layer of a file, with its entries."""

    number: int
    type: str
    entries: Tree

    def __str__(self) -> str:
        return f"layer {self.number} ({printable(self.type) or 'no type'})"

    def inner(self, key: str) -> Tree | None:
        """A group of entries, or None."""
        found = self.entries.get(key)
        return found if isinstance(found, dict) else None

    def integers(self, key: str, within: Tree | None = None) -> IntArray:
        """An entry as int64, of its own shape; ModelError if there is none, or it holds other numbers."""
        found = (self.entries if within is None else within).get(key)
        if not isinstance(found, np.ndarray):
            raise self.fail(f"has no {key}; {REMEDY}")
        if found.dtype.kind == "f":
            wrong = found[~(np.isfinite(found) & (found == np.rint(found)) & (np.abs(found) < 2**31))]
            if wrong.size:
                raise self.fail(
                    f"{key} holds {wrong.flat[0]:g}, allowed are whole numbers; export the network quantised"
                )
        if found.size and (found.min() < -(2**31) or found.max() >= 2**31):
            raise self.fail(f"{key} holds numbers that no register does; {REMEDY}")
        return found.astype(np.int64)

    def number_of(self, key: str, within: Tree | None = None) -> int:
        """An entry that is one number."""
        values = self.integers(key, within)
        if values.size != 1:
            raise self.fail(f"{key} has {values.size} values, one is allowed; {REMEDY}")
        return int(values.ravel()[0])

    def pair(self, key: str) -> tuple[int, int]:
        """An entry of two numbers, or of one for both."""
        values = self.integers(key).ravel().tolist()
        if len(values) not in (1, 2):
            raise self.fail(f"{key} has {len(values)} values, wanted 2; {REMEDY}")
        return values[0], values[-1]

    def sizes(self) -> tuple[int, ...]:
        """Its ``shape``."""
        values = tuple(self.integers("shape").ravel().tolist())
        if not 1 <= len(values) <= 3 or min(values) < 1 or max(values) > 2**20:
            raise self.fail(f"has the shape {list(values[:4])}, which is none; {REMEDY}")
        return values


def read_blocks(path: Path) -> tuple[list[Block], Tree, str]:
    """Layers of a file, what else it holds, and its hash; ModelError, without the path, if it is none."""
    tree, sha256 = read_hdf5(path, "netx file", REMEDY)
    return blocks_of(tree), tree, sha256


def blocks_of(tree: Tree) -> list[Block]:
    """Layers in the content of a file; raises as :func:`read_blocks`."""
    layers = tree.get("layer")
    if not isinstance(layers, dict) or not layers:
        raise ModelError(f"has no layers, so it is no netx file; {REMEDY}")
    if len(layers) > LAYER_LIMIT or set(layers) != {str(number) for number in range(len(layers))}:
        raise ModelError(f"has layers that are not numbered from 0 to {len(layers) - 1}; {REMEDY}")
    found = []
    for number in range(len(layers)):
        entries = layers[str(number)]
        if not isinstance(entries, dict):
            raise ModelError(f"layer {number} is no group; {REMEDY}")
        kind = entries.get("type")
        while isinstance(kind, list) and kind:
            kind = kind[0]
        found.append(Block(number=number, type=kind[:20] if isinstance(kind, str) else "", entries=entries))
    return found
