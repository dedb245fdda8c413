"""Work on the machines of a Dask cluster that is there already: its scheduler hands out, its workers measure.

Dask itself is loaded only here, and only where a scheduler is asked for. On this machine alone processes of our own
(:mod:`jobs.workers`) do: they start several times faster and open no port.
"""

from __future__ import annotations

import hashlib
import logging
import platform
import re
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import cache
from importlib import metadata, resources
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from spikeloom import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.studies.jobs.workers import ProcessDied, attempt, one_thread_each

APayload = TypeVar("APayload")
AResult = TypeVar("AResult")

CONNECT_S = 5.0
"""How long a scheduler may take to answer."""

GLANCE_S = 1.0
"""How often to look after a cluster that sends nothing."""

CLOSE_S = 2.0

PACKAGES = ("spikeloom",)


class ClusterLostError(Exception):
    """The scheduler was there and is no more, or dropped the work."""

    def __str__(self) -> str:
        return f"--scheduler {self.args[0]}: was lost"


def require_address(scheduler: str) -> None:
    """Refuse what is no address of a scheduler.

    Raises
    ------
    OptionError
        If it is none.
    """
    if re.fullmatch(r"(tcp|tls)://.+:\d{1,5}", scheduler) is None:
        raise OptionError(f"--scheduler {scheduler}: is no address; give one as in tcp://10.0.0.1:8786")


def run_on_cluster(
    payloads: Sequence[APayload], run: Callable[[APayload], AResult], *, scheduler: str, tell: Callable[[str], object]
) -> Generator[tuple[int, AResult | Exception]]:
    """Work on payloads in the workers of a cluster.

    Parameters
    ----------
    payloads : sequence
        Small: they go over the network. Handed out in this order.
    run : callable
        Does the work; a function of a module that every worker has.
    scheduler : str
        Its address.
    tell : callable
        Takes a line where there are no workers for now.

    Yields
    ------
    (int, result)
        As :func:`workers.run_side_by_side` does; `ProcessDied` where a worker ended as often as the scheduler
        allows (``distributed.scheduler.allowed-failures``, 3), and again when nothing else was at work.

    Raises
    ------
    OptionError
        If Dask is not installed, the address is none, nobody answers, or a worker is not like this machine.
    ClusterLostError
        If the scheduler is lost.
    """
    with _connected(scheduler) as client:
        require_alike(client, scheduler)
        blamed = []
        for index, found in _handed_out(client, scheduler, range(len(payloads)), payloads, run, tell):
            if isinstance(found, ProcessDied):
                blamed.append(index)
            else:
                yield index, found
        # Dask blames a death on what waited in that worker, too; so whoever is blamed has a second chance, alone
        for index in blamed:
            yield from _handed_out(client, scheduler, [index], payloads, run, tell)


def _handed_out(
    client: Any,
    scheduler: str,
    batch: Sequence[int],
    payloads: Sequence[APayload],
    run: Callable[[APayload], AResult],
    tell: Callable[[str], object],
) -> Iterator[tuple[int, AResult | Exception]]:
    """Hand out a batch and take what comes."""
    from distributed.scheduler import KilledWorker

    come: SimpleQueue[Any] = SimpleQueue()
    places = {}
    for index in batch:
        future = client.submit(measure_point, run, payloads[index], facts(), pure=False)
        places[future] = index
        future.add_done_callback(come.put)
    told = False
    while places:
        try:
            future = come.get(timeout=GLANCE_S)
        except Empty:
            told = _look_after(client, scheduler, tell, told=told)
            continue
        index = places.pop(future)
        if future.status == "finished":
            try:
                found = future.result()
            except (OSError, CancelledError):  # it came to its end, but not to us
                raise ClusterLostError(scheduler) from None
            future.release()  # or it is measured again where the worker that keeps it is lost
            yield index, found
        elif future.status == "error":
            error = future.exception()
            if not isinstance(error, KilledWorker):
                raise error
            yield index, ProcessDied("its worker ended early", times=error.allowed_failures + 1)
        else:
            raise ClusterLostError(scheduler)


def _look_after(client: Any, scheduler: str, tell: Callable[[str], object], *, told: bool) -> bool:
    """Whether there are no workers for now, which is told once."""
    if client.status != "running":
        raise ClusterLostError(scheduler)
    try:
        alone = not client.nthreads()
    except OSError:
        return told  # it is about to be lost, or was only busy
    if alone and not told:
        tell(f"{scheduler}: has no workers; waiting for some")
    return alone


@contextmanager
def _connected(scheduler: str) -> Iterator[Any]:
    """A client, closed at the end with all that it asked for."""
    require_address(scheduler)
    try:
        from distributed import Client
    except ImportError:
        raise OptionError(
            f"--scheduler {scheduler}: needs Dask, which is not installed; install distributed, or leave it away"
        ) from None
    for name in ("distributed", "distributed.client", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is told in one line
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except OSError:
        raise OptionError(
            f"--scheduler {scheduler}: nobody answers there within {CONNECT_S:g} s; start dask scheduler, or mend the "
            "address"
        ) from None
    try:
        yield client
    finally:
        client.close(timeout=CLOSE_S)


# -- on the workers ----------------------------------------------------------------------------------------------------


def measure_point(
    run: Callable[[APayload], AResult], payload: APayload, here: Mapping[str, str]
) -> AResult | Exception:
    """Work on a payload, in a worker."""
    from distributed import get_worker

    refused = refusal(here, get_worker())
    if refused is not None:
        return OptionError(refused)
    with one_thread_each():
        return attempt(run, payload)


def refusal(here: Mapping[str, str], dask_worker: Any) -> str | None:
    """Why a worker cannot take part, if it cannot.

    Parameters
    ----------
    here : mapping of str to str
        `facts` of the machine that asks.
    dask_worker : distributed.Worker
        Given by Dask, by this name.
    """
    where = f"worker {dask_worker.address}"
    threads = dask_worker.state.nthreads
    if threads != 1:
        return f"{where}: runs {threads} threads, points need a process each; start it with --nthreads 1"
    there = facts()
    for name, value in here.items():
        if there.get(name) != value:
            return f"{where}: has {name} {there.get(name)}, here it is {value}; install the same there"
    return None


@cache
def facts() -> dict[str, str]:
    """What has to be the same wherever points are measured: versions, and the source itself."""
    return {
        "spikeloom": __version__,
        "spikeloom source": source_digest(),
        "Python": ".".join(platform.python_version_tuple()[:2]),
        **{name: metadata.version(name) for name in ("numpy", "torch")},
    }


def source_digest() -> str:
    """Hash of the modules and tables of this package, 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        root = resources.files(package)
        with resources.as_file(root) as folder:
            for file in sorted(path for kind in ("py", "toml") for path in folder.rglob(f"*.{kind}")):
                content = file.read_bytes()
                digest.update(f"{package}/{file.relative_to(folder).as_posix()} {len(content)}\n".encode())
                digest.update(content)
    return digest.hexdigest()[:12]


def require_alike(client: Any, scheduler: str) -> None:
    """Refuse, before anything is measured, workers that are there and cannot take part."""
    for worker, found in sorted(client.run(refusal, facts(), on_error="return").items()):
        if isinstance(found, Exception):
            raise OptionError(
                f"--scheduler {scheduler}: worker {worker} cannot load this spikeloom ({found}); install "
                f"{facts()['spikeloom']} there"
            )
        if found is not None:
            raise OptionError(f"--scheduler {scheduler}: {found}")
