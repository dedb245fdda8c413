"""Costs of an inference in numbers: by part, layer and core, by table and time model; with what is not known."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.place import chip_count
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import FloatArray
from spikeloom.runtime.machines.injection import Injection, injection
from spikeloom.runtime.machines.loihi1.costs.cost import NOT_PRICED, Costs, by_part
from spikeloom.runtime.machines.loihi1.costs.estimate import Totals
from spikeloom.runtime.machines.loihi1.costs.timing import DetailedSpent, Spent
from spikeloom.runtime.report.encode import HIDDEN, INLINE, OPTIONAL

INPUTS = (
    "times: SANA-FE's own runs send input events from a core; those of a TactileSGNet take up to 3 % (simple) or 25 % "
    "(detailed) longer"
)
"""Said wherever times are; measured by ``benchmarks/agreement.py``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Amounts:
    """Of one inference; the energy is by table."""

    synaptic_operations: float
    synaptic_operations_on_zeros: float
    spikes: float
    neuron_updates: float
    neuron_accesses: float
    packets: float
    hops: float
    packets_between_chips: float | None = field(default=None, metadata=OPTIONAL)
    energy_j: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerCosts:
    """Of a mean inference."""

    name: str
    amounts: Amounts = field(metadata=INLINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoreCosts:
    """Of a mean inference: seconds by time table, and joules by energy table where they are worked out by core."""

    core: int
    tile: int
    layers: tuple[str, ...]
    sweep_s: Mapping[str, float]
    receive_s: Mapping[str, float]
    energy_j: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """The mean inference by the table that makes it cheapest or dearest."""

    table: str
    energy_j: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CriticalCore:
    """A core that others wait for, in which share of the steps, and in which share of these it receives."""

    core: int
    share_of_steps: float
    receiving: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Times:
    """How long inferences and steps take by one table and model; what the detailed model says of the mesh."""

    table: str
    model: str
    inference_s: Mapping[str, float]
    step_s: Mapping[str, float]
    critical_core: tuple[CriticalCore, ...]
    blocked_s: float | None = field(default=None, metadata=OPTIONAL)
    peak_link_load: float | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class FullSpeed:
    """Mean dynamic power and energy-delay product if the chip runs as fast as it can."""

    energy_table: str
    time_table: str
    model: str
    power_w: float
    energy_delay_js: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Mean dynamic power at the pace of the sensor, by energy table, and at full speed."""

    bin_s: float
    real_time_w: Mapping[str, float]
    full_speed: tuple[FullSpeed, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class StaticAtSpeed:
    """Static energy of a mean inference at full speed."""

    time_table: str
    model: str
    energy_j: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Static:
    """Power that flows whatever happens, by one source, and the mean inference's share of it."""

    source: str
    chip_w: float
    chips: int
    real_time_j: float
    full_speed_j: tuple[StaticAtSpeed, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Host:
    """What feeding the chip from outside adds, least and most: to a step, a mean inference, and its energy at rest."""

    step_s: tuple[float, float]
    inference_s: tuple[float, float]
    awake_w: float
    energy_j: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class CostReport:
    """Costs of a batch of recordings.

    The mean inference and, each amount for itself, the extremes; where energy and time go; and what is
    missing from all this. `chip_steps` are those of the longest recording; others may be shorter.
    """

    samples: int
    chip_steps: int
    detail: str
    prices: Mapping[str, str]  # of each energy table, in words
    per_inference: Amounts
    min: Amounts
    max: Amounts
    energy_by_part_j: Mapping[str, Mapping[str, float]]
    energy_range_j: Mapping[str, End] | None
    layers: tuple[LayerCosts, ...]
    cores: tuple[CoreCosts, ...]
    time: tuple[Times, ...]
    pace: Pace
    static: tuple[Static, ...]
    host: Host | None
    injection: Injection
    measured: str
    not_modelled: tuple[str, ...]
    not_priced: tuple[str, ...]
    unequal: bool = field(metadata=HIDDEN)


def cost_report(netlist: Netlist, target: Target, found: Totals, *, bin_s: float) -> CostReport:
    """Sum an estimate up; `bin_s` is the length of a data step in seconds, at the pace of the sensor."""
    costs = found.costs(target)
    core_energies = found.core_energies(target)
    chips = chip_count(netlist.core_tile, target)

    def whole(reduce: Callable[[FloatArray], Any]) -> Amounts:
        return _amounts(costs, chips, lambda amount: float(reduce(amount.sum(axis=1))))

    return CostReport(
        samples=len(costs.zeros),
        chip_steps=costs.steps,
        unequal=bool(np.ptp(found.steps)),
        detail="cycle" if found.detailed else "counts",
        prices={table.name: table.title for table in target.energy},
        per_inference=whole(np.mean),
        min=whole(np.min),
        max=whole(np.max),
        energy_by_part_j={
            name: {part: float(each.sum(axis=1).mean()) for part, each in parts.items()}
            for name, parts in by_part(target, costs.events).items()
        },
        energy_range_j=_energy_range(costs),
        layers=tuple(
            LayerCosts(name=layer.name, amounts=_amounts(costs, chips, _mean_of(i)))
            for i, layer in enumerate(netlist.layers)
        ),
        cores=tuple(_core(netlist, found, core_energies, core) for core in range(netlist.n_cores)),
        time=tuple(_times(table, model, times) for table, model, times in _models(found)),
        pace=_pace(found, costs, bin_s),
        static=tuple(
            Static(
                source=name,
                chip_w=power.value * 1e-3,
                chips=chips,
                real_time_j=float((chips * power.value * 1e-3 * found.steps * bin_s).mean()),
                full_speed_j=tuple(
                    StaticAtSpeed(
                        time_table=table,
                        model=model,
                        energy_j=float((power.value * 1e-3 * times.duration_ns * 1e-9).mean()),
                    )
                    for table, model, times in _models(found)
                ),
            )
            for name, power in target.static.items()
        ),
        host=_host(target, float(found.steps.mean()) + netlist.max_depth, chips),
        injection=injection(target, chips, found.inputs, found.steps, bin_s),
        measured=target.measured,
        not_modelled=(
            *(f"{name}: no price for {', '.join(events)}" for name, events in costs.unpriced.items()),
            *_links(chips, costs),
            *([INPUTS] if found.simple else []),
        ),
        not_priced=tuple(line for line in NOT_PRICED if not (netlist.blank and line.startswith("reset"))),
    )


def _amounts(costs: Costs, chips: int, reduce: Callable[[FloatArray], float]) -> Amounts:
    """Amounts that `reduce` makes of (samples, layers)."""
    events = costs.events
    return Amounts(
        synaptic_operations=reduce(costs.synaptic_operations),
        synaptic_operations_on_zeros=reduce(costs.zeros),
        spikes=reduce(events["spike"]),
        neuron_updates=reduce(events["neuron_active"]),
        neuron_accesses=reduce(events["neuron_active"] + events["neuron_idle"]),
        packets=reduce(events["packet"]),
        hops=reduce(events["hop_east_west"] + events["hop_north_south"]),
        packets_between_chips=reduce(costs.between_chips) if chips > 1 else None,
        energy_j={name: reduce(each) for name, each in costs.energy.items()},
    )


def _mean_of(layer: int) -> Callable[[FloatArray], float]:
    return lambda amount: float(amount[:, layer].mean())


def _energy_range(costs: Costs) -> dict[str, End] | None:
    """How far tables disagree."""
    means = [End(table=name, energy_j=float(each.sum(axis=1).mean())) for name, each in costs.energy.items()]
    if len(means) < 2:
        return None
    return {name: end(means, key=lambda mean: mean.energy_j) for name, end in (("low", min), ("high", max))}


def _links(chips: int, costs: Costs) -> list[str]:
    """What is not known of a netlist on several chips."""
    if chips == 1:
        return []
    left, sent = (
        float(amount.sum(axis=1).mean()) for amount in (costs.between_chips, costs.events["packet"])
    )
    return [
        f"links between the {chips} chips: {left:,.0f} of {sent:,.0f} packets of an inference leave their chip; their "
        "hops and latency are left out, and so are all times (no public figures)"
    ]


def _host(target: Target, steps: float, chips: int) -> Host | None:
    """What a host adds to so many chip steps; None where nobody measured it."""
    if not target.host:
        return None
    least, most = (target.host[name].value * 1e-3 for name in ("step_least", "step_most"))
    awake = chips * target.host["awake"].value * 1e-3
    return Host(
        step_s=(least, most),
        inference_s=(steps * least, steps * most),
        awake_w=awake,
        energy_j=(steps * least * awake, steps * most * awake),
    )


def _models(found: Totals) -> Iterator[tuple[str, str, Spent]]:
    """Table, model and times."""
    for table, simple in found.simple.items():
        yield table, "simple", simple
    for table, detailed in found.detailed.items():
        yield table, "detailed", detailed


def _times(table: str, model: str, times: Spent) -> Times:
    seconds = times.seconds
    steps = times.critical.sum(axis=0)
    receiving = times.receiving.sum(axis=0)
    ran = steps.sum()
    detailed = times if isinstance(times, DetailedSpent) else None
    return Times(
        table=table,
        model=model,
        inference_s={
            "mean": float(seconds.mean()),
            "min": float(seconds.min()),
            "max": float(seconds.max()),
        },
        step_s={
            "mean": float(times.duration_ns.sum() / ran * 1e-9),
            "max": float(times.longest_ns.max() * 1e-9),
        },
        critical_core=tuple(
            CriticalCore(
                core=int(core),
                share_of_steps=float(steps[core] / ran),
                receiving=float(receiving[core] / steps[core]),
            )
            for core in sorted(np.flatnonzero(steps), key=lambda core: -steps[core])
        ),
        blocked_s=None if detailed is None else float(detailed.blocked_ns.mean() * 1e-9),
        peak_link_load=None if detailed is None else float(detailed.peak_load.max()),
    )


def _pace(found: Totals, costs: Costs, bin_s: float) -> Pace:
    energies = {name: each.sum(axis=1) for name, each in costs.energy.items()}
    return Pace(
        bin_s=bin_s,
        real_time_w={name: float((each / (found.steps * bin_s)).mean()) for name, each in energies.items()},
        full_speed=tuple(
            FullSpeed(
                energy_table=name,
                time_table=table,
                model=model,
                power_w=float((each / times.seconds).mean()),
                energy_delay_js=float((each * times.duration_ns * 1e-9).mean()),
            )
            for table, model, times in _models(found)
            for name, each in energies.items()
        ),
    )


def _core(netlist: Netlist, found: Totals, energies: Mapping[str, FloatArray], core: int) -> CoreCosts:
    layers = np.unique(netlist.layer[slice(*netlist.core_compartments[core : core + 2])])
    simple = found.simple.items()
    return CoreCosts(
        core=core,
        tile=int(netlist.core_tile[core]),
        layers=tuple(netlist.layers[i].name for i in layers),
        sweep_s={name: float(times.generation_ns[:, core].mean() * 1e-9) for name, times in simple},
        receive_s={name: float(times.processing_ns[:, core].mean() * 1e-9) for name, times in simple},
        energy_j={name: float(each[:, core].mean()) for name, each in energies.items()},
    )
