"""The page of a network: chapters with figures, each table laid out once for page and terminal."""

import json
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from spikeloom.compiler.systems import TITLES
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.equivalence.verdict import LEVELS, in_a_sentence
from spikeloom.runtime.equivalence.verdict import sections as verdict_sections
from spikeloom.runtime.machines.core_map import CoreMap
from spikeloom.runtime.page import pictures
from spikeloom.runtime.page.recording import LayerRaster, Recording, Trace
from spikeloom.runtime.page.results import Decisions, Provenance, Report, Taxels
from spikeloom.runtime.report import drawing
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import (
    Block,
    Code,
    Details,
    Facts,
    Figure,
    Outcome,
    Section,
    Table,
    Text,
)
from spikeloom.runtime.studies.robustness.stress_sections import overview

LISTED = 10
"""Rows that a terminal shows of a table that is sorted by weight."""

SPIKES = 200
"""Differing spikes of a layer that a table lists; ``--json`` has them all."""

ROWS = 3000
"""Rows of a raster, at most; a screen shows fewer."""

WORDS = LEVELS | {
    "spike, vote": "what a neuron sends; one of the last layer, and the class with the most votes is decided",
    "membrane": "sum of what a neuron received, part of which is lost each step; above its threshold the neuron spikes",
    "specification, engine": "the chip's definition, written to be read; the fast simulator that made all figures",
    "ill-posed": "a spike that sums in 32 and 64 bits decide otherwise, so that neither is wrong",
    "ladder": "the chip's deviations from the float model, added one by one, and the spikes that then differ",
    "McNemar p": "how often chance alone splits what only one of the two gets right so unevenly",
    "core, tile, chip step": "cores compute side by side, some share a tile; a step updates every neuron once",
    "compartment, axon": "a neuron as a core holds it; a core's entry for the spikes of one sender",
    "synaptic operation": "one spike on one stored synapse",
    "packet, hop": "a spike on its way to a core; a link between tiles that it takes",
    "taxel graph": "which elements of the touch sensor (taxels) are neighbours; manual: joined by hand",
}
"""What a reader of the page alone may ask."""


def sections(report: Report) -> list[Section]:
    """Chapters of the page."""
    chapters = [
        Section(
            "Verdict",
            [Text(in_a_sentence(report.verify)), Facts(_cards(report)), *verdict_sections(report.verify)],
        ),
        Section("Decisions", _decisions(report.decisions)),
        Section(
            "Cores", [*_of_chip(report.described), *([] if report.cores is None else _cores(report.cores))]
        ),
        Section("Taxels", _taxels(report.taxels)),
        Section("One recording", [] if report.recording is None else _recording(report.recording)),
        Section("Energy and time", [*_of_chip(report.price.outcome), Section("", report.figures)]),
        Section("Stress", [] if report.stress is None else overview(report.stress)),
        Section("Provenance", _provenance(report.provenance)),
        Section("Words", [Table(["word", "meaning"], list(map(list, WORDS.items())), words=True, most=0)]),
    ]
    return [Section(each.title, each.blocks, chapter=True) for each in chapters if each.blocks]


def _of_chip(outcome: Outcome) -> Iterable[Block]:
    """What the chip says of itself, in its layout."""
    return outcome.sections(outcome.result)


def about(report: Report) -> str:
    """The page in a sentence."""
    system = TITLES.get(report.provenance.checkpoint.facts["system"], "a network")
    graph = f", graph {report.taxels.graph}" if report.taxels.graph else ""
    cores = "" if report.cores is None else f"on {number(len(report.cores.cores), 'core')}, "
    where = f"{cores}compared with its float model on {number(report.verify.samples, 'recording')}"
    return f"{system[0].upper()}{system[1:]}{graph}, {where}."


def _cards(report: Report) -> dict[str, tuple[str, str]]:
    verdict = report.verify
    price = report.price
    cards = {}
    for side, right in verdict.right.items():
        value, _, note = percent(right, verdict.samples).partition(" (")
        cards[f"{side} accuracy"] = value, note.removesuffix(")")
    cards["decisions equal"] = f"{verdict.equal} of {verdict.samples}", "chip and float model"
    exact = f"every spike, membrane and count of {verdict.spec_samples} recordings"
    cards["specification = engine"] = "yes" if verdict.spec_equals_engine else "NO", exact
    energy = {name: float(each.mean()) for name, each in price.dynamic_j.items()}
    static = "static power, not in that energy"
    for name, unit, values in (("dynamic energy an inference", "J", energy), (static, "W", price.static_w)):
        if values:
            rising = sorted(values, key=values.__getitem__)
            ends = dict.fromkeys(si(values[table], unit) for table in (rising[0], rising[-1]))
            cards[name] = " … ".join(ends), ", ".join(rising)
    for table, seconds in list(price.time_s.items())[:1]:
        cards["time an inference"] = si(float(seconds.mean()), "s"), f"at full speed, {table}, simple model"
    if report.cores is None:
        return cards
    neurons = sum(core.compartments for core in report.cores.cores)
    return cards | {"cores": (str(len(report.cores.cores)), f"{neurons:,} neurons on the chip")}


def _decisions(decisions: Decisions) -> list[Block]:
    ours, chip = decisions.matrices.values()
    pairs = sorted(np.argwhere(ours + chip).tolist(), key=lambda pair: -int(ours[*pair] + chip[*pair]))
    wrong = [
        [f"{label} as {decided}", str(ours[label, decided]), str(chip[label, decided])]
        for label, decided in pairs
        if label != decided
    ]
    present = np.flatnonzero(ours.any(axis=1)).tolist()
    classes = [[str(k), str(ours[k].sum()), str(ours[k, k]), str(chip[k, k])] for k in present]
    moved = [
        [file, *map(str, decided)]
        for file, *decided in zip(
            decisions.files, decisions.labels, decisions.model, decisions.chip, strict=True
        )
        if decided[1] != decided[2]
    ]
    tables = [
        Table(["label decided as", "float", "chip"], wrong, "Recordings decided wrongly", most=LISTED),
        Table(["recording", "label", "float model", "chip"], moved, "Decided differently", most=LISTED),
    ]
    title = "Confusion matrices of the float model and of the chip"
    return [
        Figure(
            "confusion",
            partial(drawing.matrices, title, {"float model": ours, "chip": chip}),
            "Recordings of a label (row) that were decided as a class (column); right ones, on the diagonal, are blue.",
            [Table(["class", "recordings", "float", "chip"], classes, "Right decisions by class", most=0)],
        ),
        Text(
            f"{number(len(wrong), 'kind')} of wrong decisions, {number(len(moved), 'recording')} that the two decide "
            "differently"
        ),
        *(table for table in tables if table.rows),
    ]


def _cores(cores: CoreMap) -> list[Block]:
    limits = list(dict.fromkeys(name for core in cores.cores for name in core.fill))
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
        for core in cores.cores
    ]
    fill = [
        [
            str(core.core),
            *(f"{core.fill[name].used:,} ({100 * core.fill[name].share:.0f} %)" for name in limits),
        ]
        for core in cores.cores
    ]
    ways = [
        [
            "input" if way.source is None else str(way.source),
            str(way.to),
            f"{way.packets:,.0f}",
            f"{way.axons:,}",
            "" if way.hops is None else str(way.hops),
        ]
        for way in sorted(cores.traffic, key=lambda way: -way.packets)
    ]
    mesh = cores.mesh
    tiles = {core.tile for core in cores.cores}
    chips = {core.chip for core in cores.cores}
    figure = Figure(
        "cores-map",
        partial(pictures.mesh, cores),
        "A core is filled as far as the fullest of its compartments, synaptic memory and axons.",
        [
            Table(["core", "tile", "layers", "compartments", "fullest limit", "fill"], places, "Cores"),
            Table(["core", *short], fill, "What each core uses of each limit", most=0),
            Table(
                ["from core", "to core", "packets", "axons", "hops"],
                ways,
                "Packets in a mean recording",
                most=LISTED,
            ),
        ],
    )
    used = (
        f"{number(len(cores.cores), 'core')} on {len(tiles)} of {len(chips) * mesh.width * mesh.height} tiles (a chip "
        f"has {mesh.width} by {mesh.height}, of {mesh.tile_cores} cores each); only the used part is drawn"
    )
    return [Section("", [Text(used), figure])]


def _taxels(taxels: Taxels) -> list[Block]:
    order = np.argsort(-taxels.events, kind="stable").tolist()
    edges = taxels.edges.tolist()
    head = [
        "taxel",
        "neighbours",
        "events (mean)",
        *([] if taxels.spikes is None else [f"{taxels.layer} spikes (mean)"]),
    ]
    rows = []
    for taxel in order[: pictures.DETAILED]:
        near = len({b for a, b in edges if a == taxel})
        spikes = [] if taxels.spikes is None else [f"{taxels.spikes[taxel]:,.1f}"]
        rows.append([str(taxel), str(near), f"{taxels.events[taxel]:,.1f}", *spikes])
    graph = "no taxel graph" if taxels.graph is None else f"graph {taxels.graph} with {len(edges)} edges"
    unknown = "; drawn on a circle, as positions are not known: train with --taxels COORDS.csv"
    where = unknown if taxels.positions_mm is None else ""
    caption = "Discs grow with what a taxel sends, and with what its first-layer neurons fire where there is a graph."
    table = Table(head, rows, "Activity in a mean recording, the busiest first", most=LISTED)
    return [
        Text(f"{taxels.sensor or 'sensor'}: {len(order)} taxels, {graph}{where}"),
        Figure("taxels-map", partial(pictures.fingertip, taxels), caption, [table]),
    ]


def _recording(recording: Recording) -> list[Block]:
    sides = zip(recording.votes["float"], recording.votes["chip"], strict=True)
    votes = [[str(k), str(ours), str(chip)] for k, (ours, chip) in enumerate(sides) if ours or chip]
    counts = [
        [layer.name, f"{len(layer.active):,} of {layer.neurons:,}"]
        + [f"{count:,}" for count in (layer.float_spikes, layer.chip_spikes, layer.different)]
        for layer in recording.layers
    ]
    nothing = np.zeros((0, 2), np.int64)
    sent = LayerRaster(name="input", neurons=0, both=recording.input, float_only=nothing, chip_only=nothing)
    shown = next((layer for layer in recording.layers if layer.different), recording.layers[0])
    rasters = [
        Details(layer.name, [_raster(layer, recording.steps, place)], "raster", layer is shown)
        for place, layer in enumerate((sent, *recording.layers))
    ]
    head = ["layer", "neurons that fire", "float spikes", "chip spikes", "different"]
    decided = f"decided {recording.decision['float']} by the float model and {recording.decision['chip']} by the chip"
    return [
        Text(f"{recording.file}, {recording.steps} steps: label {recording.label}, {decided}"),
        Table(head, counts, "Spikes by layer"),
        Details("Votes", [Table(["class", "float", "chip"], votes, "Votes")]),
        Section("Spikes", rasters),
        Section(
            "Membranes",
            [
                Text(recording.membranes[0].title),
                Figure(
                    "membranes",
                    partial(pictures.membranes, recording.membranes),
                    "Membranes before the reset, in the float model's units, around the first spike of each layer that "
                    "differs, which is shaded. Where none differs: of the neuron whose membranes lie furthest apart.",
                    [_membrane_table(trace) for trace in recording.membranes],
                ),
            ],
        ),
    ]


def _membrane_table(trace: Trace) -> Table:
    rows = [
        [str(step), f"{ours:.6f}", f"{chip:.6f}", trace.fires(step)]
        for step, (ours, chip) in enumerate(zip(trace.model, trace.chip, strict=True), trace.first_step)
    ]
    title = f"{trace.title}; threshold {trace.theta:g}, on the chip {trace.chip_theta:.6f}"
    return Table(["step", "float membrane", "chip membrane", "fires"], rows, title, most=0)


def _raster(layer: LayerRaster, steps: int, place: int) -> Figure:
    kind = "neuron" if place else "channel"
    active = layer.active.tolist()
    rows = [active[i * len(active) // ROWS] for i in range(ROWS)] if len(active) > ROWS else active
    what = "channels with an event" if kind == "channel" else "neurons that fire on either side"
    some = f"{len(rows):,} of " if len(rows) < len(active) else ""
    spikes = {"both": layer.both, "float": layer.float_only, "chip": layer.chip_only}
    entries = sorted((*pair, side) for side in ("float", "chip") for pair in spikes[side].tolist())
    listed = [[str(step), str(neuron), f"{side} only"] for step, neuron, side in entries[:SPIKES]]
    more = f", the first {SPIKES:,} of {len(entries):,} (--json has all)" if len(entries) > SPIKES else ""
    numbers = (
        [Table(["step", kind, "fires"], listed, f"Spikes of one side only{more}", most=0)] if listed else []
    )
    title = f"Spikes of {layer.name}, float model and chip"
    return Figure(
        f"raster-{place}",
        partial(drawing.raster, title, rows, steps, spikes, kind),
        f"{layer.name}: rows are {some}the {len(active):,} {what}, in order.",
        numbers,
    )


def _plain(value: Any) -> str:
    """A word as it is, anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def _provenance(made: Provenance) -> list[Block]:
    """Files, hashes, versions, options, seeds; and what to type to get all of it again."""
    files = [
        ["netlist", made.netlist.file, made.netlist.sha256],
        ["checkpoint", made.checkpoint.file, made.checkpoint.sha256],
        ["data", f"{made.data.file}, {made.data.facts['split']} split", made.data.sha256],
    ]
    known = made.checkpoint.facts
    facts: dict[str, Mapping[str, Any] | None] = {
        "How the netlist was compiled": made.netlist.facts["compiled"],
        "Decays by layer, and clocks": known["dynamics"],
        "Steps": {"bins that one joins": known["bins"]} if known["bins"] > 1 else None,
        "How the network was trained": known["training"],
        "Versions": made.versions,
        "Tables": made.tables,
    }
    tables = [
        Table(
            ["", "value"],
            [[name, _plain(value)] for name, value in values.items()],
            caption,
            words=True,
            most=0,
        )
        for caption, values in facts.items()
        if values
    ]
    versions = ", ".join(f"{name} {number}" for name, number in made.versions.items())
    commands = [block for what, line in made.commands.items() for block in (Text(f"{what}:"), Code([line]))]
    return [
        Table(
            ["", "name", "sha256"],
            files,
            "Files; the hash of recordings is over events and labels",
            words=True,
        ),
        *tables,
        Text(f"versions: {versions}"),
        Section("Commands that repeat this page", commands),
    ]
