"""The command ``explain``: why chip and float model differ on one recording.

The reference is the float model in float64, run from the synapses that the compiler expands; ``verify`` compares with
float32, as the model was trained. The chip is :mod:`loihi1.engine`.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from difflib import get_close_matches
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from spikeloom.compiler import lift
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.interpret import BoolArray, channels_last
from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TACTILESGNET
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import add_network, add_recordings
from spikeloom.runtime.equivalence import causes
from spikeloom.runtime.equivalence.causes import Explanation, Observed, RootCause
from spikeloom.runtime.equivalence.suspects import BETA, BIAS, LEFT_OUT, SATURATION, THRESHOLD, TIE, TRUNCATION, WEIGHTS
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.loihi1.trace import aligned, check_channels
from spikeloom.runtime.report.tables import table

if TYPE_CHECKING:
    from spikeloom.runtime.machines.loihi1.engine import Engine

Json = dict[str, Any]

NOTES = """\
An entry (neuron and step) that differs is a root if no input of the neuron differed since the last step in which both
sides fired; everything else follows from roots. Without --sample the first recording that differs is explained, of
the first ten or the first --limit. The reference is the float model in float64.
"""

LIMIT = 10
"""Recordings that are searched for a difference by default."""

WIDTH = 116
"""Columns of a line of text."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("netlist", metavar="NET.loom")
    parser.add_argument("--checkpoint", required=True, metavar="CKPT|NET.onnx")
    add_network(parser)
    add_recordings(parser)
    parser.add_argument("--sample", metavar="FILE", help="recording to explain (default: the first that differs)")
    parser.add_argument("--top", type=int, default=10, metavar="N", help="roots to show (default: 10)")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command; differences are its subject, not a failure.

    Raises
    ------
    SpikeloomError
        If an option, the netlist, the checkpoint or the recordings cannot be used.
    """
    from spikeloom.runtime.equivalence.verify import require_match
    from spikeloom.runtime.machines.loihi1 import engine

    if arguments.top < 1:
        raise OptionError(f"--top {arguments.top}: at least 1 root can be shown; give a positive number")
    netlist = read_netlist(arguments.netlist)
    asked = load_network(arguments.checkpoint, arguments, netlist)
    checkpoint, graph = asked.checkpoint, asked.graph
    require_match(netlist, asked.model)
    _warn(netlist, asked)
    limit = LIMIT if arguments.limit is None and arguments.sample is None else arguments.limit
    data = recordings(
        arguments.data,
        arguments.split,
        limit=limit,
        classes=netlist.classes,
        taxels=netlist.taxels,
        bin_s=arguments.bin,
        bins=netlist.bins,
    )
    check_channels(netlist, data.events.shape[1] * data.events.shape[2] + netlist.clocks.channels)
    chosen = range(len(data)) if arguments.sample is None else [_index(data, arguments.sample)]

    network, integer, prepared = asked.network, lift(netlist), engine.prepare(netlist)
    absent, unheard = left_out(netlist)
    found: Explanation | None = None
    index = 0
    for index in chosen:
        events = data.events[index : index + 1, ..., : data.steps_of(index)]
        found = causes.explain(
            network,
            integer,
            channels_last(events, netlist.clocks)[0],
            _observe(netlist, prepared, events),
            convolution=None
            if checkpoint is None or checkpoint.system != TACTILESGNET or asked.adjacency is None
            else (asked.adjacency, checkpoint.hops.astype(np.float64)),
            may_compensate=bool(netlist.provenance.get("calibrated", True)),
            absent=absent,
            unheard=unheard,
            pruned=bool(netlist.provenance.get("prune_unused", False)),
        )
        if any(found.different):
            break
    assert found is not None, "recordings are never empty"
    report = {
        "sample": data.files[index],
        "split": data.split,
        "recording": index,
        "searched": 1 if arguments.sample is not None else index + 1,
        "steps": data.steps_of(index),
        "graph": graph,
        "reference": "float64",
    }
    return report | explanation_json(found, integer, checkpoint, arguments.top), explanation_text, 0


def _warn(netlist: Netlist, asked: LoadedNetwork) -> None:
    """Say on stderr what the netlist remembers of its origin, where that is something else."""
    made, checkpoint, graph = netlist.provenance, asked.checkpoint, asked.graph
    if made.get("graph", graph) != graph:
        sys.stderr.write(f"spikeloom: warning: the netlist was compiled for graph {made['graph']}, this is {graph}\n")
    if made.get("checkpoint_sha256", asked.sha256) != asked.sha256:
        sys.stderr.write("spikeloom: warning: the netlist was compiled from another checkpoint file\n")
    elif checkpoint is not None and made.get("weights", checkpoint.weights) != checkpoint.weights:
        sys.stderr.write(
            f"spikeloom: warning: the netlist was compiled from the weights {made['weights']!r}, these are "
            f"{checkpoint.weights!r}; name them with --weights\n"
        )


def _index(data: Recordings, name: str) -> int:
    """Where a recording is."""
    if name in data.files:
        return data.files.index(name)
    near = get_close_matches(name, data.files, n=3, cutoff=0.5) or data.files[:3]
    raise DataError(
        f"--sample {name}: no such recording among {len(data)} of split {data.split}; near are {', '.join(near)}; "
        "'spikeloom run --json' lists the names"
    )


def _observe(netlist: Netlist, prepared: Engine, events: np.ndarray[Any, Any]) -> Observed:
    """What the chip does on one recording."""
    from spikeloom.runtime.machines.loihi1 import engine

    trace = engine.simulate(prepared, with_clocks(events, netlist.clocks), spikes=True, membranes=True)
    assert trace.spikes is not None, "spikes were asked for"
    assert trace.membranes is not None, "membranes were asked for"
    layers = range(len(netlist.layers))
    return Observed(
        spikes=tuple(aligned(netlist, trace.spikes, layer)[0] for layer in layers),
        membranes=tuple(aligned(netlist, trace.membranes, layer)[0] for layer in layers),
    )


def left_out(netlist: Netlist) -> tuple[list[BoolArray], list[BoolArray]]:
    """Neurons of each layer that the chip does not hold, and those of them that nobody hears."""
    absent, unheard = [], []
    for index, layer in enumerate(netlist.layers):
        neurons = np.arange(layer.neurons)
        absent.append(~np.isin(neurons, netlist.neuron[netlist.compartments_of(index)]))
        unheard.append(np.isin(neurons, layer.unheard))
    return absent, unheard


# -- what would remove a root ------------------------------------------------------------------------------------------


_BOUND = ", as far as the accumulator lets it"


def remedy(found: RootCause, layer: str, *, bits: int, planes: int) -> str:
    """The change that would remove a root.

    Parameters
    ----------
    found : RootCause
        A root and its cause.
    layer : str
        Name of its population.
    bits, planes : int
        How the population is stored.
    """
    if found.suspect is not None:
        return found.suspect.change
    if found.cause == WEIGHTS:
        why = "the range cuts off its largest weights" if found.clipped else "its weights are too coarse"
        if not found.held:
            why = "no input can make it fire with its rounded weights"
        wider = "--weight-bits 8 or " if bits < 8 else ""
        if planes < 3:
            return f"{why}: compile {layer} with {wider}--planes {planes + 1}{_BOUND if planes > 1 else ''}"
        return f"{why}: compile {layer} with {wider}--scale-groups 8{_BOUND}"
    return {
        BIAS: f"a bias counts in 64ths of a weight unit: compile {layer} with --scale-groups 8, for finer units",
        THRESHOLD: "choose the scale as threshold / theta: compile it again",
        BETA: "none on this chip, whose decay has 12 bits; a model trained with the realised decay would agree",
        TRUNCATION: f"what the chip drops is part of one unit: compile {layer} with --scale-groups 8, for finer units",
        SATURATION: f"the membrane leaves its 23 bits: compile {layer} with a coarser scale",
        LEFT_OUT: "compile without --prune-unused",
        TIE: "none: the order of a sum in float64 decides here, either spike is right",
    }.get(found.cause, "none is known")


# -- the result --------------------------------------------------------------------------------------------------------


def explanation_json(found: Explanation, integer: IntegerNetwork, checkpoint: Checkpoint | None, top: int) -> Json:
    """An explanation as JSON values, with its first roots in full."""
    names = [population.name for population in integer.populations]
    per_layer = Counter(root.root.layer for root in found.roots)
    kinds = Counter(root.cause for root in found.roots)
    layers = [
        {
            "name": name,
            "float_spikes": found.float_spikes[i],
            "chip_spikes": found.chip_spikes[i],
            "different": found.different[i],
            "roots": per_layer[i],
            "propagated": found.different[i] - per_layer[i],
        }
        for i, name in enumerate(names)
    ]
    both = Counter((root.cause, names[root.root.layer]) for root in found.roots)
    faults = Counter(root.suspect for root in found.roots if root.suspect is not None)
    return {
        "different": sum(found.different),
        "roots": len(found.roots),
        "diagnosis": found.diagnosis,
        "layers": layers,
        "causes": [
            {
                "cause": cause,
                "roots": count,
                "layers": {name: both[cause, name] for name in names},
                "from_clipped_weights": sum(root.clipped and root.cause == cause for root in found.roots),
            }
            for cause, count in kinds.most_common()
        ],
        "faults": [
            {
                "cause": fault.cause,
                "layer": names[fault.layer],
                "part": fault.part,
                "found": fault.found,
                "change": fault.change,
                "roots": faults[fault],
            }
            for fault in found.suspects
        ],
        "top": [_root_json(root, integer, checkpoint) for root in found.roots[:top]],
    }


def _root_json(found: RootCause, integer: IntegerNetwork, checkpoint: Checkpoint | None) -> Json:
    root, population = found.root, integer.populations[found.root.layer]
    stored = [p for p in integer.projections if p.post == root.layer]
    by_taxel = checkpoint is not None and checkpoint.system in GRAPH_SYSTEMS and root.layer == 0
    features = checkpoint.hops.shape[1] if checkpoint is not None and by_taxel else None
    return {
        "layer": population.name,
        "neuron": root.neuron,
        "taxel": None if features is None else root.neuron // features,
        "feature": None if features is None else root.neuron % features,
        "step": root.step,
        "remembers_from_step": root.begin,
        "float_fires": found.float_fires,
        "float_membrane": found.float_membrane,
        "float_distance": found.float_membrane - found.theta,
        "theta": found.theta,
        "chip_membrane": found.chip_membrane if found.held else None,
        "chip_distance": found.chip_membrane - found.chip_theta if found.held else None,
        "chip_theta": found.chip_theta if found.held else None,
        "chip_register": found.chip_register if found.held else None,
        "chip_threshold_register": found.chip_threshold if found.held else None,
        "cause": found.cause,
        "fault": found.suspect is not None,
        "held": found.held,
        "clipped_weights": found.clipped,
        "sufficient": list(found.sufficient),
        "moved": dict(found.gap),
        "change": remedy(
            found,
            population.name,
            bits=max(p.bits for p in stored),
            planes=len({p.exponent for p in stored}),
        ),
        "dragged": root.dragged,
        "dragged_alone": root.alone,
    }


def explanation_text(report: Json) -> str:
    """An explanation for people."""
    where = f"{report['sample']} ({report['split']} split, recording {report['recording']} counted from 0)"
    if not report["different"]:
        searched = report["searched"]
        what = where if searched == 1 else f"the first {searched} recordings of the {report['split']} split"
        lines = [f"{what}: every spike of the chip is the float64 model's; nothing to explain"]
        return "\n".join([*lines, *_faults_text(report)])
    names = [layer["name"] for layer in report["layers"]]
    columns = ("float_spikes", "chip_spikes", "different", "roots", "propagated")
    different, roots = report["different"], report["roots"]
    lines = [
        where,
        f"{different:,} entries (neuron and step) differ from the float64 model: {roots:,} are roots, "
        f"{different - roots:,} follow from them",
        "",
        table(
            ["layer", *(column.replace("_", " ") for column in columns)],
            [[layer["name"], *(f"{layer[column]:,}" for column in columns)] for layer in report["layers"]],
        ),
        "",
        table(
            ["cause of roots", *names, "all"],
            [
                [cause["cause"], *(f"{cause['layers'][name]:,}" for name in names), f"{cause['roots']:,}"]
                for cause in report["causes"]
            ],
        ),
        *_clipped_text(report),
        *_faults_text(report),
        "",
        f"diagnosis: {report['diagnosis']}",
        "",
        f"roots, those first that drag most along ({len(report['top']):,} of {roots:,} shown, --top shows more):"
        if roots > len(report["top"])
        else "roots, those first that drag most along:",
    ]
    for number, root in enumerate(report["top"], 1):
        lines += ["", *_root_text(number, root)]
    return "\n".join(lines)


def _clipped_text(report: Json) -> list[str]:
    clipped = sum(cause["from_clipped_weights"] for cause in report["causes"])
    return [f"  {clipped:,} of these roots would go if no large weight were cut off by its range"] if clipped else []


def _faults_text(report: Json) -> list[str]:
    lines = []
    for fault in report["faults"]:
        side = "simulator" if fault["part"] == "machine" else "netlist"
        count = f"{fault['roots']:,} roots come" if fault["roots"] != 1 else "1 root comes"
        lines += [
            "",
            f"FAULT of the {side}, {fault['layer']}: {fault['cause']} ({count} from it)",
            *wrap(fault["found"], WIDTH, initial_indent="  ", subsequent_indent="  "),
            *wrap(f"to remove it: {fault['change']}", WIDTH, initial_indent="  ", subsequent_indent="  "),
        ]
    return lines


def _root_text(number: int, root: Json) -> list[str]:
    graph = "" if root["taxel"] is None else f" (taxel {root['taxel']}, feature {root['feature']})"
    fires = "the float model fires, the chip does not" if root["float_fires"] else "the chip fires, the float model not"
    chip = "does not hold this neuron"
    if root["held"]:
        chip = _membrane(root["chip_membrane"], root["chip_distance"], root["chip_theta"])
        chip += f"; registers {root['chip_register']} and {root['chip_threshold_register']}"
    follow = f"{root['dragged']:,} later differences, {root['dragged_alone']:,} of them from this root alone"
    cause = root["moved"].get(root["cause"])
    by = "" if cause is None else f", which moved the membrane by {cause:.3g}"
    only = (
        "" if not root["held"] or root["cause"] in (TIE, *root["sufficient"]) else "; no single change is enough here"
    )
    return [
        f"{number:3}. {root['layer']} neuron {root['neuron']}{graph}, step {root['step']}: {fires}",
        f"     float    {_membrane(root['float_membrane'], root['float_distance'], root['theta'])}",
        f"     chip     {chip}",
        f"     cause    {root['cause']}{by}{only}",
        f"     change   {root['change']}",
        f"     drags    {follow}",
    ]


def _membrane(value: float, distance: float, theta: float) -> str:
    side = "above" if distance > 0 else "below"
    place = f"{abs(distance):.3g} {side}" if distance else "exactly at"
    return f"membrane {value:9.6f}, {place} the threshold {theta:.6g}"
