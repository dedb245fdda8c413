"""Trainings without a part of the training recordings, which they then decide: parts at random, and conditions."""

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.conditions import conditions
from spikeloom.models.recordings.counts import number
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.counters import FOLDS, Counted, fit_rules
from spikeloom.models.training.folds import Fold, folds_of
from spikeloom.models.training.plan import Plan, seen_by
from spikeloom.models.training.record import Held
from spikeloom.runtime.report.conditions import UNSEEN, right_table, worst_and_best
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import Table, Text
from spikeloom.runtime.studies.jobs import Job, content_key, sweep

AT_RANDOM = "parts at random"


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut:
    """Right decisions of recordings that were left out: a fifth of each class at a time, and a condition at a time.

    At random every recording is left out once, by conditions once for each group.
    """

    at_random: Held
    conditions: Mapping[str, Held]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial(Job):
    """One training without the recordings of a fold."""

    plan: Plan
    training: Recordings
    epochs: int
    seed: int
    fold: Fold


def condition_folds(training: Recordings, groups: str) -> list[Fold]:
    """Conditions of recordings, of which each is left out once; OptionError if they have none."""
    if not conditions(training):
        raise OptionError(
            f"--groups {groups}: all training recordings of {training.source} have the same; name another, or omit it"
        )
    return [fold for round_ in folds_of(training, 1) for fold in round_]


def announce(groups: str, folds: Sequence[Fold], *, parts: int = FOLDS) -> None:
    """Say how many trainings there will be: of conditions, and of parts at random."""
    apart = f" and of {parts} parts at random" if parts else ""
    count = number(parts + len(folds), "more training")
    tell(f"--groups {groups}: {count}, without each of {number(len(folds), 'condition')}{apart}")


def networks_left_out(
    plan: Plan, training: Recordings, folds: Sequence[Fold], *, epochs: int, seed: int, store: Path
) -> LeftOut:
    """Train networks by gradients side by side, and read them at their last epoch; a `store` keeps what is finished.

    `training` are in their own bins. The text of a KeyboardInterrupt says how to go on.
    """
    at_random = folds_of(training, 1, at_random=True)[0]
    trials = [_trial(plan, training, fold, epochs, seed) for fold in [*at_random, *folds]]
    try:
        found = sweep(trials, measure, store, label="leaving out", kind=Held)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(f"{interrupt} and --resume") from interrupt
    held = [found[trial.key] for trial in trials]
    parts = held[: len(at_random)]
    return LeftOut(
        at_random=Held(
            correct=sum(part.correct for part in parts), samples=sum(part.samples for part in parts)
        ),
        conditions=dict(zip(map(_name, folds), held[len(at_random) :], strict=True)),
    )


def _name(fold: Fold) -> str:
    return fold.condition or AT_RANDOM


def _trial(plan: Plan, training: Recordings, fold: Fold, epochs: int, seed: int) -> Trial:
    """Work whose key is of everything that decides the result."""
    from spikeloom.models.network_kinds import kind_of  # torch, so only here

    arrays = {"held": fold.held, "graph": seen_by(plan)} | training.identity()
    about = {
        "spikeloom": __version__,
        "arrays": arrays_digest(arrays),
        "architecture": repr(kind_of(plan.system).architecture(plan)),
        "recipe": plan.recipe.to_json(),
        "bins": plan.bins,
        "epochs": epochs,
        "seed": seed,
    }
    return Trial(
        key=content_key(about),
        label=f"without {_name(fold)}",
        plan=plan,
        training=training,
        epochs=epochs,
        seed=seed,
        fold=fold,
    )


def measure(work: Trial) -> JsonObject:
    """Train without a fold; the JSON of a :class:`Held`."""
    from spikeloom.models.network_kinds import kind_of  # torch, so only here
    from spikeloom.models.training.train import train

    plan = work.plan
    steps = joined_bins(work.training, plan.bins)
    with redirect_stderr(io.StringIO()):  # no bars of several processes on one terminal
        trained = train(
            steps.part(~work.fold.held),
            steps.part(work.fold.held),
            seen_by(plan),
            kind_of(plan.system).architecture(plan),
            epochs=work.epochs,
            seed=work.seed,
            recipe=plan.recipe,
        )
    last = trained.history[-1]
    found: JsonObject = encode(Held(correct=last.correct, samples=last.tested))
    return found


def counters_left_out(
    data: Counted, classes: int, strength: float, at_random: Held, folds: Sequence[Fold]
) -> LeftOut:
    """The same for the rule of a counting network, whose strength was chosen by parts `at_random`."""
    found = {}
    for fold in folds:
        rule = fit_rules(data.part(~fold.held), classes, [strength])[strength]
        right = rule.right(data.part(fold.held))
        found[_name(fold)] = Held(correct=int(np.count_nonzero(right)), samples=len(right))
    return LeftOut(at_random=at_random, conditions=found)


def left_out_blocks(found: LeftOut | None) -> list[Text | Table]:
    """What was left out, for people; or that nothing was."""
    if found is None:
        return [Text(f"{UNSEEN}; --groups leaves them out in turn")]
    right = {AT_RANDOM: found.at_random, **found.conditions}
    table = right_table(
        "training recordings left out", {name: (each.correct, each.samples) for name, each in right.items()}
    )
    accuracies = {name: each.correct / each.samples for name, each in found.conditions.items()}
    return [table, Text(f"conditions not seen in training: {worst_and_best(accuracies)}")]
