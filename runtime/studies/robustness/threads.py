"""Several measurements at a time."""

import os
from collections.abc import Iterable
from typing import Any

from joblib import Parallel

from spikeloom.runtime.report.console import Progress


def in_threads(calls: Iterable[Any], total: int, label: str, jobs: int | None) -> list[Any]:
    """Results of joblib's delayed calls, in their order; one thread a core by default.

    Kernels let go of the interpreter's lock.
    """
    work = Parallel(jobs or os.cpu_count(), backend="threading", return_as="generator")
    progress = Progress(total)
    progress(0, label)
    results = []
    for done, result in enumerate(work(calls), 1):
        results.append(result)
        progress(done, label)
    return results
