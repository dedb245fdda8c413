"""What it costs to hand out points: processes of our own beside embedded workers of Dask.

``python benchmarks/sweep_workers.py [POINTS]``: seconds until the first of two workers has answered, and for all points
of no work at all.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

from spikeloom.runtime.studies.jobs.workers import one_thread_each, run_side_by_side


def nothing(number: int) -> int:
    return number


def own(points: int) -> Iterator[object]:
    """Processes of our own."""
    with one_thread_each():
        yield from run_side_by_side(range(points), nothing, processes=2)


def embedded(points: int) -> Iterator[object]:
    """A scheduler and two worker processes that Dask starts on loopback."""
    from distributed import Client, LocalCluster, as_completed

    there = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with LocalCluster(**there) as cluster, Client(cluster) as client:
        yield from as_completed(client.map(nothing, range(points), pure=False))


def main() -> None:
    points = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    for name, way in (("processes", own), ("embedded Dask", embedded)) * 3:
        began = time.perf_counter()
        first = 0.0
        for count, _ in enumerate(way(points)):
            first = first if count else time.perf_counter() - began
        whole = time.perf_counter() - began
        print(f"{name:14} first {first:5.2f} s, {points} points {whole:5.2f} s")


if __name__ == "__main__":
    main()
