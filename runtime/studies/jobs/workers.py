"""Processes of this machine that work side by side, and what ends them all together."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import TypeVar

from spikeloom.compiler.errors import SpikeloomError

APayload = TypeVar("APayload")
AResult = TypeVar("AResult")

PATIENCE_S = 15.0
"""How long a process that was told to end may take for it; a disk may stall while it writes."""

STOPPED = 143
"""Exit code of a process that a signal ended, as a shell gives it."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that say how many threads the libraries inside a process start; read when they are loaded."""


class ProcessDied(Exception):  # noqa: N818 - it is handed over, not raised
    """A process ended while it worked.

    Parameters
    ----------
    what : str
        Which, and how.
    times : int
        How often that was so for what it worked on.
    """

    def __init__(self, what: str, times: int = 1) -> None:
        self.what = what
        self.times = times
        super().__init__(what, times)

    def __str__(self) -> str:
        return self.what if self.times == 1 else f"{self.what}, {self.times} times"


def cores() -> int:
    """Cores of this machine."""
    return os.cpu_count() or 1


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Start processes whose libraries use one thread each; a torch that is loaded here does the same meanwhile."""
    before = {name: os.environ.get(name) for name in THREADS}
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch is not None else None
    os.environ.update(dict.fromkeys(THREADS, "1"))
    if torch is not None:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if torch is not None:
            torch.set_num_threads(threads)


@contextmanager
def ended_by_signal() -> Iterator[None]:
    """A request to end (SIGTERM) interrupts as Ctrl-C does, so that everything is left tidy."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may say what a signal does
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def run_side_by_side(
    payloads: Sequence[APayload],
    run: Callable[[APayload], AResult],
    *,
    processes: int,
    tries: int = 1,
    again: Callable[[int, ProcessDied], object] | None = None,
) -> Generator[tuple[int, AResult | Exception]]:
    """Work on payloads in processes of their own; whatever ends this ends them all.

    Parameters
    ----------
    payloads : sequence
        Begun in this order.
    run : callable
        Does the work; a function of a module, since it crosses process borders.
    processes : int
        At a time.
    tries : int
        How often a payload whose process died is begun.
    again : callable, optional
        Told the place of a payload that is begun again, and how its process died.

    Yields
    ------
    (int, result)
        Place of a payload and what `run` made of it, as they come: its value, the exception that it raised, or
        `ProcessDied`.
    """
    # spawned, not forked: torch and its thread pools do not survive a fork
    context = get_context("spawn")
    queue, deaths = deque(range(len(payloads))), Counter[int]()
    idle: list[tuple[Connection, SpawnProcess]] = []
    busy: dict[Connection, tuple[int, SpawnProcess]] = {}
    try:
        while queue or busy:
            while queue and len(busy) < processes:
                ours, process = _still_alive(idle) or _begin(context, run)
                index = queue.popleft()
                busy[ours] = index, process
                with suppress(BrokenPipeError, ConnectionResetError):  # it died, which is noticed below
                    ours.send(payloads[index])
            for ready in wait(list(busy)):
                ours = next(known for known in busy if known is ready)
                index, process = busy.pop(ours)
                try:
                    found: AResult | Exception = ours.recv()
                    idle.append((ours, process))
                except (EOFError, ConnectionResetError):
                    ours.close()
                    process.join()
                    deaths[index] += 1
                    found = ProcessDied(f"its process ended early (exit code {process.exitcode})", deaths[index])
                    if deaths[index] < tries:
                        queue.append(index)
                        if again is not None:
                            again(index, found)
                        continue
                yield index, found
        for ours, _ in idle:
            ours.close()  # which tells them to end
        for _, process in idle:
            process.join(PATIENCE_S)
    finally:
        left = [process for _, process in (*idle, *busy.values()) if process.is_alive()]
        for process in left:
            process.terminate()
        for process in left:
            process.join(PATIENCE_S)
            process.kill()
            process.join()


def attempt(run: Callable[[APayload], AResult], payload: APayload) -> AResult | Exception:
    """What `run` makes of a payload, or the exception that it raised, such that it can cross process borders."""
    try:
        return run(payload)
    except (SpikeloomError, OSError, MemoryError) as error:
        return error.with_traceback(None)
    except Exception:  # a defect; not every exception survives the way
        return RuntimeError(traceback.format_exc())


def _still_alive(idle: list[tuple[Connection, SpawnProcess]]) -> tuple[Connection, SpawnProcess] | None:
    """Take an idle process; one that died meanwhile is dropped, which is the fault of no payload."""
    while idle:
        ours, process = idle.pop()
        if process.is_alive():
            return ours, process
        ours.close()
    return None


def _begin(context: SpawnContext, run: Callable[[APayload], AResult]) -> tuple[Connection, SpawnProcess]:
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(run, theirs))
    process.start()
    theirs.close()
    return ours, process


def _work(run: Callable[[APayload], AResult], connection: Connection) -> None:
    """Work in a process of its own, which outlives neither a request to end nor its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and ends us
    signal.signal(signal.SIGTERM, _stop)
    threading.Thread(target=_follow_parent, daemon=True).start()
    while True:
        try:
            payload = connection.recv()
        except EOFError:
            return
        connection.send(attempt(run, payload))


def _stop(_signal: int, _frame: object) -> None:
    raise SystemExit(STOPPED)


def _follow_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(PATIENCE_S)
        os._exit(STOPPED)
