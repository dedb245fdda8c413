"""Work on the workers of a Dask cluster, on this or other machines, instead of processes and threads here.

Dask starts again elsewhere what a lost worker had begun. Workers share this machine's folders and have its code,
libraries and files, or are refused by name: results are the same, byte for byte.
"""

import hashlib
import logging
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, wraps
from importlib import metadata, resources
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from spikeloom.compiler.errors import OptionError, UnfinishedError
from spikeloom.compiler.files import sha256_of
from spikeloom.runtime.inputs.files import INPUTS, shipped
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.choices import ClusterChoice

P = TypeVar("P")
R = TypeVar("R")
Q = TypeVar("Q", bound=ClusterChoice)

LOCAL = "local:"

PATIENCE = 30
"""Seconds in which a scheduler answers, and a first worker comes."""

AGAIN = 2
"""Seconds after which it is looked whether workers have come or gone."""

WORKERS = {"distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None}
"""Dask's default has workers hand every freed array back to the system, which takes longer than the work."""

ROOMS = ("compiler", "models", "runtime")

LIBRARIES = ("numpy", "scipy", "torch", "numba")
"""What figures are computed with."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What decides results beside the work itself: a worker has the same, or is refused."""

    folder: str
    versions: Mapping[str, str]
    files: Mapping[str, str]  # Hashes of the inputs, by path

    def require(self, worker: str) -> None:
        """Refuse a worker that has something else: an OptionError that names both."""
        try:
            os.chdir(self.folder)
        except OSError as error:
            raise OptionError(
                f"--scheduler: worker {worker} has no folder {self.folder} ({error.strerror}); share it with all"
            ) from error
        for name, wanted in {**self.versions, **self.files}.items():
            there = versions()[name] if name in self.versions else _digest(name)
            if there != wanted:
                raise OptionError(
                    f"--scheduler: worker {worker} has another {name} ({there[:12]}, here {wanted[:12]}); "
                    "make them the same"
                )


@dataclass(frozen=True, slots=True)
class Cluster:
    """A scheduler's client, and what its workers have to have."""

    client: Any
    surroundings: Surroundings


_CLUSTER: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


def cluster() -> Cluster | None:
    """The cluster that work goes to; None where it stays here."""
    return _CLUSTER.get()


@cache
def versions() -> Mapping[str, str]:
    """Versions of what computes here, our own code as a hash; threads decide in which order sums are added."""
    running = hashlib.sha256()
    for room in ROOMS:
        files = _files(Path(str(resources.files(f"spikeloom.{room}"))))
        for file in sorted(each for each in files if each.suffix in (".py", ".toml")):
            running.update(file.read_bytes())
    return {
        "spikeloom": running.hexdigest(),
        "Python": platform.python_version(),
        **{name: metadata.version(name) for name in LIBRARIES},
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "none"),
    }


def _files(folder: Path) -> Iterator[Path]:
    """Files in a folder and those below."""
    for path in folder.iterdir():
        if path.is_dir():
            yield from _files(path)
        else:
            yield path


def _digest(path: str) -> str:
    """Hash of a file, or of all in a folder; "none" where there is no such thing."""
    place = Path(path)
    if place.is_file():
        return _hashed(place, place.stat().st_mtime_ns)
    if not place.is_dir():
        return "none"
    parts = {
        file.relative_to(place).as_posix(): _hashed(file, file.stat().st_mtime_ns) for file in _files(place)
    }
    return hashlib.sha256(repr(sorted(parts.items())).encode()).hexdigest()


@cache
def _hashed(file: Path, _changed: int) -> str:
    """Hash of a file that was last changed then."""
    return sha256_of(file)


def surroundings_of(request: ClusterChoice) -> Surroundings:
    """What workers have to have for a request."""
    named = [getattr(request, name, None) for name in INPUTS]
    paths = [each for value in named for each in (value if isinstance(value, tuple) else [value])]
    files = {shipped(path) for path in paths if isinstance(path, str) and Path(shipped(path)).exists()}
    return Surroundings(
        folder=str(Path.cwd()),
        versions={**versions(), "OMP_NUM_THREADS": "1"},
        files={str(Path(path).absolute()): _digest(path) for path in sorted(files)},
    )


def on_cluster(run: Callable[[Q], Outcome]) -> Callable[[Q], Outcome]:
    """Let a command work where its ``--scheduler`` says."""

    @wraps(run)
    def anywhere(request: Q) -> Outcome:
        if request.scheduler is None:
            return run(request)
        refuse(request, ("jobs",), "--scheduler's workers decide")
        with _joined(request.scheduler) as client:
            before = _CLUSTER.set(Cluster(client, surroundings_of(request)))
            try:
                return run(request)
            finally:
                _CLUSTER.reset(before)

    return anywhere


@contextmanager
def _joined(address: str) -> Iterator[Any]:
    """A client of a scheduler, or of one that is started here with as many workers."""
    try:
        from dask import config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise OptionError(
            f"--scheduler {address}: Dask is not installed; pip install 'spikeloom[cluster]'"
        ) from error

    workers = address.removeprefix(LOCAL)
    if workers == address:
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # all of it is raised, too
        try:
            known = Client(address, timeout=PATIENCE)
        except (OSError, ValueError) as error:
            raise OptionError(f"--scheduler {address}: {error}; start one: dask scheduler") from error
        with known as client:
            yield client
        return
    if not workers.isdigit() or not int(workers):
        raise OptionError(f"--scheduler {address}: allowed are {LOCAL}1 or more, or an address")
    with (
        config.set(WORKERS),
        LocalCluster(
            n_workers=int(workers), threads_per_worker=1, dashboard_address=None, silence_logs=logging.ERROR
        ) as here,
        Client(here) as client,
    ):
        yield client


def spread(due: Iterator[tuple[int, P]], run: Callable[[P], R]) -> Iterator[tuple[int, R]]:
    """Work on numbered payloads, begun in this order, as many at a time as the workers have threads.

    Yields numbers and results as they come. Raises what `run` raised; UnfinishedError if the scheduler is gone, no
    worker comes, or some of the work ends its workers again and again.
    """
    from distributed import KilledWorker, wait

    joined = cluster()
    assert joined is not None, "asked for"
    client = joined.client
    shared = client.submit(_shared, run, pure=False)  # once to each worker, made again if one is lost
    waiting: dict[Any, int] = {}
    try:
        while True:
            free = _threads(client) - len(waiting)
            for index, payload in islice(due, max(free, 0)):
                waiting[client.submit(_work, joined.surroundings, shared, payload, pure=False)] = index
            if not waiting:
                return
            try:
                done = wait(list(waiting), timeout=AGAIN, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                continue
            for future in done:
                result = future.result()
                yield waiting.pop(future), result
    except KilledWorker as error:
        raise UnfinishedError(
            "a worker ended early again and again, perhaps for lack of memory; give workers more"
        ) from error
    except (CancelledError, OSError) as error:
        if client.status == "running" and isinstance(error, OSError):
            raise  # of the work
        raise UnfinishedError("--scheduler: it is gone; start it again") from error
    finally:
        client.cancel([shared, *waiting], force=True)


def _threads(client: Any) -> int:
    """Threads of all workers, of which there is one after a while."""
    until = time.monotonic() + PATIENCE
    while not (threads := sum(client.nthreads().values())):
        if time.monotonic() > until:
            raise UnfinishedError(
                f"--scheduler: no worker came in {PATIENCE} s; start one: dask worker ADDRESS --nthreads 1"
            )
        time.sleep(0.2)
    return int(threads)


def _shared(run: Callable[[P], R]) -> Callable[[P], R]:
    return run


def _work(surroundings: Surroundings, run: Callable[[P], R], payload: P) -> R:
    """Work on a payload, on a worker."""
    from distributed import get_worker

    surroundings.require(get_worker().name or get_worker().address)
    with one_thread():
        return run(payload)


@contextmanager
def one_thread() -> Iterator[None]:
    """As joblib's processes have it, so that the order of float sums is the same here."""
    torch = sys.modules.get("torch")
    threads = 0 if torch is None else torch.get_num_threads()
    if torch is not None:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if torch is not None:
            torch.set_num_threads(threads)
