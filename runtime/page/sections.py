"""Sections of the page, each from its own part of the report: HTML with figures, and a table behind every figure."""

from __future__ import annotations

from typing import Any

from spikeloom.runtime.equivalence.divergence import Divergence
from spikeloom.runtime.equivalence.sections import divergence_text
from spikeloom.runtime.page import figures as report_figures
from spikeloom.runtime.page.text import confusions, sender, trace_spikes, trace_title
from spikeloom.runtime.page.traces import drawn, membranes, raster
from spikeloom.runtime.report import svg
from spikeloom.runtime.report.markup import facts, figure, paragraph, table, unfold
from spikeloom.runtime.report.tables import percent, si

Json = dict[str, Any]

RUNGS = {
    "float64": "float64 instead of float32",
    "beta": "+ decay of 12 bits",
    "weights": "+ weights as stored",
    "bias_threshold": "+ biases and thresholds",
    "rounding": "+ rounding of membranes",
    "saturation": "+ registers that saturate: the chip",
}
"""Rungs of the ladder in words."""

LISTED = 200
"""Differing spikes of a layer that a table lists; ``--json`` has them all."""


# -- verdict -----------------------------------------------------------------------------------------------------------


def verdict(report: Json) -> list[str]:
    """Levels, breakdowns, the ladder and what is certain."""
    found, costs = report["verify"], report["costs"]
    samples = found["samples"]
    energy = costs["per_inference"]["energy_j"]
    right = {side: round(share * samples) for side, share in found["accuracy"].items()}
    equal = round(found["decision_agreement"] * samples)
    times = [entry for entry in costs["time"] if entry["model"] == "simple"]
    cards = {f"{side} accuracy": _split(percent(count, samples)) for side, count in right.items()}
    cards["decisions equal"] = f"{equal} of {samples}", "chip and float model"
    cards["specification = engine"] = (
        "yes" if found["spec_equals_engine"] else "NO",
        f"every spike, membrane and count of {found['spec_samples']} recordings",
    )
    if energy:
        ends = sorted(energy.items(), key=lambda entry: entry[1])
        shown = dict.fromkeys(si(value, "J") for _, value in ends)
        cards["energy an inference"] = (
            " … ".join(dict.fromkeys([next(iter(shown)), list(shown)[-1]])),
            ", ".join(energy),
        )
    if times:
        mean = times[0]["inference_s"]["mean"]
        cards["time an inference"] = si(mean, "s"), f"at full speed, {times[0]['table']}, simple model"
    cards["cores"] = f"{report['netlist']['cores']}", f"{report['netlist']['compartments']:,} neurons on the chip"
    first = found["first_divergence"]
    levels = [
        [level["name"], "–" if level["share"] is None else f"{100 * level['share']:.2f}\xa0%", level["text"]]
        for level in found["levels"]
    ]
    names = list(found["spikes"])
    rungs = {rung["stage"]: [rung["different"][name] for name in names] for rung in found["ladder"]}
    ladder = table(
        "Spikes that differ from the float32 model, with one deviation more on each rung",
        ["rung", *names],
        [[RUNGS.get(stage, stage), *(f"{count:,}" for count in counts)] for stage, counts in rungs.items()],
    )
    spikes = [
        [name, *(f"{layer[key]:,}" for key in ("float", "chip", "different", "ill_posed"))]
        for name, layer in found["spikes"].items()
    ]
    certified = found["certificate"]
    proof = [
        [name, *(f"{layer[key]:,}" for key in ("entries", "equal", "different", "undecided"))]
        for name, layer in certified["layers"].items()
    ]
    overflow = ", ".join(certified["unproven"])
    return [
        facts(cards),
        table("Levels of equivalence", ["level", "reached", "what was found"], levels, left=True),
        *(paragraph(f"Breakdown: {breakdown['text']}") for breakdown in found["breakdowns"]),
        paragraph(
            "No spike differs." if first is None else f"First divergence: {divergence_text(Divergence(**first))}."
        ),
        "<h3>Equivalence ladder</h3>",
        figure(
            svg.bars(
                "ladder",
                "Spikes that differ from the float32 model, rung by rung",
                {RUNGS.get(stage, stage): [float(sum(counts))] for stage, counts in rungs.items()},
                ["differing spikes"],
                "",
                left=230,
            ),
            "Which deviation costs how many spikes: each rung adds one to those above, the last is the chip.",
            ladder,
        ),
        table("Spikes over all recordings", ["layer", "float", "chip", "different", "ill-posed"], spikes),
        table("Certified in any order of sums", ["layer", "entries", "equal", "different", "undecided"], proof),
        paragraph(
            f"{certified['decisions']} of {certified['samples']} decisions are certified equal. "
            + (
                f"Some input may overflow a register of {overflow}."
                if overflow
                else "No register overflows for any input."
            )
        ),
    ]


def _split(text: str) -> tuple[str, str]:
    value, _, note = text.partition(" (")
    return value, note.removesuffix(")")


# -- decisions ---------------------------------------------------------------------------------------------------------


def decisions(report: Json) -> list[str]:
    """Confusion matrices."""
    found = report["decisions"]
    wrong = [[f"{label} as {decided}", str(ours), str(chip)] for label, decided, ours, chip in confusions(found)]
    matrices = found["matrices"]
    classes = [
        [str(k), str(sum(matrices["float"][k])), str(matrices["float"][k][k]), str(matrices["chip"][k][k])]
        for k in range(found["classes"])
        if sum(matrices["float"][k])
    ]
    moved = [
        [file, str(label), str(ours), str(chip)]
        for file, label, ours, chip in zip(found["files"], found["labels"], found["float"], found["chip"], strict=True)
        if ours != chip
    ]
    numbers = table("Right decisions by class", ["class", "recordings", "float", "chip"], classes)
    if wrong:
        numbers += table("Wrong decisions", ["label decided as", "float", "chip"], wrong)
    parts = [
        figure(
            report_figures.confusion(found),
            "Rows are labels, columns decisions; right ones lie on the diagonal, the others are of another colour.",
            numbers,
        )
    ]
    if moved:
        head = ["recording", "label", "float model", "chip"]
        return [*parts, table("Recordings that the two decide differently", head, moved)]
    return [*parts, paragraph("The two decide every recording alike.")]


# -- cores -------------------------------------------------------------------------------------------------------------


def cores(report: Json) -> list[str]:
    """Map of the mesh, fill and traffic."""
    found = report["cores"]
    limits = list(dict.fromkeys(name for core in found["cores"] for name in core["fill"]))
    fill = [
        [str(core["core"]), str(core["tile"]), " ".join(core["layers"])]
        + [f"{core['fill'][name]['used']:,} ({100 * core['fill'][name]['share']:.0f} %)" for name in limits]
        for core in found["cores"]
    ]
    ways = [
        [
            sender(way),
            str(way["to"]),
            f"{way['packets']:,.0f}",
            f"{way['axons']:,}",
            "" if way["hops"] is None else str(way["hops"]),
        ]
        for way in found["traffic"]
    ]
    short = [name.removeprefix("core.").replace("_", " ") for name in limits]
    mesh, tiles = found["mesh"], len({core["tile"] for core in found["cores"]})
    chips = len({core["chip"] for core in found["cores"]})
    return [
        paragraph(
            f"Cores: {len(found['cores'])}, on {tiles} of {chips * mesh['width'] * mesh['height']} tiles (a chip has "
            f"{mesh['width']} by {mesh['height']}, of {mesh['tile_cores']} cores each); only the used part is drawn."
        ),
        figure(
            report_figures.core_map(found),
            "A core is filled as far as the fullest of its compartments, synaptic memory and axons; lines are packets "
            "in a mean recording.",
            table("What each core uses of each limit", ["core", "tile", "layers", *short], fill)
            + table("Packets in a mean recording", ["from core", "to core", "packets", "axons", "hops"], ways),
        ),
    ]


# -- taxels ------------------------------------------------------------------------------------------------------------


def taxels(report: Json) -> list[str]:
    """The sensor, its graph and its activity."""
    found = report["taxels"]
    neighbours = [len({b for a, b in found["edges"] if a == taxel}) for taxel in range(len(found["events"]))]
    head = ["taxel", "neighbours", "input events"]
    rows = [[str(i), str(near), f"{found['events'][i]:,.1f}"] for i, near in enumerate(neighbours)]
    if found["spikes"] is not None:
        head.append(f"{found['layer']} spikes on the chip")
        rows = [[*row, f"{value:,.1f}"] for row, value in zip(rows, found["spikes"], strict=True)]
    sensor = f"{found['sensor'] or 'Sensor'}: {len(rows)} taxels"
    graph = "no taxel graph" if found["graph"] is None else f"graph {found['graph']} with {len(found['edges'])} edges"
    where = "" if found["positions_mm"] else " Their positions are not known, so they are drawn on a circle."
    title = "Activity of each taxel in a mean recording"
    if len(rows) > report_figures.DETAILED:
        order = sorted(range(len(rows)), key=lambda taxel: -found["events"][taxel])[: report_figures.DETAILED]
        rows, title = [rows[taxel] for taxel in order], f"Activity of the {len(order):,} busiest taxels"
    return [
        paragraph(f"{sensor}, {graph}.{where}"),
        figure(
            report_figures.fingertip(found),
            "Discs grow with what a taxel sends"
            + (", and with what its first-layer neurons fire." if found["spikes"] is not None else "."),
            table(title, head, rows),
        ),
    ]


# -- one recording -----------------------------------------------------------------------------------------------------


def recording(report: Json) -> list[str]:
    """Rasters of both sides, membranes where they part."""
    found = report["recording"]
    decided, steps = found["decision"], found["steps"]
    votes = [
        [str(k), str(ours), str(chip)]
        for k, (ours, chip) in enumerate(zip(found["votes"]["float"], found["votes"]["chip"], strict=True))
        if ours or chip
    ]
    counts = [
        [layer["name"], f"{len(layer['active']):,} of {layer['neurons']:,}"]
        + [f"{layer[key]:,}" for key in ("float_spikes", "chip_spikes", "different")]
        for layer in found["layers"]
    ]
    sent = {"name": "input", "both": found["input"], "float_only": [], "chip_only": [], "different": 0}
    sent |= {"active": sorted({channel for _, channel in found["input"]})}
    layers = [sent, *found["layers"]]
    shown = next((layer["name"] for layer in found["layers"] if layer["different"]), found["layers"][0]["name"])
    options = "".join(
        f"<option{' selected' if layer['name'] == shown else ''}>{layer['name']}</option>" for layer in layers
    )
    return [
        paragraph(
            f"{found['file']}, {steps} steps: label {found['label']}, decided {decided['float']} by the float model "
            f"and {decided['chip']} by the chip. Choose another with --recording."
        ),
        table("Spikes by layer", ["layer", "neurons that fire", "float", "chip", "different"], counts),
        unfold("Votes", table("Votes", ["class", "float", "chip"], votes)) if votes else paragraph("Nobody votes."),
        "<h3>Spikes</h3>",
        f'<label class="choose">Layer <select id="layer">{options}</select></label>',
        *(_raster(layer, steps) for layer in layers),
        "<h3>Membranes</h3>",
        figure(
            membranes(found["membranes"]),
            "Membranes before the reset, in the float model's units, around the first spike of each layer that "
            "differs, which is shaded. Where no spike differs: of the neuron whose membranes lie furthest apart.",
            "".join(_trace(trace) for trace in found["membranes"]),
        ),
    ]


def _raster(layer: Json, steps: int) -> str:
    channels = "channels with an event" if layer["name"] == "input" else "neurons that fire on either side"
    all_or_some = f"{len(drawn(layer)):,} of " if len(drawn(layer)) < len(layer["active"]) else ""
    caption = f"{layer['name']}: rows are {all_or_some}the {len(layer['active']):,} {channels}, in order."
    entries = sorted((step, neuron, side) for side in ("float", "chip") for step, neuron in layer[f"{side}_only"])
    rows = [[str(step), str(neuron), f"{side} only"] for step, neuron, side in entries[:LISTED]]
    title = f"{layer['name']}: spikes of one side only"
    title += f", the first {LISTED:,} of {len(entries):,} (--json has all)" if len(entries) > LISTED else ""
    numbers = table(title, ["step", "neuron", "fires"], rows) if rows else ""
    return figure(raster(f"raster-{layer['name']}", layer, steps), caption, numbers, raster=layer["name"])


def _trace(trace: Json) -> str:
    rows = [
        [str(trace["first_step"] + i), f"{ours:.6f}", f"{chip:.6f}", trace_spikes(trace, trace["first_step"] + i)]
        for i, (ours, chip) in enumerate(zip(trace["float"], trace["chip"], strict=True))
    ]
    title = f"{trace_title(trace)}; threshold {trace['theta']:g}, on the chip {trace['chip_theta']:.6f}"
    return table(title, ["step", "float membrane", "chip membrane", "fires"], rows)
