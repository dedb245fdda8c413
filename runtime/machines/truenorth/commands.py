"""``run``, ``estimate``, ``inspect`` and ``export`` of files that hold crossbar cores."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.formats import ranc
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.targets.base import CROSSBARS, Target, load_target, with_tables
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.targets.truenorth.netlist_file import read_crossbars
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import first_part, parse_window
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.truenorth import cost, engine, render
from spikeloom.runtime.machines.truenorth.trace import Trace
from spikeloom.runtime.report import decisions
from spikeloom.runtime.report.console import progress

Json = dict[str, Any]
Outcome = tuple[Json, Callable[[Json], str], int]


def legal(path: str) -> tuple[CrossbarNetlist, Target]:
    """Read a file and hold it against every rule of its chip.

    Raises
    ------
    FormatError, RuleError
        If it is no such file, or breaks a rule.
    """
    netlist = read_crossbars(path)
    chip = load_target(netlist.target, CROSSBARS)
    require_legal(netlist, chip)
    return netlist, chip


def class_counts(netlist: CrossbarNetlist, votes: IntArray) -> IntArray:
    """Votes per class (samples, classes) from votes per neuron (samples, neurons)."""
    voters = np.flatnonzero(netlist.readout_class >= 0)
    counts = np.zeros((len(votes), netlist.classes), np.int64)
    np.add.at(counts.T, netlist.readout_class[voters], votes[:, voters].T)
    return counts


def _data(arguments: argparse.Namespace, netlist: CrossbarNetlist, split: str, limit: int | None) -> Recordings:
    percent = parse_window(getattr(arguments, "window", "100%"))
    progress("reading the recordings")
    classes, taxels = netlist.classes, netlist.taxels
    found = recordings(arguments.data, split, limit=limit, classes=classes, taxels=taxels, bin_s=arguments.bin)
    return first_part(found, percent)


def _costs(arguments: argparse.Namespace, netlist: CrossbarNetlist, chip: Target, trace: Trace) -> Json:
    chip = chip if arguments.table is None else with_tables(chip, arguments.table)
    return render.costs_json(netlist, chip, cost.estimate(netlist, chip, trace.counts), trace.counts, arguments.bin)


def _require_detail(arguments: argparse.Namespace) -> None:
    if arguments.detail == "cycle":
        raise OptionError("--detail cycle: a tick of TrueNorth has one length, whatever happens in it; use counts")


def inspect(path: str) -> Outcome:
    """Show what a file holds."""
    netlist, chip = legal(path)
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    return render.netlist_json(netlist, chip, digest), render.netlist_text, 0


def run(arguments: argparse.Namespace) -> Outcome:
    """Decisions of the recordings, and their costs where they are asked for."""
    _require_detail(arguments)
    netlist, chip = legal(arguments.netlist)
    data = _data(arguments, netlist, arguments.split, arguments.limit)
    progress("running")
    prepared, events = engine.prepare(netlist), with_clocks(data.events, netlist.clocks)
    trace = engine.simulate(prepared, events, lengths=data.lengths, spikes=arguments.spikes is not None)
    if trace.spikes is not None:
        held = {name: trace.spikes[:, :, netlist.layer == index] for index, name in enumerate(netlist.layers)}
        with write_atomically(arguments.spikes) as file:
            np.savez_compressed(file, **held)  # type: ignore[arg-type]
    counts = class_counts(netlist, trace.counts.votes)
    report = decisions.run_json(data.files, data.labels, counts, vote(counts))
    if arguments.detail == "spikes":
        return report, decisions.run_text, 0
    found = _costs(arguments, netlist, chip, trace)
    return report | {"costs": found}, _run_text, 0


def _run_text(report: Json) -> str:
    decided = {key: value for key, value in report.items() if key != "costs"}
    return f"{decisions.run_text(decided)}\n\n{render.costs_text(report['costs'])}"


def estimate(arguments: argparse.Namespace) -> Outcome:
    """Costs of the recordings."""
    _require_detail(arguments)
    netlist, chip = legal(arguments.netlist)
    data = _data(arguments, netlist, arguments.split, arguments.limit)
    progress("running")
    trace = engine.simulate(netlist, with_clocks(data.events, netlist.clocks), lengths=data.lengths)
    return _costs(arguments, netlist, chip, trace), render.costs_text, 0


def export_ranc(arguments: argparse.Namespace) -> tuple[list[bytes], Json]:
    """Content of a file for RANC's simulator, with a recording where one is asked for, and what tells about it."""
    netlist, _ = legal(arguments.source)
    events = None
    if arguments.data is not None:
        data, number = _data(arguments, netlist, arguments.split or "test", None), arguments.recording or 0
        if not 0 <= number < len(data.files):
            raise OptionError(f"--recording {number}: {arguments.data} has recordings 0 to {len(data.files) - 1}")
        steps = None if data.lengths is None else int(data.lengths[number])
        events = with_clocks(data.events[number : number + 1], netlist.clocks)[0, :, :steps]
    lines = [f"{line}\n".encode() for line in ranc.export(netlist, events)]
    ticks = None if events is None else netlist.ticks(events.shape[1]) + 1
    return lines, {"neurons": netlist.n_neurons, "synapses": netlist.n_synapses, "ticks": ticks}
