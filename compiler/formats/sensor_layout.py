"""Which element of an input is which taxel and polarity."""

from collections.abc import Sequence

import numpy as np

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.ir import Input
from spikeloom.compiler.types import IntArray

POLARITIES = 2
"""Polarities of a sensor's events: up and down."""

_ORDER = "channel = taxel * polarities + polarity"


def sensor_layout(
    shape: Sequence[int], *, polarities: int | None = None, polarities_first: bool | None = None
) -> tuple[Input, IntArray, str]:
    """Sensor of an input of one step, the position in it of each channel, and in words what was read and assumed.

    The `shape` is ``[taxels, polarities]``, flat, or an image ``[polarities, height, width]``, whose taxels
    count row by row; axes of length 1 in front are the batch's. How many polarities there are, and whether
    they are the outer axis, the shape says by default; of a flat one there are 2, and they are not.

    Raises ModelError if the shape does not say, or says another number than `polarities`; OptionError if
    there are no such polarities.

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
    while (
        len(sizes) > 1
        and sizes[0] == 1
        and (len(sizes) < 3 or (len(shape) == 3 and (polarities or 2) in sizes[1:]))
    ):
        sizes.pop(0)
    shown = f"[{', '.join(map(str, shape))}]"
    if not sizes or min(sizes) < 1:
        raise ModelError(f"the input {shown} has no elements; give it the shape of one step")
    if len(sizes) == 1:
        count = polarities or POLARITIES
        if sizes[0] % count:
            raise ModelError(
                f"the input {shown} is no whole number of taxels with {count} polarities; tell how many with "
                "--polarities"
            )
        grid = np.arange(sizes[0]).reshape((count, -1) if polarities_first else (-1, count))
        assumed = "" if polarities else f"; {count} polarities are assumed"
        words = f"flat, {'polarity by polarity' if polarities_first else _ORDER}{assumed}"
        return _layout(grid.T if polarities_first else grid, words)
    if len(sizes) > 3:
        raise ModelError(
            f"the input {shown} is none of [taxels, polarities], flat, [polarities, height, width]; reshape it"
        )
    axis = _polarity_axis(sizes, shown, polarities, polarities_first)
    grid = np.moveaxis(np.arange(np.prod(sizes)).reshape(sizes), axis, -1).reshape(-1, sizes[axis])
    axes, rows = (["taxels"], "") if len(sizes) == 2 else (["height", "width"], ", taxels row by row")
    axes.insert(axis, "polarities")
    return _layout(grid, f"[{', '.join(axes)}]{rows}")


def order_of(sensor: Input, positions: IntArray) -> dict[str, bool]:
    """Whether polarities are the first axis of what `positions` were read from; nothing where no order is."""
    if sensor.taxels < 2 or sensor.polarities < 2:
        return {}
    return {"polarities_first": bool(positions[1] != 1)}


def _polarity_axis(sizes: list[int], shown: str, polarities: int | None, first: bool | None) -> int:
    """Which axis, the outer or the inner one, are the polarities."""
    inner = len(sizes) - 1
    if first is not None and polarities is None and inner == 1:
        return 0 if first else inner
    fits: list[int] = []
    for count in (polarities,) if polarities else (POLARITIES, 1):
        fits = fits or [axis for axis in (0, inner) if sizes[axis] == count and first in (None, axis == 0)]
    if len(fits) == 1 or (fits and inner == 2):
        return fits[0]
    which = "both axes could be" if fits else "no axis is"
    raise ModelError(
        f"the input {shown}: {which} the polarities; give --polarities N and --polarities-first or -last"
    )


def _layout(grid: IntArray, words: str) -> tuple[Input, IntArray, str]:
    taxels, polarities = grid.shape
    sensor = Input(taxels=taxels, polarities=polarities)
    return (
        sensor,
        np.ascontiguousarray(grid).ravel(),
        f"{taxels} taxels, {polarities} polarities, as {words}",
    )
