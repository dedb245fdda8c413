"""What a training needs before it begins, and after each step."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.networks.networks import TrainedModule
from spikeloom.models.networks.surrogate import Surrogate
from spikeloom.models.recordings.evtouch import Recordings

DEVICES = ("cpu", "cuda")

MOST_SEED = 2**63 - 1
"""What a torch generator takes."""


class Sizes(Protocol):
    """Sizes of a network that can be trained."""

    @property
    def taxels(self) -> int:
        """Sensor points."""

    @property
    def channels(self) -> int:
        """Inputs per taxel."""

    @property
    def classes(self) -> int:
        """Outputs."""

    def network(self, propagation: NDArray[np.float64], *, seed: int, surrogate: Surrogate) -> TrainedModule:
        """An untrained network."""


def require_options(epochs: int, decay_epochs: int, seed: int, device: str) -> None:
    """Refuse numbers that are too small, and a device that is unknown or not there."""
    for name, value, least in (("epochs", epochs, 1), ("decay-epochs", decay_epochs, 1), ("seed", seed, 0)):
        if value < least:
            raise OptionError(f"--{name} {value}: allowed are {least} or more; choose another")
    if seed > MOST_SEED:
        raise OptionError(f"--seed {seed}: allowed are 0 to {MOST_SEED}; choose another")
    if device not in DEVICES:
        raise OptionError(f"--device {device}: unknown; allowed: {', '.join(DEVICES)}")
    if device == "cuda" and not torch.cuda.is_available():
        raise OptionError("--device cuda: this machine has no usable GPU; omit --device")


def require_finite(network: torch.nn.Module, loss: float, epoch: int, step: int) -> None:
    """Stop before the weights are touched.

    Spikes hide a weight that is no number, since it exceeds no threshold and leaves the loss finite; the gradients of
    the layers before it show it.
    """
    gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    for name, found in (("loss", loss), ("gradient", sum(float(each.sum()) for each in gradients))):
        if not math.isfinite(found):
            raise DataError(
                f"epoch {epoch}, step {step}: the {name} is {found}, a finite number is needed; the state of the epoch "
                "before is kept"
            )


def require_suited(recordings: Recordings, architecture: Sizes) -> None:
    """Refuse recordings of another sensor, or of more classes than a network has."""
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
