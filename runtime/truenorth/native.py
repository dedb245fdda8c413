"""``compile``, ``verify`` and ``inspect`` of networks that were trained for TrueNorth."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compiler.dynamics import with_clocks
from compiler.errors import OptionError
from compiler.fixedpoint import IntArray
from compiler.interpret import vote
from compiler.targets import CROSSBARS, Target, known_targets, load_target
from compiler.truenorth.lower import lower
from compiler.truenorth.native import BASES, SYSTEM, highest_level
from compiler.truenorth.netlist import CrossbarNetlist
from compiler.truenorth.rules import require_legal
from compiler.truenorth.serialize import write_crossbars
from compiler.truenorth.trained import Trained, is_trained, read_trained
from models.evtouch import Recordings
from runtime.inputs import asked_recordings, progress, shipped, version
from runtime.intervals import wilson
from runtime.tables import table
from runtime.trace import ENGINES
from runtime.truenorth import engine, render, spec
from runtime.truenorth.commands import class_counts, legal
from runtime.truenorth.refusal import require_crossbar_options
from runtime.windows import first_part, window_asked

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
        "spikeloom": version(),
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """Chip against definition and model.

    Parameters
    ----------
    spec_samples, spec_differences : int
        Recordings on which engine and specification ran, and spikes, membranes and counts that differ.
    spikes : dict of str to int
        Spikes of the model by layer.
    differences : dict of str to int
        Of neurons on the chip, copies included, by layer: spikes that the model has not, or the reverse.
    overflows : int
        Ticks in which a membrane left its register.
    counts : (samples, classes) int64
        Votes on the chip.
    """

    spec_samples: int
    spec_differences: int
    spikes: dict[str, int]
    differences: dict[str, int]
    overflows: int
    counts: IntArray


def compare(netlist: CrossbarNetlist, trained: Trained, data: Recordings, *, spec_samples: int) -> Verdict:
    """Run the chip and the model on recordings, and count every spike that differs.

    Parameters
    ----------
    netlist : CrossbarNetlist
        Compiled from the network.
    trained : Trained
        The network.
    data : Recordings
        What to run.
    spec_samples : int
        Recordings, from the first, on which the specification runs, too.
    """
    from models.truenorth.network import run_network  # torch, so only here

    prepared = engine.prepare(netlist)
    layers = list(netlist.layers)
    depth = {stage.name: number for number, stage in enumerate(trained.network.towers[0])}
    spikes, differences = dict.fromkeys(depth, 0), dict.fromkeys(depth, 0)
    counts, overflows, wrong = [], 0, 0
    for index in range(len(data)):
        progress(f"comparing: {index} of {len(data)}")
        events = data.events[index : index + 1, ..., : data.steps_of(index)]
        channels = with_clocks(events, netlist.clocks)
        deep = index < spec_samples
        trace = engine.simulate(prepared, channels, spikes=True, membranes=deep)
        assert trace.spikes is not None, "spikes were asked for"
        model = run_network(trained.network, events)
        steps = events.shape[-1]
        for name, late in depth.items():
            chosen = np.flatnonzero(netlist.layer == layers.index(name))
            on_chip = trace.spikes[0, late : late + steps][:, chosen]
            spikes[name] += int(model[name].sum())
            differences[name] += int(np.count_nonzero(on_chip != model[name][0][:, netlist.neuron[chosen]]))
        overflows += int(trace.counts.overflows.sum())
        counts.append(class_counts(netlist, trace.counts.votes)[0])
        if deep:
            wrong += _against_spec(netlist, channels[0], trace)
    return Verdict(
        spec_samples=min(spec_samples, len(data)),
        spec_differences=wrong,
        spikes=spikes,
        differences=differences,
        overflows=overflows,
        counts=np.array(counts, np.int64).reshape(len(data), netlist.classes),
    )


def _against_spec(netlist: CrossbarNetlist, channels: Any, trace: Any) -> int:
    """Spikes, membranes, and spikes on axons that differ between engine and specification."""
    slow = spec.simulate(netlist, channels)
    pairs = (
        (slow.spikes, trace.spikes[0]),
        (slow.membranes, trace.membranes[0]),
        (slow.counts.axons, trace.counts.axons[0]),
        (slow.counts.votes, trace.counts.votes[0]),
    )
    return sum(int(np.count_nonzero(one != other)) for one, other in pairs)


def verify(arguments: argparse.Namespace) -> Outcome:
    """Compare chip, specification and model; exit code 1 where one spike differs."""
    for name, absent in (("original", None), ("min_agreement", None), ("require", None), ("engine", ENGINES[0])):
        value = getattr(arguments, name)
        if value != absent:
            raise OptionError(
                f"--{name.replace('_', '-')} {value}: a network for TrueNorth has one model, whose every spike must be "
                "the chip's; leave it away"
            )
    netlist, chip = legal(arguments.netlist)
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
    percent = window_asked(arguments.window)
    data = first_part(asked_recordings(arguments, netlist, labels_for="verify"), percent)
    verdict = compare(netlist, trained, data, spec_samples=arguments.spec_samples)
    report = verdict_json(verdict, data, chip)
    return report, verdict_text, 0 if report["exact"] else 1


def verdict_json(verdict: Verdict, data: Recordings, chip: Target) -> Json:
    """JSON values of a comparison."""
    correct = int(np.count_nonzero(vote(verdict.counts) == data.labels))
    different = sum(verdict.differences.values())
    return {
        "target": chip.name,
        "samples": len(data),
        "E0": {"samples": verdict.spec_samples, "differences": verdict.spec_differences},
        "E1": {
            "differences": different,
            "layers": [
                {"name": name, "spikes": verdict.spikes[name], "differences": verdict.differences[name]}
                for name in verdict.spikes
            ],
        },
        "membranes_saturated": verdict.overflows,
        "correct": correct,
        "exact": not (different or verdict.spec_differences or verdict.overflows),
    }


def verdict_text(report: Json) -> str:
    """The same for people."""
    samples, correct = report["samples"], report["correct"]
    low, high = wilson(correct, samples)
    spec_part, model_part = report["E0"], report["E1"]
    rows = [[layer["name"], f"{layer['spikes']:,}", f"{layer['differences']:,}"] for layer in model_part["layers"]]
    return "\n".join(
        [
            f"E0 specification = engine: {_told(spec_part)}, membranes and counts too",
            f"E1 model = chip: {_told(model_part | {'samples': samples})}, every copy of every neuron",
            table(["layer", "spikes of the model", "different"], rows),
            f"membranes that left their register: {report['membranes_saturated']:,}",
            f"accuracy of the chip: {correct} of {samples}, {100 * correct / samples:.2f} % "
            f"(95 %: {100 * low:.1f} … {100 * high:.1f}); the model's is the same, vote for vote"
            if report["exact"]
            else f"accuracy of the chip: {correct} of {samples}, {100 * correct / samples:.2f} %",
        ]
    )


def _told(level: Json) -> str:
    on = f"on {level['samples']} recording{'s' * (level['samples'] != 1)}"
    return f"{level['differences']:,} differences {on}" if level["differences"] else f"equal in every spike {on}"


def is_named(path: str) -> bool:
    """Whether what a user names is a network for TrueNorth."""
    return Path(shipped(path)).is_file() and is_trained(shipped(path))
