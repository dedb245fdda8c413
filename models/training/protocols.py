"""Two ways to report a training, always side by side.

*Paper protocol*: accuracy of the epoch that did best on the test split, the maximum over epochs, as the published
figures are made. *Clean protocol*: a first training leaves a fifth of the training split out and says which epoch does
best on it; a second one, on the whole training split, is read on the test split at that epoch only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import DataError
from spikeloom.models.networks.networks import Sizes
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.recipes import RELEASED, Recipe
from spikeloom.models.training.train import Trained, train

VALIDATION_SHARE = 0.2
"""Share of each class that the first training leaves out, rounded down to whole recordings."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reported:
    """A training and what both protocols say of it."""

    trained: Trained  # On the whole training split; ``kept`` holds the weights of the clean epoch
    validation: Trained  # The training that chose the clean epoch; its "test" figures are those of the left-out part
    clean_epoch: int  # Counted from 1


def validation_split(training: Recordings) -> tuple[Recordings, Recordings]:
    """Leave a fifth of every class out, rounded down, one at least; the same recordings whatever the training's seed.

    Both parts keep the order of `training`.
    """
    held = np.zeros(len(training.labels), np.bool_)
    draw = np.random.default_rng(0)
    for label in np.unique(training.labels):
        members = np.flatnonzero(training.labels == label)
        if len(members) < 2:
            raise DataError(
                f"{training.source}: class {label} has one training recording, the clean protocol needs 2 of each; "
                "record more or drop the class"
            )
        held[draw.permutation(members)[: max(1, int(len(members) * VALIDATION_SHARE))]] = True
    return training.part(~held, "fitted"), training.part(held, "validation")


def data_digest(training: Recordings, test: Recordings) -> str:
    """Hash over both splits, whatever their names."""
    splits = {"train": training, "test": test}
    names = {"events": "", "labels": "_labels", "lengths": "_lengths"}
    return arrays_digest(
        {f"{split}{names[key]}": array for split, data in splits.items() for key, array in data.identity().items()}
    )


def train_both(
    training: Recordings,
    test: Recordings,
    propagation: NDArray[np.float64],
    architecture: Sizes,
    *,
    epochs: int,
    seed: int,
    recipe: Recipe = RELEASED,
    device: str = "cpu",
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
        device=device,
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
