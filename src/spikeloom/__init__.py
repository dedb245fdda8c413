"""Lower a trained spiking network for touch to a chip's netlist, run it bit for bit, compare it and price it.

>>> import spikeloom
>>> net = spikeloom.compile("pretrained:grasps")
>>> net  # doctest: +ELLIPSIS
loihi1: 2,886 neurons (2,517 on the chip), 451,712 synapses (371,854 stored, 355,500 non-zero), 5 cores on tiles ...
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spikeloom.compiler.errors import SpikeloomError
    from spikeloom.compiler.storage import Cheapest, Exact, Fixed, Packing
    from spikeloom.models.networks.lif import LIF
    from spikeloom.runtime.api import (
        Compiled,
        Data,
        certify,
        chart,
        compile,
        estimate,
        finetune,
        load,
        recordings,
        report,
        run,
        smallest,
        stress,
        train,
        verify,
    )

from spikeloom.compiler import __version__

__all__ = [
    "LIF",
    "Cheapest",
    "Compiled",
    "Data",
    "Exact",
    "Fixed",
    "Packing",
    "SpikeloomError",
    "__version__",
    "certify",
    "chart",
    "compile",
    "estimate",
    "finetune",
    "load",
    "recordings",
    "report",
    "run",
    "smallest",
    "stress",
    "train",
    "verify",
]


def __dir__() -> list[str]:
    """The public names."""
    return __all__


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name == "SpikeloomError":
        from spikeloom.compiler.errors import SpikeloomError

        return SpikeloomError
    if name in ("Cheapest", "Exact", "Fixed", "Packing"):
        from spikeloom.compiler import storage

        return getattr(storage, name)
    if name == "LIF":
        from spikeloom.models.networks.lif import LIF

        return LIF
    if name not in __all__:
        raise AttributeError(f"module 'spikeloom' has no attribute {name!r}")
    from spikeloom.runtime import api

    return getattr(api, name)
