"""Digests of what a chip holds of each layer: a netlist remembers them from before it was placed.

Neurons that recordings removed, and weights that recordings rounded so that their errors cancel, do not
follow from the checkpoint. Digests show that they are those that the compiler chose, wherever it put them.
"""

import hashlib
from collections.abc import Iterable, Sequence

import numpy as np

from spikeloom.compiler.ir import added_up
from spikeloom.compiler.passes.prune import of_source, zeroed
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
        synapses = []
        into = added_up((p.pre, p.effective()) for p in network.projections if p.post == post)
        for pre, weight in sorted(into.items()):
            part = zeroed(weight, gone[post], of_source(gone, pre, weight.shape[1]))
            if not (part.has_sorted_indices and part.data.all()):
                part = part.copy()
                part.eliminate_zeros()
                part.sort_indices()
            synapses += [np.array(pre), part.indptr, part.indices, part.data] if part.nnz else []
        parts = {
            "neurons": [kept],
            "thresholds": [population.threshold[kept]],
            "weights": synapses,
            "biases": [population.bias[kept]],
        }
        by_layer[population.name] = {what: _digest(arrays) for what, arrays in parts.items()}
    return by_layer


def _digest(arrays: Iterable[AnyArray]) -> str:
    """Of numbers at four bytes each."""
    running = hashlib.sha256()
    for array in arrays:
        running.update(np.ascontiguousarray(array, "<i4").data)
    return running.hexdigest()[:DIGITS]
