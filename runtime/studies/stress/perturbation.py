"""What a perturbation is, and what it has to know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.runtime.studies.stress.damages import Pair
from spikeloom.runtime.studies.stress.disturbances import Events

Level = float | str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensor:
    """What perturbations must know beside the network.

    Parameters
    ----------
    distance : (taxels, taxels) float64
        Between taxels: in millimetres, or in steps on their graph where positions are not known.
    places : (taxels, dimensions) float64, or None
        Positions in millimetres.
    edges : (edges, 2) int64, or None
        Graph that the network was trained on.
    checkpoint : Checkpoint or None
        What the network was made from; None for an ONNX or NIR file.
    """

    distance: FloatArray
    places: FloatArray | None
    edges: IntArray | None
    checkpoint: Checkpoint | None

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return len(self.distance)


Disturb = Callable[[Events, float, Sensor, np.random.Generator], Events]
Damage = Callable[[Pair, Level, Sensor, np.random.Generator], Pair]


@dataclass(frozen=True, slots=True, kw_only=True)
class Perturbation:
    """One kind of trouble.

    Parameters
    ----------
    name, what, unit : str
        As typed; one line for people; what levels count.
    levels, full : tuple of float or str
        From mild to harsh; with ``--full``.
    seeded : bool
        Whether chance has a part in it.
    least, most : float
        Levels that make sense.
    whole : bool
        Whether only whole levels do.
    disturb, damage : callable, optional
        One of them: what happens to recordings, or to the network. Neither where recordings follow each other without
        a reset, see :mod:`stress.runs`.
    """

    name: str
    what: str
    unit: str
    levels: tuple[Level, ...]
    full: tuple[Level, ...]
    seeded: bool = True
    least: float = 0.0
    most: float = 1.0
    whole: bool = False
    disturb: Disturb | None = None
    damage: Damage | None = None
