"""Classifiers on event counts: what no spiking network is needed for, and what they cost on a processor.

Support vector machines on counts, and a ridge on counts, their rates, and products of the two.

Prices are those of :mod:`studies.processor`; that weights of 8 bits are enough is assumed.
"""

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.folds import Fold
from spikeloom.runtime.studies.processor import Processor, processor
from spikeloom.runtime.studies.smallest.space import Candidate

LINEAR = "linear-svm"
RBF = "rbf-svm"
RIDGE = "quadratic-ridge"

STRENGTHS = {LINEAR: (0.1, 0.01, 1.0), RBF: (10.0, 1.0, 3.0, 30.0), RIDGE: (10.0, 1.0, 100.0)}
"""Constants C, or penalties, that are tried, the first on the first rung."""

PARTS = (1, 5, 10)

MISSING = "no baselines: they need scikit-learn; install it with pip install 'spikeloom[study]'"

# For an event load, add and store a count; for a product two loads and a multiply-accumulate; two loads of a
# table
EVENT_CYCLES, PRODUCT_CYCLES, LOOKUP_CYCLES = 6, 5, 4


def baselines() -> Iterator[Candidate]:
    """All of them, if scikit-learn is there."""
    if find_spec("sklearn") is not None:
        for system in (LINEAR, RBF):
            for parts in PARTS:
                for counts in ("plain", "log"):
                    yield Candidate(system=system, options={"counts": counts, "parts": parts})
        yield Candidate(system=RIDGE, options={"counts": "log", "parts": 1})


def features(data: Recordings, candidate: Candidate) -> FloatArray:
    """Events of each channel in each part of a recording, or the logarithm of one more; (samples, features)."""
    flat = data.events.reshape(len(data), -1, data.steps)
    parts = np.array_split(flat, min(candidate.options["parts"], data.steps), axis=-1)
    counts = np.concatenate([part.sum(axis=-1, dtype=np.float64) for part in parts], axis=1)
    seen = np.log1p(counts) if candidate.options["counts"] == "log" else counts
    if candidate.system != RIDGE:
        return seen
    rates = counts / data.step_counts[:, None]
    linear = np.concatenate([seen, rates], axis=1)
    first, second = np.triu_indices(rates.shape[1])
    return np.concatenate([linear, rates[:, first] * rates[:, second]], axis=1)


def machine(system: str, strength: float) -> Any:
    """What is fitted: features of unit spread, then a support vector machine, if linear one plane for each class."""
    from sklearn.linear_model import RidgeClassifier
    from sklearn.multiclass import OneVsRestClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.svm import SVC

    if system == RIDGE:
        return make_pipeline(StandardScaler(), RidgeClassifier(alpha=strength))
    linear = OneVsRestClassifier(SVC(C=strength, kernel="linear"))
    return make_pipeline(StandardScaler(), linear if system == LINEAR else SVC(C=strength))


def decided(
    system: str, strength: float, seen: FloatArray, labels: IntArray, folds: Sequence[Fold]
) -> IntArray:
    """Class of each recording by a machine that did not see it."""
    found = np.empty_like(labels)
    for held in (fold.held for fold in folds):
        others = labels[~held]
        alike = (
            len(np.unique(others)) == 1
        )  # as where a condition holds all others, and nothing can be fitted
        found[held] = (
            others[0] if alike else machine(system, strength).fit(seen[~held], others).predict(seen[held])
        )
    return found


def priced(system: str, strength: float, data: Recordings, candidate: Candidate) -> Processor:
    """What an inference costs on a processor, fitted on all recordings."""
    seen = features(data, candidate)
    fitted = machine(system, strength).fit(seen, data.labels)[-1]
    if system == LINEAR:
        products, lookups = len(fitted.estimators_) * seen.shape[1], 0
    elif system == RIDGE:  # squares, then a plane for each class
        products, lookups = (len(fitted.classes_) + 1) * seen.shape[1], 0
    else:  # distances to all support vectors, an exponential of each, and a sum for each pair of classes
        vectors, classes = len(fitted.support_), len(fitted.classes_)
        products, lookups = vectors * (seen.shape[1] + classes - 1), vectors
    lookups += seen.shape[1] if candidate.options["counts"] == "log" else 0
    events = float(data.events.sum()) / len(data)
    return processor(
        adds=events + products,
        multiplies=products,
        accesses={seen.shape[1]: 2 * events + lookups, products: products / 8},
        cycles=EVENT_CYCLES * events + PRODUCT_CYCLES * products + LOOKUP_CYCLES * lookups,
    )
