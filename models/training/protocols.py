"""Two ways to report a training, always side by side.

*Paper protocol*: accuracy of the epoch that did best on the test split, the maximum over epochs, as the published
figures are made. *Clean protocol*: a first training leaves a fifth of the training split out and says which epoch does
best on it; a second one, on the whole training split, is read on the test split at that epoch only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import DataError
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.checks import Sizes
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

    Returns
    -------
    fitted, held : Recordings
        Both keep the order of `training`.

    Raises
    ------
    DataError
        If a class has a single recording.
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
    return _part(training, ~held, "fitted"), _part(training, held, "validation")


def _part(recordings: Recordings, chosen: NDArray[np.bool_], split: str) -> Recordings:
    files = tuple(name for name, keep in zip(recordings.files, chosen, strict=True) if keep)
    return replace(
        recordings,
        events=recordings.events[chosen],
        labels=recordings.labels[chosen],
        files=files,
        split=split,
        lengths=None if recordings.lengths is None else recordings.lengths[chosen],
    )


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
    fitted, held = validation_split(training)
    validation = train(
        fitted,
        held,
        propagation,
        architecture,
        epochs=epochs,
        seed=seed,
        recipe=recipe,
        device=device,
        state=files[0],
        resume=resume,
        label=f"seed {seed}, validation",
        position=position,
    )
    clean = max(validation.history, key=lambda epoch: (epoch.correct, -epoch.test_loss))
    trained = train(
        training,
        test,
        propagation,
        architecture,
        epochs=epochs,
        seed=seed,
        recipe=recipe,
        device=device,
        keep_epoch=clean.epoch,
        state=files[1],
        resume=resume,
        label=f"seed {seed}, all data",
        position=position,
    )
    return Reported(trained=trained, validation=validation, clean_epoch=clean.epoch)


def state_files(stem: Path) -> tuple[Path, Path]:
    """Files that hold the states of the two trainings; an uninterrupted one leaves them to the caller to remove."""
    return stem.with_name(f"{stem.name}.validation"), stem.with_name(f"{stem.name}.whole")
