"""The study: every perturbation at every level, once for each seed, on both sides at once."""

from __future__ import annotations

import argparse
import os
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import sha256_of
from spikeloom.runtime.equivalence.breakdowns import undecided
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies.stress.bench import NAMES, Bench, bench_of, by_length, whole
from spikeloom.runtime.studies.stress.pair import SIDES, TAXELS, Inputs, Level, Outcome, Perturbation, evaluate
from spikeloom.runtime.studies.stress.results import Provenance, Run, Stress
from spikeloom.runtime.studies.stress.verdicts import Requirement, curve, unmet

CHUNK = 5
"""Seeds that are measured at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Perturbations in the battery's order, what is required of them, and how densely they are measured."""

    names: tuple[str, ...]
    requirements: tuple[Requirement, ...]
    seeds: int
    full: bool
    jobs: int | None  # Measurements at a time; one a core

    def levels(self, name: str, taxels: int) -> tuple[Level, ...]:
        """Those of a perturbation on a sensor of so many taxels."""
        required = [wanted.level for wanted in self.requirements if wanted.name == name]
        return NAMES[name].levels_of(taxels, full=self.full, also=required)


def study(arguments: argparse.Namespace, plan: Plan) -> Stress:
    """Measure a plan on the files that a command's options name, and judge it."""
    bench, loaded, data = bench_of(arguments)
    recordings, classes, taxels = len(bench.labels), bench.pair.netlist.classes, bench.sensor.taxels
    reasons = {name: NAMES[name].why_not(bench.pair, bench.sensor) for name in plan.names}
    for wanted in plan.requirements:
        if reasons[wanted.name] is not None:
            raise OptionError(f"--require {wanted}: does not apply, {reasons[wanted.name]}; omit it")
        if NAMES[wanted.name].unit == TAXELS and float(wanted.level) > taxels:
            raise OptionError(f"--require {wanted}: the sensor has {taxels} taxels; give a smaller level")
    progress("clean recordings")
    reference, undisturbed = clean(bench)
    points = [
        (name, level, range(first, min(first + CHUNK, seeds)))
        for name, seeds in ((name, plan.seeds if NAMES[name].seeded else 1) for name in plan.names)
        if reasons[name] is None
        for level in plan.levels(name, taxels)
        for first in range(0, seeds, CHUNK)
    ]
    measured: dict[str, dict[Level, list[Run]]] = {}
    for (name, level, _), runs in zip(points, _measured(points, bench, reference, plan.jobs), strict=True):
        measured.setdefault(name, {}).setdefault(level, []).extend(runs)
    curves = {name: curve(name, each, undisturbed, recordings, classes) for name, each in measured.items()}
    return Stress(
        recordings=recordings,
        classes=classes,
        seeds=plan.seeds,
        full=plan.full,
        clean=undisturbed,
        perturbations=curves,
        not_applicable={name: reason for name, reason in reasons.items() if reason is not None},
        required=tuple(map(str, plan.requirements)),
        missed=unmet(plan.requirements, curves),
        provenance=_provenance(arguments, loaded, data),
    )


def _provenance(arguments: argparse.Namespace, loaded: LoadedNetwork, data: str) -> Provenance:
    return Provenance(
        spikeloom=__version__,
        netlist_sha256=sha256_of(arguments.netlist),
        checkpoint_sha256=loaded.sha256,
        **loaded.read_as,
        graph=loaded.graph,
        data_sha256=data,
        netlist=Path(arguments.netlist).name,
        checkpoint=Path(arguments.checkpoint).name,
        data=Path(arguments.data).name,
        split=arguments.split,
    )


def _measured(
    points: Sequence[tuple[str, Level, Sequence[int]]], bench: Bench, reference: Outcome, jobs: int | None
) -> list[list[Run]]:
    """Runs of each point, several at a time in threads: kernels let go of the interpreter's lock."""
    pool = ThreadPoolExecutor(jobs or os.cpu_count())
    try:
        waiting = [pool.submit(measure, bench, *point, reference) for point in points]
        for done, finished in enumerate(as_completed(waiting), 1):
            finished.result()
            progress(f"stress: {done} of {len(points)} points")
    finally:
        pool.shutdown(cancel_futures=True)
    return [each.result() for each in waiting]


# -- one point ---------------------------------------------------------------------------------------------------------


def generator(name: str, seed: int) -> np.random.Generator:
    """Source of a perturbation's chance: the same for all levels, so that a harsher one contains a milder one."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def clean(bench: Bench) -> tuple[Outcome, Run]:
    """Nothing is wrong."""
    inputs = whole(bench.events, bench.pair.netlist, bench.lengths)
    outcome = evaluate(bench.pair, inputs)
    return outcome, _run(bench, outcome, None, slice(None), inputs, outcome)


def measure(bench: Bench, name: str, level: Level, seeds: Sequence[int], reference: Outcome) -> list[Run]:
    """One perturbation at one level, once for each seed; one seed is enough for what has no part in chance.

    Seeds run together where only recordings differ. `reference` is of the clean recordings.
    """
    trouble, count = NAMES[name], len(bench.events)
    if trouble.to == "pair":
        runs = []
        for seed in seeds:
            damaged = trouble.done(bench.pair, level, bench.sensor, generator(name, seed))
            inputs = whole(bench.events, damaged.netlist, bench.lengths)
            outcome = evaluate(damaged, inputs)
            runs.append(_run(bench, outcome, seed, slice(None), inputs, reference))
        return runs
    many = [_inputs(bench, trouble, level, generator(name, seed)) for seed in seeds]
    longest = max(inputs.events.shape[2] for inputs in many)
    filled = [np.pad(each.events, ((0, 0), (0, 0), (0, longest - each.events.shape[2]))) for each in many]
    inputs = Inputs(
        events=np.concatenate(filled),
        lengths=np.concatenate([inputs.lengths for inputs in many]),
        begin=np.concatenate([inputs.begin for inputs in many]),
    )
    outcome = evaluate(bench.pair, inputs)
    parts = [slice(i * count, (i + 1) * count) for i in range(len(seeds))]
    return [_run(bench, outcome, seed, part, inputs, reference) for seed, part in zip(seeds, parts, strict=True)]


def _inputs(bench: Bench, trouble: Perturbation, level: Level, rng: np.random.Generator) -> Inputs:
    if trouble.to == "bench":
        inputs: Inputs = trouble.done(bench, level, bench.sensor, rng)
        return inputs
    events = by_length(bench.events, bench.lengths, lambda part: trouble.done(part, level, bench.sensor, rng))
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
