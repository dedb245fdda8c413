"""Learning curves and decisions of trainings, as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.types import IntArray
from spikeloom.models.training.recipes import MSE
from spikeloom.models.training.record import TrainingRecord

PICTURES = (".png", ".svg", ".pdf")
"""Kinds of picture that `draw_training` writes."""


def draw_training(path: str, records: Sequence[TrainingRecord], labels: IntArray, predictions: list[IntArray]) -> None:
    """Draw learning curves of all seeds and the confusion matrix of their last epochs, summed.

    Parameters
    ----------
    path : str
        PNG, SVG or PDF to write, whole or not at all.
    records : sequence of TrainingRecord
        Training records.
    labels : (samples,) int64
        True classes.
    predictions : list of (samples,) int64
        One per record.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import MaxNLocator

    from spikeloom.compiler.files import write_atomically

    classes = int(max(labels.max(), *(p.max() for p in predictions))) + 1
    confusion = np.zeros((classes, classes), np.int64)
    for predicted in predictions:
        np.add.at(confusion, (labels, predicted), 1)
    samples = records[0].test_samples
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(13, 4.2), layout="constrained", width_ratios=(1, 1, 1.05)
    )
    for index, record in enumerate(records):
        history = np.array(record.history)
        epochs = np.arange(1, len(history) + 1)
        colour, marker = f"C{index}", "." if len(history) == 1 else ""  # a line of one point is none
        left.semilogy(epochs, history[:, 0], marker=marker, color=colour, label=f"seed {record.seed}")
        left.semilogy(epochs, history[:, 1], marker=marker, color=colour, linestyle="--")
        middle.plot(epochs, 100 * history[:, 2] / samples, color=colour, label=f"seed {record.seed}")
        clean = record.clean
        middle.plot(clean.epoch, 100 * clean.accuracy, "o", color=colour, markeredgecolor="black")
    loss = (records[0].recipe or {}).get("loss", MSE)
    measured = "squared error of spike rates" if loss == MSE else loss
    left.set(xlabel="epoch", ylabel=measured, title="loss: training solid, test dashed")
    middle.set(xlabel="epoch", ylabel="test accuracy (%)", title="accuracy; circle: epoch of the clean protocol")
    longest = max(len(record.history) for record in records)
    for axes in (left, middle):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if longest == 1:
            axes.set_xticks([1])
        axes.grid(alpha=0.3)
    middle.legend(loc="lower right")
    image = right.imshow(confusion, cmap="cividis")
    right.set(xlabel="decision", ylabel="class", title="confusion, last epoch")
    right.xaxis.set_major_locator(MaxNLocator(integer=True))
    right.yaxis.set_major_locator(MaxNLocator(integer=True))
    figure.colorbar(image, ax=right, label="test recordings")
    with write_atomically(path) as file:
        figure.savefig(file, format=Path(path).suffix.removeprefix(".") or "png", dpi=120, metadata=_no_date(path))
    plt.close(figure)


def _no_date(path: str) -> dict[str, Any]:
    """Metadata that keeps equal pictures equal: SVG and PDF would store the date."""
    return {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(Path(path).suffix, {})
