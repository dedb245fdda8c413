"""The float network that a command is given: a checkpoint on its graph, or an ONNX or NIR file that holds all."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.archive import COUNTERS, FORMATS, TRAINED, is_netlist, stated
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import ModelError, OptionError, SpikeloomError
from spikeloom.compiler.formats import NETX, NIR, ONNX
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.text import text
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import Factored, expand
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TACTILESGNET, TITLES
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import FloatArray, IntArray, JsonObject
from spikeloom.models.graphs import CHOICES, NEUTOUCH, Graph
from spikeloom.models.sensors import read_layout, sensor_graph
from spikeloom.models.systems import NO_GRAPH, propagation_of
from spikeloom.runtime.inputs.files import is_recordings, shipped
from spikeloom.runtime.inputs.repeat import NETWORK, refuse
from spikeloom.runtime.report.console import progress, tell
from spikeloom.runtime.requests.choices import CheckpointChoice, NetworkChoice, SensorChoice

NETWORKS = {ONNX: "ONNX", NIR: "NIR", COUNTERS: "counting"}
"""Networks that a file holds whole, by its ending, or by what it says of itself."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoadedNetwork:
    """A float network and where it is from."""

    network: Network  # Float stage
    sha256: str  # Of the file
    checkpoint: Checkpoint | None = None  # Where it is from one
    # (taxels, taxels) or (filters, places, taxels) float64; what its first layer sees, likewise; see `expand.stack_of`
    adjacency: FloatArray | None = None
    graph: str | None = None  # Its name, likewise
    facts: tuple[str, ...] = ()  # What was read from an ONNX or NIR file and what was assumed
    format: str = "checkpoint"  # or ``onnx``, ``nir``, ``module``
    read_as: Mapping[str, Any] = field(default_factory=dict)  # Beyond what the file says: the time step of a NIR file
    training: Mapping[str, Any] | None = None  # How it was made, where the file says so

    def origin(self, run: int) -> JsonObject:
        """What a netlist remembers of the file; `run` is which of a released file's runs was asked for."""
        if self.checkpoint is None:
            return {"format": self.format, **self.read_as}
        return {"run": run, "weights": self.checkpoint.weights, "graph": self.graph}

    def differs_from(self, netlist: Any, run: int) -> str | None:
        """How it is not what a netlist was compiled from; `run` is which of a file's runs it is.

        ModelError if it is the same file on another graph: what differs then is not the chip's doing.
        """
        made = netlist.provenance
        if (sha256 := made.get("checkpoint_sha256", self.sha256)) != self.sha256:
            return (
                f"compiled from a checkpoint of sha256 {sha256[:12]}…, this one has {self.sha256[:12]}…; "
                "give the one that it was compiled from"
            )
        for name, value in self.origin(run).items():
            if made.get(name, value) != value:
                why = f"compiled for {name} {made[name]}, this is {value}; give --{name} {made[name]}"
                if name == "graph":
                    raise ModelError(f"the netlist was {why}")
                return why
        for name in ("beta", "theta") if self.checkpoint is not None else ():
            for layer, ours in zip(netlist.layers, self.network.populations, strict=False):
                found = getattr(ours, name)
                due = getattr(layer, name, found)
                if due != found:
                    return f"{layer.name} was compiled with {name} {due:g}, this has {found:g}; give --{name} {due:g}"
        return None

    def require_same(self, path: str, netlist: Netlist, run: int) -> None:
        """Refuse another network than the netlist at `path` is from, for the chip would be blamed: a ModelError."""
        if (difference := self.differs_from(netlist, run)) is not None:
            raise ModelError(f"{path}: {difference}")

    @property
    def model(self) -> Factored | Network:
        """What is compiled, and run in its own operator order: the checkpoint on its graph where there is one."""
        if self.checkpoint is None or self.adjacency is None:
            return self.network
        return Factored(self.checkpoint, self.adjacency)


def load_network(path: str | Network, request: NetworkChoice, netlist: Netlist | None = None) -> LoadedNetwork:
    """Read what a command is given; beside a `netlist` as that was, where the options say nothing.

    These are the epoch and the graph of a checkpoint that does not say which, the time step of a NIR file, and the
    names of the layers of a network.

    Raises OptionError or ModelError if it is not there, not as the options say, or an option is for the other kind of
    file.
    """
    if isinstance(path, Network):
        # a network that Python made, as if it came from a file
        sha256 = hashlib.sha256(text(path).encode()).hexdigest()
        return LoadedNetwork(network=path, sha256=sha256, format="module")
    kind = network_kind(path)
    _require_fit(path, kind, request)
    made = {} if netlist is None else netlist.provenance
    if kind is None:
        checkpoint = load_checkpoint(path, request)
        epoch = made.get("weights") if made.get("checkpoint_sha256") == checkpoint.sha256 else None
        if request.weights is None and epoch in checkpoint.sets and epoch != checkpoint.weights:
            checkpoint = load_checkpoint(path, replace(request, weights=epoch))
        graph, adjacency = propagation(checkpoint, _graph_of(checkpoint, request, made), path)
        return LoadedNetwork(
            network=expand(checkpoint, adjacency),
            sha256=checkpoint.sha256,
            checkpoint=checkpoint,
            adjacency=adjacency,
            graph=graph,
            training=checkpoint.training,
        )
    progress("reading the network")
    training = None
    layout: dict[str, Any] = {"polarities": request.polarities, "polarities_first": request.polarities_first}
    if kind == COUNTERS:
        from spikeloom.compiler.formats.counters import read_counters, read_network

        found, training = read_network(shipped(path)), read_counters(shipped(path))[0].training
    elif kind == ONNX:
        from spikeloom.compiler.formats.onnx.reader import read_onnx

        found = read_onnx(path, **layout)
    else:
        from spikeloom.compiler.formats.nir.reader import read_nir

        given = {name: getattr(request, name) for name in ("dt", "convention")}
        steps = {name: made.get(name) if value is None else value for name, value in given.items()}
        found = read_nir(path, **steps, **layout)
        training = found.training
    return LoadedNetwork(
        network=found.network if netlist is None else _named_alike(found.network, netlist),
        sha256=found.sha256,
        facts=found.facts,
        format=NETWORKS[kind].lower(),
        read_as=found.read_as,
        training=training,
    )


def _graph_of(checkpoint: Checkpoint, request: CheckpointChoice, made: Mapping[str, Any]) -> Graph | None:
    """Graph that the options name, or the one that a netlist was compiled for, if it is built in; None for neither."""
    asked = load_graph(request, checkpoint.system)
    if asked is not None or checkpoint.edges is not None or not isinstance(made.get("graph"), str):
        return asked
    try:
        return load_graph(replace(request, graph=made["graph"]), checkpoint.system)
    except SpikeloomError:
        return None  # one of the user's own


def _named_alike(network: Network, netlist: Any) -> Network:
    """The network with the names that layers have in a netlist, if these are as many and as large."""
    layers = [(layer.name, layer.neurons) for layer in netlist.layers if not isinstance(layer, str)]
    if [population.size for population in network.populations] != [neurons for _, neurons in layers]:
        return network
    pairs = zip(network.populations, layers, strict=True)
    return replace(network, populations=tuple(replace(population, name=name) for population, (name, _) in pairs))


def network_kind(path: str) -> str | None:
    """Which of ``NETWORKS`` a file holds; None for a checkpoint, or nothing of ours."""
    suffix = next((suffix for suffix in (ONNX, NIR) if path.endswith(suffix)), None)
    return suffix or (COUNTERS if stated(Path(shipped(path)), "format") == COUNTERS else None)


def _require_fit(path: str, kind: str | None, request: NetworkChoice) -> None:
    """Refuse options that are for another kind of file, and files that hold no float network."""
    if path.endswith(NETX):
        raise OptionError(f"{path}: holds integers, no float network to compare with; compile, inspect and run it")
    if kind not in (ONNX, NIR):
        why = f"is for ONNX and NIR files, {path} is none"
        refuse(request, ("polarities",), why)
        if request.polarities_first is not None:
            raise OptionError(f"--polarities-first or -last: {why}; omit it")
    if kind is not None:
        refuse(request, NETWORK, f"is for checkpoints, the {NETWORKS[kind]} file {path} holds all it needs")
    if kind != NIR:
        refuse(request, ("dt", "convention"), f"is for NIR files, {path} is none")


def load_graph(request: SensorChoice, system: str = TACTILESGNET) -> Graph | None:
    """Graph that the options name, or None if they name none; a warning goes to stderr.

    Raises OptionError or ModelError if there is no such graph, its files are wrong, or the system has no graph at all.
    """
    if system not in GRAPH_SYSTEMS:
        refuse(request, ("graph", "edges", "directed"), f"is for taxel graphs, {TITLES[system]} has none")
        return None
    if not (request.graph or request.taxels or request.edges or request.directed):
        return None
    graph, warning = sensor_graph(
        graph=request.graph, taxels=request.taxels, edges=request.edges, directed=request.directed
    )
    if warning is not None:
        tell(f"warning: {warning}")
    return graph


def sensor_places(taxels: str | None) -> FloatArray:
    """Positions of the taxels in millimetres: of ``--taxels``, where a number lines them up, or of the built-in sensor.

    Raises OptionError or DataError if there is no such sensor.
    """
    if taxels is None:
        return NEUTOUCH
    count, places = read_layout(taxels)
    return np.arange(float(count))[:, None] if places is None else places


def propagation(checkpoint: Checkpoint, asked: Graph | None, where: str) -> tuple[str, FloatArray]:
    """Name of the graph that was asked for, or of the one in the checkpoint, and what the first layer sees.

    Raises ModelError if no graph is known, or another one than the checkpoint was trained on is asked for.
    """

    def seen(edges: IntArray, taxels: int) -> FloatArray:
        return propagation_of(checkpoint.system, edges, taxels, checkpoint.grid, len(checkpoint.hops))

    if checkpoint.system not in GRAPH_SYSTEMS:
        return NO_GRAPH, seen(np.zeros((0, 2), np.int64), checkpoint.taxels)
    if asked is None:
        if checkpoint.edges is None:
            raise ModelError(f"{where}: the graph is not in this file; name it with --graph: {CHOICES}")
        return str(checkpoint.graph), seen(checkpoint.edges, checkpoint.taxels)
    found = seen(asked.edges, asked.n_taxels)
    if checkpoint.edges is not None and not np.array_equal(seen(checkpoint.edges, checkpoint.taxels), found):
        raise ModelError(
            f"{where}: graph and weights disagree: it was trained on {checkpoint.graph}, --graph says "
            f"{asked.name}; omit --graph"
        )
    return asked.name, found


def load_checkpoint(path: str, request: CheckpointChoice) -> Checkpoint:
    """Read a checkpoint as the options say; OptionError or ModelError if it is not there, or not as they say."""
    progress("reading the checkpoint")
    if (kind := stated(Path(shipped(path)), "format")) in (TRAINED, COUNTERS):
        raise ModelError(f"{path}: is {FORMATS[kind]}; only compile, verify and inspect take one")
    if Path(shipped(path)).is_file() and is_netlist(shipped(path)):
        raise ModelError(f"{path}: is a netlist, its weights are rounded; give the checkpoint that it was made from")
    if is_recordings(path):
        raise ModelError(f"{path}: holds recordings; give the network here, and these as --calibrate or --data")
    return read_checkpoint(
        shipped(path), run=request.run, weights=request.weights, beta=request.beta, theta=request.theta
    )
