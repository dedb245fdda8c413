"""Networks of crossbar cores and their costs, as JSON values for machines and as text for people."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.runtime.machines.truenorth.cost import NOT_PRICED, Costs
from spikeloom.runtime.machines.truenorth.trace import Counts
from spikeloom.runtime.report.tables import si, table

Json = dict[str, Any]


def netlist_json(netlist: CrossbarNetlist, chip: Target, sha256: str) -> Json:
    """What a network is: sizes, layers, the fullest core by each limit."""
    core, degree = netlist.core_of_neuron(), np.diff(netlist.axon_synapses)
    fan_in = np.bincount(netlist.neuron_of_synapse(), minlength=netlist.n_neurons)
    fullest = {
        "core.neurons": np.diff(netlist.core_neurons),
        "core.axons": np.diff(netlist.core_axons),
        "neuron.delay": netlist.wire_delay,
        "chip.cores": np.array([netlist.n_cores]),
    }
    return {
        "target": netlist.target,
        "taxels": netlist.taxels,
        "classes": netlist.classes,
        **({"clocks": asdict(netlist.clocks)} if netlist.clocks.channels else {}),
        "ticks_per_step": netlist.bin_ticks,
        "drain_ticks": netlist.drain,
        "neurons": netlist.n_neurons,
        "axons": netlist.n_axons,
        "crossing_points": netlist.n_synapses,
        "feeds": len(netlist.feed_channel),
        "tick_clocks": len(netlist.clock_core),
        "wires": len(netlist.wire_neuron),
        "cores": netlist.n_cores,
        "layers": [
            {
                "name": name,
                "neurons": int(np.count_nonzero(netlist.layer == index)),
                "distinct": len(np.unique(netlist.neuron[netlist.layer == index])),
                "max_fan_in": int(fan_in[netlist.layer == index].max(initial=0)),
                "cores": len(np.unique(core[netlist.layer == index])),
            }
            for index, name in enumerate(netlist.layers)
        ],
        "limits": [
            {"name": rule, "used": int(used.max(initial=0)), "allowed": chip.limit(rule)}
            for rule, used in fullest.items()
        ],
        "max_crossing_points_of_an_axon": int(degree.max(initial=0)),
        "provenance": dict(netlist.provenance),
        "sha256": sha256,
    }


def netlist_text(report: Json) -> str:
    """The same for people."""
    ticks = report["ticks_per_step"]
    rows = [
        [layer["name"], *(f"{layer[key]:,}" for key in ("neurons", "distinct", "max_fan_in", "cores"))]
        for layer in report["layers"]
    ]
    limits = [
        [
            limit["name"],
            f"{limit['used']:,}",
            f"{limit['allowed']:,}",
            f"{100 * limit['used'] / limit['allowed']:.0f} %",
        ]
        for limit in report["limits"]
    ]
    return "\n".join(
        [
            f"{report['target']}: {report['neurons']:,} neurons, {report['axons']:,} axons, "
            f"{report['crossing_points']:,} crossing points, {report['cores']:,} cores; "
            f"{ticks} tick{'s' * (ticks > 1)} a data step, {report['drain_ticks']} more to drain",
            table(["layer", "neurons", "distinct", "fan-in", "cores"], rows),
            "",
            table(["limit", "used", "allowed", "fill"], limits),
        ]
    )


def costs_json(netlist: CrossbarNetlist, chip: Target, costs: Costs, counts: Counts, bin_s: float) -> Json:
    """Costs per inference: mean, smallest and largest, by layer and by reading."""
    amounts = {
        "synaptic_events": costs.synaptic_events.sum(axis=1),
        "spikes": costs.spikes.sum(axis=1),
        "packets": costs.packets,
        "hops": costs.hops,
        "ticks": costs.ticks,
        "merged_spikes": counts.merged,
        "membranes_saturated": counts.overflows.sum(axis=1),
    }

    def summary(reduce: Any) -> Json:
        values: Json = {name: float(reduce(amount)) for name, amount in amounts.items()}
        energy = {name: float(reduce(found.total_j)) for name, found in costs.energy.items()}
        return values | {"time_s": float(reduce(costs.time_s)), "energy_j": energy}

    share = netlist.n_cores / chip.limit("chip.cores")
    tick_s = chip.limit("tick.length") * 1e-6
    readings = []
    for prices in chip.energy:
        found = costs.energy[prices.name]
        floor = None if found.floor_j is None else float(found.floor_j.mean())
        readings.append(
            {
                "table": prices.name,
                "title": prices.title,
                "events_j": float(found.events_j.mean()),
                "floor_j": floor,
                "floor_of_used_cores_j": None if floor is None else floor * share,
                "total_j": float(found.total_j.mean()),
            }
        )
    return {
        "samples": len(costs.ticks),
        "cores": netlist.n_cores,
        "cores_of_chip": chip.limit("chip.cores"),
        "per_inference": summary(np.mean),
        "min": summary(np.min),
        "max": summary(np.max),
        "layers": [
            {
                "name": name,
                "synaptic_events": float(costs.synaptic_events[:, index].mean()),
                "spikes": float(costs.spikes[:, index].mean()),
            }
            for index, name in enumerate(netlist.layers)
        ],
        "energy": readings,
        "pace": {
            "bin_s": bin_s,
            "step_s": netlist.bin_ticks * tick_s,
            "real_time": netlist.bin_ticks * tick_s <= bin_s,
        },
        "static_w": {name: power.value * 1e-3 for name, power in chip.static.items()},
        "not_priced": list(NOT_PRICED),
    }


def costs_text(report: Json) -> str:
    """The same for people."""
    columns = [report["per_inference"], report["min"], report["max"]]
    rows = [
        [key.replace("_", " "), *(f"{column[key]:,.0f}" for column in columns)]
        for key in columns[0]
        if key not in ("energy_j", "time_s")
    ]
    rows.append(["time, 1 tick a millisecond", *(si(column["time_s"], "s") for column in columns)])
    rows += [[f"energy, {name}", *(si(c["energy_j"][name], "J") for c in columns)] for name in columns[0]["energy_j"]]
    layers = [
        [layer["name"], f"{layer['synaptic_events']:,.0f}", f"{layer['spikes']:,.0f}"] for layer in report["layers"]
    ]
    pace = report["pace"]
    lines = [
        f"per inference on {report['cores']:,} of {report['cores_of_chip']:,} cores, "
        f"over {report['samples']} recordings:",
        table(["", "mean", "min", "max"], rows),
        "",
        table(["layer (mean)", "synaptic events", "spikes"], layers),
        "",
    ]
    for reading in report["energy"]:
        parts = "standing power within the price"
        if reading["floor_j"] is not None:
            parts = (
                f"{si(reading['events_j'], 'J')} for events and {si(reading['floor_j'], 'J')} of floor "
                f"for the whole chip "
                f"({si(reading['floor_of_used_cores_j'], 'J')} for the share of the cores in use)"
            )
        lines.append(f"{reading['table']}: {si(reading['total_j'], 'J')}, {parts}; {reading['title']}")
    lines.append("two readings of one measurement: take one, never their sum")
    speed = "keeps" if pace["real_time"] else "does not keep"
    lines.append(
        f"a data step takes {si(pace['step_s'], 's')}: {speed} the sensor's pace of {1000 * pace['bin_s']:g} ms a step"
    )
    lines += [f"not priced: {line}" for line in report["not_priced"]]
    return "\n".join(lines)
