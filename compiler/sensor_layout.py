"""Which element of an input is which taxel and polarity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.ir import Input
from spikeloom.compiler.types import IntArray

POLARITIES = 2
"""Of a sensor's events: up and down."""

_ORDER = "channel = taxel * polarities + polarity"


def sensor_layout(
    shape: Sequence[int], *, polarities: int | None = None, polarities_first: bool | None = None
) -> tuple[Input, IntArray, str]:
    """Sensor of an input of one step, the position in it of each channel, and in words what was read and assumed.

    The `shape` is ``[taxels, polarities]``, flat, or an image ``[polarities, height, width]``, whose taxels count row
    by row; axes of length 1 in front are the batch's. How many polarities there are, and whether they are the outer
    axis, the shape says by default; of a flat one there are 2, and they are not.

    Raises ModelError if the shape does not say, or says another number than `polarities`; OptionError if there are no
    such polarities.

    Examples
    --------
    >>> sensor_layout([1, 39, 2])[2]
    '39 taxels, 2 polarities, as [taxels, polarities]'
    >>> sensor_layout([2, 2, 2], polarities_first=True)[1].tolist()
    [0, 4, 1, 5, 2, 6, 3, 7]
    """
    if polarities is not None and polarities < 1:
        raise OptionError(f"--polarities {polarities}: allowed are numbers from 1")
    sizes = list(shape)
    while len(sizes) > 3 and sizes[0] == 1:
        sizes.pop(0)
    # The 1 of [1, 39, 2] is a batch's axis, of [1, 8, 8] one polarity of an image.
    while len(sizes) > 1 and sizes[0] == 1 and (len(sizes) < 3 or (len(shape) == 3 and (polarities or 2) in sizes[1:])):
        sizes.pop(0)
    shown = f"[{', '.join(map(str, shape))}]"
    if not sizes or min(sizes) < 1:
        raise ModelError(f"the input {shown} has no elements; give it the shape of one step")
    if len(sizes) == 3:
        return _image(sizes, shown, polarities, polarities_first)
    if len(sizes) == 2:
        return _table(sizes, shown, polarities, polarities_first)
    if len(sizes) == 1:
        return _flat(sizes[0], shown, polarities, polarities_first)
    raise ModelError(
        f"the input {shown} is none of [taxels, polarities], flat, [polarities, height, width]; reshape it"
    )


def _image(sizes: list[int], shown: str, polarities: int | None, first: bool | None) -> tuple[Input, IntArray, str]:
    count = polarities or POLARITIES
    fits = [axis for axis in (0, 2) if sizes[axis] == count or (polarities is None and sizes[axis] == 1)]
    if first is not None:
        fits = [axis for axis in fits if (axis == 0) == first]
    if not fits:
        raise ModelError(
            f"the input {shown} has no axis of {count} polarities where they should be; tell how many with --polarities"
        )
    axis = fits[0]
    grid = np.moveaxis(np.arange(np.prod(sizes)).reshape(sizes), axis, -1)
    words = "[polarities, height, width]" if axis == 0 else "[height, width, polarities]"
    return _layout(grid.reshape(-1, sizes[axis]), f"{words}, taxels row by row")


def _table(sizes: list[int], shown: str, polarities: int | None, first: bool | None) -> tuple[Input, IntArray, str]:
    usual = (polarities,) if polarities else (POLARITIES, 1)
    fits = next((found for count in usual if (found := [axis for axis in (0, 1) if sizes[axis] == count])), [])
    if first is not None:
        fits = [0 if first else 1] if polarities is None else [axis for axis in fits if (axis == 0) == first]
    if len(fits) != 1:
        which = "both axes could be" if fits else "no axis is"
        raise ModelError(
            f"the input {shown}: {which} the polarities; tell with --polarities N and --polarities-first or -last"
        )
    grid = np.arange(sizes[0] * sizes[1]).reshape(sizes)
    return _layout(grid.T if fits[0] == 0 else grid, "[polarities, taxels]" if fits[0] == 0 else "[taxels, polarities]")


def _flat(size: int, shown: str, polarities: int | None, first: bool | None) -> tuple[Input, IntArray, str]:
    count = polarities or POLARITIES
    if size % count:
        raise ModelError(
            f"the input {shown} is no whole number of taxels with {count} polarities; tell how many with --polarities"
        )
    grid = np.arange(size).reshape((count, -1) if first else (-1, count))
    assumed = "" if polarities else f"; {count} polarities are assumed"
    return _layout(grid.T if first else grid, f"flat, {'polarity by polarity' if first else _ORDER}{assumed}")


def _layout(grid: IntArray, words: str) -> tuple[Input, IntArray, str]:
    taxels, polarities = grid.shape
    sensor = Input(taxels=taxels, polarities=polarities)
    return sensor, np.ascontiguousarray(grid).ravel(), f"{taxels} taxels, {polarities} polarities, as {words}"
