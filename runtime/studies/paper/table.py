"""Statistics of the paper's tables: means over seeds by both protocols, beside the published ones, and chip figures.

All accuracies are in percent; intervals are Student's, of the mean, at 95 %.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from spikeloom.compiler.systems import SYSTEMS, TACTILESGNET
from spikeloom.models.training.schedule import EPOCHS
from spikeloom.runtime.report.intervals import of_mean
from spikeloom.runtime.studies.paper.cells import GRAPHS, Part, Row, row_of
from spikeloom.runtime.studies.paper.published import RECORDINGS, RUNS, Published, published

Json = dict[str, Any]
Cells = Mapping[str, Json]

PROTOCOLS = ("best", "last", "clean")
"""The paper's protocol first."""

MARGIN = 2.0
"""Combined standard errors within which the paper's mean is said to be reproduced."""


def spread(values: Sequence[float]) -> Json | None:
    """Number, mean, standard deviation and interval of the mean of some accuracies; the last two need two values.

    An interval ends where accuracies do, at 0 and 100. Equal values do not tell how wide it is.

    Examples
    --------
    >>> found = spread([90.0, 88.0])
    >>> {name: round(found[name], 3) for name in ("n", "mean", "std", "low", "high")}
    {'n': 2, 'mean': 89.0, 'std': 1.414, 'low': 76.294, 'high': 100.0}
    >>> spread([90.0]), spread([])
    ({'values': [90.0], 'n': 1, 'mean': 90.0, 'std': None, 'low': None, 'high': None}, None)
    """
    if not values:
        return None
    mean = statistics.fmean(values)
    if len(values) == 1:
        return {"values": [mean], "n": 1, "mean": mean, "std": None, "low": None, "high": None}
    low, high = of_mean(values)
    wide = len(set(values)) > 1
    return {
        "values": list(values),
        "n": len(values),
        "mean": mean,
        "std": statistics.stdev(values),
        "low": max(low, 0.0) if wide else None,
        "high": min(high, 100.0) if wide else None,
    }


def compare(ours: Json | None, theirs: Published | None) -> Json | None:
    """Whether a published mean lies within two combined standard errors of ours; None where that cannot be told.

    Examples
    --------
    >>> compare(spread([89.0, 91.0]), Published(mean=88.0, std=1.0))
    {'difference': 2.0, 'combined_se': 1.0488088481701516, 'within': True}
    """
    if ours is None or ours["std"] is None or theirs is None or theirs.std is None:
        return None
    combined = math.sqrt(ours["std"] ** 2 / ours["n"] + theirs.std**2 / RUNS)
    difference = ours["mean"] - theirs.mean
    return {"difference": difference, "combined_se": combined, "within": abs(difference) <= MARGIN * combined}


def rows(part: Part, cells: Cells) -> list[Json]:
    """A table: its planned rows, and others of its kind that there are cells of, with what is known of each."""
    members: dict[Row, list[Json]] = {row: [] for row in part.seeds}
    for cell in cells.values():
        row = row_of(cell)
        if row in members or _belongs(part, row):
            members.setdefault(row, []).append(cell)
    hashes = {cell["data"]: cell["data_sha256"] for cell in cells.values()}
    return [
        _row(part, row, sorted(found, key=lambda cell: cell["seed"]), hashes.get(row.data, ""))
        for row, found in sorted(members.items(), key=lambda member: _place(member[0]))
    ]


def _place(row: Row) -> tuple[Any, ...]:
    """Order of rows: data sets, systems and graphs as the paper has them, then all others by name."""
    of_data, of_system, of_graph = (
        (list(names).index(name) if name in names else len(names), name)
        for names, name in ((RECORDINGS, row.data), (SYSTEMS, row.system), (GRAPHS, row.form))
    )
    return of_data, of_system, of_graph


def _belongs(part: Part, row: Row) -> bool:
    """Whether a row that was not planned is of this table all the same."""
    if row.epochs != part.epochs:
        return False
    return row.system == TACTILESGNET if part.table == "graphs" else row.system != TACTILESGNET or row.form == "manual"


def _row(part: Part, row: Row, cells: list[Json], sha256: str) -> Json:
    there = [cell["seed"] for cell in cells]
    planned = part.seeds.get(row, part.usual[row.system])
    found: Json = {
        "table": part.table,
        "data": row.data,
        "system": row.system,
        "form": row.form,
        "epochs": row.epochs,
        "seeds": there,
        "planned": planned,
        "cells": [row.cell(seed) for seed in there],
        "missing": [row.cell(seed) for seed in range(planned) if seed not in there],
        "test_samples": cells[0]["test_samples"] if cells else None,
    }
    for protocol in PROTOCOLS:
        found[protocol] = spread([100 * cell[protocol]["accuracy"] for cell in cells])
    theirs = published(row.data, sha256, row.system, row.form)
    found["paper"] = None if theirs is None else {"mean": theirs.mean, "std": theirs.std, "runs": RUNS}
    found["comparison"] = compare(found["best"], theirs)
    return found | _on_chip(cells)


def _on_chip(cells: list[Json]) -> Json:
    """Chip figures of the cells that have them; costs are those of the last epoch."""
    chips = [cell["chip"] for cell in cells if "refused" not in cell["chip"]]
    found: Json = {"refused": next((cell["chip"]["refused"] for cell in cells if "refused" in cell["chip"]), None)}
    if not chips:
        return found | {"chip": None}
    samples = cells[0]["test_samples"]
    last = [chip["last"] for chip in chips]
    costs = {key: _mean(last, key) for key in ("synaptic_operations", "first_layer_operations", "neurons", "synapses")}
    lean = [figures["without_quiet"] for figures in last]
    layers = [figures["first_layer"] for figures in last]
    return found | {
        "chip": {
            **{
                which: spread([100 * chip[which]["correct"] / samples for chip in chips]) for which in ("last", "clean")
            },
            "equal": {
                which: statistics.fmean(100 * chip[which]["equal"] / samples for chip in chips)
                for which in ("last", "clean")
            },
            **costs,
            "energy_j": _means(last, "energy_j"),
            "first_layer_energy_j": _means(last, "first_layer_energy_j"),
            "cores": _ends(last),
            "first_layer": {key: _mean(layers, key) for key in layers[0]},
            "without_quiet": {
                "changed": sum(samples - figures["equal_to_chip"] for figures in lean),
                "accuracy": spread([100 * figures["correct"] / samples for figures in lean]),
                **{key: _mean(lean, key) for key in costs},
                "energy_j": _means(lean, "energy_j"),
                "cores": _ends(lean),
            },
        }
    }


def _mean(figures: Sequence[Json], key: str) -> float:
    return statistics.fmean(each[key] for each in figures)


def _means(figures: Sequence[Json], key: str) -> dict[str, float]:
    return {name: statistics.fmean(each[key][name] for each in figures) for name in figures[0][key]}


def _ends(figures: Sequence[Json]) -> list[int]:
    cores = [each["cores"] for each in figures]
    return [min(cores), max(cores)]


def schedules(cells: Cells, epochs: int) -> list[Json]:
    """What a shorter training loses against the released one, on the manual graph of each data set.

    It is the beginning of that one, seed by seed, so means are over the seeds that both have; held against the standard
    error of the whole one.

    Parameters
    ----------
    cells : mapping of str to dict
        All that there are.
    epochs : int
        Of the shorter training; nothing is told where it is not shorter.
    """
    if epochs == EPOCHS:
        return []
    found = []
    for data in dict.fromkeys(cell["data"] for cell in cells.values()):
        of_length: list[dict[int, Json]] = []
        for length in (epochs, EPOCHS):
            row = Row(data=data, system=TACTILESGNET, form="manual", epochs=length)
            of_length.append({cell["seed"]: cell for cell in cells.values() if row_of(cell) == row})
        shared = sorted(of_length[0].keys() & of_length[1].keys())
        for which in PROTOCOLS:
            short, long = (spread([100 * of[seed][which]["accuracy"] for seed in shared]) for of in of_length)
            entry: Json = {"data": data, "protocol": which, "epochs": epochs, "short": short, "long": long}
            if short and long and long["std"] is not None:
                error = long["std"] / math.sqrt(long["n"])
                difference = short["mean"] - long["mean"]
                entry |= {"difference": difference, "se": error, "within": abs(difference) <= error}
            found.append(entry)
    return found
