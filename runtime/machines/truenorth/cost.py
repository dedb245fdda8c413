"""What a run of crossbar cores costs: synaptic events, spikes, hops, ticks, and energy by two readings.

A *synaptic event* is a set crossing point that a spike on its axon meets. The chip's measured power can be read in two
ways, which are never added up: all of it divided by the events of one workload (26 pJ each, standing power within), or
a price for what an event adds on top of a floor that the whole chip takes for as long as it runs. The first flatters a
network that does little, the second charges it with 4,096 cores of which it uses some; the share of the cores in use
stands beside it. A tick takes its time in full, whatever happens in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.targets.base import EnergyTable, Target
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.runtime.machines.truenorth.trace import Counts
from spikeloom.runtime.report.numbers import si
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text

NOT_PRICED = (
    "injection of input events and clocks, read-out of votes (no public figure per event)",
    "spikes and hops by themselves (both prices are per synaptic event and hold them at the measured workload)",
)
"""Said with every estimate."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Energy:
    """Joules of recordings (samples,) by one reading: of events, and of the chip's floor where no event holds it."""

    events_j: FloatArray
    floor_j: FloatArray | None

    @property
    def total_j(self) -> FloatArray:
        """Joules of each recording."""
        return self.events_j if self.floor_j is None else self.events_j + self.floor_j


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Costs:
    """Costs of recordings."""

    ticks: IntArray  # (samples,) int64
    time_s: FloatArray  # (samples,) float64; at the length of a tick in real time
    # synaptic_events, spikes: (samples, layers) int64; by the layer that receives and that sends
    synaptic_events: IntArray
    spikes: IntArray
    # packets, hops: (samples,) int64; spikes with a target on the chip, and the cores that they pass
    packets: IntArray
    hops: IntArray
    energy: Mapping[str, Energy]


def estimate(netlist: CrossbarNetlist, target: Target, counts: Counts) -> Costs:
    """Count and price a batch of recordings: `counts` has one leading axis."""
    layers = len(netlist.layers)
    into = np.zeros((netlist.n_axons, layers), np.int64)
    np.add.at(into, (netlist.axon_of_synapse(), netlist.layer[netlist.neuron_of_synapse()]), 1)
    member = np.eye(layers, dtype=np.int64)[netlist.layer]
    sent = counts.spikes[:, netlist.wire_neuron]
    events = counts.axons @ into
    time_s: FloatArray = counts.ticks.astype(np.float64) * (target.limit("tick.length") * 1e-6)
    return Costs(
        ticks=counts.ticks,
        time_s=time_s,
        synaptic_events=events,
        spikes=counts.spikes @ member,
        packets=sent.sum(axis=1),
        hops=sent @ netlist.hops(),
        energy={table.name: price(table, events.sum(axis=1), time_s) for table in target.energy},
    )


def price(table: EnergyTable, events: IntArray, time_s: FloatArray) -> Energy:
    """Energy of recordings with so many synaptic events that take so long, both (samples,).

    Examples
    --------
    >>> from spikeloom.compiler.targets.base import load_target
    >>> all_in, marginal = load_target("truenorth").energy
    >>> price(all_in, np.array([1_000_000]), np.array([0.25])).total_j.round(9).tolist()
    [2.6e-05]
    >>> price(marginal, np.array([1_000_000]), np.array([0.25])).total_j.round(7).tolist()
    [0.0161023]
    """
    floor = table.floor_w
    joules: FloatArray = events.astype(np.float64) * table.joule("synaptic_event")
    return Energy(events_j=joules, floor_j=None if floor is None else floor * time_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Amounts:
    """Of one inference."""

    synaptic_events: float
    spikes: float
    packets: float
    hops: float
    ticks: float
    merged_spikes: float
    membranes_saturated: float
    time_s: float
    energy_j: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class LayerCosts:
    """Of a mean inference."""

    name: str
    synaptic_events: float
    spikes: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """Energy of a mean inference by one table."""

    table: str
    title: str
    events_j: float
    floor_j: float | None
    floor_of_used_cores_j: float | None
    total_j: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Seconds of a bin of the sensor, and of a data step on the chip."""

    bin_s: float
    step_s: float
    real_time: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Costs per inference: mean, smallest and largest, by layer and by reading."""

    samples: int
    cores: int
    cores_of_chip: int
    per_inference: Amounts
    min: Amounts
    max: Amounts
    layers: tuple[LayerCosts, ...]
    energy: tuple[Reading, ...]
    pace: Pace
    static_w: Mapping[str, float]
    not_priced: tuple[str, ...] = NOT_PRICED


def summarise(netlist: CrossbarNetlist, chip: Target, costs: Costs, counts: Counts, bin_s: float) -> Outcome:
    """Costs of recordings put together."""

    def amounts(reduce: Callable[[Any], Any]) -> Amounts:
        return Amounts(
            synaptic_events=float(reduce(costs.synaptic_events.sum(axis=1))),
            spikes=float(reduce(costs.spikes.sum(axis=1))),
            packets=float(reduce(costs.packets)),
            hops=float(reduce(costs.hops)),
            ticks=float(reduce(costs.ticks)),
            merged_spikes=float(reduce(counts.merged)),
            membranes_saturated=float(reduce(counts.overflows.sum(axis=1))),
            time_s=float(reduce(costs.time_s)),
            energy_j={name: float(reduce(found.total_j)) for name, found in costs.energy.items()},
        )

    share = netlist.n_cores / chip.limit("chip.cores")
    step_s = netlist.bin_ticks * (chip.limit("tick.length") * 1e-6)
    readings = []
    for table in chip.energy:
        found = costs.energy[table.name]
        floor = None if found.floor_j is None else float(found.floor_j.mean())
        readings.append(
            Reading(
                table=table.name,
                title=table.title,
                events_j=float(found.events_j.mean()),
                floor_j=floor,
                floor_of_used_cores_j=None if floor is None else floor * share,
                total_j=float(found.total_j.mean()),
            )
        )
    layers = zip(netlist.layers, costs.synaptic_events.mean(axis=0), costs.spikes.mean(axis=0), strict=True)
    result = Estimate(
        samples=len(costs.ticks),
        cores=netlist.n_cores,
        cores_of_chip=chip.limit("chip.cores"),
        per_inference=amounts(np.mean),
        min=amounts(np.min),
        max=amounts(np.max),
        layers=tuple(LayerCosts(name, float(events), float(spikes)) for name, events, spikes in layers),
        energy=tuple(readings),
        pace=Pace(bin_s=bin_s, step_s=step_s, real_time=step_s <= bin_s),
        static_w={name: power.value * 1e-3 for name, power in chip.static.items()},
    )
    return Outcome(result, sections)


COUNTED = ("synaptic_events", "spikes", "packets", "hops", "ticks", "merged_spikes", "membranes_saturated")


def sections(found: Estimate) -> list[Section]:
    """The same for people."""
    columns = [found.per_inference, found.min, found.max]
    rows = [[name.replace("_", " "), *(f"{getattr(column, name):,.0f}" for column in columns)] for name in COUNTED]
    rows.append(["time, 1 tick a millisecond", *(si(column.time_s, "s") for column in columns)])
    rows += [
        [f"energy, {name}", *(si(c.energy_j[name], "J") for c in columns)] for name in found.per_inference.energy_j
    ]
    layers = [[layer.name, f"{layer.synaptic_events:,.0f}", f"{layer.spikes:,.0f}"] for layer in found.layers]
    head = f"per inference on {found.cores:,} of {found.cores_of_chip:,} cores, over {found.samples} recordings:"
    pace = found.pace
    lines = [
        *map(_reading_line, found.energy),
        "two readings of one measurement: take one, never their sum",
        f"a data step takes {si(pace.step_s, 's')}: {'keeps' if pace.real_time else 'does not keep'} the sensor's pace "
        f"of {1000 * pace.bin_s:g} ms a step",
        *(f"not priced: {line}" for line in found.not_priced),
    ]
    return [
        Section("Costs", [Text(head), Table(["", "mean", "min", "max"], rows)]),
        Section("Layers", [Table(["layer (mean)", "synaptic events", "spikes"], layers)]),
        Section("Energy", [Text("\n".join(lines))]),
    ]


def _reading_line(reading: Reading) -> str:
    parts = "standing power within the price"
    if reading.floor_j is not None and reading.floor_of_used_cores_j is not None:
        parts = (
            f"{si(reading.events_j, 'J')} for events and {si(reading.floor_j, 'J')} of floor for the whole chip "
            f"({si(reading.floor_of_used_cores_j, 'J')} for the share of the cores in use)"
        )
    return f"{reading.table}: {si(reading.total_j, 'J')}, {parts}; {reading.title}"
