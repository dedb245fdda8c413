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

IMPOSSIBLE = "has a kernel size, stride or dilation below 1 or a padding below 0; export it again"

Padding = Sequence[tuple[int, int]]
"""Zeros before and after each space axis."""


def same_padding(kernel: Sequence[int], dilation: Sequence[int]) -> Padding:
    """Padding that keeps the size at a stride of 1; the odd zero comes after, as in torch.

    Examples
    --------
    >>> same_padding((3, 2), (1, 1))
    [(1, 1), (0, 1)]
    """
    total = [step * (size - 1) for size, step in zip(kernel, dilation, strict=True)]
    return [(zeros // 2, zeros - zeros // 2) for zeros in total]


def places(
    space: Sequence[int], kernel: Sequence[int], stride: Sequence[int], padding: Padding, dilation: Sequence[int]
) -> tuple[int, ...]:
    """Places that a kernel takes on each axis.

    Examples
    --------
    >>> places((5, 4), (3, 2), (2, 1), [(1, 1), (0, 0)], (1, 1))
    (3, 3)

    Raises ModelError if it takes none.
    """
    numbers = [*kernel, *stride, *dilation]
    pads = [zeros for pair in padding for zeros in pair]
    if min(numbers, default=1) < 1 or min(pads, default=0) < 0:
        raise ModelError(IMPOSSIBLE)
    found = []
    for size, taps, step, (before, after), apart in zip(space, kernel, stride, padding, dilation, strict=True):
        covered = size + before + after - apart * (taps - 1)
        if covered < 1:
            raise ModelError(f"has a kernel of {taps} for {size} places; export it again")
        found.append((covered - 1) // step + 1)
    return tuple(found)


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
    out = places(space, kernel, stride, padding, dilation)
    points, taps = math.prod(out), math.prod(kernel)
    padded = channels * math.prod(size + sum(zeros) for size, zeros in zip(space, padding, strict=True))
    if max(weight.size * points, points, padded) > COEFFICIENT_LIMIT:
        raise ModelError(
            f"has {weight.size * points:,} weights once written out, {COEFFICIENT_LIMIT:,} are allowed; this "
            "is no network of one chip"
        )
    # where in the input each tap looks from each place; -1 is the padding
    positions = np.pad(np.arange(math.prod(shape)).reshape(shape), [(0, 0), *padding], constant_values=-1)
    spans = [apart * (length - 1) + 1 for length, apart in zip(kernel, dilation, strict=True)]
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


def pooling(
    shape: Sequence[int], *, kernel: Sequence[int], stride: Sequence[int], padding: Padding, mean: bool
) -> tuple[Sparse, tuple[int, ...]]:
    """Matrix of a sum or mean over windows, channel by channel; zeros of the padding count.

    Examples
    --------
    >>> matrix, shape = pooling((1, 2, 2), kernel=(2, 2), stride=(2, 2), padding=[(0, 0)] * 2, mean=True)
    >>> shape, matrix.toarray().tolist()
    ((1, 1, 1), [[0.25, 0.25, 0.25, 0.25]])
    """
    if min(kernel) < 1:
        raise ModelError(IMPOSSIBLE)
    share = 1 / math.prod(kernel) if mean else 1.0
    return convolution(
        shape,
        np.full((shape[0], 1, *kernel), share),
        stride=stride,
        padding=padding,
        dilation=[1] * len(kernel),
        groups=shape[0],
    )
