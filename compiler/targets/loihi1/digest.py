"""Digests of what a chip holds of each layer: a netlist remembers them from before it was placed.

Neurons that recordings removed, and weights that recordings rounded so that their errors cancel, do not
follow from the checkpoint. Digests show that they are those that the compiler chose, wherever it put them.
"""

import hashlib
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from spikeloom.compiler.ir import added_up, entry_parts, row_parts
from spikeloom.compiler.passes.prune import of_source, touched
from spikeloom.compiler.targets.loihi1.bounds import one_sided_sums
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.types import AnyArray, BoolArray

DIGITS = 16
"""Hexadecimal digits of a digest."""


def digests(network: IntegerNetwork, gone: Sequence[BoolArray]) -> dict[str, dict[str, str]]:
    """Digests of the neurons of each layer, their thresholds, weights and biases, without those that are `gone`.

    Weights are sums of planes in weight units, so that neither the order of synapses nor zeros count.
    """
    by_layer = {}
    for post, population in enumerate(network.populations):
        kept = np.flatnonzero(~gone[post])
        parts: dict[str, Iterable[AnyArray]] = {
            "neurons": [kept],
            "thresholds": [population.threshold[kept]],
            "weights": _synapses(network, post, gone),
            "biases": [population.bias[kept]],
        }
        by_layer[population.name] = {what: _digest(arrays) for what, arrays in parts.items()}
    return by_layer


def _synapses(network: IntegerNetwork, post: int, gone: Sequence[BoolArray]) -> Iterator[AnyArray]:
    """Source, ends of rows, columns and weights of what a population receives, in parts to save memory."""
    into = added_up((p.pre, p.effective()) for p in network.projections if p.post == post)
    for pre, weight in sorted(into.items()):
        left = ~touched(weight, gone[post], of_source(gone, pre, weight.shape[1])) & (weight.data != 0)
        if left.any():
            yield np.array(pre)
            ends = (weight.indptr[rows.start : rows.stop + 1] for rows in row_parts(weight))
            counts = [one_sided_sums(left[part[0] : part[-1]].view(np.int8), part)[0] for part in ends]
            yield np.cumsum(np.append(0, np.concatenate(counts)))
            for column in (weight.indices, weight.data):
                yield from (column[part][left[part]] for part in entry_parts(weight))


def _digest(arrays: Iterable[AnyArray]) -> str:
    """Of numbers at four bytes each."""
    running = hashlib.sha256()
    for array in arrays:
        running.update(np.ascontiguousarray(array, "<i4").data)
    return running.hexdigest()[:DIGITS]
