"""How chip, specification and model of a TrueNorth netlist are compared."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from operator import add

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.counters import read_counters
from spikeloom.compiler.interpret import channels_last, float_simulation, vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.truenorth.codebook import PartialSums, in_levels, run_levels
from spikeloom.compiler.targets.truenorth.counting import planned, run_counters
from spikeloom.compiler.targets.truenorth.in_time import first_spikes
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, unlike
from spikeloom.compiler.targets.truenorth.passes import Options, Source, compile_crossbars
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.machines.truenorth.lowering import COUNTING, TITLE, read
from spikeloom.runtime.machines.truenorth.machine import TrueNorth, load
from spikeloom.runtime.machines.votes import class_counts, readout_counts
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.report.encode import OPTIONAL, key
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text

VERIFY = ("original", "min_agreement", "require", "engine")
"""Options of ``verify`` where chip and model may differ."""

SPEC_STEPS = 5
"""Data steps of a recording on which the specification runs, too: it takes a second for two hundred ticks."""


Modelled = tuple[Mapping[str, BoolArray], tuple[PartialSums, ...]]
Model = Callable[[EventArray], Modelled]
"""Spikes (steps, neurons) of each layer for events (taxels, polarities, steps); partial sums that travel in time."""


@dataclass(frozen=True, slots=True)
class AgainstNetlist:
    """What in the netlist is not as lowering the network of the file again gives it."""

    faults: tuple[str, ...]
    json_properties = ("holds",)

    @property
    def holds(self) -> bool:
        """Whether all is."""
        return not self.faults

    @property
    def text(self) -> str:
        """One line for people."""
        if self.faults:
            return f"EN NOT what the network of the file is lowered to: {'; '.join(self.faults)}"
        return "EN every neuron, axon, crossing point, wire and register is what the network of the file is lowered to"


@dataclass(frozen=True, slots=True)
class AgainstSpec:
    """Recordings on which both ran; spikes, membranes and counts that differ."""

    samples: int
    differences: int


@dataclass(frozen=True, slots=True)
class LayerSpikes:
    """Spikes of the model, and those of neurons on the chip, copies included, that differ."""

    name: str
    spikes: int
    differences: int


@dataclass(frozen=True, slots=True)
class AgainstModel:
    """Spikes that differ, by layer."""

    layers: tuple[LayerSpikes, ...]
    json_properties = ("differences",)

    @property
    def differences(self) -> int:
        """Of all layers."""
        return sum(layer.differences for layer in self.layers)


@dataclass(frozen=True, slots=True)
class AgainstNetwork:
    """Decisions that are those of the network of the file, as other chips have it, and votes that differ."""

    decisions_equal: int
    votes_different: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Netlist against network (EN); chip against definition (E0), model (E1) and, if it counts, that network (E3).

    `spec_steps` confines the first to the first data steps of each recording.
    """

    target: str
    samples: int
    netlist: AgainstNetlist = field(metadata=key("EN"))
    spec: AgainstSpec = field(metadata=key("E0"))
    model: AgainstModel = field(metadata=key("E1"))
    membranes_saturated: int
    correct: int
    spec_steps: int | None = field(default=None, metadata=OPTIONAL)
    sums: tuple[PartialSums, ...] | None = field(default=None, metadata=OPTIONAL)
    network: AgainstNetwork | None = field(default=None, metadata={**OPTIONAL, **key("E3")})
    json_properties = ("exact",)

    @property
    def different(self) -> int:
        """Spikes that are not the model's."""
        return self.model.differences

    @property
    def exact(self) -> bool:
        """Whether nothing differs, and no membrane left its register."""
        differ = self.model.differences or self.spec.differences
        return self.netlist.holds and not (differ or self.membranes_saturated)


def compare(
    netlist: CrossbarNetlist,
    model: Model,
    first: Mapping[str, int],
    data: Recordings,
    *,
    spec_samples: int,
    spec_steps: int | None = None,
    network: Network | None = None,
    held: AgainstNetlist = AgainstNetlist(()),
) -> Verdict:
    """Run the chip and the model on recordings, and count every spike that differs, and votes of a float network.

    `first` is the tick in which a layer spikes for the first data step. The specification runs on the first
    recordings, too, and there on the first steps, where `spec_steps` says so. `held` is what is known of the netlist.
    """
    machine, layers = TrueNorth(netlist), list(netlist.layers)
    spikes, differences = dict.fromkeys(first, 0), dict.fromkeys(first, 0)
    votes, overflows, wrong = np.zeros((len(data), netlist.classes), np.int64), 0, 0
    theirs = np.zeros_like(votes)
    sums: tuple[PartialSums, ...] = ()
    count = Progress(len(data))
    for index in range(len(data)):
        count(index, "comparing")
        events = data.events[index : index + 1, ..., : data.steps_of(index)]
        trace = machine.simulate(with_clocks(events, netlist.clocks), spikes=True)
        assert trace.spikes is not None, "spikes are kept"
        expected, counts = model(events[0])
        sums = tuple(map(add, sums, counts)) or counts
        for name, late in first.items():
            chosen = np.flatnonzero(netlist.layer == layers.index(name))
            on_chip = trace.spikes[0, late : late + events.shape[-1] * netlist.bin_ticks][:, chosen]
            due = np.zeros_like(on_chip)
            due[:: netlist.bin_ticks] = expected[name][:, netlist.neuron[chosen]]
            spikes[name] += int(expected[name].sum())
            differences[name] += int(np.count_nonzero(on_chip != due))
        overflows += int(trace.counts.overflows.sum())
        votes[index] = class_counts(netlist, trace.counts.votes)[0]
        theirs[index] = 0 if network is None else _votes(network, events)
        wrong += machine.check(events[..., :spec_steps]) if index < spec_samples else 0
    same, moved = np.count_nonzero(vote(votes) == vote(theirs)), np.abs(votes - theirs).sum()
    return Verdict(
        target=netlist.target,
        samples=len(data),
        netlist=held,
        spec=AgainstSpec(min(spec_samples, len(data)), wrong),
        model=AgainstModel(tuple(LayerSpikes(name, spikes[name], differences[name]) for name in first)),
        membranes_saturated=overflows,
        correct=int(np.count_nonzero(vote(votes) == data.labels)),
        spec_steps=spec_steps,
        sums=sums or None,
        network=None if network is None else AgainstNetwork(int(same), int(moved)),
    )


def _votes(network: Network, events: EventArray) -> IntArray:
    """Votes (1, classes) of a float network in a recording (1, taxels, polarities, steps)."""
    done = float_simulation(network).run(channels_last(events, network.input.clocks))
    return readout_counts(network.readout, network.classes, done.spikes[network.readout.population])


def sections(found: Verdict) -> list[Section]:
    """The same for people."""
    part = "" if found.spec_steps is None else f" (the first {found.spec_steps} steps of each)"
    spec = _differences(found.spec.differences, found.spec.samples)
    model = _differences(found.model.differences, found.samples)
    rows = [[layer.name, f"{layer.spikes:,}", f"{layer.differences:,}"] for layer in found.model.layers]
    accuracy = f"accuracy of the chip: {found.correct} of {found.samples}, {100 * found.correct / found.samples:.2f} %"
    if found.exact:
        low, high = wilson(found.correct, found.samples)
        accuracy += f" (95 %: {100 * low:.1f} … {100 * high:.1f}); the model's is the same, vote for vote"
    blocks: list[Text | Table] = [
        Text(found.netlist.text),
        Text(f"E0 specification = engine: {spec}{part}, membranes and counts too"),
        Text(f"E1 model = chip: {model}, every copy of every neuron"),
        Table(["layer", "spikes of the model", "different"], rows),
        Text(f"membranes that left their register: {found.membranes_saturated:,}"),
    ]
    if found.sums:
        shares = [f"{each.saturated:,} ({100 * each.saturated / max(each.partial, 1):.2g} %)" for each in found.sums]
        each_sum = zip(found.sums, shares, strict=True)
        sums = [[each.layer, f"{each.partial:,}", share, str(each.largest)] for each, share in each_sum]
        blocks.append(Table(["layer", "partial sums", "saturated", "largest"], sums))
    if found.network is not None:
        same, moved = found.network.decisions_equal, found.network.votes_different
        blocks += [Text(f"E3 network of the file: {same} of {found.samples} decisions equal; votes moved: {moved:,}")]
    return [Section("Verdict", [*blocks, Text(accuracy)])]


def _differences(differences: int, samples: int) -> str:
    on = f"on {samples} recording{'s' * (samples != 1)}"
    return f"{differences:,} differences {on}" if differences else f"equal in every spike {on}"


def verify(arguments: argparse.Namespace) -> Outcome:
    """Compare chip, specification and model; exit code 1 where one spike differs."""
    refuse(arguments, VERIFY, f"a network for {TITLE} has one model, whose every spike must be the chip's")
    machine = load(arguments.netlist)
    netlist, made = machine.netlist, machine.netlist.provenance
    copies, counting, path = int(made.get("in_time") or 0), made.get("format") == COUNTING, arguments.checkpoint
    network = load_network(path, arguments) if copies or counting else read(path, arguments)
    if made.get("checkpoint_sha256") != network.sha256:
        raise OptionError(f"--checkpoint {path}: {arguments.netlist} was compiled from another file; give that one")
    compared: Network | None = None
    model: Model
    source: Source
    if isinstance(network, LoadedNetwork) and counting:
        source = read_counters(shipped(path))[0]
        plan, compared = planned(source, machine.target), network.network
        model, first = (lambda events: (run_counters(plan, events), ())), plan.first
    elif isinstance(network, LoadedNetwork):
        source, levels = network.model, in_levels(network.network, copies, machine.target)
        model, first = (lambda events: run_levels(levels, events.reshape(-1, events.shape[-1]))), first_spikes(levels)
    elif made.get("weights") != network.weights:
        raise OptionError(
            f"--weights {network.weights}: {arguments.netlist} was compiled from {made.get('weights')}; give the same"
        )
    else:
        from spikeloom.models.truenorth.network import run_network  # torch, so only here

        source = trained = network.network
        first = {stage.name: n for n, stage in enumerate(trained.stages)}

        def model(events: EventArray) -> Modelled:
            return {name: held[0] for name, held in run_network(trained, events[None]).items()}, ()

    again = compile_crossbars(source, Options(in_time=copies or None)).netlist
    held = AgainstNetlist(tuple(unlike(netlist, again)))
    if arguments.data is None:
        return Outcome(held, lambda held: [Section("Netlist", [Text(held.text)])], 0 if held.holds else 1)
    data = load_recordings(arguments, netlist, labels_for="verify")
    steps = SPEC_STEPS if copies else None
    checked = arguments.spec_samples
    verdict = compare(netlist, model, first, data, spec_samples=checked, spec_steps=steps, network=compared, held=held)
    return Outcome(verdict, sections, 0 if verdict.exact else 1)
