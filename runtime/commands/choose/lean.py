"""The command ``lean``: what of a network its recordings do not need, what that costs, and a netlist without it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from spikeloom.compiler import Compilation, Options, compile_network
from spikeloom.compiler.atomic import write_atomically
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.systems import TACTILESGNET
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist
from spikeloom.compiler.version import __version__
from spikeloom.models.recordings.counts import number
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import add_network, add_recordings
from spikeloom.runtime.inputs.compilation import storage
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies.pruning.leaner import (
    Scene,
    Trial,
    alone,
    coarse_netlist,
    coarser,
    decisions,
    scene,
    without_hops,
    without_taxels,
)
from spikeloom.runtime.studies.pruning.text import lean_text

Json = dict[str, Any]

NOTES = """\
Everything is chosen on the training split and reported on --split: how many decisions change, what is right,
operations, energy and time. Of several checkpoints the cheapest within one training recording of the best is taken.
What -o writes is, of neurons, taxels and hops alone or together, what takes least energy on the training split.
"""

DIFFER = 0.01

BINS = (2, 4)
"""Bins that are joined."""

TARGET = "loihi1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("checkpoint", nargs="+", metavar="CKPT|NET.onnx")
    add_network(parser)
    add_recordings(parser)
    parser.add_argument(
        "--differ",
        type=float,
        default=DIFFER,
        metavar="X",
        help=f"share of training decisions that the netlist may change (default: {DIFFER:g})",
    )
    parser.add_argument("-o", "--output", metavar="OUT.loom", help="write the netlist without what may go together")
    parser.add_argument("--report", metavar="OUT.json", help="write the result")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command.

    Raises
    ------
    SpikeloomError
        If an option, a checkpoint or the recordings cannot be used.
    """
    if not 0 <= arguments.differ < 1:
        raise OptionError(f"--differ {arguments.differ:g}: not a share; give a number from 0 to below 1")
    for option, place in (("-o", arguments.output), ("--report", arguments.report)):
        if place is not None:
            for path in arguments.checkpoint:
                require_place(place, option, argparse.Namespace(**vars(arguments) | {"checkpoint": path}))
    found = [load_network(path, arguments) for path in arguments.checkpoint]
    first = found[0].network
    for path, asked in zip(arguments.checkpoint, found, strict=True):
        own = asked.network
        if own.input.bins != first.input.bins:
            raise OptionError(
                f"{path}: a step joins {number(own.input.bins, 'bin')}, of {arguments.checkpoint[0]} "
                f"{first.input.bins}; spikeloom chart compares such networks"
            )
        shape = own.input.taxels, own.input.polarities, own.classes
        if shape != (first.input.taxels, first.input.polarities, first.classes):
            raise OptionError(
                f"{path}: {shape[0]} taxels, {shape[1]} polarities and {shape[2]} classes, {arguments.checkpoint[0]} "
                f"has {first.input.taxels}, {first.input.polarities} and {first.classes}; give networks for the same "
                "recordings"
            )
    training, test = (
        _read(arguments, split, limit, found[0])
        for split, limit in (("train", None), (arguments.split, arguments.limit))
    )
    candidates, compilations = _candidates(arguments, found, training, test)
    chosen = _cheapest(candidates)
    session = _Session(
        found[chosen], compilations[chosen], training, test, int(arguments.differ * len(training) + 1e-9)
    )
    report = session.report()
    netlist = session.netlist
    report |= {
        "source": test.source,
        "split": test.split,
        "differ": arguments.differ,
        "candidates": candidates if len(candidates) > 1 else [],
        "chosen": arguments.checkpoint[chosen],
        "output": arguments.output,
    }
    if arguments.output is not None:
        taken = report["rows"][report["taken"]]["removed"]
        made = _provenance(arguments, found[chosen]) | {"lean": {"differ": arguments.differ} | taken}
        write_netlist(replace(netlist, provenance=made), arguments.output)
    if arguments.report is not None:
        with write_atomically(arguments.report) as file:
            file.write(json.dumps(report).encode())
    return report, lean_text, 0


def _read(arguments: argparse.Namespace, split: str, limit: int | None, asked: LoadedNetwork) -> Recordings:
    progress("reading the recordings")
    return recordings(
        arguments.data,
        split,
        limit=limit,
        classes=asked.network.classes,
        taxels=asked.network.input.taxels,
        bin_s=arguments.bin,
        bins=asked.network.input.bins,
        labels_for="lean",
    )


def _provenance(arguments: argparse.Namespace, asked: LoadedNetwork) -> Json:
    made = {"spikeloom": __version__, "checkpoint_sha256": asked.sha256, **asked.origin(arguments.run)}
    made |= storage(None, asked.checkpoint)
    return made | {"keep_all": False, "prune_unused": True, "ranges": "proven", "calibrated": True}


def _candidates(
    arguments: argparse.Namespace, found: list[LoadedNetwork], training: Recordings, test: Recordings
) -> tuple[list[Json], list[Compilation]]:
    """Each checkpoint on the chip: decisions and costs."""
    target, candidates, compilations = load_target(TARGET), [], []
    for path, asked in zip(arguments.checkpoint, found, strict=True):
        progress(f"compiling {path}")
        forms = None if asked.checkpoint is None else asked.checkpoint.forms
        compilation = compile_network(
            asked.network, Options(forms=forms, training_events=training.events), target=TARGET
        )
        netlist = compilation.netlist
        seen, reported = scene(training, netlist), scene(test, netlist)
        (decided, cost), (decided_test, entry) = (_costs(netlist, target, of) for of in (seen, reported))
        entry |= {"name": path, "graph": asked.graph, "training_operations": cost["operations"]}
        entry["training_right"] = int(np.count_nonzero(decided == training.labels))
        entry["test_right"] = int(np.count_nonzero(decided_test == test.labels))
        candidates.append(entry)
        compilations.append(compilation)
    return candidates, compilations


def _cheapest(candidates: list[Json]) -> int:
    """The candidate of fewest operations in training among those within one training recording of the best."""
    least = max(entry["training_right"] for entry in candidates) - 1
    fitting = [i for i, entry in enumerate(candidates) if entry["training_right"] >= least]
    return min(fitting, key=lambda i: candidates[i]["training_operations"])


def _costs(netlist: Netlist, target: Target, of: Scene) -> tuple[IntArray, Json]:
    """Decisions, and what an inference costs in the mean."""
    from spikeloom.runtime.machines.votes import predictions

    counts, found = estimate(netlist, target, of.flat, lengths=of.lengths)
    return predictions(netlist, counts.spikes), {
        "operations": float(found.costs.synaptic_operations.sum(axis=1).mean()),
        "energy_j": {name: float(each.sum(axis=1).mean()) for name, each in found.costs.energy.items()},
        "time_s": {name: float(each.duration_ns.sum(axis=1).mean() * 1e-9) for name, each in found.simple.items()},
        "cores": netlist.n_cores,
        "neurons": netlist.n_compartments,
        "synapses": netlist.n_synapses,
    }


class _Session:
    """All trials with one compiled network."""

    def __init__(
        self, asked: LoadedNetwork, compilation: Compilation, training: Recordings, test: Recordings, allowed: int
    ) -> None:
        self.asked, self.compilation, self.target = asked, compilation, load_target(TARGET)
        self.netlist = compilation.netlist
        self.training, self.test = scene(training, self.netlist), scene(test, self.netlist)
        ran = engine.simulate(self.netlist, self.training.flat, lengths=self.training.lengths)
        self.spikes = ran.counts.spikes.sum(axis=0)
        self.wanted, self.wanted_test = decisions(self.netlist, self.training), decisions(self.netlist, self.test)
        self.strict = Trial(
            compilation=compilation,
            integer=compilation.integer,
            training=self.training,
            wanted=self.wanted,
            allowed=0,
        )
        self.loose = replace(self.strict, allowed=allowed)
        self.rows: list[Json] = []
        self.overflowing: list[str] = []
        self._kept: list[tuple[int, Netlist]] = []

    def report(self) -> Json:
        """Run all trials; afterwards `netlist` is the one that takes least energy, of those that change few enough."""
        netlist = self.netlist
        self._add("everything", {}, netlist)
        progress("neurons")
        never = np.flatnonzero((self.spikes == 0) & (netlist.readout_class < 0))
        self._add(
            "neurons that never fired in training", self._neurons(netlist, never), self.strict.built(never, netlist)
        )
        for trial in self._trials():
            spared = trial.spare_neurons(netlist, self.spikes)
            built = trial.built(spared, netlist)
            self._add(f"neurons, {self._told(trial)}", self._neurons(netlist, spared), built, keep=True)
        progress("taxels")
        changed, changed_test = (
            alone(netlist, of, wanted) for of, wanted in ((self.training, self.wanted), (self.test, self.wanted_test))
        )
        for trial in self._trials():
            spared = trial.spare_taxels(netlist, changed)
            deaf = replace(trial, integer=without_taxels(trial.integer, netlist, spared))
            self._add(f"taxels, {self._told(trial)}", {"taxels": sorted(spared.tolist())}, deaf.built(), keep=True)
        hops = self._hops()
        self._bins()
        self._together(hops, changed)
        samples = len(self.training.labels)
        taken, self.netlist = min(self._kept, key=lambda kept: self._energy(kept[1]))
        return {
            "taken": taken,
            "samples": {"training": samples, "test": len(self.test.labels)},
            "layers": self._layers(),
            "taxels": self._taxels(changed, changed_test),
            "rows": self.rows,
            "overflowing": self.overflowing,
        }

    def _trials(self) -> tuple[Trial, ...]:
        return (self.strict, self.loose) if self.loose.allowed else (self.strict,)

    def _told(self, trial: Trial) -> str:
        return "no training decision changed" if not trial.allowed else f"{trial.allowed} training decisions may change"

    def _energy(self, netlist: Netlist) -> float:
        """Joules of a training recording by the first table, or operations where no table prices them."""
        costs = _costs(netlist, self.target, self.training)[1]
        return float(next(iter(costs["energy_j"].values()), costs["operations"]))

    def _add(
        self,
        name: str,
        removed: Json,
        netlist: Netlist,
        training: Scene | None = None,
        test: Scene | None = None,
        *,
        keep: bool = False,
    ) -> Json:
        """Measure what is left."""
        training, test = training or self.training, test or self.test
        decided = decisions(netlist, training)
        found, costs = _costs(netlist, self.target, test)
        before = self.wanted_test == test.labels
        row = {
            "name": name,
            "removed": removed,
            "training": {
                "differ": int(np.count_nonzero(decided != self.wanted)),
                "right": int(np.count_nonzero(decided == training.labels)),
            },
            "test": {
                "differ": int(np.count_nonzero(found != self.wanted_test)),
                "right": int(np.count_nonzero(found == test.labels)),
                "gained": int(np.count_nonzero(~before & (found == test.labels))),
                "lost": int(np.count_nonzero(before & (found != test.labels))),
            },
            **costs,
        }
        if keep and row["training"]["differ"] <= self.loose.allowed:
            self._kept.append((len(self.rows), netlist))
        self.rows.append(row)
        return row

    def _neurons(self, netlist: Netlist, gone: IntArray) -> Json:
        """How many neurons of each layer."""
        counts = np.bincount(netlist.layer[gone], minlength=len(netlist.layers))
        return {"neurons": {layer.name: int(n) for layer, n in zip(netlist.layers, counts, strict=True) if n}}

    def _hops(self) -> tuple[int, ...]:
        """Try every hop alone and all from one on; the cheapest that changes few enough training decisions."""
        checkpoint, adjacency = self.asked.checkpoint, self.asked.adjacency
        if checkpoint is None or adjacency is None or checkpoint.system != TACTILESGNET or len(checkpoint.hops) < 2:
            return ()
        count = len(checkpoint.hops)
        tried = [(hop,) for hop in range(count)] + [tuple(range(hop, count)) for hop in range(1, count - 1)]
        best: tuple[float, tuple[int, ...]] = np.inf, ()
        for hops in tried:
            progress(f"without hops {', '.join(map(str, hops))}")
            integer = without_hops(self.compilation, checkpoint, adjacency, hops)
            name = f"hop {hops[0]}" if len(hops) == 1 else f"hops {hops[0]} to {hops[-1]}"
            if integer is None:
                self.overflowing.append(name)
            else:
                built = replace(self.strict, integer=integer).built()
                row = self._add(name, {"hops": list(hops)}, built, keep=True)
                if row["training"]["differ"] <= self.loose.allowed:
                    best = min(best, (row["operations"], hops))
        return best[1]

    def _bins(self) -> None:
        """Join bins, with the decays as they are and with those of as many steps."""
        for bins in BINS:
            progress(f"{bins} bins joined")
            for adapted in (False, True):
                told = "decays of as many steps" if adapted else "decays as they are"
                self._add(
                    f"{bins} bins joined, {told}",
                    {"bins": bins},
                    coarse_netlist(self.netlist, bins, adapted=adapted),
                    coarser(self.training, self.netlist, bins),
                    coarser(self.test, self.netlist, bins),
                )

    def _together(self, hops: tuple[int, ...], changed: IntArray) -> None:
        """Hops, then taxels, then neurons, as long as no more training decisions change than may."""
        trial, removed = self.loose, dict[str, Any]()
        checkpoint, adjacency = self.asked.checkpoint, self.asked.adjacency
        if hops and checkpoint is not None and adjacency is not None:
            fewer = without_hops(self.compilation, checkpoint, adjacency, hops)
            assert fewer is not None, "it was tried before"
            trial, removed = replace(trial, integer=fewer), {"hops": list(hops)}
        progress("all of it together")
        built = trial.built()
        taxels = trial.spare_taxels(built, changed)
        trial = replace(trial, integer=without_taxels(trial.integer, built, taxels))
        built = trial.built()
        ran = engine.simulate(built, self.training.flat, lengths=self.training.lengths)
        spared = trial.spare_neurons(built, ran.counts.spikes.sum(axis=0))
        removed |= {"taxels": sorted(taxels.tolist())} | self._neurons(built, spared)
        self._add(f"together, {self._told(trial)}", removed, trial.built(spared, built), keep=True)

    def _layers(self) -> list[Json]:
        """Neurons of each layer by what they do."""
        netlist = self.compilation.netlist
        found = []
        for index, layer in enumerate(netlist.layers):
            held = netlist.compartments_of(index)
            quiet = int(np.count_nonzero(self.spikes[held] == 0))
            entry = {"name": layer.name, "neurons": layer.neurons, "on_chip": len(held), "never_fired": quiet}
            found.append(entry)
        return found

    def _taxels(self, changed: IntArray, changed_test: IntArray) -> list[Json]:
        """Events of each taxel and what its absence changes."""
        netlist = self.compilation.netlist
        sensor = self.training.flat[:, : netlist.taxels * netlist.polarities]
        events = sensor.reshape(len(sensor), netlist.taxels, -1).sum(axis=(0, 2), dtype=np.int64)
        return [
            {"events": int(count), "training_differ": int(here), "test_differ": int(there)}
            for count, here, there in zip(events, changed, changed_test, strict=True)
        ]
