"""A sweep to be run in a process of its own, and what it measures: ``python swept.py STORE LOG POINTS JOBS``."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError
from spikeloom.runtime.studies.jobs import Job, content_key, sweep


@dataclass(frozen=True, slots=True, kw_only=True)
class Square(Job):
    """A number to square, or trouble instead."""

    payload: dict[str, Any]


def square(job: Square) -> dict[str, Any]:
    """What is measured: a square, after a moment; a payload may ask for trouble instead."""
    payload = job.payload
    number = payload["number"]
    with Path(payload["log"]).open("a") as log:
        log.write(f"{number}\n")
    time.sleep(payload.get("seconds", 0))
    match payload.get("trouble"):
        case "die once" if begun(payload["log"]).count(number) > 1:
            pass
        case "die" | "die once":
            os.kill(os.getpid(), signal.SIGKILL)
        case "data":
            raise DataError("x.zip: is empty; give another")
        case "interrupt":
            raise KeyboardInterrupt
        case "defect":
            raise ZeroDivisionError("a defect")
    return {"square": number**2, "third": number / 3, "pair": (number, None)}


def begun(log: str | Path) -> list[int]:
    """Numbers whose measurement began, in that order."""
    return [int(line) for line in Path(log).read_text().splitlines()] if Path(log).exists() else []


def points(log: Path, count: int, **trouble: dict[int, Any]) -> list[Square]:
    """As many points; keywords: entries of the payload by number."""
    return [
        Square(
            key=content_key({"number": number}),
            label=f"number {number}",
            payload={"number": number, "log": str(log)}
            | {name: those[number] for name, those in trouble.items() if number in those},
        )
        for number in range(count)
    ]


if __name__ == "__main__":
    store, log, count, jobs = sys.argv[1:]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # even where a job in the background ignores it
    made = points(Path(log), int(count), seconds=dict.fromkeys(range(int(count)), 0.1))
    sweep(made, square, Path(store), jobs=int(jobs), label="squares")
