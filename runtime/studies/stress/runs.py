"""One perturbation at one level, run on both sides at once and counted."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from spikeloom.runtime.equivalence.breakdowns import undecided
from spikeloom.runtime.studies.stress.battery import NAMES, Level
from spikeloom.runtime.studies.stress.bench import Bench, by_length, whole
from spikeloom.runtime.studies.stress.pair import SIDES, Inputs, Outcome, evaluate, ready
from spikeloom.runtime.studies.stress.results import Run


def generator(name: str, seed: int) -> np.random.Generator:
    """Source of a perturbation's chance: the same for all levels, so that a harsher one contains a milder one."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def clean(bench: Bench) -> tuple[Outcome, Run]:
    """Nothing is wrong."""
    inputs = whole(bench.events, bench.pair.netlist, bench.lengths)
    outcome = evaluate(bench.ready, inputs)
    return outcome, _run(bench, outcome, None, slice(None), inputs, outcome)


def measure(bench: Bench, name: str, level: Level, seeds: Sequence[int], reference: Outcome) -> list[Run]:
    """One perturbation at one level, once for each seed; one seed is enough for what has no part in chance.

    Seeds run together where only recordings differ. `reference` is of the clean recordings.
    """
    damage, count = NAMES[name].damage, len(bench.events)
    if damage is not None:
        runs = []
        for seed in seeds:
            damaged = damage(bench.pair, level, bench.sensor, generator(name, seed))
            inputs = whole(bench.events, damaged.netlist, bench.lengths)
            outcome = evaluate(ready(damaged), inputs)
            runs.append(_run(bench, outcome, seed, slice(None), inputs, reference))
        return runs
    many = [_inputs(bench, name, level, generator(name, seed)) for seed in seeds]
    longest = max(inputs.events.shape[2] for inputs in many)
    filled = [np.pad(each.events, ((0, 0), (0, 0), (0, longest - each.events.shape[2]))) for each in many]
    inputs = Inputs(
        events=np.concatenate(filled),
        lengths=np.concatenate([inputs.lengths for inputs in many]),
        begin=np.concatenate([inputs.begin for inputs in many]),
    )
    outcome = evaluate(bench.ready, inputs)
    parts = [slice(i * count, (i + 1) * count) for i in range(len(seeds))]
    return [_run(bench, outcome, seed, part, inputs, reference) for seed, part in zip(seeds, parts, strict=True)]


def _inputs(bench: Bench, name: str, level: Level, rng: np.random.Generator) -> Inputs:
    disturb, replay = NAMES[name].disturb, NAMES[name].replay
    if replay is not None:
        return replay(bench, level, rng)
    assert disturb is not None, "no damage either"
    events = by_length(bench.events, bench.lengths, lambda part: disturb(part, level, bench.sensor, rng))
    return whole(events, bench.pair.netlist, bench.lengths)


def _run(bench: Bench, outcome: Outcome, seed: int | None, part: slice, inputs: Inputs, reference: Outcome) -> Run:
    """Counts over the recordings of one seed."""
    netlist = bench.pair.netlist
    decided = {side: outcome.decisions(side)[part] for side in SIDES}
    spikes = outcome.spikes[part].sum(axis=0).tolist()
    steps = int((inputs.lengths - inputs.begin)[part].sum())
    held = np.bincount(netlist.layer, minlength=len(netlist.layers)).tolist()
    kinds = {side: np.unique_counts(values) for side, values in decided.items()}
    signs = {side: undecided(reference.votes[side], outcome.votes[side][part], bench.files) for side in SIDES}
    return Run(
        seed=seed,
        right={side: int(np.count_nonzero(values == bench.labels)) for side, values in decided.items()},
        equal=int(np.count_nonzero(decided["float"] == decided["chip"])),
        layers={
            layer.name: (*counts, neurons * steps)
            for layer, counts, neurons in zip(netlist.layers, spikes, held, strict=True)
        },
        signs={side: {sign.kind: sign.count for sign in each} for side, each in signs.items()},
        most={side: (int(k.values[np.argmax(k.counts)]), int(k.counts.max())) for side, k in kinds.items()},
        stopped=int(np.count_nonzero(outcome.stopped[part])),
        saturated=int(outcome.saturated[part].sum()),
    )
