"""What is in the recordings: support vector machines on event counts, for comparison with spiking networks.

    python benchmarks/features.py DATA [OUT.json]        (needs scikit-learn, which spikeloom does not)

Features are events per channel in so many equal parts of the trial, as they are or as log(1 + events), standardised on
the training split; or, as a network of longer bins sees them, bins of so many steps with an event. Chosen is nothing;
cross-validation is on the training split, five parts, shuffled from seed 0.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from made import made
from sklearn.model_selection import StratifiedKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from spikeloom.models.recordings.events import joined_bins, load_data
from spikeloom.models.recordings.evtouch import Recordings

KERNELS = {"linear": SVC(kernel="linear", C=0.1), "rbf": SVC(C=10.0)}

BINS = (2, 5, 10, 25, 50)


def counts(data: Recordings, parts: int) -> np.ndarray:
    """Events per channel and part of the trial, (samples, channels * parts) float64."""
    pieces = np.array_split(data.events, parts, axis=-1)
    return np.stack([piece.sum(axis=-1, dtype=np.float64) for piece in pieces], axis=-1).reshape(
        len(data), -1
    )


def main() -> None:
    """Fit, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", nargs="?", type=Path)
    arguments = parser.parse_args()
    training, test = (load_data(arguments.recordings, split) for split in ("train", "test"))
    folds = StratifiedKFold(5, shuffle=True, random_state=0)
    print("features             kernel   cross-validation   test")
    features = {}
    for parts in (1, 5, 10):
        for name, scale in (("events", np.asarray), ("log(1 + events)", np.log1p)):
            features[f"{parts:2} × {name}"] = [scale(counts(data, parts)) for data in (training, test)]
    for steps in BINS:
        features[f"bins of {steps} steps"] = [
            counts(joined_bins(data, steps), 1) for data in (training, test)
        ]
    found = []
    for words, (shown, held) in features.items():
        for kernel, machine in KERNELS.items():
            model = make_pipeline(StandardScaler(), machine)
            across = cross_val_score(model, shown, training.labels, cv=folds).mean()
            right = int(np.sum(model.fit(shown, training.labels).predict(held) == test.labels))
            row = {
                "features": words.strip(),
                "kernel": kernel,
                "cross_validation": round(across, 4),
                "correct": right,
            }
            found.append(row)
            print(f"{words:20} {kernel:8} {across:16.1%}   {right} of {len(test)} ({right / len(test):.1%})")
    if arguments.output:
        rows = made(training, test) | {"data": Path(arguments.recordings).name}
        rows |= {"test_samples": len(test), "machines": found}
        arguments.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
