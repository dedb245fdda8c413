"""Machine code checks no index: what calls it does so, once, before it starts."""

import numpy as np
import pytest
import torch
from oracles import refused
from random_networks import chain
from zoo import specimen

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.interpret import float_simulation
from spikeloom.models.networks.layers import spike_linear
from spikeloom.runtime.machines.changes import Past, single
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.changes import kernel
from spikeloom.runtime.machines.loihi1.changes.chip import chip_of
from spikeloom.runtime.machines.loihi1.costs import timing
from spikeloom.runtime.machines.truenorth import engine as crossbars

EVENTS = np.ones((2, 3, 4), np.uint8)


def layers():
    float_simulation(chain(np.ones((3, 4)))).run(np.ones((1, 5, 9), np.bool_))


def training():
    spike_linear(torch.ones(2, 5), torch.ones(4, 3), torch.zeros(3))


def long_recording(simulate, name):
    made = specimen(name)
    netlist = made.machine.netlist
    channels = with_clocks(made.events, netlist.clocks)
    simulate(netlist, channels, lengths=np.full(len(channels), channels.shape[2] + 1))


def known_run(*, channels=0):
    netlist = specimen("counters").machine.netlist
    chip = chip_of(netlist)
    return chip, kernel.known_run(chip, np.ones((netlist.n_inputs + channels, 5), np.uint8))


def flipped(channel, step):
    chip, known = known_run()
    kernel.effects(chip, known, 3, single(np.array([[channel, step]])))


def timed(**more):
    machine = specimen("tactilesgnet").machine
    netlist = machine.netlist
    tables = timing.prepare(netlist, machine.target, machine.target.time[0])
    sizes = {"compartments": netlist.n_compartments, "channels": netlist.n_inputs, "steps": 6}
    sizes = {name: size + more.get(name, 0) for name, size in sizes.items()}
    spikes = np.zeros((1, 6, sizes["compartments"]), np.bool_)
    events = np.zeros((1, sizes["channels"], 4), np.uint8)
    timing.detailed(tables, spikes, spikes, events, steps=np.array([sizes["steps"]]))


def grouped(*, steps=5, decision=0, step=0, single=False):
    machine = specimen("counters").machine
    channels = np.ones((machine.netlist.n_inputs, 5), np.uint8)
    machine.groups(channels, steps, decision, 1).after(Past(1, single), step)


OUTSIDE = {
    "a spike of a source that a layer does not know": layers,
    "an input of a layer that is trained": training,
    "a step after the end on Loihi": lambda: long_recording(engine.simulate, "counters"),
    "a step after the end on TrueNorth": lambda: long_recording(crossbars.simulate, "native"),
    "an input channel of a known run": lambda: known_run(channels=1),
    "a channel that is flipped": lambda: flipped(9999, 0),
    "a step that is flipped": lambda: flipped(0, 5),
    "a compartment that is timed": lambda: timed(compartments=1),
    "a channel that is timed": lambda: timed(channels=1),
    "a chip step that is timed": lambda: timed(steps=1),
    "a step that events are changed in": lambda: grouped(steps=6),
    "a class that is decided": lambda: grouped(decision=99),
    "a step of a group": lambda: grouped(step=5),
    "a step of the group before": lambda: grouped(single=True),
}


@pytest.mark.parametrize("call", OUTSIDE.values(), ids=OUTSIDE)
def test_an_index_outside_is_refused_before_machine_code_runs(call):
    refused(IndexError, "allowed are 0", call)


def test_indices_inside_are_taken():
    flipped(0, 4)
    timed()
    grouped()
