"""What a run of crossbar cores costs: synaptic events, spikes, hops, ticks, and energy by two readings.

A *synaptic event* is a set crossing point that a spike on its axon meets. The chip's measured power can be
read in two ways, which are never added up: all of it divided by the events of one workload (26 pJ each,
standing power within), or a price for what an event adds on top of a floor that the whole chip takes for as
long as it runs. The first flatters a network that does little, the second charges it with 4,096 cores of
which it uses some; the share of the cores in use stands beside it. A tick takes its time in full, whatever
happens in it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.targets.base import EnergyTable, Target
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.types import EventArray, FloatArray, IntArray
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.machines import injection
from spikeloom.runtime.machines.base import PART, Price
from spikeloom.runtime.machines.injection import Injection, input_events
from spikeloom.runtime.machines.truenorth.engine import Engine, simulate
from spikeloom.runtime.machines.truenorth.spec import Trace
from spikeloom.runtime.report.numbers import dominant, si
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text

NOT_PRICED = (
    "read-out of votes (no public figure)",
    "initial membranes, which every neuron takes before each recording (no public figure)",
    "work off the chip: binning of the sensor's events, joining of bins, making of clocks",
    "spikes and hops by themselves (both prices are per synaptic event and hold them at the measured workload)",
)
"""Said with every estimate."""

TICK = "tick"
"""Name of the one time table: every tick takes the same time, whatever happens in it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Amounts:
    """Of one inference: `packets` are spikes with a target on the chip, `hops` the cores that they pass."""

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
    injection: Injection
    not_priced: tuple[str, ...] = NOT_PRICED


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Totals:
    """What is kept of recordings: amounts, input events and data steps, (samples,), and events by layer."""

    counted: Mapping[str, IntArray]
    received: IntArray  # (samples, layers) int64; synaptic events by the layer that receives
    sent: IntArray  # (samples, layers) int64; spikes by the layer that sends
    inputs: IntArray
    steps: IntArray


class Pricing:
    """As :class:`machines.base.Pricing`."""

    def __init__(self, prepared: Engine, chip: Target) -> None:
        self._engine = prepared
        self._chip = chip
        netlist = prepared.netlist
        layers = len(netlist.layers)
        self._points = np.zeros((netlist.n_axons, layers), np.int64)
        np.add.at(self._points, (netlist.axon_of_synapse(), netlist.layer[netlist.neuron_of_synapse()]), 1)
        self._senders = np.eye(layers, dtype=np.int64)[netlist.layer]
        self._hops = netlist.hops()

    def batch(self, steps: int) -> int:  # noqa: ARG002
        """A few: their counts of axons are what fills memory."""
        return PART

    def run(self, channels: EventArray, lengths: IntArray | None) -> tuple[Trace, Totals]:
        """Synaptic events, spikes and ticks."""
        trace = simulate(self._engine, channels, lengths=lengths)
        counts = trace.counts
        steps = (
            np.full(len(channels), channels.shape[-1]) if lengths is None else np.asarray(lengths, np.int64)
        )
        received = counts.axons @ self._points
        sent = counts.spikes @ self._senders
        packets = counts.spikes[:, self._engine.netlist.wire_neuron]
        counted = {
            "synaptic_events": received.sum(axis=1),
            "spikes": sent.sum(axis=1),
            "packets": packets.sum(axis=1),
            "hops": packets @ self._hops,
            "ticks": counts.ticks,
            "merged_spikes": counts.merged,
            "membranes_saturated": counts.overflows.sum(axis=1),
        }
        inputs = input_events(channels, steps)
        return trace, Totals(counted=counted, received=received, sent=sent, inputs=inputs, steps=steps)

    def price(self, totals: Totals, bin_s: float) -> Price:
        """By both readings."""
        return price(self._engine.netlist, self._chip, totals, bin_s)


def price(netlist: CrossbarNetlist, chip: Target, totals: Totals, bin_s: float) -> Price:
    """Price recordings by what was kept of them."""
    counted = totals.counted
    tick_s = chip.limit("tick.length") * 1e-6
    time_s: FloatArray = counted["ticks"].astype(np.float64) * tick_s
    step_s = netlist.bin_ticks * tick_s
    parts = {table.name: joules(table, counted["synaptic_events"], time_s) for table in chip.energy}
    energy = {name: events if floor is None else events + floor for name, (events, floor) in parts.items()}
    # where there is no floor, the price of an event holds standing power, too
    dynamic = {name: events for name, (events, floor) in parts.items() if floor is not None}

    def amounts(reduce: Callable[[Any], Any]) -> Amounts:
        return Amounts(
            **{name: float(reduce(values)) for name, values in counted.items()},
            time_s=float(reduce(time_s)),
            energy_j={name: float(reduce(values)) for name, values in energy.items()},
        )

    by_layer = totals.received.mean(axis=0).tolist(), totals.sent.mean(axis=0).tolist()
    means = zip(netlist.layers, *by_layer, strict=True)
    used = netlist.n_cores / chip.limit("chip.cores")
    result = Estimate(
        samples=len(time_s),
        cores=netlist.n_cores,
        cores_of_chip=chip.limit("chip.cores"),
        per_inference=amounts(np.mean),
        min=amounts(np.min),
        max=amounts(np.max),
        layers=tuple(LayerCosts(*each) for each in means),
        energy=tuple(_reading(table, *parts[table.name], energy[table.name], used) for table in chip.energy),
        pace=Pace(bin_s=bin_s, step_s=step_s, real_time=step_s <= bin_s),
        static_w={name: power.value * 1e-3 for name, power in chip.static.items()},
        injection=injection.injection(chip, 1, totals.inputs, totals.steps, bin_s),
    )
    return Price(
        synaptic_operations=counted["synaptic_events"],
        energy_j=energy,
        time_s={TICK: time_s},
        step_s={TICK: step_s},
        dynamic_j=dynamic or energy,
        static_w=result.static_w,
        outcome=Outcome(result, sections),
    )


def _reading(
    table: EnergyTable, events_j: FloatArray, floor_j: FloatArray | None, total_j: FloatArray, used: float
) -> Reading:
    """Means over recordings, (samples,); `used` is the share of the chip's cores."""
    floor = None if floor_j is None else float(floor_j.mean())
    return Reading(
        table=table.name,
        title=table.title,
        events_j=float(events_j.mean()),
        floor_j=floor,
        floor_of_used_cores_j=None if floor is None else floor * used,
        total_j=float(total_j.mean()),
    )


def joules(table: EnergyTable, events: IntArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Joules of so many synaptic events, (samples,), and of the chip's floor in that time where no event holds it.

    >>> from spikeloom.compiler.targets.base import load_target
    >>> all_in, marginal = load_target("truenorth").energy
    >>> joules(all_in, np.array([1_000_000]), np.array([0.25]))
    (array([2.6e-05]), None)
    >>> joules(marginal, np.array([1_000_000]), np.array([0.25]))
    (array([2.3e-06]), array([0.0161]))
    """
    events_j: FloatArray = events.astype(np.float64) * table.joule("synaptic_event")
    return events_j, None if table.floor_w is None else table.floor_w * time_s


def sections(found: Estimate) -> list[Section]:
    """The same for people."""
    columns = [found.per_inference, found.min, found.max]
    *counted, _, _ = Amounts.__dataclass_fields__
    rows = [
        [name.replace("_", " "), *(f"{getattr(column, name):,.0f}" for column in columns)]
        for name in counted
    ]
    rows.append(["time, 1 tick a millisecond", *(si(column.time_s, "s") for column in columns)])
    rows += [
        [f"energy, {name}", *(si(c.energy_j[name], "J") for c in columns)] for name in columns[0].energy_j
    ]
    rows += injection.rows(found.injection)
    layers = [
        [layer.name, f"{layer.synaptic_events:,.0f}", f"{layer.spikes:,.0f}"] for layer in found.layers
    ]
    over = number(found.samples, "recording")
    head = f"per inference on {found.cores:,} of {found.cores_of_chip:,} cores, over {over}:"
    pace = found.pace
    seconds = found.per_inference.time_s / pace.step_s * pace.bin_s
    static = [f"{si(watts, 'W')} ({name})" for name, watts in found.static_w.items()]
    events = [each.events_j for each in found.energy if each.floor_j is not None]
    lines = [
        *map(_reading_line, found.energy),
        "each prices the whole chip by a measurement of its own: take one, never their sum",
        f"a data step takes {si(pace.step_s, 's')}: {'keeps' if pace.real_time else 'does not keep'} the sensor's pace "
        f"of {1000 * pace.bin_s:g} ms a step",
        f"static power of a chip: {', '.join(static)}",
        injection.line(found.injection),
        *([dominant([watts * seconds for watts in found.static_w.values()], events)] if events else []),
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
