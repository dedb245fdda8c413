"""The command ``smallest``: of many networks the cheapest that is about as accurate as the best."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import DataError, OptionError, require_least
from spikeloom.compiler.files import sha256_of, write_atomically
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.systems import GRAPH_SYSTEMS, GRID_CNN, SYSTEMS
from spikeloom.compiler.targets.base import COMPARTMENTS, Target
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import sensor_grid, taxels_alone
from spikeloom.models.training.counters import require_levels
from spikeloom.runtime.commands.main_job import compile, verify
from spikeloom.runtime.commands.options import request_of
from spikeloom.runtime.commands.training import train
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import load_graph, sensor_places
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.machines.backends import backend_of, machine_for
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.numbers import dominant
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.choices import SensorChoice
from spikeloom.runtime.requests.choose import SmallestRequest
from spikeloom.runtime.requests.main_job import CompileRequest, VerifyRequest
from spikeloom.runtime.requests.training import TrainRequest
from spikeloom.runtime.studies.cluster import on_cluster
from spikeloom.runtime.studies.jobs import content_key
from spikeloom.runtime.studies.search.budgets import parse_budgets
from spikeloom.runtime.studies.search.results import data_of, share
from spikeloom.runtime.studies.smallest.results import Checked, Tried
from spikeloom.runtime.studies.smallest.space import counting, networks
from spikeloom.runtime.studies.smallest.study import LIMITS, smallest
from spikeloom.runtime.studies.smallest.trained import Sensor
from spikeloom.runtime.studies.smallest.work import Scene, costs_of, some
from spikeloom.runtime.studies.training.plan import both_splits

SENSOR = ("graph", "taxels", "edges", "directed")

DEFAULT_TIME = "15m"

STATE = re.compile(r"\.?[0-9a-f]{24}\.")
"""Beginning of the names of states of trainings."""

GRAPH = "manual"
"""Of the built-in sensor, unless another is named."""

NOTES = """\
Candidates are counting networks and networks trained by gradients, of many sizes. They are cross-validated inside the
training split, in rounds: those that a cheaper one beats are dropped, the others are trained for longer. If recordings
have groups, such as speed, each of their values is left out in turn; else random parts are, which says nothing of
other conditions. Taken is the cheapest that is at most 2 % behind the best, and not shown to be worse by a paired
test, recording by recording, or one that is more accurate for at most 5 % more energy. It is trained on the whole
training split, compiled and verified, and read on the test split once. Results are kept in the store, from which the
same command goes on, with another budget too; delete it to measure anew. The exit code is 1 if no candidate fits a
budget.
"""


REQUEST = SmallestRequest


@on_cluster
def run(request: SmallestRequest) -> Outcome:
    """Run the command; exit code 1 if no candidate fits a budget."""
    from spikeloom.runtime.studies.smallest.sections import page, sections

    output = Path(request.output)
    network = output.with_suffix(".pt")
    store = output.with_suffix(".sqlite") if request.store is None else Path(request.store)
    for place, option, kinds in ((output, "-o", ["loom"]), (network, "-o", ()), (store, "--store", ())):
        require_place(str(place), option, request, kinds)
    require_place(request.html, "--html", request, ["html"])
    require_least(vars(request), jobs=1, levels=1)
    budgets = parse_budgets([words for each in request.budget for words in each.split(",")], LIMITS)
    taxels = None if request.taxels is None else len(sensor_places(request.taxels))
    seconds = seconds_of(request.time)
    training, test = both_splits(request.data, taxels, request.bin, request.groups)
    require_levels(request.levels or 1, int(training.labels.max()) + 1)
    bin_s = training.seconds
    request = replace(request, bin=bin_s)
    sensor = _sensor(request, training.taxels)
    data = data_of(request.data, bin_s, training, test)
    backend = backend_of(request.target)
    target = backend.target
    bits = backend.counting_bits
    scene = Scene(
        data=data,
        groups=request.groups,
        sensor=sensor,
        target=request.target,
        states=_states(store.with_suffix(".training")),
        conditions=content_key(dict(training.groups)),
        classes=training.names,
    )
    found = smallest(
        list(counting(training.steps, request.levels or 1, bits)),
        list(networks(int(np.median(training.step_counts)), systems_of(target, sensor))),
        scene,
        training,
        target,
        budgets,
        store,
        partial(_made, sensor=sensor, splits=(training, test), request=request),
        command=_command(request),
        jobs=request.jobs,
        seconds=seconds,
    )
    if request.html is not None:
        with write_atomically(request.html) as file:
            file.write(page(found).encode())
    return Outcome(found, sections, 0 if found.choice.fits else 1)


def _states(folder: Path) -> Path:
    """Folder for the states of trainings, which goes at the end; OptionError if it holds anything else."""
    if folder.exists() and not (
        folder.is_dir() and all(STATE.match(each.name) for each in folder.iterdir())
    ):
        raise OptionError(
            f"--store: {folder} keeps trainings, and holds other files; move it, or give another store"
        )
    return folder


def systems_of(target: Target, sensor: Sensor) -> tuple[str, ...]:
    """Systems of networks that are trained by gradients, as far as the chip and the sensor have a place for them."""
    if target.cores != COMPARTMENTS:
        return ()
    try:
        sensor_grid(sensor.graph.coordinates, "none")
    except DataError:  # its taxels are not on a plane, or too few
        flat = tuple(system for system in SYSTEMS if system != GRID_CNN)
    else:
        flat = SYSTEMS
    return flat if len(sensor.graph.edges) else tuple(each for each in flat if each not in GRAPH_SYSTEMS)


def seconds_of(words: str | None) -> float | None:
    """Seconds of ``--time``; OptionError if it is no time."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)(s|m|h)", (words or DEFAULT_TIME).strip())
    if match is None or float(match[1]) <= 0:
        raise OptionError(f"--time {words}: is no time; write it as in 90s, 30m or 2h")
    return float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2]]


def _made(
    tried: Tried, *, sensor: Sensor, splits: tuple[Recordings, ...], request: SmallestRequest
) -> tuple[Checked, tuple[str, ...]]:
    """Train a candidate on the whole training split, compile and verify it, then read the test split; the commands."""
    candidate = tried.candidate
    netlist = request.output
    data = request.data
    network = str(Path(netlist).with_suffix(".pt"))
    counts = candidate.system == COUNTING
    read = repeat.words({"data": data, "bin": request.bin})
    trained = [*read, *repeat.words(sensor.options_of(candidate.system)), *candidate.words]
    trained += [] if counts else ["--epochs", f"{tried.setting:g}", "--keep", "last"]
    trained += ["-o", network]
    made = repeat.words({"target": request.target})
    made += [] if counts else repeat.words({"weight_bits": 8, "calibrate": data, "bin": request.bin})
    words = {"train": trained, "compile": [network, *made, "-o", netlist]}
    words |= {"verify": [netlist, "--checkpoint", network, *read], "estimate": [netlist, *read]}
    from spikeloom.models.training.train import state_files  # with torch

    begun = not counts and any(file.exists() for file in state_files(Path(f"{network}.state")))
    try:
        train.run(request_of(TrainRequest, [*trained, *(["--resume"] if begun else [])]))
    except KeyboardInterrupt:
        raise KeyboardInterrupt("what was found is kept; go on with the same command") from None
    compile.run(request_of(CompileRequest, words["compile"]))
    progress("verifying")
    checks = {
        split: request_of(VerifyRequest, [*words["verify"], "--split", split]) for split in ("train", "test")
    }
    verdicts = {split: verify.run(check).result for split, check in checks.items()}
    machine = machine_for(netlist)
    bins = machine.netlist.bins
    length = machine.netlist.clocks.length
    seen, held = (of_length(joined_bins(each, bins), length) for each in (some(splits[0]), splits[1]))
    right = int(np.count_nonzero(machine.run(held.events, lengths=held.lengths).decisions == held.labels))
    costs = costs_of(machine.netlist, seen)
    price = machine.price(seen.events, bin_s=splits[0].seconds, lengths=seen.lengths)[1]
    seconds = float(seen.step_counts.mean()) * bins * splits[0].seconds
    dynamic = [float(each.mean()) for each in price.dynamic_j.values()]
    words |= {"anytime": [netlist, *read]} if "whole" in costs else {}
    return Checked(
        network=network,
        network_sha256=sha256_of(Path(network)),
        netlist=netlist,
        netlist_sha256=sha256_of(Path(netlist)),
        different={split: verdict.different for split, verdict in verdicts.items()},
        right=share(right, len(held)),
        costs=costs.get("whole", costs["costs"]),
        stopped=costs["costs"] if "whole" in costs else None,
        pace=dominant([watts * seconds for watts in price.static_w.values()], dynamic),
    ), tuple(repeat.command(name, *typed) for name, typed in words.items())


def _sensor(request: SmallestRequest, taxels: int) -> Sensor:
    """The sensor that the options name, or the built-in one with its usual graph, if it has as many taxels."""
    options = repeat.given(request, SENSOR)
    if taxels == len(NEUTOUCH) and not any(options.values()):
        options["graph"] = GRAPH
    graph = load_graph(SensorChoice(**options)) or taxels_alone(np.arange(float(taxels))[:, None])
    return Sensor(graph=graph, options=options)


def _command(request: SmallestRequest) -> str:
    """The words that ask for the same search."""
    words = repeat.words(
        repeat.given(request, ("data", "bin", "groups", *SENSOR, "target", "levels", "time", "store"))
    )
    budgets = [word for budget in request.budget for word in ("--budget", budget)]
    return repeat.command("smallest", *words, *budgets, "-o", request.output)
