"""Faults in the middle of commands: killed, without space, where nothing may be written, twice at once, late.

Each trial runs a command in a folder of its own, in a process that meets a fault at one of its writes (an open to
write, a rename, a removal, a new folder, or a flush, half of what was written) or at a random moment, over an older
output in every other trial. Then the output must be as before, or whole. The same command, or ``--resume``, goes on; it
must leave the bytes of an undisturbed run, and nothing else. An output that is there already gains the commands that
it lacks.
"""

import argparse
import contextlib
import errno
import io
import json
import os
import random
import resource
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import torch
import typed
from made import made
from made_files import csv_folder, events, own_file, recordings_folder
from tqdm import tqdm

from spikeloom.compiler.files import MOST_SAID
from spikeloom.models.training import record, train
from spikeloom.runtime.cli import main
from spikeloom.runtime.commands.check import certify, stress
from spikeloom.runtime.commands.choose import chart, smallest
from spikeloom.runtime.commands.exchange import data, export
from spikeloom.runtime.commands.main_job import compile, report, run, verify

LOADED = (record, train, certify, stress, chart, smallest, data, export, compile, report, run, verify)
"""What a process that is forked need not import."""

COMMANDS = {
    "train": "train --data data --edges ring.csv --features 2 --hidden 4 --epochs 2 -o out/x.pt",
    "train counters": "train --system counters --data data -o out/x.pt",
    "finetune": "finetune net.pt --data data --weight-bits 4 --epochs 2 -o out/x.pt",
    "compile": "compile net.pt --calibrate data -o out/x.loom",
    "report": "report net.loom --checkpoint net.pt --data data --limit 2 -o out/x.html",
    "chart": "chart net.pt --data data --grid bits=4,8 --jobs 1 -o out/x",
    "smallest": "smallest --data data --jobs 1 --time 9m --html out/x.html -o out/x.loom",
    "data convert, a folder": "data convert taps -o out/x",
    "data convert, a zip": "data convert taps -o out/x.zip",
    "certify": "certify net.loom --data data --limit 2 --shift 1 --most 2 --jobs 1 --certificate out/x -o out/x.json",
    "export": "export net.loom --to onnx -o out/x.onnx",
    "export, NIR": "export net.loom --to nir -o out/x.nir",
    "join": "join net.pt net.pt -o out/x.pt",
    "run": "run net.loom --data data --spikes out/x.npz",
}
RESUMED = "train", "finetune"
"""Commands that go on with ``--resume`` where a state is there."""

WRITES = "open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"
"""Audit events of what changes a folder."""

BEFORE = b"an older output"


@dataclass
class Fault:
    """What happens in a process at the write `at`; ``none`` happens at none, and counts them.

    ``kill``: the process ends at once, in a flush with half of the file. ``full disk``: the write fails, and those
    after it. ``read only``: every write fails, from the first one. ``clock``: the time of day goes back a year.
    ``moment``: killed after so many milliseconds. ``file size``: files may have no more bytes than that.
    """

    kind: str
    at: int = 0
    seen: int = 0

    def arm(self) -> None:
        """Wait for it in this process, which works in the folder of its trial."""
        self.place = str(Path.cwd())
        self.flush = os.fsync
        os.fsync = self._flush
        sys.addaudithook(self._hear)
        if self.kind == "moment":
            signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
            signal.setitimer(signal.ITIMER_REAL, self.at / 1000)
        if self.kind == "file size":
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.at, resource.RLIM_INFINITY))
        if self.kind == "clock":
            now = time.time
            time.time = lambda: now() - (self.seen >= self.at) * 365 * 86400

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event not in WRITES or (
            event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        ):
            return
        where = arguments[0]
        if not isinstance(where, int) and str(Path(os.fsdecode(where)).absolute()).startswith(self.place):
            self._meet(event, None)

    def _flush(self, file: int) -> None:
        self._meet("fsync", file)
        self.flush(file)

    def _meet(self, event: str, file: int | None) -> None:
        self.seen += 1
        if self.kind == "kill" and self.seen == self.at:
            if file is not None:
                os.ftruncate(file, os.fstat(file).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        if (
            self.kind == "full disk"
            and self.seen >= self.at
            and event not in ("os.remove", "os.rmdir", "os.rename")
        ):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self.kind == "read only":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))


@dataclass
class Child:
    """A command in a process of its own."""

    folder: Path
    words: list[str]
    fault: Fault

    def start(self) -> "Child":
        """Begin."""
        self.ears, mouth = os.pipe()
        self.begun = time.monotonic()
        self.process = os.fork()
        if self.process == 0:
            os.chdir(self.folder)
            said, code = io.StringIO(), 2
            try:
                with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
                    self.fault.arm()
                    code = main(self.words)
            except BaseException as error:  # what a command must not let through
                said.write(f"Traceback: {type(error).__name__}: {error}")
            os.write(mouth, json.dumps([code, said.getvalue()[-3000:], self.fault.seen]).encode())
            os._exit(0)
        os.close(mouth)
        return self

    def end(self) -> "Child":
        """Wait for it; a killed one has no code."""
        with os.fdopen(self.ears, "rb") as file:
            heard = file.read()
        os.waitpid(self.process, 0)
        self.seconds = time.monotonic() - self.begun
        self.code, self.said, self.writes = json.loads(heard) if heard else (None, "", 0)
        return self


def made_folder(place: Path) -> None:
    """Recordings, networks and a netlist."""
    recordings_folder(place / "data", train=events(1, samples=12), test=events(2, samples=8))
    csv_folder(place / "taps", taxels=6, samples=4)
    own_file(place / "net.pt")
    (place / "ring.csv").write_text("".join(f"{i},{(i + 1) % 6}\n" for i in range(6)))
    child = (
        Child(place, ["compile", "net.pt", "--weight-bits", "8", "-o", "net.loom"], Fault("none"))
        .start()
        .end()
    )
    assert child.code == 0, child.said


def files_in(folder: Path) -> dict[str, bytes]:
    """Contents of all files below a folder, by name."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def values_in(name: str, content: bytes) -> Any:
    """What must be equal of a file: of a store its rows, else the bytes."""
    if not name.endswith(".sqlite"):
        return content
    with contextlib.closing(sqlite3.connect(f"file:{name}?mode=memory")) as database:
        database.deserialize(content)
        return sorted(database.execute("SELECT key, result FROM results"))


def is_passing(name: str) -> bool:
    """Whether a file is one of those that a command leaves for the next one to go on with, or to remove."""
    left = (".part", ".lock", ".state", ".training", ".sqlite")
    return any(part in name for part in left)


@dataclass
class Trial:
    """A fault in a command, and what came of it."""

    command: str
    fault: Fault
    folder: Path
    due: dict[str, bytes]  # Files of the undisturbed command
    old: bool  # Whether there is an older output

    def run(self) -> list[str]:
        """What is wrong, nothing where all is well."""
        out = self.folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        before: dict[str, bytes] = {}
        if self.old and len(self.due) == 1:
            before = dict.fromkeys(self.due, BEFORE)
            (out / next(iter(self.due))).write_bytes(BEFORE)
        words = COMMANDS[self.command].split()
        child = Child(self.folder, words, self.fault).start().end()
        wrong = self._left(child, before, files_in(out))
        states = any(".state" in file.name and ".part" not in file.name for file in out.iterdir())
        if self.command.startswith("data convert, a folder"):
            shutil.rmtree(out / "x", ignore_errors=True)  # it writes no folder that is there
        again = [*words, "--resume"] if self.command in RESUMED and states else words
        child = Child(self.folder, again, Fault("none")).start().end()
        if child.code != 0:
            return [*wrong, f"it does not go on: {child.said[-300:]}"]
        found = files_in(out)
        names = {name for name in (*self.due, *found) if not name.endswith(".sqlite") or name in self.due}
        odd = [
            name
            for name in sorted(names)
            if values_in(name, found.get(name, b"")) != values_in(name, self.due.get(name, b""))
        ]
        return wrong + [f"after going on, another {name}" for name in odd]

    def _left(self, child: Child, before: dict[str, bytes], found: dict[str, bytes]) -> list[str]:
        """What is wrong right after the fault."""
        wrong = [
            f"left another {name} of {len(content)} bytes"
            for name, content in found.items()
            if not is_passing(name) and content not in (self.due.get(name), before.get(name))
        ]
        wrong += [f"lost the older {name}" for name in before if name not in found]
        if child.code is None:
            return wrong
        last = child.said.splitlines()[-1] if child.said else ""
        if (
            child.code not in (0, 1, 2)
            or "Traceback" in child.said
            or len(last) > MOST_SAID + 20 + len(str(self.folder))
        ):
            wrong.append(f"exit {child.code}: {last[:300]}")
        if child.code == 2 and not last.startswith("spikeloom: "):
            wrong.append(f"says {last[:300]!r}")
        if any(name.endswith(".part") for name in found):
            wrong.append("a half-written file stays")
        return wrong


def faults_for(writes: int, seconds: float, largest: int, rng: random.Random) -> list[Fault]:
    """Each write killed, up to a number; and some of the other kinds."""
    places = rng.sample(range(1, writes + 1), min(writes, KILLS))
    found = [Fault("kill", at) for at in sorted(places)]
    found += [Fault("moment", int(1000 * seconds * rng.uniform(0.05, 1.0))) for _ in range(2)]
    found += [Fault("full disk", at) for at in sorted(rng.sample(range(1, writes + 1), min(writes, 3)))]
    found += [Fault("file size", int(largest * share)) for share in (0.0, rng.random(), 0.999)]
    return [*found, Fault("read only"), Fault("clock", rng.randint(1, writes))]


KILLS = 6
"""Writes of a command that are killed."""


def twice(folder: Path, command: str, due: dict[str, bytes]) -> list[str]:
    """Two processes on one output: one may be refused, and what is there is whole."""
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    both = [Child(folder, COMMANDS[command].split(), Fault("none")).start() for _ in range(2)]
    codes = [child.end() for child in both]
    wrong = [child.said[-300:] for child in codes if child.code not in (0, 2) or "Traceback" in child.said]
    found = files_in(out)
    if all(child.code == 2 for child in codes):
        wrong.append("both were refused")
    odd = [name for name in due if values_in(name, found.get(name, b"")) != values_in(name, due[name])]
    return wrong + [f"two processes wrote another {name}" for name in odd]


def trials_of(command: str, folder: Path, rng: random.Random) -> Iterator[tuple[str, list[str]]]:
    """Kind of fault and what was wrong, of each trial of a command."""
    (folder / "out").mkdir()
    whole = Child(folder, COMMANDS[command].split(), Fault("none")).start().end()
    assert whole.code == 0, whole.said
    due = files_in(folder / "out")
    largest = max(map(len, due.values()))
    for number, fault in enumerate(faults_for(whole.writes, whole.seconds, largest, rng)):
        trial = Trial(command, fault, folder, due, old=number % 2 == 1)
        yield f"{fault.kind} {fault.at}", trial.run()
    yield "two at once", twice(folder, command, due)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--only", help="commands whose names begin so")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    typed.few_candidates()
    found: dict[str, Any] = made() | {"trials": 0, "wrong": 0, "first": {}, "faults": {}, "commands": {}}
    if arguments.output.exists():
        found = json.loads(arguments.output.read_text())
    left = [
        name for name in COMMANDS if name.startswith(arguments.only or "") and name not in found["commands"]
    ]
    for command in tqdm(left, disable=None):
        with tempfile.TemporaryDirectory() as folder:
            made_folder(Path(folder))
            for fault, wrong in trials_of(command, Path(folder), random.Random(command)):
                kind = fault.rstrip(" 0123456789")
                found["trials"] += 1
                found["wrong"] += bool(wrong)
                for key, name in (("faults", kind), ("commands", command)):
                    found[key][name] = found[key].get(name, 0) + 1
                if wrong:
                    found["first"][f"{command}, {fault}"] = [line.replace(folder, "") for line in wrong]
        arguments.output.write_text(json.dumps(found, indent=1) + "\n")
