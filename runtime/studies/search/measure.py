"""The measurement of a candidate: its decisions on the chip, and what a mean inference costs."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.base import Machine, Price
from spikeloom.runtime.studies.search.results import Costs, NetlistCosts


def decisions(netlist: Any, data: Recordings) -> IntArray:
    """Class of each recording."""
    return machine_of(netlist).run(data.events, lengths=data.lengths).decisions


def measure(machine: Machine, data: Recordings, bin_s: float) -> tuple[IntArray, Costs]:
    """Class of each recording, and the costs of a mean inference; as many recordings at a time as memory holds."""
    size = machine.batch(data.steps)
    parts = [slice(first, first + size) for first in range(0, len(data), size)]
    lengths = data.step_counts
    runs = [machine.price(data.events[part], bin_s=bin_s, lengths=lengths[part]) for part in parts]
    prices = [price for _, price in runs]

    def by_table(of: Callable[[Price], Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
        return {table: np.concatenate([of(price)[table] for price in prices]) for table in of(prices[0])}

    operations = np.concatenate([price.synaptic_operations for price in prices])
    costs = Costs.mean(
        operations, by_table(lambda price: price.energy_j), by_table(lambda price: price.time_s)
    )
    return np.concatenate([run.decisions for run, _ in runs]), costs


def measure_netlist(netlist: Any, data: Recordings) -> tuple[IntArray, NetlistCosts]:
    """The same at full speed, whatever the pace of the sensor, and the size of the netlist."""
    decided, costs = measure(machine_of(netlist), data, bin_s=1.0)
    size = {"cores": netlist.n_cores, "neurons": len(netlist.readout_class), "synapses": netlist.n_synapses}
    return decided, NetlistCosts(**asdict(costs), **size)
