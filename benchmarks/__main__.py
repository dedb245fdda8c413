"""Stored results: what made each, in how many seconds, and whether the code that it depends on has changed since.

    python -m benchmarks                                          # all of them
    python -m benchmarks --again NAME… [--write] [--files FOLDER] # run what made these results again, and compare
    python -m benchmarks --again --under 60                       # all that were seen to take less than 60 s

A result depends on the files of this repository that the processes of its command opened to read, pages left out;
``traced/sitecustomize.py`` notes them. ``--write`` stores the new result with its pictures, and in ``results/runs`` the
seconds that it took, the processor, and a digest of each of these files: of Python its statements without comments,
docstrings and the words of ``--help``, of others the bytes. A result without such a record is ``not known`` to be up to
date; ``finished`` is one whose script is only in the history. Commands run in a copy of this folder, beside links to
``$SPIKELOOM_SHARED/data``, ``checkpoints``, and what else they read, in FOLDER.
"""

import argparse
import ast
import hashlib
import itertools
import json
import math
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import cache
from importlib.util import source_from_cache
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT, RESULTS = HERE.parent, HERE / "results"
RUNS = RESULTS / "runs"
SHARED = Path(os.environ.get("SPIKELOOM_SHARED", ROOT.parent / "shared"))
SOURCES = (SHARED / "data", SHARED / "data" / "silicon", SHARED / "checkpoints")
WORK, FINISHED = "work", "*.parts.json"  # What studies go on from: a run again does all of it
SAID = {"command", "spikeloom", "seconds"}  # Of a run, and not of what came out


def names() -> list[str]:
    """Every stored result, by its place in the folder; pictures and tables come with one."""
    files = (file for file in sorted(RESULTS.rglob("*.json")) if RUNS not in file.parents)
    return [str(file.relative_to(RESULTS)) for file in files]


def read(file: Path) -> dict[str, Any]:
    """Content of a JSON file: of a result, or of its record, empty where there is none."""
    content = json.loads(file.read_text("utf-8")) if file.exists() else {}
    return content if isinstance(content, dict) else {"": content}


def is_text(node: ast.stmt) -> bool:
    """Whether a statement is a docstring."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


@cache
def digest(name: str) -> str:
    """Of what a file of the repository does, empty where it is gone."""
    file = ROOT / name
    data = file.read_bytes() if file.exists() else b""
    if file.suffix == ".py":
        tree = ast.parse(data)
        for node in ast.walk(tree):
            if isinstance(getattr(node, "body", None), list):
                node.body = list(itertools.filterfalse(is_text, node.body)) or [ast.Pass()]
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "option":
                del node.args[:1]
        data = ast.unparse(tree).encode()
    return hashlib.sha256(data).hexdigest()[:16]


def state(name: str) -> str:
    """Whether the files that a result depends on are as they were; a study is finished if its script is gone."""
    script = re.match(r"python (benchmarks/\S+)", read(RESULTS / name).get("command", ""))
    if script and not (ROOT / script[1]).exists():
        return "finished"
    files = flat(read(RUNS / name).get("files", {}))
    changed = [file for file, noted in files.items() if digest(file) != noted]
    return f"stale ({', '.join(changed[:3])})" if changed else "up to date" if files else "not known"


def flat(folders: dict[str, dict[str, str]]) -> dict[str, str]:
    """Digests of files, in a record by folder."""
    return {str(Path(folder, file)): at for folder, files in folders.items() for file, at in files.items()}


def depends(log: Path, place: Path, began: int) -> dict[str, dict[str, str]]:
    """Digests of the files of the repository that are in a log, by folder; `place` holds the copy of this folder.

    Not of what was written there since the run began, ns.
    """
    found = set()
    for line in set(log.read_text("utf-8").splitlines()):
        path = Path(source_from_cache(line) if line.endswith(".pyc") else line)
        if path.is_relative_to(place) and path.exists() and path.stat().st_mtime_ns >= began:
            continue
        path = ROOT / path.relative_to(place) if path.is_relative_to(place) else path.resolve()
        if path.is_relative_to(ROOT) and path.suffix != ".md":
            found.add(str(path.relative_to(ROOT)))
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    known: dict[str, dict[str, str]] = {}
    for file in map(Path, sorted(found & set(tracked.stdout.splitlines()))):
        known.setdefault(str(file.parent), {})[file.name] = digest(str(file))
    return known


def run(name: str, place: Path, sources: list[Path]) -> dict[str, Any]:
    """Run what made a result in an empty folder, and give its record; it is in ``benchmarks/results`` there."""
    shutil.copytree(HERE, place / "benchmarks", ignore=shutil.ignore_patterns(FINISHED))
    for folder in ("docs", "examples", "tests"):
        (place / folder).symlink_to(ROOT / folder)
    (place / "FOLDER").mkdir()
    for file in [file for folder in sources for file in folder.resolve().iterdir() if file.name != WORK]:
        for link in {file.name, f"FOLDER/{file.name}", file.name.removeprefix("Ev-").lower()}:
            (place / link).symlink_to(file)
    results = place / "benchmarks" / "results"
    (results / name).unlink()
    program, *words = shlex.split(read(RESULTS / name)["command"])
    words = [re.sub(r"^OUT(?=\.json$|\.png$)", Path(name).stem, word) for word in words]
    words = [str(results / word) if (RESULTS / word).is_file() else word for word in words]
    start = [sys.executable, *(["-m", program, *words, "--json"] if program == "spikeloom" else words)]
    paths = os.pathsep.join(map(str, (HERE / "traced", ROOT / "src")))
    environment = os.environ | {"PYTHONPATH": paths, "SPIKELOOM_TRACE": str(place / "log")}
    began = time.time_ns()
    done = subprocess.run(start, cwd=place, env=environment, capture_output=True, text=True, check=False)
    seconds = (time.time_ns() - began) / 1e9
    if program == "spikeloom":
        (results / name).write_text(done.stdout, "utf-8")
    fine = (
        (0, 1) if program == "spikeloom" else (0,)
    )  # 1 is a failed check of a command, of a script its end
    if done.returncode not in fine or not (results / name).exists():
        raise RuntimeError(f"exit code {done.returncode}\n{done.stderr[-2000:]}")
    return {
        "seconds": round(seconds, 1),
        "processor": processor(),
        "files": depends(place / "log", place, began),
    }


def processor() -> str:
    """Name, family and model, as Linux tells them: hosts give processors of several generations one name."""
    try:
        lines = Path("/proc/cpuinfo").read_text("ascii", "replace").split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    found = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    known = [f"{key} {found[key]}" for key in ("cpu family", "model") if key in found]
    return ", ".join([found.get("model name", platform.machine()), *known])


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """Places where two results differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in (old.keys() | new.keys()) - SAID:
            yield from differences(old.get(key), new.get(key), f"{path}/{key}")
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for at, pair in enumerate(zip(old, new, strict=True)):
            yield from differences(*pair, f"{path}/{at}")
    elif not (old == new or (isinstance(old, float) and isinstance(new, float) and math.isclose(old, new))):
        yield f"{path}: {json.dumps(old)[:60]} -> {json.dumps(new)[:60]}"


def again(name: str, write: bool = False, extra: Path | None = None) -> list[str]:
    """Differences between a stored result and what its command gives now."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder).resolve()
        began = time.time_ns()
        record = run(name, place, [*SOURCES, *([extra] if extra else [])])
        results = place / "benchmarks" / "results"
        found = sorted(differences(read(RESULTS / name), read(results / name)))
        if write:
            (results / "runs" / name).parent.mkdir(parents=True, exist_ok=True)
            (results / "runs" / name).write_text(json.dumps(record, indent=0) + "\n", "utf-8")
            made = (file for file in results.rglob("*.*") if file.stat().st_mtime_ns >= began)
            for file in made:  # not the copies of others, which may be newer by now
                (RESULTS / file.relative_to(results)).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, RESULTS / file.relative_to(results))
    return found


def show(name: str) -> str:
    """Two lines of the list."""
    content, record = read(RESULTS / name), read(RUNS / name)
    took = f"{record['seconds']:.0f} s" if record else "seconds not known"
    data = " ".join(re.findall(r'"(\w{8})\w{56}"', json.dumps(content))[:2]) or "none of a file"
    return f"{name}: {state(name)}, {took}, data {data}\n    {content.get('command', 'in README.md')}"


def chosen(given: list[str], under: float | None) -> list[str]:
    """Results to run again: those that were given, or all that are known to take less time."""
    took = {name: read(RUNS / name).get("seconds", math.inf) for name in given or names()}
    return sorted(
        took if under is None else (name for name in took if took[name] < under), key=took.__getitem__
    )


def main() -> None:
    """List the results, or run some again; exit code 1 if one differs or does not come out."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=str(__doc__).splitlines()[0])
    parser.add_argument(
        "--again", nargs="*", choices=names(), metavar="NAME", help="for example shown/cost.json"
    )
    parser.add_argument("--under", type=float, metavar="SECONDS", help="only those that took less")
    parser.add_argument("--write", action="store_true", help="store what came out, and its record")
    parser.add_argument("--files", type=Path, metavar="FOLDER", help="with what else commands read")
    arguments = parser.parse_args()
    if arguments.again is None:
        print("\n".join(map(show, names())))
        return
    bad = 0
    for name in chosen(arguments.again, arguments.under):
        try:
            found = again(name, arguments.write, arguments.files)
            print("\n".join([f"{name}: {len(found)} differences", *found[:20]]), flush=True)
        except RuntimeError as error:
            found = [str(error)]
            print(f"{name}: {error}", flush=True)
        bad += bool(found)
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
