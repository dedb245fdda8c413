"""What ``run`` prints: a decision for each recording, and the accuracy over those that have labels."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.models.recordings.eventfiles import UNLABELLED
from spikeloom.runtime.report.tables import percent, table

Json = dict[str, Any]


def run_json(files: tuple[str, ...], labels: IntArray, counts: IntArray, predictions: IntArray) -> Json:
    """Predictions and class spike counts of a run; the accuracy counts recordings with a label."""
    known = labels != UNLABELLED
    return {
        "samples": len(files),
        "labelled": int(np.count_nonzero(known)),
        "accuracy": float(np.mean(labels[known] == predictions[known])) if known.any() else None,
        "files": list(files),
        "labels": labels.tolist(),
        "predictions": predictions.tolist(),
        "counts": counts.tolist(),
    }


def run_text(report: Json) -> str:
    """Accuracy, recordings that went wrong, and decisions where no label is known."""
    rows = list(zip(report["files"], report["labels"], report["predictions"], report["counts"], strict=True))
    unknown = [row for row in rows if row[1] == UNLABELLED]
    known = [row for row in rows if row[1] != UNLABELLED]
    wrong = [row for row in known if row[1] != row[2]]
    lines = []
    if known:
        without = f", {len(unknown)} more without a label" if unknown else ""
        lines.append(f"chip accuracy: {percent(len(known) - len(wrong), len(known))}{without}")
    if wrong:
        cells = [[file, *map(str, (label, found, votes[label], votes[found]))] for file, label, found, votes in wrong]
        lines.append(table(["decided wrongly", "label", "decision", "votes for label", "for decision"], cells))
    if unknown:
        cells = [[file, str(found), str(counts[found])] for file, _, found, counts in unknown]
        lines.append(table(["without a label" if known else "recording", "decision", "votes"], cells))
    return "\n".join(lines)
