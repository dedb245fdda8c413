"""What ``report`` prints for people who open no page: the page's tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.targets.loihi1.legalize import LimitUse
from spikeloom.runtime.machines.loihi1 import description
from spikeloom.runtime.report.sections import Section, terminal
from spikeloom.runtime.report.tables import si, table
from spikeloom.runtime.studies.chart.sections import taken
from spikeloom.runtime.studies.stress.text import stress_text

Json = dict[str, Any]

LISTED = 10
"""Rows of tables that are sorted by weight; the page and --json have them all."""


def report_text(report: Json, verdict: str, costs: str) -> str:
    """Section by section, under the headings of the page."""
    sections = {
        "Verdict": verdict,
        "Decisions": _decisions(report["decisions"]),
        "Cores": f"{_netlist(report['netlist'])}\n\n{_cores(report['cores'])}",
        "Taxels": _taxels(report["taxels"]),
        "One recording": _recording(report["recording"]),
        "Energy and time": costs,
        **({"Stability": stress_text(report["stress"])} if "stress" in report else {}),
        **({"Configurations": terminal([Section("", taken(report["chart"]))])} if "chart" in report else {}),
        "Provenance": _provenance(report["provenance"]),
    }
    parts = [f"{title}\n{'-' * len(title)}\n{text}" for title, text in sections.items()]
    return "\n\n".join([*parts, f"page: {report['output']}"])


def _netlist(facts: Json) -> str:
    layers = [description.LayerFacts(**layer) for layer in facts["layers"]]
    limits = [LimitUse(**use) for use in facts["limits"]]
    clocks = {"clocks": Clocks(**facts["clocks"])} if "clocks" in facts else {}
    found = description.NetlistFacts(**(facts | clocks | {"layers": layers, "limits": limits}))
    return terminal(description.sections(found))


def confusions(decisions: Json) -> list[tuple[int, int, int, int]]:
    """Label, wrong decision, and how often float model and chip take it; those that are most frequent first."""
    ours, chip = (np.array(decisions["matrices"][side]) for side in ("float", "chip"))
    pairs = [
        (label, decided, int(ours[label, decided]), int(chip[label, decided]))
        for label, decided in np.argwhere(ours + chip).tolist()
        if label != decided
    ]
    return sorted(pairs, key=lambda pair: (-pair[2] - pair[3], pair[0], pair[1]))


def _decisions(decisions: Json) -> str:
    wrong = confusions(decisions)
    if not wrong:
        return "no recording is decided wrongly, by either side"
    rows = [[f"{label} as {decided}", str(ours), str(chip)] for label, decided, ours, chip in wrong[:LISTED]]
    return table(["label decided as", "float", "chip"], rows) + _more(len(wrong))


def _more(total: int) -> str:
    return f"\n  … and {total - LISTED} more, see the page" if total > LISTED else ""


def _cores(cores: Json) -> str:
    rows = [
        [
            str(core["core"]),
            str(core["tile"]),
            " ".join(core["layers"]),
            f"{core['compartments']:,}",
            core["fullest"],
            f"{100 * core['fill'][core['fullest']]['share']:.0f} %",
        ]
        for core in cores["cores"]
    ]
    ways = sorted(cores["traffic"], key=lambda way: -way["packets"])
    sent = [
        [sender(way), str(way["to"]), f"{way['packets']:,.0f}", "" if way["hops"] is None else str(way["hops"])]
        for way in ways[:LISTED]
    ]
    return "\n".join(
        [
            table(["core", "tile", "layers", "compartments", "fullest limit", "fill"], rows),
            "",
            table(["from core", "to core", "packets (mean)", "hops"], sent) + _more(len(ways)),
        ]
    )


def sender(way: Json) -> str:
    """Where packets come from."""
    return "input" if way["from"] is None else str(way["from"])


def _taxels(taxels: Json) -> str:
    events = taxels["events"]
    order = sorted(range(len(events)), key=lambda taxel: -events[taxel])
    spikes = taxels["spikes"]
    head = ["taxel", "events (mean)", *([] if spikes is None else [f"{taxels['layer']} spikes, chip (mean)"])]
    rows = [
        [str(taxel), f"{events[taxel]:,.1f}", *([] if spikes is None else [f"{spikes[taxel]:,.1f}"])]
        for taxel in order[:LISTED]
    ]
    graph = "no taxel graph" if taxels["graph"] is None else f"graph {taxels['graph']}, {len(taxels['edges'])} edges"
    return f"{len(events)} taxels, {graph}; the busiest:\n{table(head, rows)}{_more(len(events))}"


def _recording(recording: Json) -> str:
    decided = recording["decision"]
    lines = [
        f"{recording['file']}: label {recording['label']}, decided {decided['float']} by the float model and "
        f"{decided['chip']} by the chip",
        table(
            ["layer", "neurons that fire", "float spikes", "chip spikes", "different"],
            [
                [layer["name"], str(len(layer["active"]))]
                + [f"{layer[key]:,}" for key in ("float_spikes", "chip_spikes", "different")]
                for layer in recording["layers"]
            ],
        ),
        "",
        trace_title(recording["membranes"][0]),
        table(["step", "float membrane", "chip membrane", "spikes"], _trace_rows(recording["membranes"][0])),
    ]
    energy = {name: np.array(each) for name, each in recording["by_step"]["energy_j"].items()}
    time = {name: np.array(each) for name, each in recording["by_step"]["time_s"].items()}
    rows = [
        [f"{what}, {name}", si(float(each.mean()), unit), si(float(each.max()), unit), str(int(each.argmax()))]
        for what, unit, found in (("energy", "J", energy), ("time", "s", time))
        for name, each in found.items()
    ]
    return "\n".join([*lines, "", table(["by chip step", "mean", "most", "at step"], rows)])


def trace_title(trace: Json) -> str:
    """What a membrane trace shows."""
    where = f"{trace['layer']} {trace['of']}, step {trace['step']}"
    if not trace["diverges"]:
        return f"no spike differs; the membranes lie furthest apart at {where}"
    return f"first spike of {trace['layer']} that differs: {where}{'' if trace['held'] else ' (not on the chip)'}"


def trace_spikes(trace: Json, step: int) -> str:
    """Who fires in a step of a trace."""
    fires = step in trace["float_spikes"], step in trace["chip_spikes"]
    return {(True, True): "both", (True, False): "float only", (False, True): "chip only", (False, False): ""}[fires]


def _trace_rows(trace: Json) -> list[list[str]]:
    """The steps next to the divergence."""
    rows = []
    for offset, (ours, chip) in enumerate(zip(trace["float"], trace["chip"], strict=True)):
        step = trace["first_step"] + offset
        if abs(step - trace["step"]) <= LISTED // 2:
            rows.append([str(step), f"{ours:.6f}", f"{chip:.6f}", trace_spikes(trace, step)])
    return rows


def _provenance(provenance: Json) -> str:
    files = [
        [name, found.get("file", found.get("name")), found["sha256"]]
        for name, found in provenance.items()
        if isinstance(found, dict) and "sha256" in found
    ]
    versions = ", ".join(f"{name} {number}" for name, number in provenance["versions"].items())
    commands = [f"$ {line['command']}" for line in provenance["commands"]]
    return "\n".join([table(["", "name", "sha256"], files), f"versions: {versions}", "", *commands])
