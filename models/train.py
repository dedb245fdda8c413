"""Training by the released protocol: one recording at a time, Adam, the squared error of the spike rates.

The released script reads recordings in the order that the folder lists them, unshuffled, which differs from machine
to machine. Here each epoch shuffles them anew, from the seed.

Everything runs on one thread: at one recording per step a second thread gains little, and so a seed gives the same
weights whatever the number of cores.

References
----------
.. [1] F. Gu et al., "TactileSGNet: A Spiking Graph Neural Network for Event-based Tactile Object Recognition",
   IROS 2020.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from compiler.errors import DataError, OptionError
from models.evtouch import Recordings
from models.networks import Architecture, TactileSGNet, Weights

DECAY_EPOCHS = 40
"""The learning rate falls to a tenth after so many epochs; the first of each such block still has the old rate."""

TEST_BATCH = 2  # larger batches outgrow the cache


@dataclass(frozen=True, slots=True, kw_only=True)
class Epoch:
    """Figures of one epoch.

    Parameters
    ----------
    epoch : int
        Counted from 1.
    learning_rate : float
        While it ran.
    training_loss, test_loss : float
        Mean squared error of the spike rates against zeros and a one, mean over the recordings.
    correct, tested : int
        Test recordings classified correctly after it, and all of them.
    """

    epoch: int
    learning_rate: float
    training_loss: float
    test_loss: float
    correct: int
    tested: int

    @property
    def accuracy(self) -> float:
        """Share of the test recordings classified correctly."""
        return self.correct / self.tested


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trained:
    """What a training left.

    Parameters
    ----------
    architecture : Architecture
        Of the network.
    last, best : dict of arrays
        Weights after the last epoch, and after the epoch with the most correct test recordings (the first such):
        the latter is chosen on test data, as the published figures are.
    best_epoch : int
        Counted from 1.
    history : tuple of Epoch
        All epochs.
    """

    architecture: Architecture
    last: Weights
    best: Weights
    best_epoch: int
    history: tuple[Epoch, ...]


def train(
    training: Recordings,
    test: Recordings,
    adjacency: NDArray[np.float64],
    architecture: Architecture,
    *,
    epochs: int = 100,
    seed: int = 0,
    learning_rate: float = 1e-3,
    after_epoch: Callable[[Epoch], None] | None = None,
) -> Trained:
    """Train a `TactileSGNet` from scratch.

    Parameters
    ----------
    training, test : Recordings
        Both splits; `test` is only looked at.
    adjacency : (taxels, taxels) float64
        Normalised propagation matrix of the taxel graph.
    architecture : Architecture
        Sizes.
    epochs : int
        Passes over the training recordings.
    seed : int
        Of the initial weights and of the order of recordings.
    learning_rate : float
        At the start.
    after_epoch : callable, optional
        Called with the figures of each epoch.

    Raises
    ------
    OptionError
        If `epochs` or `seed` is too small.
    DataError
        If recordings and architecture disagree.
    """
    for name, value, least in (("epochs", epochs, 1), ("seed", seed, 0)):
        if value < least:
            raise OptionError(f"{name}: {value}, allowed are {least} or more; choose another")
    for recordings in (training, test):
        _check(recordings, architecture)
    order = np.random.default_rng(seed)
    history: list[Epoch] = []
    best: Weights = {}
    best_epoch = 0
    with _one_thread():
        network = TactileSGNet(architecture, adjacency, seed=seed)
        optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate, amsgrad=True, fused=True)
        with tqdm(range(epochs), desc="train", unit="epoch", disable=None) as progress:
            for index in progress:
                rate = float(optimizer.param_groups[0]["lr"])
                training_loss = _train_epoch(network, optimizer, training, order.permutation(len(training)))
                if index % DECAY_EPOCHS == 0 and index > 1:
                    for group in optimizer.param_groups:
                        group["lr"] *= 0.1
                test_loss, correct = evaluate(network, test)
                history.append(
                    Epoch(
                        epoch=index + 1,
                        learning_rate=rate,
                        training_loss=training_loss,
                        test_loss=test_loss,
                        correct=correct,
                        tested=len(test),
                    )
                )
                if not best or correct > history[best_epoch - 1].correct:
                    best, best_epoch = network.export_weights(), index + 1
                progress.set_postfix(loss=f"{training_loss:.4f}", test=f"{correct}/{len(test)}")
                if after_epoch is not None:
                    after_epoch(history[-1])
        last = network.export_weights()
    return Trained(architecture=architecture, last=last, best=best, best_epoch=best_epoch, history=tuple(history))


def evaluate(network: TactileSGNet, recordings: Recordings) -> tuple[float, int]:
    """Mean loss, and how many recordings are classified correctly; equal top rates count for the lowest class."""
    loss, correct = 0.0, 0
    with torch.no_grad():
        for start in range(0, len(recordings), TEST_BATCH):
            chosen = slice(start, start + TEST_BATCH)
            labels = recordings.labels[chosen]
            rates = network(_time_first(recordings.events[chosen]))
            loss += float(_loss(rates, labels)) * len(labels)
            correct += int(np.sum(rates.numpy().argmax(axis=1) == labels))
    return loss / len(recordings), correct


def _train_epoch(
    network: TactileSGNet, optimizer: torch.optim.Optimizer, recordings: Recordings, order: NDArray[np.int64]
) -> float:
    total = 0.0
    for index in order:
        chosen = slice(index, index + 1)
        optimizer.zero_grad()
        loss = _loss(network(_time_first(recordings.events[chosen])), recordings.labels[chosen])
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        total += float(loss.detach())
    return total / len(order)


def _loss(rates: Tensor, labels: NDArray[np.int64]) -> Tensor:
    target = torch.zeros_like(rates)
    target[torch.arange(len(labels)), torch.tensor(labels)] = 1.0
    return torch.nn.functional.mse_loss(rates, target)


def _time_first(events: NDArray[np.uint8]) -> Tensor:
    """(samples, taxels, channels, steps) uint8 to (steps, samples, taxels, channels) float32."""
    return torch.from_numpy(events.transpose(3, 0, 1, 2).astype(np.float32, order="C"))


def _check(recordings: Recordings, architecture: Architecture) -> None:
    where = f"{recordings.source}: split {recordings.split!r}"
    found, wanted = recordings.events.shape[1:3], (architecture.taxels, architecture.channels)
    if found != wanted:
        raise DataError(
            f"{where}: {found[0]} taxels and {found[1]} polarities, the network has {wanted[0]} and {wanted[1]}; "
            "use the graph of this sensor"
        )
    highest = int(recordings.labels.max())
    if highest >= architecture.classes:
        raise DataError(
            f"{where}: label {highest}, the network has {architecture.classes} classes "
            f"(0..{architecture.classes - 1}); train it with more classes"
        )


@contextmanager
def _one_thread() -> Iterator[None]:
    """One torch thread, subnormal numbers flushed to zero (beta**t decays into them); both undone at the end."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    # glibc hands large blocks back to the system when they are freed, and each step would fault them in anew.
    # Having freed one of 30 MB it keeps blocks up to that size, see "dynamic mmap threshold" in mallopt(3).
    torch.empty(30 << 20, dtype=torch.uint8)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)
        torch.set_num_threads(threads)
