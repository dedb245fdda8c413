"""The smallest network for some recordings: candidates by successive halving, a choice, and what that reaches.

On the first rung every candidate is cross-validated once at one strength; what may still be chosen goes on, with more
strengths, and from there to five rounds. Everything happens on the training split but the last look at the choice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from spikeloom.compiler import __version__, write_netlist
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.targets.base import Target
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.studies.chart.results import ChosenBy, Data, share
from spikeloom.runtime.studies.counting import train_counters
from spikeloom.runtime.studies.fronts import Budget, front
from spikeloom.runtime.studies.jobs import sweep
from spikeloom.runtime.studies.pruning.trials import priced
from spikeloom.runtime.studies.smallest import choice, work
from spikeloom.runtime.studies.smallest.baselines import baselines
from spikeloom.runtime.studies.smallest.results import RUNGS, Checked, Smallest, Tried
from spikeloom.runtime.studies.smallest.space import Candidate, variants
from spikeloom.runtime.studies.smallest.trained import Sensor, arguments, compiled, plan_of
from spikeloom.runtime.studies.training import Job, run_job


def smallest(
    candidates: Iterable[Candidate],
    splits: tuple[Recordings, Recordings],
    data: Data,
    target: Target,
    budgets: Sequence[Budget],
    store: Path,
    output: str,
    *,
    sensor: Sensor,
    command: str,
    jobs: int | None = None,
    fresh: bool = False,
) -> Smallest:
    """Search as far as the store does not know, choose, train the choice anew and write network and netlist.

    `splits` are training and test recordings; `command` repeats it.
    """
    trial = partial(work.trial, data=data, sensor=sensor, target=target.name)
    beside = search(baselines(), most_accurate, trial, store, jobs=jobs, fresh=fresh)
    tried = search(candidates, choice.going_on, trial, store, jobs=jobs)
    taken = choice.choose(tried, budgets)
    best = tried[taken.best - 1]
    tried = [_beside(each, best, tried) for each in tried]
    times = {table.name: table.title for table in target.time}
    by = ChosenBy(energy=next(iter(taken.cheapest)), time=next(iter(times), None))
    chosen = tried[taken.cheapest[by.energy] - 1]
    checked, commands = train_again(chosen.candidate, sensor, splits, data, target, output)
    return Smallest(
        spikeloom=__version__,
        command=command,
        target=target.name,
        data=data,
        tables={"energy": {table.name: table.title for table in target.energy}, "time": times},
        chosen_by=by,
        tried=tuple(tried),
        baselines=tuple(_beside(each, best, ()) for each in beside),
        choice=taken,
        checked=checked,
        commands=commands,
    )


def search(
    candidates: Iterable[Candidate],
    going_on: Callable[[Sequence[Tried], int], Sequence[Tried]],
    trial: Callable[[Candidate, int, float | None], work.Trial],
    store: Path,
    *,
    jobs: int | None,
    fresh: bool = False,
) -> list[Tried]:
    """All candidates, as far as each came; `going_on` chooses those that go on from a rung."""
    known: dict[str, Tried] = {}
    alive = list(candidates)
    for rung in range(1, RUNGS + 1):
        before = [known.get(each.name) for each in alive]
        works = [
            trial(each, rung, None if old is None else old.setting) for each, old in zip(alive, before, strict=True)
        ]
        label = f"rung {rung} of {RUNGS}"
        anew = fresh and rung == 1
        found = sweep(works, work.measure, store, jobs=jobs, fresh=anew, label=label, kind=work.Measured)
        for candidate, old, each in zip(alive, before, works, strict=True):
            measured = found[each.key]
            if old is not None and measured.costs is None:
                measured = replace(measured, costs=old.costs, refused=old.refused)
            number = len(known) + 1 if old is None else old.number
            known[candidate.name] = _tried(number, candidate, rung, measured)
        if rung < RUNGS:
            on = [each.candidate for each in going_on([known[c.name] for c in alive], rung)]
            extra = [other for each in on for other in variants(each)] if rung == 1 else []
            alive = list({each.name: each for each in (*on, *extra)}.values())
    return list(known.values())


def most_accurate(tried: Sequence[Tried], rung: int) -> list[Tried]:
    """Baselines that go on from a rung: three of each kind, then one."""
    ordered = sorted(tried, key=lambda each: -each.accuracy)
    kinds = dict.fromkeys(each.candidate.system for each in tried)
    return [each for kind in kinds for each in [e for e in ordered if e.candidate.system == kind][: {1: 3, 2: 1}[rung]]]


def _tried(number: int, candidate: Candidate, rung: int, measured: work.Measured) -> Tried:
    right, recordings = choice.accuracy(measured), int(np.count_nonzero(measured.tried))
    low, high = wilson(right * recordings, recordings)
    return Tried(
        number=number,
        candidate=candidate,
        rung=rung,
        accuracy=right,
        low=low,
        high=high,
        setting=measured.setting,
        costs=measured.costs,
        refused=measured.refused,
        processor=measured.processor,
        measured=measured,
    )


def _beside(each: Tried, best: Tried, tried: Sequence[Tried]) -> Tried:
    """A candidate with what the best has ahead of it, and whether it is on the front of those that came as far."""
    behind, error = choice.gap(best.measured, each.measured)
    peers = [other for other in tried if other.rung == each.rung and other.costs is not None]
    marks = front([other.accuracy for other in peers], [choice.energy(other) for other in peers])
    on = any(mark and other.number == each.number for mark, other in zip(marks, peers, strict=True))
    return replace(each, behind=behind, behind_error=error, front=on)


# -- the choice --------------------------------------------------------------------------------------------------------


def train_again(
    candidate: Candidate,
    sensor: Sensor,
    splits: tuple[Recordings, Recordings],
    data: Data,
    target: Target,
    output: str,
) -> tuple[Checked, tuple[str, ...]]:
    """Train a candidate on the whole training split, compile and verify it, then read the test split; the commands."""
    training, test = splits
    network, counts = str(Path(output).with_suffix(".pt")), candidate.system == COUNTING
    typed = [*repeat.words({"bin": data.bin_s, **sensor.options_of(candidate.system)}), *candidate.words]
    typed += [] if counts else ["--keep", "last"]
    command = repeat.command("train", "--data", Path(data.path).name, *typed)
    if counts:
        sha256 = train_counters(candidate.plan(), training, test, command, network).sha256
    else:
        job = Job(
            plan=plan_of(candidate, sensor, training),
            training=training,
            test=test,
            epochs=candidate.options["epochs"],
            seed=0,
            resume=False,
            output=Path(network),
            keep=("last",),
            command=command,
            position=0,
        )
        sha256 = run_job(job).sha256
    progress("compiling")
    loaded = load_network(network, arguments(target))
    netlist = compiled(loaded, target, None if counts else joined_bins(training, loaded.network.input.bins))
    netlist_sha256 = write_netlist(netlist, output)
    train, held = (of_length(joined_bins(each, netlist.bins), netlist.clocks.length) for each in (training, test))
    progress("verifying")
    of = {"train": train, "test": held}
    verdicts = {
        split: verify(netlist, loaded.model, each.events, each.labels, each.files, lengths=each.lengths)
        for split, each in of.items()
    }
    seen = verdicts["train"]
    _, costs = priced(netlist, work.some(train))
    right = int(np.count_nonzero(verdicts["test"].chip_predictions == held.labels))
    checked = Checked(
        network=network,
        network_sha256=sha256,
        netlist=output,
        netlist_sha256=netlist_sha256,
        different=sum(each.different for each in seen.spikes.values()),
        levels=seen.levels,
        equal={split: int(np.sum(v.float_predictions == v.chip_predictions)) for split, v in verdicts.items()},
        right=share(right, len(held)),
        costs=costs,
    )
    read = repeat.words({"data": data.path, "bin": data.bin_s})
    rounding = [] if counts else repeat.words({"weight_bits": 8, "calibrate": data.path})
    return checked, (
        repeat.command("train", "--data", data.path, *typed, "-o", network),
        repeat.command("compile", network, *rounding, "-o", output),
        repeat.command("verify", output, "--checkpoint", network, *read),
        repeat.command("estimate", output, *read),
    )
