"""Counting networks, a TactileSGNet and support vector machines in nested cross-validation over all recordings.

    python benchmarks/nested.py DATA OUT.json [--levels 5] [--left-out speed=3600] [--jobs 2]     (needs scikit-learn)

Both splits are put together and parted five times five ways. In each training part every plan and strength, kernel and
constant is tried by cross-validation in five folds, plans within two standard errors of the best `--again` times;
the test part is decided once by what these chose, counting networks as they spike. `chosen` is the plan of fewest
neurons x steps whose accuracy is not lower than the best one's by more than a standard error of the difference,
recording by recording; `best` is the best at any price, its ramp too. `split` has the same for the split as released;
`rules` are single plans, decided by exact sums. The TactileSGNet is of one size, taken before any result of it on these
parts was seen; it is trained from another seed in each round, and decides on the chip, in 8 bits. Intervals (95 %) and
differences are bootstrapped over recordings. A system decides *as well as* another one if the interval of what the
other has ahead of it ends below `MARGIN`, which was set before, too. Parts that were measured before are not again.

`--left-out speed=3600`: DATA are the textures of `unseen.py`, and recordings of that condition stand for the released
test split.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from made import made as made_by
from sklearn.svm import SVC
from unseen import write_events, write_taxels

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.systems import TACTILESGNET
from spikeloom.compiler.targets.base import load_target
from spikeloom.models.recordings.events import joined_bins, load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.counters import (
    FOLDS,
    Counted,
    Fitted,
    Plan,
    counters_of,
    cross_validate,
    fit_rules,
    run_counters,
    split_folds,
)
from spikeloom.runtime.inputs.checkpoint import load_graph
from spikeloom.runtime.requests.choices import SensorChoice
from spikeloom.runtime.studies.counting import decisions_of
from spikeloom.runtime.studies.search.measure import decisions
from spikeloom.runtime.studies.smallest.space import JOINS, USUAL_STEPS, Candidate
from spikeloom.runtime.studies.smallest.trained import Sensor, plan_of, without

Json = dict[str, Any]

ROUNDS, DRAWS = 5, 10_000

FOUR, EIGHT = (1, 4, 16, 64), (1, 2, 4, 8, 16, 32, 64, 128)
TWELVE = (1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 130)

SMALL = [
    (bins, parts, events)
    for bins, parts, events in product((1, 5, 10, 25), (1, 2, 3), (FOUR, EIGHT, TWELVE))
]
LARGE = [(bins, parts, TWELVE) for bins, parts in product((1, 5), (6, 10))]
STRENGTHS = (0.03, 0.1, 0.3)
LONG_RAMP = 256

NETWORK = Candidate(
    system=TACTILESGNET,
    options={"recipe": "rates", "features": 32, "hops": 3, "hidden": "128", "spike_penalty": 0.3},
)
"""One of the sizes of ``smallest``, in bins that give its usual number of steps."""

EPOCHS = 72
MARGIN = 0.02

KERNELS = {"linear SVM": (0.003, 0.01, 0.1), "RBF SVM": (1.0, 3.0, 30.0)}
SVM_PARTS = (1, 3, 10)


def name_of(plan: Plan) -> str:
    """What tells a plan from the others."""
    levels = f", levels {plan.levels}" if plan.levels > 1 else ""
    return f"bins {plan.bins}, parts {plan.parts}, {len(plan.thresholds)} thresholds{levels}"


def whole(path: str, taxels: int | None = None) -> tuple[Recordings, int]:
    """Recordings of both splits, and how many are of the training split; shorter ones end in bins without events."""
    training, test = (load_data(path, split, taxels=taxels) for split in ("train", "test"))
    steps = max(training.steps, test.steps)
    events = [np.pad(each.events, [(0, 0)] * 3 + [(0, steps - each.steps)]) for each in (training, test)]
    both = replace(
        training,
        held=np.concatenate(events),
        lengths=None
        if training.lengths is None is test.lengths
        else np.concatenate([training.step_counts, test.step_counts]),
        labels=np.concatenate([training.labels, test.labels]),
        files=training.files + test.files,
        split="both",
    )
    return both, len(training)


def parted(data: Recordings, training: int) -> dict[str, np.ndarray]:
    """Which recordings are held out: those released as test split, and each fifth in five rounds."""
    held = {"split": np.arange(len(data)) >= training}
    for number in range(ROUNDS):
        fold = split_folds(data.labels, FOLDS, np.random.default_rng(1000 + number))
        held |= {f"{number}.{each}": fold == each for each in range(FOLDS)}
    return held


def measured_parts(
    split: Mapping[str, np.ndarray],
    store: Path,
    measure: Callable[[np.ndarray, np.ndarray], Json],
    jobs: int = 1,
) -> Json:
    """What is found for each part, so many `jobs` at a time; parts that the store knows are not measured again."""
    done: Json = json.loads(store.read_text()) if store.exists() else {}
    missing = {name: held for name, held in split.items() if name not in done}
    work = (delayed(measure)(np.flatnonzero(~held), np.flatnonzero(held)) for held in missing.values())
    for name, found in zip(missing, Parallel(jobs, return_as="generator")(work), strict=True):
        done[name] = found
        store.write_text(json.dumps(done))
        print(name, flush=True)
    return done


def write(output: Path, source: str, data: Recordings, training: int, found: Json) -> None:
    """Store what was found, and on what."""
    halves = data.part(slice(training)), data.part(slice(training, None))
    whole = made_by(*halves) | {"data": Path(source).name, "recordings": len(data)} | found
    with write_atomically(output) as file:
        file.write(json.dumps(whole, indent=1).encode() + b"\n")


def price(data: Counted, classes: int) -> int:
    """Neurons x steps of a plan, with all counters that would be used."""
    counters = int(((data.spikes > 0).sum(axis=0) >= 3).sum())
    gates = len(data.counter) // len(data.plan.thresholds) if data.plan.parts > 1 else 0
    return (gates + counters + 2 * classes) * (data.steps + data.plan.ramp)


def tried(data: Counted, classes: int, seeds: Sequence[int] = (0,)) -> tuple[float, np.ndarray, float]:
    """Best strength of a plan on training recordings, how often each is right, and the lowest largest sum."""
    sums = [cross_validate(data, classes, seed=seed) for seed in seeds]
    right = {
        name: np.mean([each[name].argmax(axis=1) == data.labels for each in sums], axis=0)
        for name in sums[0]
    }
    best = max(right, key=lambda strength: right[strength].mean())
    return best, right[best], min(float(each[best].max(axis=1).min()) for each in sums)


def able(right: Mapping[str, np.ndarray], errors: float = 1.0) -> list[str]:
    """Plans that are not worse than the best one by more than so many standard errors of the difference."""
    best = max(right, key=lambda name: right[name].mean())
    behind = {name: right[best] - each for name, each in right.items()}
    return [name for name, each in behind.items() if each.mean() <= errors * each.std() / np.sqrt(len(each))]


def measured(
    data: Recordings, all_counted: Mapping[str, Counted], rows: np.ndarray, held: np.ndarray, again: int = 1
) -> Json:
    """All systems, chosen and fitted on some recordings, on the others."""
    training, test, classes = data.part(rows), data.part(held), int(data.labels.max()) + 1
    found: Json = {"rules": {}, "systems": {}}
    once, trials, own_of = {}, {}, {}
    for name, each in all_counted.items():
        own = each.part(rows)
        once[name] = strength, trials[name], _ = tried(own, classes)
        rule = fit_rules(own, classes, [strength])[strength]
        own_of[name] = own
        correct = rule.right(each.part(held))
        found["rules"][name] = {
            "held_out": float(trials[name].mean()),
            "right": correct.astype(int).tolist(),
        }
    prices = {name: price(own, classes) for name, own in own_of.items()}
    for levels in sorted({each.plan.levels for each in all_counted.values()}):
        names = able({name: trials[name] for name in trials if all_counted[name].plan.levels == levels}, 2.0)
        tried_again = {
            name: tried(own_of[name], classes, range(again)) if again > 1 else once[name] for name in names
        }
        right = {name: each[1] for name, each in tried_again.items()}
        chosen = min(able(right), key=prices.__getitem__)
        best = max(right, key=lambda name: (right[name].mean(), -prices[name]))
        for system, name in (("chosen", chosen), ("best", best)):
            own, (strength, _, lowest) = own_of[name], tried_again[name]
            if system == "best":
                own = replace(own, plan=replace(own.plan, ramp=LONG_RAMP))
            rule = fit_rules(own, classes, [strength])[strength]
            fitted = Fitted(rule=rule, strength=strength, accuracy={}, lowest=lowest)
            made = counters_of(own, fitted, training, classes)
            found["systems"][f"{system}, levels" if levels > 1 else system] = {
                "plan": name,
                "strength": strength,
                "counters": len(made.counter),
                "neuron_steps": price(own, classes),
                "held_out": float(right[name].mean()),
                "right": (decisions_of(made, test) == test.labels).astype(int).tolist(),
            }
    found["systems"] |= machines(data, rows, held)
    return found


def network(data: Recordings, sensor: Sensor, seed: int, _: np.ndarray, held: np.ndarray) -> Json:
    """Decisions on recordings that are held out, of a TactileSGNet trained on the others, on the chip."""
    steps = float(np.median(data.step_counts))
    join = min(JOINS, key=lambda join: abs(np.log(steps / join / USUAL_STEPS)))
    plan = plan_of(replace(NETWORK, options={**NETWORK.options, "join": join}), sensor, data)
    without_them = np.zeros(len(data), bool)
    without_them[held] = True
    netlist = without(plan, data, without_them, EPOCHS, load_target("loihi1"), seed=seed)
    decided = decisions(netlist, joined_bins(data, plan.bins).part(held))
    right = (decided == data.labels[held]).astype(int)
    return {"join": join, "seed": seed, "right": right.tolist()}


def machines(data: Recordings, rows: np.ndarray, held: np.ndarray) -> Json:
    """Support vector machines on log(1 + events) of each channel in parts, chosen by the same folds."""
    label, found = data.labels[rows], {}
    fold = split_folds(label, FOLDS, np.random.default_rng(0))
    for kernel, constants in KERNELS.items():
        trials: dict[tuple[int, float], tuple[float, list[int]]] = {}
        for parts in SVM_PARTS:
            pieces = np.array_split(data.events, parts, axis=-1)
            seen = np.log1p(np.stack([each.sum(axis=-1, dtype=float) for each in pieces])).transpose(
                1, 0, 2, 3
            )
            seen = seen.reshape(len(data), -1)
            seen = seen[:, seen[rows].std(axis=0) > 0]
            seen = (seen - seen[rows].mean(axis=0)) / seen[rows].std(axis=0)
            alike = seen @ seen.T / seen.shape[1]
            if kernel == "linear SVM":
                alike *= seen.shape[1]
            else:
                own = np.diag(alike)
                alike = np.exp(2 * alike - own[:, None] - own)
            for constant in constants:
                right = 0
                for each in range(FOLDS):
                    inner, outer = rows[fold != each], rows[fold == each]
                    machine = SVC(C=constant, kernel="precomputed").fit(
                        alike[np.ix_(inner, inner)], data.labels[inner]
                    )
                    right += int((machine.predict(alike[np.ix_(outer, inner)]) == data.labels[outer]).sum())
                machine = SVC(C=constant, kernel="precomputed").fit(alike[np.ix_(rows, rows)], label)
                correct = machine.predict(alike[np.ix_(held, rows)]) == data.labels[held]
                trials[parts, constant] = right / len(rows), correct.astype(int).tolist()
        parts, constant = max(trials, key=lambda each: trials[each][0])
        accuracy, correct = trials[parts, constant]
        found[kernel] = {"parts": parts, "C": constant, "held_out": accuracy, "right": correct}
    return found


def spread(share: np.ndarray, draws: np.ndarray) -> list[float]:
    """Mean of a share per recording and its interval over draws of recordings."""
    means = share[draws].mean(axis=1)
    return [round(float(each), 5) for each in (share.mean(), *np.quantile(means, (0.025, 0.975)))]


def summary(parts: Sequence[Json], tests: Sequence[np.ndarray], samples: int) -> Json:
    """Accuracy of each system and plan over rounds, and what a system has ahead of each other one."""
    draws = np.random.default_rng(0).integers(0, samples, (DRAWS, samples))
    found: Json = {}
    for kind in ("systems", "rules"):
        share = {name: np.zeros(samples) for name in parts[0][kind]}
        for part, test in zip(parts, tests, strict=True):
            for name, each in part[kind].items():
                share[name][test] += np.array(each["right"]) / ROUNDS
        found[kind] = {name: {"accuracy": spread(each, draws)} for name, each in share.items()}
        if kind == "systems":
            for name, each in share.items():
                ahead = {
                    other: spread(each - theirs, draws) for other, theirs in share.items() if other != name
                }
                plans: dict[str, int] = {}
                for part in parts:
                    plan = part[kind][name].get("plan", "")
                    plans[plan] = plans.get(plan, 0) + 1
                found[kind][name] |= {
                    "ahead_of": ahead,
                    "as_well_as": [other for other, each in ahead.items() if each[1] > -MARGIN],
                    "plans": dict(sorted(plans.items(), key=lambda p: -p[1])),
                }
    return found


def main() -> None:
    """Measure what is missing, write after each part, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument(
        "--levels", type=int, default=1, help="classes in a row that are levels of one thing"
    )
    parser.add_argument("--again", type=int, default=1, help="cross-validations of plans near the best one")
    parser.add_argument("--ramp", type=int, default=32, help="steps of the read-out; twice for levels")
    parser.add_argument("--left-out", metavar="CONDITION", help="of textures, for the test split")
    parser.add_argument("--jobs", type=int, default=1, help="networks and parts at a time")
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        files, sensor = arguments.recordings, SensorChoice(graph="manual")
        if arguments.left_out:
            write_events(Path(files), Path(folder), arguments.left_out)
            files, taxels = folder, write_taxels(Path(folder) / "taxels.csv")
            sensor = SensorChoice(graph="knn:4", taxels=str(taxels))
        graph = load_graph(sensor)
        assert graph is not None, "one is named"
        data, training = whole(files, len(graph.coordinates))
    plans = [
        Plan(
            bins=bins,
            parts=parts,
            thresholds=events,
            strengths=STRENGTHS,
            levels=levels,
            ramp=arguments.ramp * min(levels, 2),
        )
        for levels in sorted({1, arguments.levels})
        for bins, parts, events in SMALL + LARGE
    ]
    all_counted, too_fine = {}, []
    for plan in plans:
        try:
            all_counted[name_of(plan)] = run_counters(data, plan)
        except OptionError as error:  # More parts than the shortest recording has
            too_fine.append(f"{name_of(plan)}: {error}")
    split = parted(data, training)
    networks: Json = {}
    for seed in range(ROUNDS):
        parts = {name: held for name, held in split.items() if name.startswith((f"{seed}.", "split"))}
        store = arguments.output.with_suffix(".networks.json")
        measure = partial(network, data, Sensor(graph=graph), seed)
        networks |= measured_parts(parts, store, measure, arguments.jobs)
    done = measured_parts(
        split,
        arguments.output.with_suffix(".parts.json"),
        partial(measured, data, all_counted, again=arguments.again),
        arguments.jobs,
    )
    for name, each in networks.items():
        done[name]["systems"][NETWORK.system] = each
    nested = [name for name in split if name != "split"]
    found: Json = {"rounds": ROUNDS, "folds": FOLDS, "not_tried": too_fine}
    found["nested"] = summary([done[name] for name in nested], [split[name] for name in nested], len(data))
    own = done["split"]
    found["split"] = {
        kind: {
            name: {key: value for key, value in each.items() if key != "right"}
            | {"test_correct": sum(each["right"]), "test_samples": len(each["right"])}
            for name, each in own[kind].items()
        }
        for kind in ("systems", "rules")
    }
    write(arguments.output, arguments.recordings, data, training, found)
    for name, each in found["nested"]["systems"].items():
        mean, low, high = (100 * value for value in each["accuracy"])
        test = found["split"]["systems"][name]
        print(
            f"{name:16} {mean:.2f} ({low:.2f} … {high:.2f})   test {test['test_correct']} of {test['test_samples']}"
        )


if __name__ == "__main__":
    main()
