"""What is compiled for TrueNorth: networks that were trained for it, and counting ones."""

from collections.abc import Callable, Mapping
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats import NETX
from spikeloom.compiler.formats.counters import read_counters
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.targets.truenorth.native_file import Trained, is_trained, read_trained
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, write_crossbars
from spikeloom.compiler.targets.truenorth.passes import Options, Source, compile_crossbars
from spikeloom.compiler.types import JsonObject
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.network import COUNTING, load_network
from spikeloom.runtime.inputs.repeat import NETWORK, PLACING, ROUNDING, refuse
from spikeloom.runtime.machines.backend import Lowered, Reference
from spikeloom.runtime.machines.truenorth.description import describe
from spikeloom.runtime.machines.truenorth.model import model_of
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.requests.choices import CheckpointChoice, ComparisonChoice
from spikeloom.runtime.requests.main_job import CompileRequest

TITLE = "TrueNorth"


def read(path: str, request: CheckpointChoice) -> Trained:
    """Read a trained network as the options say; OptionError or ModelError if it is not as they say."""
    others = [name for name in NETWORK if name != "weights"]
    refuse(request, others, f"{path} is a network for {TITLE} and says that itself")
    return read_trained(shipped(path), weights=request.weights)


def lower(request: CompileRequest, after: Callable[[str, Any], object]) -> Lowered:
    """Place a network on cores; OptionError, ModelError or CapacityError if that cannot be."""
    path = request.checkpoint
    if isinstance(path, str) and path.endswith(NETX):
        raise OptionError(f"--target {request.target}: {path} holds integers of another chip; omit it")
    refuse(request, ("calibrate", "bin", *ROUNDING, *PLACING), "is not for truenorth")
    source: Source | Network
    if isinstance(path, str) and is_trained(shipped(path)):
        trained = read(path, request)
        source = trained.network
        provenance = provenance_of(trained)
    else:
        loaded = load_network(path, request)
        source = read_counters(shipped(str(path)))[0] if loaded.format == COUNTING.name else loaded.network
        provenance = {"spikeloom": __version__, "checkpoint_sha256": loaded.sha256}
        provenance |= loaded.origin(request.run) | origin_of(loaded.training)
    progress("compiling")
    try:
        done = compile_crossbars(source, Options(provenance=provenance), after=after)
    except ModelError as error:
        raise ModelError(f"{path if isinstance(path, str) else 'module'}: {error}") from error
    netlist = done.netlist
    return Lowered(
        netlist=netlist,
        model=model_of(done.source, done.target),
        write=lambda output: write_crossbars(netlist, output),
        report=lambda sha256: describe(netlist, sha256),
    )


def provenance_of(trained: Trained) -> JsonObject:
    """What a netlist remembers of the trained network that it is from."""
    return {
        "spikeloom": __version__,
        "checkpoint_sha256": trained.sha256,
        "weights": trained.weights,
        "graph": trained.graph,
        "copies": trained.network.copies,
        "towers": 1,
        **origin_of(trained.training),
    }


def reference(request: ComparisonChoice, netlist: CrossbarNetlist) -> Reference:
    """The network that a netlist was compiled from; OptionError if the file is another one."""
    path = request.checkpoint
    made = netlist.provenance
    if made.get("format") == COUNTING.name:
        loaded = load_network(path, request)
        _require_file(request, made, loaded.sha256)
        counters = read_counters(shipped(str(path)))[0]
        return Reference(network=counters, loaded=loaded, whole=True)
    trained = read(str(path), request)
    _require_file(request, made, trained.sha256)
    if made.get("weights") != trained.weights:
        compiled = f"{request.netlist} was compiled from {made.get('weights')}"
        raise OptionError(f"--weights {trained.weights}: {compiled}; give the same")
    return Reference(network=trained.network, loaded=None, whole=True)


def _require_file(request: ComparisonChoice, made: Mapping[str, Any], sha256: str) -> None:
    """Refuse another file than a netlist was compiled from."""
    if made.get("checkpoint_sha256") != sha256:
        path = f"--checkpoint {request.checkpoint}"
        raise OptionError(f"{path}: {request.netlist} was compiled from another file; give that one")
