"""A chip that inherits nothing of another one: put into the tuple of backends, every command takes it."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
import pytest
from commands import as_json, refusal, run
from zoo import specimen

from spikeloom.compiler.archive import stated
from spikeloom.compiler.dynamics import Clocks, with_clocks
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.interpret import cut
from spikeloom.compiler.targets.base import EnergyTable, Quantity, Target
from spikeloom.compiler.targets.netlist_file import Netlist, NetlistFile
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.repeat import PLACING, ROUNDING, refuse
from spikeloom.runtime.machines import backends
from spikeloom.runtime.machines.backend import Backend, Lowered
from spikeloom.runtime.machines.base import Machine, Model, Price
from spikeloom.runtime.machines.netlist_check import NetlistCheck
from spikeloom.runtime.report.sections import Outcome, Section, Text

ABACUS = Target(
    name="abacus",
    title="Abacus",
    limits={"core.neurons": Quantity(value=4096, unit="neurons", source="here")},
    choices={},
    energy=(
        EnergyTable(
            name="guess", title="A guess", prices={"spike": Quantity(value=2, unit="pJ", source="here")}
        ),
    ),
    time=(),
    static={},
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Beads(Netlist):
    """One core. A membrane loses its lowest bits (``>> shift``), adds its inputs, and is zero after a spike."""

    target: str = "abacus"
    taxels: int
    polarities: int
    classes: int
    clocks: Clocks
    layers: tuple[str, ...]
    provenance: dict = field(default_factory=dict)
    # by neuron
    layer: np.ndarray
    shift: np.ndarray
    threshold: np.ndarray
    bias: np.ndarray
    readout_class: np.ndarray
    # by synapse: sender (input channels, then neurons), receiver, weight
    pre: np.ndarray
    post: np.ndarray
    weight: np.ndarray


FILE = NetlistFile(
    format="abacus",
    version=1,
    targets=("abacus",),
    netlist=Beads,
    entries={"layers": [str, ...]},
    layer=str,
    inconsistencies=lambda _: [],
)


def lowered(network, provenance=None) -> Beads:
    """Eight bits a weight; as many neurons as a core holds."""
    offsets = np.cumsum([0, *(population.size for population in network.populations)])
    columns = {
        name: []
        for name in ("layer", "shift", "threshold", "bias", "readout_class", "pre", "post", "weight")
    }
    for post, population in enumerate(network.populations):
        into = [(p.pre, p.weight.tocoo()) for p in network.projections if p.post == post]
        scale = 127 / max(np.abs(weight.data).max() for _, weight in into)
        votes = network.readout.label if post == network.readout.population else np.full(population.size, -1)
        own = (
            np.full(population.size, post),
            np.full(population.size, round(-np.log2(population.beta or 0.5**31))),
        )
        numbers = (
            np.floor(np.full(population.size, population.theta * scale)),
            np.rint(population.bias * scale),
            votes,
        )
        for name, values in zip(list(columns)[:5], (*own, *numbers), strict=True):
            columns[name].append(values)
        for pre, weight in into:
            columns["pre"].append(weight.col + (0 if pre < 0 else network.input.size + offsets[pre]))
            columns["post"].append(weight.row + offsets[post])
            columns["weight"].append(np.rint(weight.data * scale))
    made = {name: np.concatenate(parts).astype(np.int64) for name, parts in columns.items()}
    if offsets[-1] > ABACUS.limit("core.neurons"):
        raise CapacityError(
            [ABACUS.exceeded("network", "core.neurons", int(offsets[-1]), "train a smaller one")]
        )
    sizes = {name: getattr(network.input, name) for name in ("taxels", "polarities", "clocks")}
    names = tuple(population.name for population in network.populations)
    return Beads(classes=network.classes, layers=names, provenance=provenance or {}, **sizes, **made)


def simulate(netlist: Beads, channels: np.ndarray, lengths=None):
    """Spikes and membranes of recordings (samples, channels, steps), all neurons of a layer at a time."""
    samples, inputs, steps = channels.shape
    neurons = len(netlist.threshold)
    weight = np.zeros((inputs + neurons, neurons), np.int64)
    np.add.at(weight, (netlist.pre, netlist.post), netlist.weight)
    spikes, membranes = (
        np.zeros((samples, steps, neurons), bool),
        np.zeros((samples, steps, neurons), np.int32),
    )
    held = np.zeros((samples, neurons), np.int64)
    for step in range(steps):
        for layer in range(len(netlist.layers)):
            here = netlist.layer == layer
            sent = np.concatenate([channels[:, :, step] != 0, spikes[:, step]], axis=1)
            held[:, here] = (
                (held[:, here] >> netlist.shift[here]) + sent @ weight[:, here] + netlist.bias[here]
            )
            spikes[:, step, here] = held[:, here] > netlist.threshold[here]
            held[spikes[:, step] & here] = 0
        membranes[:, step] = held
    spikes = cut(spikes, lengths)
    return traced(spikes, membranes)


def traced(spikes, membranes):
    counts = Counted(votes=spikes.sum(axis=-2), spikes=spikes.sum(axis=-2))
    return Traced(counts=counts, spikes=spikes, membranes=membranes)


@dataclass
class Counted:
    votes: np.ndarray
    spikes: np.ndarray


@dataclass
class Traced:
    counts: Counted
    spikes: np.ndarray
    membranes: np.ndarray


def specification(netlist: Beads, channels: np.ndarray):
    """The same for one recording, a synapse at a time."""
    neurons = len(netlist.threshold)
    spikes, membranes = (
        np.zeros((channels.shape[1], neurons), bool),
        np.zeros((channels.shape[1], neurons), np.int32),
    )
    held = [0] * neurons
    for step, events in enumerate(channels.T):
        sent = [*events.tolist(), *[0] * neurons]
        for neuron in range(neurons):
            into = netlist.post == neuron
            inputs = sum(
                w for s, w in zip(netlist.pre[into], netlist.weight[into].tolist(), strict=True) if sent[s]
            )
            held[neuron] = (held[neuron] >> int(netlist.shift[neuron])) + inputs + int(netlist.bias[neuron])
            if held[neuron] > netlist.threshold[neuron]:
                sent[len(events) + neuron] = spikes[step, neuron] = 1
                held[neuron] = 0
        membranes[step] = held
    return traced(spikes, membranes)


@dataclass(frozen=True)
class Machinery(Machine):
    netlist: Beads
    target = ABACUS
    details = ("counts",)
    weight_bits = 8

    @property
    def layers(self):
        return self.netlist.layers

    def legal(self):
        assert len(self.netlist.threshold) <= ABACUS.limit("core.neurons")

    def check_lowering(self, network):
        due = lowered(network)
        names = [each.name for each in fields(Beads) if isinstance(getattr(due, each.name), np.ndarray)]
        wrong = [
            name for name in names if not np.array_equal(getattr(due, name), getattr(self.netlist, name))
        ]
        return NetlistCheck(
            whole=tuple(f"another {name}" for name in wrong), claim="every bead is in its place"
        )

    def of_layer(self, array, index):
        return array[..., self.netlist.layer == index]

    def simulate(self, channels, lengths, *, spikes, membranes):
        return simulate(self.netlist, channels, lengths)

    def model(self, network):
        again = lowered(network)

        def spikes(events):
            found = simulate(again, with_clocks(events, again.clocks)).spikes
            return {name: found[..., again.layer == index] for index, name in enumerate(again.layers)}

        return Model(first=dict.fromkeys(again.layers, 0), spikes=spikes)

    def spec_and_engine(self, channels):
        return specification(self.netlist, channels), simulate(self.netlist, channels[None])

    def priced(self, channels, lengths, chip, bin_s, detail, progress):
        trace = simulate(self.netlist, channels, lengths)
        spikes = trace.counts.spikes.sum(axis=1)
        energy = {table.name: spikes * table.joule("spike") for table in chip.energy}
        means = {"per_inference": {"energy_j": {name: each.mean() for name, each in energy.items()}}}
        sections = [Section("Costs", [Text(f"{spikes.mean():g} beads moved an inference")])]
        return trace, Price(
            synaptic_operations=spikes,
            energy_j=energy,
            time_s={},
            step_s={},
            dynamic_j=energy,
            static_w={},
            outcome=Outcome(means, lambda _: sections),
        )


class Abacus(Backend):
    name = "abacus"
    target = ABACUS
    counting_bits = 8
    passes = ("lower",)

    def lower(self, arguments, after):
        refuse(arguments, ("calibrate", *ROUNDING, *PLACING), "is not for the abacus")
        loaded = load_network(arguments.checkpoint, arguments)
        netlist = lowered(
            loaded.network, {"checkpoint_sha256": loaded.sha256, **loaded.origin(arguments.run)}
        )
        return Lowered(
            netlist=netlist,
            model=Machinery(netlist).model(loaded.network),
            write=lambda path: FILE.write(netlist, path),
            report=lambda sha256: described(netlist, sha256),
        )

    def lower_counters(self, counters):
        raise NotImplementedError

    def machine(self, netlist):
        return Machinery(netlist)

    def load(self, path):
        return Machinery(FILE.read(path))

    def describe(self, path):
        return described(FILE.read(path), "")


def described(netlist: Beads, sha256: str) -> Outcome:
    facts = {"target": netlist.target, "neurons": len(netlist.threshold), "sha256": sha256}
    return Outcome(facts, lambda facts: [Section("Netlist", [Text(f"abacus: {facts['neurons']} neurons")])])


@pytest.fixture
def made(monkeypatch, tmp_path):
    monkeypatch.setattr(backends, "BACKENDS", (*backends.BACKENDS, Abacus()))
    monkeypatch.chdir(tmp_path)
    return specimen("tactilesgnet")


def test_every_command_takes_it(made):
    compiled = as_json("compile", made.network, *made.reading, "--target", "abacus", "-o", "net.loom")
    assert stated(Path("net.loom"), "target") == "abacus"
    assert as_json("inspect", "net.loom") | {"sha256": ""} == compiled | {"sha256": ""}
    decided = as_json("run", "net.loom", "--data", made.data, "--spikes", "spikes.npz")
    with np.load("spikes.npz") as spikes:
        assert tuple(spikes) == backends.machine_for("net.loom").layers
        assert np.array_equal(decided["counts"], votes_of(spikes))
    assert as_json("estimate", "net.loom", "--data", made.data)["per_inference"]["energy_j"]["guess"] > 0
    words = ("net.loom", "--checkpoint", made.network, *made.reading, "--data", made.data)
    verdict = as_json("verify", *words, "--spec-samples", 1, "--require", "EN,E0,E1")
    shares = {level["name"]: level["share"] for level in verdict["levels"]}
    assert (shares["EN"], shares["E0"], shares["E1"], shares["E2"]) == (1, 1, 1, None)
    assert shares["E3"] == verdict["decision_agreement"] > 0.2
    assert (
        as_json("report", *words, "--spec-samples", 1, "-o", "page.html")["verify"]["levels"]
        == verdict["levels"]
    )
    assert "beads moved an inference" in Path("page.html").read_text()


def votes_of(spikes):
    """Votes of each recording by the spikes that were written."""
    netlist = backends.machine_for("net.loom").netlist
    voting = netlist.readout_class[netlist.layer == len(netlist.layers) - 1]
    return spikes[netlist.layers[-1]].sum(axis=1) @ np.eye(netlist.classes, dtype=np.int64)[voting]


def wrongly(machine, channels):
    return specification(machine.netlist, channels[::-1]), simulate(machine.netlist, channels[None])


def test_what_is_wrong_is_found(made, monkeypatch):
    as_json("compile", made.network, *made.reading, "--target", "abacus", "-o", "net.loom")
    words = (
        "net.loom",
        "--checkpoint",
        made.network,
        *made.reading,
        "--data",
        made.data,
        "--spec-samples",
        1,
    )
    netlist = FILE.read("net.loom")
    FILE.write(replace(netlist, threshold=netlist.threshold - 20), "net.loom")
    code, out, _ = run("verify", *words)
    assert code == 1
    assert "missed: EN: NOT what this network is lowered to: another threshold" in out
    assert "missed: E1" not in out, "nobody required it"
    monkeypatch.setattr(Machinery, "spec_and_engine", wrongly)
    assert "missed: E0" in run("verify", *words)[1]


def test_what_it_does_not_have_is_refused_by_name(made):
    compiling = ("compile", made.network, *made.reading, "-o", "no.loom", "--target")
    assert refusal(*compiling, "abacus", "--planes", 2) == "--planes 2: is not for the abacus; omit it"
    assert refusal(*compiling, "loihi2").endswith("allowed: loihi1, truenorth, abacus")
    as_json(*compiling[:-2], "no.loom", "--target", "abacus")
    assert "is for Abacus, which anytime does not take" in refusal("anytime", "no.loom", "--data", made.data)
