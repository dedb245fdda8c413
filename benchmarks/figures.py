"""Figures of commands that the docs quote, stored: what ``benchmarks/claims.toml`` binds texts to.

    python benchmarks/figures.py FOLDER [STUDY...]

FOLDER holds ``Ev-Objects.zip`` and ``Ev-Containers.zip``, the released ``objects_manual.t7`` and, for the chart of
Containers, ``containers-knn1.pt`` (``spikeloom train --data Ev-Containers.zip --graph knn:1``), for its processor
``containers-200ms.pt``: ``spikeloom train --data Ev-Containers.zip --join 10 --graph manual --recipe timed --keep last
--current-decay fc1=0.6,fc2=0.6,fc3=0.6``. Each study is a file in benchmarks/results, with the commands, the hash of
the recordings and the version that made it.
"""

import argparse
import json
import re
import shlex
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from scipy.stats import binomtest, ttest_ind

import spikeloom
from spikeloom.compiler.files import write_atomically
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import data_digest
from spikeloom.runtime.report.drawing import matrices
from spikeloom.runtime.report.numbers import wilson

Json = dict[str, Any]

RESULTS = Path(__file__).parent / "results"
OBJECTS, CONTAINERS, MANUAL = "Ev-Objects.zip", "Ev-Containers.zip", "objects_manual.t7"
SHIPPED = {  # Row: network with its options, recordings, options of `compile`
    "objects_manual": (f"{MANUAL} --graph manual", OBJECTS, ""),
    "objects_manual, spike-exact": (f"{MANUAL} --graph manual", OBJECTS, "--spike-exact"),
    "objects": ("pretrained:objects", OBJECTS, ""),
    "objects-200ms": ("pretrained:objects-200ms", OBJECTS, "--weight-bits 8"),
    "objects-200ms, spike-exact": ("pretrained:objects-200ms", OBJECTS, "--spike-exact"),
    "containers": ("pretrained:containers", CONTAINERS, "--weight-bits 8"),
    "objects-counters": ("pretrained:objects-counters", OBJECTS, ""),
    "containers-counters": ("pretrained:containers-counters", CONTAINERS, ""),
    "grasps": ("pretrained:grasps", "synthetic", ""),
}
NETWORKS = ("objects", "objects-200ms", "objects-truenorth", "containers", "containers-truenorth", "grasps")
PROCESSOR = {  # Networks with options of `compile`
    OBJECTS: {
        "TactileSGNet": f"{MANUAL} --graph manual --weight-bits 8",
        "200 ms": "pretrained:objects-200ms --weight-bits 8",
        "counters": "pretrained:objects-counters",
    },
    CONTAINERS: {
        "TactileSGNet": "pretrained:containers --weight-bits 8",
        "200 ms": "containers-200ms.pt --weight-bits 8",
        "counters": "pretrained:containers-counters",
    },
}
LAYOUTS = ("", *(f"--cores-for {each}" for each in ("fc1=4", "fc1=6", "fc1=8", "conv1=6,fc1=6,fc2=3")))
CHARTS = {
    OBJECTS: ("pretrained:objects", "bits=3,4,8,window=10%,20%,100%"),
    CONTAINERS: ("pretrained:containers containers-knn1.pt", "bits=2,4,8,window=25-100%"),
}
USUAL = ("8b", "cores", 100)
"""Storage, layout and window that others are compared with, of the first network."""

FILLINGS, CONTAINER_CLASSES = 5, 20
"""Of each of four containers, classes in order."""

STORAGE = {
    "8 bits, from the weights": "",
    "8 bits": "--calibrate DATA --weight-bits 8",
    "2 × 8 bits": "--calibrate DATA --planes 2",
    "2 × 8 bits, 8 scales": "--calibrate DATA --planes 2 --scale-groups 8",
    "spike-exact": "--calibrate DATA --spike-exact",
    "6 bits": "--calibrate DATA --weight-bits 6",
    "4 bits": "--calibrate DATA --weight-bits 4",
    "4 bits, 8 scales": "--calibrate DATA --weight-bits 4 --scale-groups 8",
    "ternary, 8 scales": "--calibrate DATA --weight-bits 2 --scale-groups 8",
}
"""Options of `compile`."""

NAMED = {"objects": OBJECTS, "containers": CONTAINERS}

ROOT = Path(__file__).parents[1]
SHOWN = re.compile(r"^\$ (spikeloom .+)\n((?:(?!\$ |```).*\n)*)", re.MULTILINE)
"""A command in the docs, and what they show of its output."""

IN_HARDWARE = {"counters": 20, "native": 20}
"""First test recordings that run in RANC's hardware, by kind of network."""

PAGES = (
    "anytime",
    "chart",
    "compile",
    "cost",
    "counting",
    "data",
    "formats",
    "stress",
    "truenorth",
    "verify",
)
"""Those that show some."""

POINT = ("number", "network", "storage", "cores", "window", "n_cores", "test")


class Session:
    """Commands that run in one folder, beside links to what they read."""

    def __init__(self, sources: Path, folder: Path) -> None:
        self.folder = folder
        self.commands: list[str] = []
        for file in sources.resolve().iterdir():
            (folder / file.name).symlink_to(file)

    def run(self, words: str, output: str = "", program: str = "") -> Json:
        """What a command, or a `program` of this folder, says in JSON, or writes."""
        self.commands.append(f"python benchmarks/{program} {words}" if program else f"spikeloom {words}")
        file = [str(Path(__file__).with_name(program))] if program else ["-m", "spikeloom"]
        run = [sys.executable, *file, *words.split(), "--json"]
        done = subprocess.run(run, cwd=self.folder, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode not in (0, 1):
            raise SystemExit(f"spikeloom {words}: exit code {done.returncode}")
        found: Json = json.loads((self.folder / output).read_text() if output else done.stdout)
        return found

    def costs(self, data: str, options: str = "") -> Json:
        """Means of ``estimate`` for ``net.loom``."""
        found = self.run(f"estimate net.loom --data {data} {options}".rstrip())
        time = found["time"][-1]
        return {
            "chip_steps": found["chip_steps"],
            "cores": len(found["cores"]),
            "synaptic_operations": found["per_inference"]["synaptic_operations"],
            "energy_j": found["per_inference"]["energy_j"],
            "static_real_time_j": found["static"][0]["real_time_j"],
            "time": {
                "model": time["model"],
                "inference_s": time["inference_s"]["mean"],
                "step_s": time["step_s"]["mean"],
            },
        }


def pretrained(session: Session) -> Json:
    """What each shipped network's record says of its epochs."""
    found = {}
    for name in NETWORKS:
        record = session.run(f"inspect pretrained:{name}")["training"]
        samples = record["test_samples"]
        found[name] = {
            "made_by": record["command"],
            "test_samples": samples,
            "validation": record["validation"],
        }
        for which in ("last", "best", "clean"):
            epoch, right = record[which]["epoch"], record[which]["correct"]
            low, high = wilson(right, samples)
            percent = {"accuracy": 100 * right / samples, "low": 100 * low, "high": 100 * high}
            found[name][which] = {"epoch": epoch, "correct": right, **percent}
    return found


def shipped(session: Session) -> Json:
    """Decisions, spikes and costs at 8 bits."""
    found = {}
    for name, (network, data, options) in SHIPPED.items():
        session.run(f"compile {network} --calibrate {data} {options} -o net.loom".replace("  ", " "))
        verdict = session.run(f"verify net.loom --checkpoint {network} --data {data}")
        right = {side: round(share * verdict["samples"]) for side, share in verdict["accuracy"].items()}
        found[name] = {
            "test_samples": verdict["samples"],
            **right,
            "equal": round(verdict["decision_agreement"] * verdict["samples"]),
            "spikes_moved": {layer: n["different"] / n["float"] for layer, n in verdict["spikes"].items()},
            **session.costs(data),
        }
    return found


def storage(session: Session) -> Json:
    """What each way to store weights keeps and costs, with p of its right decisions against the float model's."""
    found: Json = {}
    for name, data in NAMED.items():
        rows = {}
        for row, options in STORAGE.items():
            words = f"compile pretrained:{name} {options} -o net.loom".replace("DATA", data)
            session.run(words.replace("  ", " "))
            rows[row] = stored(session, f"pretrained:{name}", data)
        found[name] = {"rows": rows}
    return found


def stored(session: Session, network: str, data: str) -> Json:
    """Decisions, spikes and costs of ``net.loom``."""
    verdict = session.run(f"verify net.loom --checkpoint {network} --data {data}")
    moved: Any = re.search(r"float only (\d+), on chip only (\d+)", verdict["levels"][-1]["text"])
    lost, gained = map(int, moved.groups())
    return {
        "float": round(verdict["accuracy"]["float"] * verdict["samples"]),
        "right": round(verdict["accuracy"]["chip"] * verdict["samples"]),
        "test_samples": verdict["samples"],
        "equal": round(verdict["decision_agreement"] * verdict["samples"]),
        "p": binomtest(lost, lost + gained).pvalue if lost + gained else 1.0,
        "spikes_moved": sum(each["different"] for each in verdict["spikes"].values()),
        **{key: verdict[key] for key in ("row_different",) if key in verdict},
        **session.costs(data),
    }


def free_running(session: Session) -> Json:
    """What a chip that nobody resets decides and costs, beside one whose layers have windows."""
    found: Json = {}
    for name in ("objects_manual", "objects", "containers"):
        network, data, _ = SHIPPED[name]
        rows, decided = {}, []
        for row, option in {"windows": "", "free-running": "--free-running "}.items():
            made = session.run(f"compile {network} --calibrate {data} {option}-o net.loom")
            trained = session.run(f"run net.loom --data {data} --split train")
            decided.append(trained["predictions"])
            right = sum(a == b for a, b in zip(trained["predictions"], trained["labels"], strict=True))
            rows[row] = {
                "train_right": right,
                "left": made.get("free_running"),
                **stored(session, network, data),
            }
        equal = sum(a == b for a, b in zip(*decided, strict=True))
        found[name] = rows | {"train_equal": equal, "train_samples": trained["samples"]}
    return found


def layouts(session: Session) -> Json:
    """What more cores cost and bring, message by message."""
    found = {}
    for options in LAYOUTS:
        session.run(
            f"compile {MANUAL} --graph manual --calibrate {OBJECTS} {options} -o net.loom".replace("  ", " ")
        )
        found[options or "default"] = session.costs(OBJECTS, "--detail cycle")
    return found


def chart(session: Session, data: str) -> Json:
    """Points of a grid, and the one that was chosen."""
    networks, grid = CHARTS[data]
    found = session.run(f"chart {networks} --data {data} --grid {grid} -o chart", "chart/chart.json")
    if data == OBJECTS:
        (RESULTS / "chart-objects.png").write_bytes((session.folder / "chart" / "chart.png").read_bytes())
    points = {str(point["number"]): {key: point[key] for key in POINT} for point in found["points"]}
    usual = next(
        each for each in points.values() if (each["storage"], each["cores"], each["window"]) == USUAL
    )
    for point in points.values():
        whole, energy = usual["test"]["energy_j"], point["test"]["energy_j"]
        point["times_less"] = {table: whole[table] / energy[table] for table in energy}
    return {"points": points, "taken": found["budget"]["point"]}


def anytime(session: Session, data: str) -> Json:
    """Windows and rules."""
    network = f"{MANUAL} --graph manual" if data == OBJECTS else "pretrained:containers"
    session.run(f"compile {network} --calibrate {data} --weight-bits 8 -o net.loom")
    found = session.run(f"anytime net.loom --data {data} --calibrate {data} -o anytime.json", "anytime.json")
    windows = {str(each["percent"]): each["chip"]["correct"] for each in found["windows"]}
    rules = {
        str(each["allowed"]): {key: each[key] for key in each if key != "samples"} for each in found["rules"]
    }
    for rule in rules.values():
        rule["steps_saved"] = 1 - rule["mean"]["chip_steps"] / found["full"]["chip_steps"]
    return {"full": found["full"], "windows": windows, "rules": rules}


def lean(session: Session, data: str) -> Json:
    """What a network does without, when one decision of a hundred may differ and when none may."""
    network = f"{MANUAL} --graph manual" if data == OBJECTS else "pretrained:containers"
    found: Json = {}
    for differ in ("0.01", "0"):
        result = session.run(f"lean {network} --data {data} --differ {differ}")
        found[differ] = {row.pop("name"): row for row in result["rows"]}
        found["taxels_without_change"] = sum(taxel["training_differ"] == 0 for taxel in result["taxels"])
    return found


def stress(session: Session, network: str, calibrate: str = "") -> Json:
    """Accuracy of both sides under every perturbation, and where it leaves that of clean recordings."""
    session.run(f"compile {network} {calibrate}-o net.loom")
    options = f"--data {OBJECTS} -o stress.json --picture stress.png"
    result = session.run(f"stress net.loom --checkpoint {network} {options}", "stress.json")
    if calibrate:
        (RESULTS / "stress.png").write_bytes((session.folder / "stress.png").read_bytes())
    found: Json = {"clean": {"right": result["clean"]["right"], "equal": result["clean"]["equal"]}}
    for name, each in result["perturbations"].items():
        verdict = {key: each[key] for key in ("verdict", "breaks", "same_place")}
        levels = {
            f"{level['level']:g}": {side: level[side]["mean"] for side in ("float", "chip")}
            | {"equal": level["equal"]}
            for level in each["levels"]
        }
        found[name] = verdict | {"levels": levels}
    return found


def truenorth(session: Session) -> Json:
    """Counting networks of few bits, and the shipped networks that were trained for the chip."""
    found: Json = {}
    for data in (OBJECTS, CONTAINERS):
        for bits in (8, 5, 4):
            made = session.run(f"train --data {data} --system counters --weight-bits {bits} -o net.pt")[
                "record"
            ]
            session.run(f"compile net.pt {'' if bits == 8 else '--target truenorth '}-o net.loom")
            costs = session.run(f"estimate net.loom --data {data}")
            found[f"{data}, {bits} bits"] = {
                "cross_validation": made["validation"]["correct"] / made["validation"]["samples"],
                "right": made["test_correct"],
                "cores": costs["cores"] if bits < 8 else len(costs["cores"]),
                **{key: costs["per_inference"].get(key) for key in ("ticks", "energy_j")},
            }
        name = f"{Path(data).stem.removeprefix('Ev-').lower()}-truenorth"
        session.run(f"compile pretrained:{name} --target truenorth -o net.loom")
        verdict = session.run(f"verify net.loom --checkpoint pretrained:{name} --data {data}")
        costs = session.run(f"estimate net.loom --data {data}")
        kept = {key: costs["per_inference"][key] for key in ("ticks", "time_s", "energy_j")}
        moved = sum(layer["different"] for layer in verdict["model"].values())
        right = round(verdict["accuracy"]["chip"] * verdict["samples"])
        found[name] = {"right": right, "spikes_differ": moved, "cores": costs["cores"], **kept}
    return found


def hardware(session: Session, kind: str) -> Json:
    """Networks of a kind in RANC's hardware; FOLDER holds a clone, RANC, and gets what is finished, in ``work``."""
    found: Json = {}
    for name, data in NAMED.items():
        network = f"pretrained:{name}-truenorth"
        if kind == "counters":
            network = "net.pt"
            session.run(f"train --data {data} --system counters --weight-bits 5 -o net.pt")
        session.run(f"compile {network} --target truenorth -o net.loom")
        work = f"work/{name if kind == 'counters' else kind}"
        words = f"net.loom {data} --rtl RANC --limit {IN_HARDWARE[kind]} --work {work}"
        result = session.run(words, program="cosimulate.py")
        found[name] = result | {"recordings": len(result["recordings"])}
    return found


def neurobench(session: Session) -> Json:
    """NeuroBench's metrics of the released network on the chip."""
    session.run(f"compile {MANUAL} --graph manual --calibrate {OBJECTS} --weight-bits 8 -o net.loom")
    return session.run(f"estimate net.loom --data {OBJECTS} --neurobench")["neurobench"]


def shown(session: Session, page: str) -> Json:
    """What the commands print that a page of the docs shows."""
    found = {}
    whole = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
    if "objects.loom" in whole and "-o objects.loom" not in whole:
        session.run(f"compile {MANUAL} --graph manual --calibrate {OBJECTS} -o objects.loom")
    for command, text in SHOWN.findall(whole):
        session.commands.append(command)
        run = [sys.executable, "-m", *shlex.split(command)]
        done = subprocess.run(run, cwd=session.folder, capture_output=True, text=True, check=False)
        if text.strip(" \n…"):
            found[command] = done.stderr if done.returncode == 2 else done.stdout
    return found


def taken_for(session: Session, network: str, data: str) -> list[tuple[int, int]]:
    """Class of each test recording, and what the chip takes it for."""
    session.run(f"compile {network} --calibrate {data} --weight-bits 8 -o net.loom")
    found = session.run(f"run net.loom --data {data}")
    return list(zip(found["labels"], found["predictions"], strict=True))


def confused_objects(session: Session) -> Json:
    """Which objects two networks take for others, those with most wrong decisions first."""
    found = {}
    for name, network in {
        "TactileSGNet": f"{MANUAL} --graph manual",
        "counters": "pretrained:objects-counters",
    }.items():
        wrong = Counter(label for label, decided in taken_for(session, network, OBJECTS) if label != decided)
        found[name] = {
            "wrong": wrong.total(),
            "classes": len(wrong),
            "worst": [label for label, times in wrong.most_common() if times > 1],
            "of_them": sum(times for times in wrong.values() if times > 1),
        }
    return found


def confusion(session: Session) -> Json:
    """What the chip takes for what on Containers: another container, or another filling of the same."""
    pairs = taken_for(session, "pretrained:containers", CONTAINERS)
    other = sum(label // FILLINGS != decided // FILLINGS for label, decided in pairs)
    wrong = sum(label != decided for label, decided in pairs)
    near = sum(
        label // FILLINGS == decided // FILLINGS and abs(label - decided) == 1 for label, decided in pairs
    )
    counts = np.zeros((CONTAINER_CLASSES, CONTAINER_CLASSES), np.int64)
    np.add.at(counts, tuple(np.transpose(pairs)), 1)
    drawing = matrices(
        "Containers in rows of five fillings", {"Containers, five fillings of each of four": counts}
    )
    drawing.figure.set_size_inches(4.8, 4.8)
    for axes in drawing.figure.axes:
        for edge in range(FILLINGS, CONTAINER_CLASSES, FILLINGS):
            axes.axhline(edge - 0.5, color="0.6", lw=0.8)
            axes.axvline(edge - 0.5, color="0.6", lw=0.8)
    (RESULTS / "confusion-containers.png").write_bytes(drawing.file("png"))
    return {
        "test_samples": len(pairs),
        "wrong": wrong,
        "other_container": other,
        "next_filling": near,
        "pairs": pairs,
    }


def longer_bins(session: Session) -> Json:
    """Chip accuracy on Objects, 200 ms less 20 ms: points, and Welch's p over networks; from stored results."""
    cells = json.loads((RESULTS / "paper" / "cells.json").read_text())
    short = [cell for name, cell in cells.items() if name.startswith("objects-tactilesgnet-manual-e100-")]
    found: Json = {"validation_20ms": sorted({cell["validation"]["correct"] for cell in short})}
    for row, file in {
        "200 ms": "variants-objects-200ms",
        "200 ms, spike-exact": "variants-objects-200ms-exact",
    }.items():
        variant = json.loads((RESULTS / f"{file}.json").read_text())["variants"][row]
        found[row] = {}
        for epoch in ("last", "clean"):
            long = [100 * network["chip"] / 144 for network in variant[epoch]["networks"]]
            ours = [100 * cell["chip"][epoch]["correct"] / 144 for cell in short]
            p = float(ttest_ind(long, ours, equal_var=False).pvalue)
            found[row][epoch] = {"difference": fmean(long) - fmean(ours), "p": p}
    session.commands.append("from paper/cells.json, variants-objects-200ms.json and -exact.json")
    return found


def processor(session: Session, data: str) -> Json:
    """Three networks against a rule on a processor."""
    found = {}
    for name, network in PROCESSOR[data].items():
        session.run(f"compile {network} --calibrate {data} -o net.loom")
        found[name] = session.run(f"estimate net.loom --data {data} --against-processor")[
            "against_processor"
        ]
    return found


STUDIES: dict[str, Callable[[Session], Json]] = {
    "storage": storage,
    "free-running": free_running,
    "stress-objects": lambda session: stress(session, f"{MANUAL} --graph manual", f"--calibrate {OBJECTS} "),
    "stress-counters": lambda session: stress(session, "pretrained:objects-counters"),
    "truenorth": truenorth,
    "rtl-counters": lambda session: hardware(session, "counters"),
    "rtl-native": lambda session: hardware(session, "native"),
    "neurobench": neurobench,
    "confusion-containers": confusion,
    "confusion-objects": confused_objects,
    "longer-bins": longer_bins,
    "pretrained": pretrained,
    "shipped": shipped,
    "layouts": layouts,
    "chart-objects": lambda session: chart(session, OBJECTS),
    "chart-containers": lambda session: chart(session, CONTAINERS),
    "lean-objects": lambda session: lean(session, OBJECTS),
    "lean-containers": lambda session: lean(session, CONTAINERS),
    "processor-objects": lambda session: processor(session, OBJECTS),
    "processor-containers": lambda session: processor(session, CONTAINERS),
    "anytime-objects": lambda session: anytime(session, OBJECTS),
    "anytime-containers": lambda session: anytime(session, CONTAINERS),
    **{f"shown/{page}": partial(shown, page=page) for page in PAGES},
}


def main() -> None:
    """Make the studies that are named, or all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=", ".join(STUDIES))
    arguments = parser.parse_args()
    for name in arguments.studies or STUDIES:
        with tempfile.TemporaryDirectory() as folder:
            session = Session(arguments.folder, Path(folder))
            figures = STUDIES[name](session)
            read = [
                data for data in (OBJECTS, CONTAINERS) if any(data in words for words in session.commands)
            ]
            read = read or [OBJECTS, CONTAINERS]  # of records
            hashes = {
                data: data_digest(*(load_data(arguments.folder / data, each) for each in ("train", "test")))
                for data in read
            }
        found = {
            "command": f"python benchmarks/figures.py FOLDER {name}",
            "commands": session.commands,
            "spikeloom": spikeloom.compiler.__version__,
            "data_sha256": hashes,
            "figures": figures,
        }
        with write_atomically(RESULTS / f"{name}.json") as file:
            file.write((json.dumps(found, indent=1) + "\n").encode())
        print(RESULTS / f"{name}.json")


if __name__ == "__main__":
    main()
