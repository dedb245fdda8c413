"""Training, by default by the released protocol: one recording at a time, Adam, the squared error of the spike rates.

:mod:`training.recipes` has another way, as data.

The released script reads recordings in the order that the folder lists them, unshuffled, which differs from
machine to machine. Here each epoch shuffles them anew, from the seed.

Everything runs on one thread: at one recording per step a second thread gains little, and so a seed gives
the same weights whatever the number of cores. Sums are in the order of AVX2, so that processors with AVX-512
give them, too.

A training is reported at three epochs, side by side. *Last*: nothing is chosen. *Best epoch on test*: the
maximum over epochs, chosen on the test split. *Clean*: a first training leaves a fifth of the training split
out and says which epoch does best on it; a second one, on the whole training split, is read on the test
split at that epoch only. Which epoch the published figures [1]_ are of their text does not say.

References
----------
.. [1] F. Gu et al., "TactileSGNet: A Spiking Graph Neural Network for Event-based Tactile Object Recognition",
   IROS 2020.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import DataError, OptionError, require_least
from spikeloom.compiler.types import FloatArray, IntArray, JsonObject
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.networks import Sizes, SpikingNet, TrainedModule, Weights
from spikeloom.models.recordings.counts import number
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.evaluate import evaluate, loss_of, one_thread, require_finite
from spikeloom.models.training.recipes import ADAMW, COSINE, PLATEAU, RELEASED, Recipe, plateau
from spikeloom.models.training.resume import Course, set_rate
from spikeloom.models.training.robust import disturb

MOST_SEED = 2**63 - 1
"""What a torch generator takes."""

MOST_EPOCHS = 1_000_000
"""Stands for any number of them in the state of a plateau."""

VALIDATION_SHARE = 0.2
"""Share of each class that the first training leaves out, rounded down to whole recordings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Epoch:
    """Figures of one epoch."""

    epoch: int  # Counted from 1
    learning_rate: float  # When it began
    training_loss: (
        float  # The recipe's, mean over the recordings; a penalty on spikes counts in training only
    )
    test_loss: float
    correct: int  # Test recordings classified correctly after it
    tested: int  # All test recordings

    @property
    def accuracy(self) -> float:
        """Share of the test recordings classified correctly."""
        return self.correct / self.tested


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trained:
    """Outcome of a training."""

    architecture: Sizes  # Of the network
    last: Weights  # After the last epoch
    best: Weights  # After the first epoch with the most correct test recordings: chosen on these, as published figures
    best_epoch: int  # Counted from 1
    kept: Weights | None  # Weights after the epoch that was asked for
    history: tuple[Epoch, ...]  # All epochs


def train(
    training: Recordings,
    test: Recordings,
    propagation: FloatArray,
    architecture: Sizes,
    *,
    epochs: int = RELEASED.epochs,
    seed: int = 0,
    recipe: Recipe = RELEASED,
    keep_epoch: int | None = None,
    state: Path | None = None,
    resume: bool = False,
    trunk: Path | None = None,
    label: str = "train",
    position: int = 0,
    after_epoch: Callable[[Epoch], None] | None = None,
) -> Trained:
    """Train a network from scratch, or go on with an interrupted training; `test` is only looked at.

    `propagation` is what the first layer sees, see :func:`systems.propagation_of`; the sizes and dynamics of
    the `recipe` are already in the architecture. The `seed` is that of the initial weights and of the order
    of recordings. The weights after epoch `keep_epoch`, counted from 1, are kept too. The file `state` holds
    the state after each epoch, which the caller removes when the result is safe; `resume` goes on from it,
    to the same weights as without interruption. `trunk` is the stem of states at the end of a plateau of the
    learning rate: a training of more epochs goes on from there, to the same weights as from scratch. `label`
    and `position` are name and row of the progress bar.

    OptionError if a number is too small, or `state` is another training's. DataError if
    recordings and architecture disagree, or the loss is no longer a number.
    """
    _require_options(epochs, recipe.decay_epochs, seed)
    _require_suited(training, architecture)
    _require_suited(test, architecture)
    options = _identity(training, test, propagation, architecture, recipe)
    options |= {"epochs": MOST_EPOCHS if trunk else epochs, "seed": seed, "kept epoch": keep_epoch}
    with one_thread():
        network = architecture.network(propagation, seed=seed, surrogate=recipe.surrogate)
        course = Course(
            options=options,
            network=network,
            optimizer=_optimizer_of(recipe, network),
            draw=np.random.default_rng(seed),
            epoch=Epoch,
        )
        if resume and state is not None and state.exists():
            course.restore(state)
        run = partial(
            course.run,
            train_epoch=lambda index: _run_epoch(
                course, network, training, test, recipe, epochs, keep_epoch, index
            ),
            state=state,
            after_epoch=after_epoch,
            shown=_shown,
            label=label,
            position=position,
        )
        if trunk is not None and recipe.schedule == PLATEAU:
            _climb(course, trunk, plateau(epochs), run)
        run(epochs)
        return _trained(architecture, network.export_weights(), course)


def _shown(epoch: Epoch) -> dict[str, str]:
    """Figures beside the progress bar."""
    return {"loss": f"{epoch.training_loss:.4f}", "test": f"{epoch.correct}/{epoch.tested}"}


def _climb(course: Course[Epoch], trunk: Path, epochs: int, run: Callable[[int], None]) -> None:
    """Train to the end of the plateau, from the longest state that is no longer than that."""
    states = {int(file.suffix[1:]): file for file in trunk.parent.glob(f"{trunk.name}.*")}
    done = max((length for length in states if length <= epochs), default=0)
    if done:
        course.restore(states[done])
    if done < epochs:
        run(epochs)
        course.write(trunk.with_name(f"{trunk.name}.{epochs}"))


def _trained(architecture: Sizes, last: Weights, course: Course[Epoch]) -> Trained:
    """What is left after the last epoch."""
    correct = [epoch.correct for epoch in course.history]
    return Trained(
        architecture=architecture,
        last=last,
        best=course.weights["best"],
        best_epoch=correct.index(max(correct)) + 1,
        kept=course.weights.get("kept"),
        history=tuple(course.history),
    )


def _identity(
    training: Recordings, test: Recordings, propagation: FloatArray, architecture: Sizes, recipe: Recipe
) -> JsonObject:
    """What is trained, and how."""
    return {
        "architecture": repr(architecture),
        "graph": arrays_digest({"adjacency": propagation}),
        "training data": arrays_digest(training.identity()),
        "test data": arrays_digest(test.identity()),
        "recipe": recipe.to_json(),
    }


def _run_epoch(
    course: Course[Epoch],
    network: TrainedModule,
    training: Recordings,
    test: Recordings,
    recipe: Recipe,
    epochs: int,
    keep_epoch: int | None,
    index: int,
) -> Epoch:
    """Train an epoch, look at the test recordings, and keep the weights if it is the best, or the one to keep."""
    optimizer = course.optimizer
    schedule = _schedule_of(recipe, index, epochs)
    if schedule is not None:
        set_rate(optimizer, schedule(0.0))
    rate = float(optimizer.param_groups[0]["lr"])
    training_loss = _train_epoch(
        network, optimizer, training, course.draw, recipe, schedule, epoch=index + 1
    )
    if schedule is None and index % recipe.decay_epochs == 0 and index > 1:
        set_rate(optimizer, rate * 0.1)
    test_loss, correct = evaluate(network, test, recipe)
    if correct > max((epoch.correct for epoch in course.history), default=-1):
        course.weights["best"] = network.export_weights()
    if index + 1 == keep_epoch:
        course.weights["kept"] = network.export_weights()
    return Epoch(
        epoch=index + 1,
        learning_rate=rate,
        training_loss=training_loss,
        test_loss=test_loss,
        correct=correct,
        tested=len(test),
    )


def _optimizer_of(recipe: Recipe, network: torch.nn.Module) -> torch.optim.Optimizer:
    """Optimizer of a recipe on the parameters of a network."""
    rate = recipe.learning_rate
    parameters = network.parameters()
    if recipe.optimizer == ADAMW:
        return torch.optim.AdamW(
            parameters, lr=rate, weight_decay=recipe.weight_decay, amsgrad=True, fused=True
        )
    return torch.optim.Adam(parameters, lr=rate, amsgrad=True, fused=True)


def _schedule_of(recipe: Recipe, epoch: int, epochs: int) -> Callable[[float], float] | None:
    """Learning rate within an epoch by the share of it that is done, counted from 0; None where it is constant."""
    if recipe.schedule == PLATEAU:
        rate = recipe.learning_rate * (1.0 if epoch < plateau(epochs) else 0.1)
        return lambda _: rate
    if recipe.schedule != COSINE:
        return None
    return lambda share: recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * (epoch + share) / epochs))


def _train_epoch(
    network: TrainedModule,
    optimizer: torch.optim.Optimizer,
    recordings: Recordings,
    draw: np.random.Generator,
    recipe: Recipe,
    schedule: Callable[[float], float] | None,
    *,
    epoch: int,
) -> float:
    total = 0.0
    order = draw.permutation(len(recordings))
    for step, start in enumerate(range(0, len(order), recipe.batch), 1):
        chosen = order[start : start + recipe.batch]
        if schedule is not None:
            set_rate(optimizer, schedule(start / len(order)))
        optimizer.zero_grad()
        loss = _loss(network, recordings, chosen, recipe, draw)
        value = float(loss.detach())
        loss.backward()  # type: ignore[no-untyped-call]
        require_finite(network, value, epoch, step)
        optimizer.step()
        total += value * len(chosen)
    return total / len(order)


def _loss(
    network: TrainedModule,
    recordings: Recordings,
    chosen: IntArray,
    recipe: Recipe,
    draw: np.random.Generator,
) -> torch.Tensor:
    """Loss of some recordings, with the penalty on spikes."""
    lengths = np.array([recordings.steps_of(int(index)) for index in chosen])
    events = time_first(disturb(recordings.events[chosen][..., : lengths.max()], recipe.robust, draw))
    labels = recordings.labels[chosen]
    filled = torch.tensor(lengths) if lengths.min() < lengths.max() else None
    if not isinstance(network, SpikingNet) or not recipe.penalty:
        return loss_of(recipe, network(events, filled), labels)
    layers = network.layers(events)
    return loss_of(recipe, network.rates(layers, filled), labels) + recipe.penalty * network.activity(
        layers, filled
    )


def _require_options(epochs: int, decay_epochs: int, seed: int) -> None:
    """Refuse numbers that are too small or large."""
    require_least(
        {"epochs": epochs, "decay_epochs": decay_epochs, "seed": seed}, epochs=1, decay_epochs=1, seed=0
    )
    if seed > MOST_SEED:
        raise OptionError(f"--seed {seed}: allowed are 0 to {MOST_SEED}; choose another")


def _require_suited(recordings: Recordings, architecture: Sizes) -> None:
    """Refuse recordings of another sensor, or of more classes than a network has."""
    where = f"{recordings.source}: split {recordings.split!r}"
    shape = recordings.events.shape[1:3]
    wanted = (architecture.taxels, architecture.channels)
    if shape != wanted:
        found = f"{number(shape[0], 'taxel')} and {number(shape[1], 'polarity')}"
        raise DataError(
            f"{where}: {found}, the network has {wanted[0]} and {wanted[1]}; use the graph of this sensor"
        )
    highest = int(recordings.labels.max())
    if highest >= architecture.classes:
        raise DataError(
            f"{where}: label {highest}, the network has {architecture.classes} classes "
            f"(0..{architecture.classes - 1}); train it with more classes"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reported:
    """A training and what it reached at its last, best and clean epoch."""

    trained: Trained  # On the whole training split; ``kept`` holds the weights of the clean epoch
    validation: (
        Trained  # The training that chose the clean epoch; its "test" figures are those of the left-out part
    )
    clean_epoch: int  # Counted from 1


def validation_split(training: Recordings) -> tuple[Recordings, Recordings]:
    """Leave a fifth of every class out, rounded down, one at least; the same recordings whatever the training's seed.

    A class of one recording is not left out. Both parts keep the order of `training`. DataError if none would be.
    """
    chosen = np.zeros(len(training.labels), np.bool_)
    draw = np.random.default_rng(0)
    for label in np.unique(training.labels):
        members = np.flatnonzero(training.labels == label)
        if len(members) > 1:
            chosen[draw.permutation(members)[: max(1, int(len(members) * VALIDATION_SHARE))]] = True
    if not chosen.any():
        raise DataError(
            f"{training.source}: each class has one training recording, the clean epoch needs 2 of some; record more"
        )
    return training.part(~chosen, "fitted"), training.part(chosen, "validation")


def train_both(
    training: Recordings,
    test: Recordings,
    propagation: FloatArray,
    architecture: Sizes,
    *,
    epochs: int,
    seed: int,
    recipe: Recipe = RELEASED,
    state: Path | None = None,
    resume: bool = False,
    position: int = 0,
) -> Reported:
    """Train twice with one seed: to choose the clean epoch, then on everything.

    Parameters as :func:`train.train`; `state` is the stem of two files.
    """
    files = state_files(state) if state is not None else (None, None)
    once = partial(
        train,
        propagation=propagation,
        architecture=architecture,
        epochs=epochs,
        seed=seed,
        recipe=recipe,
        resume=resume,
        position=position,
    )
    validation = once(*validation_split(training), state=files[0], label=f"seed {seed}, validation")
    clean = max(validation.history, key=lambda epoch: (epoch.correct, -epoch.test_loss))
    trained = once(training, test, state=files[1], label=f"seed {seed}, all data", keep_epoch=clean.epoch)
    return Reported(trained=trained, validation=validation, clean_epoch=clean.epoch)


def state_files(stem: Path) -> tuple[Path, Path]:
    """Files that hold the states of the two trainings; an uninterrupted one leaves them to the caller to remove."""
    return stem.with_name(f"{stem.name}.validation"), stem.with_name(f"{stem.name}.whole")
