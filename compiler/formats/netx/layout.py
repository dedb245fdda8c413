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

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.hdf5 import AGAIN, Part, Tree
from spikeloom.compiler.formats.names import printable

SUFFIX = ".net"

BIAS_EXPONENT = 6
"""Biases are in whole weight steps."""

DEFAULT_INPUT_WEIGHT = 64

LAYER_LIMIT = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block(Part):
    """One layer of a file, with its entries."""

    number: int
    type: str

    def __str__(self) -> str:
        return f"layer {self.number} ({printable(self.type) or 'no type'})"

    def inner(self, key: str) -> Tree | None:
        """A group of entries, or None."""
        found = self.values.get(key)
        return found if isinstance(found, dict) else None

    def sizes(self) -> tuple[int, ...]:
        """Its ``shape``."""
        values = tuple(self.integers("shape").ravel().tolist())
        if not 1 <= len(values) <= 3 or min(values) < 1 or max(values) > 2**20:
            raise self.fail(f"has the shape {list(values[:4])}, which is none; {AGAIN}")
        return values


def blocks_of(tree: Tree) -> list[Block]:
    """Layers in the content of a file; ModelError if it is none."""
    layers = tree.get("layer")
    if not isinstance(layers, dict) or not layers:
        raise ModelError(f"has no layers, so it is no netx file; {AGAIN}")
    if len(layers) > LAYER_LIMIT or set(layers) != {str(number) for number in range(len(layers))}:
        raise ModelError(f"has layers that are not numbered from 0 to {len(layers) - 1}; {AGAIN}")
    found = []
    for number in range(len(layers)):
        entries = layers[str(number)]
        if not isinstance(entries, dict):
            raise ModelError(f"layer {number} is no group; {AGAIN}")
        kind = entries.get("type")
        while isinstance(kind, list) and kind:
            kind = kind[0]
        found.append(Block(number=number, type=kind[:20] if isinstance(kind, str) else "", values=entries))
    return found
