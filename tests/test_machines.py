"""The one interface of all chips: what it returns is the simulator's, and a further chip is a folder."""

import json
import sys
from importlib import resources

import numpy as np
import pytest
from oracles import refused
from random_networks import random_checkpoint, ring
from zoo import specimen

from spikeloom.compiler import compile_network, targets
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.interpret import channels_last, run_integer
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets import base
from spikeloom.compiler.targets.loihi1.legalize import REMEDIES
from spikeloom.compiler.targets.loihi1.netlist import write_netlist
from spikeloom.runtime import machines
from spikeloom.runtime.machines.base import machine_for
from spikeloom.runtime.machines.integer import integer_machine
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.truenorth import engine as crossbar_engine
from spikeloom.runtime.machines.votes import class_counts, readout_counts
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal

LENGTHS = np.array([14, 5, 1, 9])
SIMULATORS = {"timed": engine, "native": crossbar_engine}


@pytest.fixture(params=SIMULATORS)
def made(request):
    return specimen(request.param)


def test_runs_and_prices_are_the_simulators(made):
    machine, events = made.machine, made.events
    netlist, channels = machine.netlist, with_clocks(events, made.machine.netlist.clocks)
    counts = SIMULATORS[made.folder.name].simulate(netlist, channels, lengths=LENGTHS).counts
    done = machine.run(events, lengths=LENGTHS, spikes=True)
    votes = counts.votes if netlist.target == "truenorth" else counts.spikes
    np.testing.assert_array_equal(done.votes, class_counts(netlist, votes))
    np.testing.assert_array_equal(done.decisions, done.votes.argmax(axis=1))
    assert tuple(done.spikes) == machine.layers
    for detail in machine.details:
        again, price = machine.price(events, lengths=LENGTHS, bin_s=0.02, detail=detail)
        np.testing.assert_array_equal(again.votes, done.votes)
        each = [price.synaptic_operations, *price.energy_j.values(), *price.time_s.values()]
        assert {np.shape(values) for values in each} == {(4,)}
        assert set(price.energy_j) == {table.name for table in machine.target.energy}
        assert set(price.step_s) == set(price.time_s)
        assert encode(price.outcome.result)["per_inference"]["energy_j"] == {
            name: pytest.approx(values.mean()) for name, values in price.energy_j.items()
        }
        assert "per inference" in terminal(price.outcome.sections(price.outcome.result))
    with pytest.raises(OptionError, match=f"--detail none: .* allowed: {', '.join(machine.details)}"):
        machine.price(events, bin_s=0.02, detail="none")


def test_simulators_are_held_against_their_specifications(made, monkeypatch):
    machine, events, lengths = made.machine, made.events[:3], LENGTHS[:3]
    assert machine.check(events, lengths=lengths) == 0
    done = machine.run(events, lengths=lengths, spikes=True, membranes=True)
    shapes = {name: held.shape for name, held in done.spikes.items()}
    assert {name: held.shape for name, held in done.membranes.items()} == shapes
    assert any(held.any() for held in done.membranes.values())
    simulator = SIMULATORS[made.folder.name]
    simulate = simulator.simulate

    def wrong(*words, **options):
        trace = simulate(*words, **options)
        trace.membranes[0, -1, -1] ^= 1
        return trace

    monkeypatch.setattr(simulator, "simulate", wrong)
    assert machine.check(events, lengths=lengths) == 3
    with pytest.raises(DataError, match=r"9 input channels found, the netlist has \d+"):
        machine.require_sensor(np.zeros((1, 3, 3, 12), np.uint8))


PASSES = """
import numpy as np
from dataclasses import replace
from spikeloom.compiler.passes.prune import without_channels
from spikeloom.compiler.pipeline import Pass
from spikeloom.compiler.targets.loihi1 import passes
from spikeloom.compiler.targets.loihi1.options import Options

def unplug(done):
    return replace(done, integer=without_channels(done.integer, np.arange(done.integer.input.size) == 0))

PASSES = (*passes.FLOATS, Pass(name="unplug", does="ignores channel 0", keeps="the rest", apply=unplug),
          *passes.INTEGERS, *passes.LAYOUT)

def start(source, options, target):
    return passes.start(source, options, target)[0], PASSES
"""
MACHINE = """
from spikeloom.runtime.machines.loihi1.machine import Loihi
from spikeloom.compiler.targets.loihi1.netlist import read_netlist

class Toy(Loihi):
    details = ("counts",)

def machine_of(netlist):
    return Toy(netlist)

def load(path):
    return Toy(read_netlist(path))
"""


def test_a_third_chip_is_a_folder_of_the_compiler_and_one_of_the_machines(tmp_path, monkeypatch):
    """With cores of eight neurons and one pass more."""
    limits = (resources.files(targets) / "loihi1" / "chip.toml").read_text("utf-8").replace('"loihi1"', '"toy"')
    limits = limits.replace("core.compartments = { value = 1024", "core.compartments = { value = 8")
    for package, texts in ((targets, {"chip.toml": limits, "passes.py": PASSES}), (machines, {"machine.py": MACHINE})):
        folder = tmp_path / package.__name__ / "toy"
        folder.mkdir(parents=True)
        for name, text in texts.items():
            (folder / name).write_text(text)
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(folder.parent)])
    base.shipped.cache_clear()
    try:
        done = compile_network(expand(random_checkpoint(), ring(5)), target="toy")
        assert [step.name for step in base.load_target("toy").module.PASSES][4] == "unplug"
        assert np.diff(done.netlist.core_compartments).max() <= 8
        assert not (done.netlist.axon_source == 0).any()
        write_netlist(done.netlist, tmp_path / "net.loom")
        machine = machine_for(tmp_path / "net.loom")
        assert (type(machine).__name__, machine.target.name) == ("Toy", "toy")
        events = (np.random.default_rng(0).random((4, 5, 2, 12)) < 0.3).astype(np.uint8)
        expected = run_integer(done.integer, channels_last(events)).spikes[-1]
        votes = readout_counts(done.integer.readout, done.integer.classes, expected)
        np.testing.assert_array_equal(machine.run(events).votes, votes)
        assert votes.any()
        assert integer_machine(machine).check(events[:1]) == 0
        with pytest.raises(OptionError, match="toy has no such price model; allowed: counts"):
            machine.price(events, bin_s=0.02, detail="cycle")
    finally:
        base.shipped.cache_clear()
        for name in [name for name in sys.modules if ".toy" in name]:
            del sys.modules[name]


@pytest.mark.parametrize("name", ["loihi1", "truenorth"])
def test_every_number_of_a_chip_is_as_published(golden, name):
    golden(f"{name}.chip.json", json.dumps(encode(base.load_target(name)), indent=1) + "\n")


def test_a_barrier_is_that_of_the_fewest_tiles_it_is_known_for():
    chip = base.load_target("loihi1")
    barriers = [chip.time[0].barrier(tiles) for tiles in (1, 2, 3, 4, 28, 29, 32)]
    assert barriers == [600_000, *[1_000_000] * 2, *[1_400_000] * 2, *[1_800_000] * 2]
    assert set(REMEDIES) == {rule for rule in chip.limits if rule.startswith(("core.", "chip."))}


def test_known_targets_are_the_folders():
    assert base.known_targets() == ("loihi1", "truenorth")
    assert base.known_targets(base.CROSSBARS) == ("truenorth",)


TEXT = (resources.files("spikeloom.compiler.targets") / "loihi1" / "chip.toml").read_text("utf-8")


WRONG = [
    ('title = "Intel Loihi 1"\n', "", "title: missing"),
    ("core.axons_in = { value = 4096,", "core.axons_in = { value = -1,", "limits.core.axons_in: value is -1, a finite"),
    ("core.axons_in = { value = 4096,", "core.axons_in = { unt = 2, value = 4096,", "core.axons_in: is {'unt': 2"),
    ("mesh.height = { value = 4,", "mesh.height = { value = nan,", "mesh.height: value is nan, a finite"),
    ("mesh.height = { value = 4,", 'mesh.height = { value = "4",', "mesh.height: value is '4', a finite"),
    ("synapse.word_bits = { value = 64,", "synapse.word_bits = {", "synapse.word_bits: is {'unit'"),
    ('spike = { value = 69.3, unit = "pJ"', 'spkie = { value = 69.3, unit = "pJ"', "sanafe.spkie: unknown, allowed"),
    ('spike = { value = 69.3, unit = "pJ"', 'spike = { value = 69, unit = "nJ"', "spike: unit is 'nJ', allowed is"),
    ('spike = { value = 69.3, unit = "pJ"', 'spike = { value = inf, unit = "pJ"', "sanafe.spike: value is inf"),
    ("neuron_access = {", "neuron_acess = {", "time.sanafe.neuron_acess: unknown|neuron_access"),
    ('neuron_access = { value = 6.0, unit = "ns"', 'neuron_access = { value = 6.0, unit = "s"', "unit is 's'"),
    ("link_buffer = {", "#", "time.sanafe: lacks link_buffer"),
    ("barrier.1 = {", "barrier.3 = {", "time.sanafe: lacks barrier.1"),
    ("barrier.2 = {", "barrier.two = {", "time.sanafe: lacks barrier.1, and others with a number"),
    ("name = ", "name = \n", "(TOMLDecodeError: "),
    ('title = "SANA-FE\'s fit to a Nahuku board"\nneuron', "neuron", "time.sanafe: lacks its title"),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG)
def test_a_wrong_entry_is_named(tmp_path, old, new, words):
    assert TEXT.count(old) == 1
    (tmp_path / "x.toml").write_text(TEXT.replace(old, new), "utf-8")
    refused(OptionError, f"{tmp_path / 'x.toml'}: |{words}", base.read_target, tmp_path / "x.toml")


def test_a_file_that_is_not_there(tmp_path):
    refused(OptionError, "no such file", base.read_target, tmp_path / "no.toml")


MINE = """
[energy.mine]
title = "Measured in our lab"
neuron_active = { value = 80.0, unit = "pJ", source = "board 7" }
"""


def test_tables_by_name_or_from_a_file(tmp_path):
    chip = base.load_target("loihi1")
    assert [table.name for table in base.with_tables(chip, "davies2018").energy] == ["davies2018"]
    assert base.with_tables(chip, "davies2018").time == chip.time
    (tmp_path / "mine.toml").write_text(MINE)
    found = base.with_tables(chip, str(tmp_path / "mine.toml"))
    assert [(table.name, table.joule("neuron_active")) for table in found.energy] == [("mine", 80e-12)]
    assert (found.time, found.limits, found.static) == (chip.time, chip.limits, chip.static)


def test_tables_that_are_not_there_or_wrong(tmp_path):
    chip, path = base.load_target("loihi1"), tmp_path / "mine.toml"
    refused(OptionError, "--table davis: unknown|davies2018, sanafe|.toml", base.with_tables, chip, "davis")
    refused(OptionError, f"{path}: no such file", base.with_tables, chip, str(path))
    path.write_text("limits = 3")
    refused(OptionError, "holds limits|[energy.NAME]|[time.NAME]", base.with_tables, chip, str(path))
    path.write_text("")
    refused(OptionError, "holds nothing|[energy.NAME]", base.with_tables, chip, str(path))
    path.write_text(MINE.replace("80.0", "-80.0"))
    refused(OptionError, "energy.mine.neuron_active: value is -80.0", base.with_tables, chip, str(path))
    path.write_text(MINE.replace("[energy.mine]", "[energy.mine]\nhopp = 1"))
    refused(OptionError, "energy.mine.hopp: unknown", base.with_tables, chip, str(path))
