"""Sweeps on a real Dask scheduler and real workers, on loopback: killed, lost, of another version."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from socket import create_server
from types import SimpleNamespace

import pytest
from swept import KIND, VIOLATION, begun, points, square

from spikeloom.compiler.errors import CapacityError, OptionError, UnfinishedError
from spikeloom.runtime.studies.jobs.cluster import facts, refusal, require_alike, source_digest
from spikeloom.runtime.studies.jobs.sweep import sweep

pytest.importorskip("distributed", reason="distributed is not installed (extra 'cluster')")

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 120

DIFFERS = r"^--scheduler tcp://\S+: worker tcp://127.0.0.1:\d+: has spikeloom source [0-9a-f]{12}, here it is "


class Cluster:
    """A scheduler and its workers, each a process of its own."""

    def __init__(self, **config: str) -> None:
        with create_server(("127.0.0.1", 0)) as socket:
            port = socket.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self.processes: list[subprocess.Popen[bytes]] = []
        self.scheduler = self.started("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), **config)

    def started(self, module: str, *words: str, source: Path = ROOT, **config: str) -> subprocess.Popen[bytes]:
        """A process of Dask, whose modules of ours are those of `source`."""
        paths = os.pathsep.join([str(source), str(ROOT / "tests")])
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", "--no-dashboard", *words],
            cwd=source,  # which -m looks into first
            env=os.environ | config | {"PYTHONPATH": paths},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.processes.append(process)
        return process

    def worker(self, *words: str, source: Path = ROOT) -> subprocess.Popen[bytes]:
        """A worker; without a nanny nobody starts it again."""
        given = words or ("--nthreads", "1", "--no-nanny")
        return self.started("dask_worker", self.address, "--host", "127.0.0.1", *given, source=source)

    def reachable(self, workers: int) -> None:
        """Wait until it answers, with as many workers."""
        from distributed import Client

        def answers() -> bool:
            try:
                with Client(self.address, timeout=2, set_as_default=False) as client:
                    return len(client.nthreads()) == workers
            except OSError:
                return False

        until(answers)

    def lets_go(self) -> None:
        """Wait until it keeps no result: what is kept in a worker that is lost would be measured again."""
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            until(lambda: "memory" not in client.run_on_scheduler(states))

    def end(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def made() -> Iterator[Callable[..., Cluster]]:
    """Makes clusters that end with the test."""
    clusters = []

    def make(**config: str) -> Cluster:
        clusters.append(Cluster(**config))
        return clusters[-1]

    yield make
    for cluster in clusters:
        cluster.end()


def swept_there(folder: Path, asked, address: str):
    return sweep(asked, square, folder / "x.store", kind=KIND, version=1, scheduler=address, label="squares")


def until(so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not so():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def kept(store: Path) -> int:
    return len(store.read_text().splitlines()) - 1


def states(dask_scheduler) -> set[str]:
    return {task.state for task in dask_scheduler.tasks.values()}


def meanwhile(what: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=what)
    thread.start()
    return thread


def expected(count: int) -> list[dict]:
    return [{"square": n * n, "third": n / 3, "pair": [n, None], "threads": "1"} for n in range(count)]


def test_a_worker_that_is_killed_costs_its_unfinished_points(made, tmp_path, capsys):
    cluster = made()
    first, _ = cluster.worker(), cluster.worker()
    cluster.reachable(2)
    log, held = tmp_path / "log", tmp_path / "held"
    held.touch()
    asked = points(log, 8, hold=dict.fromkeys((4, 5), str(held)), trouble={7: "capacity"})

    def kill() -> None:
        # both are at work, neither ends before one is dead, and whatever came before is kept
        until(lambda: {4, 5} <= set(begun(log)) and kept(tmp_path / "x.store") == len(begun(log)) - 2)
        cluster.lets_go()
        first.kill()
        first.wait()
        held.unlink()

    killer = meanwhile(kill)
    found = swept_there(tmp_path, asked[:7], cluster.address)
    killer.join()
    assert list(found.values()) == expected(7)
    counted = Counter(begun(log))
    assert counted[4] + counted[5] == 3
    assert all(counted[number] == 1 for number in (0, 1, 2, 3, 6))
    assert capsys.readouterr().err == ""

    with pytest.raises(CapacityError) as raised:
        swept_there(tmp_path, asked, cluster.address)
    assert raised.value.violations == (VIOLATION,)
    assert raised.value.__notes__ == ["number 7", f"7 of 8 points are kept in {tmp_path / 'x.store'}"]
    assert sum(Counter(begun(log)).values()) == 9, "measured again"


def test_a_scheduler_that_is_lost_leaves_what_came(made, tmp_path, monkeypatch):
    cluster = made()
    cluster.worker()
    cluster.reachable(1)
    log, held = tmp_path / "log", tmp_path / "held"
    held.touch()
    asked = points(log, 5, hold={3: str(held)})

    def kill() -> None:
        until(lambda: 3 in begun(log) and kept(tmp_path / "x.store") == 3)
        cluster.scheduler.kill()

    killer = meanwhile(kill)
    with pytest.raises(UnfinishedError) as raised:
        swept_there(tmp_path, asked, cluster.address)
    killer.join()
    held.unlink()
    assert str(raised.value) == (
        f"--scheduler {cluster.address}: was lost\n3 of 5 points are kept in {tmp_path / 'x.store'}"
    )
    assert list(raised.value.results.values()) == expected(3)
    monkeypatch.setattr("spikeloom.runtime.studies.jobs.cluster.CONNECT_S", 0.5)
    with pytest.raises(OptionError) as refused:
        swept_there(tmp_path, asked, cluster.address)
    assert str(refused.value) == (
        f"--scheduler {cluster.address}: nobody answers there within 0.5 s; start dask scheduler, or mend the address"
    )
    assert list(sweep(asked, square, tmp_path / "x.store", kind=KIND, version=1, jobs=1, label="").values()) == (
        expected(5)
    )
    assert set(begun(log)[:3]) == {0, 1, 2}
    assert all(Counter(begun(log))[number] == 1 for number in (0, 1, 2))


def test_workers_that_are_not_alike_are_refused(made, tmp_path):
    other = tmp_path / "other"
    for package in ("spikeloom",):
        shutil.copytree(ROOT / package, other / package, ignore=shutil.ignore_patterns("pretrained", "__pycache__"))
    with (other / "runtime" / "sweep.py").open("a") as file:
        file.write("# another line\n")
    cluster = made()
    worker = cluster.worker(source=other)
    cluster.reachable(1)
    asked = points(tmp_path / "log", 1)
    with pytest.raises(OptionError, match=DIFFERS) as raised:
        swept_there(tmp_path, asked, cluster.address)
    assert f"here it is {source_digest()}; install the same there" in str(raised.value)
    worker.kill()
    worker.wait()
    cluster.worker("--nthreads", "2", "--no-nanny")
    cluster.reachable(1)
    with pytest.raises(OptionError, match=r"runs 2 threads, points need a process each; start it with --nthreads 1"):
        swept_there(tmp_path, asked, cluster.address)
    assert begun(tmp_path / "log") == []


@pytest.mark.slow
def test_a_point_that_kills_workers_is_left_out(made, tmp_path):
    cluster = made(DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0")
    cluster.worker("--nthreads", "1")  # its nanny starts it again
    cluster.reachable(1)
    with pytest.raises(UnfinishedError) as raised:
        swept_there(tmp_path, points(tmp_path / "log", 4, trouble={1: "die"}), cluster.address)
    assert str(raised.value) == (
        "number 1: its worker ended early, perhaps for lack of memory; left out\n"
        f"3 of 4 points are kept in {tmp_path / 'x.store'}"
    )
    assert Counter(begun(tmp_path / "log")) >= Counter({0: 1, 1: 2, 2: 1, 3: 1})


@pytest.mark.slow
def test_workers_may_come_later(made, tmp_path, capsys):
    cluster = made()
    cluster.reachable(0)
    helper = meanwhile(lambda: (time.sleep(3), cluster.worker()))
    assert list(swept_there(tmp_path, points(tmp_path / "log", 3), cluster.address).values()) == expected(3)
    helper.join()
    assert capsys.readouterr().err == f"spikeloom: {cluster.address}: has no workers; waiting for some\n"


# --- without a cluster ------------------------------------------------------------------------------------------------


def worker_of(threads: int) -> SimpleNamespace:
    return SimpleNamespace(address="tcp://10.0.0.7:4", state=SimpleNamespace(nthreads=threads))


def test_refusals():
    here = facts()
    assert refusal(here, worker_of(1)) is None
    assert refusal(here, worker_of(4)) == (
        "worker tcp://10.0.0.7:4: runs 4 threads, points need a process each; start it with --nthreads 1"
    )
    assert refusal(here | {"spikeloom": "9.9"}, worker_of(1)) == (
        f"worker tcp://10.0.0.7:4: has spikeloom {here['spikeloom']}, here it is 9.9; install the same there"
    )
    assert refusal(here | {"torch": "9.9"}, worker_of(1)) == (
        f"worker tcp://10.0.0.7:4: has torch {here['torch']}, here it is 9.9; install the same there"
    )


def test_a_worker_without_this_package():
    reason = ModuleNotFoundError("No module named 'runtime'")
    client = SimpleNamespace(run=lambda *_, **__: {"tcp://10.0.0.7:4": reason})
    with pytest.raises(OptionError) as raised:
        require_alike(client, "tcp://h:1")
    assert str(raised.value) == (
        "--scheduler tcp://h:1: worker tcp://10.0.0.7:4 cannot load this spikeloom (No module named 'runtime'); "
        f"install {facts()['spikeloom']} there"
    )


@pytest.mark.parametrize("address", ["localhost:8786", "http://h:1", "tcp://h", "tcp://:1", "tcp://h:x", ""])
def test_what_is_no_address(tmp_path, address):
    with pytest.raises(OptionError) as raised:
        swept_there(tmp_path, points(tmp_path / "log", 1), address)
    assert str(raised.value) == f"--scheduler {address}: is no address; give one as in tcp://10.0.0.1:8786"


def test_without_dask(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(OptionError) as raised:
        swept_there(tmp_path, points(tmp_path / "log", 1), "tcp://h:1")
    assert str(raised.value) == (
        "--scheduler tcp://h:1: needs Dask, which is not installed; install distributed, or leave it away"
    )


def test_dask_is_loaded_where_it_is_asked_for_only():
    code = (
        "import sys, spikeloom.runtime.cli, "
        "spikeloom.runtime.studies.jobs.cluster; "
        "sys.exit('distributed' in sys.modules or 'dask' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT / "src", check=False).returncode == 0
