"""What a training leaves behind in its checkpoint: how to repeat it, and what it reached at three epochs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.evtouch import Recordings, data_digest

if TYPE_CHECKING:
    from spikeloom.models.training.train import Reported

CHOSEN_ON = {"last": "nothing", "best": "the test split", "clean": "a part of the training split"}
"""What decided which epoch the weights of a set are from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reached:
    """Test recordings that the network of an epoch classifies correctly."""

    epoch: int
    correct: int
    accuracy: float
    chosen_on: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Held:
    """Recordings left out by the validation training, and how many of them the clean epoch classifies correctly."""

    correct: int
    samples: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingRecord:
    """Everything needed to repeat a training, and what it reached; the fields are the keys in the checkpoint.

    `history` has training loss, test loss and correct test recordings of each epoch; `recipe` is missing
    where it is the released one, and `bin_s`, the seconds of a bin, where the recordings had bins already.
    """

    command: str
    seed: int
    epochs: int
    data: str
    data_sha256: str
    test_samples: int
    last: Reached
    best: Reached
    clean: Reached
    validation: Held
    history: Sequence[Sequence[float]]
    torch: str
    numpy: str
    spikeloom: str
    device: str = "cpu"
    recipe: Mapping[str, Any] | None = field(default=None, metadata={"optional": True})
    train_sha256: str | None = field(default=None, metadata={"optional": True})  # Of the events that trained
    bin_s: float | None = field(default=None, metadata={"optional": True})
    class_names: Sequence[str] | None = field(default=None, metadata={"optional": True})
    window: int | None = field(default=None, metadata={"optional": True})  # Per cent of each that trained
    positions_mm: Sequence[Sequence[float]] | None = field(default=None, metadata={"optional": True})

    def to_json(self) -> JsonObject:
        """JSON values."""
        return {key: value for key, value in asdict(self).items() if value is not None}


def read_record(found: Mapping[str, Any]) -> TrainingRecord:
    """The record of a checkpoint; KeyError if it is of another kind of training."""
    values = dict(found)
    values |= {which: Reached(**values[which]) for which in CHOSEN_ON} | {
        "validation": Held(**values["validation"])
    }
    return TrainingRecord(**values)


def training_record(
    reported: Reported,
    training: Recordings,
    test: Recordings,
    *,
    command: str,
    seed: int,
    recipe: Mapping[str, Any] | None = None,
    window: int | None = None,
    positions_mm: Sequence[Sequence[float]] | None = None,
) -> TrainingRecord:
    """Record of a training; `recipe`, `window` and `positions_mm` where they are not the released ones.

    The best epoch is chosen on the test split, as the published figures are; the clean one on a part of the
    training split; the last one is not chosen at all.
    """
    import torch  # two seconds that whoever reads records need not wait

    history = reported.trained.history
    chosen = {"last": len(history), "best": reported.trained.best_epoch, "clean": reported.clean_epoch}
    validation = reported.validation.history[reported.clean_epoch - 1]
    reached = {
        name: Reached(
            epoch=epoch,
            correct=history[epoch - 1].correct,
            accuracy=history[epoch - 1].accuracy,
            chosen_on=CHOSEN_ON[name],
        )
        for name, epoch in chosen.items()
    }
    return TrainingRecord(
        command=command,
        seed=seed,
        epochs=len(history),
        data=training.source,
        data_sha256=data_digest(training, test),
        test_samples=len(test),
        last=reached["last"],
        best=reached["best"],
        clean=reached["clean"],
        validation=Held(correct=validation.correct, samples=validation.tested),
        history=[[e.training_loss, e.test_loss, e.correct] for e in history],
        torch=torch.__version__,
        numpy=np.__version__,
        spikeloom=__version__,
        recipe=recipe,
        train_sha256=training.events_sha256,
        bin_s=training.bin_s,
        class_names=training.names,
        window=window,
        positions_mm=positions_mm,
    )
