"""What ``estimate`` prints: costs as JSON values for machines and as text for people."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_count
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.costs.cost import NOT_PRICED, Costs
from spikeloom.runtime.costs.estimate import Estimate
from spikeloom.runtime.machines.loihi1.timing import DetailedTimes, SimpleTimes
from spikeloom.runtime.report.tables import si, table

Json = dict[str, Any]


def estimate_json(netlist: Netlist, target: Target, found: Estimate, *, bin_s: float) -> Json:
    """Costs per inference, by part, by layer and by core, and how long an inference takes.

    Parameters
    ----------
    netlist : Netlist
        What ran.
    target : Target
        Its chip.
    found : Estimate
        What it cost.
    bin_s : float
        Seconds of a data step at the pace of the sensor.
    """
    costs, chips = found.costs, chip_count(netlist.core_tile, target)
    per_sample: dict[str, FloatArray] = {
        "synaptic_operations": costs.synaptic_operations,
        "synaptic_operations_on_zeros": costs.zeros,
        "spikes": costs.events["spike"],
        "neuron_updates": costs.events["neuron_active"],
        "neuron_accesses": costs.events["neuron_active"] + costs.events["neuron_idle"],
        "packets": costs.events["packet"],
        "hops": costs.events["hop_east_west"] + costs.events["hop_north_south"],
    }
    if chips > 1:
        per_sample["packets_between_chips"] = costs.between_chips

    def summary(reduce: Any) -> Json:
        values: Json = {key: float(reduce(amount.sum(axis=1))) for key, amount in per_sample.items()}
        return values | {"energy_j": {name: float(reduce(e.sum(axis=1))) for name, e in costs.energy.items()}}

    layers = []
    for index, layer in enumerate(netlist.layers):
        means: Json = {key: float(amount[:, index].mean()) for key, amount in per_sample.items()}
        means["energy_j"] = {name: float(each[:, index].mean()) for name, each in costs.energy.items()}
        layers.append({"name": layer.name} | means)
    return {
        "samples": len(costs.zeros),
        "chip_steps": costs.steps,
        "detail": "cycle" if found.detailed else "counts",
        "per_inference": summary(np.mean),
        "min": summary(np.min),
        "max": summary(np.max),
        "energy_by_part_j": {
            name: {part: float(each.sum(axis=1).mean()) for part, each in parts.items()}
            for name, parts in found.parts.items()
        },
        "energy_range_j": _range_json(costs),
        "layers": layers,
        "cores": _cores_json(netlist, found),
        "time": _times_json(found),
        "pace": _pace_json(found, bin_s),
        "static": [
            {
                "source": name,
                "chip_w": power.value * 1e-3,
                "chips": chips,
                "real_time_j": float((chips * power.value * 1e-3 * found.steps * bin_s).mean()),
                "full_speed_j": [
                    {
                        "time_table": of,
                        "model": model,
                        "energy_j": float((power.value * 1e-3 * times.duration_ns.sum(axis=1) * 1e-9).mean()),
                    }
                    for (of, model), times in _models(found).items()
                ],
            }
            for name, power in target.static.items()
        ],
        "not_modelled": [
            *(f"{name}: no price for {', '.join(events)}" for name, events in costs.unpriced.items()),
            *_between_chips(chips, costs),
        ],
        "not_priced": list(NOT_PRICED),
    }


def _range_json(costs: Costs) -> Json | None:
    """Lowest and highest mean energy of an inference where tables disagree, and whose they are."""
    means = {name: float(each.sum(axis=1).mean()) for name, each in costs.energy.items()}
    if len(means) < 2:
        return None
    ends = {"low": min(means, key=lambda name: means[name]), "high": max(means, key=lambda name: means[name])}
    return {end: {"table": name, "energy_j": means[name]} for end, name in ends.items()}


def _between_chips(chips: int, costs: Costs) -> list[str]:
    """What is not known of a netlist on several chips."""
    if chips == 1:
        return []
    left, sent = (float(amount.sum(axis=1).mean()) for amount in (costs.between_chips, costs.events["packet"]))
    return [
        f"links between the {chips} chips: {left:,.0f} of {sent:,.0f} packets of an inference leave their chip; their "
        "hops and latency are left out, and so are all times (no public figures)"
    ]


def _models(found: Estimate) -> dict[tuple[str, str], SimpleTimes | DetailedTimes]:
    """Times by table and model."""
    models: Json = {"simple": found.simple, "detailed": found.detailed}
    return {(name, model): times for model, each in models.items() for name, times in each.items()}


def _times_json(found: Estimate) -> list[Json]:
    """Seconds of an inference by table and model, what bounds its steps, and, in detail, how congested the mesh is."""
    entries: list[Json] = []
    for (name, model), times in _models(found).items():
        seconds = times.duration_ns.sum(axis=1) * 1e-9
        ran = times.critical_core >= 0
        core, steps = np.unique(times.critical_core[ran], return_counts=True)
        entry: Json = {
            "table": name,
            "model": model,
            "inference_s": {"mean": float(seconds.mean()), "min": float(seconds.min()), "max": float(seconds.max())},
            "step_s": {
                "mean": float(times.duration_ns[ran].mean() * 1e-9),
                "max": float(times.duration_ns.max() * 1e-9),
            },
            "critical_core": [
                {
                    "core": int(c),
                    "share_of_steps": float(n / ran.sum()),
                    "receiving": float(times.receiving[times.critical_core == c].mean()),
                }
                for c, n in sorted(zip(core, steps, strict=True), key=lambda pair: -pair[1])
            ],
        }
        if isinstance(times, DetailedTimes):
            entry["blocked_s"] = float(times.blocked_ns.sum(axis=1).mean() * 1e-9)
            entry["peak_link_load"] = float(times.peak_load.max())
        entries.append(entry)
    return entries


def _pace_json(found: Estimate, bin_s: float) -> Json:
    """Power at the pace of the sensor and at full speed, and the energy-delay product; by energy table."""
    energies = {name: each.sum(axis=1) for name, each in found.costs.energy.items()}
    return {
        "bin_s": bin_s,
        "real_time_w": {name: float((each / (found.steps * bin_s)).mean()) for name, each in energies.items()},
        "full_speed": [
            {
                "energy_table": name,
                "time_table": of,
                "model": model,
                "power_w": float((each / (times.duration_ns.sum(axis=1) * 1e-9)).mean()),
                "energy_delay_js": float((each * times.duration_ns.sum(axis=1) * 1e-9).mean()),
            }
            for (of, model), times in _models(found).items()
            for name, each in energies.items()
        ],
    }


def _cores_json(netlist: Netlist, found: Estimate) -> list[Json]:
    """Energy and time of each core, as far as they were asked for."""
    core = netlist.core_of_compartment()
    entries: list[Json] = []
    for k in range(netlist.n_cores):
        held = np.unique(netlist.layer[core == k])
        entries.append(
            {
                "core": k,
                "tile": int(netlist.core_tile[k]),
                "layers": [netlist.layers[i].name for i in held],
                "sweep_s": {name: float(t.generation_ns[:, k].mean() * 1e-9) for name, t in found.simple.items()},
                "receive_s": {name: float(t.processing_ns[:, k].mean() * 1e-9) for name, t in found.simple.items()},
                "energy_j": {name: float(each[:, k].mean()) for name, each in found.cores.items()},
            }
        )
    return entries


def estimate_text(report: Json) -> str:
    """Costs for people: the mean inference and its range, where energy and time go."""
    columns = [report["per_inference"], report["min"], report["max"]]
    rows = [
        [key.replace("_", " "), *(f"{column[key]:,.0f}" for column in columns)]
        for key in columns[0]
        if key != "energy_j"
    ]
    tables = list(columns[0]["energy_j"])
    rows += [[f"energy, {name}", *(si(c["energy_j"][name], "J") for c in columns)] for name in tables]
    rows += [
        [
            f"time, {entry['table']}, {entry['model']} model",
            *(si(entry["inference_s"][key], "s") for key in ("mean", "min", "max")),
        ]
        for entry in report["time"]
    ]
    layers = [
        [
            layer["name"],
            *(f"{layer[key]:,.0f}" for key in ("synaptic_operations", "spikes", "neuron_updates")),
            *(si(layer["energy_j"][name], "J") for name in tables),
        ]
        for layer in report["layers"]
    ]
    parts = [
        [name, *(si(value, "J") for value in found.values())] for name, found in report["energy_by_part_j"].items()
    ]
    lines = [
        f"per inference of {report['chip_steps']} chip steps, over {report['samples']} recordings:",
        table(["", "mean", "min", "max"], rows),
        "",
        table(["layer (mean)", "synaptic operations", "spikes", "neuron updates", *tables], layers),
        "",
    ]
    if parts:
        lines += [table(["energy by part", *next(iter(report["energy_by_part_j"].values()))], parts), ""]
    lines += [_cores_text(report), ""] if report["time"] else []
    lines += _pace_lines(report)
    lines += [f"not modelled: {line}" for line in report["not_modelled"]]
    lines += [f"not priced: {line}" for line in report["not_priced"]]
    return "\n".join(lines)


def _cores_text(report: Json) -> str:
    """What each core does, and in how many steps the others wait for it."""
    critical = {
        (entry["model"], found["core"]): found["share_of_steps"]
        for entry in report["time"]
        for found in entry["critical_core"]
    }
    models = [entry["model"] for entry in report["time"]]
    head = ["core", "layers", "sweep and send", "receive", *(f"slowest, {model}" for model in models)]
    energies = list(report["cores"][0]["energy_j"]) if report["cores"] else []
    rows = [
        [
            str(core["core"]),
            " ".join(core["layers"]),
            *(si(next(iter(core[key].values()), 0.0), "s") for key in ("sweep_s", "receive_s")),
            *(f"{100 * critical.get((model, core['core']), 0):.0f} %" for model in models),
            *(si(core["energy_j"][name], "J") for name in energies),
        ]
        for core in report["cores"]
    ]
    return table([*head, *energies], rows)


def _pace_lines(report: Json) -> list[str]:
    pace, ends = report["pace"], report["energy_range_j"]
    realtime = ", ".join(f"{si(value, 'W')} ({name})" for name, value in pace["real_time_w"].items())
    lines = []
    if ends is not None:
        low, high = (f"{si(ends[end]['energy_j'], 'J')} ({ends[end]['table']})" for end in ("low", "high"))
        lines.append(f"sources differ: a mean inference takes {low} to {high}")
    lines += [f"dynamic power at the sensor's pace, {1000 * pace['bin_s']:g} ms a step: {realtime}"]
    lines += [
        f"at full speed ({entry['time_table']}, {entry['model']} model): {si(entry['power_w'], 'W')}, energy-delay "
        f"product {si(entry['energy_delay_js'], 'J s')} ({entry['energy_table']})"
        for entry in pace["full_speed"]
    ]
    for entry in report["time"]:
        if entry["model"] == "detailed":
            lines.append(
                f"mesh ({entry['table']}): senders blocked for {si(entry['blocked_s'], 's')} an inference; at most "
                f"{entry['peak_link_load']:.1f} messages on a link"
            )
    for static in report["static"]:
        full = ", ".join(f"{si(e['energy_j'], 'J')} ({e['time_table']}, {e['model']})" for e in static["full_speed_j"])
        lines.append(
            f"static, not in the above: {si(static['chip_w'], 'W')} a chip ({static['source']}), so an inference "
            f"{'' if static['chips'] == 1 else 'on {} chips '.format(static['chips'])}takes "
            f"{si(static['real_time_j'], 'J')} at the sensor's pace" + (f", at full speed {full}" if full else "")
        )
    return lines
