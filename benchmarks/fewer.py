"""Counting networks with fewer taxels, on the first part of a recording, and both: how much is lost.

    python benchmarks/fewer.py DATA OUT.json [--thresholds 1,4,16,64] [--parts 1] [--join 1] [--levels 1] [--ramp 32]

As `nested.py` parts all recordings five times five ways, and beside it as released. In each training part the taxels
that matter least are left out a few at a time, by what their counters add to the sums of a rule fitted without the
ones before; then the strength is chosen in five folds, and the spiking network decides the test part. Intervals (95 %)
and differences are bootstrapped over recordings. Parts that were measured before are not again.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from nested import DRAWS, ROUNDS, measured_parts, parted, spread, tried, whole, write

from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.counters import (
    Counted,
    Fitted,
    Plan,
    counters_of,
    fit_rules,
    run_counters,
)
from spikeloom.runtime.studies.counting import decisions_of

Json = dict[str, Any]

OPTIONS = ("thresholds", "parts", "join", "levels", "ramp")
STRENGTHS = (0.03, 0.1, 0.3)
KEPT = (39, 30, 20, 15, 10, 5)
WINDOWS = {100: KEPT, 75: (39, 20), 50: KEPT, 25: (39, 20)}


def order(data: Counted, polarities: int, classes: int) -> dict[int, np.ndarray]:
    """Taxels that are left of a sensor, by how many; chosen on these recordings."""
    taxel = data.counter[:, 0] // polarities
    left = np.unique(taxel)
    found = {}
    for kept in KEPT:
        if kept < len(left):
            columns = np.flatnonzero(np.isin(taxel, left))
            rule = fit_rules(only(data, columns), classes, [0.1])[0.1]
            spiked = (data.spikes[:, columns[rule.used]] > 0).mean(axis=0)
            adds = (rule.weight - rule.weight.mean(axis=0)).var(axis=0) * spiked * (1 - spiked)
            matters = np.bincount(taxel[columns[rule.used]], adds, minlength=left.max() + 1)[left]
            left = np.sort(left[np.argsort(-matters)[:kept]])
        found[kept] = left
    return found


def only(data: Counted, columns: np.ndarray) -> Counted:
    """Some of the counters."""
    return replace(
        data, counter=data.counter[columns], spikes=data.spikes[:, columns], at=data.at[:, columns]
    )


def measured(data: Recordings, of_window: dict[int, Counted], rows: np.ndarray, held: np.ndarray) -> Json:
    """Which of some recordings each network decides rightly that was fitted on the others."""
    training, test, classes = data.part(rows), data.part(held), int(data.labels.max()) + 1
    polarities, found = data.events.shape[2], {}
    for window, every in of_window.items():
        own = every.part(rows)
        left = order(own, polarities, classes)
        for kept in WINDOWS[window]:
            few = only(own, np.flatnonzero(np.isin(own.counter[:, 0] // polarities, left[kept])))
            strength, _, lowest = tried(few, classes)
            rule = fit_rules(few, classes, [strength])[strength]
            fitted = Fitted(rule=rule, strength=strength, accuracy={}, lowest=lowest)
            made = counters_of(few, fitted, training, classes)
            found[f"{kept} taxels, {window} %"] = {
                "counters": len(made.counter),
                "taxels": left[kept].tolist(),
                "right": (decisions_of(made, test) == test.labels).astype(int).tolist(),
            }
    return found


def main() -> None:
    """Measure what is missing, write after each part, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--thresholds", default="1,4,16,64")
    for name in OPTIONS[1:]:
        parser.add_argument(f"--{name}", type=int, default=32 if name == "ramp" else 1)
    arguments = parser.parse_args()
    data, training = whole(arguments.recordings)
    plan = Plan(
        thresholds=tuple(map(int, arguments.thresholds.split(","))),
        parts=arguments.parts,
        bins=arguments.join,
        levels=arguments.levels,
        ramp=arguments.ramp,
        strengths=STRENGTHS,
    )
    of_window = {window: run_counters(data, replace(plan, window=window)) for window in WINDOWS}
    split = parted(data, training)
    done = measured_parts(
        split,
        arguments.output.with_suffix(".parts.json"),
        lambda rows, held: measured(data, of_window, rows, held),
    )
    draws = np.random.default_rng(0).integers(0, len(data), (DRAWS, len(data)))
    share = {point: np.zeros(len(data)) for point in done["split"]}
    for name, held in split.items():
        if name != "split":
            for point, each in done[name].items():
                share[point][held] += np.array(each["right"]) / ROUNDS
    points = {}
    first = next(iter(share.values()))
    for point, each in share.items():
        own = done["split"][point]
        points[point] = {
            "accuracy": spread(each, draws),
            "behind": spread(first - each, draws),
            "counters": own["counters"],
            "taxels": own["taxels"],
            "test_correct": sum(own["right"]),
        }
        mean, low, high = (100 * value for value in points[point]["accuracy"])
        print(
            f"{point:18} {mean:.2f} ({low:.2f} … {high:.2f})   test {sum(own['right'])} of {len(own['right'])}"
        )
    plan_words = {name: getattr(arguments, name) for name in OPTIONS}
    found: Json = {"test_samples": len(data) - training, "plan": plan_words, "points": points}
    write(arguments.output, arguments.recordings, data, training, found)


if __name__ == "__main__":
    main()
