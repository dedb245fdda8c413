"""The paper's tables as CSV, as Markdown and on a terminal."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

from spikeloom.compiler.systems import GCN, GRAPH_SYSTEMS, GRID_CNN, MLP, TACTILESGNET
from spikeloom.models.training.schedule import DECAY_EPOCHS, EPOCHS
from spikeloom.runtime.report.tables import si, table
from spikeloom.runtime.studies.paper.cells import SAME_AS, SAME_PADDING
from spikeloom.runtime.studies.paper.published import RUNS
from spikeloom.runtime.studies.paper.table import MARGIN, PROTOCOLS

Json = dict[str, Any]

NAMES = {TACTILESGNET: "TactileSGNet", GRID_CNN: "grid-based CNN", MLP: "MLP", GCN: "GCN"}

TITLES = {"methods": "Methods", "graphs": "Graphs"}

UNKNOWN = "not available here"
"""Where the paper has a figure that is not known here; never another figure instead."""

NONE = "—"

HEADS = {
    "best": "best epoch on test (paper's protocol)",
    "last": "last epoch",
    "clean": "clean epoch, chosen on validation",
}


def name_of(row: Json) -> str:
    """What a row is called.

    Examples
    --------
    >>> [name_of({"table": "methods", "system": s, "form": f}) for s, f in (("gcn", "manual"), ("grid-cnn", "same"))]
    ['GCN, manual graph', 'grid-based CNN, same padding']
    >>> name_of({"table": "graphs", "system": "tactilesgnet", "form": "mst:0"})
    'mst:0, mst:1.5'
    """
    if row["table"] == "graphs":
        return ", ".join([row["form"], *(name for name, same in SAME_AS.items() if same == row["form"])])
    of = f", {row['form']} graph" if row["system"] in GRAPH_SYSTEMS else ""
    return NAMES[row["system"]] + (", same padding" if row["form"] == SAME_PADDING else of)


# -- CSV ---------------------------------------------------------------------------------------------------------------


def csv_text(rows: Sequence[Json]) -> str:
    """One line for each row of each data set; empty where there is no figure, accuracies in percent."""
    text = io.StringIO()
    lines = [_flat(row) for row in rows]
    columns = list(dict.fromkeys(key for line in lines for key in line))
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _flat(row: Json) -> dict[str, Any]:
    flat = {key: row[key] for key in ("data", "system", "form", "epochs")}
    flat |= {"seeds": " ".join(map(str, row["seeds"])), "planned": row["planned"], "test_samples": row["test_samples"]}
    flat |= {"paper_mean": _of(row["paper"], "mean"), "paper_std": _of(row["paper"], "std")}
    for protocol in PROTOCOLS:
        flat |= _spread_columns(protocol, row[protocol])
    flat |= {key: _rounded(_of(row["comparison"], key)) for key in ("difference", "combined_se")}
    flat["within"] = _of(row["comparison"], "within")
    chip = row["chip"]
    flat["chip_refused"] = "; ".join(row["refused"] or ())
    for which in ("last", "clean"):
        flat |= _spread_columns(f"chip_{which}", chip and chip[which])
        flat[f"chip_{which}_equal"] = _rounded(chip and chip["equal"][which])
    for key in ("synaptic_operations", "first_layer_operations"):
        flat[key] = _rounded(_of(chip, key), 0)
    flat |= _chip_columns(chip) if chip else {}
    return {key: "" if value is None else value for key, value in flat.items()}


def _chip_columns(chip: Json) -> dict[str, Any]:
    """Columns that are only there where some network is on the chip."""
    lean = chip["without_quiet"]
    found = {f"energy_{name}_j": f"{joule:.4g}" for name, joule in chip["energy_j"].items()}
    found |= {"cores_min": chip["cores"][0], "cores_max": chip["cores"][1]}
    found |= {f"first_layer_{key}": _rounded(value, 1) for key, value in chip["first_layer"].items()}
    found |= {
        f"without_quiet_{key}": _rounded(lean[key], 0) for key in ("synaptic_operations", "first_layer_operations")
    }
    found |= {f"without_quiet_energy_{name}_j": f"{joule:.4g}" for name, joule in lean["energy_j"].items()}
    found |= {"without_quiet_cores_min": lean["cores"][0], "without_quiet_cores_max": lean["cores"][1]}
    return found | {"without_quiet_decisions_changed": lean["changed"]}


def _spread_columns(name: str, spread: Json | None) -> dict[str, Any]:
    return {f"{name}_{key}": _rounded(_of(spread, key)) for key in ("mean", "std", "low", "high")}


def _of(values: Json | None, key: str) -> Any:
    return None if values is None else values[key]


def _rounded(value: float | None, digits: int = 3) -> Any:
    if value is None:
        return None
    return round(value, digits) if digits else round(value)


# -- Markdown ----------------------------------------------------------------------------------------------------------


def markdown(kind: str, epochs: int, rows: Sequence[Json], noise: Sequence[Json], shorter: Sequence[Json]) -> str:
    """A table of the paper, one section for each data set.

    Parameters
    ----------
    kind : str
        ``methods`` or ``graphs``.
    epochs : int
        Of every training.
    rows : sequence of dict
        See :func:`table.rows`.
    noise : sequence of dict
        See :func:`noise.differences`.
    shorter : sequence of dict
        See :func:`table.schedules`; the graphs' table shows it.
    """
    planned = sum(row["planned"] for row in rows)
    missing = sum(len(row["missing"]) for row in rows)
    lines = [
        f"# {TITLES[kind]}",
        "",
        f"{epochs} epochs, the learning rate falls after every {DECAY_EPOCHS}; {planned - missing} of {planned} "
        "trainings are there. Accuracy in percent: mean (standard deviation) over the seeds, 95 % interval of the "
        f"mean. *Reproduced*: the paper's mean is within our mean by its protocol ± {MARGIN:g} combined standard "
        f"errors (the paper's of {RUNS} runs). Chip: Loihi 1 as simulated here, 8 bits, scales chosen on training "
        "recordings; operations and energy of an inference of a test recording, last epoch.",
    ]
    for data in dict.fromkeys(row["data"] for row in rows):
        of_data = [[each for each in found if each["data"] == data] for found in (rows, noise)]
        lines += ["", *_section(kind, data, *of_data)]
    if kind == "graphs":
        lines += [
            "",
            "`knn:K` and `mst:SIGMA` are without the repeated edges of the released code, with which the paper's ",
        ]
        lines[-1] += "figures were made; `released:NAME` has them."
        lines += ["", *_schedule_lines(epochs, shorter)]
    return "\n".join(lines) + "\n"


def _section(kind: str, data: str, rows: Sequence[Json], noise: Sequence[Json]) -> list[str]:
    samples = next((row["test_samples"] for row in rows if row["test_samples"]), None)
    one = f" ({samples} test recordings, one is {100 / samples:.2f})" if samples else ""
    heads = ["", "seeds", "paper", *HEADS.values(), "reproduced"]
    lines = [f"## {data}{one}", "", *pipes(heads, [_accuracies(row) for row in rows])]
    missing = sum(len(row["missing"]) for row in rows)
    if missing:
        lines += ["", f"Missing: {missing} trainings; `spikeloom reproduce --no-train --json -o FOLDER` names them."]
    lines += _noise_section(kind, noise)
    if any(row["seeds"] for row in rows):
        lines += _chip_section([row for row in rows if row["seeds"]])
    return lines


def _noise_section(kind: str, noise: Sequence[Json]) -> list[str]:
    """Whether rows differ by more than seeds do; nothing where there are too few."""
    held = [each for each in noise if each["between"] or each["with_operations"]]
    if not held:
        return []
    heads = ["differences", f"{kind} with two seeds or more", "deviation of their means", "by seeds alone", "F", "p"]
    heads += ["rank correlation with first-layer operations", "p"] if kind == "graphs" else []
    return ["", *pipes(heads, [_noise_cells(each)[: len(heads)] for each in held])]


def _noise_cells(each: Json) -> list[str]:
    between, rank = each["between"], each["with_operations"]
    words = [{**HEADS, "chip": "on the chip, last epoch"}[each["reading"]]]
    if between is None:
        words += [NONE] * 5
    else:
        words += [str(between["rows"]), f"{between['between']:.2f}", f"{between['expected']:.2f}"]
        words += [f"{between['f']:.2f}", _chance(between["p"])]
    return [*words, *([NONE] * 2 if rank is None else [f"{rank['rho']:+.2f}", _chance(rank["p"])])]


def _chance(p: float) -> str:
    return f"{p:.2f}" if p >= 0.005 else f"{p:.1g}"


def _chip_section(rows: Sequence[Json]) -> list[str]:
    """What is known of the chip, of rows that are there."""
    held = [row for row in rows if row["chip"]]
    energies = list(dict.fromkeys(name for row in held for name in row["chip"]["energy_j"]))
    heads = ["on the chip", "last epoch", "clean epoch", "decided as float", "operations", "of the first layer"]
    heads += [*(f"energy, {name}" for name in energies), "cores"]
    lines = ["", *pipes(heads, [_chip_cells(row, energies) for row in rows])]
    heads = ["first layer", "neurons", "cannot fire", "never fired in training", "nor in test"]
    heads += ["operations saved", "of the first layer", *(f"energy saved, {name}" for name in energies), "cores"]
    if held:
        lines += ["", *pipes([*heads, "decisions changed"], [_quiet_cells(row, energies) for row in held])]
    refused = [_refusal(row) for row in rows if row["refused"]]
    return [*lines, *([""] if refused else []), *refused]


def _refusal(row: Json) -> str:
    fit, seeds = row["chip"]["last"]["n"] if row["chip"] else 0, len(row["seeds"])
    what = f"{seeds - fit} of {seeds} seeds, the figures are of the others" if fit else "it"
    return f"- {name_of(row)}: Loihi 1 refuses {what}: {'; '.join(row['refused'])}"


def _accuracies(row: Json) -> list[str]:
    return [name_of(row), counted(row), paper_words(row), *(spread_words(row[p]) for p in PROTOCOLS), verdict(row)]


def counted(row: Json) -> str:
    """How many seeds there are, of how many where some are missing."""
    return f"{len(row['seeds'])} of {row['planned']}" if row["missing"] else str(len(row["seeds"]))


def paper_words(row: Json) -> str:
    """The paper's figure, or that it is not known."""
    paper = row["paper"]
    if paper is None:
        return UNKNOWN
    return f"{paper['mean']:.2f}" + ("" if paper["std"] is None else f" ({paper['std']:.2f})")


def spread_words(spread: Json | None) -> str:
    """Mean, standard deviation and interval.

    Examples
    --------
    >>> spread_words({"n": 3, "mean": 89.123, "std": 0.5, "low": 87.88, "high": 90.37})
    '89.12 (0.50), 87.9 … 90.4'
    >>> spread_words({"n": 1, "mean": 90.0, "std": None, "low": None, "high": None}), spread_words(None)
    ('90.00 (one seed)', 'missing')
    """
    if spread is None:
        return "missing"
    if spread["std"] is None:
        return f"{spread['mean']:.2f} (one seed)"
    words = f"{spread['mean']:.2f} ({spread['std']:.2f})"
    return words if spread["low"] is None else f"{words}, {spread['low']:.1f} … {spread['high']:.1f}"


def verdict(row: Json) -> str:
    """Whether the paper's mean is reproduced, with the figures behind it."""
    found = row["comparison"]
    if found is None:
        return NONE
    words = "yes" if found["within"] else "no"
    return f"{words}: {found['difference']:+.2f}, allowed ± {MARGIN * found['combined_se']:.2f}"


def _chip_cells(row: Json, energies: Sequence[str]) -> list[str]:
    chip = row["chip"]
    if chip is None:
        return [name_of(row), "refused", *[NONE] * (len(energies) + 5)]
    return [
        name_of(row),
        *(spread_words(chip[which]) for which in ("last", "clean")),
        f"{chip['equal']['last']:.1f} %",
        _millions(chip["synaptic_operations"]),
        _millions(chip["first_layer_operations"]),
        *(si(chip["energy_j"][name], "J") for name in energies),
        _range(chip["cores"]),
    ]


def _quiet_cells(row: Json, energies: Sequence[str]) -> list[str]:
    chip = row["chip"]
    layer, lean = chip["first_layer"], chip["without_quiet"]
    return [
        name_of(row),
        *(f"{layer[key]:,.0f}" for key in ("neurons", "cannot_fire", "quiet_in_training", "quiet_in_both")),
        *(_saved(chip[key], lean[key]) for key in ("synaptic_operations", "first_layer_operations")),
        *(_saved(chip["energy_j"][name], lean["energy_j"][name]) for name in energies),
        f"{_range(chip['cores'])} → {_range(lean['cores'])}",
        str(lean["changed"]),
    ]


def _millions(count: float) -> str:
    return f"{count / 1e6:.2f} M"


def _range(ends: Sequence[int]) -> str:
    return " … ".join(map(str, dict.fromkeys(ends)))


def _saved(before: float, after: float) -> str:
    return f"{100 * (1 - after / before):.1f} %" if before else NONE


def _schedule_lines(epochs: int, shorter: Sequence[Json]) -> list[str]:
    """What a shorter training loses, or why that is not known."""
    if epochs == EPOCHS:
        return [f"Trained as long as in the paper's protocol, {EPOCHS} epochs."]
    heads = [
        "manual graph",
        "protocol",
        f"{epochs} epochs",
        f"{EPOCHS} epochs",
        "difference",
        "standard error",
        "within",
    ]
    lines = [f"## {epochs} epochs against {EPOCHS}", "", *pipes(heads, map(_schedule_cells, shorter))]
    if not shorter or any("within" not in entry for entry in shorter):
        lines += ["", "Not shown everywhere yet: two seeds that both lengths have are needed."]
    return lines


def _schedule_cells(entry: Json) -> list[str]:
    words = [entry["data"], HEADS[entry["protocol"]], spread_words(entry["short"]), spread_words(entry["long"])]
    if "within" not in entry:
        return [*words, NONE, NONE, NONE]
    return [*words, f"{entry['difference']:+.2f}", f"{entry['se']:.2f}", "yes" if entry["within"] else "no"]


def pipes(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    r"""Lines of a Markdown table; the first column to the left, the others to the right.

    Examples
    --------
    >>> print("\n".join(pipes(["graph", "seeds"], [["manual", "5"]])))
    | graph | seeds |
    |---|---:|
    | manual | 5 |
    """
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return [lines[0], "|---" + "|---:" * (len(head) - 1) + "|", *lines[1:]]


# -- terminal ----------------------------------------------------------------------------------------------------------


def terminal(report: Json) -> str:
    """Accuracies of all tables, what is missing, and where everything is written."""
    lines = []
    for kind in TITLES:
        for data in dict.fromkeys(row["data"] for row in report.get(kind, ())):
            rows = [row for row in report[kind] if row["data"] == data]
            heads = [f"{kind}, {data}", "seeds", "paper", "best", "last", "clean", "chip, last", "reproduced"]
            lines += [table(heads, [_terminal_cells(row) for row in rows]), ""]
    missing = report["missing"]
    shown = ", ".join(missing[:3]) + (" …" if len(missing) > 3 else "")
    lines += [f"{report['finished']} of {report['planned']} trainings are there"]
    lines[-1] += f"; missing: {shown}" if missing else ""
    if report["elsewhere"]:
        lines.append(f"{report['elsewhere']} more cells in the folder are of other tables or lengths")
    return "\n".join([*lines, f"written: {', '.join(report['files'])}"])


def _terminal_cells(row: Json) -> list[str]:
    found = row["comparison"]
    return [
        name_of(row),
        counted(row),
        NONE if row["paper"] is None else paper_words(row),
        *(_short(row[protocol]) for protocol in PROTOCOLS),
        _chip_words(row),
        NONE if found is None else "yes" if found["within"] else "no",
    ]


def _chip_words(row: Json) -> str:
    if row["chip"] is None:
        return "refused" if row["refused"] else "missing"
    last = row["chip"]["last"]
    return _short(last) + (f", {last['n']} of {len(row['seeds'])} fit" if row["refused"] else "")


def _short(spread: Json | None) -> str:
    if spread is None:
        return "missing"
    return f"{spread['mean']:.2f}" + ("" if spread["std"] is None else f" ({spread['std']:.2f})")
