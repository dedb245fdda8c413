"""The page of ``report``: one HTML file that needs nothing else, the same bytes for the same report."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from html import escape
from importlib import resources
from typing import Any

from spikeloom.runtime.page import costs as report_costs
from spikeloom.runtime.page import sections as report_sections
from spikeloom.runtime.page import stress as report_stress
from spikeloom.runtime.report import html
from spikeloom.runtime.report.markup import paragraph, section, table
from spikeloom.runtime.report.sections import Section
from spikeloom.runtime.studies.chart.sections import figures, saved, taken

Json = dict[str, Any]


def page(report: Json) -> str:
    """The whole page.

    Parameters
    ----------
    report : dict
        What ``report --json`` prints.
    """
    made = report["provenance"]
    title = f"{made['netlist']['file']} on {made['data']['name']}"
    made_of = {name: (heading, content(report)) for name, (heading, content) in SECTIONS.items()}
    shown = {name: found for name, found in made_of.items() if found[1]}
    body = "".join(section(name, heading, content) for name, (heading, content) in shown.items())
    links = "".join(f'<li><a href="#{name}">{escape(heading)}</a></li>' for name, (heading, _) in shown.items())
    files = resources.files("spikeloom.runtime.page")
    style = files.joinpath("report.css").read_text("utf-8")
    script = files.joinpath("report.js").read_text("utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)} – spikeloom</title>\n<style>\n{style}</style></head>\n<body>"
        '<a class="skip" href="#verdict">To the verdict</a>'
        f"<header><h1>{escape(title)}</h1>{paragraph(_about(report))}"
        '<p class="hint">Point at a figure, or move to it with Tab and press arrow keys, to read its values.</p>'
        f'<nav aria-label="Sections"><ul>{links}</ul></nav></header>\n<main>{body}</main>\n'
        f"<footer><p>Made by spikeloom {escape(made['versions']['spikeloom'])}; this page loads nothing.</p></footer>"
        f"\n<script>\n{script}</script></body></html>\n"
    )


def _about(report: Json) -> str:
    net, made = report["netlist"], report["provenance"]
    system = made["checkpoint"]["system"] or "network"
    graph = f", graph {made['checkpoint']['graph']}" if report["taxels"]["graph"] else ""
    return (
        f"A {system}{graph}: {net['neurons']:,} neurons and {net['synapses']:,} synapses on {net['cores']} cores of "
        f"{net['target']}, held against its float model on {made['data']['samples']} recordings."
    )


def _configurations(report: Json) -> list[str]:
    """What a chart of this network and others found; nothing where none was given."""
    if "chart" not in report:
        return []
    chart = report["chart"]
    return [html.fragment(Section("", [*figures(chart, "pareto"), *taken(chart), saved(chart)]))]


def _stability(report: Json) -> list[str]:
    """What a stress battery found of this netlist; nothing where none was given."""
    return report_stress.stability(report) if "stress" in report else []


def _provenance(report: Json) -> list[str]:
    """Files, hashes, versions, options, seeds; and what to type to get all of it again."""
    made = report["provenance"]
    files = [
        ["netlist", made["netlist"]["file"], made["netlist"]["sha256"]],
        ["checkpoint", made["checkpoint"]["file"], made["checkpoint"]["sha256"]],
        ["recordings", f"{made['data']['name']}, {made['data']['split']} split", made["data"]["sha256"]],
    ]
    parts = [
        table("Files; the hash of recordings is over their events and labels", ["", "name", "sha256"], files, left=True)
    ]
    facts: dict[str, Mapping[str, Any] | None] = {
        "How the netlist was compiled": made["netlist"]["compiled"],
        "Decays by layer, and clocks": made["checkpoint"]["dynamics"],
        "Steps": {"bins that one joins": made["checkpoint"]["bins"]} if made["checkpoint"]["bins"] > 1 else None,
        "How the network was trained": made["checkpoint"]["training"],
        "Versions": made["versions"],
        "Energy tables": made["chip"]["energy_tables"],
        "Time tables": made["chip"]["time_tables"],
    }
    for caption, found in facts.items():
        if found:
            rows = [[key, value if isinstance(value, str) else json.dumps(value)] for key, value in found.items()]
            parts.append(table(caption, ["", "value"], rows, left=True))
    parts.append("<h3>Commands that repeat this page</h3>")
    parts += [
        f"<p>For {escape(line['for'])}:</p><pre><code>{escape(line['command'])}</code></pre>"
        for line in made["commands"]
    ]
    return parts


SECTIONS: dict[str, tuple[str, Callable[[Json], list[str]]]] = {
    "verdict": ("Verdict", report_sections.verdict),
    "decisions": ("Decisions", report_sections.decisions),
    "cores-section": ("Cores", report_sections.cores),
    "taxels-section": ("Taxels", report_sections.taxels),
    "recording": ("One recording", report_sections.recording),
    "costs": ("Energy and time", report_costs.costs),
    "stress": ("Stability", _stability),
    "configurations": ("Configurations", _configurations),
    "provenance": ("Provenance", _provenance),
}
"""Sections in their order: id, heading, and what makes the content; one without content is left out."""
