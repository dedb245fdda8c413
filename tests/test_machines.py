"""The one interface of all chips: what it returns is the simulator's."""

import json
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from oracles import refused
from zoo import specimen

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.targets import base
from spikeloom.compiler.targets.loihi1.legalize import REMEDIES
from spikeloom.runtime.machines.backends import BACKENDS
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.truenorth import engine as crossbar_engine
from spikeloom.runtime.machines.votes import class_counts
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
    assert_array_equal(done.votes, class_counts(netlist, votes))
    assert_array_equal(done.decisions, done.votes.argmax(axis=1))
    assert tuple(done.spikes) == machine.layers
    for detail in machine.details:
        again, price = machine.price(events, lengths=LENGTHS, bin_s=0.02, detail=detail)
        assert_array_equal(again.votes, done.votes)
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
        machine.run(np.zeros((1, 3, 3, 12), np.uint8))


@pytest.mark.parametrize("name", ["loihi1", "truenorth"])
def test_every_number_of_a_chip_is_as_published(golden, name):
    golden(f"{name}.chip.json", json.dumps(encode(base.load_target(name)), indent=1) + "\n")


def test_a_barrier_is_that_of_the_fewest_tiles_it_is_known_for():
    chip = base.load_target("loihi1")
    barriers = [chip.time[0].barrier(tiles) for tiles in (1, 2, 3, 4, 28, 29, 32)]
    assert barriers == [600_000, *[1_000_000] * 2, *[1_400_000] * 2, *[1_800_000] * 2]
    assert set(REMEDIES) == {rule for rule in chip.limits if rule.startswith(("core.", "chip."))}


def test_every_chip_that_is_described_can_be_compiled_for():
    assert [backend.name for backend in BACKENDS] == sorted(base.shipped()) == ["loihi1", "truenorth"]


TEXT = (resources.files("spikeloom.compiler.targets") / "loihi1" / "chip.toml").read_text("utf-8")


WRONG = [
    ('title = "Intel Loihi 1"\n', "", "title: missing"),
    (
        "core.axons_in = { value = 4096,",
        "core.axons_in = { value = -1,",
        "limits.core.axons_in: value is -1, a finite",
    ),
    (
        "core.axons_in = { value = 4096,",
        "core.axons_in = { unt = 2, value = 4096,",
        "core.axons_in: is {'unt': 2",
    ),
    ("mesh.height = { value = 4,", "mesh.height = { value = nan,", "mesh.height: value is nan, a finite"),
    ("mesh.height = { value = 4,", 'mesh.height = { value = "4",', "mesh.height: value is '4', a finite"),
    ("synapse.word_bits = { value = 64,", "synapse.word_bits = {", "synapse.word_bits: is {'unit'"),
    (
        'spike = { value = 69.3, unit = "pJ"',
        'spkie = { value = 69.3, unit = "pJ"',
        "sanafe.spkie: unknown, allowed",
    ),
    (
        'spike = { value = 69.3, unit = "pJ"',
        'spike = { value = 69, unit = "nJ"',
        "spike: unit is 'nJ', allowed is",
    ),
    (
        'spike = { value = 69.3, unit = "pJ"',
        'spike = { value = inf, unit = "pJ"',
        "sanafe.spike: value is inf",
    ),
    ("neuron_access = {", "neuron_acess = {", "time.sanafe.neuron_acess: unknown|neuron_access"),
    (
        'neuron_access = { value = 6.0, unit = "ns"',
        'neuron_access = { value = 6.0, unit = "s"',
        "unit is 's'",
    ),
    (
        '"x86 cores awake" = { value = 66.6, unit = "mW"',
        'x86 = { value = 1, unit = "s"',
        "injection.x86: unit is 's'",
    ),
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


@pytest.mark.parametrize(
    ("joules", "said"), [(1e-9, "static power dominates"), (1e9, "dynamic energy is 1e+09 J")]
)
def test_which_power_dominates_is_said_once(joules, said):
    """Static power is not called the larger where dynamic energy is more."""
    made = specimen("timed")
    outcome = made.machine.price(made.events, lengths=LENGTHS, bin_s=0.02)[1].outcome
    mean = replace(
        outcome.result.per_inference, energy_j=dict.fromkeys(outcome.result.per_inference.energy_j, joules)
    )
    text = terminal(outcome.sections(replace(outcome.result, per_inference=mean, min=mean, max=mean)))
    assert f"at the sensor's pace {said}" in text
    assert "all else" not in text
