"""Slow and simple definitions that the product is held against."""

import numpy as np
import pytest
import torch


def probed(stage, channels):
    """Weights (outputs, channels) and bias of an affine stage, by its responses to unit vectors."""
    bias = stage(np.zeros((1, channels)))[0]
    return (stage(np.eye(channels)) - bias).T, bias


def weight_differences(first, second):
    """(layer, row, column, weight, other weight) of each synapse that two integer networks of the same layers differ
    in; planes are added up. Thresholds, biases and decays must be the same."""
    for one, other in zip(first.populations, second.populations, strict=True):
        assert (one.decay_u, one.decay_v) == (other.decay_u, other.decay_v)
        np.testing.assert_array_equal(one.threshold, other.threshold)
        np.testing.assert_array_equal(one.bias, other.bias)
    found = []
    ends = {(p.pre, p.post) for network in (first, second) for p in network.projections}
    for pre, post in sorted(ends):
        one, other = (
            sum(p.effective() for p in network.projections if (p.pre, p.post) == (pre, post))
            for network in (first, second)
        )
        row, column = (one != other).nonzero()
        name = first.populations[post].name
        found += [(name, int(i), int(j), int(one[i, j]), int(other[i, j])) for i, j in zip(row, column, strict=True)]
    return found


def load_weights(network, weights):
    """Give a TactileSGNet the weights of a checkpoint."""
    network.gains = ()
    network.load_state_dict({n: torch.tensor(w.T if n.endswith(".weight") else w) for n, w in weights.items()})


def refused(error, words, call, *given, **options):
    """Check that a call raises `error` and that its message holds each of the words, separated by ``|``."""
    with pytest.raises(error) as caught:
        call(*given, **options)
    message = str(caught.value)
    for word in words.split("|"):
        assert word in message
    return message


def comparable(netlist, layer):
    """Neurons of a layer whose spikes can be compared: all but those left out because their spikes reach no neuron."""
    return np.setdiff1d(np.arange(netlist.layers[layer].neurons), netlist.layers[layer].unread)
