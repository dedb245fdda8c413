"""Loss and accuracy of a network, in small batches."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from llvmlite.binding import get_host_cpu_features
from torch import Tensor

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.types import EventArray, IntArray
from spikeloom.models.networks.layers import time_first
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.recipes import CROSS_ENTROPY, RELEASED, Recipe

TEST_BATCH = 2  # larger batches outgrow the cache

if get_host_cpu_features().get("avx512f"):
    # Else log_softmax adds up in another order than with AVX2, and a seed gives other weights. torch reads this at
    # its first computation.
    os.environ.setdefault("ATEN_CPU_CAPABILITY", "avx2")


def evaluate(
    network: torch.nn.Module, recordings: Recordings, recipe: Recipe = RELEASED
) -> tuple[float, int]:
    """Mean loss, and how many recordings are classified correctly; equal top rates count for the lowest class."""
    loss = 0.0
    correct = 0
    with torch.no_grad():
        for chosen, events in _batches(recordings):
            labels = recordings.labels[chosen]
            rates: Tensor = network(time_first(events))
            loss += float(loss_of(recipe, rates, labels)) * len(labels)
            correct += int(np.sum(rates.numpy().argmax(axis=1) == labels))
    return loss / len(recordings), correct


def _batches(recordings: Recordings) -> Iterator[tuple[slice, EventArray]]:
    """All recordings in order, a few of one length at a time: where they stand, and their events without filling."""
    start = 0
    while start < len(recordings):
        steps = recordings.steps_of(start)
        stop = start + 1
        while stop < min(start + TEST_BATCH, len(recordings)) and recordings.steps_of(stop) == steps:
            stop += 1
        yield slice(start, stop), recordings.events[start:stop, ..., :steps]
        start = stop


def loss_of(recipe: Recipe, rates: Tensor, labels: IntArray) -> Tensor:
    """Loss of spike rates (samples, classes) by a recipe, without its penalty on spikes."""
    if recipe.loss == CROSS_ENTROPY:
        wanted = torch.tensor(labels)
        return torch.nn.functional.cross_entropy(
            recipe.gain * rates, wanted, label_smoothing=recipe.smoothing
        )
    return rate_loss(rates, labels)


def rate_loss(rates: Tensor, labels: IntArray) -> Tensor:
    """Mean squared error of spike rates (samples, classes) against zeros and a one."""
    target = torch.zeros_like(rates)
    target[torch.arange(len(labels)), torch.tensor(labels)] = 1.0
    return torch.nn.functional.mse_loss(rates, target)


@contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread, subnormal numbers flushed to zero (beta**t decays into them); both undone at the end."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    # glibc hands large blocks back to the system when they are freed, and each step would fault them in
    # anew. Having freed one of 30 MB it keeps blocks up to that size, see "dynamic mmap threshold" in
    # mallopt(3).
    torch.empty(30 << 20, dtype=torch.uint8)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)
        torch.set_num_threads(threads)


def require_finite(network: torch.nn.Module, loss: float, epoch: int, step: int) -> None:
    """Stop before the weights are touched.

    Spikes hide a weight that is no number, since it exceeds no threshold and leaves the loss finite; the
    gradients of the layers before it show it.
    """
    gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    for name, found in (("loss", loss), ("gradient", sum(float(each.sum()) for each in gradients))):
        if not math.isfinite(found):
            raise DataError(
                f"epoch {epoch}, step {step}: the {name} is {found}, a finite number is needed; the state of the epoch "
                "before is kept"
            )
