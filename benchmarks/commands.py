"""Time whole commands of two trees, an old one and this, side by side: what a person waits for, and in what memory.

    python benchmarks/commands.py --old TREE --new . CHECKPOINT RECORDINGS [--only NAME …] [--turns 5] [--core 0]

Each job is a row of processes of one core (``taskset``, ``OMP_NUM_THREADS=1``). Trees take turns, so that both meet the
same machine; figures are medians of the turns: seconds of wall and CPU time and the peak memory of the largest process,
with the ratio of CPU times within a turn, which other work on the machine disturbs less. Machine code is compiled
before anything is timed, except where a job begins with an empty cache. A job that ends with an error, or after
``--limit`` seconds, is not repeated; its exit code says so.

What the jobs read is made in ``--folder`` and kept there: netlists by each tree itself, and, with the old tree, whose
files the new one reads, a grid-based CNN with padding, whose first layer has 15,808 neurons, after one epoch.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from made import made

import spikeloom.compiler
from spikeloom.models.recordings.events import load_data

DEFAULT = Path(__file__).parent / "results" / "commands.json"
THIS = Path(spikeloom.compiler.__file__).resolve().parents[1]
TRACED = [str(Path(__file__).parent / "traced")] if "SPIKELOOM_TRACE" in os.environ else []
"""Notes, where a record is to be made, what the commands open."""

MAKE = {
    "objects.loom": "compile {checkpoint} --graph manual --calibrate {recordings} -o {file}",
    "wide.pt": "train --data {recordings} --system grid-cnn --padding same --epochs 1 --keep last -o {file}",
}
"""Files that jobs read, and what makes them."""

COMPILE = "compile {checkpoint} --graph manual --calibrate {recordings} -o {folder}/out.loom"
VERIFY = "verify {folder}/%s.loom --checkpoint {checkpoint} --graph manual --data {recordings}"
ESTIMATE = "estimate {folder}/%s.loom --data {recordings}"
WIDE = "compile {wide} --calibrate {recordings} -o {folder}/wide.loom"
TRAIN = "train --data {recordings} --graph manual --keep last -o {folder}/out.pt --epochs %s"

JOBS: Mapping[str, tuple[str, ...]] = {
    "help": ("--help",),
    "inspect": ("inspect {folder}/objects.loom",),
    "run": ("run {folder}/objects.loom --data {recordings}",),
    "estimate": (ESTIMATE % "objects",),
    "compile": (COMPILE,),
    "verify": (VERIFY % "objects",),
    "main job": (COMPILE, VERIFY % "out", ESTIMATE % "out"),
    "spike-exact": (COMPILE + " --spike-exact",),
    "wide": (WIDE,),
    "wide, spike-exact": (WIDE + " --spike-exact",),
    "first demo": ("demo",),
    "one epoch": (TRAIN % 1,),
    "three epochs": (TRAIN % 3,),
}
"""Commands of each job, one after another. A further epoch takes half of what three take longer than one."""

COLD = ("first demo",)
"""Jobs that begin without any machine code."""


@dataclass(frozen=True)
class Tree:
    """A state of the code, and how its command is started."""

    name: str
    path: Path
    folder: Path  # Of what it makes

    def command(self) -> tuple[list[str], str]:
        """Words that start it, and what is on Python's path; trees had their packages at the top once."""
        source = self.path / "src"
        if (source / "spikeloom").is_dir():
            return [sys.executable, "-m", "spikeloom"], str(source)
        return [sys.executable, "-m", "runtime"], str(self.path)

    def start(
        self, words: str, values: Mapping[str, str], core: int, cache: Path, limit: float
    ) -> dict[str, float]:
        """Run a command to its end: seconds, gigabytes and exit code, 124 after the limit."""
        start, path = self.command()
        given = [word.format(folder=self.folder, **values) for word in words.split()]
        line = ["taskset", "-c", str(core), "timeout", str(limit), *start, *given]
        more = {
            "PYTHONPATH": os.pathsep.join([*TRACED, path]),
            "OMP_NUM_THREADS": "1",
            "NUMBA_CACHE_DIR": str(cache),
        }
        more["PYTHONDONTWRITEBYTECODE"] = ""  # modules are read as after a first start
        begun = time.perf_counter()
        with (self.folder / "log").open("wb") as log:
            child = subprocess.Popen(line, env=os.environ | more, stdout=subprocess.DEVNULL, stderr=log)
            _, status, used = os.wait4(child.pid, 0)  # of this child and of those that it waited for
        child.returncode = os.waitstatus_to_exitcode(status)
        return {
            "wall_s": time.perf_counter() - begun,
            "cpu_s": used.ru_utime + used.ru_stime,
            "peak_gb": used.ru_maxrss / 1e6,
            "exit_code": child.returncode,
        }

    def run(self, job: str, values: Mapping[str, str], core: int, limit: float) -> dict[str, float]:
        """Run the commands of a job; times add up."""
        cache = self.folder / "machine code"
        if job in COLD:
            cache = self.folder / "no machine code"
            shutil.rmtree(cache, ignore_errors=True)
        parts = [self.start(words, values, core, cache, limit) for words in JOBS[job]]
        return {key: (sum if key.endswith("_s") else max)(part[key] for part in parts) for key in parts[0]}

    def make(self, name: str, folder: Path, values: Mapping[str, str], core: int) -> str:
        """A file that jobs read, made where it is missing."""
        file = folder / name
        if not file.exists():
            done = self.start(
                MAKE[name], dict(values) | {"file": str(file)}, core, self.folder / "machine code", 3600
            )
            if done["exit_code"]:
                raise SystemExit(f"{name}: {(self.folder / 'log').read_text()}")
        return str(file)


def medians(turns: list[dict[str, float]]) -> dict[str, float]:
    """Of the turns that went well."""
    return {
        "exit_code": max(turn["exit_code"] for turn in turns),
        **{
            key: round(statistics.median(turn[key] for turn in turns), 3)
            for key in turns[0]
            if key != "exit_code"
        },
    }


def measure(
    job: str, trees: tuple[Tree, Tree], values: Mapping[str, str], arguments: argparse.Namespace
) -> dict[str, Any]:
    """A job in turns."""
    if job not in COLD:
        for tree in trees:  # compiles what machine code there is
            if tree.run(job, values, arguments.core, arguments.limit)["exit_code"]:
                sys.stderr.write(f"{job}, {tree.name}: {(tree.folder / 'log').read_text()[-300:]}\n")
    found: dict[str, list[dict[str, float]]] = {tree.name: [] for tree in trees}
    for turn in range(arguments.turns):
        for tree in trees if turn % 2 else trees[::-1]:
            done = found[tree.name]
            if not any(each["exit_code"] for each in done):  # once is enough to know that it fails
                done.append(tree.run(job, values, arguments.core, arguments.limit))
    old, new = (found[tree.name] for tree in trees)
    ratios = [before["cpu_s"] / after["cpu_s"] for before, after in zip(old, new, strict=False)]
    return {
        "old": medians(old),
        "new": medians(new),
        "times_faster": round(statistics.median(ratios), 2),
        "times_faster_by_turn": [round(ratio, 2) for ratio in ratios],
    }


def main() -> None:
    """Measure, print a line for each job, and store what is known after each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint")
    parser.add_argument("recordings")
    parser.add_argument("--old", type=Path, required=True)
    parser.add_argument("--new", type=Path, default=THIS)
    parser.add_argument(
        "--only", nargs="+", choices=JOBS, default=list(JOBS), metavar="NAME", help=", ".join(JOBS)
    )
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--limit", type=float, default=900, metavar="SECONDS")
    parser.add_argument("--folder", type=Path, default=Path("commands"))
    parser.add_argument("-o", "--output", type=Path, default=DEFAULT)
    arguments = parser.parse_args()

    folder = arguments.folder.resolve()
    old, new = (Tree(name, getattr(arguments, name).resolve(), folder / name) for name in ("old", "new"))
    values = {name: str(Path(getattr(arguments, name)).resolve()) for name in ("checkpoint", "recordings")}
    output = arguments.output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)  # not that of a tree: Python would look there first
    for tree in (old, new):
        tree.folder.mkdir(parents=True, exist_ok=True)
        tree.make("objects.loom", tree.folder, values, arguments.core)
    values["wide"] = (
        old.make("wide.pt", folder, values, arguments.core) if "wide" in " ".join(arguments.only) else ""
    )
    commit = ["git", "-C", str(old.path), "rev-parse", "--short=8", "HEAD"]
    results = made(*(load_data(values["recordings"], each) for each in ("train", "test"))) | {
        "old": subprocess.run(commit, capture_output=True, text=True, check=True).stdout.strip(),
        "jobs": json.loads(output.read_text())["jobs"] if output.exists() else {},
    }
    for job in arguments.only:
        found = results["jobs"][job] = measure(job, (old, new), values, arguments)
        before, after = found["old"], found["new"]
        seconds = f"{before['wall_s']:8.2f} -> {after['wall_s']:7.2f} s, {found['times_faster']:6.1f} times as fast"
        memory = f"{before['peak_gb']:.2f} -> {after['peak_gb']:.2f} GB"
        print(
            f"{job:<18} {seconds}, {memory}, exit codes {before['exit_code']}, {after['exit_code']}",
            flush=True,
        )
        output.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
