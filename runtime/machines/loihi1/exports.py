"""Netlists in the formats of other programs."""

import json
from dataclasses import dataclass, field

from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.files import reading
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.formats.nir import CONVENTIONS
from spikeloom.compiler.formats.nir import writer as nir
from spikeloom.compiler.formats.onnx import writer as onnx
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import Netlist, read_netlist
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.models.recordings.evtouch import BIN_S
from spikeloom.runtime.machines.exports import Export, Facts, Format
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.requests.exchange import ExportRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class SanafeFacts(Facts):
    """What a file for SANA-FE holds: groups of neurons, and the cores (``tile.core``) of layers and inputs."""

    groups: tuple[str, ...]
    cores: tuple[str, ...]
    input_cores: tuple[str, ...]
    floating_currents: tuple[str, ...] | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxFacts(Facts):
    """What an ONNX file of a netlist holds, and what it takes and gives, as words."""

    form: str
    inputs: list[str]
    outputs: list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class NirFacts(Facts):
    """What a NIR file holds, and how its time constants count: seconds of a step, and the convention."""

    dt: float
    convention: str


def _legal(path: str) -> Netlist:
    """A netlist that the chip holds, without the simulator; FormatError or CapacityError."""
    netlist = read_netlist(path)
    require_legal(netlist, load_target(netlist.target))
    return netlist


def _sanafe(request: ExportRequest) -> Export:
    netlist = _legal(request.source)
    target = load_target(netlist.target)
    places = sanafe.cores(netlist, target)
    facts = SanafeFacts(
        neurons=netlist.n_compartments,
        synapses=netlist.n_synapses,
        groups=(sanafe.INPUT, *sanafe.group_names(netlist)),
        cores=places[: netlist.n_cores],
        input_cores=places[netlist.n_cores :],
        floating_currents=sanafe.floating_layers(netlist) or None,
    )
    lines = [
        f"groups: {', '.join(facts.groups)}",
        f"cores (tile.core, tiles counted by columns, not rows): {', '.join(facts.cores)}; "
        f"of the inputs: {', '.join(facts.input_cores)}",
    ]
    if facts.floating_currents:
        lines.append(
            f"currents of {', '.join(facts.floating_currents)} are floats there, so spikes may differ"
        )
    content = (f"{line}\n".encode() for line in sanafe.export(netlist, target))
    return Export(content=content, facts=facts, lines=tuple(lines))


def _onnx(request: ExportRequest) -> Export:
    netlist = _legal(request.source)
    form = request.form or "scan"
    content, *ports = onnx.export(netlist, form)
    inputs, outputs = ([str(port) for port in side] for side in ports)
    facts = OnnxFacts(
        neurons=netlist.n_compartments,
        synapses=netlist.n_synapses,
        form=form,
        inputs=inputs,
        outputs=outputs,
    )
    lines = ("inputs:", *(f"  {port}" for port in inputs), "outputs:", *(f"  {port}" for port in outputs))
    return Export(content=[content], facts=facts, form=form, lines=lines)


def _nir(request: ExportRequest) -> Export:
    netlist = _legal(request.source)
    origin = origin_of(netlist.provenance)
    dt = request.dt
    if dt is None:
        read_in = netlist.provenance.get("dt", BIN_S * netlist.bins)
        dt = origin["bin_s"] * netlist.bins if "bin_s" in origin else read_in
    facts = NirFacts(
        neurons=sum(layer.neurons for layer in netlist.layers),
        synapses=netlist.n_synapses,
        dt=dt,
        convention=CONVENTIONS[0],
    )
    lines = (f"in steps of {dt:g} s ({facts.convention})",)
    with reading(request.source, FormatError, "compile it again"):
        content = nir.export(lift(netlist), dt, training=json.dumps(origin) if origin else None)
    return Export(content=[content], facts=facts, lines=lines)


FORMATS = (
    Format(
        name="sanafe",
        title=f"network and mapping of a netlist for SANA-FE {sanafe.VERSION}, YAML",
        write=_sanafe,
        ending="yaml",
    ),
    Format(
        name="onnx",
        title="a netlist as an integer ONNX graph, bit for bit the chip",
        write=_onnx,
        options=("form",),
    ),
    Format(
        name="nir", title="a netlist as a NIR file in weight units", write=_nir, options=("dt",), whole=True
    ),
)
