"""A real scheduler and two workers: the same bytes as on one machine, nothing lost with a worker, strangers refused."""

import json
import os
import re
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import commands
import pytest
from made_files import TAXELS, recordings_folder
from swept import begun, points, square

from spikeloom.compiler.errors import OptionError, UnfinishedError
from spikeloom.runtime.requests.choices import ClusterChoice
from spikeloom.runtime.studies import cluster
from spikeloom.runtime.studies.jobs import sweep

distributed = pytest.importorskip("distributed", reason="the extra spikeloom[cluster] is not installed")

pytestmark = pytest.mark.filterwarnings("default")  # those of Dask are its own

HERE = Path(__file__).parent


class Dask:
    """A scheduler and two workers, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.scheduler = self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        self.workers = [self.worker(), self.worker()]
        self.address = json.loads(self.waited(folder / "scheduler.json").read_text())["address"]
        with distributed.Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(len(self.workers), timeout=60)

    def start(self, what: str, *words: str) -> subprocess.Popen:
        path = os.pathsep.join([str(HERE.parent / "src"), str(HERE)])
        line = [
            sys.executable,
            "-m",
            f"distributed.cli.dask_{what}",
            *words,
            "--scheduler-file",
            "scheduler.json",
        ]
        environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
        with (self.folder / "log").open("ab") as log:
            return subprocess.Popen(line, cwd=self.folder, env=environment, stdout=log, stderr=log)

    def worker(self) -> subprocess.Popen:
        return self.start("worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard")

    def waited(self, file: Path) -> Path:
        until = time.monotonic() + 60
        while not file.exists() or not file.stat().st_size:  # it is made before it is written
            assert time.monotonic() < until, (self.folder / "log").read_text()
            time.sleep(0.05)
        return file

    def end(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def dask(tmp_path_factory):
    started = Dask(tmp_path_factory.mktemp("dask"))
    yield started
    started.end()


def on(address: str, work):
    """Do something where a request's scheduler says."""
    return cluster.on_cluster(lambda _request: work())(ClusterChoice(scheduler=address))


def test_commands_give_the_same_bytes(dask, tmp_path, monkeypatch):
    """A training, and what stresses its network, both say how far they are; another version of the code is refused."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SPIKELOOM_PROGRESS", "json")
    recordings_folder(tmp_path / "data")
    Path("ring.csv").write_text("\n".join(f"{i},{(i + 1) % TAXELS}" for i in range(TAXELS)))
    here = ["--scheduler", dask.address]
    train = ["train", "--data", "data", "--edges", "ring.csv", "--epochs", "1"]
    for folder, more in (("alone", []), ("spread", here)):
        Path(folder).mkdir()
        said = commands.run(*train, *more, "-o", f"{folder}/net.pt")[2]
        counts = [json.loads(line) for line in said.splitlines() if '"training"' in line]
        assert [line["done"] for line in counts] == ([0, 1] if more else []), said
        net = f"{folder}/net.pt"
        commands.as_json("compile", net, "-o", f"{folder}/net.loom")
        stress = [
            "stress",
            f"{folder}/net.loom",
            "--checkpoint",
            net,
            "--data",
            "data",
            "--only",
            "events_lost",
        ]
        stress += ["--seeds", "1"]
        said = commands.run(*stress, *more, "-o", f"{folder}/stress.json")[2]
        points_done = [json.loads(line) for line in said.splitlines() if "total" in line]
        assert points_done[-1]["done"] == points_done[-1]["total"] > 1, said
        assert points_done[-1]["left_s"] == 0
        commands.as_json(
            "certify",
            f"{folder}/net.loom",
            "--data",
            "data",
            "--limit",
            "3",
            *more,
            "-o",
            f"{folder}/certify.json",
        )
    for file in Path("alone").iterdir():
        alone, spread = (
            folder.joinpath(file.name).read_bytes() for folder in (Path("alone"), Path("spread"))
        )
        assert alone.replace(b"alone/", b"spread/") == spread, file
    ours = cluster.versions()
    monkeypatch.setattr(cluster, "versions", lambda: ours | {"spikeloom": "another"})
    said = commands.refusal("certify", "alone/net.loom", "--data", "data", *here)
    assert f"has another spikeloom ({ours['spikeloom'][:12]}, here another)" in said
    assert said.endswith("make them the same")


def test_points_of_a_lost_worker_are_done_elsewhere(dask, tmp_path):
    log = tmp_path / "log"
    made = points(log, 8, trouble={3: "die once"})
    squares = on(dask.address, lambda: dict(cluster.spread(enumerate(made), square)))
    assert [squares[index]["square"] for index in range(8)] == [n**2 for n in range(8)]
    assert begun(log).count(3) == 2
    assert sum(process.poll() is None for process in dask.workers) == 1


def test_without_its_scheduler_a_sweep_ends_and_goes_on_later(dask, tmp_path):
    log = tmp_path / "log"
    made = points(log, 6, seconds=dict.fromkeys(range(2, 6), 1))
    work = partial(sweep, made, square, tmp_path / "x.store", label="squares")

    def kill():
        while len(begun(log)) < 4:
            time.sleep(0.01)
        time.sleep(0.3)  # the first two are kept by then
        dask.scheduler.kill()

    threading.Thread(target=kill).start()
    with pytest.raises(UnfinishedError, match=r"it is gone; start it again") as raised:
        on(dask.address, work)
    assert re.match(r"[23] of 6 measurements of this stage are kept", raised.value.__notes__[-1])
    assert [each["square"] for each in work(jobs=1).values()] == [n**2 for n in range(6)]
    assert sorted(begun(log))[:3] == [0, 1, 2]


def test_workers_here_keep_what_they_free():
    said = on("local:1", lambda: cluster.cluster().client.run(os.environ.get, "MALLOC_TRIM_THRESHOLD_"))
    assert list(said.values()) == [None]  # by Dask's default a chart takes twice as long


def test_what_cannot_be_joined_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 1)
    with pytest.raises(OptionError, match=r"--scheduler tcp://127.0.0.1:9: .*"):
        on("tcp://127.0.0.1:9", dict)
    with pytest.raises(OptionError, match=r"--scheduler local:two: allowed are local:1 or more"):
        on("local:two", dict)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(OptionError, match=r"Dask is not installed; pip install 'spikeloom\[cluster\]'"):
        on("local:2", dict)
