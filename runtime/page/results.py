"""All that the page of a network shows, as its JSON has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.netlist import Netlist
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.inputs.network import LoadedNetwork, sensor_places
from spikeloom.runtime.machines.page_parts import BatchParts, Cores
from spikeloom.runtime.page.provenance import Provenance
from spikeloom.runtime.page.recording import Recording
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL, key
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.stress.results import Stress


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decisions:
    """Every recording's decisions; a matrix (classes, classes) of each side counts them, rows by label."""

    classes: int
    matrices: Mapping[str, IntArray]
    files: tuple[str, ...]
    labels: IntArray
    model: IntArray = field(metadata=key("float"))
    chip: IntArray


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Report:
    """All that the page shows."""

    verify: Verdict
    decisions: Decisions
    netlist: object
    cores: Cores
    taxels: Taxels
    recording: Recording
    costs: object
    provenance: Provenance
    stress: Stress | None = field(default=None, metadata=OPTIONAL)
    explained_cost: Any = field(default=None, metadata=OPTIONAL)
    output: str
    described: Outcome = field(metadata=HIDDEN)
    chip: BatchParts = field(metadata=HIDDEN)


def decisions(verdict: Verdict, classes: int) -> Decisions:
    """Confusion matrices of both sides, and every recording's decisions."""
    sides = {"float": verdict.float_predictions, "chip": verdict.chip_predictions}
    matrices = {side: np.zeros((classes, classes), np.int64) for side in sides}
    for side, decided in sides.items():
        np.add.at(matrices[side], (verdict.labels, decided), 1)
    return Decisions(
        classes=classes,
        matrices=matrices,
        files=verdict.files,
        labels=verdict.labels,
        model=verdict.float_predictions,
        chip=verdict.chip_predictions,
    )


def taxels(
    netlist: Netlist,
    loaded: LoadedNetwork,
    data: Recordings,
    mean_spikes: Mapping[str, FloatArray],
    sensor: str | None,
) -> Taxels:
    """Taxels, the graph over them where there is one, and what each sends and its neurons fire in a mean recording.

    `mean_spikes` are those of each neuron on the chip, by layer; `sensor` is what the user named by ``--taxels``.
    """
    places = sensor_places(sensor)
    known = len(places) == netlist.taxels and places.shape[1] > 1
    checkpoint = loaded.checkpoint
    layer, of_neurons = next(iter(mean_spikes.items()))
    edges: IntArray = np.zeros((0, 2), np.int64)
    spikes: FloatArray | None = None
    has_graph = checkpoint is not None and checkpoint.system in GRAPH_SYSTEMS
    if checkpoint is not None and loaded.adjacency is not None and has_graph:
        seen = loaded.adjacency.reshape(-1, netlist.taxels, netlist.taxels)[0]
        target, source = np.nonzero(seen)
        edges = np.stack([source, target], axis=1)[source != target]
        taxel = np.arange(len(of_neurons)) // checkpoint.hops.shape[1]  # those of clocks come after the last
        fired = np.bincount(taxel, of_neurons, netlist.taxels)
        spikes = fired[: netlist.taxels].astype(np.float64)
    return Taxels(
        sensor="NeuTouch" if sensor is None and known and np.array_equal(places, NEUTOUCH) else None,
        positions_mm=places[:, :2] if known else None,
        graph=loaded.graph if has_graph else None,
        edges=edges,
        events=data.events.sum(axis=(2, 3), dtype=np.int64).mean(axis=0),
        layer=layer,
        spikes=spikes,
    )
