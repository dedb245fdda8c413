"""Many measurements, each kept as soon as it is there: on the cores of this machine, or on a cluster of Dask.

A sweep can be ended at any time, by Ctrl-C, a kill or a loss of power. What was measured is in its store
(:mod:`runtime.sweep_store`), by keys that name everything that decides a result; the same command goes on from there.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from compiler.errors import OptionError, SpikeloomError, UnfinishedError
from runtime.sweep_store import Store, opened
from runtime.workers import ProcessDied, cores, ended_by_signal, one_thread_each, run_side_by_side

Json = dict[str, Any]
Measure = Callable[[Any], Json]

TRIES = 3
"""How often a point whose process dies is begun."""

KEY_DIGITS = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One measurement of a sweep.

    Parameters
    ----------
    key : str
        Of everything that decides the result, see `content_key`.
    label : str
        For messages.
    payload : picklable
        What `measure` is given: paths and options, no arrays.
    """

    key: str
    label: str
    payload: Any


def content_key(facts: Mapping[str, Any]) -> str:
    """Key of a point: a hash of what decides its result, in JSON.

    Parameters
    ----------
    facts : mapping
        JSON values: options, hashes of the files that are read, version of the measurement.

    Examples
    --------
    >>> content_key({"bits": 8, "data": "c0ffee"})
    'a758198fa7fc427a63415cec'
    >>> content_key({"bits": 8, "data": "c0ffee"}) == content_key({"data": "c0ffee", "bits": 8})
    True
    """
    text = json.dumps(facts, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]


def add_sweep_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where a sweep runs, and whether it begins anew."""
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at a time (default: one a core)")
    parser.add_argument(
        "--scheduler", metavar="tcp://HOST:PORT", help="measure on the workers of this Dask scheduler instead"
    )
    parser.add_argument("--fresh", action="store_true", help="measure anew what an earlier run left")


def sweep(
    points: Sequence[Point],
    measure: Measure,
    store: Path,
    *,
    kind: str,
    version: int,
    jobs: int | None = None,
    scheduler: str | None = None,
    fresh: bool = False,
    label: str,
) -> dict[str, Json]:
    """Measure points, as far as the store does not know them.

    Parameters
    ----------
    points : sequence of Point
        Begun in this order; of those with equal keys the first is measured.
    measure : callable
        Payload to JSON values; a function of a module, since it crosses process borders. What it wants to keep from
        point to point (recordings, say) it keeps in a cache of its own.
    store : Path
        File that keeps the results, in a folder that exists.
    kind, version : str, int
        What is measured; a store of another one is refused. The version goes up when results mean something else.
    jobs : int, optional
        Processes at a time, whose libraries use one thread each; 1 measures in this process. As many as there are
        cores by default.
    scheduler : str, optional
        Address of a Dask scheduler, on whose workers to measure instead.
    fresh : bool
        Forget what the store holds.
    label : str
        Of the progress bar.

    Returns
    -------
    dict of str to dict
        Result of each point by its key, in the order of the points, as JSON gives it back (tuples are lists), whether
        it was measured now or before.

    Raises
    ------
    OptionError
        If an option cannot be meant, the scheduler cannot be reached or its workers are not like this machine, or if
        another sweep is writing to the store.
    DataError
        If the store is of something else, or damaged.
    UnfinishedError
        If points ended their process `TRIES` times, or the scheduler was lost; it carries the other results.
    SpikeloomError, OSError, MemoryError
        What a measurement raised, with a note that names its point. Results that are there are kept.
    KeyboardInterrupt
        On an interrupt or a request to end; its text says what is kept.
    """
    if jobs is not None and jobs < 1:
        raise OptionError(f"--jobs {jobs}: allowed are 1 or more; choose another")
    if jobs is not None and scheduler is not None:
        raise OptionError(
            f"--jobs {jobs}: counts processes on this machine, --scheduler has workers of its own; leave one away"
        )
    keys = list(dict.fromkeys(point.key for point in points))
    with opened(store, kind=kind, version=version, fresh=fresh) as kept:
        first = {point.key: point for point in reversed(points)}
        waiting = [first[key] for key in keys if key not in kept.results]
        lost = []
        there = tqdm(total=len(keys), initial=len(keys) - len(waiting), desc=label, unit="point", disable=None)
        with there as bar, ended_by_signal(), one_thread_each():
            try:
                with closing(_measured(waiting, measure, jobs or cores(), scheduler)) as measured:
                    for point, found in measured:
                        if isinstance(found, ProcessDied):
                            lost.append(f"{point.label}: {found} {TRIES} times, perhaps for lack of memory; left out")
                        elif isinstance(found, Exception):
                            found.add_note(point.label)
                            raise found
                        else:
                            kept.add(point.key, found)
                            bar.update()
            except KeyboardInterrupt as interrupt:
                raise KeyboardInterrupt(f"{_kept(kept, keys)}; go on with the same command") from interrupt
            except SpikeloomError as error:
                error.add_note(_kept(kept, keys))
                raise
        results = {key: kept.results[key] for key in keys if key in kept.results}
        if lost:
            raise UnfinishedError("\n".join([*lost, _kept(kept, keys)]), results)
        return results


def _kept(store: Store, keys: Sequence[str]) -> str:
    return f"{sum(key in store.results for key in keys)} of {len(keys)} points are kept in {store.path}"


def _measured(
    points: Sequence[Point], measure: Measure, processes: int, scheduler: str | None
) -> Generator[tuple[Point, Json | Exception]]:
    """Points and what came of them, as they come."""
    if scheduler is not None:
        raise OptionError("--scheduler: is not there yet")
    if min(processes, len(points)) <= 1:
        for point in points:
            try:
                found: Json | Exception = measure(point.payload)
            except (SpikeloomError, OSError, MemoryError) as error:
                found = error
            yield point, found
        return

    def again(index: int, died: ProcessDied) -> None:
        tqdm.write(f"spikeloom: {points[index].label}: {died}; tried again", file=sys.stderr)

    payloads = [point.payload for point in points]
    at_work = run_side_by_side(payloads, measure, processes=processes, tries=TRIES, again=again)
    with closing(at_work):
        for index, come in at_work:
            yield points[index], come
