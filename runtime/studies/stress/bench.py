"""What ``stress`` works on, from its options: netlist, float network, sensor and recordings."""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.compiler.version import __version__
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.sensors import read_layout, sensor_graph
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.studies.stress.damages import Pair
from spikeloom.runtime.studies.stress.perturbation import Sensor
from spikeloom.runtime.studies.stress.runs import Bench
from spikeloom.runtime.studies.stress.side_by_side import ready

Json = dict[str, Any]


def bench_of(arguments: argparse.Namespace) -> tuple[Bench, LoadedNetwork, str]:
    """Everything that is stressed, the float network, and a hash of the recordings."""
    netlist = read_netlist(arguments.netlist)
    asked = load_network(arguments.checkpoint, arguments, netlist)
    require_match(netlist, asked.model)
    data = load_recordings(arguments, netlist, labels_for="stress", joined=False)
    pair = Pair(netlist=netlist, network=asked.network)
    places, edges = _places(arguments, netlist.taxels), _edges(arguments, asked)
    digest = hashlib.sha256()
    for array in data.identity().values():
        digest.update(np.ascontiguousarray(array).tobytes())
    bench = Bench(
        pair=pair,
        ready=ready(pair),
        sensor=Sensor(
            distance=distances(netlist.taxels, places, edges), places=places, edges=edges, checkpoint=asked.checkpoint
        ),
        events=data.events,
        labels=data.labels,
        files=data.files,
        lengths=np.full(len(data), data.steps) if data.lengths is None else np.asarray(data.lengths),
    )
    return bench, asked, digest.hexdigest()


def _places(arguments: argparse.Namespace, taxels: int) -> FloatArray | None:
    """Positions of the taxels, where they are known."""
    if arguments.taxels is not None:
        return read_layout(arguments.taxels)[1]
    return NEUTOUCH if taxels == len(NEUTOUCH) and not arguments.edges else None


def _edges(arguments: argparse.Namespace, asked: LoadedNetwork) -> IntArray | None:
    """Edges of the taxel graph, where there is one."""
    checkpoint = asked.checkpoint
    if checkpoint is None or checkpoint.system not in GRAPH_SYSTEMS:
        return None
    if checkpoint.edges is not None:
        return checkpoint.edges
    graph, _ = sensor_graph(
        graph=arguments.graph, taxels=arguments.taxels, edges=arguments.edges, directed=arguments.directed
    )
    return graph.edges


def distances(taxels: int, places: FloatArray | None, edges: IntArray | None) -> FloatArray:
    """Distances between taxels: of their positions, else on their graph, else of their numbers; (taxels, taxels).

    Examples
    --------
    >>> distances(3, None, None)[0].tolist(), distances(3, None, np.array([[0, 2], [2, 1]]))[0].tolist()
    ([0.0, 1.0, 2.0], [0.0, 2.0, 1.0])
    """
    if places is None and edges is not None:
        from scipy.sparse import csgraph, csr_array

        graph = csr_array((np.ones(len(edges)), edges.T), shape=(taxels, taxels))
        hops: FloatArray = csgraph.shortest_path(graph, directed=False, unweighted=True)
        return hops
    where = np.arange(float(taxels))[:, None] if places is None else places
    found: FloatArray = np.linalg.norm(where[:, None] - where, axis=2)
    return found


def facts_of(arguments: argparse.Namespace, asked: LoadedNetwork, data: str) -> Json:
    """What the runs depend on beside perturbation, level and seed."""
    return {
        "spikeloom": __version__,
        "netlist_sha256": hashlib.sha256(Path(arguments.netlist).read_bytes()).hexdigest(),
        "checkpoint_sha256": asked.sha256,
        **asked.read_as,
        "graph": asked.graph,
        "data_sha256": data,
        "netlist": Path(arguments.netlist).name,
        "checkpoint": Path(arguments.checkpoint).name,
        "data": Path(arguments.data).name,
        "split": arguments.split,
    }
