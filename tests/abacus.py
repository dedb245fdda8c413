"""A third chip, as small as one can be: its limits, its netlist and file, its passes, its machine, its prices.

One core whose neurons count in beads; it inherits nothing of the other chips. See docs/extend.md for the order.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.interpret import cut
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.targets.base import EnergyTable, Quantity, Target
from spikeloom.compiler.targets.netlist_file import Netlist, NetlistFile, column_faults
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.repeat import PLACING, ROUNDING, refuse
from spikeloom.runtime.machines.backend import Backend, Lowered
from spikeloom.runtime.machines.base import Counts, Machine, Model, Price, Trace
from spikeloom.runtime.machines.netlist_check import NetlistCheck
from spikeloom.runtime.report.sections import Outcome, Section, Text

SPIKE = Quantity(value=2, unit="pJ", source="a guess")
ABACUS = Target(
    name="abacus",
    title="Abacus",
    limits={"core.neurons": Quantity(value=4096, unit="neurons", source="a guess")},
    choices={},
    energy=(EnergyTable(name="guess", title="A guess", prices={"spike": SPIKE}),),
    time=(),
    static={},
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Beads(Netlist):
    """A membrane is shifted right by `shift`, gets inputs and bias, is compared, and is zero after a spike."""

    target: str = "abacus"
    taxels: int
    polarities: int
    classes: int
    clocks: Clocks
    provenance: dict
    layers: tuple[str, ...]
    layer: np.ndarray  # (neurons,) int64, as those that follow
    shift: np.ndarray
    threshold: np.ndarray
    bias: np.ndarray
    readout_class: np.ndarray
    weight: np.ndarray  # (senders, neurons) int64; the senders are the input channels, then the neurons


def faults(netlist: Beads) -> list[str]:
    """What in a file from a stranger would be read out of bounds."""
    neurons = len(netlist.layer)
    lengths = dict.fromkeys(("shift", "threshold", "bias", "readout_class"), neurons)
    lengths["weight"] = netlist.n_inputs + neurons
    ranges = {"layer": (0, len(netlist.layers)), "shift": (0, 64), "readout_class": (-1, netlist.classes)}
    wrong = column_faults(netlist, {}, lengths, ranges)
    return wrong if netlist.weight.shape[1] == neurons else [*wrong, f"weight has not {neurons} columns"]


FILE = NetlistFile(
    format="abacus",
    version=1,
    targets=("abacus",),
    netlist=Beads,
    entries={"layers": [str, ...]},
    layer=str,
    inconsistencies=faults,
    tables=frozenset({"weight"}),
)


def lowered(network, provenance=None) -> Beads:
    """Weights of eight bits; membranes count in steps of the weights of their layer."""
    populations = network.populations
    sizes = [population.size for population in populations]
    layer = np.repeat(np.arange(len(sizes)), sizes)
    ends = network.input.size + np.cumsum([0, *sizes])
    weight = np.zeros((ends[-1], len(layer)))
    for projection in network.projections:
        first, last = (0, ends[0]) if projection.pre == INPUT else ends[projection.pre : projection.pre + 2]
        weight[first:last, layer == projection.post] = projection.weight.toarray().T
    scale = np.array([127 / np.abs(weight[:, layer == post]).max() for post in range(len(sizes))])[layer]
    theta = np.array([population.theta for population in populations])[layer]
    beta = np.array([population.beta for population in populations])[layer]
    readout_class = np.full(len(layer), -1)
    readout_class[layer == network.readout.population] = network.readout.label
    return Beads(
        taxels=network.input.taxels,
        polarities=network.input.polarities,
        classes=network.classes,
        clocks=network.input.clocks,
        provenance=provenance or {},
        layers=tuple(population.name for population in populations),
        layer=layer,
        shift=np.rint(-np.log2(np.maximum(beta, 2.0**-31))).astype(np.int64),
        threshold=np.floor(theta * scale).astype(np.int64),
        bias=np.rint(np.concatenate([each.bias for each in populations]) * scale).astype(np.int64),
        readout_class=readout_class,
        weight=np.rint(weight * scale).astype(np.int64),
    )


def traced(spikes, membranes) -> Trace:
    """What machines hand back; every spike of a neuron with a class is a vote."""
    counts = spikes.sum(axis=-2)
    return Trace(counts=Counts(spikes=counts, votes=counts), spikes=spikes, membranes=membranes)


def specification(netlist: Beads, channels) -> Trace:
    """The definition: one recording (channels, steps), one neuron after another."""
    inputs, steps = channels.shape
    neurons = len(netlist.layer)
    sent = np.concatenate([channels.T != 0, np.zeros((steps, neurons), bool)], axis=1)
    membranes = np.zeros((steps, neurons), np.int32)
    held = [0] * neurons
    for step, neuron in product(range(steps), range(neurons)):
        arrived = sum(netlist.weight[sent[step], neuron].tolist())
        membrane = (held[neuron] >> int(netlist.shift[neuron])) + arrived + int(netlist.bias[neuron])
        spiked = membrane > int(netlist.threshold[neuron])
        sent[step, inputs + neuron] = spiked
        membranes[step, neuron] = membrane
        held[neuron] = 0 if spiked else membrane
    return traced(sent[:, inputs:], membranes)


def simulate(netlist: Beads, channels, lengths=None) -> Trace:
    """The same for recordings (samples, channels, steps), all neurons of a layer at a time."""
    samples, inputs, steps = channels.shape
    shape = (samples, steps, len(netlist.layer))
    sent = np.concatenate([channels.transpose(0, 2, 1) != 0, np.zeros(shape, bool)], axis=2)
    spikes = sent[:, :, inputs:]
    membranes = np.zeros(shape, np.int32)
    held = np.zeros((samples, len(netlist.layer)), np.int64)
    for step, layer in product(range(steps), range(len(netlist.layers))):
        here = netlist.layer == layer
        arrived = sent[:, step] @ netlist.weight[:, here]
        held[:, here] = (held[:, here] >> netlist.shift[here]) + arrived + netlist.bias[here]
        membranes[:, step, here] = held[:, here]
        spikes[:, step, here] = held[:, here] > netlist.threshold[here]
        held[spikes[:, step] & here] = 0
    return traced(cut(spikes, lengths), membranes)


@dataclass(frozen=True)
class AbacusMachine(Machine):
    netlist: Beads
    target = ABACUS
    details = ("counts",)
    weight_bits = 8

    def legal(self):
        neurons = len(self.netlist.layer)
        if neurons > ABACUS.limit("core.neurons"):
            raise CapacityError([ABACUS.exceeded("network", "core.neurons", neurons, "train a smaller one")])

    def check_lowering(self, network):
        due = lowered(network)
        wrong = [
            f"another {name}"
            for name in FILE.arrays
            if not np.array_equal(getattr(due, name), getattr(self.netlist, name))
        ]
        return NetlistCheck(whole=tuple(wrong), claim="every bead is in its place")

    def model(self, network):
        again = replace(self, netlist=lowered(network))
        return Model(
            first=dict.fromkeys(self.layers, 0), spikes=lambda events: again.run(events, spikes=True).spikes
        )

    def simulate(self, channels, lengths, *, spikes, membranes):
        return simulate(self.netlist, channels, lengths)

    def spec_and_engine(self, channels):
        return specification(self.netlist, channels), simulate(self.netlist, channels[None])

    def pricing(self, chip, detail):
        return Pricing(self.netlist, chip)


@dataclass(frozen=True)
class Pricing:
    netlist: Beads
    chip: Target

    def batch(self, steps):
        return max(1, (1 << 20) // steps)

    def run(self, channels, lengths):
        trace = simulate(self.netlist, channels, lengths)
        return trace, trace.counts.spikes.sum(axis=1)

    def price(self, spikes, bin_s):
        energy = {table.name: spikes * table.joule("spike") for table in self.chip.energy}
        means = {"per_inference": {"energy_j": {name: each.mean() for name, each in energy.items()}}}
        page = [Section("Costs", [Text(f"{spikes.mean():g} beads moved an inference")])]
        return Price(
            synaptic_operations=spikes,
            energy_j=energy,
            dynamic_j=energy,
            outcome=Outcome(means, lambda _: page),
        )


class Abacus(Backend):
    name = "abacus"
    target = ABACUS
    passes = ("lower",)

    def lower(self, request, after):
        refuse(request, ("calibrate", *ROUNDING, *PLACING), "is not for the abacus")
        loaded = load_network(request.checkpoint, request)
        provenance = {"checkpoint_sha256": loaded.sha256, **loaded.origin(request.run)}
        machine = AbacusMachine(lowered(loaded.network, provenance))
        machine.legal()
        return Lowered(
            netlist=machine.netlist,
            model=machine.model(loaded.network),
            write=lambda path: FILE.write(machine.netlist, path),
            report=lambda sha256: described(machine.netlist, sha256),
        )

    def machine(self, netlist):
        return AbacusMachine(netlist)

    def load(self, path):
        return AbacusMachine(FILE.read(path))

    def describe(self, path):
        return described(FILE.read(path), sha256_of(path))


def described(netlist: Beads, sha256: str) -> Outcome:
    facts = {"target": netlist.target, "neurons": len(netlist.layer), "sha256": sha256}
    return Outcome(facts, lambda facts: [Section("Netlist", [Text(f"abacus: {facts['neurons']} neurons")])])
