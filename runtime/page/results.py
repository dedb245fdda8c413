"""All that the page of a network shows, as its JSON has it, and where that is from."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import FloatArray, IntArray, JsonObject
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import places_of
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.base import Machine, Price
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.machines.core_map import CoreMap
from spikeloom.runtime.page.recording import Recording
from spikeloom.runtime.report.encode import HIDDEN, INLINE, OPTIONAL, key
from spikeloom.runtime.report.sections import Block, Outcome
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.main_job import ReportRequest
from spikeloom.runtime.studies.robustness.results import Stress

PACKAGES = ("numpy", "scipy", "torch", "numba", "networkx")
"""Packages whose versions may move a float spike."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decisions:
    """Every recording's decisions."""

    classes: int
    files: tuple[str, ...]
    labels: IntArray
    model: IntArray = field(metadata=key("float"))
    chip: IntArray

    json_properties = ("matrices",)

    @property
    def matrices(self) -> Mapping[str, IntArray]:
        """Of each side how often a label (rows) is decided as a class, (classes, classes)."""
        counts = {side: np.zeros((self.classes, self.classes), np.int64) for side in ("float", "chip")}
        np.add.at(counts["float"], (self.labels, self.model), 1)
        np.add.at(counts["chip"], (self.labels, self.chip), 1)
        return counts


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Taxels:
    """The sensor, its graph where there is one, and events and first-layer spikes of each taxel, on the mean."""

    sensor: str | None
    positions_mm: FloatArray | None
    graph: str | None
    edges: IntArray
    events: FloatArray
    layer: str
    spikes: FloatArray | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """A file, or recordings with a hash over their events and labels, and what is known of it."""

    file: str
    sha256: str
    facts: Mapping[str, Any] = field(metadata=INLINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """Files and their hashes, titles of the chip's tables, versions, and what to type to get it again."""

    netlist: Origin
    checkpoint: Origin
    data: Origin
    tables: Mapping[str, str]
    versions: Mapping[str, str]
    commands: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Report(Shown):
    """All that the page shows."""

    verify: Verdict
    decisions: Decisions
    netlist: object
    cores: CoreMap | None
    taxels: Taxels
    recording: Recording | None
    costs: object
    provenance: Provenance
    stress: Stress | None = field(default=None, metadata=OPTIONAL)
    output: str
    described: Outcome = field(metadata=HIDDEN)
    price: Price = field(metadata=HIDDEN)
    figures: Sequence[Block] = field(metadata=HIDDEN)


def taxels(
    machine: Machine, loaded: LoadedNetwork, data: Recordings, counts: IntArray, sensor: str | None
) -> Taxels:
    """Taxels, the graph over them where there is one, and what each sends and its neurons fire in a mean recording.

    `counts` are those of the chip's :class:`Run`; `sensor` is what the user named by ``--taxels``.
    """
    netlist = machine.netlist
    places = places_of(sensor, netlist.provenance, netlist.taxels)
    checkpoint = loaded.checkpoint
    edges: IntArray = np.zeros((0, 2), np.int64)
    spikes: FloatArray | None = None
    has_graph = checkpoint is not None and checkpoint.system in GRAPH_SYSTEMS
    convolution = loaded.network.convolution
    if convolution is not None and has_graph and isinstance(machine, Comparable):
        seen = convolution.propagation.reshape(-1, netlist.taxels, netlist.taxels)[0]
        target, source = np.nonzero(seen)
        edges = np.stack([source, target], axis=1)[source != target]
        ids = netlist.compartments_of(0)
        taxel = netlist.neuron[ids] // convolution.filters.shape[1]  # those of clocks come after the last
        fired = np.bincount(taxel, counts.mean(axis=0)[ids], netlist.taxels)
        spikes = fired[: netlist.taxels].astype(np.float64)
    return Taxels(
        sensor="NeuTouch" if places is NEUTOUCH else None,
        positions_mm=None if places is None else places[:, :2],
        graph=loaded.graph if has_graph else None,
        edges=edges,
        events=data.events.sum(axis=(2, 3), dtype=np.int64).mean(axis=0),
        layer=machine.layers[0],
        spikes=spikes,
    )


def provenance(
    request: ReportRequest,
    netlist: Netlist,
    target: Target,
    loaded: LoadedNetwork,
    data: Recordings,
    recording: str,
) -> Provenance:
    """Where everything is from; `data` are in their own bins, `recording` is the one that is drawn.

    File names are those of the files, without their folders; the page is always called ``report.html``.
    """
    checkpoint = loaded.checkpoint
    file = Path(request.checkpoint).name if isinstance(request.checkpoint, str) else loaded.format
    facts: JsonObject = dict.fromkeys(("system", "weights", "dynamics", "training"))
    if checkpoint is not None:
        facts |= {
            "system": checkpoint.system,
            "weights": checkpoint.weights,
            "training": checkpoint.training,
        }
        facts |= {"dynamics": None if checkpoint.dynamics.is_plain else checkpoint.dynamics.to_json()}
    facts |= {"graph": loaded.graph, "bins": netlist.bins}
    recorded = {"split": data.split, "samples": len(data), "bin_s": data.seconds}
    return Provenance(
        netlist=Origin(
            file=Path(request.netlist).name,
            sha256=sha256_of(request.netlist),
            facts={"compiled": dict(netlist.provenance)},
        ),
        checkpoint=Origin(file=file, sha256=loaded.sha256, facts=facts),
        data=Origin(file=Path(data.source).name, sha256=data.sha256, facts=recorded),
        tables={f"energy, {table.name}": table.title for table in target.energy}
        | {f"time, {table.name}": table.title for table in target.time},
        versions={"spikeloom": __version__, "python": platform.python_version()}
        | {name: metadata.version(name) for name in PACKAGES},
        commands=_commands(request, recording, data),
    )


def _commands(request: ReportRequest, recording: str, used: Recordings) -> dict[str, str]:
    """What to type, and what each is for; how the netlist was compiled is among its facts."""

    def name(given: Any) -> str:
        path = (
            "" if given is None else str(getattr(given, "source", given))
        )  # recordings that Python handed over
        return Path(path).name or path

    net = name(request.netlist)
    checkpoint = name(request.checkpoint)
    data = SYNTHETIC if used.source.startswith(SYNTHETIC) else name(request.data)
    options = repeat.given(request, repeat.NETWORK)
    options |= {option: name(options[option]) or None for option in ("taxels", "edges")}
    model = repeat.words(options | {"polarities": request.polarities})
    if request.polarities_first is not None:
        model.append("--polarities-first" if request.polarities_first else "--polarities-last")
    split = None if used.split == "test" else used.split
    read = ["--data", data, *repeat.words({"split": split, "limit": request.limit, "bin": used.bin_s})]
    spec = repeat.words({"spec_samples": None if request.spec_samples == 3 else request.spec_samples})
    both = [net, "--checkpoint", checkpoint, *model, *read]
    lines = {
        "verdict and ladder": ["verify", *both, *spec],
        "energy and time": ["estimate", net, *read],
        "why this recording differs": ["explain", *both, "--sample", recording],
        "this page": ["report", *both, *spec, "--recording", recording, "-o", "report.html"],
    }
    return {what: repeat.command(*words) for what, words in lines.items()}
