"""The command ``stress``: where float network and chip break, and whether at the same place."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import redirect_stderr
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spikeloom.compiler.atomic import write_atomically
from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.commands.options import add_network, add_recordings
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies.jobs import Point, add_sweep_arguments, content_key, sweep
from spikeloom.runtime.studies.stress.battery import NAMES, SEEDS, levels_of, why_not
from spikeloom.runtime.studies.stress.perturbation import Level
from spikeloom.runtime.studies.stress.text import stress_text
from spikeloom.runtime.studies.stress.verdicts import Requirement, curve, parse_requirement, shown, unmet

if TYPE_CHECKING:
    from spikeloom.runtime.studies.stress.runs import Bench

Json = dict[str, Any]

NOTES = """\
Perturbations: {names}.
Accuracies are means over the seeds with a 95 % interval; a level leaves where the mean is below the interval of the
clean accuracy. --full and --jobs measure in processes of their own and go on where an earlier run ended.
"""
KIND, VERSION = "stress", 1
"""Of the store of measured points; the version goes up when a result means something else."""

CHUNK = 5
"""Seeds of a point."""

UNKEPT = (
    *("action", "command", "debug", "json", "output", "picture"),
    *("only", "require", "full", "seeds", "jobs", "scheduler", "fresh"),
)
"""Options that change no run."""

HASHED = ("netlist", "checkpoint", "data")
"""Files that a point knows by their hash."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("netlist", metavar="NET.loom")
    parser.add_argument("--checkpoint", required=True, metavar="CKPT|NET.onnx")
    add_network(parser)
    add_recordings(parser)
    parser.add_argument("--only", metavar="NAME[,…]", help="some perturbations (default: all)")
    parser.add_argument("--full", action="store_true", help="dense curves")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help=f"draws of each (default: {SEEDS})")
    parser.add_argument(
        "--require",
        action="append",
        default=[],
        metavar="NAME:LEVEL>=SHARE",
        help="accuracy that the chip must keep, as in taxels_dead:3>=0.85; else exit code 1; may be repeated",
    )
    add_sweep_arguments(parser)
    parser.add_argument("--picture", metavar="OUT.png", help="draw the curves")
    parser.add_argument("-o", "--output", metavar="OUT.json", help="write what --json prints; report --stress shows it")
    parser.epilog = NOTES.format(names=", ".join(NAMES))


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command; exit code 1 where a requirement is missed.

    Raises
    ------
    SpikeloomError
        If an option, the netlist, the checkpoint or the recordings cannot be used, or do not belong together.
    """
    names, requirements = _check(arguments)
    from spikeloom.runtime.studies.stress.bench import bench_of, facts_of
    from spikeloom.runtime.studies.stress.runs import clean

    bench, asked, data = bench_of(arguments)

    sensor = bench.sensor
    reasons = {name: why_not(name, bench.pair, sensor) for name in names}
    for wanted in requirements:
        if reasons[wanted.name] is not None:
            raise OptionError(f"--require {wanted}: does not apply, {reasons[wanted.name]}; leave it away")
        if NAMES[wanted.name].unit == "taxels" and float(wanted.level) > sensor.taxels:
            raise OptionError(f"--require {wanted}: the sensor has {sensor.taxels} taxels; give a smaller level")
    plan = {
        name: levels_of(
            name,
            sensor.taxels,
            full=arguments.full,
            also=[wanted.level for wanted in requirements if wanted.name == name],
        )
        for name in names
        if reasons[name] is None
    }
    progress("clean recordings")
    _, undisturbed = clean(bench)
    places = [(name, level) for name, levels in plan.items() for level in levels]
    measured = _measured(arguments, bench, places, facts_of(arguments, asked, data))
    curves = {
        name: _described(name)
        | curve(
            [(level, measured[name, level]) for level in levels],
            undisturbed,
            len(bench.labels),
            bench.pair.netlist.classes,
        )
        for name, levels in plan.items()
    }
    missed = unmet(requirements, curves)
    found: Json = {
        "recordings": len(bench.labels),
        "classes": bench.pair.netlist.classes,
        "seeds": arguments.seeds,
        "full": arguments.full,
        "clean": undisturbed,
        "perturbations": curves,
        "not_applicable": {name: reason for name, reason in reasons.items() if reason is not None},
        "required": [str(wanted) for wanted in requirements],
        "missed": missed,
        "provenance": facts_of(arguments, asked, data),
    }
    if arguments.picture is not None:
        from spikeloom.runtime.studies.stress.picture import picture

        with write_atomically(arguments.picture) as file:
            file.write(picture(found))
    if arguments.output is not None:
        with write_atomically(arguments.output) as file:
            file.write(json.dumps(found).encode())
    return found, stress_text, 1 if missed else 0


def _check(arguments: argparse.Namespace) -> tuple[tuple[str, ...], list[Requirement]]:
    """Refuse options that cannot be meant; return perturbations in the battery's order, and requirements."""
    for option, place in (("-o", arguments.output), ("--picture", arguments.picture)):
        if place is not None:
            require_place(place, option, arguments)
    if arguments.seeds < 1:
        raise OptionError(f"--seeds {arguments.seeds}: allowed are 1 or more; choose another")
    asked = list(NAMES) if arguments.only is None else [name.strip() for name in arguments.only.split(",")]
    for name in asked:
        if name not in NAMES:
            raise OptionError(f"--only {name}: no such perturbation; choose from {', '.join(NAMES)}")
    requirements = [parse_requirement(words) for words in arguments.require]
    for wanted in requirements:
        if wanted.name not in asked:
            raise OptionError(f"--require {wanted}: --only leaves {wanted.name} out; add it there")
    return tuple(name for name in NAMES if name in asked), requirements


def _described(name: str) -> Json:
    known = NAMES[name]
    return {"what": known.what, "unit": known.unit, "seeded": known.seeded}


# -- runs --------------------------------------------------------------------------------------------------------------


def _measured(
    arguments: argparse.Namespace, bench: Bench, places: Sequence[tuple[str, Level]], facts: Json
) -> dict[tuple[str, Level], list[Json]]:
    """Runs of each seed, by perturbation and level."""
    seeds = {name: range(arguments.seeds if NAMES[name].seeded else 1) for name, _ in places}
    if not (arguments.full or arguments.jobs is not None or arguments.scheduler):
        return _here(bench, places, seeds)
    options = {name: _absolute(value) for name, value in vars(arguments).items() if name not in UNKEPT}
    chosen = {name: value for name, value in vars(arguments).items() if name not in (*UNKEPT, *HASHED)}
    known = facts | {"options": chosen, "sensor": _digest(bench)}
    keyed: dict[tuple[str, Level], list[Point]] = {}
    for name, level in places:
        chunks = [list(seeds[name][i : i + CHUNK]) for i in range(0, len(seeds[name]), CHUNK)]
        keyed[name, level] = [
            Point(
                key=content_key(known | {"perturbation": name, "level": level, "seeds": chunk}),
                label=f"{name} {shown(level)}",
                payload={"options": options, "name": name, "level": level, "seeds": chunk},
            )
            for chunk in chunks
        ]
    with tempfile.TemporaryDirectory(prefix="spikeloom-") as folder:
        store = Path(folder) / "points" if arguments.output is None else Path(f"{arguments.output}.points")
        results = sweep(
            [point for points in keyed.values() for point in points],
            measure_point,
            store,
            kind=KIND,
            version=VERSION,
            jobs=arguments.jobs,
            scheduler=arguments.scheduler,
            fresh=arguments.fresh,
            label="stress",
        )
    return {place: [run for point in points for run in results[point.key]["runs"]] for place, points in keyed.items()}


def _absolute(value: Any) -> Any:
    """A path as processes elsewhere find it; anything else as it is."""
    return str(Path(value).resolve()) if isinstance(value, str) and Path(value).exists() else value


def _digest(bench: Bench) -> str:
    """Hash over distances and edges of the sensor."""
    edges = bench.sensor.edges
    return hashlib.sha256(bench.sensor.distance.tobytes() + (b"" if edges is None else edges.tobytes())).hexdigest()


def _here(
    bench: Bench, places: Sequence[tuple[str, Level]], seeds: dict[str, range]
) -> dict[tuple[str, Level], list[Json]]:
    """Measure in this process, several points at a time."""
    from spikeloom.runtime.studies.stress.runs import clean, measure

    reference, _ = clean(bench)
    found: dict[tuple[str, Level], list[Json]] = {}
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        waiting = {pool.submit(measure, bench, *place, seeds[place[0]], reference): place for place in places}
        for done in as_completed(waiting):
            found[waiting[done]] = done.result()
            progress(f"stress: {len(found)} of {len(places)} points")
    finally:
        pool.shutdown(cancel_futures=True)
    return found


@lru_cache(maxsize=1)
def _kept(options: str) -> tuple[Bench, Any]:
    """The bench of a process, and what its clean recordings do."""
    from spikeloom.runtime.studies.stress.bench import bench_of
    from spikeloom.runtime.studies.stress.runs import clean

    with redirect_stderr(StringIO()):  # the command has said it
        bench, _, _ = bench_of(argparse.Namespace(**json.loads(options)))
    return bench, clean(bench)[0]


def measure_point(payload: Json) -> Json:
    """One perturbation at one level in a process of its own: ``runs``, one for each seed."""
    from spikeloom.runtime.studies.stress.runs import measure

    bench, reference = _kept(json.dumps(payload["options"], sort_keys=True))
    return {"runs": measure(bench, payload["name"], payload["level"], payload["seeds"], reference)}
