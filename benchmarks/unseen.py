"""Conditions that training has not seen: ``smallest`` with one speed or force of a set of textures left out for test.

    python benchmarks/unseen.py ntp-textures.zip OUT.json --only speed=3600 force=0.0

The zip holds ``textureNN_speedS_forceF.npz`` with ``spikes`` (steps, 10), a step a millisecond, of which nine columns
are taxels: the recordings of github.com/LIMB-UCF/NTP. Silent ones are omitted. Beside the choice stands a quadratic
ridge on counts and rates, whose penalty is chosen by the same folds, and the best network at any price and the largest,
trained on all of the training split from three seeds.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

import spikeloom
from spikeloom.compiler import __version__
from spikeloom.compiler.files import sha256_of
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.studies.smallest.baselines import RIDGE, features, machine
from spikeloom.runtime.studies.smallest.space import EPOCHS, Candidate
from spikeloom.runtime.studies.smallest.work import RUNGS

NAME = re.compile(r"texture(?P<texture>[0-9]+)_speed(?P<speed>[0-9]+)_force(?P<force>[0-9.]+)\.npz")
TAXELS = 9
SEEDS = (0, 1, 2)
LARGEST = "tactilesgnet recipe=rates join=1 features=64 hops=3 hidden=128,256"
COMMAND = "python benchmarks/unseen.py ntp-textures.zip OUT.json"
CONDITIONS = (
    *(f"speed={speed}" for speed in (1200, 2400, 3600, 4800, 6000)),
    "force=0.0",
    "force=0.5",
    "force=1.0",
)


def write_events(archive: Path, folder: Path, condition: str) -> None:
    """Event files of all recordings; those of a condition are the test split."""
    group, value = condition.split("=")
    with zipfile.ZipFile(archive) as members:
        names = sorted(filter(NAME.fullmatch, members.namelist()))
        textures = sorted({about(name)["texture"] for name in names})
        for name in names:
            spikes = np.load(io.BytesIO(members.read(name)), allow_pickle=False)["spikes"]
            step, taxel = np.nonzero(spikes[:, :TAXELS])
            if len(step):
                split = folder / ("test" if about(name)[group] == value else "train")
                split.mkdir(parents=True, exist_ok=True)
                label = textures.index(about(name)["texture"])
                lines = [f"{(t + 0.5) / 1000:.4f},{n},1\n" for t, n in zip(step, taxel, strict=True)]
                text = "".join(["time_s,taxel,polarity\n", *lines])
                (split / f"{Path(name).stem}_label_{label}.csv").write_text(text)


def write_taxels(file: Path) -> Path:
    """Places of the taxels, on a square of three by three."""
    places = [f"{index // 3 * 2},{index % 3 * 2}" for index in range(TAXELS)]
    file.write_text("\n".join(["x,y", *places]))
    return file


def about(name: str) -> dict[str, str]:
    """Texture, speed and force of a file."""
    match = NAME.fullmatch(name)
    assert match is not None, "only such names are asked for"
    return match.groupdict()


def row_of(condition: str, found: Any, folder: Path, sensor: list[str]) -> dict[str, Any]:
    """What stands in the result, of the JSON of a search."""
    train, test = (
        recordings(str(folder), split, classes=None, taxels=TAXELS) for split in ("train", "test")
    )
    tried = found["tried"]
    chosen = tried[found["choice"]["cheapest"]["davies2018"] - 1]
    best = tried[found["choice"]["best"] - 1]
    largest = next(each for each in tried if each["name"] == LARGEST)
    counters = max(
        (each for each in tried if each["system"] == "counters"),
        key=lambda each: (each["rung"], each["accuracy"]),
    )
    (ridge,) = (each for each in found["baselines"] if each["system"] == RIDGE)
    return {
        "left_out": condition.replace("=", " "),
        "test": found["data"]["test"],
        "chosen": side_of(chosen) | {"right": found["checked"]["right"]["correct"]},
        "best": side_of(best) | {"right": rights(best["name"], best["setting"], folder, sensor)},
        "largest": side_of(largest) | {"right": rights(LARGEST, EPOCHS[-1], folder, sensor)},
        "counters": side_of(counters),
        "ridge": {"accuracy": ridge["accuracy"], "right": right_by_ridge(ridge["setting"], train, test)},
        "at_random": found.get("at_random"),
        "last_rung": [side_of(each) | {"behind": each["behind"]} for each in tried if each["rung"] >= RUNGS],
        "families": found["families"],
        "sha256": found["data"]["sha256"],
    }


def rights(name: str, epochs: float, folder: Path, sensor: list[str]) -> list[int]:
    """Right decisions of a candidate, trained from each seed."""
    return [right_fully_trained(name, epochs, folder, sensor, seed) for seed in SEEDS]


def right_fully_trained(name: str, epochs: float, folder: Path, sensor: list[str], seed: int) -> int:
    """Right decisions of the chip in the test split, by a candidate that is trained on all of the training split."""
    system, *about = name.split()
    pairs = [word.split("=", 1) for word in about]
    words = [word for option, value in pairs for word in (f"--{option.replace('_', '-')}", value)]
    with tempfile.TemporaryDirectory() as scratch:
        network = f"{scratch}/best.pt"
        words += ["--system", system, "--epochs", f"{epochs:g}", "--seed", str(seed), "--keep", "last"]
        command = ["train", "--data", str(folder), *sensor, *words, "-o", network]
        subprocess.run([sys.executable, "-m", "spikeloom", *command], check=True, stdout=subprocess.DEVNULL)
        made = spikeloom.compile(network, calibrate=str(folder), weight_bits=8).run(str(folder))
        return int(np.count_nonzero(made.predictions == made.labels))


def side_of(tried: Any) -> dict[str, Any]:
    """A candidate: its accuracy by cross-validation over conditions, and joules."""
    return {
        "name": tried["name"],
        "accuracy": tried["accuracy"],
        "epochs": tried["setting"],
        "energy_j": tried["costs"]["energy_j"]["davies2018"],
        "conditions": tried["conditions"],
    }


def right_by_ridge(penalty: float, train: Recordings, test: Recordings) -> int:
    """Right decisions of a ridge on all training recordings, in the test split."""
    candidate = Candidate(system=RIDGE, options={"counts": "log", "parts": 1})
    fitted = machine(RIDGE, penalty).fit(features(train, candidate), train.labels)
    return int((fitted.predict(features(test, candidate)) == test.labels).sum())


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--only", nargs="+", default=CONDITIONS, choices=CONDITIONS)
    parser.add_argument("--jobs", type=int)
    parser.add_argument("--time", default="20m")
    options = parser.parse_args()
    rows = json.loads(options.output.read_text())["rows"] if options.output.exists() else []
    with tempfile.TemporaryDirectory() as scratch:
        taxels = write_taxels(Path(scratch, "taxels.csv"))
        for condition in options.only:
            folder = Path(scratch, condition)
            write_events(options.archive, folder, condition)
            about = {"groups": "speed,force", "taxels": str(taxels), "graph": "knn:4", "time": options.time}
            begun = time.monotonic()
            found = spikeloom.smallest(str(folder), f"{folder}.loom", jobs=options.jobs, **about)
            seconds = round(time.monotonic() - begun)
            head = {"command": COMMAND, "spikeloom": __version__, "data_sha256": sha256_of(options.archive)}
            sensor = ["--taxels", str(taxels), "--graph", "knn:4"]
            row = row_of(condition, json.loads(found.to_json()), folder, sensor) | {"seconds": seconds}
            row["how"] = f"--time {options.time}, {options.jobs or os.cpu_count()} processes"
            rows = [*(each for each in rows if each["left_out"] != row["left_out"]), row]
            options.output.write_text(json.dumps(head | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
