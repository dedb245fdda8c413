"""The page's section on energy and time: a mean inference by layer, part and core, one recording step by step."""

from __future__ import annotations

from typing import Any

from spikeloom.runtime.report import svg
from spikeloom.runtime.report.markup import figure, paragraph, table
from spikeloom.runtime.report.tables import si

Json = dict[str, Any]

EVENTS = ("synaptic_operations", "spikes", "neuron_updates", "packets", "hops")
"""What is counted of each layer."""


def costs(report: Json) -> list[str]:
    """Energy and time of a mean inference, and of the recording step by step."""
    found, own = report["costs"], report["recording"]
    tables = list(found["per_inference"]["energy_j"])
    rows = [
        [key.replace("_", " "), *(f"{found[column][key]:,.0f}" for column in ("per_inference", "min", "max"))]
        for key in found["per_inference"]
        if key != "energy_j"
    ]
    rows += [
        [f"energy, {name}", *(si(found[column]["energy_j"][name], "J") for column in ("per_inference", "min", "max"))]
        for name in tables
    ]
    rows += [
        [f"time, {entry['table']}, {entry['model']} model"]
        + [si(entry["inference_s"][key], "s") for key in ("mean", "min", "max")]
        for entry in found["time"]
    ]
    events = [[layer["name"], *(f"{layer[key]:,.0f}" for key in EVENTS)] for layer in found["layers"]]
    parts = [table(f"An inference, over {found['samples']} recordings", ["", "mean", "least", "most"], rows)]
    if tables:
        parts += [
            "<h3>By layer</h3>",
            _bars(
                "energy-layers",
                "Energy of a mean inference by layer",
                tables,
                {layer["name"]: [layer["energy_j"][name] for name in tables] for layer in found["layers"]},
                "J",
                "Synapses belong to the layer that receives, packets to the layer that sends.",
            ),
            table("Events of a mean inference by layer", ["layer", *(key.replace("_", " ") for key in EVENTS)], events),
            "<h3>By part of the chip</h3>",
            _bars(
                "energy-parts",
                "Energy of a mean inference by part of the chip",
                tables,
                {
                    part: [found["energy_by_part_j"][name][part] for name in tables]
                    for part in next(iter(found["energy_by_part_j"].values()))
                },
                "J",
                "Synapse: visited entries; soma: neuron updates and spikes; network: packets and hops.",
            ),
        ]
    return [*parts, *_by_core(found, own), *_by_step(own["by_step"]), *_left_out(found)]


def _bars(name: str, title: str, series: list[str], rows: dict[str, list[float]], unit: str, caption: str) -> str:
    cells = [[label, *(si(value, unit) for value in values)] for label, values in rows.items()]
    return figure(svg.bars(name, title, rows, series, unit), f"{title}. {caption}", table(title, ["", *series], cells))


def _by_core(found: Json, own: Json) -> list[str]:
    """Time of each core in the mean, and its energy in the recording, which is simulated message by message."""
    parts = []
    if found["time"]:
        first = found["time"][0]["table"]
        waits = {each["core"]: each["share_of_steps"] for each in found["time"][0]["critical_core"]}
        rows = {f"core {core['core']}": [core["sweep_s"][first], core["receive_s"][first]] for core in found["cores"]}
        slowest = ", ".join(f"core {core} in {100 * share:.0f} %" for core, share in waits.items())
        caption = f"Both go on at once; a step lasts as long as the slowest core. That is {slowest} of the steps."
        series = ["sweep and send", "receive"]
        parts.append(_bars("time-cores", "Time of a mean inference by core", series, rows, "s", caption))
    tables = list(own["costs"]["cores"][0]["energy_j"])
    if tables:
        rows = {f"core {core['core']}": [core["energy_j"][name] for name in tables] for core in own["costs"]["cores"]}
        caption = "It is the one that is drawn above, simulated message by message."
        parts.append(_bars("energy-cores", "Energy of this recording by core", tables, rows, "J", caption))
    return ["<h3>By core</h3>", *parts] if parts else []


def _by_step(found: Json) -> list[str]:
    parts = []
    times = found["time_s"] | {f"mean of all, {name}": each for name, each in found["mean_time_s"].items()}
    plots = (
        ("energy-steps", "Energy of each chip step of this recording", found["energy_j"], "J"),
        ("time-steps", "Time of each chip step of this recording", times, "s"),
    )
    for name, title, series, unit in plots:
        if series:
            longest = max(len(values) for values in series.values())
            rows = [
                [str(step), *(si(v[step], unit) if step < len(v) else "" for v in series.values())]
                for step in range(longest)
            ]
            drawn = svg.lines(name, title, series, "chip step", unit)
            parts.append(
                figure(drawn, f"{title}: one line for each table.", table(title, ["chip step", *series], rows))
            )
    return ["<h3>By step</h3>", *parts] if parts else []


def _left_out(found: Json) -> list[str]:
    lines = [f"Not modelled: {line}." for line in found["not_modelled"]]
    lines += [f"Not priced: {line}." for line in found["not_priced"]]
    return [paragraph(line) for line in lines]
