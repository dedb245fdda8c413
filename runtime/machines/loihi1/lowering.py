"""What is compiled for Loihi: networks of floats, which are rounded, and netx files, which bring their integers."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.formats import NETX
from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.ir import Network
from spikeloom.compiler.storage import Fixed, Storage
from spikeloom.compiler.targets.loihi1 import integers
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.netlist import write_netlist
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import Compilation, compile_network
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import BoolArray, EventArray
from spikeloom.models.recordings.counts import number
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.compilation import parse_cores, provenance, storage_of
from spikeloom.runtime.inputs.network import COUNTING, LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings, step_of
from spikeloom.runtime.inputs.repeat import LAYOUT, NETWORK, ROUNDING, command, refuse, typed
from spikeloom.runtime.machines.backend import Lowered
from spikeloom.runtime.machines.base import Model
from spikeloom.runtime.machines.loihi1 import compiled, description
from spikeloom.runtime.machines.loihi1.description import NetlistFacts
from spikeloom.runtime.report.console import progress, tell
from spikeloom.runtime.report.encode import HIDDEN, INLINE
from spikeloom.runtime.report.sections import Outcome, Section, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.main_job import CompileRequest


def lower(request: CompileRequest, after: Callable[[str, Any], object]) -> Lowered:
    """Read a network and lower it; OptionError, ModelError, DataError or CapacityError if that cannot be."""
    path = request.checkpoint
    if isinstance(path, str) and path.endswith(NETX):
        return _lower_integers(path, request)
    if request.calibrate is None:
        refuse(request, ("share_lists", "bin"), "is about recordings, give --calibrate too")
    said = _options(request, storage_of(request))
    said.require_consistent(calibrated=request.calibrate is not None)
    loaded = load_network(path, request)
    forms = loaded.network.forms
    if forms is not None:
        refuse(request, ("keep", "share_lists"), f"{path} was fine-tuned for its own storage")
    seen = None if request.calibrate is None else _calibration(request.calibrate, request.bin, loaded)
    training = None if seen is None else _in_steps(seen, loaded.network)
    progress("compiling")
    options = replace(
        said,
        storage=storage_of(request, forms),
        training_events=training,
        provenance=provenance(request, loaded, calibrated=seen),
    )
    done = compile_network(loaded.network, options, after=after)
    _warn_of_lost(done, loaded, str(path))
    helps = _finetune(request, checkpoint=loaded.checkpoint is not None)
    return Lowered(
        netlist=done.netlist,
        model=_model(done),
        write=lambda output: write_netlist(done.netlist, output),
        report=lambda sha256: compiled.outcome(done, sha256, loaded.facts, helps),
    )


def _warn_of_lost(done: Compilation, loaded: LoadedNetwork, path: str) -> None:
    """Say on stderr that whole weights of a counting network, which decide exactly, round to zero."""
    zeroed = sum(choice.zeroed for choice in done.choices)
    if zeroed and loaded.format == COUNTING.name:
        tell(
            f"warning: {path}: {number(zeroed, 'weight')} of counters and sums round to zero, so it may decide "
            "otherwise; compile it without --weight-bits, or train with it"
        )


def _model(done: Compilation) -> Model:
    """The integers before they are placed."""
    network = done.integer
    names = [population.name for population in network.populations]
    first = {layer.name: layer.depth for layer in done.netlist.layers}

    def spikes(events: EventArray) -> Mapping[str, BoolArray]:
        layers = run_integer(network, channels_last(events, network.input.clocks)).spikes
        return dict(zip(names, layers, strict=True))

    return Model(first=first, spikes=spikes)


def _options(request: CompileRequest, storage: Storage) -> Options:
    """Options of the passes that a request asks for."""
    return Options(
        storage=storage,
        keep_all=request.keep_all,
        prune_unused=request.prune_unused,
        share_lists=request.share_lists,
        cores_for=parse_cores(request.cores_for),
        chips=request.chips,
        free_running=request.free_running,
    )


def _calibration(source: str | Recordings, bin_s: float | None, loaded: LoadedNetwork) -> Recordings:
    """Training recordings that choose storage and scales, in their own bins."""
    progress("reading the recordings")
    return recordings(
        source,
        "train",
        classes=loaded.network.classes,
        taxels=loaded.network.input.taxels,
        bin_s=bin_s,
        trained=origin_of(loaded.training) | step_of(loaded.read_as, loaded.network.input.bins),
    )


def _in_steps(data: Recordings, network: Network) -> EventArray:
    """Their events in steps of a network."""
    return of_length(joined_bins(data, network.input.bins), network.input.clocks.length).events


def _finetune(request: CompileRequest, *, checkpoint: bool) -> str:
    """What to type for training on the chip's integers."""
    read = typed(request, (*NETWORK, *LAYOUT))
    data = ("--data", str(request.calibrate), "--weight-bits", "8")
    return command(
        "finetune", str(request.checkpoint), *read, *data, "-o", "TUNED.pt" if checkpoint else "TUNED.nir"
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LaidOut(Shown):
    """A netlist of integers as they stood, and what was read from their file."""

    netlist: NetlistFacts = field(metadata=INLINE)
    path: str
    facts: Sequence[str]
    sha256: str = field(metadata=HIDDEN)


def _lower_integers(path: str, request: CompileRequest) -> Lowered:
    """Lay out a file that brings its integers: nothing is rounded."""
    floats = ("dt", "convention", *ROUNDING, "dump_after", "calibrate", "bin")
    refuse(request, floats, f"is for float networks, {path} holds integers")
    refuse(request, NETWORK, f"is for checkpoints, the netx file {path} holds all it needs")
    progress("reading the network")
    read = read_netx(path, polarities=request.polarities, polarities_first=request.polarities_first)
    integers.verify(read.network)
    progress("compiling")
    cores_for = parse_cores(request.cores_for)
    origin = {
        "spikeloom": __version__,
        "checkpoint_sha256": read.sha256,
        "format": "netx",
        "keep_all": request.keep_all,
        **({"cores_for": cores_for} if cores_for else {}),
        **({"chips": request.chips} if request.chips != 1 else {}),
    }
    done = compile_network(read.network, replace(_options(request, Fixed()), provenance=origin))
    return Lowered(
        netlist=done.netlist,
        model=_model(done),
        write=lambda output: write_netlist(done.netlist, output),
        report=lambda sha256: _laid_out(request.output, sha256, read.facts),
    )


def _laid_out(path: str, sha256: str, facts: Sequence[str]) -> Outcome:
    """The netlist of a file, what was read, and the hash."""
    described: NetlistFacts = description.inspect(path).result
    return Outcome(LaidOut(netlist=described, path=path, facts=facts, sha256=sha256), sections)


def sections(made: LaidOut) -> Iterator[Section]:
    """The same for people."""
    yield Section("", [*map(Text, made.facts)])
    *first, last = description.sections(made.netlist)
    yield from first
    yield Section("", [*last.blocks, Text(f"sha256 {made.sha256}")])
