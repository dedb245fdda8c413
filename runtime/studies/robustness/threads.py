"""Several measurements at a time."""

import os
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from joblib import Parallel, delayed

from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.studies.cluster import cluster, spread

P = TypeVar("P")
R = TypeVar("R")


def in_threads(run: Callable[[P], R], payloads: Sequence[P], label: str, jobs: int | None) -> list[R]:
    """Results of payloads, in their order; one thread a core by default, or the workers of a `cluster`.

    Kernels let go of the interpreter's lock.
    """
    made: Iterator[tuple[int, R]]
    if cluster() is None:
        work = Parallel(jobs or os.cpu_count(), backend="threading", return_as="generator")
        made = enumerate(work(map(delayed(run), payloads)))
    else:
        made = spread(enumerate(payloads), run)
    progress = Progress(len(payloads))
    progress(0, label)
    results: dict[int, R] = {}
    for index, result in made:
        results[index] = result
        progress(len(results), label)
    return [results[index] for index in range(len(payloads))]
