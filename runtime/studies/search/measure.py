"""The measurement of a candidate: its decisions on the chip, and what a mean inference costs."""

from dataclasses import asdict
from typing import Any

from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.studies.search.results import Costs, NetlistCosts


def decisions(netlist: Any, data: Recordings) -> IntArray:
    """Class of each recording."""
    return machine_of(netlist).run(data.events, lengths=data.lengths).decisions


def measure(machine: Machine, data: Recordings, bin_s: float) -> tuple[IntArray, Costs]:
    """Class of each recording, and the costs of a mean inference."""
    run, price = machine.price(data.held, bin_s=bin_s, lengths=data.lengths)
    return run.decisions, Costs.mean(price.synaptic_operations, price.energy_j, price.time_s)


def measure_netlist(netlist: Any, data: Recordings) -> tuple[IntArray, NetlistCosts]:
    """The same at full speed, whatever the pace of the sensor, and the size of the netlist."""
    decided, costs = measure(machine_of(netlist), data, bin_s=1.0)
    size = {"cores": netlist.n_cores, "neurons": len(netlist.readout_class), "synapses": netlist.n_synapses}
    return decided, NetlistCosts(**asdict(costs), **size)
