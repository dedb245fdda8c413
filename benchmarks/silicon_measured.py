"""Measured chips beside predictions: ``python benchmarks/silicon_measured.py LOGS.zip PREDICTIONS.json OUT.json PNG``.

LOGS are the power logs of github.com/abr/power_benchmarks (``loihi-power-logs.zip``: a folder ``running`` and a folder
``idle``), PREDICTIONS what ``silicon.py`` wrote before. Figures of two networks that SLAYER trained are those that the
notebooks of github.com/intel-nrc-ecosystem/models print. An energy of the logs is the mean power of a run less that of
the board after it, its x86 cores awake, over inferences a second.
"""

import csv
import hashlib
import io
import json
import sys
import zipfile
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from made import made

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.types import FloatArray

mpl.use("Agg")
from matplotlib import pyplot as plt

Json = dict[str, Any]

STAMP = "%Y-%m-%d_%H:%M:%S.%f"
COLUMNS = {"total": "Total Power (W)", "VDD": "P_VDD", "VDDM": "P_VDDM"}
SETTLED = 1.0
"""Seconds after the end of a run from which the board counts as at rest."""

NOTEBOOKS = {
    "braille": {
        "cores": 52,
        "step_s": 6.640671060008044e-06,
        "sample_j": 132.40603359009617e-6,
        "steps": 270,
        "static_w": 2 * 89.08402777777778e-3,
    },
    "ntidigits": {
        "cores": 6,
        "step_s": 17.6250417494265e-06,
        "sample_j": 575.9630912620312e-6,
        "steps": 3000,
    },
}
"""Of one copy of a network on a chip that holds several: its cores that are not empty, dynamic energy.

Static power is that of a chip, which held two copies.
"""

CORES_A_BRANCH = 10


def readings(text: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Seconds and watts by rail of a log."""
    rows = list(csv.DictReader(io.StringIO(text)))
    at = np.array([datetime.strptime(row["Time"], STAMP).timestamp() for row in rows])
    return at, {rail: np.array([float(row[name]) for row in rows]) for rail, name in COLUMNS.items()}


def measured(logs: zipfile.ZipFile) -> dict[str, Json]:
    """By network the means over its runs: inferences a second, watts by rail running, after it, with the x86 off."""
    runs: dict[str, list[Json]] = {}
    for name in sorted(logs.namelist()):
        if not name.startswith("running/") or not name.endswith(".json"):
            continue
        about = json.loads(logs.read(name))
        log = name.removesuffix("json") + "csv"
        at, watts = readings(logs.read(log).decode())
        _, idle = readings(logs.read(log.replace("running", "idle")).decode())
        begin, end = (datetime.strptime(about[key], STAMP).timestamp() for key in ("start_time", "end_time"))
        network = f"N={about['n_copies']}" if "n_layers" in about else "spotter"
        runs.setdefault(network, []).append(
            {
                "inferences_per_s": about["n_inferences"] / (end - begin),
                "running_w": {k: v[(at >= begin) & (at <= end)].mean() for k, v in watts.items()},
                "after_w": {k: v[at > end + SETTLED].mean() for k, v in watts.items()},
                "idle_w": {k: v.mean() for k, v in idle.items()},
            }
        )
    return {network: mean_of(each) for network, each in runs.items()}


def mean_of(runs: list[Json]) -> Json:
    """Means over runs, and joules an inference by rail."""
    powers = {
        key: {rail: float(np.mean([run[key][rail] for run in runs])) for rail in COLUMNS}
        for key in ("running_w", "after_w", "idle_w")
    }
    speed = float(np.mean([run["inferences_per_s"] for run in runs]))
    joules = {
        rail: float(
            np.mean([(r["running_w"][rail] - r["after_w"][rail]) / r["inferences_per_s"] for r in runs])
        )
        for rail in COLUMNS
    }
    return {"runs": len(runs), "inferences_per_s": speed, "inference_j": joules, **powers}


class Predictions:
    """What was predicted, by network and level."""

    def __init__(self, stored: Json) -> None:
        self.rows = stored["rows"]
        self.slope = stored["slope_per_branch_j"]
        self.inference = stored["inference_steps"]
        self.tables = list(self.rows[0]["energy_per_step_j"])

    def ends(self, found: Mapping[str, float]) -> Json:
        """Least, central and most of an amount by level."""
        return {"least": min(found.values()), "central": found["central"], "most": max(found.values())}

    def means(self, of: Callable[[Json], float], **where: object) -> Json:
        """Ends of the means over the rows that are such."""
        levels: dict[str, list[float]] = {}
        for row in self.rows:
            if all(row.get(key) == value for key, value in where.items()):
                levels.setdefault(row["level"], []).append(of(row))
        return self.ends({level: float(np.mean(each)) for level, each in levels.items()})

    def layout(self, network: str, of: Callable[[Json], float], layout: str = "published") -> Json:
        """Of a network of a file in a layout."""
        return self.means(of, network=network, layout=layout)

    def keyword(self, network: str, of: Callable[[Json], float]) -> Json:
        """Of a keyword network; of one with branches by the straight line through all draws of a level."""
        branches = int(network[2:]) if network.startswith("N=") else 0
        if not branches:
            return self.means(of, network=network)
        levels: dict[str, list[tuple[float, float]]] = {}
        for row in self.rows:
            if row.get("branches"):
                levels.setdefault(row["level"], []).append((row["branches"], of(row)))
        lines = {level: np.polyfit(*zip(*pairs, strict=True), 1) for level, pairs in levels.items()}
        return self.ends({level: float(np.polyval(line, branches)) for level, line in lines.items()})

    def branch(self, table: str, part: str) -> Json:
        """Joules an inference of a further branch."""
        return self.ends({level: by[table][part] for level, by in self.slope.items()})

    def synapse_share(self, table: str) -> Json:
        """Share of synapses in a further branch."""
        by = {level: each[table] for level, each in self.slope.items()}
        return self.ends({level: each["synapse"] / each["all"] for level, each in by.items()})


def point(name: str, unit: str, value: float, predicted: Mapping[str, Json], lacking: str) -> Json:
    """A measured amount, what each table says, their ratio, and how many times what a table says was measured."""
    ratio = {table: {end: each / value for end, each in ends.items()} for table, ends in predicted.items()}
    times = {table: value / ends["central"] for table, ends in predicted.items()}
    return {
        "name": name,
        "unit": unit,
        "measured": value,
        "predicted": predicted,
        "ratio": ratio,
        "times": times,
        "lacking": lacking,
    }


IO = "input and read-out through the x86 cores, and what they do in each step"
BRANCH = "power of a core that runs, or the price of its step"
FED = "the x86 cores, which inject the input and have phases of their own in each step"


def points(found: dict[str, Json], told: Predictions) -> list[Json]:
    """Every measured amount."""
    beside = []
    inference = {table: energy_of(table, told.inference) for table in told.tables}
    for name, each in found.items():
        by = {table: told.keyword(name, of) for table, of in inference.items()}
        beside.append(point(f"{name}, an inference", "J", each["inference_j"]["total"], by, IO))
    slope = {table: told.branch(table, "all") for table in told.tables}
    beside.append(point("a branch, an inference", "J", slope_of(found, "total"), slope, BRANCH))
    for name, note in NOTEBOOKS.items():
        by = {table: told.layout(name, energy_of(table, note["steps"])) for table in told.tables}
        beside.append(point(f"{name}, a sample", "J", note["sample_j"], by, FED))
    for name in ("spotter", "N=0", "N=10"):
        seconds = 1 / found[name]["inferences_per_s"] / told.inference
        beside.append(point(f"{name}, a step", "s", seconds, {"sanafe": told.keyword(name, step_of)}, IO))
    for name, note in NOTEBOOKS.items():
        beside.append(
            point(f"{name}, a step", "s", note["step_s"], {"sanafe": told.layout(name, step_of)}, FED)
        )
    for name, note in NOTEBOOKS.items():
        by = {layout: told.layout(name, cores_of, layout) for layout in ("published", "ours")}
        beside.append(
            point(f"{name}, cores", "cores", note["cores"], by, "neurons per core were given by hand")
        )
    return beside


def energy_of(table: str, steps: float) -> Callable[[Json], float]:
    """Joules of so many steps of a row."""
    return lambda row: steps * float(row["energy_per_step_j"][table])


def step_of(row: Json) -> float:
    """Seconds of a step of a row."""
    return float(row["step_s"]["sanafe"])


def cores_of(row: Json) -> float:
    """Cores of a row."""
    return float(row["cores"])


def family(found: dict[str, Json]) -> tuple[FloatArray, list[str]]:
    """Branches of the scaled networks that have any, and their names."""
    names = sorted(
        (name for name in found if name.startswith("N=") and name != "N=0"), key=lambda n: int(n[2:])
    )
    return np.array([float(name[2:]) for name in names]), names


def slope_of(found: dict[str, Json], rail: str) -> float:
    """Joules an inference of each further branch, measured: least squares over N of 1 and more."""
    branches, names = family(found)
    return float(np.polyfit(branches, [found[name]["inference_j"][rail] for name in names], 1)[0])


def missing_term(found: dict[str, Json], told: Predictions, table: str) -> Json:
    """What is missing a branch, as power of a core that runs and as price of its step; each network left out once.

    The residual of a network is its measured energy less what the others predict with events of the table at the
    central level, a constant for input and output, and the term, as a share of the measured; of networks outside the
    family stands what share of the measured the term alone would be.
    """
    branches, names = family(found)
    seconds = np.array([1 / found[name]["inferences_per_s"] for name in names])
    energy = np.array([found[name]["inference_j"]["total"] for name in names])
    events = branches * told.slope["central"][table]["all"]
    terms = {
        "running_core_w": branches * CORES_A_BRANCH * seconds,
        "core_step_j": branches * CORES_A_BRANCH * told.inference,
    }
    found_terms: Json = {}
    for term, amount in terms.items():
        left = np.stack([np.ones_like(amount), amount], axis=1)
        residual = {}
        for index, name in enumerate(names):
            others = np.arange(len(names)) != index
            fit = np.linalg.lstsq(left[others], (energy - events)[others], rcond=None)[0]
            residual[name] = float((energy[index] - events[index] - left[index] @ fit) / energy[index])
        value = float(np.linalg.lstsq(left, energy - events, rcond=None)[0][1])
        elsewhere = {}
        for name, note in NOTEBOOKS.items():
            a_step = value * note["cores"] * (note["step_s"] if term == "running_core_w" else 1)
            elsewhere[name] = a_step * note["steps"] / note["sample_j"]
        largest = max(abs(each) for each in residual.values())
        found_terms[term] = {
            "value": value,
            "residual": residual,
            "largest_residual": largest,
            "share_elsewhere": elsewhere,
        }
    return found_terms


def rails(found: dict[str, Json], told: Predictions) -> Json:
    """Share of memory in what a branch takes: the rail VDDM, and synapses, by table and level."""
    share = {rail: slope_of(found, rail) for rail in COLUMNS}
    return {
        "branch_j": share,
        "memory_share": share["VDDM"] / share["total"],
        "synapse_share": {table: told.synapse_share(table) for table in told.tables},
    }


def draw(rows: list[Json], path: Path) -> None:
    """Predicted over measured energies, with the interval over what is not known."""
    colours = {"davies2018": "#1b7f5c", "sanafe": "#c4622d"}
    figure, panel = plt.subplots(figsize=(6.4, 5.2), layout="constrained")
    shown = [row for row in rows if row["unit"] == "J"]
    limits = np.array([10.0, 1000.0])
    panel.fill_between(
        limits, limits / 1.5, limits * 1.5, color="#9aa5b1", alpha=0.25, lw=0, label="within 1.5"
    )
    panel.plot(limits, limits, "--", color="#9aa5b1", lw=1)
    for table, colour in colours.items():
        x = np.array([row["measured"] for row in shown]) * 1e6
        ends = [
            np.array([row["predicted"][table][end] for row in shown]) * 1e6
            for end in ("least", "central", "most")
        ]
        shift = 1.03 if table == "sanafe" else 1 / 1.03
        panel.errorbar(
            x * shift,
            ends[1],
            [ends[1] - ends[0], ends[2] - ends[1]],
            fmt="o",
            ms=4,
            lw=1,
            color=colour,
            label=table,
        )
    for row in shown:
        at = max(row["predicted"][table]["most"] for table in colours) * 1e6
        panel.annotate(row["name"].split(",")[0], (row["measured"] * 1e6, at), (0, 4), textcoords="offset points",
                       fontsize=7, ha="center", rotation=60)  # fmt: skip
    panel.set(xscale="log", yscale="log", xlim=limits, ylim=(0.2, 5000))
    panel.set_xlabel("measured, µJ an inference")
    panel.set_ylabel("predicted, µJ; lines: what is not known of rates and input")
    panel.legend(frameon=False, fontsize=8)
    panel.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Write measured amounts, points, rails and the missing term, and draw the energies."""
    logs, predictions, out, picture = map(Path, sys.argv[1:])
    told = Predictions(json.loads(predictions.read_text()))
    with zipfile.ZipFile(logs) as archive:
        found = measured(archive)
    content = made() | {
        "data_sha256": hashlib.sha256(logs.read_bytes()).hexdigest(),
        "predictions_sha256": hashlib.sha256(predictions.read_bytes()).hexdigest(),
        "measured": found,
        "points": (rows := points(found, told)),
        "rails": rails(found, told),
        "static_w": NOTEBOOKS["braille"]["static_w"],
        "missing": {table: missing_term(found, told, table) for table in told.tables},
    }
    with write_atomically(out) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())
    draw(rows, picture)


if __name__ == "__main__":
    main()
