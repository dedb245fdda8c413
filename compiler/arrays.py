"""Arrays that nobody may write to."""

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.types import AnyArray, FloatArray, IntArray


def frozen(array: AnyArray) -> AnyArray:
    """The same array, read-only from now on."""
    array.flags.writeable = False
    return array


def read_only(array: npt.ArrayLike) -> IntArray:
    """Copy to a read-only int64 array, as most fields of netlists are."""
    return frozen(np.array(array, dtype=np.int64))


def read_only_float(array: npt.ArrayLike) -> FloatArray:
    """Copy to a read-only float64 array."""
    return frozen(np.array(array, dtype=np.float64))
