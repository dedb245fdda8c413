"""Names of types that everything shares: arrays, and what JSON files hold."""

from typing import Any

import numpy as np
import numpy.typing as npt

AnyArray = npt.NDArray[Any]

BoolArray = npt.NDArray[np.bool_]

EventArray = npt.NDArray[np.uint8 | np.bool_]

Float32Array = npt.NDArray[np.float32]

FloatArray = npt.NDArray[np.float64]

IntArray = npt.NDArray[np.int64]

JsonObject = dict[str, Any]
"""A JSON object as Python reads it, or as it is to be written."""
