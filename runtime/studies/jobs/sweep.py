"""Many measurements, each kept as soon as it is there: on the cores of this machine, or on a cluster of Dask.

A sweep can be ended at any time, by Ctrl-C, a kill or a loss of power. What was measured is in its store
(:mod:`jobs.sweep_store`), by keys that name everything that decides a result; the same command goes on from there.
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
from typing import Any, TypeVar

from spikeloom.compiler.errors import OptionError, SpikeloomError, UnfinishedError
from spikeloom.runtime.studies.jobs.cluster import ClusterLostError, require_address, run_on_cluster
from spikeloom.runtime.studies.jobs.sweep_store import Store, opened
from spikeloom.runtime.studies.jobs.workers import (
    ProcessDied,
    attempt,
    cores,
    ended_by_signal,
    one_thread_each,
    run_side_by_side,
)

Json = dict[str, Any]
Measure = Callable[[Any], Json]
AResult = TypeVar("AResult")

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
        What `measure` is given: absolute paths and options, no arrays; it may travel to another machine.
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


def add_place_arguments(parser: argparse.ArgumentParser, note: str = "") -> None:
    """Add the options that say where many things are measured."""
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at a time (default: one a core)")
    parser.add_argument(
        "--scheduler", metavar="tcp://HOST:PORT", help=f"work on the workers of this Dask scheduler instead{note}"
    )


def require_place_to_work(jobs: int | None, scheduler: str | None) -> None:
    """Refuse `--jobs` and `--scheduler` that cannot be meant.

    Raises
    ------
    OptionError
        If there are no processes, both are given, or the address is none.
    """
    if jobs is not None and jobs < 1:
        raise OptionError(f"--jobs {jobs}: allowed are 1 or more; choose another")
    if scheduler is None:
        return
    require_address(scheduler)
    if jobs is not None:
        raise OptionError(
            f"--jobs {jobs}: counts processes on this machine, --scheduler has workers of its own; leave one away"
        )


def add_sweep_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where a sweep runs, and whether it begins anew."""
    add_place_arguments(parser)
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
    from tqdm import tqdm  # here, since every command loads this module

    require_place_to_work(jobs, scheduler)
    keys = list(dict.fromkeys(point.key for point in points))
    with opened(store, kind=kind, version=version, fresh=fresh) as kept:
        first = {point.key: point for point in reversed(points)}
        waiting = [first[key] for key in keys if key not in kept.results]
        lost = []
        there = tqdm(total=len(keys), initial=len(keys) - len(waiting), desc=label, unit="point", disable=None)
        with there as bar, ended_by_signal():
            try:
                with closing(spread(waiting, measure, jobs=jobs, scheduler=scheduler)) as measured:
                    for point, found in measured:
                        if isinstance(found, ProcessDied):
                            lost.append(left_out(point, found))
                        elif isinstance(found, Exception):
                            found.add_note(point.label)
                            raise found
                        else:
                            kept.add(point.key, found)
                            bar.update()
            except KeyboardInterrupt as interrupt:
                raise KeyboardInterrupt(f"{_kept(kept, keys)}; go on with the same command") from interrupt
            except ClusterLostError as error:
                lost.append(str(error))
            except SpikeloomError as error:
                error.add_note(_kept(kept, keys))
                raise
        results = {key: kept.results[key] for key in keys if key in kept.results}
        if lost:
            raise UnfinishedError("\n".join([*lost, _kept(kept, keys)]), results)
        return results


def _kept(store: Store, keys: Sequence[str]) -> str:
    return f"{sum(key in store.results for key in keys)} of {len(keys)} points are kept in {store.path}"


def spread(
    points: Sequence[Point], measure: Callable[[Any], AResult], *, jobs: int | None = None, scheduler: str | None = None
) -> Generator[tuple[Point, AResult | Exception]]:
    """Measure points wherever that was asked for; what `sweep` does without its store.

    Yields
    ------
    (Point, result)
        As they come: what was measured, the exception that the measurement raised, or
        :class:`workers.ProcessDied` where that ended its process too often.

    Raises
    ------
    OptionError, ClusterLostError
        See :func:`cluster.run_on_cluster`.
    """
    if not points:
        return
    payloads = [point.payload for point in points]
    processes = min(jobs or cores(), len(points))
    if scheduler is not None:
        measured = run_on_cluster(payloads, measure, scheduler=scheduler, tell=tell)
    elif processes == 1:
        measured = ((index, attempt(measure, payload)) for index, payload in enumerate(payloads))
    else:
        measured = run_side_by_side(
            payloads,
            measure,
            processes=processes,
            tries=TRIES,
            again=lambda index, died: tell(f"{points[index].label}: {died}; tried again"),
        )
    with closing(measured), one_thread_each():
        for index, found in measured:
            yield points[index], found


def left_out(point: Point, died: ProcessDied) -> str:
    """What is told of a point without a result."""
    return f"{point.label}: {died}, perhaps for lack of memory; left out"


def tell(line: str) -> None:
    """Say something on stderr, above the progress bar where there is one."""
    from tqdm import tqdm

    tqdm.write(f"spikeloom: {line}", file=sys.stderr)
