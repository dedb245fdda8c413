"""Round weights one input after the other: what the rounding of one gains or loses, those to come make up for.

They do so as far as their inputs spike together, so that the errors of a neuron's sum cancel.

References
----------
.. [1] B. Hassibi, D. Stork, "Second order derivatives for network pruning: Optimal Brain Surgeon", NIPS 1992.
.. [2] E. Frantar et al., "GPTQ: Accurate post-training quantization for generative pre-trained transformers", 2022,
   arXiv:2210.17323: the order-by-order update through a Cholesky factor.
.. [3] L. Babai, "On Lovász' lattice reduction and the nearest lattice point problem", Combinatorica 6, 1986: the same
   integers without an inverse.
"""

import numpy as np

from spikeloom.compiler.types import FloatArray

DAMPING = 0.03
"""Share of the mean activity that is added to each input's own."""

BLOCK = 64
"""Columns to which the errors of all earlier ones are passed on at once: the same sums, as one matrix product."""


def shares(together: FloatArray) -> FloatArray:
    """How much of each input's error the later ones make up for, from how often each two spike together.

    A Cholesky factor, columns scaled; both (inputs, inputs).
    """
    damped = together[::-1, ::-1].copy()
    np.einsum("ii->i", damped)[:] += DAMPING * np.trace(together) / max(len(together), 1)
    factor = np.linalg.cholesky(damped)[::-1, ::-1]
    return np.asarray(factor / np.diag(factor))


def round_in_turn(weight: FloatArray, share: FloatArray, most: float = np.inf) -> FloatArray:
    """Whole numbers up to a magnitude for weights (neurons, inputs); later columns make up for each one's errors.

    >>> round_in_turn(np.array([[0.4, 0.4, 0.4]]), np.array([[1.0, 1, 1], [0, 1, 1], [0, 0, 1]])).tolist()
    [[0.0, 1.0, 0.0]]
    """
    rounded = np.empty_like(weight)
    errors = np.empty_like(weight)
    for start in range(0, weight.shape[1], BLOCK):
        block = slice(start, start + BLOCK)
        wanted = weight[:, block] + errors[:, :start] @ share[:start, block]
        for j in range(start, start + wanted.shape[1]):
            rounded[:, j] = np.clip(np.rint(wanted[:, j - start]), -most, most)
            errors[:, j] = weight[:, j] - rounded[:, j]
            wanted[:, j + 1 - start :] += np.outer(errors[:, j], share[j, j + 1 : start + BLOCK])
    return rounded
