"""The float network that a command is given: a checkpoint on its graph, or an ONNX or NIR file that holds all."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from spikeloom.compiler.archive import COUNTERS, stated
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats import NETX, NIR, ONNX
from spikeloom.compiler.formats.assemble import ReadNetwork
from spikeloom.compiler.formats.hdf5 import is_hdf5
from spikeloom.compiler.formats.text import text
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import JsonObject
from spikeloom.runtime.inputs.checkpoint import graph_of, load_checkpoint, propagation
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.repeat import INPUT_LAYOUT, LAYOUT, NETWORK, refuse
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.requests.choices import NetworkChoice


def _option(name: str, value: object) -> str:
    """As it is typed."""
    if name == "polarities_first":
        return "--polarities-first" if value else "--polarities-last"
    return f"--{name} {value}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoadedNetwork:
    """A float network and where it is from."""

    network: Network  # Float stage
    sha256: str  # Of the file
    checkpoint: Checkpoint | None = None  # Where it is from one
    graph: str | None = None  # Its name, likewise
    facts: tuple[str, ...] = ()  # What was read from an ONNX or NIR file and what was assumed
    format: str = "checkpoint"  # or ``onnx``, ``nir``, ``module``
    read_as: Mapping[str, Any] = field(
        default_factory=dict
    )  # Beyond what the file says: the time step of a NIR file
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
                why = f"compiled for {name} {made[name]}, this is {value}; give {_option(name, made[name])}"
                if name == "graph":
                    raise ModelError(f"the netlist was {why}")
                return why
        for name in ("beta", "theta") if self.checkpoint is not None else ():
            for layer, ours in zip(netlist.layers, self.network.populations, strict=False):
                value_here = getattr(ours, name)
                due = getattr(layer, name, value_here)
                if due != value_here:
                    remedy = f"give --{name} {due:g}"
                    return (
                        f"{layer.name} was compiled with {name} {due:g}, this has {value_here:g}; {remedy}"
                    )
        return None

    def require_same(self, path: str, netlist: Netlist, run: int) -> None:
        """Refuse another network than the netlist at `path` is from, for the chip would be blamed: a ModelError."""
        if (difference := self.differs_from(netlist, run)) is not None:
            raise ModelError(f"{path}: {difference}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """A format that float networks are read from.

    name, title: what :attr:`LoadedNetwork.format` says, and what one of its files is, in a sentence. ending:
    how their names end; empty where the file itself says what it is, by the format `states` of its manifest.
    options: those of a request that it takes; others are refused. read: reads a file as a request says,
    beside the provenance of a netlist where there is one.
    """

    name: str
    title: str
    ending: str = ""
    states: str | None = None
    options: tuple[str, ...] = ()
    read: Callable[[str, NetworkChoice, Mapping[str, Any]], LoadedNetwork]

    def takes(self, path: str) -> bool:
        """Whether a file is of this format."""
        if self.ending:
            return path.endswith(self.ending)
        return self.states is None or stated(Path(shipped(path)), "format") == self.states


def _read_onnx(path: str, request: NetworkChoice, made: Mapping[str, Any]) -> LoadedNetwork:  # noqa: ARG001
    from spikeloom.compiler.formats.onnx.reader import read_onnx

    read = read_onnx(path, polarities=request.polarities, polarities_first=request.polarities_first)
    return _loaded("onnx", read)


def _read_nir(path: str, request: NetworkChoice, made: Mapping[str, Any]) -> LoadedNetwork:
    from spikeloom.compiler.formats.nir.reader import read_nir

    read = read_nir(
        path,
        dt=request.dt,
        convention=request.convention,
        polarities=request.polarities,
        polarities_first=request.polarities_first,
        usual=made,
    )
    return _loaded("nir", read)


def _read_counters(path: str, request: NetworkChoice, made: Mapping[str, Any]) -> LoadedNetwork:  # noqa: ARG001
    from spikeloom.compiler.formats.counters import read_network

    read = read_network(shipped(path))
    return _loaded("counting", read)


def _loaded(name: str, read: ReadNetwork[Network]) -> LoadedNetwork:
    """What was read from a file that holds the whole network."""
    return LoadedNetwork(
        network=read.network,
        sha256=read.sha256,
        facts=read.facts,
        format=name,
        read_as=read.read_as,
        training=read.training,
    )


def _read_checkpoint(path: str, request: NetworkChoice, made: Mapping[str, Any]) -> LoadedNetwork:
    """On the graph and of the epoch of a netlist, where the options say nothing."""
    checkpoint = load_checkpoint(path, request)
    epoch = made.get("weights") if made.get("checkpoint_sha256") == checkpoint.sha256 else None
    if request.weights is None and epoch in checkpoint.sets and epoch != checkpoint.weights:
        checkpoint = load_checkpoint(path, replace(request, weights=epoch))
    graph, adjacency = propagation(checkpoint, graph_of(checkpoint, request, made), path)
    return LoadedNetwork(
        network=expand(checkpoint, adjacency),
        sha256=checkpoint.sha256,
        checkpoint=checkpoint,
        graph=graph,
        training=checkpoint.training,
    )


COUNTING = Reader(name="counting", title="a counting network", states=COUNTERS, read=_read_counters)
CHECKPOINT = Reader(name="checkpoint", title="a checkpoint", options=NETWORK, read=_read_checkpoint)

READERS = (
    Reader(name="onnx", title="an ONNX file", ending=ONNX, options=INPUT_LAYOUT, read=_read_onnx),
    Reader(name="nir", title="a NIR file", ending=NIR, options=LAYOUT, read=_read_nir),
    COUNTING,
    CHECKPOINT,
)
"""All of them; the first that takes a file reads it, the last takes any.

A further layout of checkpoints is no row here but one of :data:`checkpoint_reader.LAYOUTS`, from which ``finetune``,
``join``, ``lean`` and ``chart`` read, too.
"""


def reader_of(path: str) -> Reader:
    """The format of a file."""
    return next(reader for reader in READERS if reader.takes(path))


def load_network(
    path: str | Network, request: NetworkChoice, netlist: Netlist | None = None
) -> LoadedNetwork:
    """Read what a command is given; beside a `netlist` as that was, where the options say nothing.

    These are the epoch and the graph of a checkpoint that does not say which, the time step of a NIR file,
    and the names of the layers of a network.

    Raises OptionError or ModelError if it is not there, not as the options say, or an option is for another
    format.
    """
    if isinstance(path, Network):
        # a network that Python made, as if it came from a file
        sha256 = hashlib.sha256(text(path).encode()).hexdigest()
        return LoadedNetwork(network=path, sha256=sha256, format="module")
    reader = reader_of(path)
    _require_fit(path, reader, request)
    if reader is not CHECKPOINT:
        progress("reading the network")
    loaded = reader.read(path, request, {} if netlist is None else netlist.provenance)
    if netlist is None or loaded.checkpoint is not None:
        return loaded
    return replace(loaded, network=_named_alike(loaded.network, netlist))


def _require_fit(path: str, reader: Reader, request: NetworkChoice) -> None:
    """Refuse options that are for another format, and files that hold no float network."""
    if path.endswith(NETX):
        raise OptionError(
            f"{path}: holds integers, no float network to compare with; compile it, then inspect and run the netlist"
        )
    if reader is CHECKPOINT and is_hdf5(path):
        raise ModelError(f"{path}: is an HDF5 file, as NIR files are; let its name end in {NIR}")
    for name in (*NETWORK, *LAYOUT):
        if name not in reader.options:
            titles = " or ".join(other.title for other in READERS if name in other.options)
            refuse(request, (name,), f"is for {titles}, {path} is none")


def _named_alike(network: Network, netlist: Any) -> Network:
    """The network with the names that layers have in a netlist, if these are as many and as large."""
    layers = [(layer.name, layer.neurons) for layer in netlist.layers if not isinstance(layer, str)]
    if [population.size for population in network.populations] != [neurons for _, neurons in layers]:
        return network
    pairs = zip(network.populations, layers, strict=True)
    return replace(
        network, populations=tuple(replace(population, name=name) for population, (name, _) in pairs)
    )
