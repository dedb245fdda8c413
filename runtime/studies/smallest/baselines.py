"""Support vector machines on event counts: what no spiking network is needed for, and what they cost on a processor.

Prices are of operations in 45 nm at 0.9 V [1]_. At least, an inference takes its arithmetic (8-bit weights, 32-bit
sums) and its memory accesses; at most, every operation also takes instructions of a simple core, without SIMD, at the
published 70 pJ. A small processor lies between. Sleep, leakage and the sensor's interface are left out, as they are for
the chip; that 8 bits are enough is assumed.

References
----------
.. [1] M. Horowitz, "Computing's energy problem (and what we can do about it)", ISSCC 2014, figure 1.1.9.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.studies.smallest.space import Candidate
from spikeloom.runtime.studies.yardsticks import HOROWITZ

LINEAR, RBF = "linear-svm", "rbf-svm"

STRENGTHS = {LINEAR: (0.1, 0.01, 1.0), RBF: (10.0, 1.0, 3.0, 30.0)}
"""Constants C that are tried, the first on the first rung."""

PARTS = (1, 5, 10)

SOURCE = "Horowitz, ISSCC 2014, figure 1.1.9 (45 nm, 0.9 V): arithmetic, memory accesses, 70 pJ an instruction"

MISSING = "no baselines: support vector machines need scikit-learn; install it with pip install 'spikeloom[study]'"

SRAM = {8 << 10: 10.0, 32 << 10: 20.0, 1 << 20: 100.0}
"""pJ of an access to 64 bits in a memory of so many bytes."""

WORD = 8
"""Bytes of an access."""

INSTRUCTION = 70.0
"""pJ, fetched, decoded and carried out."""

# Instructions: for an event load, add, store and its address; for a product two loads and a multiply-accumulate
EVENT_INSTRUCTIONS, PRODUCT_INSTRUCTIONS = 4, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Processor:
    """An inference of a baseline on a small processor: operations, bytes of its model, joules at least and at most."""

    events: float
    products: int
    size: int
    least_j: float
    most_j: float


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


def processor(system: str, strength: float, data: Recordings, candidate: Candidate) -> Processor:
    """What an inference costs, fitted on all recordings."""
    seen = features(data, candidate)
    fitted = machine(system, strength).fit(seen, data.labels)[-1]
    if system == LINEAR:
        products, lookups = len(fitted.estimators_) * seen.shape[1], 0
    else:  # distances to all support vectors, an exponential of each, and a sum for each pair of classes
        vectors, classes = len(fitted.support_), len(fitted.classes_)
        products, lookups = vectors * (seen.shape[1] + classes - 1), vectors
    lookups += seen.shape[1] if candidate.options["counts"] == "log" else 0
    events = float(data.events.sum()) / len(data)
    counting, model = (_access(each) for each in (seen.shape[1], products))
    add, multiply = HOROWITZ["int32_add"], HOROWITZ["int8_multiply"]
    least = events * (add + 2 * counting) + products * (add + multiply + model / WORD) + lookups * counting
    instructions = EVENT_INSTRUCTIONS * events + PRODUCT_INSTRUCTIONS * products + 2 * lookups
    most = least + INSTRUCTION * instructions
    return Processor(events=events, products=products, size=products, least_j=1e-12 * least, most_j=1e-12 * most)


def _access(size: int) -> float:
    """PJ of an access to the smallest memory that holds so many bytes, or the largest."""
    return next((price for most, price in SRAM.items() if size <= most), max(SRAM.values()))
