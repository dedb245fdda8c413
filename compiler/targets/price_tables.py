"""What events cost and how long they take: tables of prices and latencies, and the numbers they are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

PRICE_UNIT = "pJ"
POWER_UNIT = "mW"
TIME_UNIT = "ns"
PICOSECONDS = 1000
"""In a TIME_UNIT; finer latencies are rounded."""

EVENTS = (
    *("synaptic_operation", "synaptic_operation_dense", "synaptic_operation_sparse", "neuron_idle", "neuron_active"),
    *("spike", "packet", "hop_east_west", "hop_north_south"),
)
"""What an energy table may price."""

FLOOR = "floor"
"""Power of a chip that events come on top of; a table without it has it in its prices."""

CROSSBAR_EVENTS = ("synaptic_event", FLOOR)
"""The same for crossbars: a synaptic event is a set crossing point that a spike on its axon meets."""

LINK_BUFFER = "link_buffer"

LATENCIES = (
    *("neuron_access", "neuron_update", "spike", "axon_out", "axon_in"),
    *("synaptic_operation_dense", "synaptic_operation_sparse", "hop_east_west", "hop_north_south"),
)
"""What a time table must give in nanoseconds, beside ``link_buffer`` and ``barrier.N``, the barrier from N used tiles
on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """One number of a target, with its unit and where it was read."""

    value: float
    unit: str
    source: str
    confidence: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EnergyTable:
    """Prices per event in joules; an event without an entry is unknown to this table."""

    name: str
    title: str
    prices: Mapping[str, Quantity]

    def joule(self, event: str) -> float:
        """Price of one `event` in joules; KeyError if the table does not know it."""
        return self.prices[event].value * 1e-12  # PRICE_UNIT

    @property
    def floor_w(self) -> float | None:
        """Watt of a chip beside the events, or None where the prices hold it."""
        return self.prices[FLOOR].value * 1e-3 if FLOOR in self.prices else None  # POWER_UNIT


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeTable:
    """Latencies per event; all are whole picoseconds, so that sums of them are exact."""

    # name, title: For humans
    name: str
    title: str
    latencies: Mapping[str, Quantity]  # Of each of ``LATENCIES``
    # Length of the barrier that ends a step, by the least number of used tiles that it holds for
    barriers: Mapping[int, Quantity]
    link_buffer: Quantity  # Messages that a link of the mesh holds

    def picoseconds(self, event: str) -> int:
        """Latency of one `event`."""
        return round(self.latencies[event].value * PICOSECONDS)

    def barrier(self, tiles: int) -> int:
        """Picoseconds of the barrier among so many used tiles, at least one.

        Examples
        --------
        >>> from spikeloom.compiler.targets.base import load_target
        >>> [load_target("loihi1").time[0].barrier(tiles) for tiles in (1, 3, 4, 32)]
        [600000, 1000000, 1400000, 1800000]
        """
        return round(self.barriers[max(least for least in self.barriers if least <= tiles)].value * PICOSECONDS)
