"""What the page shows beside a single recording: decisions, cores and their traffic, taxels."""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_of_core, chip_tiles
from spikeloom.compiler.targets.loihi1.layout.core_graph import core_map
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.inputs.network import LoadedNetwork, sensor_places
from spikeloom.runtime.machines.loihi1.trace import Counts
from spikeloom.runtime.page.results import Core, Cores, Decisions, Fill, Mesh, Sides, Taxels, Way

FILLS = ("core.compartments", "core.synapse_words", "core.axons_in", "core.axons_out")
"""Limits of which the fullest says how full a core is: those that a larger network uses up."""


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


def cores(netlist: Netlist, target: Target, counts: Counts) -> Cores:
    """Where the cores lie, how full each is of everything, and packets of the mean of the recordings in `counts`."""
    width, chip = target.limit("mesh.width"), chip_of_core(netlist.core_tile, target)
    fill: dict[int, dict[str, Fill]] = {core: {} for core in range(netlist.n_cores)}
    for use in measure(netlist, target):
        if use.core is not None and use.allowed:
            fill[use.core][use.name] = Fill(used=use.used, allowed=use.allowed, share=use.used / use.allowed)
    graph, placed = core_map(netlist, target), []
    for core, tile in enumerate(netlist.core_tile.tolist()):
        y, x = divmod(tile % chip_tiles(target), width)
        placed.append(
            Core(
                core=core,
                chip=int(chip[core]),
                tile=tile,
                x=x,
                y=y,
                layers=tuple(graph.nodes[core]["layers"]),
                compartments=graph.nodes[core]["compartments"],
                fullest=max(FILLS, key=lambda name: fill[core][name].share),
                fill=fill[core],
            )
        )
    packets = _packets(netlist, counts)
    traffic = [
        Way(
            source=None if pre == "input" else pre,
            to=post,
            packets=float(packets[-1 if pre == "input" else pre, post]),
            axons=edge["axons"],
            hops=edge["hops"],
        )
        for pre, post, edge in graph.edges(data=True)
    ]
    return Cores(
        mesh=Mesh(width=width, height=target.limit("mesh.height"), tile_cores=target.limit("mesh.tile_cores")),
        cores=tuple(placed),
        traffic=tuple(sorted(traffic, key=lambda way: (-1 if way.source is None else way.source, way.to))),
    )


def _packets(netlist: Netlist, counts: Counts) -> FloatArray:
    """Packets of a mean recording from each core, and in the last row from the input, to each core."""
    fired = np.concatenate([counts.inputs, counts.spikes], axis=1).mean(axis=0)
    home = np.append(np.full(netlist.n_inputs, netlist.n_cores), netlist.core_of_compartment())
    packets = np.zeros((netlist.n_cores + 1, netlist.n_cores))
    np.add.at(packets, (home[netlist.axon_source], netlist.core_of_axon()), fired[netlist.axon_source])
    return packets


def taxels(netlist: Netlist, loaded: LoadedNetwork, data: Recordings, counts: Counts, sensor: str | None) -> Taxels:
    """Taxels, the graph over them where there is one, and what each sends and its neurons fire in a mean recording.

    `counts` are of the chip on all recordings; `sensor` is what the user named by ``--taxels``.
    """
    places = sensor_places(sensor)
    known = len(places) == netlist.taxels and places.shape[1] > 1
    events: IntArray = data.events.sum(axis=(2, 3), dtype=np.int64)
    checkpoint = loaded.checkpoint
    edges: IntArray = np.zeros((0, 2), np.int64)
    spikes: FloatArray | None = None
    has_graph = checkpoint is not None and checkpoint.system in GRAPH_SYSTEMS
    if checkpoint is not None and loaded.adjacency is not None and has_graph:
        seen = loaded.adjacency.reshape(-1, netlist.taxels, netlist.taxels)[0]
        target, source = np.nonzero(seen)
        edges = np.stack([source, target], axis=1)[source != target]
        ids = netlist.compartments_of(0)
        taxel = netlist.neuron[ids] // checkpoint.hops.shape[1]  # those of clocks come after the last
        fired = np.bincount(taxel, counts.spikes[:, ids].mean(axis=0), netlist.taxels)
        spikes = fired[: netlist.taxels].astype(np.float64)
    return Taxels(
        sensor="NeuTouch" if sensor is None and known and np.array_equal(places, NEUTOUCH) else None,
        positions_mm=places[:, :2] if known else None,
        graph=loaded.graph if has_graph else None,
        edges=edges,
        events=events.mean(axis=0),
        layer=netlist.layers[0].name,
        spikes=spikes,
    )
