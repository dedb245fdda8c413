"""Learning curves and decisions of trainings, as a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spikeloom.compiler.types import IntArray
from spikeloom.models.training.recipes import MSE
from spikeloom.models.training.record import TrainingRecord
from spikeloom.runtime.report.drawing import COLOURS, Drawing, sheet, styled


@styled
def picture(records: Sequence[TrainingRecord], labels: IntArray, predictions: Sequence[IntArray]) -> Drawing:
    """Learning curves of all seeds and the confusion matrix of their last epochs, summed.

    `labels` are the true classes of the test recordings, `predictions` has for each record what it decided.
    """
    classes = int(max(labels.max(), *(p.max() for p in predictions))) + 1
    confusion = np.zeros((classes, classes), np.int64)
    for predicted in predictions:
        np.add.at(confusion, (labels, predicted), 1)
    drawing = sheet("trainings", 4.2, width=13.0)
    left, middle, right = drawing.figure.subplots(1, 3, width_ratios=(1, 1, 1.05))
    for index, record in enumerate(records):
        training, test, correct = np.array(record.history).T
        epochs = np.arange(1, len(correct) + 1)
        colour, marker = COLOURS[index % len(COLOURS)], "." if len(epochs) == 1 else ""  # a line of one point is none
        left.semilogy(epochs, training, marker=marker, color=colour)
        left.semilogy(epochs, test, marker=marker, color=colour, linestyle="--")
        middle.plot(epochs, 100 * correct / record.test_samples, color=colour, label=f"seed {record.seed}")
        clean = record.clean
        middle.plot(clean.epoch, 100 * clean.accuracy, "o", color=colour, markeredgecolor="black")
    loss = (records[0].recipe or {}).get("loss", MSE)
    measured = "squared error of spike rates" if loss == MSE else loss
    left.set(xlabel="epoch", ylabel=measured, title="loss: training solid, test dashed")
    middle.set(xlabel="epoch", ylabel="test accuracy (%)", title="accuracy; circle: epoch of the clean protocol")
    middle.legend(loc="lower right")
    image = right.imshow(confusion, cmap="cividis")
    right.set(xlabel="decision", ylabel="class", title="confusion, last epoch")
    drawing.figure.colorbar(image, ax=right, label="test recordings")
    for axes in (left, middle):
        axes.locator_params(axis="x", integer=True)
        axes.grid()
    right.locator_params(integer=True)
    return drawing
