"""What ``lean`` prints."""

from __future__ import annotations

from typing import Any

from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.tables import table

Json = dict[str, Any]


def lean_text(report: Json) -> str:
    """What is used, what may go, and what that changes and saves."""
    rows, samples = report["rows"], report["samples"]
    whole = rows[0]
    lines = []
    if report["candidates"]:
        lines += [_candidates(report), f"taken: {report['chosen']}", ""]
    lines += [
        f"chip accuracy: {percent(whole['test']['right'], samples['test'])} on {report['split']}, "
        f"{whole['training']['right']} of {samples['training']} in training",
        "",
        table(
            ["layer", "neurons", "on chip", "never fired in training"],
            [[e["name"], *(f"{e[key]:,}" for key in ("neurons", "on_chip", "never_fired"))] for e in report["layers"]],
        ),
        _taxels(report["taxels"]),
        "",
        _rows(report),
        *(f"without {name}: not tried, what is left could leave a register" for name in report["overflowing"]),
        "",
        f"least energy in training: {rows[report['taken']]['name']}",
        *_removed(rows[report["taken"]]),
    ]
    if report["output"] is not None:
        lines.append(f"written without them: {report['output']}")
    return "\n".join(lines)


def _candidates(report: Json) -> str:
    samples = report["samples"]
    rows = [
        [
            entry["name"],
            str(entry["graph"] or ""),
            f"{entry['training_right']} of {samples['training']}",
            f"{entry['test_right']} of {samples['test']}",
            f"{entry['operations']:,.0f}",
            *(si(each, "J") for each in entry["energy_j"].values()),
            str(entry["cores"]),
        ]
        for entry in report["candidates"]
    ]
    tables = list(report["candidates"][0]["energy_j"])
    return table(["network", "graph", "right in training", "right", "operations", *tables, "cores"], rows)


def _taxels(taxels: list[Json]) -> str:
    """Taxels without which nothing changes, and the one that matters most."""
    silent = [str(i) for i, taxel in enumerate(taxels) if not taxel["events"]]
    free = [str(i) for i, taxel in enumerate(taxels) if taxel["events"] and not taxel["training_differ"]]
    most = max(range(len(taxels)), key=lambda i: taxels[i]["training_differ"])
    parts = [
        f"{len(silent)} of {len(taxels)} taxels without an event in training{_listed(silent)}",
        f"{len(free)} more without which, one at a time, no training decision changes{_listed(free)}",
        f"taxel {most} matters most: {taxels[most]['training_differ']} training decisions change without it",
    ]
    return "\n".join(parts)


def _listed(names: list[str]) -> str:
    return f" ({', '.join(names)})" if names else ""


def _rows(report: Json) -> str:
    rows, samples = report["rows"], report["samples"]
    whole = rows[0]
    tables = list(whole["energy_j"])
    head = ["without", "differ in training", "differ", "right", "operations", "saved"]
    head += [word for name in tables for word in (name, "saved")] + ["time, " + name for name in whole["time_s"]]
    head += ["neurons", "cores"]
    body = []
    for row in rows:
        cells = [
            f"{row['training']['differ']} of {samples['training']}",
            f"{row['test']['differ']} of {samples['test']}",
        ]
        cells += [str(row["test"]["right"]), f"{row['operations']:,.0f}"]
        cells.append(_saved(row["operations"], whole["operations"]))
        for name in tables:
            cells += [si(row["energy_j"][name], "J"), _saved(row["energy_j"][name], whole["energy_j"][name])]
        cells += [si(each, "s") for each in row["time_s"].values()]
        name = "nothing" if row is whole else row["name"]
        body.append([name, *cells, f"{row['neurons']:,}", str(row["cores"])])
    return table(head, body)


def _saved(left: float, whole: float) -> str:
    return f"{100 * (1 - left / whole):.1f} %" if whole else ""


def _removed(row: Json) -> list[str]:
    """What went together."""
    gone, lines = row["removed"], []
    if "hops" in gone:
        lines.append(f"hops that went: {', '.join(map(str, gone['hops']))}")
    if gone.get("taxels"):
        lines.append(f"taxels that went: {', '.join(map(str, gone['taxels']))}")
    if gone.get("neurons"):
        lines.append("neurons that went: " + ", ".join(f"{name} {count:,}" for name, count in gone["neurons"].items()))
    return lines
