"""State of a training between two epochs, so that a killed one continues to the same weights, bit for bit."""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import numpy as np
import torch
from tqdm import tqdm

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import FileFault, read_whole, reading, write_atomically
from spikeloom.compiler.formats.torch_checkpoint import load_torch
from spikeloom.models.networks.networks import Weights

E = TypeVar("E")


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
            total=epochs, initial=done, desc=label, unit="epoch", position=position, disable=None
        ) as bar:
            for index in range(done, epochs):
                self.history.append(train_epoch(index))
                if state is not None:
                    self.write(state)
                bar.set_postfix(shown(self.history[-1]))
                bar.update()
                if after_epoch is not None:
                    after_epoch(self.history[-1])

    def write(self, path: Path) -> None:
        """Write the state, whole or not at all."""
        state = {
            "options": dict(self.options),
            "history": [asdict(epoch) for epoch in self.history],  # type: ignore[call-overload]
            "order": self.draw.bit_generator.state,
            **_trained(self.network, self.optimizer, self.weights),
        }
        with write_atomically(path) as file:
            try:
                torch.save(state, file)
            except RuntimeError as error:
                if isinstance(error.__context__, KeyboardInterrupt):  # torch then finds its file cut short
                    raise error.__context__ from None
                raise

    def restore(self, path: Path, keeps: Callable[[int], Mapping[str, Weights]] = lambda _: {}) -> None:
        """Put back what was written; `keeps` gives weights of the shapes that are kept after so many epochs.

        ModelError if the state is missing or damaged, OptionError if it is that of another training.
        """
        with reading(path, ModelError, "delete it and train anew"):
            state = load_torch(read_whole(path, "training state"))
            self._require_same(path, state)
            self._require_history(state["history"])
            after_epoch = _after_an_epoch(self.network, self.optimizer, keeps(len(state["history"])))
            if not _alike({name: state[name] for name in after_epoch}, after_epoch):
                raise FileFault("is not the state of this network")
            self.network.load_state_dict(state["network"], strict=False)
            self.optimizer.load_state_dict(state["optimizer"])
            self.draw.bit_generator.state = state["order"]
        self.history = [self.epoch(**each) for each in state["history"]]
        self.weights = {
            which: {name: array.numpy() for name, array in arrays.items()}
            for which, arrays in state["kept"].items()
        }

    def _require_same(self, path: Path, state: Any) -> None:
        if not isinstance(state, dict) or not isinstance(written := state.get("options"), dict):
            raise FileFault("is not a training state")
        names = {*written, *self.options}
        if differing := sorted(str(name) for name in names if written.get(name) != self.options.get(name)):
            raise OptionError(
                f"{path}: belongs to a training with other {', '.join(differing)[:100]}; give the same options and "
                "data, or delete it to train anew"
            )

    def _require_history(self, figures: Any) -> None:
        types = get_type_hints(self.epoch)
        typed = all({name: type(value) for name, value in each.items()} == types for each in figures)
        last = min(len(figures), self.options["epochs"])
        if not typed or [each["epoch"] for each in figures] != [*range(1, last + 1)]:
            raise FileFault("has no usable history")


def _trained(
    network: torch.nn.Module, optimizer: torch.optim.Optimizer, weights: Mapping[str, Weights]
) -> dict[str, Any]:
    return {
        "network": {name: parameter.detach() for name, parameter in network.named_parameters()},
        "optimizer": optimizer.state_dict(),
        "kept": {
            which: {name: torch.tensor(array) for name, array in kept.items()}
            for which, kept in weights.items()
        },
    }


def _after_an_epoch(
    network: torch.nn.Module, optimizer: torch.optim.Optimizer, weights: Mapping[str, Weights]
) -> dict[str, Any]:
    """Names, types and shapes of a state after an epoch; its numbers mean nothing."""
    network, optimizer = copy.deepcopy((network, optimizer))
    for parameter in network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    return _trained(network, optimizer, weights)


def _alike(found: Any, wanted: Any) -> bool:
    """Whether two values are equal, finite real numbers aside."""
    if type(found) is not type(wanted):
        return False
    match wanted:
        case dict():
            return found.keys() == wanted.keys() and all(
                _alike(found[key], each) for key, each in wanted.items()
            )
        case list() | tuple():
            return len(found) == len(wanted) and all(map(_alike, found, wanted))
        case torch.Tensor():
            same = (found.shape, found.dtype, found.layout) == (wanted.shape, wanted.dtype, wanted.layout)
            return same and bool(found.isfinite().all())
    return math.isfinite(found) if isinstance(found, float) else bool(found == wanted)


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate
