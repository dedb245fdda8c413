"""A sweep to be run in a process of its own, and what it measures.

``python swept.py STORE LOG POINTS [JOBS|tcp://HOST:PORT]``: every measurement that begins adds its number to LOG.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import CapacityError, DataError, Violation
from spikeloom.runtime.studies.jobs.sweep import Point, content_key, sweep

KIND = "test"

VIOLATION = Violation(owner="core 0", rule="loihi1.core.axons_in", used=5, allowed=4, remedy="fewer inputs")


def square(payload: dict[str, Any]) -> dict[str, Any]:
    """What is measured: a square, after a moment; a payload may ask for trouble instead."""
    number = payload["number"]
    with Path(payload["log"]).open("a") as log:
        log.write(f"{number}\n")
    hold = payload.get("hold")
    while hold is not None and Path(hold).exists():
        time.sleep(0.01)
    time.sleep(payload.get("seconds", 0))
    match payload.get("trouble"):
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "die once" if begun(payload["log"]).count(number) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        case "data":
            raise DataError("x.zip: is empty; give another")
        case "capacity":
            raise CapacityError((VIOLATION,))
        case "interrupt":
            raise KeyboardInterrupt
        case "defect":
            raise ZeroDivisionError("a defect")
    return {"square": number**2, "third": number / 3, "pair": (number, None), "threads": os.environ["OMP_NUM_THREADS"]}


def begun(log: str | Path) -> list[int]:
    """Numbers whose measurement began, in that order."""
    return [int(line) for line in Path(log).read_text().splitlines()] if Path(log).exists() else []


def points(log: Path, count: int, **trouble: dict[int, Any]) -> list[Point]:
    """As many points; keywords: entries of the payload by number."""
    return [
        Point(
            key=content_key({"number": number}),
            label=f"number {number}",
            payload={"number": number, "log": str(log)}
            | {name: those[number] for name, those in trouble.items() if number in those},
        )
        for number in range(count)
    ]


def main() -> None:
    """Run it."""
    store, log, count, *where = sys.argv[1:]
    slow = dict.fromkeys(range(int(count)), 0.02)
    scheduler = where[0] if where and where[0].startswith("tcp:") else None
    jobs = int(where[0]) if where and scheduler is None else None
    made = points(Path(log), int(count), seconds=slow)
    sweep(made, square, Path(store), kind=KIND, version=1, jobs=jobs, scheduler=scheduler, label="squares")


if __name__ == "__main__":
    main()
