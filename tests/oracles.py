"""Slow and simple definitions that the product is held against."""

import numpy as np
import pytest
import torch
from random_networks import dense_weights


def probed(stage, channels):
    """Weights (outputs, channels) and bias of an affine stage, by its responses to unit vectors."""
    bias = stage(np.zeros((1, channels)))[0]
    return (stage(np.eye(channels)) - bias).T, bias


def assert_same_network(found, expected):
    """Equal in everything but names, scales, stored zeros and the division into projections."""
    assert found.input == expected.input
    assert found.classes == expected.classes
    assert found.readout.population == expected.readout.population
    np.testing.assert_array_equal(found.readout.label, expected.readout.label)
    for ours, theirs in zip(found.populations, expected.populations, strict=True):
        for name in ("beta", "theta", "decay_u", "decay_v"):
            assert getattr(ours, name) == getattr(theirs, name), name
        for name in ("threshold", "bias_mantissa", "bias_exponent"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    for post in range(len(expected.populations)):
        ours, theirs = dense_weights(found, post), dense_weights(expected, post)
        for pre in set(ours) | set(theirs):
            nothing = np.zeros(1, np.int64)
            np.testing.assert_array_equal(
                *np.broadcast_arrays(ours.get(pre, nothing), theirs.get(pre, nothing))
            )


def load_weights(network, weights):
    """Give a TactileSGNet the weights of a checkpoint."""
    network.gains = ()
    network.load_state_dict(
        {n: torch.tensor(w.T if n.endswith(".weight") else w) for n, w in weights.items()}
    )


def refused(error, words, call, *given, **options):
    """Check that a call raises `error` and that its message holds each of the words, separated by ``|``."""
    with pytest.raises(error) as caught:
        call(*given, **options)
    message = str(caught.value)
    for word in words.split("|"):
        assert word in message
    return message
