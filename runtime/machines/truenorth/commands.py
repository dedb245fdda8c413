"""What TrueNorth does in its own way: networks that were trained for it, and history-free ones (``--in-time``)."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from operator import add
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import Factored
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.truenorth.codebook import PartialSums, in_levels, run_levels
from spikeloom.compiler.targets.truenorth.in_time import first_spikes
from spikeloom.compiler.targets.truenorth.native import SYSTEM, NativeNetwork
from spikeloom.compiler.targets.truenorth.native_file import Trained, is_trained, read_trained
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, write_crossbars
from spikeloom.compiler.targets.truenorth.passes import Compilation, Options
from spikeloom.compiler.types import BoolArray, JsonObject
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import netlist_recordings
from spikeloom.runtime.inputs.repeat import NETWORK, PLACING, ROUNDING, refuse
from spikeloom.runtime.machines.truenorth import verdicts
from spikeloom.runtime.machines.truenorth.describe import describe, describe_trained
from spikeloom.runtime.machines.truenorth.machine import load
from spikeloom.runtime.machines.truenorth.verdicts import Verdict, compare
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.sections import Outcome

TITLE = "TrueNorth"

VERIFY = ("original", "min_agreement", "require", "engine")
"""Options of ``verify`` where chip and model may differ."""

SPEC_STEPS = 5
"""Data steps of a recording on which the specification runs, too: it takes a second for two hundred ticks."""


def takes(path: str) -> bool:
    """Whether what a user names is a network that was trained for the chip."""
    return Path(shipped(path)).is_file() and is_trained(shipped(path))


def read(path: str, arguments: argparse.Namespace) -> Trained:
    """Read a trained network as the options say; OptionError or ModelError if it is not as they say."""
    others = [name for name in NETWORK if name != "weights" and getattr(arguments, name, None) != SYSTEM]
    refuse(arguments, others, f"{path} is a network for {TITLE} and says that itself")
    return read_trained(shipped(path), weights=arguments.weights)


def inspect(arguments: argparse.Namespace) -> Outcome:
    """Show what a trained network is."""
    return describe_trained(read(arguments.path, arguments))


def compile_network(arguments: argparse.Namespace) -> Outcome:
    """Place a network on cores and write it; OptionError, ModelError or CapacityError if that cannot be."""
    path, trained = arguments.checkpoint, takes(arguments.checkpoint)
    chip = load_target("truenorth")
    if arguments.target != chip.name:
        raise OptionError(f"--target {arguments.target}: {path} was trained for {TITLE}; give --target {chip.name}")
    refuse(arguments, ("calibrate", *ROUNDING, *PLACING), f"is not for {chip.name}")
    source: NativeNetwork | Factored | Network
    if trained:
        network = read(path, arguments)
        source, origin = network.network, provenance(network)
    else:
        loaded = load_network(path, arguments)
        source, origin = loaded.model, {"spikeloom": __version__, "checkpoint_sha256": loaded.sha256}
        origin |= loaded.origin(arguments.run) | {"in_time": arguments.in_time}
    progress("compiling")

    def dump(name: str, done: Compilation) -> None:
        if name in arguments.dump_after:
            sys.stderr.write(done.text())

    try:
        netlist = chip.compile(source, Options(in_time=arguments.in_time, provenance=origin), after=dump).netlist
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    return describe(netlist, chip, write_crossbars(netlist, arguments.output))


def provenance(trained: Trained) -> JsonObject:
    """What a netlist remembers of the trained network that it is from."""
    return {
        "spikeloom": __version__,
        "checkpoint_sha256": trained.sha256,
        "weights": trained.weights,
        "graph": trained.graph,
        "copies": trained.network.copies,
        "towers": 1,
    }


def verify(arguments: argparse.Namespace) -> Outcome:
    """Compare chip, specification and model; exit code 1 where one spike differs."""
    why = f"a network for {TITLE} has one model, whose every spike must be the chip's"
    refuse(arguments, VERIFY, why)
    machine = load(arguments.netlist)
    check = _verify_in_time if "in_time" in machine.netlist.provenance else _verify_trained
    verdict = check(arguments, machine.netlist, machine.target)
    return Outcome(verdict, verdicts.sections, 0 if verdict.exact else 1)


def _require_same(arguments: argparse.Namespace, netlist: CrossbarNetlist, network: Trained | LoadedNetwork) -> None:
    """Refuse a network that the netlist was not compiled from."""
    made = netlist.provenance
    if made.get("checkpoint_sha256") != network.sha256:
        raise OptionError(
            f"--checkpoint {arguments.checkpoint}: {arguments.netlist} was compiled from another file; give that one"
        )
    if isinstance(network, Trained) and made.get("weights") != network.weights:
        raise OptionError(
            f"--weights {network.weights}: {arguments.netlist} was compiled from {made.get('weights')}; give the same"
        )


def _verify_trained(arguments: argparse.Namespace, netlist: CrossbarNetlist, _: Target) -> Verdict:
    trained = read(arguments.checkpoint, arguments)
    _require_same(arguments, netlist, trained)
    data = netlist_recordings(arguments, netlist, labels_for="verify")
    from spikeloom.models.truenorth.network import run_network  # torch, so only here

    def spikes(events: Any) -> dict[str, BoolArray]:
        return {name: held[0] for name, held in run_network(trained.network, events[None]).items()}

    first = {stage.name: number for number, stage in enumerate(trained.network.stages)}
    return compare(netlist, spikes, first, data, spec_samples=arguments.spec_samples)


def _verify_in_time(arguments: argparse.Namespace, netlist: CrossbarNetlist, chip: Target) -> Verdict:
    loaded = load_network(arguments.checkpoint, arguments)
    _require_same(arguments, netlist, loaded)
    levels = in_levels(loaded.network, int(netlist.provenance["in_time"]), chip)
    data = netlist_recordings(arguments, netlist, labels_for="verify")
    sums = tuple(PartialSums(layer.name, 0, 0, 0) for layer in levels.layers if layer.is_split)

    def spikes(events: Any) -> dict[str, BoolArray]:
        nonlocal sums
        spikes, counts = run_levels(levels, events.reshape(-1, events.shape[-1]))
        sums = tuple(map(add, sums, counts))
        return spikes

    samples = arguments.spec_samples
    verdict = compare(netlist, spikes, first_spikes(levels), data, spec_samples=samples, spec_steps=SPEC_STEPS)
    return replace(verdict, sums=sums)
