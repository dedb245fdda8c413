"""What a chart measures, in steps that can be kept: float decisions, netlists, and netlists on recordings.

A network is rounded once for any number of layouts, a netlist is compiled once for any number of windows. Everything
here is a function of files and of the words of ``spikeloom compile``, so that a netlist is the file, byte for byte,
that the command would write.
"""

from __future__ import annotations

import argparse
import hashlib
import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import Options, lay_out_again, store
from spikeloom.compiler.errors import CapacityError, DataError, FormatError, ModelError
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.interpret import cut, vote
from spikeloom.compiler.targets.base import CROSSBARS, known_targets, load_target
from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist
from spikeloom.compiler.targets.truenorth.native_file import Trained, read_trained
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import first_part, steps_of
from spikeloom.runtime.commands.main_job.compile import parse_recipes, provenance
from spikeloom.runtime.commands.options import parse_cores
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.base import Machine, machine_for
from spikeloom.runtime.machines.truenorth import charted
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.studies.chart.tasks import SPLITS, Build, Data, Decide, Run

Json = dict[str, Any]

PART = 16
"""Recordings whose float spikes are held at a time."""


def measure(work: Decide | Build | Run) -> Json:
    """Do one piece of a chart's work; JSON values.

    Raises
    ------
    SpikeloomError
        If a file cannot be used.
    """
    if isinstance(work, Decide):
        return _decide(work)
    return _build(work) if isinstance(work, Build) else _run(work)


# -- what is kept from one piece to the next ---------------------------------------------------------------------------


@lru_cache(maxsize=1)
def both_splits(data: Data, taxels: int, classes: int) -> dict[str, Recordings]:
    """Training and test recordings by split.

    Raises
    ------
    DataError, OptionError
        If they cannot be used, do not suit the network, or are others than those of who asks for the work.
    """
    from spikeloom.models.training.protocols import data_digest

    shared: dict[str, Any] = {"classes": classes, "taxels": taxels, "bin_s": data.bin_s, "labels_for": "chart"}
    found = {split: recordings(data.path, split, **shared) for split in SPLITS}
    if data.sha256 not in (None, data_digest(found["train"], found["test"])):
        raise DataError(f"{data.path}: holds other recordings than where the chart was asked for; copy those here")
    return found


@lru_cache(maxsize=2)
def _heard(data: Data, taxels: int, classes: int, bins: int) -> dict[str, Recordings]:
    """The same in the steps of a network that joins bins."""
    return {split: joined_bins(found, bins) for split, found in both_splits(data, taxels, classes).items()}


@lru_cache(maxsize=2)
def _network(words: tuple[str, ...], sha256: str) -> LoadedNetwork:
    arguments = parsed(words)
    found = load_network(arguments.checkpoint, arguments)
    _require_same(arguments.checkpoint, found.sha256, sha256)
    return found


def _is_native(words: tuple[str, ...]) -> bool:
    return parsed(words).target in known_targets(CROSSBARS)


@lru_cache(maxsize=2)
def _trained(words: tuple[str, ...], sha256: str) -> Trained:
    arguments = parsed(words)
    found = read_trained(shipped(arguments.checkpoint), weights=arguments.weights)
    _require_same(arguments.checkpoint, found.sha256, sha256)
    return found


def _require_same(path: str, found: str, asked: str) -> None:
    if found != asked:
        raise ModelError(f"{path}: is another file than where the chart was asked for; copy that here")


def parsed(words: tuple[str, ...]) -> argparse.Namespace:
    """Options of a command, as they would be typed."""
    from spikeloom.runtime.cli import build_parser

    return build_parser().parse_args(list(words))


@lru_cache(maxsize=1)
def _read(path: Path, sha256: str) -> Machine | None:
    """A netlist that is kept, on its chip; None if it is gone, damaged or another one."""
    if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
        return None
    try:
        return machine_for(path)
    except FormatError:
        return None


# -- float model -------------------------------------------------------------------------------------------------------


def _decide(work: Decide) -> Json:
    """Decisions of the float32 model by split and window; one run each, since what comes later changes nothing."""
    from spikeloom.models.networks.reference import float_spikes  # torch, so only here

    if _is_native(work.words):
        network = _trained(work.words, work.sha256).network
        both = both_splits(work.data, network.taxels, network.classes)
        return {split: charted.model_decisions(network, data, work.windows) for split, data in both.items()}
    asked = _network(work.words, work.sha256)
    checkpoint, adjacency = asked.checkpoint, asked.adjacency
    assert checkpoint is not None, "a chart takes checkpoints"
    assert adjacency is not None, "and these have a first layer that sees something"
    found: Json = {}
    for split, data in _heard(work.data, checkpoint.taxels, checkpoint.classes, checkpoint.bins).items():
        counts: dict[int, list[IntArray]] = {window: [] for window in work.windows}
        own = np.full(len(data), data.steps) if data.lengths is None else data.lengths
        for first in range(0, len(data), PART):
            part = slice(first, first + PART)
            *_, spikes = float_spikes(checkpoint, adjacency, data.events[part]).values()
            for window in work.windows:
                heard = cut(spikes, steps_of(own[part], window))
                counts[window].append(readout_counts(checkpoint.readout, checkpoint.classes, heard))
        found[split] = {str(window): vote(np.concatenate(each)).tolist() for window, each in counts.items()}
    return found


# -- netlists ----------------------------------------------------------------------------------------------------------


def _build(work: Build) -> Json:
    """Compile what is not there; by layout the netlist's size and hash, or the limits that it breaks."""
    arguments = {layout: parsed(words) for layout, words in work.layouts.items()}
    words = next(iter(work.layouts.values()))
    if _is_native(words):
        try:
            return {name: charted.build(_trained(words, work.sha256), file) for name, file in work.files.items()}
        except CapacityError as error:
            return {name: {"refused": str(error).splitlines()} for name in work.files}
    some = next(iter(arguments.values()))
    asked = _network(model_words(words), work.sha256)
    sensor = asked.network.input
    training = _heard(work.data, sensor.taxels, asked.network.classes, sensor.bins)["train"]
    try:
        stored = store(
            asked.source,
            Options(
                forms=None if asked.checkpoint is None else asked.checkpoint.forms,
                recipes=parse_recipes(some),
                prune_unused=some.prune_unused,
                training_events=training.events,
            ),
            load_target(some.target),
        )
    except (CapacityError, ModelError) as error:
        return {layout: {"refused": str(error).splitlines()} for layout in work.layouts}
    found: Json = {}
    for layout, own in arguments.items():
        try:
            options = Options(
                cores_for=parse_cores(own.cores_for),
                optimize=own.optimize,
                provenance=provenance(own, asked, calibrated=True),
            )
            netlist = lay_out_again(stored, options).netlist
        except CapacityError as error:
            found[layout] = {"refused": str(error).splitlines()}
            continue
        work.files[layout].parent.mkdir(parents=True, exist_ok=True)
        found[layout] = {
            "sha256": write_netlist(netlist, work.files[layout]),
            "cores": netlist.n_cores,
            "neurons": netlist.n_compartments,
            "synapses": netlist.n_synapses,
        }
    return found


STORAGE = ("--weight-bits", "--planes", "--scale-groups", "--optimize", "--cores-for", "-o")
"""Options of ``compile`` that say nothing of the float network, each with a value; ``--prune-unused`` has none."""


def model_words(words: tuple[str, ...]) -> tuple[str, ...]:
    """The words of a ``compile`` command that name the float network.

    Examples
    --------
    >>> model_words(("compile", "a.pt", "--weight-bits", "4", "--prune-unused", "-o", "x.loom"))
    ('compile', 'a.pt', '-o', 'x.loom')
    """
    kept, skip = [], False
    for word in words:
        if skip:
            skip = False
        elif word in STORAGE:
            skip = True
        elif word != "--prune-unused":
            kept.append(word)
    return (*kept, "-o", "x.loom")


# -- netlists on recordings --------------------------------------------------------------------------------------------


def _run(work: Run) -> Json:
    """What a netlist decides on both splits, what that costs, and how fast the simulator is."""
    path = work.build.files[work.layout]
    machine = _read(path, work.sha256)
    if machine is None:
        _read.cache_clear()
        _build(work.build)
        machine = _read(path, work.sha256)
    if machine is None:
        raise FormatError(f"{path}: is not the netlist that was measured before; begin anew with --fresh")
    netlist, data = machine.netlist, work.build.data
    splits = _heard(data, netlist.taxels, netlist.classes, netlist.bins)
    parts = {split: first_part(each, work.window) for split, each in splits.items()}
    found: Json = {split: _costs(machine, each, data.bin_s) for split, each in parts.items()}
    found["recordings_per_s"] = _throughput(machine, parts["test"])
    return found


def _costs(machine: Machine, data: Recordings, bin_s: float) -> Json:
    """Decisions, and the mean inference: operations, energy by table, time by table, the longest step."""
    own = np.full(len(data), data.steps) if data.lengths is None else data.lengths
    size = machine.batch(data.steps)
    done = []
    for first in range(0, len(data), size):
        part = slice(first, first + size)
        done.append(machine.price(data.events[part], bin_s=bin_s, lengths=own[part]))
    prices = [price for _, price in done]

    def mean(values: Sequence[FloatArray | IntArray]) -> float:
        return float(np.concatenate(values).mean())

    return {
        "decisions": np.concatenate([run.decisions for run, _ in done]).tolist(),
        "synaptic_operations": mean([price.synaptic_operations for price in prices]),
        "energy_j": {name: mean([price.energy_j[name] for price in prices]) for name in prices[0].energy_j},
        "time_s": {name: mean([price.time_s[name] for price in prices]) for name in prices[0].time_s},
        "step_s": {name: max(price.step_s[name] for price in prices) for name in prices[0].step_s},
        "steps": float(own.mean()),
    }


def _throughput(machine: Machine, data: Recordings) -> float:
    """Recordings a second on one thread, decisions only; the better of two rounds."""
    rounds = []
    for _ in range(2):
        began = time.perf_counter()
        machine.run(data.events, lengths=data.lengths, threads=1)
        rounds.append(time.perf_counter() - began)
    return len(data) / min(rounds)
