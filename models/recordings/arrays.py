"""Recordings that are in bins: npy (taxels, polarities, steps), npz of one array (steps, taxels[, polarities])."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.types import AnyArray, EventArray
from spikeloom.models.graphs import MAX_TAXELS
from spikeloom.models.recordings.classes import class_in_name
from spikeloom.models.recordings.eventfiles import Opener, class_in, is_events, label_array, npz_file
from spikeloom.models.recordings.evtouch import (
    BIN_S,
    MAX_POLARITIES,
    WIDTH,
    parse_npy,
    require_bins,
    seconds_in,
    unzipped,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Binned:
    """A recording in bins."""

    events: EventArray  # (taxels, polarities, steps)
    label: str | None
    bin_s: float | None  # Seconds of a bin, where the file says so


def read_binned(name: str, opener: Opener, where: str, taxels: int | None) -> Binned | None:
    """Read a recording in bins; None if the file holds events. DataError if it cannot be read."""
    suffix = PurePosixPath(name).suffix.lower()
    if suffix == ".npy":
        events = require_bins(where, parse_npy(where, opener), taxels)
        return Binned(events=events, label=class_in_name(PurePosixPath(name).name), bin_s=None)
    if suffix != ".npz":
        return None
    arrays = unzipped(where, npz_file(where, opener))
    if is_events(arrays):
        return None
    (array,) = arrays.keys() - {"label.npy", "bin_s.npy"}
    here = f"{where}: {array.removesuffix('.npy')}"
    width = arrays.get("bin_s.npy")
    return Binned(
        events=require_bins(here, _taxels_first(here, parse_npy(here, arrays[array])), taxels),
        label=class_in(where, PurePosixPath(name).name, label_array(arrays, where)),
        bin_s=None if width is None else seconds_in(f"{where}: bin_s", width),
    )


def _taxels_first(where: str, values: AnyArray) -> AnyArray:
    """An array (steps, taxels[, polarities]) as (taxels, polarities, steps); where it has one, that is rising."""
    shape = values.shape
    if len(shape) not in (2, 3) or not 0 < shape[1] <= MAX_TAXELS or not 0 < shape[-1] <= MAX_TAXELS:
        raise DataError(f"{where}: shape {shape}, allowed is (steps, taxels[, polarities]); save it so")
    if len(shape) == 3 and shape[2] > MAX_POLARITIES:
        raise DataError(
            f"{where}: shape {shape}, allowed is (steps, taxels, polarities), up to {MAX_POLARITIES} of them; "
            "exchange its axes"
        )
    every = values[:, :, None] if len(shape) == 2 else values
    if every.shape[2] == 1:
        every = np.concatenate([np.zeros_like(every), every], axis=2)
    return np.moveaxis(every, 0, 2)


def bins_joined(
    own: float | None, bin_s: float | None, default_bin_s: float | None, where: str
) -> tuple[int, float | None]:
    """How many bins of an array make one of `bin_s` seconds, and the width of these, where anybody said so.

    The array's `own` width is `BIN_S` where nothing says it. Without `bin_s` they are joined to `default_bin_s`, which
    a network was trained on, if that is a multiple. OptionError if `bin_s` is none.
    """
    width = own or BIN_S
    wanted = bin_s or (default_bin_s if own else None) or width
    times = wanted / width
    count = round(times)
    if count >= 1 and abs(times - count) < 1e-6 * times:
        return count, wanted if own or count > 1 else None
    if bin_s is None:
        return 1, own
    said = f"bins of {width:g} s" if own else f"bins, of {width:g} s as nothing says it: write it to {WIDTH}"
    raise OptionError(f"--bin {bin_s:g}: {where} holds {said}; give a multiple of that, or omit --bin")


def one_width(widths: Sequence[float | None], source: str) -> float | None:
    """Width of the bins of all arrays; DataError if they differ."""
    found = sorted({width or BIN_S for width in widths})
    if len(found) > 1:
        raise DataError(
            f"{source}: bins of {found[0]:g} s and of {found[-1]:g} s; give a multiple of both to --bin"
        )
    return next((width for width in widths if width is not None), None)
