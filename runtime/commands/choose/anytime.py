"""The command ``anytime``: how early a decision could have been taken, and what that saves."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.recordings.eventfiles import UNLABELLED
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import add_network, add_recordings
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.loihi1.costs import cumulative
from spikeloom.runtime.machines.loihi1.costs.cumulative import Cumulative
from spikeloom.runtime.machines.loihi1.trace import check_channels
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.intervals import wilson
from spikeloom.runtime.studies.anytime import exits
from spikeloom.runtime.studies.anytime.text import anytime_text

Json = dict[str, Any]

NOTES = """\
By proof: stop once no further spike can change the vote. With --calibrate also: stop once the leader is ahead by a
times the root of the steps left, where a is the smallest factor that lets no more than --differ of the training split's
races for second place end otherwise. Figures are of --split; everything comes from one run of the recordings.
"""

ALLOWED = (0.0, 0.005, 0.01, 0.02, 0.05)
"""Shares of calibration races that may end otherwise, all of them reported."""

DIFFER = 0.0
"""By default no calibration race may end otherwise; of real votes a little more do than of races."""

WINDOWS = tuple(range(5, 101, 5))
"""Percent of each recording that is observed."""

BESIDE = ("graph", "taxels", "edges", "system", "weights", "dt", "convention")
"""Options that say how a checkpoint is read, and are nothing without one."""

PART = 16
"""Recordings whose float spikes are held at a time."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("netlist", metavar="NET.loom")
    parser.add_argument("--checkpoint", metavar="CKPT|NET.onnx", help="float model to show beside the chip")
    add_network(parser)
    add_recordings(parser)
    parser.add_argument("--calibrate", metavar="PATH", help="recordings whose train split says when a vote is sure")
    parser.add_argument(
        "--differ",
        type=float,
        metavar="X",
        help=f"share of calibration races that may end otherwise (default: {DIFFER:g})",
    )
    parser.add_argument("--picture", metavar="OUT.png", help="draw accuracy against the window, and savings")
    parser.add_argument("-o", "--output", metavar="OUT.json", help="write the result with figures of every recording")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command.

    Raises
    ------
    SpikeloomError
        If an option, the netlist, the checkpoint or the recordings cannot be used.
    """
    for option, place in (("-o", arguments.output), ("--picture", arguments.picture)):
        if place is not None:
            require_place(place, option, arguments)
    allowed = _allowed(arguments)
    netlist = read_netlist(arguments.netlist)
    data = _read(arguments.data, arguments.split, netlist, arguments, limit=arguments.limit)
    lengths = _lengths(data)
    floats = _float_votes(arguments, netlist, data)
    points = _races(arguments, netlist)
    progress("running")
    ran = cumulative.run(netlist, load_target(netlist.target), with_clocks(data.events, netlist.clocks), lengths)
    rules: list[exits.Calibrated | None] = [None]
    rules += [] if points is None else [exits.calibrate(points, share) for share in allowed]
    report = _report(netlist, data, ran, rules, floats)
    if points is not None:
        report |= {"calibrated_on": arguments.calibrate, "chosen": allowed.index(_chosen(arguments)) + 1}
    report |= {"savings": dict(_best(report))}
    if arguments.picture is not None:
        from spikeloom.runtime.studies.anytime.picture import picture  # matplotlib, so only here

        with write_atomically(arguments.picture) as file:
            file.write(picture(report))
    if arguments.output is not None:
        with write_atomically(arguments.output) as file:
            file.write(json.dumps(report).encode())
    return report, anytime_text, 0


def _chosen(arguments: argparse.Namespace) -> float:
    return DIFFER if arguments.differ is None else float(arguments.differ)


def _allowed(arguments: argparse.Namespace) -> list[float]:
    """Shares to calibrate for."""
    if arguments.differ is not None and arguments.calibrate is None:
        raise OptionError(f"--differ {arguments.differ:g}: nothing to calibrate on; add --calibrate or leave it away")
    chosen = _chosen(arguments)
    if not 0 <= chosen < 1:
        raise OptionError(f"--differ {chosen:g}: not a share; give a number from 0 to below 1")
    return sorted({*ALLOWED, chosen})


def _read(
    path: str, split: str, netlist: Netlist, arguments: argparse.Namespace, limit: int | None = None
) -> Recordings:
    progress("reading the recordings")
    data = recordings(
        path,
        split,
        limit=limit,
        classes=netlist.classes,
        taxels=netlist.taxels,
        bin_s=arguments.bin,
        bins=netlist.bins,
    )
    check_channels(netlist, data.events.shape[1] * data.events.shape[2] + netlist.clocks.channels)
    return data


def _lengths(data: Recordings) -> IntArray:
    return np.full(len(data), data.steps) if data.lengths is None else data.lengths.astype(np.int64)


def _races(arguments: argparse.Namespace, netlist: Netlist) -> FloatArray | None:
    """Turning points of the races on the training split, if there is something to calibrate on."""
    if arguments.calibrate is None:
        return None
    training = _read(arguments.calibrate, "train", netlist, arguments)
    progress("calibrating")
    lengths = _lengths(training)
    votes = cumulative.votes_of(netlist, with_clocks(training.events, netlist.clocks), lengths)
    return exits.turning_points(exits.races(votes, lengths))


def _float_votes(arguments: argparse.Namespace, netlist: Netlist, data: Recordings) -> IntArray | None:
    """Votes of the float model so far after each step, (samples, steps, classes), if a checkpoint was given."""
    if arguments.checkpoint is None:
        given = [name for name in BESIDE if getattr(arguments, name) is not None]
        if given:
            raise OptionError(f"--{given[0]}: is for --checkpoint, which is not given; add it or leave this away")
        return None
    from spikeloom.compiler.interpret import cut
    from spikeloom.runtime.equivalence.reference import require_match, spikes_of

    asked = load_network(arguments.checkpoint, arguments, netlist)
    require_match(netlist, asked.model)
    readout, lengths = asked.network.readout, _lengths(data)
    votes = []
    for first in range(0, len(data), PART):
        progress(f"float model: {first} of {len(data)}")
        part = slice(first, first + PART)
        spikes = spikes_of(asked.model, asked.adjacency, data.events[part], "float32")[readout.population]
        votes.append(cumulative.float_votes(readout, netlist.classes, cut(spikes, lengths[part])))
    return np.concatenate(votes)


def _report(
    netlist: Netlist, data: Recordings, ran: Cumulative, rules: list[exits.Calibrated | None], floats: IntArray | None
) -> Json:
    """All figures as JSON values."""
    at = exits.standing(ran.votes, ran.lengths)
    sure = exits.proven(ran.votes, at, exits.most_votes(netlist, data.steps))
    known = data.labels != UNLABELLED
    beside = None
    if floats is not None:
        beside = exits.standing(floats, ran.lengths)
        voters = np.bincount(netlist.readout_class[netlist.readout_class >= 0], minlength=netlist.classes)
        certain = exits.proven(floats, beside, voters[:, None] * np.arange(data.steps + 1))
    found = []
    for rule in rules:
        factor = np.inf if rule is None else rule.factor
        entry = _rule(rule) | _stopped(ran, at, exits.exits(sure, at, factor), data.labels)
        if beside is not None:
            ends = exits.exits(certain, beside, factor)
            entry["float"] = _decided(beside, ends, data.labels) | {"steps": float(np.mean(ends + 1))}
        found.append(entry)
    return {
        "samples": len(data),
        "labelled": int(known.sum()),
        "source": data.source,
        "split": data.split,
        "bins": data.steps,
        "least_interval": int(exits.least_interval(netlist).min(initial=1)),
        "full": _costs(ran, ran.chip_steps - 1)
        | {"correct": _correct(at.decision, data.labels)}
        | ({} if beside is None else {"float_correct": _correct(beside.decision, data.labels)}),
        "windows": [_window(share, data, ran, at, beside) for share in WINDOWS] if known.any() else [],
        "files": list(data.files),
        "labels": data.labels.tolist(),
        "decisions": at.decision.tolist(),
        "chip_steps": ran.chip_steps.tolist(),
        "rules": found,
    }


def _rule(rule: exits.Calibrated | None) -> Json:
    """How a rule came about; the proof rests on nothing."""
    if rule is None:
        return {"allowed": None, "factor": None, "races": None, "races_differ": None, "bound": None}
    return {
        "allowed": rule.allowed,
        "factor": rule.factor,
        "races": rule.races,
        "races_differ": rule.differ,
        "bound": rule.bound,
    }


def _correct(decisions: IntArray, labels: IntArray) -> int | None:
    known = labels != UNLABELLED
    return int(np.count_nonzero(known & (decisions == labels))) if known.any() else None


def _decided(at: exits.Standing, ends: IntArray, labels: IntArray) -> Json:
    """What stopping changes."""
    early, late = at.leader[np.arange(len(ends)), ends], at.decision
    known = labels != UNLABELLED
    return {
        "differ": int(np.count_nonzero(early != late)),
        "correct": _correct(early, labels),
        "gained": int(np.count_nonzero(known & (early == labels) & (late != labels))),
        "lost": int(np.count_nonzero(known & (early != labels) & (late == labels))),
    }


def _costs(ran: Cumulative, index: IntArray) -> Json:
    """Mean chip steps, operations, joules and seconds up to and with a chip step of each recording."""
    rows = np.arange(len(index))
    return {
        "chip_steps": float(np.mean(index + 1)),
        "operations": float(ran.operations[rows, index].mean()),
        "energy_j": {name: float(each[rows, index].mean()) for name, each in ran.energy.items()},
        "time_s": {name: float(each[rows, index].mean()) for name, each in ran.time.items()},
    }


def _stopped(ran: Cumulative, at: exits.Standing, ends: IntArray, labels: IntArray) -> Json:
    """What a rule comes to, in the mean and for every recording."""
    last = ran.chip_steps - 1
    index = np.where(ends == ran.lengths - 1, last, np.minimum(ends + ran.depth, last))
    rows = np.arange(len(ends))
    spent, whole = _costs(ran, index), _costs(ran, last)

    def share(kept: float, of: float) -> float:
        return 1 - kept / of if of else 0.0

    def saved(sums: FloatArray) -> list[float]:
        return [float(each) for each in sums[rows, last] - sums[rows, index]]

    return {
        "mean": spent,
        "saved": {
            "chip_steps": share(spent["chip_steps"], whole["chip_steps"]),
            "operations": share(spent["operations"], whole["operations"]),
            "energy_j": {name: share(each, whole["energy_j"][name]) for name, each in spent["energy_j"].items()},
            "time_s": {name: share(each, whole["time_s"][name]) for name, each in spent["time_s"].items()},
        },
        **_decided(at, ends, labels),
        "samples": {
            "chip_steps": (index + 1).tolist(),
            "decisions": at.leader[rows, ends].tolist(),
            "saved_operations": saved(ran.operations),
            "saved_energy_j": {name: saved(each) for name, each in ran.energy.items()},
            "saved_time_s": {name: saved(each) for name, each in ran.time.items()},
        },
    }


def _window(percent: int, data: Recordings, ran: Cumulative, at: exits.Standing, beside: exits.Standing | None) -> Json:
    """Accuracy where only the first part of each recording is observed; the read-out still runs to its end."""
    steps = np.maximum(ran.lengths * percent // 100, 1)
    known = int(np.count_nonzero(data.labels != UNLABELLED))
    entry: Json = {"percent": percent, "bins": float(steps.mean())}
    for name, votes in (("chip", at), ("float", beside)):
        if votes is not None:
            right = _correct(votes.leader[np.arange(len(steps)), steps - 1], data.labels) or 0
            entry[name] = {"correct": right, "interval": list(wilson(right, known))}
    return entry


def _best(report: Json) -> Iterator[tuple[str, int]]:
    """Rules that save most steps with the same decisions, and with at most one recording less right."""
    rules = report["rules"]
    conditions: dict[str, Callable[[Json], bool]] = {"identical": lambda rule: rule["differ"] == 0}
    if report["labelled"]:
        least = report["full"]["correct"] - 1
        conditions["one_lost"] = lambda rule: rule["correct"] >= least
    for name, holds in conditions.items():
        fitting = [index for index, rule in enumerate(rules) if holds(rule)]
        yield name, max(fitting, key=lambda index: rules[index]["saved"]["chip_steps"])
