"""The one interface of all chips: what it returns is the simulator's, and a further chip is a folder."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_netlists import lively
from zoo import specimen

from spikeloom.compiler import targets
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.targets.base import shipped
from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist
from spikeloom.runtime import machines
from spikeloom.runtime.machines.base import machine_for, machine_of
from spikeloom.runtime.machines.integer import integer_machine
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
    np.testing.assert_array_equal(done.votes, class_counts(netlist, votes))
    np.testing.assert_array_equal(done.decisions, done.votes.argmax(axis=1))
    assert tuple(done.spikes) == machine.layers
    for detail in machine.details:
        again, price = machine.price(events, lengths=LENGTHS, bin_s=0.02, detail=detail, spikes=True)
        np.testing.assert_array_equal(again.votes, done.votes)
        for name, spikes in done.spikes.items():
            np.testing.assert_array_equal(again.spikes[name], spikes)
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


def test_what_is_compared_with_a_float_model():
    made = specimen("timed")
    found, events = integer_machine(made.machine), made.events
    sizes = [layer.neurons for layer in found.netlist.layers]
    assert [len(out) for out in found.absent] == [len(out) for out in found.unread] == sizes
    ran = found.cumulative(events, LENGTHS)
    np.testing.assert_array_equal(ran.votes[:, -1], found.run(events, lengths=LENGTHS).votes)
    price = found.price(events, lengths=LENGTHS, bin_s=0.02)[1]
    np.testing.assert_array_equal(ran.operations[:, -1], price.synaptic_operations)


TOY = """
from spikeloom.runtime.machines.loihi1.machine import Loihi
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist

class Toy(Loihi):
    details = ("counts",)

def machine_of(netlist):
    return Toy(netlist)

def load(path):
    return Toy(read_netlist(path))
"""


def test_a_third_chip_is_a_folder(tmp_path, monkeypatch):
    (tmp_path / "machines" / "toy").mkdir(parents=True)
    (tmp_path / "machines" / "toy" / "machine.py").write_text(TOY)
    (tmp_path / "targets" / "toy").mkdir(parents=True)
    limits = (Path(targets.__path__[0]) / "loihi1" / "chip.toml").read_text("utf-8")
    (tmp_path / "targets" / "toy" / "chip.toml").write_text(limits.replace('"loihi1"', '"toy"'))
    monkeypatch.setattr(targets, "__path__", [*targets.__path__, str(tmp_path / "targets")])
    monkeypatch.setattr(machines, "__path__", [*machines.__path__, str(tmp_path / "machines")])
    shipped.cache_clear()
    try:
        write_netlist(replace(lively(), target="toy"), tmp_path / "net.loom")
        machine = machine_for(tmp_path / "net.loom")
        assert (type(machine).__name__, machine.target.name) == ("Toy", "toy")
        events = (np.random.default_rng(0).random((4, machine.netlist.taxels, 2, 12)) < 0.3).astype(np.uint8)
        np.testing.assert_array_equal(machine.run(events).votes, machine_of(lively()).run(events).votes)
        assert integer_machine(machine).check(events[:1]) == 0
        with pytest.raises(OptionError, match="toy has no such price model; allowed: counts"):
            machine.price(events, bin_s=0.02, detail="cycle")
    finally:
        shipped.cache_clear()
        for name in [name for name in sys.modules if name.startswith("spikeloom.runtime.machines.toy")]:
            del sys.modules[name]
