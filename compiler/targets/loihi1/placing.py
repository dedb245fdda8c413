"""Integers onto cores: the last passes of every compilation, whatever the integers come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.passes.prune import compact, either, removable
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.emit import Origin, emit
from spikeloom.compiler.targets.loihi1.layout.choose import Layout, lay_out
from spikeloom.compiler.targets.loihi1.legalize import LimitUse, require_legal
from spikeloom.compiler.targets.loihi1.netlist import Netlist

Masks = tuple[npt.NDArray[np.bool_], ...]
"""Neurons of each population, (neurons,) bool."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placed:
    """An integer network on cores.

    Parameters
    ----------
    netlist : Netlist
        The result.
    uses : tuple of LimitUse
        Use of every limit by every core.
    layout, usual : Layout
        Cores and tiles; and those of the layout of fewest cores.
    """

    netlist: Netlist
    uses: tuple[LimitUse, ...]
    layout: Layout
    usual: Layout


def place_integers(
    integer: IntegerNetwork,
    *,
    removed: tuple[Masks, Masks] | None = None,
    target: str = "loihi1",
    cores_for: Mapping[str, int] | None = None,
    chips: int = 1,
    optimize: str = "cores",
    rates: tuple[FloatArray, ...] | None = None,
    calibration: Calibration | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Placed:
    """Put an integer network on the cores of a chip, as it stands.

    Parameters
    ----------
    integer : IntegerNetwork
        Integer stage, verified.
    removed : pair of Masks, optional
        Neurons that the chip does not hold: those without a spike, and those that may spike but are not heard. By
        default those of :func:`prune.removable`.
    target, cores_for, chips, optimize, provenance
        See :func:`compilation.compile_network`.
    rates : tuple of (neurons,) float64, optional
        Spikes per step by population, for the placement; those of the calibration by default.
    calibration : Calibration, optional
        What layouts are judged by.

    Raises
    ------
    OptionError, CapacityError
        As the passes say.
    """
    chip = load_target(target)
    silent, unheard = removable(integer) if removed is None else removed
    laid, identity = compact(integer, either(silent, unheard))
    if rates is None and calibration is not None:
        rates = tuple(spikes.mean(axis=(0, 1)) for spikes in calibration.spikes)
    layout, usual = lay_out(
        laid,
        chip,
        goal=optimize,
        cores_for=cores_for,
        chips=chips,
        rates=None if rates is None else tuple(rate[ids] for rate, ids in zip(rates, identity, strict=True)),
        calibration=calibration,
        identity=identity,
    )
    origin = Origin(network=integer, identity=identity, unheard=unheard)
    netlist = emit(laid, layout.parts, layout.placement.tiles, chip, provenance or {}, origin)
    return Placed(netlist=netlist, uses=require_legal(netlist, chip), layout=layout, usual=usual)
