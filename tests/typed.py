"""Commands that are given a file from a stranger: what a command does with it is tried, not what its reader does alone.

`LINES` are command lines by what the file is: ``{x}`` is the file, other names are those of good files beside it, and
the folder ``written``, which is emptied first, takes what is written.
"""

import contextlib
import io
import json
import random
import re
import runpy
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import commands
import numpy as np
import pytest
from zoo import specimen

from spikeloom.compiler.archive import npy_bytes, zip_bytes
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.files import MOST_FOLDERS, MOST_SAID
from spikeloom.runtime.studies.smallest import baselines, space, work

WRITTEN = Path("written")
CHECKER = Path(__file__).parents[1] / "examples" / "check_certificate.py"

ONE = "--data {data} --limit 1"
COMPARED = f"--checkpoint {{network}} {ONE}"
NETLIST = (
    "inspect {x}",
    f"run {{x}} {ONE} --spikes written/spikes.npz",
    "run {x} --data {data} --json",
    f"verify {{x}} {COMPARED}",
    f"estimate {{x}} {ONE} --json",
    "anytime {x} --data {data} --calibrate {data} -o written/anytime.json",
    f"certify {{x}} {ONE} --shift 1 --most 2 --jobs 1 --certificate written/certificate",
    "watch {x} --input {events}",
)
READ = ("inspect {x}", f"verify {{netlist}} --checkpoint {{x}} {ONE}")
LINES = {
    "netlist": (
        *NETLIST,
        f"estimate {{x}} {ONE} --detail cycle",
        f"estimate {{x}} {ONE} --neurobench",
        f"verify {{x}} {COMPARED} --engine onnx",
        f"explain {{x}} {COMPARED}",
        f"report {{x}} {COMPARED} -o written/page.html",
        f"stress {{x}} {COMPARED} --only taxels_dead --seeds 1 --jobs 1",
        *(f"export {{x}} --to {to} -o written/x.{to}" for to in ("onnx", "nir")),
        "export {x} --to sanafe -o written/x.yaml",
    ),
    "netlist of crossbars": (*NETLIST, "export {x} --to ranc --data {data} -o written/x.ranc"),
    "checkpoint": (
        *READ,
        "compile {x} --calibrate {data} -o written/x.loom",
        "compile {x} --weight-bits 4 --planes 2 -o written/x.loom",
        f"explain {{netlist}} --checkpoint {{x}} {ONE}",
        f"report {{netlist}} --checkpoint {{x}} {ONE} -o written/page.html",
        f"lean {{x}} {ONE} -o written/x.loom",
        "finetune {x} --data {data} --weight-bits 4 --epochs 1 -o written/x.pt",
        "join {x} {network} -o written/x.pt",
        "chart {x} --data {data} --grid bits=8 --jobs 1 -o written/chart",
    ),
    "released checkpoint": ("inspect {x}", "compile {x} --edges {ring} -o written/x.loom"),
    "counting network": (*READ, "compile {x} -o written/x.loom"),
    "NIR": (
        "compile {x} --dt 0.02 -o written/x.loom",
        f"verify {{netlist}} --checkpoint {{x}} {ONE}",
        "finetune {x} --data {data} --dt 0.02 --weight-bits 4 --epochs 1 -o written/x.nir",
    ),
    "ONNX": ("compile {x} -o written/x.loom", f"verify {{netlist}} --checkpoint {{x}} {ONE}"),
    "netx": ("compile {x} -o written/x.loom",),
    "network for crossbars": (*READ, "compile {x} --target truenorth -o written/x.loom"),
    "recordings": (
        "run {netlist} --data {x}",
        "verify {netlist} --checkpoint {network} --data {x} --limit 1",
        "estimate {netlist} --data {x} --limit 1",
        "data describe {x} --json",
        "data convert {x} -o written/out",
        "compile {network} --calibrate {x} -o written/x.loom",
        "anytime {netlist} --data {x}",
    ),
    "recordings of both splits": ("train --system counters --data {x} -o written/x.pt",),
    "options": tuple(
        f"{name} --config {{x}}" for name in ("run", "verify", "estimate", "certify", "compile")
    ),
    "stress": ("report {netlist} --checkpoint {network} --data {data} --stress {x} -o written/page.html",),
    "store of smallest": ("smallest --store {x} --data {data} --jobs 1 --time 9m -o written/x.loom",),
    "store of a chart": ("chart {network} --data {data} --grid bits=4,8 --jobs 1 -o written",),
}


@cache
def beside(name: str) -> dict[str, Path]:
    """Good files: those of a network of the zoo, and event lines."""
    made = specimen(name)
    events = made.folder / "events.csv"
    events.write_text("time_s,taxel,polarity\n0.01,1,1\n0.05,3,0\n\n0.02,0,1\n")
    ring = made.folder / "ring.csv"
    ring.write_text("".join(f"{i},{(i + 1) % 6}\n" for i in range(6)))
    names = {each: getattr(made, each) for each in ("network", "netlist", "data")}
    return names | {"events": events, "ring": ring}


def emptied() -> None:
    """The folder for what is written."""
    shutil.rmtree(WRITTEN, ignore_errors=True)
    WRITTEN.mkdir()


def is_short(line: str) -> bool:
    """Whether a line on standard error is one that people read; folders of a path do not count."""
    folders = sum(map(len, re.findall(r"\S*/", line)))
    return line.isprintable() and len(line) <= len("spikeloom: ") + MOST_SAID + min(folders, MOST_FOLDERS)


def require_tidy(code: int, out: str, err: str, *, as_json: bool) -> None:
    """An AssertionError unless a command ended as one may."""
    lines = err.splitlines()
    assert code in (0, 1, 2), f"exit code {code}"
    assert all(map(is_short, lines)), f"{len(max(lines, key=len))} letters: {max(lines, key=len)[:400]!r}"
    assert code < 2 or (lines and lines[-1].startswith("spikeloom: ") and not out), (
        f"exit code 2: {err[-300:]!r}"
    )
    assert not [*Path().rglob("*.part")], "a half-written file is left"
    if as_json and code < 2:
        json.loads(out, parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))


def through(lines: str, name: str, place: str | None = None) -> Callable[[Path], str]:
    """What gives a file to one of these commands, which its content chooses, beside the files of a network of the zoo.

    A CapacityError stands for a refusal. `place` is where the file must lie, if that is not its own.
    """

    def read(path: Path) -> str:
        emptied()
        if place is not None:
            path = path.rename(WRITTEN / place)
        words = random.Random(path.read_bytes()).choice(LINES[lines]).format(x=path, **beside(name)).split()
        try:
            code, out, err = commands.run(*words)
        except SystemExit as error:
            raise AssertionError(f"{words}: exit {error.code}") from error
        require_tidy(code, out, err, as_json="--json" in words)
        if code == 2:
            raise CapacityError(())
        return words[0]

    return read


def checked(path: Path) -> str:
    """Let the program of its own check a file of certificates."""
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            checker()["main"](beside("counters")["netlist"], path)
        except SystemExit as refusal:
            said = str(refusal.code)
            assert said.startswith("refused: "), said[:300]
            assert is_short(said), f"{len(said)} letters: {said[:400]!r}"
            raise CapacityError(()) from refusal
    return "holds"


@cache
def checker() -> dict:
    return runpy.run_path(str(CHECKER))


# -- good files --------------------------------------------------------------------------------------------------------
def written_by(name: str, line: str, file: str) -> bytes:
    """A file that a command writes."""
    emptied()
    code, _, err = commands.run(*line.format(**beside(name)).split())
    assert code == 0, err
    return (WRITTEN / file).read_bytes()


def certificate() -> list[bytes]:
    return [written_by("counters", f"certify {{netlist}} {ONE} --jobs 1 --certificate written/x", "x")]


def stress() -> list[bytes]:
    line = f"stress {{netlist}} {COMPARED} --only taxels_dead,longer --seeds 1 --jobs 1 -o written/x.json"
    return [written_by("mlp", line, "x.json")]


def chart() -> list[bytes]:
    return [written_by("mlp", LINES["store of a chart"][0], "points.sqlite")]


FEW_CANDIDATES = (
    (
        space,
        {
            "JOINS": (1,),
            "PARTS": (1,),
            "THRESHOLDS": ((1,), (1, 4)),
            "WINDOWS": (100,),
            "RAMPS": (16,),
            "SIZES": (),
        },
    ),
    (baselines, {"PARTS": (1,)}),
    (work, {"PRICED": 2, "ROUNDS": 2}),
)
"""With which ``smallest`` tries two counting networks and their like."""


def few_candidates() -> None:
    """Let ``smallest`` try few in this process, for good: tests/test_readers.py puts back what was there."""
    for module, changes in FEW_CANDIDATES:
        for constant, value in changes.items():
            setattr(module, constant, value)


def smallest() -> list[bytes]:
    few_candidates()
    line = LINES["store of smallest"][0].replace("{x}", "written/x.sqlite")
    return [written_by("mlp", line, "x.sqlite")]


def recordings() -> list[bytes]:
    """Four recordings of each split, with the width of their bins."""
    data = beside("mlp")["data"]
    files = [file for split in ("test", "train") for file in sorted((data / split).iterdir())[:4]]
    members: dict[str, bytes] = {f"x/{file.relative_to(data)}": file.read_bytes() for file in files}
    return [zip_bytes(members | {"x/bins.npy": npy_bytes(np.array([0.02]))})]


def events() -> list[bytes]:
    """Events of one recording and its class."""
    columns = {"time_s": [0.0, 0.02, 0.1], "taxel": [0, 2, 1], "polarity": [1, 0, 1], "label": [1]}
    return [zip_bytes({f"{name}.npy": npy_bytes(np.array(column)) for name, column in columns.items()})]


def options() -> list[bytes]:
    """Tables of options, of several commands."""
    made = beside("mlp")
    shared = {"netlist": str(made["netlist"]), "data": str(made["data"]), "limit": 1, "split": "test"}
    tables = {
        "run": shared | {"window": "50%", "json": True},
        "verify": shared | {"checkpoint": str(made["network"]), "spec-samples": 1, "require": "E0,E3=0"},
        "estimate": shared | {"detail": "cycle"},
        "certify": shared | {"shift": 1, "most": 2, "jobs": 1},
        "compile": {
            "checkpoint": str(made["network"]),
            "weight-bits": [8, 4, 4, 4],
            "output": "written/x.loom",
        },
    }
    return [toml_of(tables)]


def toml_of(tables: dict) -> bytes:
    """Tables, as far as TOML can hold them."""

    def value(each: object) -> str:
        if isinstance(each, dict):
            return "{" + ", ".join(f"{json.dumps(key)} = {value(one)}" for key, one in each.items()) + "}"
        if isinstance(each, list):
            return f"[{', '.join(map(value, each))}]"
        return json.dumps(each).replace("NaN", "nan").replace("Infinity", "inf").replace("null", '""')

    lines = []
    for name, table in tables.items():
        if isinstance(table, dict):
            lines.append(f"[{json.dumps(name)}]")
            lines += [f"{json.dumps(key)} = {value(each)}" for key, each in table.items()]
        else:
            lines.insert(0, f"{json.dumps(name)} = {value(table)}")
    return "\n".join(lines).encode()
