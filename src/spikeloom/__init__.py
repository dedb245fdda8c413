"""Lower a trained spiking network for touch to a chip's netlist, run it bit for bit, compare it and price it.

>>> import spikeloom
>>> net = spikeloom.compile("pretrained:grasps")
>>> net  # doctest: +ELLIPSIS
loihi1: 2,886 neurons (2,517 on the chip), 451,712 synapses (371,854 stored, 355,500 non-zero), 5 cores on tiles ...
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spikeloom.compiler.errors import SpikeloomError
    from spikeloom.models.networks.lif import LIF
    from spikeloom.runtime.api import Compiled, compile, finetune, load, recordings

from spikeloom.compiler import __version__

__all__ = ["LIF", "Compiled", "SpikeloomError", "__version__", "compile", "finetune", "load", "recordings"]

_PLACES = {"SpikeloomError": "compiler.errors", "LIF": "models.networks.lif"}


def __dir__() -> list[str]:
    """The public names."""
    return __all__


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module 'spikeloom' has no attribute {name!r}")
    return getattr(import_module(f"spikeloom.{_PLACES.get(name, 'runtime.api')}"), name)
