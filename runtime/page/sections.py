"""The page of a network: chapters with figures, each table laid out once for page and terminal."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from spikeloom.runtime.equivalence.sections import ladder_table
from spikeloom.runtime.equivalence.sections import sections as verdict_sections
from spikeloom.runtime.page import pictures
from spikeloom.runtime.page.provenance import Provenance
from spikeloom.runtime.page.recording import LayerRaster, Recording, Trace
from spikeloom.runtime.page.results import Report
from spikeloom.runtime.report import drawing
from spikeloom.runtime.report.drawing import Drawing, bar_figure
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Block, Code, Details, Facts, Figure, Outcome, Section, Table, Text
from spikeloom.runtime.studies.chart.sections import figures, saved, taken
from spikeloom.runtime.studies.stress.sections import stability

LISTED = 10
"""Rows that a terminal shows of a table that is sorted by weight."""

SPIKES = 200
"""Differing spikes of a layer that a table lists; ``--json`` has them all."""

ROWS = 3000
"""Rows of a raster, at most; a screen shows fewer."""

STAGES = {
    "float64": "float64 instead of float32",
    "beta": "+ decay of 12 bits",
    "weights": "+ weights as stored",
    "bias_threshold": "+ biases and thresholds",
    "rounding": "+ rounding of membranes",
    "saturation": "+ registers that saturate: the chip",
}
"""Rungs of the ladder in words."""


def sections(report: Report) -> list[Section]:
    """Chapters of the page."""
    chart = report.chart  # of this network and others
    chapters = [
        Section("Verdict", _verdict(report)),
        Section("Decisions", _decisions(report)),
        Section("Cores", [*_of_chip(report.described), *_cores(report)]),
        Section("Taxels", _taxels(report)),
        Section("One recording", _recording(report.recording)),
        Section("Energy and time", [*_of_chip(report.chip.costs), *_by_step(report.recording)]),
        Section("Stability", [] if report.stress is None else stability(report.stress)),
        Section("Configurations", [] if chart is None else [*figures(chart, "pareto"), *taken(chart), saved(chart)]),
        Section("Provenance", _provenance(report.provenance)),
    ]
    return [Section(each.title, each.blocks, chapter=True) for each in chapters if each.blocks]


def _of_chip(outcome: Outcome) -> Iterable[Block]:
    """What the chip says of itself, in its layout."""
    return outcome.sections(outcome.result)


def about(report: Report) -> str:
    """The page in a sentence."""
    net, origin = report.netlist, report.provenance.checkpoint
    graph = f", graph {origin.graph}" if report.taxels.graph else ""
    return (
        f"A {origin.system or 'network'}{graph}: {net.neurons:,} neurons and {net.synapses:,} synapses on "
        f"{net.cores} cores of {net.target}, compared with its float model on {report.provenance.data.samples} "
        "recordings."
    )


# -- verdict and decisions ---------------------------------------------------------------------------------------------


def _verdict(report: Report) -> list[Block]:
    verdict = report.verify
    blocks: list[Block] = [Facts(_cards(report))]
    rungs = {STAGES.get(rung.stage, rung.stage): [float(sum(rung.different.values()))] for rung in verdict.ladder}
    title = "Spikes that differ from the float32 model, rung by rung"
    for section in verdict_sections(verdict):
        if section.title == "Ladder":
            caption = "Which deviation costs how many spikes: each rung adds one to those above, the last is the chip."
            draw = partial(drawing.bars, title, rungs, ["differing spikes"])
            blocks.append(Section("Ladder", [Figure("ladder", draw, caption, [ladder_table(verdict)])]))
        else:
            blocks.append(section)
    return blocks


def _cards(report: Report) -> dict[str, tuple[str, str]]:
    verdict, costs = report.verify, report.chip
    cards = {}
    for side, share in verdict.accuracy.items():
        value, _, note = percent(round(share * verdict.samples), verdict.samples).partition(" (")
        cards[f"{side} accuracy"] = value, note.removesuffix(")")
    equal = round(verdict.decision_agreement * verdict.samples)
    cards["decisions equal"] = f"{equal} of {verdict.samples}", "chip and float model"
    exact = f"every spike, membrane and count of {verdict.spec_samples} recordings"
    cards["specification = engine"] = "yes" if verdict.spec_equals_engine else "NO", exact
    energy = costs.energy_j
    if energy:
        shown = dict.fromkeys(si(value, "J") for value in sorted(energy.values()))
        cards["energy an inference"] = (
            " … ".join(dict.fromkeys([next(iter(shown)), list(shown)[-1]])),
            ", ".join(energy),
        )
    for table, seconds in list(costs.time_s.items())[:1]:
        cards["time an inference"] = si(seconds, "s"), f"at full speed, {table}, simple model"
    net = report.netlist
    return cards | {"cores": (f"{net.cores}", f"{net.compartments:,} neurons on the chip")}


def _decisions(report: Report) -> list[Block]:
    found = report.decisions
    ours, chip = found.matrices.model, found.matrices.chip
    wrong = [[f"{label} as {decided}", str(a), str(b)] for label, decided, a, b in found.confusions()]
    classes = [
        [str(k), str(ours[k].sum()), str(ours[k, k]), str(chip[k, k])] for k in range(found.classes) if ours[k].any()
    ]
    moved = [
        [file, *map(str, decided)]
        for file, *decided in zip(found.files, found.labels, found.model, found.chip, strict=True)
        if decided[1] != decided[2]
    ]
    title = "Confusion matrices of the float model and of the chip"
    figure = Figure(
        "confusion",
        partial(drawing.matrices, title, {"float model": ours, "chip": chip}),
        "Rows are labels, columns decisions; right ones lie on the diagonal, the others are of another colour.",
        [Table(["class", "recordings", "float", "chip"], classes, "Right decisions by class", most=0)],
    )
    blocks: list[Block] = [figure]
    if wrong:
        blocks.append(Table(["label decided as", "float", "chip"], wrong, "Wrong decisions", most=LISTED))
    else:
        blocks.append(Text("no recording is decided wrongly, by either side"))
    if moved:
        caption = "Recordings that the two decide differently"
        table = Table(["recording", "label", "float model", "chip"], moved, caption, most=LISTED)
        return [*blocks, Section("", [Text(f"{len(moved)} decided differently:"), table])]
    return [*blocks, Text("the two decide every recording alike")]


# -- cores and taxels --------------------------------------------------------------------------------------------------


def _cores(report: Report) -> list[Block]:
    found = report.cores
    limits = list(dict.fromkeys(name for core in found.cores for name in core.fill))
    short = [name.removeprefix("core.").replace("_", " ") for name in limits]
    places = [
        [
            str(core.core),
            str(core.tile),
            " ".join(core.layers),
            f"{core.compartments:,}",
            core.fullest,
            f"{100 * core.fill[core.fullest].share:.0f} %",
        ]
        for core in found.cores
    ]
    fill = [
        [str(core.core), *(f"{core.fill[name].used:,} ({100 * core.fill[name].share:.0f} %)" for name in limits)]
        for core in found.cores
    ]
    ways = [
        [way.sender, str(way.to), f"{way.packets:,.0f}", f"{way.axons:,}", "" if way.hops is None else str(way.hops)]
        for way in sorted(found.traffic, key=lambda way: -way.packets)
    ]
    mesh, tiles, chips = found.mesh, {core.tile for core in found.cores}, {core.chip for core in found.cores}
    figure = Figure(
        "cores-map",
        partial(pictures.mesh, found),
        "A core is filled as far as the fullest of its compartments, synaptic memory and axons; lines are packets in a "
        "mean recording.",
        [
            Table(["core", "tile", "layers", "compartments", "fullest limit", "fill"], places, "Cores"),
            Table(["core", *short], fill, "What each core uses of each limit", most=0),
            Table(
                ["from core", "to core", "packets", "axons", "hops"], ways, "Packets in a mean recording", most=LISTED
            ),
        ],
    )
    used = (
        f"{len(found.cores)} cores on {len(tiles)} of {len(chips) * mesh.width * mesh.height} tiles (a chip has "
        f"{mesh.width} by {mesh.height}, of {mesh.tile_cores} cores each); only the used part is drawn"
    )
    return [Section("", [Text(used), figure])]


def _taxels(report: Report) -> list[Block]:
    found = report.taxels
    order = np.argsort(-found.events, kind="stable").tolist()
    edges = found.edges.tolist()
    head = ["taxel", "neighbours", "events (mean)", *([] if found.spikes is None else [f"{found.layer} spikes (mean)"])]
    rows = []
    for taxel in order[: pictures.DETAILED]:
        near = len({b for a, b in edges if a == taxel})
        spikes = [] if found.spikes is None else [f"{found.spikes[taxel]:,.1f}"]
        rows.append([str(taxel), str(near), f"{found.events[taxel]:,.1f}", *spikes])
    graph = "no taxel graph" if found.graph is None else f"graph {found.graph} with {len(edges)} edges"
    where = "" if found.positions_mm is not None else "; their positions are not known, so they are drawn on a circle"
    caption = "Discs grow with what a taxel sends, and with what its first-layer neurons fire where there is a graph."
    table = Table(head, rows, "Activity in a mean recording, the busiest first", most=LISTED)
    return [
        Text(f"{found.sensor or 'sensor'}: {len(order)} taxels, {graph}{where}; the busiest:"),
        Figure("taxels-map", partial(pictures.fingertip, found), caption, [table]),
    ]


# -- one recording -----------------------------------------------------------------------------------------------------


def _recording(found: Recording) -> list[Block]:
    decided = found.decision
    votes = [
        [str(k), str(ours), str(chip)]
        for k, (ours, chip) in enumerate(zip(found.votes.model, found.votes.chip, strict=True))
        if ours or chip
    ]
    counts = [
        [layer.name, f"{len(layer.active):,} of {layer.neurons:,}"]
        + [f"{count:,}" for count in (layer.float_spikes, layer.chip_spikes, layer.different)]
        for layer in found.layers
    ]
    nothing = np.zeros((0, 2), np.int64)
    sent = LayerRaster(
        name="input",
        neurons=0,
        active=np.unique(found.input[:, 1]),
        float_spikes=len(found.input),
        chip_spikes=len(found.input),
        different=0,
        both=found.input,
        float_only=nothing,
        chip_only=nothing,
    )
    shown = next((layer for layer in found.layers if layer.different), found.layers[0])
    rasters = [
        Details(layer.name, [_raster(layer, found.steps)], "raster", layer is shown) for layer in (sent, *found.layers)
    ]
    head = ["layer", "neurons that fire", "float spikes", "chip spikes", "different"]
    voted = Table(["class", "float", "chip"], votes, "Votes") if votes else Text("No neuron votes.")
    first, *others = found.membranes
    near = [_membrane_rows(first)[step - first.first_step] for step in _near(first)]
    return [
        Text(
            f"{found.file}, {found.steps} steps: label {found.label}, decided {decided.model} by the float model and "
            f"{decided.chip} by the chip"
        ),
        Table(head, counts, "Spikes by layer"),
        Details("Votes", [voted]),
        Section("Spikes", rasters),
        Section(
            "Membranes",
            [
                Text(first.title),
                Table(MEMBRANE, near, "Around the first of them"),
                Figure(
                    "membranes",
                    partial(pictures.membranes, found.membranes),
                    "Membranes before the reset, in the float model's units, around the first spike of each layer that "
                    "differs, which is shaded. Where none differs: of the neuron whose membranes lie furthest apart.",
                    [_membrane_table(trace) for trace in (first, *others)],
                ),
            ],
        ),
    ]


MEMBRANE = ["step", "float membrane", "chip membrane", "fires"]


def _near(trace: Trace) -> range:
    """Steps next to the divergence."""
    end = trace.first_step + len(trace.model)
    return range(max(trace.first_step, trace.step - LISTED // 2), min(end, trace.step + LISTED // 2 + 1))


def _membrane_rows(trace: Trace) -> list[list[str]]:
    return [
        [str(step), f"{ours:.6f}", f"{chip:.6f}", trace.fires(step)]
        for step, (ours, chip) in enumerate(zip(trace.model, trace.chip, strict=True), trace.first_step)
    ]


def _membrane_table(trace: Trace) -> Table:
    title = f"{trace.title}; threshold {trace.theta:g}, on the chip {trace.chip_theta:.6f}"
    return Table(MEMBRANE, _membrane_rows(trace), title, most=0)


def _raster(layer: LayerRaster, steps: int) -> Figure:
    kind = "channel" if layer.name == "input" else "neuron"
    active = layer.active.tolist()
    rows = [active[i * len(active) // ROWS] for i in range(ROWS)] if len(active) > ROWS else active
    what = "channels with an event" if kind == "channel" else "neurons that fire on either side"
    some = f"{len(rows):,} of " if len(rows) < len(active) else ""
    spikes = {"both": layer.both, "float": layer.float_only, "chip": layer.chip_only}
    entries = sorted((*pair, side) for side in ("float", "chip") for pair in spikes[side].tolist())
    listed = [[str(step), str(neuron), f"{side} only"] for step, neuron, side in entries[:SPIKES]]
    more = f", the first {SPIKES:,} of {len(entries):,} (--json has all)" if len(entries) > SPIKES else ""
    numbers = [Table(["step", kind, "fires"], listed, f"Spikes of one side only{more}", most=0)] if listed else []
    title = f"Spikes of {layer.name}, float model and chip"
    return Figure(
        f"raster-{layer.name}",
        partial(drawing.raster, title, rows, steps, spikes, kind),
        f"{layer.name}: rows are {some}the {len(active):,} {what}, in order.",
        numbers,
    )


# -- energy and time ---------------------------------------------------------------------------------------------------


def _by_step(recording: Recording) -> list[Block]:
    """Energy by core, energy and time by step of the recording that is drawn."""
    found, cores = recording.by_step, recording.core_energy_j
    times = {**found.time_s, **{f"mean of all, {name}": each for name, each in found.mean_time_s.items()}}
    rows = [
        [f"{what}, {name}", si(float(each.mean()), unit), si(float(each.max()), unit), str(int(each.argmax()))]
        for what, unit, series in (("energy", "J", found.energy_j), ("time", "s", found.time_s))
        for name, each in series.items()
    ]
    blocks: list[Block] = [Table(["by chip step", "mean", "most", "at step"], rows, f"Chip steps of {recording.file}")]
    if tables := list(next(iter(cores.values()))):
        energy = {core: list(joules.values()) for core, joules in cores.items()}
        caption = "It is the one that is drawn above, simulated message by message."
        blocks.append(bar_figure("energy-cores", "Energy of this recording by core", energy, tables, "J", caption))
    for name, title, series, unit in (
        ("energy-steps", "Energy of each chip step of this recording", found.energy_j, "J"),
        ("time-steps", "Time of each chip step of this recording", times, "s"),
    ):
        if series:
            longest = max(len(values) for values in series.values())
            cells = [
                [str(step), *(si(float(v[step]), unit) if step < len(v) else "" for v in series.values())]
                for step in range(longest)
            ]
            draw: Callable[[], Drawing] = partial(drawing.lines, title, series, "chip step", unit)
            numbers = [Table(["chip step", *series], cells, title, most=0)]
            blocks.append(Figure(name, draw, f"{title}: one line for each table.", numbers))
    return [Section("Step by step", blocks)]


# -- the rest ----------------------------------------------------------------------------------------------------------


def _provenance(made: Provenance) -> list[Block]:
    """Files, hashes, versions, options, seeds; and what to type to get all of it again."""
    files = [
        ["netlist", made.netlist.file, made.netlist.sha256],
        ["checkpoint", made.checkpoint.file, made.checkpoint.sha256],
        ["data", f"{made.data.name}, {made.data.split} split", made.data.sha256],
    ]
    facts: dict[str, Mapping[str, Any] | None] = {
        "How the netlist was compiled": made.netlist.compiled,
        "Decays by layer, and clocks": made.checkpoint.dynamics,
        "Steps": {"bins that one joins": made.checkpoint.bins} if made.checkpoint.bins > 1 else None,
        "How the network was trained": made.checkpoint.training,
        "Versions": made.versions,
        "Energy tables": made.chip.energy_tables,
        "Time tables": made.chip.time_tables,
    }
    tables = [
        Table(
            ["", "value"],
            [[name, value if isinstance(value, str) else json.dumps(value)] for name, value in found.items()],
            caption,
            words=True,
            most=0,
        )
        for caption, found in facts.items()
        if found
    ]
    versions = ", ".join(f"{name} {number}" for name, number in made.versions.items())
    commands = [block for line in made.commands for block in (Text(f"{line.what}:"), Code([line.command]))]
    return [
        Table(["", "name", "sha256"], files, "Files; the hash of recordings is over events and labels", words=True),
        *tables,
        Text(f"versions: {versions}"),
        Section("Commands that repeat this page", commands),
    ]
