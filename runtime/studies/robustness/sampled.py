"""The study: every perturbation at every level, once for each seed, on both sides at once."""

import zlib
from collections.abc import Sequence
from functools import partial

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.equivalence.breakdowns import undecided
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.requests.check import StressRequest
from spikeloom.runtime.studies.robustness.bench import Bench, bench_of, by_length, whole
from spikeloom.runtime.studies.robustness.curves import Requirement, curve, unmet
from spikeloom.runtime.studies.robustness.definition import TAXELS, Level
from spikeloom.runtime.studies.robustness.pair import SIDES, Inputs, Outcome, Pair, evaluate
from spikeloom.runtime.studies.robustness.perturbations import SAMPLED
from spikeloom.runtime.studies.robustness.provenance import compared
from spikeloom.runtime.studies.robustness.results import InCondition, Run, Stress
from spikeloom.runtime.studies.robustness.threads import in_threads


def stress(request: StressRequest, names: Sequence[str], requirements: Sequence[Requirement]) -> Stress:
    """Measure perturbations on the files that a command's options name, and judge them."""
    bench, loaded, data = bench_of(request)
    recordings = len(bench.labels)
    classes = bench.pair.netlist.classes
    taxels = bench.events.shape[1]
    reasons = {name: SAMPLED[name].why_not(bench.pair) for name in names}
    for wanted in requirements:
        if reasons[wanted.name] is not None:
            raise OptionError(f"--require {wanted}: does not apply, {reasons[wanted.name]}; omit it")
        if SAMPLED[wanted.name].unit == TAXELS and wanted.level > taxels:
            raise OptionError(f"--require {wanted}: the sensor has {taxels} taxels; give a smaller level")
    progress("clean recordings")
    reference, undisturbed = clean(bench)
    points = [
        (name, level, seed)
        for name in names
        if reasons[name] is None
        for level in SAMPLED[name].levels_of(
            taxels, [each.level for each in requirements if each.name == name]
        )
        for seed in range(request.seeds if SAMPLED[name].seeded else 1)
    ]
    measured: dict[str, dict[Level, list[Run]]] = {}
    runs = in_threads(partial(measure, bench, reference), points, "stress", request.jobs)
    for (name, level, _), run in zip(points, runs, strict=True):
        measured.setdefault(name, {}).setdefault(level, []).append(run)
    curves = {name: curve(name, each, undisturbed, recordings, classes) for name, each in measured.items()}
    return Stress(
        recordings=recordings,
        classes=classes,
        seeds=request.seeds,
        clean=undisturbed,
        conditions=_in_conditions(bench, reference),
        perturbations=curves,
        not_applicable={name: reason for name, reason in reasons.items() if reason is not None},
        required=tuple(map(str, requirements)),
        missed=unmet(requirements, curves),
        provenance=compared(request, data, loaded),
    )


def generator(name: str, seed: int) -> np.random.Generator:
    """A perturbation's chance: the same for all levels, so that a harsher one contains a milder one."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def clean(bench: Bench) -> tuple[Outcome, Run]:
    """Run the unperturbed recordings."""
    inputs = whole(bench.events, bench.pair.netlist, bench.lengths)
    outcome = evaluate(bench.pair, inputs)
    return outcome, _run(bench, outcome, None, inputs, outcome)


def _in_conditions(bench: Bench, outcome: Outcome) -> dict[str, InCondition]:
    """Right decisions by condition."""
    right = {side: outcome.decisions(side) == bench.labels for side in SIDES}
    return {
        name: InCondition(
            recordings=int(np.count_nonzero(those)),
            right={side: int(np.count_nonzero(each[those])) for side, each in right.items()},
        )
        for name, those in bench.conditions.items()
    }


def measure(bench: Bench, reference: Outcome, point: tuple[str, Level, int]) -> Run:
    """One perturbation at one level under one seed; `reference` is of the clean recordings."""
    name, level, seed = point
    trouble = SAMPLED[name]
    rng = generator(name, seed)
    pair = bench.pair
    if trouble.to == "bench":
        inputs: Inputs = trouble.done(bench, level, bench.distance, rng)
    elif trouble.to == "memory":
        damaged = trouble.done(pair.memory, level, bench.distance, rng)
        pair = Pair(netlist=damaged.netlist, network=damaged.network)
        inputs = whole(bench.events, pair.netlist, bench.lengths)
    else:
        events = by_length(
            bench.events, bench.lengths, lambda part: trouble.done(part, level, bench.distance, rng)
        )
        inputs = whole(events, pair.netlist, bench.lengths)
    return _run(bench, evaluate(pair, inputs), seed, inputs, reference)


def _run(bench: Bench, outcome: Outcome, seed: int | None, inputs: Inputs, reference: Outcome) -> Run:
    """Counts over the recordings."""
    netlist = bench.pair.netlist
    decided = {side: outcome.decisions(side) for side in SIDES}
    spikes = outcome.spikes.tolist()
    steps = int((inputs.lengths - inputs.begin).sum())
    neurons_of = np.bincount(netlist.layer, minlength=len(netlist.layers)).tolist()
    kinds = {side: np.unique_counts(values) for side, values in decided.items()}
    signs = {side: undecided(reference.votes[side], outcome.votes[side], bench.files) for side in SIDES}
    return Run(
        seed=seed,
        right={side: int(np.count_nonzero(values == bench.labels)) for side, values in decided.items()},
        equal=int(np.count_nonzero(decided["float"] == decided["chip"])),
        layers={
            layer.name: (*counts, neurons * steps)
            for layer, counts, neurons in zip(netlist.layers, spikes, neurons_of, strict=True)
        },
        signs={side: {sign.kind: sign.count for sign in each} for side, each in signs.items()},
        most={side: (int(k.values[np.argmax(k.counts)]), int(k.counts.max())) for side, k in kinds.items()},
        stopped=int(np.count_nonzero(outcome.stopped)),
        saturated=int(outcome.saturated.sum()),
    )
