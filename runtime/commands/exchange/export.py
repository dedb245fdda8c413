"""The command ``export``: a netlist, or a checkpoint's float network, in the format of another program."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats import ranc, sanafe
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.formats.netx import writer as netx_export
from spikeloom.compiler.formats.nir import writer as nir_export
from spikeloom.compiler.formats.nir.neurons import CONVENTIONS
from spikeloom.compiler.formats.nir.sidecar import sidecar_bytes, sidecar_of
from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.compiler.formats.onnx import writer_float as onnx_float
from spikeloom.compiler.formats.onnx.builder import port_words
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.recordings.events import BIN_S
from spikeloom.runtime.commands.options import DATA_HELP, MODEL, add_bin_option, add_model
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import recordings

Json = dict[str, Any]


FORMATS = {
    "sanafe": f"network and mapping of a netlist for SANA-FE {sanafe.VERSION}, YAML",
    "ranc": "TrueNorth cores, and a recording, for RANC's simulator, JSON",
    "onnx": "a netlist as an integer ONNX graph, bit for bit the chip",
    "onnx-float": "the float network of a checkpoint as a static ONNX graph",
    "nir": "a netlist as a NIR file in weight units, with a side-car FILE.json that holds all of it",
    "netx": "a netlist as a .net file of lava-dl, biases rounded to whole weight steps",
}
"""Values of ``--to``."""

RECORDING: dict[str, tuple[object, tuple[str, ...]]] = {
    "data": (None, ("ranc", "netx")),
    "split": (None, ("ranc", "netx")),
    "bin": (BIN_S, ("ranc", "netx")),
    "recording": (None, ("ranc",)),
    "limit": (None, ("netx",)),
}
"""Options that name recordings: what they are where they are not given, and the formats that they are for."""

OWN = {"dt": (None, "nir"), "strict": (False, "netx")}
"""Other options of one format, likewise."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("source", metavar="NET.loom|CKPT", help="a netlist; for onnx-float a checkpoint")
    parser.add_argument(
        "--to", required=True, choices=tuple(FORMATS), help="; ".join(f"{key}: {what}" for key, what in FORMATS.items())
    )
    parser.add_argument(
        "--form", choices=onnx_writer.FORMS, help="onnx: one step with its state, or whole recordings (default: scan)"
    )
    parser.add_argument(
        "--data",
        metavar="PATH",
        help=f"ranc: a recording to add; netx: those on which spikes that move are counted; {DATA_HELP}",
    )
    parser.add_argument("--split", help="ranc, netx: split to read (default: test)")
    parser.add_argument("--recording", type=int, metavar="N", help="ranc: which of them (default: 0)")
    parser.add_argument("--limit", type=int, metavar="N", help="netx: first N of them only")
    add_bin_option(parser)
    add_model(parser)
    parser.add_argument("--dt", type=float, metavar="SECONDS", help=f"nir: length of a step (default: {BIN_S:g} a bin)")
    parser.add_argument("--strict", action="store_true", help="netx: write nothing that had to be rounded")
    parser.add_argument("-o", "--output", required=True, metavar="FILE")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Written:
    """What a format makes of a network.

    Parameters
    ----------
    chunks : iterable of bytes
        The file.
    facts : JSON values
        What tells about it.
    beside : mapping of str to bytes
        Files to go with it, by their paths.
    """

    chunks: Iterable[bytes]
    facts: Json
    beside: Mapping[str, bytes] = field(default_factory=dict)


def _sanafe(arguments: argparse.Namespace) -> Written:
    netlist = read_netlist(arguments.source)
    target = load_target(netlist.target)
    places = sanafe.cores(netlist, target)
    lines = (f"{line}\n".encode() for line in sanafe.export(netlist, target))
    facts = {
        "neurons": netlist.n_compartments,
        "synapses": netlist.n_synapses,
        "groups": [sanafe.INPUT, *sanafe.group_names(netlist)],
        "cores": list(places[: netlist.n_cores]),
        "input_cores": list(places[netlist.n_cores :]),
        **({"floating_currents": list(floating)} if (floating := sanafe.floating_layers(netlist)) else {}),
    }
    return Written(chunks=lines, facts=facts)


def _ranc(arguments: argparse.Namespace) -> Written:
    netlist, events = ranc.read(arguments.source), None
    if arguments.data is not None:
        data = recordings(
            arguments.data,
            arguments.split or "test",
            classes=netlist.classes,
            taxels=netlist.taxels,
            bin_s=arguments.bin,
        )
        number = arguments.recording or 0
        if not 0 <= number < len(data.files):
            raise OptionError(f"--recording {number}: {arguments.data} has recordings 0 to {len(data.files) - 1}")
        events = with_clocks(data.events[number : number + 1], netlist.clocks)[0, :, : data.steps_of(number)]
    lines = (f"{line}\n".encode() for line in ranc.export(netlist, events))
    ticks = None if events is None else netlist.ticks(events.shape[1]) + 1
    return Written(chunks=lines, facts={"neurons": netlist.n_neurons, "synapses": netlist.n_synapses, "ticks": ticks})


def _onnx(arguments: argparse.Namespace) -> Written:
    netlist = read_netlist(arguments.source)
    content = onnx_writer.export(netlist, arguments.form or "scan")
    facts = {"neurons": netlist.n_compartments, "synapses": netlist.n_synapses}
    return Written(chunks=[content], facts=facts | _ports(arguments, content))


def _onnx_float(arguments: argparse.Namespace) -> Written:
    checkpoint = load_checkpoint(arguments.source, arguments)
    name, adjacency = propagation(checkpoint, load_graph(arguments), arguments.source)
    content = onnx_float.export_float(checkpoint, adjacency, arguments.form or "scan", graph_name=name)
    neurons = len(adjacency) * len(checkpoint.conv_bias) + sum(len(dense.bias) for dense in checkpoint.dense)
    return Written(chunks=[content], facts={"neurons": neurons, "graph": name} | _ports(arguments, content))


def _ports(arguments: argparse.Namespace, content: bytes) -> Json:
    inputs, outputs = port_words(content)
    return {"form": arguments.form or "scan", "inputs": inputs, "outputs": outputs}


def _nir(arguments: argparse.Namespace) -> Written:
    netlist = read_netlist(arguments.source)
    dt = BIN_S * netlist.bins if arguments.dt is None else arguments.dt
    beside = str(sidecar_of(arguments.output))
    require_place(beside, "-o", arguments)
    content = nir_export.export(netlist, dt)
    facts = {
        "neurons": sum(layer.neurons for layer in netlist.layers),
        "synapses": netlist.n_synapses,
        "dt": dt,
        "convention": CONVENTIONS[0],
        "sidecar": beside,
    }
    said = sidecar_bytes(netlist, content, dt=dt, convention=CONVENTIONS[0])
    return Written(chunks=[content], facts=facts, beside={beside: said})


def _netx(arguments: argparse.Namespace) -> Written:
    netlist = read_netlist(arguments.source)
    network = lift(netlist)
    blocks = netx_export.blocks_for(network)
    exact = not any(block.rounded or block.threshold_rounded or block.shift for block in blocks)
    layers: list[Json] = [
        {
            "name": block.name,
            "biases": len(block.bias),
            "biases_rounded": block.rounded,
            "furthest_steps": block.furthest,
            "threshold_rounded": block.threshold_rounded,
            "rescaled_by": 2.0**block.shift,
        }
        for block in blocks
    ]
    if arguments.strict and not exact:
        raise OptionError(f"--strict: netx cannot hold {arguments.source} as it is ({'; '.join(_rounding(layers))})")
    if arguments.data is not None:
        data = recordings(
            arguments.data,
            arguments.split or "test",
            limit=arguments.limit,
            classes=netlist.classes,
            taxels=netlist.taxels,
            bin_s=arguments.bin,
            bins=netlist.bins,
        )
        moved = netx_export.moved_spikes(network, blocks, channels_last(data.events, netlist.clocks))
        for layer in layers:
            layer["spikes_moved"], layer["spikes"] = moved[layer["name"]]
    content = netx_export.file_bytes(netx_export.tree_of(network, blocks))
    facts = {
        "neurons": sum(len(block.bias) for block in blocks),
        "synapses": sum(block.synapses for block in blocks),
        "exact": exact,
        "layers": layers,
        **({} if arguments.data is None else {"recordings": len(data)}),
    }
    return Written(chunks=[content], facts=facts)


def _rounding(layers: list[Json]) -> list[str]:
    """What was rounded in each layer, for people."""
    told = []
    for layer in layers:
        words = []
        if layer["biases_rounded"]:
            words.append(
                f"{layer['biases_rounded']} of {layer['biases']} biases rounded, by {layer['furthest_steps']:.3g} "
                "steps at most"
            )
        words += ["threshold rounded"] if layer["threshold_rounded"] else []
        words += [f"rescaled by {layer['rescaled_by']:g}"] if layer["rescaled_by"] != 1 else []
        told += [f"{layer['name']}: {', '.join(words)}"] if words else []
    return told


WRITERS: dict[str, Callable[[argparse.Namespace], Written]] = {
    "sanafe": _sanafe,
    "ranc": _ranc,
    "onnx": _onnx,
    "onnx-float": _onnx_float,
    "nir": _nir,
    "netx": _netx,
}
"""What writes each format."""


def _require_fit(arguments: argparse.Namespace) -> None:
    """Refuse options that the format would ignore."""
    for name, (absent, formats) in RECORDING.items():
        given = getattr(arguments, name)
        if given != absent and arguments.to not in formats:
            raise OptionError(f"--{name} {given}: is for {' and '.join(formats)}; leave it away")
        if given != absent and arguments.data is None:
            raise OptionError(f"--{name} {given}: says which recording of --data, which is not given; add it")
    for name, (absent, only) in OWN.items():
        if getattr(arguments, name) != absent and arguments.to != only:
            raise OptionError(f"--{name}: is for {only}, --to says {arguments.to}; leave it away")
    if arguments.form is not None and not arguments.to.startswith("onnx"):
        raise OptionError(f"--form {arguments.form}: is for onnx and onnx-float; leave it away")
    if arguments.to == "onnx-float":
        return
    for name, absent in MODEL.items():
        given = getattr(arguments, name)
        if given != absent:
            shown = f"--{name}" if given is True else f"--{name} {given}"
            raise OptionError(f"{shown}: is for checkpoints, --to {arguments.to} takes a netlist; leave it away")


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command: the report, how to print it, and the exit code."""
    _require_fit(arguments)
    require_place(arguments.output, "-o", arguments)
    written = WRITERS[arguments.to](arguments)
    digest, size = hashlib.sha256(), 0
    with write_atomically(arguments.output) as file:
        for chunk in written.chunks:
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
    for path, content in written.beside.items():
        with write_atomically(path) as file:
            file.write(content)
    report = {
        "path": arguments.output,
        "format": arguments.to,
        "bytes": size,
        "sha256": digest.hexdigest(),
        **written.facts,
    }
    return report, _text, 0


def _text(report: Json) -> str:
    held = f"{report['neurons']} neurons"
    if "synapses" in report:
        held += f" and {report['synapses']} synapses"
    first = f"{report['path']}: {held} for {report['format']}, {report['bytes']} bytes"
    if "sidecar" in report:
        return (
            f"{first}\nin steps of {report['dt']:g} s ({report['convention']}); all of the netlist: {report['sidecar']}"
        )
    if "layers" in report:
        return "\n".join([first, *_netx_lines(report)])
    if "ticks" in report:
        inputs = report["path"], report["path"].removesuffix(".json") + ".out"
        with_events = "no recording, add packets" if report["ticks"] is None else f"{report['ticks']} ticks"
        return f"{first}\nrun: ranc_sim {inputs[0]} {inputs[1]} {inputs[0]} TICKS ({with_events})"
    if "groups" in report:
        return (
            f"{first}\ngroups: {', '.join(report['groups'])}\n"
            f"cores (tile.core): {', '.join(report['cores'])}; of the inputs: {', '.join(report['input_cores'])}"
            + (
                f"\ncurrents of {', '.join(report['floating_currents'])} are floats there, so spikes may differ"
                if "floating_currents" in report
                else ""
            )
        )
    sides = [f"{side}:\n" + "\n".join(f"  {port}" for port in report[side]) for side in ("inputs", "outputs")]
    return "\n".join([f"{first}, form {report['form']}", *sides])


def _netx_lines(report: Json) -> list[str]:
    """What the format changed, and what that does."""
    lines = ["biases, thresholds and weights are the netlist's"] if report["exact"] else _rounding(report["layers"])
    if "recordings" not in report:
        return [*lines, *([] if report["exact"] else ["--data counts the spikes that this moves"])]
    moved = [f"{layer['name']} {layer['spikes_moved']:,} of {layer['spikes']:,}" for layer in report["layers"]]
    return [*lines, f"spikes that differ from the netlist's on {report['recordings']} recordings: {', '.join(moved)}"]
