"""Arrays of numbers from ``.npy`` bytes: nothing is unpickled, and memory is taken for what is there only."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from spikeloom.compiler.errors import DataError

MAX_FILE_BYTES = 64 << 20  # the released recordings have 0.1 MB


def read_bounded(where: str, opened: Callable[[], IO[bytes]]) -> bytes:
    """Content of a file of at most `MAX_FILE_BYTES`.

    Raises
    ------
    DataError
        If it is larger or cannot be read.
    """
    try:
        with opened() as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except Exception as error:  # zipfile answers damage with errors of many kinds
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"{where}: cannot be read ({reason}); copy or download it again") from error
    if len(data) > MAX_FILE_BYTES:
        raise DataError(f"{where}: more than {MAX_FILE_BYTES} bytes, the limit of a recording; split it")
    return data


def parse_npy(where: str, data: bytes) -> NDArray[Any]:
    """Array of real numbers or truth values; read-only.

    Raises
    ------
    DataError
        If the bytes are no such array.
    """
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, fortran, dtype = header(file)
    except Exception as error:  # numpy answers a damaged header with errors of many kinds
        raise DataError(f"{where}: not an npy file, or a damaged one; save it with numpy.save") from error
    if dtype.kind not in "biuf":
        raise DataError(f"{where}: dtype {dtype.str!r}, allowed are numbers; convert it")
    expected, found = math.prod(shape) * dtype.itemsize, len(data) - file.tell()
    if expected != found or min(shape, default=0) < 0:
        raise DataError(
            f"{where}: {found} bytes of data, its header announces {expected}; truncated or damaged, copy it again"
        )
    values: NDArray[Any] = np.ndarray(shape, dtype, buffer=data, offset=file.tell(), order="F" if fortran else "C")
    return values
