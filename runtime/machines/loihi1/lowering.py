"""What is compiled for Loihi: networks of floats, which are rounded, and netx files, which bring their integers."""

from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler import Compilation, Options, __version__, compile_network, invariants, write_netlist
from spikeloom.compiler.formats import NETX
from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.compiler.interpret import channels_last, run_integer
from spikeloom.compiler.types import BoolArray, EventArray
from spikeloom.models.recordings.events import of_length
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.compilation import parse_cores, parse_keep, parse_packings, provenance
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import origin_of, recordings
from spikeloom.runtime.inputs.repeat import LAYOUT, NETWORK, ROUNDING, command, given, refuse, words
from spikeloom.runtime.machines.base import Lowered, Model
from spikeloom.runtime.machines.loihi1 import compiled, description
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import INLINE
from spikeloom.runtime.report.sections import Outcome, Section, Text


def lower(arguments: Namespace, after: Callable[[str, Any], object]) -> Lowered:
    """Read a network and lower it; OptionError, ModelError, DataError or CapacityError if that cannot be."""
    path = arguments.checkpoint
    if isinstance(path, str) and path.endswith(NETX):
        return _lower_integers(arguments)
    packings = parse_packings(arguments)
    keep = parse_keep(arguments)
    parse_cores(arguments.cores_for)
    _options(arguments, packings=packings, keep=keep).require_consistent(calibrated=arguments.calibrate is not None)
    loaded = load_network(path, arguments)
    forms = loaded.network.forms
    if forms is not None:
        refuse(arguments, ("keep",), f"{path} was fine-tuned for its own storage")
    seen = None if arguments.calibrate is None else _calibration(arguments, loaded)
    training = None if seen is None else of_length(seen, loaded.network.input.clocks.length).events
    progress("compiling")
    options = _options(
        arguments,
        packings=packings,
        keep=keep,
        forms=forms,
        training_events=training,
        provenance=provenance(arguments, loaded, calibrated=seen),
    )
    done = compile_network(loaded.model, options, after=after)
    helps = _finetune(arguments, checkpoint=loaded.checkpoint is not None)
    return Lowered(
        netlist=done.netlist,
        model=_model(done),
        write=lambda output: write_netlist(done.netlist, output),
        report=lambda sha256: compiled.outcome(done, sha256, loaded.facts, helps),
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


def _options(arguments: Namespace, **further: Any) -> Options:
    """Options of the passes that a request asks for."""
    return Options(
        spike_exact=arguments.spike_exact,
        keep_all=arguments.keep_all,
        prune_unused=arguments.prune_unused,
        share_lists=arguments.share_lists,
        cores_for=parse_cores(arguments.cores_for),
        chips=arguments.chips,
        free_running=arguments.free_running,
        **further,
    )


def _calibration(arguments: Namespace, loaded: LoadedNetwork) -> Recordings:
    """Training recordings that choose storage and scales."""
    progress("reading the recordings")
    return recordings(
        arguments.calibrate,
        "train",
        classes=loaded.network.classes,
        taxels=loaded.network.input.taxels,
        bin_s=arguments.bin,
        bins=loaded.network.input.bins,
        trained=origin_of(loaded.training),
    )


def _finetune(arguments: Namespace, *, checkpoint: bool) -> str:
    """What to type for training on the chip's integers."""
    read = words(given(arguments, (*NETWORK, *LAYOUT)))
    data = ("--data", str(arguments.calibrate), "--weight-bits", "8")
    return command("finetune", str(arguments.checkpoint), *read, *data, "-o", "TUNED.pt" if checkpoint else "TUNED.nir")


@dataclass(frozen=True, slots=True, kw_only=True)
class LaidOut:
    """A netlist of integers as they stood, and what was read from their file."""

    netlist: Any = field(metadata=INLINE)
    path: str
    facts: Sequence[str]


def _lower_integers(arguments: Namespace) -> Lowered:
    """Lay out a file that brings its integers: nothing is rounded."""
    path = arguments.checkpoint
    floats = ("dt", "convention", *ROUNDING, "dump_after", "calibrate")
    refuse(arguments, floats, f"is for float networks, {path} holds integers")
    refuse(arguments, NETWORK, f"is for checkpoints, the netx file {path} holds all it needs")
    progress("reading the network")
    read = read_netx(path, polarities=arguments.polarities, polarities_first=arguments.polarities_first)
    invariants.verify(read.network)
    progress("compiling")
    cores_for = parse_cores(arguments.cores_for)
    origin = {
        "spikeloom": __version__,
        "checkpoint_sha256": read.sha256,
        "format": "netx",
        "keep_all": arguments.keep_all,
        **({"cores_for": cores_for} if cores_for else {}),
        **({"chips": arguments.chips} if arguments.chips != 1 else {}),
    }
    options = Options(
        keep_all=arguments.keep_all,
        cores_for=cores_for,
        free_running=arguments.free_running,
        chips=arguments.chips,
        provenance=origin,
    )
    done = compile_network(read.network, options)
    netlist = done.netlist
    return Lowered(
        netlist=netlist,
        model=_model(done),
        write=lambda output: write_netlist(netlist, output),
        report=lambda sha256: _laid_out(arguments.output, sha256, read.facts),
    )


def _laid_out(path: str, sha256: str, facts: Sequence[str]) -> Outcome:
    """The netlist of a file, what was read, and the hash."""
    described = description.inspect(path)

    def sections(made: LaidOut) -> Iterator[Section]:
        yield Section("", [*map(Text, made.facts)])
        *first, last = described.sections(made.netlist)
        yield from first
        yield Section("", [*last.blocks, Text(f"sha256 {sha256}")])

    return Outcome(LaidOut(netlist=described.result, path=path, facts=facts), sections)
