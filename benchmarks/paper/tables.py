"""The paper's tables from ``cells.json`` as CSV, Markdown and PNG: ``python benchmarks/paper/tables.py [FOLDER]``."""

import csv
import io
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

from cells import DATA, EPOCHS, RESULTS, RUNS, Cell, planned, read_cells
from pictures import pictures
from spreads import EQUAL, MARGIN, PROTOCOLS, READINGS, Line, Spread, lines_of, rank_correlation, variance

from spikeloom.compiler.files import write_atomically
from spikeloom.models.training.recipes import DECAY_EPOCHS
from spikeloom.runtime.report.numbers import si
from spikeloom.runtime.report.sections import Table

ENERGIES = ("davies2018", "sanafe")
COMPARABLE = ("best", "last")
"""Epochs of which each row is compared with the paper's; the clean epoch is not one that it can have read."""

FIRST_LAYER = ("neurons", "cannot_fire", "unheard", "quiet_in_training", "quiet_in_both")
COMPARED = ("difference", "combined_se", "within", "equal")
OPERATIONS = ("synaptic_operations", "first_layer_operations")


def main() -> None:
    """Write all files of a folder."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else RESULTS
    for name, content in files(read_cells(folder)).items():
        with write_atomically(folder / name) as file:
            file.write(content)
        print(folder / name)


def files(cells: Mapping[str, Cell], *, drawn: bool = True) -> dict[str, bytes]:
    """Content of every file by name."""
    found: dict[str, bytes] = {}
    summed: dict[str, Any] = {
        "command": "python benchmarks/paper/tables.py",
        "spikeloom": " ".join(sorted({cell["spikeloom"] for cell in cells.values()})),
        "data_sha256": {
            data: sorted({cell["data_sha256"] for cell in cells.values() if cell["data"] == data})
            for data in DATA
        },
    }
    for table in EPOCHS:
        lines = lines_of(table, planned(table), cells)
        found[f"{table}.csv"] = _csv(lines, planned(table)).encode()
        found[f"{table}.md"] = _markdown(table, lines, cells).encode()
        found |= pictures(table, lines) if drawn else {}
        of = {data: [line for line in lines if line.row.data == data] for data in DATA}
        summed[table] = {
            data: _statistics(each) | {"spans": _spans(each)} for data, each in of.items() if each
        }
    found["statistics.json"] = (json.dumps(_rounded(summed), indent=1, allow_nan=False) + "\n").encode()
    return found


def _rounded(value: Any) -> Any:
    """Keep 12 digits of every float: the last ones depend on the processor that added them up."""
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each) for each in value]
    return float(f"{value:.12g}") if isinstance(value, float) else value


# -- CSV ---------------------------------------------------------------------------------------------------------------


def _csv(lines: Sequence[Line], seeds: Mapping[Any, int]) -> str:
    text = io.StringIO()
    rows = [_flat(line, seeds.get(line.row, len(line.cells))) for line in lines]
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _flat(line: Line, planned_seeds: int) -> dict[str, Any]:
    row = line.row
    flat: dict[str, Any] = {"data": row.data, "system": row.system, "form": row.form, "epochs": row.epochs}
    flat |= {"seeds": " ".join(str(cell["seed"]) for cell in line.cells), "planned": planned_seeds}
    flat["test_samples"] = line.samples
    flat |= dict(zip(("paper_mean", "paper_std"), line.paper or (None, None), strict=True))
    for protocol in PROTOCOLS:
        flat |= _columns(protocol, line.accuracy(protocol))
    for reading in ("best", "last"):
        found = line.comparison(reading)
        values = (
            (round(found.difference, 3), round(found.error, 3), found.within, found.equal)
            if found
            else [""] * 4
        )
        flat |= dict(zip((f"{reading}_{key}" for key in COMPARED), values, strict=True))
    flat["chip_refused"] = ""
    for which, reading in (("last", "chip"), ("clean", "chip_clean")):
        flat |= _columns(f"chip_{which}", line.accuracy(reading))
        flat[f"chip_{which}_equal"] = round(line.equal(which), 3)
    flat |= {key: round(line.mean(key)) for key in OPERATIONS}
    flat |= {f"energy_{name}_j": f"{line.mean('energy_j', name):.4g}" for name in ENERGIES}
    flat |= dict(zip(("cores_min", "cores_max"), line.cores(), strict=True))
    flat |= {f"first_layer_{key}": round(line.mean("first_layer", key), 1) for key in FIRST_LAYER}
    lean = "without_quiet"
    flat |= {f"{lean}_{key}": round(line.mean(lean, key)) for key in OPERATIONS}
    flat |= {f"{lean}_energy_{name}_j": f"{line.mean(lean, 'energy_j', name):.4g}" for name in ENERGIES}
    flat |= dict(zip((f"{lean}_cores_min", f"{lean}_cores_max"), line.cores(lean), strict=True))
    return flat | {f"{lean}_decisions_changed": line.changed}


def _columns(name: str, spread: Spread) -> dict[str, Any]:
    low, high = spread.interval or (None, None)
    values = {"mean": spread.mean, "std": spread.std, "low": low, "high": high}
    return {f"{name}_{key}": "" if value is None else round(value, 5) for key, value in values.items()}


# -- Markdown ----------------------------------------------------------------------------------------------------------


def _markdown(table: str, lines: Sequence[Line], cells: Mapping[str, Cell]) -> str:
    wanted = sum(planned(table).values())
    there = sum(len(line.cells) for line in lines)
    parts = [
        f"# {table.capitalize()}",
        f"{EPOCHS[table]} epochs, the learning rate falls after every {DECAY_EPOCHS}; {there} of {wanted} "
        "trainings are there. Accuracy in percent: mean (standard deviation) over the seeds, 95 % interval of the "
        "mean. The paper's text does not say which epoch it reads. *Less the paper's*: our mean less its mean, and "
        f"whether that is within {MARGIN:g} combined standard errors (the paper's of {RUNS} runs), which shows no "
        f"difference but no equality either; *equal*: shown to be within {EQUAL:g} points (both one-sided tests, 5 %). "
        "Chip: Loihi 1 as simulated here, 8 bits, scales chosen on training "
        "recordings; operations and energy of an inference of a test recording, last epoch.",
    ]
    for data in dict.fromkeys(line.row.data for line in lines):
        of_data = [line for line in lines if line.row.data == data]
        samples = of_data[0].samples
        parts.append(f"## {data} ({samples} test recordings, one is {100 / samples:.2f})")
        statistics = _statistics(of_data)
        parts += [_marked(_accuracies(of_data)), _marked(_agreement(statistics))]
        parts += [_marked(_noise(table, statistics)), _marked(_chip(of_data)), _marked(_quiet(of_data))]
    if table == "graphs":
        parts.append(
            "`knn:K` and `mst:SIGMA` are without the repeated edges of the released code, with which the paper's "
            "figures were made: in the released lists all but manual and `mst:0` have some edges twice, which the "
            "normalisation counts twice; `released:NAME` has them. `mst:1.5`, without them, is `mst:0`."
        )
        parts += [f"## {EPOCHS['graphs']} epochs against {EPOCHS['methods']}", _marked(_schedule(cells))]
    return "\n\n".join(parts) + "\n"


def _marked(table: Table) -> str:
    ruler = "|".join(["---", *(["---" if table.words else "---:"] * (len(table.head) - 1))])
    lines = [f"| {' | '.join(row)} |" for row in (table.head, *table.rows)]
    return "\n".join([lines[0], f"|{ruler}|", *lines[1:]])


def _accuracies(lines: Sequence[Line]) -> Table:
    rows = []
    for line in lines:
        paper = "—" if line.paper is None else f"{line.paper[0]:.2f} ({line.paper[1]:.2f})"
        spreads = (line.accuracy(protocol).words() for protocol in PROTOCOLS)
        rows.append(
            [
                line.name,
                str(len(line.cells)),
                paper,
                *spreads,
                *(_against(line, which) for which in COMPARABLE),
            ]
        )
    less = (f"less the paper's, {PROTOCOLS[which]}" for which in COMPARABLE)
    return Table(["", "seeds", "paper", *PROTOCOLS.values(), *less], rows)


def _against(line: Line, reading: str) -> str:
    found = line.comparison(reading)
    if found is None:
        return "—"
    verdict = f"{'within' if found.within else 'beyond'} {MARGIN * found.error:.2f}"
    return f"{found.difference:+.2f}, {verdict}{', equal' if found.equal else ''}"


def _statistics(lines: Sequence[Line]) -> dict[str, Any]:
    """By epoch: how the rows of a data set go with the paper's, and whether they differ by more than seeds do."""
    found: dict[str, Any] = {}
    several = [line for line in lines if line.paper is not None]
    papers = [line.paper[0] for line in several if line.paper]
    for reading in READINGS:
        spread = variance([line.accuracy(reading).values for line in lines])
        costs = [line.mean("first_layer_operations") for line in lines]
        ranks = {"operations": rank_correlation([line.accuracy(reading).mean for line in lines], costs)}
        found[reading] = {"variance": spread and asdict(spread)}
        if reading in PROTOCOLS:
            against = [each for line in several if (each := line.comparison(reading))]
            ours = [line.accuracy(reading).mean for line in several]
            ranks["spearman"] = rank_correlation(ours, papers)
            ranks["kendall"] = rank_correlation(ours, papers, kendall=True)
            found[reading] |= {"rows": len(against)}
            found[reading]["difference"] = fmean(each.difference for each in against) if against else None
            found[reading] |= {
                key: sum(getattr(each, key) for each in against) for key in ("within", "equal")
            }
        found[reading] |= {
            key: rank and dict(zip(("rank", "p"), rank, strict=True)) for key, rank in ranks.items()
        }
    return found


def _spans(lines: Sequence[Line]) -> dict[str, Any]:
    """How far rows lie apart: points of accuracy, factors of costs, shares of silent neurons, and what these save."""
    costs = {key: [line.mean(key) for line in lines] for key in OPERATIONS}
    costs["energy"] = [line.mean("energy_j", ENERGIES[0]) for line in lines]
    papers = [line.paper[0] for line in lines if line.paper]
    means = {reading: [line.accuracy(reading).mean for line in lines] for reading in PROTOCOLS}
    first = {key: [line.mean("first_layer", key) for line in lines] for key in FIRST_LAYER}
    silent = [sum(each) for each in zip(first["cannot_fire"], first["quiet_in_training"], strict=True)]
    left = {"first_layer_operations": ("first_layer_operations",), "energy": ("energy_j", ENERGIES[0])}
    saved = {
        key: [1 - line.mean("without_quiet", *at) / line.mean(*at) for line in lines]
        for key, at in left.items()
    }
    return {
        "paper_points": max(papers) - min(papers) if papers else None,
        "points": {reading: max(each) - min(each) for reading, each in means.items()},
        "best_above_last": [a - b for a, b in zip(means["best"], means["last"], strict=True)],
        "factor": {key: max(each) / min(each) for key, each in costs.items()},
        "cannot_fire": first["cannot_fire"],
        "silent": [count / of for count, of in zip(silent, first["neurons"], strict=True)],
        "saved": {key: max(each) for key, each in saved.items()},
        "changed": sum(line.changed for line in lines),
        "decisions": sum(line.samples * len(line.cells) for line in lines),
    }


def _agreement(statistics: Mapping[str, Any]) -> Table:
    """How the rows of a data set go with the paper's; of few rows a rank correlation has no p."""
    rows = []
    for reading, title in PROTOCOLS.items():
        each = statistics[reading]
        cells = []
        for rank in (each["spearman"], each["kendall"]):
            cells.append("—" if rank is None else f"{rank['rank']:+.2f}")
            cells.append("—" if rank is None or each["rows"] < 6 else _chance(rank["p"]))
        difference = "—" if each["difference"] is None else f"{each['difference']:+.2f}"
        counts = (f"{each[key]} of {each['rows']}" for key in ("within", "equal"))
        rows.append([title, *cells, difference, *counts])
    head = ["with the paper's rows", "Spearman", "p", "Kendall", "p", "mean difference"]
    return Table([*head, f"within {MARGIN:g} standard errors", f"equal within {EQUAL:g} points"], rows)


def _noise(table: str, statistics: Mapping[str, Any]) -> Table:
    """Whether rows differ by more than their seeds do, and with what they cost."""
    head = [
        "differences",
        f"{table} with two seeds or more",
        "deviation of their means",
        "by seeds alone",
        "F",
        "p",
    ]
    head += ["rank correlation with first-layer operations", "p"] if table == "graphs" else []
    rows = []
    for reading, title in READINGS.items():
        found, rank = statistics[reading]["variance"], statistics[reading]["operations"]
        cells = ["—"] * 5
        if found is not None:
            means = (f"{found[key]:.2f}" for key in ("between", "expected", "f"))
            cells = [str(found["rows"]), *means, _chance(found["p"])]
        cells += ["—"] * 2 if rank is None else [f"{rank['rank']:+.2f}", _chance(rank["p"])]
        rows.append([title, *cells][: len(head)])
    return Table(head, rows)


def _chance(p: float) -> str:
    return f"{p:.2f}" if p >= 0.005 else f"{p:.1g}"


def _chip(lines: Sequence[Line]) -> Table:
    head = [
        "on the chip",
        "last epoch",
        "clean epoch",
        "decided as float",
        "operations",
        "of the first layer",
    ]
    rows = [
        [
            line.name,
            *(line.accuracy(reading).words() for reading in ("chip", "chip_clean")),
            f"{line.equal('last'):.1f} %",
            *(f"{line.mean(key) / 1e6:.2f} M" for key in OPERATIONS),
            *(si(line.mean("energy_j", name), "J") for name in ENERGIES),
            _range(line.cores()),
        ]
        for line in lines
    ]
    return Table([*head, *(f"energy, {name}" for name in ENERGIES), "cores"], rows)


def _quiet(lines: Sequence[Line]) -> Table:
    """First-layer neurons that never fire, and what leaving them out saves."""
    head = [
        "first layer",
        "neurons",
        "cannot fire",
        "never fired in training",
        "nor in test",
        "operations saved",
    ]
    head += [
        "of the first layer",
        *(f"energy saved, {name}" for name in ENERGIES),
        "cores",
        "decisions changed",
    ]
    rows = []
    for line in lines:
        saved = [(key,) for key in OPERATIONS] + [("energy_j", name) for name in ENERGIES]
        rows.append(
            [
                line.name,
                *(f"{line.mean('first_layer', key):,.0f}" for key in FIRST_LAYER if key != "unheard"),
                *(
                    f"{100 * (1 - line.mean('without_quiet', *keys) / line.mean(*keys)):.1f} %"
                    for keys in saved
                ),
                f"{_range(line.cores())} → {_range(line.cores('without_quiet'))}",
                str(line.changed),
            ]
        )
    return Table(head, rows)


def _range(ends: tuple[int, int]) -> str:
    return " … ".join(map(str, dict.fromkeys(ends)))


def _schedule(cells: Mapping[str, Cell]) -> Table:
    """What the shorter training loses on the manual graph, over the seeds that both have."""
    short, long = (
        {line.row.data: line for line in lines_of(table, planned(table), cells) if line.name.endswith(name)}
        for table, name in (("graphs", "manual"), ("methods", "TactileSGNet, manual graph"))
    )
    rows = []
    for data in sorted(short.keys() & long.keys()):
        seeds = {cell["seed"] for cell in short[data].cells} & {cell["seed"] for cell in long[data].cells}
        for protocol, title in PROTOCOLS.items():
            ours, whole = (
                Spread(
                    tuple(100 * cell[protocol]["accuracy"] for cell in each.cells if cell["seed"] in seeds)
                )
                for each in (short[data], long[data])
            )
            error, difference = (whole.std or 0.0) / len(seeds) ** 0.5, ours.mean - whole.mean
            within = "yes" if abs(difference) <= error else "no"
            rows.append(
                [data, title, ours.words(), whole.words(), f"{difference:+.2f}", f"{error:.2f}", within]
            )
    head = ["manual graph", "epoch", *(f"{EPOCHS[table]} epochs" for table in ("graphs", "methods"))]
    return Table([*head, "difference", "standard error", "within"], rows)


if __name__ == "__main__":
    main()
