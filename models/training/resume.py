"""State of a training between two epochs, so that a killed one continues to the same weights, bit for bit."""

import hashlib
import io
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from spikeloom.compiler.archive import stored_members, zip_bytes
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import FileFault, read_whole, reading, write_atomically
from spikeloom.models.networks.networks import Weights
from spikeloom.models.progress import lines_wanted, say

E = TypeVar("E")

SEAL_BYTES = 32


@dataclass(kw_only=True, eq=False)
class Course(Generic[E]):
    """A training between two epochs: all that one epoch hands to the next."""

    # JSON values that must be equal to go on: digests of data and graph, architecture, epochs, seed, rates
    options: Mapping[str, Any]
    network: torch.nn.Module
    optimizer: torch.optim.Optimizer
    draw: np.random.Generator  # Of the order of recordings
    epoch: type[E]  # Dataclass of the figures of an epoch
    history: list[E] = field(default_factory=list)  # Figures of the epochs so far
    weights: dict[str, Weights] = field(default_factory=dict)  # Those of epochs that are kept

    def run(
        self,
        epochs: int,
        train_epoch: Callable[[int], E],
        *,
        state: Path | None,
        after_epoch: Callable[[E], None] | None,
        shown: Callable[[E], Mapping[str, str]],
        label: str,
        position: int = 0,
    ) -> None:
        """Train the epochs that are left, by their index, with a progress bar; write the `state` after each."""
        done = len(self.history)
        with tqdm(
            total=epochs,
            initial=done,
            desc=label,
            unit="epoch",
            position=position,
            disable=lines_wanted() or None,  # without a terminal
        ) as bar:
            for index in range(done, epochs):
                self.history.append(train_epoch(index))
                if state is not None:
                    self.write(state)
                bar.set_postfix(shown(self.history[-1]))
                bar.update()
                say(label, done=index + 1, total=epochs)
                if after_epoch is not None:
                    after_epoch(self.history[-1])

    def write(self, path: Path) -> None:
        """Write the state, whole or not at all."""
        state = {
            "options": dict(self.options),
            "history": [asdict(epoch) for epoch in self.history],  # type: ignore[call-overload]
            "order": self.draw.bit_generator.state,
            "network": {name: parameter.detach() for name, parameter in self.network.named_parameters()},
            "optimizer": self.optimizer.state_dict(),
            "kept": {
                which: {name: torch.tensor(array) for name, array in kept.items()}
                for which, kept in self.weights.items()
            },
        }
        content = io.BytesIO()
        try:
            torch.save(state, content)
        except RuntimeError as error:
            if isinstance(error.__context__, KeyboardInterrupt):  # torch then finds its file cut short
                raise error.__context__ from None
            raise
        with write_atomically(path) as file:
            file.write(content.getvalue() + _seal(content.getvalue()))

    def restore(self, path: Path) -> None:
        """Put back what was written.

        ModelError if the state is missing, damaged or altered, OptionError if it is that of another training.
        """
        with reading(path, ModelError, "delete it and train anew"):
            sealed = read_whole(path, "training state")
            content = sealed[:-SEAL_BYTES]
            if _seal(content) != sealed[-SEAL_BYTES:]:
                raise FileFault("is no training state, or was altered")
            plain = io.BytesIO(zip_bytes(stored_members(content)))  # whose CRCs torch does not check
            state = torch.load(plain, map_location="cpu", weights_only=True)
            self._require_same(path, state["options"])
            self.network.load_state_dict(state["network"], strict=False)
            self.optimizer.load_state_dict(state["optimizer"])
            self.draw.bit_generator.state = state["order"]
        self.history = [self.epoch(**each) for each in state["history"]]
        self.weights = {
            which: {name: array.numpy() for name, array in arrays.items()}
            for which, arrays in state["kept"].items()
        }

    def _require_same(self, path: Path, written: Mapping[str, Any]) -> None:
        names = {*written, *self.options}
        if differing := sorted(name for name in names if written.get(name) != self.options.get(name)):
            raise OptionError(
                f"{path}: belongs to a training with other {', '.join(differing)[:100]}; give the same options and "
                "data, or delete it to train anew"
            )


def _seal(content: bytes) -> bytes:
    """What stands behind the content of a state: nothing else is looked at in a file that it does not fit."""
    return hashlib.sha256(content).digest()


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate
