"""``compile --in-time`` and ``verify`` of history-free networks whose sums travel in time."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

from spikeloom import __version__
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.targets.base import CROSSBARS, Target, load_target
from spikeloom.compiler.targets.truenorth.codebook import COPIES, LevelNetwork, in_levels, run_levels
from spikeloom.compiler.targets.truenorth.in_time import first_spikes, lower_in_time
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.targets.truenorth.netlist_file import write_crossbars
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.machines.truenorth import render
from spikeloom.runtime.machines.truenorth.refusal import require_crossbar_options
from spikeloom.runtime.machines.truenorth.verdicts import BoolArray, compare, verdict_json, verdict_text
from spikeloom.runtime.report.console import progress

Json = dict[str, Any]
Outcome = tuple[Json, Callable[[Json], str], int]

SPEC_STEPS = 5
"""Data steps of a recording on which the specification runs, too: it takes a second for two hundred ticks."""

FORGET = "give --beta 0 where the file does not say, or train it with --membrane-decay LAYER=0 for every layer"


def compile_network(arguments: argparse.Namespace) -> Outcome:
    """Place a history-free network on cores and write them.

    Raises
    ------
    OptionError, ModelError, CapacityError
        If the options or the network cannot be used, or it does not fit.
    """
    require_crossbar_options(arguments)
    if arguments.in_time not in COPIES:
        raise OptionError(f"--in-time {arguments.in_time}: allowed are {', '.join(map(str, COPIES))} axons an input")
    if arguments.calibrate is not None:
        raise OptionError("--calibrate: levels are chosen by the weights alone; leave it away")
    chip = load_target(arguments.target, CROSSBARS)
    asked = load_network(arguments.checkpoint, arguments)
    levels = _levels(arguments.checkpoint, asked, arguments.in_time, chip)
    progress("compiling")
    provenance = {
        "spikeloom": __version__,
        "checkpoint_sha256": asked.sha256,
        **asked.origin(arguments.run),
        "in_time": arguments.in_time,
    }
    netlist = lower_in_time(levels, chip, provenance=provenance)
    require_legal(netlist, chip)
    return render.netlist_json(netlist, chip, write_crossbars(netlist, arguments.output)), render.netlist_text, 0


def _levels(path: str, asked: LoadedNetwork, copies: int, chip: Target) -> LevelNetwork:
    try:
        return in_levels(asked.network, copies, chip)
    except ModelError as error:
        raise ModelError(f"{path}: {error}; {FORGET}") from error


def verify(
    arguments: argparse.Namespace, netlist: CrossbarNetlist, chip: Target, read: Callable[[], Recordings]
) -> Outcome:
    """Compare chip, specification and the network in levels; exit code 1 where one spike differs."""
    asked = load_network(arguments.checkpoint, arguments)
    if netlist.provenance.get("checkpoint_sha256") != asked.sha256:
        raise OptionError(
            f"--checkpoint {arguments.checkpoint}: {arguments.netlist} was compiled from another file; give that one"
        )
    levels = _levels(arguments.checkpoint, asked, int(netlist.provenance["in_time"]), chip)
    data = read()
    parts = np.zeros((3, len(levels.layers)), np.int64)

    def spikes(events: Any) -> dict[str, BoolArray]:
        found = run_levels(levels, events.reshape(-1, events.shape[-1]))
        parts[0] += found.partial
        parts[1] += found.saturated
        np.maximum(parts[2], found.largest, out=parts[2])
        return {layer.name: held for layer, held in zip(levels.layers, found.spikes, strict=True)}

    verdict = compare(
        netlist, spikes, first_spikes(levels), data, spec_samples=arguments.spec_samples, spec_steps=SPEC_STEPS
    )
    report = verdict_json(verdict, data, chip) | {"spec_steps": SPEC_STEPS}
    report["sums"] = [
        {"layer": layer.name, "partial": int(partial), "saturated": int(saturated), "largest": int(largest)}
        for layer, partial, saturated, largest in zip(levels.layers, *parts, strict=True)
        if layer.is_split
    ]
    return report, verdict_text, 0 if report["exact"] else 1
