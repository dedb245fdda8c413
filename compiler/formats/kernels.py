"""Convolutions and poolings as the sparse matrices that they are, for any number of space axes.

A convolution here is a cross-correlation, as in torch: kernels are not turned round. Images are (channels, space),
flat in that order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import Sparse

COEFFICIENT_LIMIT = 2**25
"""Products of a kernel's weights with places: more than twice the synapses of a whole chip."""

Padding = Sequence[tuple[int, int]]
"""Zeros before and after each space axis."""


def convolution(
    shape: Sequence[int],
    weight: npt.NDArray[np.floating],
    *,
    stride: Sequence[int],
    padding: Padding,
    dilation: Sequence[int],
    groups: int = 1,
) -> tuple[Sparse, tuple[int, ...]]:
    """Matrix of a convolution, csr_array (size of the result, size of the input), and the shape of what it gives.

    shape: (channels, *space) of the input.
    weight: (filters, channels / groups, *kernel) float64; weights of zero are not in the matrix.
    stride, dilation: one for each space axis.
    padding: zeros before and after, for each space axis.
    groups: parts of the channels that do not mix.

    Raises ModelError if sizes do not fit each other, or the matrix would be too large.

    >>> matrix, shape = convolution((1, 3), np.array([[[1.0, 2.0]]]), stride=[1], padding=[(0, 0)], dilation=[1])
    >>> shape, matrix.toarray().tolist()
    ((1, 2), [[1.0, 2.0, 0.0], [0.0, 1.0, 2.0]])
    """
    channels, *space = shape
    filters, each, *kernel = weight.shape
    if groups < 1 or channels != each * groups or filters % groups:
        raise ModelError(
            f"has kernels for {each} channels in {groups} groups and {filters} filters, its input has {channels} "
            f"channels; export it again"
        )
    if min((*kernel, *stride, *dilation), default=1) < 1 or any(min(pair) < 0 for pair in padding):
        raise ModelError("has a kernel size, stride or dilation below 1 or a padding below 0; export it again")
    spans = [apart * (taps - 1) + 1 for taps, apart in zip(kernel, dilation, strict=True)]
    padded_space = [size + sum(zeros) for size, zeros in zip(space, padding, strict=True)]
    for size, taps, span, covered in zip(space, kernel, spans, padded_space, strict=True):
        if span > covered:
            raise ModelError(f"has a kernel of {taps} for {size} places; export it again")
    out = [(room - span) // step + 1 for room, span, step in zip(padded_space, spans, stride, strict=True)]
    points, taps = math.prod(out), math.prod(kernel)
    if max(weight.size * points, points, channels * math.prod(padded_space)) > COEFFICIENT_LIMIT:
        raise ModelError(
            f"has {weight.size * points:,} weights once written out, {COEFFICIENT_LIMIT:,} are allowed; this "
            "is no network of one chip"
        )
    # where in the input each tap looks from each place; -1 is the padding
    positions = np.pad(np.arange(math.prod(shape)).reshape(shape), [(0, 0), *padding], constant_values=-1)
    windows = np.lib.stride_tricks.sliding_window_view(positions, (1, *spans))
    looks = windows[:, *(slice(None, None, step) for step in (*stride, 1, *dilation))]
    inner = filters // groups
    rows = np.arange(filters * points).reshape(groups, inner, 1, points, 1)
    columns = looks.reshape(groups, 1, each, points, taps)
    values = weight.reshape(groups, inner, each, 1, taps)
    kept = (columns >= 0) & (values != 0)
    rows, columns, values = (np.broadcast_to(part, kept.shape)[kept] for part in (rows, columns, values))
    matrix = sparse.coo_array(
        (values.astype(np.float64), (rows, columns)), shape=(filters * points, math.prod(shape))
    ).tocsr()
    matrix.sort_indices()
    return matrix, (filters, *out)


def block_diagonal(matrix: Sparse, copies: int) -> Sparse:
    """The same matrix for each of so many parts of a value."""
    return matrix if copies == 1 else sparse.csr_array(sparse.kron(sparse.identity(copies), matrix, format="csr"))
