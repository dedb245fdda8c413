"""Many measurements side by side, each kept as soon as it is there.

A sweep can be ended at any time, by Ctrl-C, a kill or a loss of power. What was measured is in its store, by
keys that name everything that decides a result; the same command goes on from there. joblib does the work.
"""

import _thread
import hashlib
import json
import os
import signal
import sqlite3
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from itertools import takewhile
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from spikeloom.compiler.errors import DataError, OptionError, SpikeloomError, UnfinishedError, require_least
from spikeloom.compiler.files import WRITTEN, FileFault, reading, remove_leftovers, require_size
from spikeloom.runtime.report.console import Progress, tell
from spikeloom.runtime.report.encode import decode
from spikeloom.runtime.studies.cluster import cluster, one_thread, spread

APayload = TypeVar("APayload")
AResult = TypeVar("AResult")
AJob = TypeVar("AJob", bound="Job")


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One measurement of a sweep; what is measured are the fields of a subclass: paths and options, no large arrays."""

    key: str  # Of everything that decides the result, see `content_key`
    label: str  # For messages


def content_key(facts: Mapping[str, Any]) -> str:
    """Key of a point: a hash of the JSON values that decide its result (options, hashes of files, versions).

    >>> content_key({"bits": 8, "data": "c0ffee"})
    'a758198fa7fc427a63415cec'
    >>> content_key({"bits": 8, "data": "c0ffee"}) == content_key({"data": "c0ffee", "bits": 8})
    True
    """
    text = json.dumps(facts, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def sweep(
    points: Sequence[AJob],
    measure: Callable[[AJob], Any],
    store: Path,
    *,
    jobs: int | None = None,
    label: str,
    kind: Any = Any,
    own: Sequence[Path] = (),
    until: float | None = None,
) -> dict[str, Any]:
    """Measure jobs, as far as the store does not know them; their results by key, of a `kind` that is decoded.

    They are begun in this order; of those with equal keys the first is measured. `measure` makes JSON values
    of a job, a function of a module, since it crosses process borders. `store` is an SQLite file in a folder
    that exists. `jobs` are processes at a time (one a core), whose libraries use one thread each; `label`
    says what is done; half-written files are removed from folders that are its `own`. From the time `until`, by
    the monotonic clock, none is begun.

    What a measurement raises is raised with notes that name it and say what is kept, as does the text of a
    KeyboardInterrupt; UnfinishedError, if a process died.
    """
    keys = list(dict.fromkeys(point.key for point in points))
    if store.exists() and not store.is_file():
        raise DataError(f"{store}: is not a file; give another output")
    with only_one(store), closing(sqlite3.connect(store)) as kept:
        for folder in own:
            remove_leftovers(folder)
        with reading(store, DataError, "give another output, or delete it"):
            require_size(store.stat().st_size if store.exists() else 0, "store of measurements", STORE_LIMIT)
            rows = _rows_of(kept)
            WRITTEN[str(store)] = None
            results = {key: decode(kind, _unsealed(key, rows[key])) for key in keys if key in rows}
        first = {point.key: point for point in reversed(points)}
        waiting = [first[key] for key in keys if key not in results]

        def standing() -> str:
            done = sum(key in results for key in keys)
            return f"{done} of {len(keys)} measurements of this stage are kept in {store}"

        progress = Progress(len(waiting))
        try:
            progress(0, label)
            for done, (index, found) in enumerate(
                side_by_side(waiting, partial(_named, measure), jobs=jobs, until=until), 1
            ):
                key = waiting[index].key
                text = json.dumps(found, allow_nan=False)
                with kept:
                    kept.execute("INSERT INTO results VALUES (?, ?)", (key, sealed(key, text)))
                results[key] = decode(kind, json.loads(text))
                progress(done, label)
        except KeyboardInterrupt as interrupt:
            raise KeyboardInterrupt(f"{standing()}; go on with the same command") from interrupt
        except sqlite3.OperationalError as error:  # a full disk, say
            raise OSError(None, str(error), str(store)) from error
        except SpikeloomError as error:
            error.add_note(standing())
            raise
        return {key: results[key] for key in keys if key in results}


TABLE = "CREATE TABLE results (key TEXT PRIMARY KEY, result TEXT)"
"""All that a store has."""

STORE_LIMIT = 1 << 30
"""Bytes of a store."""


def _rows_of(kept: sqlite3.Connection) -> dict[str, str]:
    """Results of a store, which may be new, by key; FileFault if it is damaged, or no table of ours alone.

    Rows of that table take no more than its file has: views, triggers and functions are what could.
    """
    kept.execute("PRAGMA trusted_schema = OFF")
    found = kept.execute("SELECT substr(sql, 1, 999) FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    if found not in ([], [(TABLE,)]):
        raise FileFault("is no store of measurements, or holds more than these")
    if not found:
        kept.execute(TABLE)
    if (said := kept.execute("PRAGMA quick_check").fetchone()) != ("ok",):
        raise FileFault(f"is damaged ({said})")
    return dict(kept.execute("SELECT key, result FROM results"))


def _named(measure: Callable[[AJob], AResult], job: AJob) -> AResult:
    """Measure a job; what that raises has a note that names it."""
    try:
        return measure(job)
    except Exception as error:
        error.add_note(job.label)
        raise


def sealed(key: str, text: str) -> str:
    """A result as a store holds it: with a hash, for SQLite has none."""
    return f"{content_key({key: text})} {text}"


def _unsealed(key: str, row: str) -> Any:
    """A result from a store; FileFault if it was altered."""
    text = row.partition(" ")[2]
    if sealed(key, text) != row:
        raise FileFault(f"its result {key} does not match its hash, so it was altered")
    return json.loads(text)


def side_by_side(
    payloads: Sequence[APayload],
    run: Callable[[APayload], AResult],
    *,
    jobs: int | None = None,
    until: float | None = None,
) -> Iterator[tuple[int, AResult]]:
    """Work on payloads, begun in this order, in processes of their own in this folder; on a single one here.

    With a `cluster` its workers take them all.

    Yields the place of a payload and what `run`, a function of a module, made of it, as they come; none is begun
    from the time `until`. Raises what `run` raised; UnfinishedError, if a process ended while it worked, and with it
    what the others had not finished.
    """
    require_least({"jobs": jobs}, jobs=1)
    due = takewhile(lambda _: until is None or time.monotonic() < until, enumerate(payloads))
    if cluster() is not None:
        yield from spread(due, run)
        return
    processes = min(jobs or os.cpu_count() or 1, len(payloads))
    if processes <= 1:
        with one_thread():
            yield from ((index, run(payload)) for index, payload in due)
        return
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.backend import resource_tracker as trackers_of_joblib
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    if os.name == "posix":  # elsewhere there are no such processes
        for tracker in (resource_tracker, trackers_of_joblib):
            tracker.ensure_running()  # which makes later processes hear signals, so it comes first
    attempt = delayed(partial(_in_child, os.getpid(), Path.cwd(), run))
    with parallel_config("loky", n_jobs=processes, inner_max_num_threads=1), warnings.catch_warnings():
        # One that has grown is replaced, and nothing lost
        warnings.filterwarnings("ignore", "A worker stopped")
        work = Parallel(return_as="generator_unordered", batch_size=1)
        # Of new processes, until they work
        before = _mask("SIG_BLOCK", {signal.SIGINT})
        try:
            found = work(attempt(index, payload) for index, payload in due)
            _mask("SIG_SETMASK", before)
            yield from found
        except TerminatedWorkerError as error:
            raise UnfinishedError(
                "a process ended early, perhaps for lack of memory; use fewer --jobs"
            ) from error
        finally:
            _mask("SIG_SETMASK", before)


def _mask(how: str, signals: Collection[int]) -> Collection[int]:
    """Block signals or let them through, and return those that were blocked; Windows has no such thing."""
    if not hasattr(signal, "pthread_sigmask"):
        return ()
    return signal.pthread_sigmask(getattr(signal, how), signals)


def _in_child(
    parent: int, folder: Path, run: Callable[[APayload], AResult], index: int, payload: APayload
) -> tuple[int, AResult]:
    """Work on a payload in a process that does not outlive the one that started it, even where that is killed."""
    _end_with(parent)
    os.chdir(folder)  # the process may be left from earlier work in another one
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # forgets what came before the work
    _mask("SIG_UNBLOCK", {signal.SIGINT})
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return index, run(payload)
    except KeyboardInterrupt:
        if os.getppid() != parent:  # tidy by now, and nobody waits for a result
            os._exit(1)
        raise
    finally:
        _mask("SIG_BLOCK", {signal.SIGINT})


@cache
def _end_with(parent: int) -> None:
    """Interrupt this process, as Ctrl-C does, when its parent is gone."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        _thread.interrupt_main()
        time.sleep(20)
        os._exit(1)  # whatever it was that did not let itself be interrupted

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def only_one(output: Path) -> Iterator[None]:
    """Be the only process that works on `output`; ``NAME.lock`` beside it says so."""
    from filelock import FileLock, Timeout

    lock = FileLock(f"{output}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise OptionError(
            f"{output}: another process is working on it; wait for it, or give another output"
        ) from None
    except NotImplementedError:  # a network's file system without locks
        tell(f"warning: {output}: its file system has no locks; start no second process on it")
        yield
        return
    try:
        yield
    finally:
        with suppress(PermissionError):  # on Windows, where releasing it removes it
            Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()
