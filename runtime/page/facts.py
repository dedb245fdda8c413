"""What the page shows beside a single recording: decisions and taxels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.netlist import Netlist
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.inputs.network import LoadedNetwork, sensor_places
from spikeloom.runtime.report.encode import key

Kind = TypeVar("Kind")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sides(Generic[Kind]):
    """What the float model has, and what the chip."""

    model: Kind = field(metadata=key("float"))
    chip: Kind


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decisions:
    """Every recording's decisions; matrices (classes, classes) count them, rows by label."""

    classes: int
    matrices: Sides[IntArray]
    files: tuple[str, ...]
    labels: IntArray
    model: IntArray = field(metadata=key("float"))
    chip: IntArray

    def confusions(self) -> list[tuple[int, int, int, int]]:
        """Label, wrong decision, and how often float model and chip take it; the most frequent first."""
        ours, chip = self.matrices.model, self.matrices.chip
        pairs = [
            (label, decided, int(ours[label, decided]), int(chip[label, decided]))
            for label, decided in np.argwhere(ours + chip).tolist()
            if label != decided
        ]
        return sorted(pairs, key=lambda pair: (-pair[2] - pair[3], pair[0], pair[1]))


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


def decisions(verdict: Verdict, classes: int) -> Decisions:
    """Confusion matrices of both sides, and every recording's decisions."""

    def matrix(decided: IntArray) -> IntArray:
        counts = np.zeros((classes, classes), np.int64)
        np.add.at(counts, (verdict.labels, decided), 1)
        return counts

    return Decisions(
        classes=classes,
        matrices=Sides(model=matrix(verdict.float_predictions), chip=matrix(verdict.chip_predictions)),
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
    events: IntArray = data.events.sum(axis=(2, 3), dtype=np.int64)
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
        events=events.mean(axis=0),
        layer=layer,
        spikes=spikes,
    )
