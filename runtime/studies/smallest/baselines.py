"""Support vector machines on event counts: what no spiking network is needed for, and what they cost on a processor.

Prices are those of :mod:`studies.processor`; that weights of 8 bits are enough is assumed.
"""

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.studies.processor import Processor, processor
from spikeloom.runtime.studies.smallest.space import Candidate

LINEAR, RBF = "linear-svm", "rbf-svm"

STRENGTHS = {LINEAR: (0.1, 0.01, 1.0), RBF: (10.0, 1.0, 3.0, 30.0)}
"""Constants C that are tried, the first on the first rung."""

PARTS = (1, 5, 10)

MISSING = (
    "no baselines: support vector machines need scikit-learn; install it with pip install 'spikeloom[study]'"
)

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


def features(data: Recordings, candidate: Candidate) -> FloatArray:
    """Events of each channel in each part of a recording, or the logarithm of one more; (samples, features)."""
    flat = data.events.reshape(len(data), -1, data.steps)
    parts = np.array_split(flat, min(candidate.options["parts"], data.steps), axis=-1)
    counts = np.concatenate([part.sum(axis=-1, dtype=np.float64) for part in parts], axis=1)
    return np.log1p(counts) if candidate.options["counts"] == "log" else counts


def machine(system: str, strength: float) -> Any:
    """What is fitted: features of unit spread, then a support vector machine, if linear one plane for each class."""
    from sklearn.multiclass import OneVsRestClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.svm import SVC

    linear = OneVsRestClassifier(SVC(C=strength, kernel="linear"))
    return make_pipeline(StandardScaler(), linear if system == LINEAR else SVC(C=strength))


def decided(system: str, strength: float, seen: FloatArray, labels: IntArray, fold: IntArray) -> IntArray:
    """Class of each recording by a machine that did not see it."""
    found = np.empty_like(labels)
    for held in np.unique(fold):
        fitted = machine(system, strength).fit(seen[fold != held], labels[fold != held])
        found[fold == held] = fitted.predict(seen[fold == held])
    return found


def priced(system: str, strength: float, data: Recordings, candidate: Candidate) -> Processor:
    """What an inference costs on a processor, fitted on all recordings."""
    seen = features(data, candidate)
    fitted = machine(system, strength).fit(seen, data.labels)[-1]
    if system == LINEAR:
        products, lookups = len(fitted.estimators_) * seen.shape[1], 0
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
