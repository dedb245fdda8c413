"""What ``stress`` works on: netlist and float network, sensor and recordings, and inputs made of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.targets.compartments import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.conditions import by_condition
from spikeloom.models.recordings.events import fitted, join_bins
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.inputs.checkpoint import load_graph, places_of
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.capabilities import Threaded
from spikeloom.runtime.requests.check import StressRequest
from spikeloom.runtime.studies.robustness.pair import Events, Inputs, Pair
from spikeloom.runtime.studies.robustness.proofs.entries import channels_of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """What is stressed, and on what."""

    pair: Pair  # As compiled
    # Between taxels, (taxels, taxels) float64; in millimetres, or in steps on the graph where positions
    # are not known
    distance: FloatArray
    # (recordings, taxels, polarities, T) uint8; in the bins of the recordings, which are disturbed before
    # a network joins them
    events: Events
    labels: IntArray  # (recordings,) int64
    files: tuple[str, ...]
    lengths: IntArray  # (recordings,) int64; bins of each
    # Recordings (recordings,) of each condition
    conditions: Mapping[str, BoolArray] = field(default_factory=dict)


def in_steps(events: Events, lengths: IntArray, netlist: Netlist) -> tuple[Events, IntArray]:
    """Recordings in steps of a network, and how many steps of each count."""
    joined = join_bins(events, netlist.bins)
    steps = netlist.clocks.length
    if steps is None:
        return joined, -(-lengths // netlist.bins)
    return fitted(joined, steps), np.full_like(lengths, steps)


def whole(events: Events, netlist: Netlist, lengths: IntArray) -> Inputs:
    """Recordings from their first bin on."""

    def channels(rows: slice) -> Events:
        return channels_of(events[rows], netlist)

    steps = in_steps(events[:1], lengths, netlist)[1]
    return Inputs(channels=channels, lengths=steps, begin=np.zeros_like(lengths))


def by_length(events: Events, lengths: IntArray, change: Callable[[Events], Events]) -> Events:
    """Disturb recordings of equal length together, none beyond its own."""
    if (lengths == events.shape[-1]).all():
        return change(events)
    changed = np.zeros_like(events)
    for length in np.unique(lengths).tolist():
        those = np.flatnonzero(lengths == length)
        changed[those, ..., :length] = change(events[those, ..., :length])
    return changed


def last_of(order: IntArray, lengths: IntArray, channels: Callable[[slice], Events]) -> Inputs:
    """Recordings in a row, (rows, recordings), of which the last one counts."""
    length = lengths[order].sum(axis=1)
    return Inputs(channels=channels, lengths=length, begin=length - lengths)


def in_a_row(events: Events, lengths: IntArray, order: IntArray) -> Events:
    """Recordings one after another, silence at the end."""
    longest = int(lengths[order].sum(axis=1).max())
    rows = np.zeros((len(order), *events.shape[1:-1], longest), np.uint8)
    for row, parts in zip(rows, order.tolist(), strict=True):
        joined = np.concatenate([events[part, ..., : lengths[part]] for part in parts], axis=-1)
        row[..., : joined.shape[-1]] = joined
    return rows


def bench_of(request: StressRequest) -> tuple[Bench, LoadedNetwork, str]:
    """Everything that is stressed, the float network, and a hash of the recordings."""
    netlist = Threaded.required(machine_for(request.netlist), request.netlist, "stress").netlist
    loaded = load_network(request.checkpoint, request, netlist)
    require_match(netlist, loaded.network)
    loaded.require_same(request.netlist, netlist, request.run)
    data = load_recordings(request.data, request, netlist, labels_for="stress", joined=False)
    bench = Bench(
        pair=Pair(netlist=netlist, network=loaded.network),
        distance=_distances(request, loaded.checkpoint, netlist),
        events=data.events,
        labels=data.labels,
        files=data.files,
        lengths=data.step_counts,
        conditions=by_condition(data),
    )
    return bench, loaded, data.sha256


def _distances(request: StressRequest, checkpoint: Checkpoint | None, netlist: Netlist) -> FloatArray:
    """Distances between taxels, as far as anything is known of their places."""
    taxels = netlist.taxels
    places = places_of(request.taxels, netlist.provenance, taxels)
    if request.taxels is not None or (places is not None and not request.edges):
        return distances(taxels, places, None)
    graph = None if checkpoint is None else checkpoint.edges
    if graph is None and checkpoint is not None:
        given = load_graph(request, checkpoint.system)
        graph = None if given is None else given.edges
    return distances(taxels, None, graph)


def distances(taxels: int, places: FloatArray | None, edges: IntArray | None) -> FloatArray:
    """Distances between taxels by their positions, else on their graph, else by their numbers, (taxels, taxels).

    >>> distances(3, None, None)[0].tolist(), distances(3, None, np.array([[0, 2], [2, 1]]))[0].tolist()
    ([0.0, 1.0, 2.0], [0.0, 2.0, 1.0])
    """
    if places is None and edges is not None:
        from scipy.sparse import csgraph, csr_array

        graph = csr_array((np.ones(len(edges)), edges.T), shape=(taxels, taxels))
        return np.asarray(csgraph.shortest_path(graph, directed=False, unweighted=True))
    where = np.arange(float(taxels))[:, None] if places is None else places
    return np.asarray(np.linalg.norm(where[:, None] - where, axis=2))
