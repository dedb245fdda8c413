"""The command ``smallest``: the cheapest network that does the job, chosen by cross-validation."""

import argparse
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import DEFAULT_TARGET
from spikeloom.compiler.errors import require_least
from spikeloom.compiler.files import sha256_of, write_atomically
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.systems import MLP, SYSTEMS
from spikeloom.compiler.targets.base import COMPARTMENTS
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import taxels_alone
from spikeloom.models.training.counters import require_levels
from spikeloom.runtime.commands.options import add_data, add_graph_options
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_graph, sensor_places
from spikeloom.runtime.machines.backends import backend_of, machine_for
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.numbers import dominant
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.chart.results import data_of, share
from spikeloom.runtime.studies.fronts import parse_budgets
from spikeloom.runtime.studies.smallest.results import Checked
from spikeloom.runtime.studies.smallest.space import Candidate, counting, networks
from spikeloom.runtime.studies.smallest.study import LIMITS, smallest
from spikeloom.runtime.studies.smallest.trained import Sensor
from spikeloom.runtime.studies.smallest.work import costs_of, some

SENSOR = ("graph", "taxels", "edges", "directed")

GRAPH = "manual"
"""Of the built-in sensor, unless another is named."""

LEVELS = "so many classes in a row are levels of one thing, for counting networks (default: 1)"

NOTES = """\
Candidates are counting networks of many sizes and a few that are trained by gradients. They are cross-validated inside
the training split, in three rungs: what a cheaper one beats is dropped early. Taken is the cheapest whose accuracy is
at most a standard error below the best, recording by recording; it is trained on the whole training split, compiled and
verified, and read on the test split once. Results are kept in the store; the same command goes on from there, other
budgets ask it again; delete it to measure anew. The exit code is 1 if no candidate fits a budget.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_data(parser)
    add_graph_options(parser, f"of the built-in sensor (default: {GRAPH})")
    parser.add_argument("--target", default=DEFAULT_TARGET, help=f"chip (default: {DEFAULT_TARGET})")
    parser.add_argument("--levels", type=int, metavar="N", help=LEVELS)
    what = "energy=5uJ, time=5ms, operations=25000, cores=1, accuracy=88, certified=90; all of them hold"
    parser.add_argument("--budget", action="append", default=[], metavar="WHAT=LIMIT[,…]", help=what)
    parser.add_argument("--store", metavar="FILE", help="what is measured (default: NET.sqlite, beside the netlist)")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at a time (default: one a core)")
    parser.add_argument("--html", metavar="PAGE.html", help="write a page, too")
    parser.add_argument("-o", "--output", required=True, metavar="NET.loom", help="netlist; NET.pt is the network")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; exit code 1 if no candidate fits a budget."""
    from spikeloom.runtime.commands.training.train import both_splits
    from spikeloom.runtime.studies.smallest.sections import page, sections

    output = Path(arguments.output)
    network = output.with_suffix(".pt")
    store = output.with_suffix(".sqlite") if arguments.store is None else Path(arguments.store)
    for place, option, kinds in ((output, "-o", ["loom"]), (network, "-o", ()), (store, "--store", ())):
        require_place(str(place), option, arguments, kinds)
    require_place(arguments.html, "--html", arguments, ["html"])
    require_least(vars(arguments), jobs=1, levels=1)
    budgets = parse_budgets([words for each in arguments.budget for words in each.split(",")], LIMITS)
    taxels = None if arguments.taxels is None else len(sensor_places(arguments.taxels))
    training, test = both_splits(arguments.data, taxels, arguments.bin)
    require_levels(arguments.levels or 1, int(training.labels.max()) + 1)
    arguments.bin = training.seconds
    sensor = _sensor(arguments, training.taxels)
    data = data_of(arguments.data, arguments.bin, training, test)
    backend = backend_of(arguments.target)
    target = backend.target
    bits = backend.counting_bits
    systems = () if target.cores != COMPARTMENTS else SYSTEMS if len(sensor.graph.edges) else (MLP,)
    found = smallest(
        [*counting(training.steps, arguments.levels or 1, bits), *networks(training.steps, systems)],
        data,
        target,
        budgets,
        store,
        partial(_made, sensor=sensor, splits=(training, test), arguments=arguments),
        sensor=sensor,
        command=_command(arguments),
        jobs=arguments.jobs,
    )
    if arguments.html is not None:
        with write_atomically(arguments.html) as file:
            file.write(page(found).encode())
    return Outcome(found, sections, 0 if found.choice.fits else 1)


def _made(
    candidate: Candidate, *, sensor: Sensor, splits: tuple[Recordings, ...], arguments: argparse.Namespace
) -> tuple[Checked, tuple[str, ...]]:
    """Train a candidate on the whole training split, compile and verify it, then read the test split; the commands."""
    netlist, data = arguments.output, arguments.data
    network, counts = str(Path(netlist).with_suffix(".pt")), candidate.system == COUNTING
    read = repeat.words({"data": data, "bin": arguments.bin})
    trained = [*read, *repeat.words(sensor.options_of(candidate.system)), *candidate.words]
    trained += [*([] if counts else ["--keep", "last"]), "-o", network]
    made = repeat.words({"target": arguments.target})
    made += (
        [] if counts else repeat.words({"weight_bits": candidate.storage or 8, "calibrate": data, "bin": arguments.bin})
    )
    words = {"train": trained, "compile": [network, *made, "-o", netlist]}
    words |= {"verify": [netlist, "--checkpoint", network, *read], "estimate": [netlist, *read]}
    from spikeloom.models.training.train import state_files  # with torch

    begun = not counts and any(file.exists() for file in state_files(Path(f"{network}.state")))
    try:
        _typed("train", [*trained, *(["--resume"] if begun else [])])
    except KeyboardInterrupt:
        raise KeyboardInterrupt("what was found is kept; go on with the same command") from None
    _typed("compile", words["compile"])
    progress("verifying")
    verdicts = {split: _typed("verify", [*words["verify"], "--split", split]) for split in ("train", "test")}
    machine = machine_for(netlist)
    bins, length = machine.netlist.bins, machine.netlist.clocks.length
    seen, held = (of_length(joined_bins(each, bins), length) for each in (some(splits[0]), splits[1]))
    right = int(np.count_nonzero(machine.run(held.events, lengths=held.lengths).decisions == held.labels))
    costs = costs_of(machine.netlist, seen)
    price = machine.price(seen.events, bin_s=arguments.bin, lengths=seen.lengths)[1]
    seconds = float(seen.step_counts.mean()) * bins * arguments.bin
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


def _typed(name: str, words: list[str]) -> Any:
    """What another command finds, as it is typed."""
    group = {"train": "training"}.get(name, "main_job")
    module, parser = import_module(f"spikeloom.runtime.commands.{group}.{name}"), argparse.ArgumentParser()
    module.add_arguments(parser)
    return module.run(parser.parse_args(words)).result


def _sensor(arguments: argparse.Namespace, taxels: int) -> Sensor:
    """The sensor that the options name, or the built-in one with its usual graph, if it has as many taxels."""
    options = repeat.given(arguments, SENSOR)
    if taxels == len(NEUTOUCH) and not any(options.values()):
        options["graph"] = GRAPH
    graph = load_graph(argparse.Namespace(**options)) or taxels_alone(np.arange(float(taxels))[:, None])
    return Sensor(graph=graph, options=options)


def _command(arguments: argparse.Namespace) -> str:
    """The words that ask for the same search."""
    words = repeat.words(repeat.given(arguments, ("data", "bin", *SENSOR, "target", "levels", "store")))
    budgets = [word for budget in arguments.budget for word in ("--budget", budget)]
    return repeat.command("smallest", *words, *budgets, "-o", arguments.output)
