"""``compile``, ``verify`` and ``inspect`` of networks that were trained for TrueNorth."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import CROSSBARS, known_targets, load_target
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.lower import lower
from spikeloom.compiler.targets.truenorth.native import BASES, SYSTEM, highest_level
from spikeloom.compiler.targets.truenorth.native_file import Trained, is_trained, read_trained
from spikeloom.compiler.targets.truenorth.netlist_file import write_crossbars
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import first_part, parse_window
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.loihi1.trace import ENGINES
from spikeloom.runtime.machines.truenorth import in_time, render
from spikeloom.runtime.machines.truenorth.machine import load
from spikeloom.runtime.machines.truenorth.refusal import require_crossbar_options
from spikeloom.runtime.machines.truenorth.verdicts import BoolArray, compare, verdict_json, verdict_text
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.tables import table

Json = dict[str, Any]
Outcome = tuple[Json, Callable[[Json], str], int]

OTHERS = {
    **dict.fromkeys(("graph", "taxels", "edges", "beta", "theta", "system"), None),
    **{"run": 0, "directed": False},
}
"""Options of other checkpoints, and what they are where they are not given."""


def read(path: str, arguments: argparse.Namespace) -> Trained:
    """Read a network as the options say.

    Raises
    ------
    OptionError, ModelError
        If it is not as they say, or an option is for others.
    """
    for name, absent in OTHERS.items():
        value = getattr(arguments, name, absent)
        if value != absent and (name, value) != ("system", SYSTEM):
            raise OptionError(
                f"--{name} {value}: {path} is a network for TrueNorth and says that itself; leave it away"
            )
    return read_trained(shipped(path), weights=arguments.weights)


def compile_network(arguments: argparse.Namespace) -> Outcome:
    """Place a network on cores and write them."""
    if arguments.target not in known_targets(CROSSBARS):
        raise OptionError(
            f"--target {arguments.target}: {arguments.checkpoint} was trained for TrueNorth; give --target truenorth"
        )
    require_crossbar_options(arguments)
    if arguments.in_time is not None:
        raise OptionError(f"--in-time: {arguments.checkpoint} was trained for the chip; leave it away")
    if arguments.calibrate is not None:
        raise OptionError(f"--calibrate: {arguments.checkpoint} is whole numbers already; leave it away")
    chip = load_target(arguments.target, CROSSBARS)
    trained = read(arguments.checkpoint, arguments)
    progress("compiling")
    netlist = lower(trained.network, chip, provenance=provenance(trained))
    require_legal(netlist, chip)
    return render.netlist_json(netlist, chip, write_crossbars(netlist, arguments.output)), render.netlist_text, 0


def provenance(trained: Trained) -> Json:
    """What a netlist remembers of the network that it is from."""
    return {
        "spikeloom": __version__,
        "checkpoint_sha256": trained.sha256,
        "weights": trained.weights,
        "graph": trained.graph,
        "copies": trained.network.copies,
        "towers": len(trained.network.towers),
    }


def inspect(arguments: argparse.Namespace) -> Outcome:
    """Show what a file holds."""
    return trained_json(read(arguments.path, arguments)), trained_text, 0


def trained_json(trained: Trained) -> Json:
    """What a network is, and how it was made."""
    network = trained.network
    return {
        "system": SYSTEM,
        "taxels": network.taxels,
        "classes": network.classes,
        "graph": trained.graph,
        "edges": len(trained.edges),
        "copies": network.copies,
        "levels": 2 * highest_level(network.copies) + 1,
        "clocks": network.clocks.channels,
        "towers": len(network.towers),
        "layers": [
            {
                "name": stage.name,
                "blocks": stage.blocks,
                "inputs": int(stage.inputs.shape[1]),
                "clocks": stage.clocks,
                "neurons": stage.size,
                "zeros": float(np.mean(stage.level == 0)),
            }
            for stage in network.towers[0]
        ],
        "weights": trained.weights,
        "sets": list(trained.sets),
        "training": dict(trained.training),
        "sha256": trained.sha256,
    }


def trained_text(report: Json) -> str:
    """The same for people."""
    rows = [
        [
            layer["name"],
            *(f"{layer[key]:,}" for key in ("blocks", "inputs", "clocks", "neurons")),
            f"{100 * layer['zeros']:.0f} %",
        ]
        for layer in report["layers"]
    ]
    towers = report["towers"]
    lines = [
        f"{report['system']}: {report['taxels']} taxels, graph {report['graph']}, {report['classes']} classes, "
        f"{towers} tower{'s' * (towers > 1)}",
        f"{report['copies']} copies of an input, weights {', '.join(map(str, BASES[report['copies']]))}: "
        f"{report['levels']} levels; {report['clocks']} clocks",
        table(["layer", "groups", "inputs", "clocks", "neurons", "level 0"], rows),
        f"  groups, inputs and neurons of one tower; holds the epochs {', '.join(report['sets'])}, shown is "
        f"{report['weights']}",
    ]
    training = report["training"]
    if "command" in training:
        lines.append(f"  made by: {training['command']}")
    if isinstance(training.get("test"), dict) and "correct" in training["test"]:
        found = training["test"]
        lines.append(f"  {100 * found['accuracy']:.2f} % of {found['samples']} test recordings")
    for which in report["sets"]:
        if isinstance(training.get(which), dict) and "correct" in training[which]:
            found = training[which]
            share = 100 * found["accuracy"]
            lines.append(
                f"  {which}: epoch {found['epoch']}, {share:.2f} % of {training['test_samples']} test recordings"
            )
    return "\n".join(lines)


def verify(arguments: argparse.Namespace) -> Outcome:
    """Compare chip, specification and model; exit code 1 where one spike differs."""
    for name, absent in (("original", None), ("min_agreement", None), ("require", None), ("engine", ENGINES[0])):
        value = getattr(arguments, name)
        if value != absent:
            raise OptionError(
                f"--{name.replace('_', '-')} {value}: a network for TrueNorth has one model, whose every spike must be "
                "the chip's; leave it away"
            )
    machine = load(arguments.netlist)
    netlist, chip = machine.netlist, machine.target
    percent = parse_window(arguments.window)

    def recordings() -> Recordings:
        return first_part(load_recordings(arguments, netlist, labels_for="verify"), percent)

    if "in_time" in netlist.provenance:
        return in_time.verify(arguments, netlist, chip, recordings)
    trained = read(arguments.checkpoint, arguments)
    if netlist.provenance.get("checkpoint_sha256") != trained.sha256:
        raise OptionError(
            f"--checkpoint {arguments.checkpoint}: {arguments.netlist} was compiled from another file; give that one"
        )
    if netlist.provenance.get("weights") != trained.weights:
        raise OptionError(
            f"--weights {trained.weights}: {arguments.netlist} was compiled from {netlist.provenance.get('weights')}; "
            "give the same"
        )
    data = recordings()
    from spikeloom.models.truenorth.network import run_network  # torch, so only here

    def spikes(events: Any) -> dict[str, BoolArray]:
        return {name: held[0] for name, held in run_network(trained.network, events[None]).items()}

    first = {stage.name: number for number, stage in enumerate(trained.network.towers[0])}
    verdict = compare(netlist, spikes, first, data, spec_samples=arguments.spec_samples)
    report = verdict_json(verdict, data, chip)
    return report, verdict_text, 0 if report["exact"] else 1


def is_named(path: str) -> bool:
    """Whether what a user names is a network for TrueNorth."""
    return Path(shipped(path)).is_file() and is_trained(shipped(path))
