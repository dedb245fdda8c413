"""``compile --target truenorth`` of a network that does not fit: every reason, and what each way out would cost."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.ir import recurrent
from spikeloom.compiler.targets.base import CROSSBARS, Target, load_target
from spikeloom.compiler.targets.truenorth.codebook import COPIES
from spikeloom.compiler.targets.truenorth.native import SYSTEM
from spikeloom.compiler.targets.truenorth.needs import needs
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import PLACING, ROUNDING
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.truenorth.retrained import shipped_networks
from spikeloom.runtime.machines.truenorth.trials import Trial
from spikeloom.runtime.machines.truenorth.ways import RETRAINED, Planner, Way
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.tables import table

Json = dict[str, Any]

TRIED = 72
"""Training recordings that ways out are measured on, evenly spaced."""


def require_crossbar_options(arguments: argparse.Namespace) -> None:
    """Refuse options that only Loihi has.

    Raises
    ------
    OptionError
        Naming the first.
    """
    for name, absent in (ROUNDING | PLACING).items():
        if getattr(arguments, name) != absent:
            raise OptionError(f"--{name.replace('_', '-')}: is for loihi1, not for truenorth; leave it away")


def refuse(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Say why a network does not fit: the report, how to print it, and exit code 2.

    Raises
    ------
    OptionError, ModelError, DataError
        If the options, the network or the recordings cannot be used.
    """
    require_crossbar_options(arguments)
    chip = load_target(arguments.target, CROSSBARS)
    asked = load_network(arguments.checkpoint, arguments)
    if asked.network.input.clocks.channels:
        raise ModelError(
            f"{arguments.checkpoint}: hears clocks, of which ways out are not known; train one for the chip, which may "
            f"hear them: spikeloom train --system {SYSTEM}"
        )
    if loops := recurrent(asked.network):
        raise ModelError(
            f"{arguments.checkpoint}: {', '.join(loops)} hears itself, ways out of that are not known; use loihi1"
        )
    trial, steps = None, None
    if arguments.calibrate is not None:
        progress("reading the recordings")
        data = recordings(
            arguments.calibrate,
            "train",
            classes=asked.network.classes,
            taxels=asked.network.input.taxels,
            bin_s=arguments.bin,
            bins=asked.network.input.bins,
            labels_for="compile --target truenorth",
        )
        trial, steps = _trial(asked, data), data.events.shape[3]
    return _report(arguments.checkpoint, asked, chip, trial, steps), refusal_text, 2


def _trial(asked: LoadedNetwork, data: Recordings) -> Trial:
    kept = np.linspace(0, len(data.labels) - 1, min(TRIED, len(data.labels))).round().astype(np.int64)
    return Trial(asked.network, channels_last(data.events[kept]), data.labels[kept])


def _report(path: str, asked: LoadedNetwork, chip: Target, trial: Trial | None, steps: int | None) -> Json:
    network = asked.network
    sensor = {"taxels": network.input.taxels, "classes": network.classes}
    retrained = shipped_networks(chip, **sensor, checkpoint=asked.checkpoint)
    planner = Planner(asked, chip, trial, path, retrained)
    found = needs(network, chip)
    if not found:
        raise ModelError(
            f"{path}: breaks none of the rules that are known before lowering, but is not lowered; use loihi1"
        )
    violations = []
    for number, need in enumerate(found):
        progress(f"pricing ways out: {number} of {len(found)}")
        ways = [_way_json(way, network, steps) for way in planner.ways(need)]
        name = network.populations[need.layer].name
        violations.append({"layer": name, "kind": need.kind, **asdict(need.fault), "ways": ways})
    together = [_way_json(planner.together(copies), network, steps) for copies in COPIES]
    return {
        "network": Path(path).name,
        "target": chip.name,
        "title": chip.title,
        "accuracy": None if trial is None else trial.accuracy({}),
        "samples": 0 if trial is None else len(trial.labels),
        "steps": steps,
        "cores_of_chip": chip.limit("chip.cores"),
        "violations": violations,
        "together": together,
        "retrained": [  # which hear each bin
            _way_json(planner.retrained_way(like.name, like), network, steps and steps * network.input.bins)
            | asdict(like)
            for like in retrained
        ],
    }


def _way_json(way: Way, network: Any, steps: int | None) -> Json:
    """A way with the ticks of a decision, where the length of a recording is known."""
    depth = len(network.populations) - 1
    ticks = None if steps is None or way.cores is None else steps * way.bin_ticks + depth + way.more_ticks
    return asdict(way) | {"ticks": ticks}


def refusal_text(report: Json) -> str:
    """The same for people."""
    violations = report["violations"]
    lines = [
        f"{report['network']} does not fit {report['title']}: {len(violations)} violations, nothing was written",
    ]
    if report["samples"]:
        lines.append(
            f"accuracy on {report['samples']} training recordings (one is {100 / report['samples']:.1f} points), "
            f"{100 * report['accuracy']:.1f} % as trained; each way alone, in its layer; cores of the layer; "
            "ticks of a decision"
        )
    else:
        lines.append(
            "cores of the layer, ticks of a data step; --calibrate DATA measures what the ways do to decisions"
        )
    for violation in violations:
        lines += [
            "",
            f"{violation['where']}: {violation['found']}, allowed {violation['allowed']} ({violation['rule']})",
            _ways_table(violation["ways"]),
        ]
    lines += ["", "all of it at once, without training (--in-time):", _ways_table(report["together"])]
    lines += _retrained_lines(report)
    ways = [way for violation in violations for way in violation["ways"] if way["command"] is not None]
    known = {way["command"]: way["shipped"] for way in ways if way["shipped"] not in (None, *_names(report))}
    other = {way["command"]: way["name"] for way in ways if way["shipped"] is None}
    for command, name in known.items():
        lines += [f"  {name}:", f"    {command}"]
    if other:
        lines += ["", "also to be trained; nothing of the kind is shipped, so nothing is known of what it reaches:"]
        lines += [f"  {name}: {command}" for command, name in other.items()]
    return "\n".join(lines)


def _names(report: Json) -> list[str]:
    return [like["name"] for like in report["retrained"]]


def _retrained_lines(report: Json) -> list[str]:
    """Shipped networks for the chip, what they reached and what makes them."""
    if not report["retrained"]:
        return []
    first = report["retrained"][0]
    lines = [
        "",
        f"all of it at once, after retraining; accuracy on the {first['samples']} test recordings of {first['data']}, "
        "cores and ticks of the whole network:",
        _ways_table(report["retrained"]),
        "",
        "what made the shipped networks:",
    ]
    for like in report["retrained"]:
        lines += [f"  {like['name']}:", *(f"    {command}" for command in like["commands"])]
    return lines


def _ways_table(ways: list[Json]) -> str:
    rows = [
        [
            way["name"] + (f" ({way['note']})" if way["note"] and way["command"] is None else ""),
            _accuracy(way),
            "does not fit" if way["cores"] is None else f"{way['cores']:,}",
            f"{way['bin_ticks']} a step" if way["ticks"] is None else f"{way['ticks']:,}",
        ]
        for way in ways
    ]
    return table(["way out", "accuracy", "cores", "ticks"], rows)


def _accuracy(way: Json) -> str:
    if way["command"] is not None:
        return RETRAINED if way["accuracy"] is None else f"{100 * way['accuracy']:.1f} % {RETRAINED}"
    if way["accuracy"] is None:
        return "as it is" if way["exact"] else "not measured"
    return f"{100 * way['accuracy']:.1f} %" + (", no spike changes" if way["exact"] else "")
