"""The study: every perturbation at every level, once for each seed, on both sides at once."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.types import JsonObject
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import decode, encode
from spikeloom.runtime.studies.jobs import Job, content_key
from spikeloom.runtime.studies.stress.battery import NAMES, TAXELS, Level, levels_of, why_not
from spikeloom.runtime.studies.stress.bench import Bench, bench_of
from spikeloom.runtime.studies.stress.pair import Outcome
from spikeloom.runtime.studies.stress.results import Provenance, Run, Stress, shown
from spikeloom.runtime.studies.stress.runs import clean, measure
from spikeloom.runtime.studies.stress.verdicts import Requirement, curve, unmet

CHUNK = 5
"""Seeds that a process measures at a time."""

FILES = ("netlist", "checkpoint", "data", "taxels", "edges")
"""Options that name files."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """Files and how they are read: the options of the command that decide a run."""

    netlist: str
    checkpoint: str
    data: str
    bin: float
    split: str
    limit: int | None
    graph: str | None
    taxels: str | None
    edges: str | None
    directed: bool
    system: str | None
    run: int
    weights: str | None
    beta: float | None
    theta: float | None
    polarities: int | None
    polarities_first: bool | None
    dt: float | None
    convention: str | None

    @classmethod
    def of(cls, arguments: argparse.Namespace) -> Request:
        """The part of a command's options."""
        return cls(**{field.name: getattr(arguments, field.name) for field in fields(cls)})

    def load(self) -> tuple[Bench, LoadedNetwork, str]:
        """Read it all, see :func:`bench.bench_of`."""
        return bench_of(argparse.Namespace(**asdict(self)))

    def from_anywhere(self) -> Request:
        """The same for a process that works in another folder."""
        options = asdict(self)
        named = {name: options[name] for name in FILES if options[name] and Path(options[name]).exists()}
        return Request(**options | {name: str(Path(path).resolve()) for name, path in named.items()})

    def readings(self) -> JsonObject:
        """All but the files, which are known by their hashes."""
        return {name: value for name, value in asdict(self).items() if name not in FILES}


@dataclass(frozen=True, slots=True, kw_only=True)
class Task(Job):
    """A perturbation at a level, and the seeds to draw it with."""

    request: Request
    name: str
    level: Level
    seeds: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Perturbations in the battery's order, what is required of them, and how densely they are measured."""

    names: tuple[str, ...]
    requirements: tuple[Requirement, ...]
    seeds: int
    full: bool


Sweep = Callable[[Sequence[Task]], Mapping[str, Any]]


def study(request: Request, plan: Plan, sweep: Sweep | None = None) -> Stress:
    """Measure a plan and judge it; `sweep` measures tasks by :func:`measure_task`, else threads of this process do."""
    bench, loaded, data = request.load()
    reasons = {name: why_not(name, bench.pair, bench.sensor) for name in plan.names}
    _require_measurable(plan, reasons, bench.sensor.taxels)
    progress("clean recordings")
    reference, undisturbed = clean(bench)
    known = _provenance(request, loaded, data)
    facts = encode(known) | {"options": request.readings(), "sensor": bench.sensor.digest()}
    tasks = [
        _task(request.from_anywhere(), name, level, tuple(range(first, min(first + CHUNK, seeds))), facts)
        for name, seeds in ((name, plan.seeds if NAMES[name].seeded else 1) for name in plan.names)
        if reasons[name] is None
        for level in _levels(name, plan, bench.sensor.taxels)
        for first in range(0, seeds, CHUNK)
    ]
    if sweep is None:
        runs = _in_threads(tasks, bench, reference)
    else:
        found = sweep(tasks)
        runs = [[decode(Run, run) for run in found[task.key]["runs"]] for task in tasks]
    measured: dict[str, dict[Level, list[Run]]] = {}
    for task, some in zip(tasks, runs, strict=True):
        measured.setdefault(task.name, {}).setdefault(task.level, []).extend(some)
    recordings, classes = len(bench.labels), bench.pair.netlist.classes
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
        provenance=known,
    )


def _require_measurable(plan: Plan, reasons: Mapping[str, str | None], taxels: int) -> None:
    for wanted in plan.requirements:
        if reasons[wanted.name] is not None:
            raise OptionError(f"--require {wanted}: does not apply, {reasons[wanted.name]}; omit it")
        if NAMES[wanted.name].scale is TAXELS and float(wanted.level) > taxels:
            raise OptionError(f"--require {wanted}: the sensor has {taxels} taxels; give a smaller level")


def _levels(name: str, plan: Plan, taxels: int) -> tuple[Level, ...]:
    required = [wanted.level for wanted in plan.requirements if wanted.name == name]
    return levels_of(name, taxels, full=plan.full, also=required)


def _provenance(request: Request, loaded: LoadedNetwork, data: str) -> Provenance:
    return Provenance(
        spikeloom=__version__,
        netlist_sha256=sha256_of(request.netlist),
        checkpoint_sha256=loaded.sha256,
        **loaded.read_as,
        graph=loaded.graph,
        data_sha256=data,
        netlist=Path(request.netlist).name,
        checkpoint=Path(request.checkpoint).name,
        data=Path(request.data).name,
        split=request.split,
    )


# -- where tasks are measured ------------------------------------------------------------------------------------------


def _task(request: Request, name: str, level: Level, seeds: tuple[int, ...], facts: Mapping[str, Any]) -> Task:
    key = content_key({**facts, "perturbation": name, "level": level, "seeds": seeds})
    return Task(key=key, label=f"{name} {shown(level)}", request=request, name=name, level=level, seeds=seeds)


def _in_threads(tasks: Sequence[Task], bench: Bench, reference: Outcome) -> list[list[Run]]:
    """Runs of each task, several at a time in this process."""
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        waiting = [pool.submit(measure, bench, task.name, task.level, task.seeds, reference) for task in tasks]
        for done, finished in enumerate(as_completed(waiting), 1):
            finished.result()
            progress(f"stress: {done} of {len(tasks)} points")
    finally:
        pool.shutdown(cancel_futures=True)
    return [each.result() for each in waiting]


def measure_task(task: Task) -> JsonObject:
    """JSON values of a task's runs, in a process of its own."""
    bench, reference = _loaded(task.request)
    return {"runs": encode(measure(bench, task.name, task.level, task.seeds, reference))}


@lru_cache(maxsize=1)
def _loaded(request: Request) -> tuple[Bench, Outcome]:
    """The bench of a process, and what its clean recordings do."""
    with redirect_stderr(StringIO()):  # the command has said it
        bench, _, _ = request.load()
    return bench, clean(bench)[0]
