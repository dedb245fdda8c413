"""Long work: trainings side by side and sweeps; nothing is lost or done twice, whoever is killed."""

import json
import os
import shlex
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import swept
from commands import RUNTIME, as_json, refusal, run
from made_files import grasps_folder
from oracles import refused
from swept import Square, begun, points, square

from spikeloom.compiler.errors import DataError, OptionError, UnfinishedError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.runtime import cli
from spikeloom.runtime.studies.jobs import only_one, sweep
from spikeloom.runtime.studies.training import seeds as trainings

ROOT = Path(__file__).resolve().parents[1]
WORDS = ("train", "--data", "data", "--graph", "manual", "--features", "4")


@pytest.fixture
def data(tmp_path, monkeypatch) -> Path:
    """A small data set in the released layout; the working folder is where it is."""
    monkeypatch.chdir(tmp_path)
    grasps_folder(tmp_path / "data", per_class=3, steps=12)
    return tmp_path


def test_one_seed_reports_both_protocols_and_stores_three_epochs(data):
    report = as_json(*WORDS, "--epochs", "2", "-o", "x.pt")
    (run,) = report["runs"]
    assert run["command"] == "spikeloom train --data data --graph manual --features 4 --epochs 2 --seed 0"
    assert {name: run[name]["chosen_on"] for name in ("last", "best", "clean")} == {
        "last": "nothing",
        "best": "the test split",
        "clean": "a part of the training split",
    }
    assert report["protocols"]["best"] == {"mean": run["best"]["accuracy"], "std": None} | dict.fromkeys(
        ("min", "max"), run["best"]["accuracy"]
    )
    assert report["protocols"]["last"]["std"] is None
    assert [file.name for file in data.glob("x.pt*")] == ["x.pt"], "states of the training are left"
    epochs = {name: read_checkpoint("x.pt", weights=name) for name in ("last", "best", "clean")}
    for name, checkpoint in epochs.items():
        other = next(n for n in epochs if n != name)
        same = np.array_equal(checkpoint.dense[0].weight, epochs[other].dense[0].weight)
        assert same == (run[name]["epoch"] == run[other]["epoch"])
    assert read_checkpoint("x.pt").weights == "last"


def test_seeds_side_by_side_equal_single_ones_and_finished_ones_are_left_alone(data):
    words = (*WORDS, "--epochs", "1")
    several = (*words, "--seeds", "2", "--seed", "4", "-o", "x.pt")
    report = as_json(*several, "--picture", "a.png")
    assert [run["file"] for run in report["runs"]] == ["x-seed4.pt", "x-seed5.pt"]
    assert (data / "a.png").read_bytes()[:4] == b"\x89PNG"
    single = as_json(*words, "--seed", "5", "-o", "y.pt")
    assert (data / "y.pt").read_bytes() == (data / "x-seed5.pt").read_bytes()
    accuracies = [run["last"]["accuracy"] for run in report["runs"]]
    assert report["protocols"]["last"]["mean"] == pytest.approx(np.mean(accuracies))
    assert report["protocols"]["last"]["std"] == pytest.approx(np.std(accuracies, ddof=1))
    assert single["runs"][0]["sha256"] == report["runs"][1]["sha256"]

    _, out, err = run(*several, "--resume", "--picture", "b.png", "--json")
    assert err == "".join(f"spikeloom: x-seed{seed}.pt: is finished, not trained again\n" for seed in (4, 5))
    assert json.loads(out) == report
    assert Path("a.png").read_bytes() == Path("b.png").read_bytes()

    lines = run(*several, "--resume")[1].splitlines()
    assert [line.split(", ")[0].strip() for line in lines[2:8]] == ["seed 4"] * 3 + ["seed 5"] * 3
    assert lines[8].startswith("  mean of 2 seeds: last ")
    assert lines[9] == "  written: x-seed4.pt, x-seed5.pt"
    assert max(map(len, lines)) <= 120


def started(*words, until):
    """A training in a process of its own, once `until` is true."""
    process = subprocess.Popen(
        [*RUNTIME, *WORDS, *words],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not until() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert process.poll() is None, process.communicate()[1]
    return process


def children(pid: int) -> list[int]:
    """Processes below another one, all the way down; Linux keeps them under /proc."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(words[1]) == pid and words[0] != "Z":
            found += [int(stat.parent.name), *children(int(stat.parent.name))]
    return found


def gone(pids: list[int]) -> bool:
    deadline = time.monotonic() + 40
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def test_interrupted_it_says_what_is_kept_and_resumes_to_the_same_bytes(data):
    """The moment of a signal is not fixed: wherever it falls, the result must be the same."""
    kept, words = Path("x.pt.state.validation"), ("--epochs", "8", "-o", "x.pt")
    process = started(*words, until=kept.exists)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err == (
        f"spikeloom: interrupted; the epochs so far are kept in {kept}; go on with the same command and --resume\n"
    )
    assert not list(data.glob(".*")), "half-written files are left"
    content = kept.read_bytes()
    assert refusal(*WORDS, *words) == (
        f"{kept}: an interrupted training is kept here; go on with --resume, or delete it to train anew"
    )
    assert refusal(*WORDS, "--epochs", "2", "-o", "x.pt", "--resume") == (
        f"{kept}: belongs to a training with other epochs; give the same options and data, or delete it to train anew"
    )
    assert kept.read_bytes() == content
    as_json(*WORDS, *words, "--resume")
    as_json(*WORDS, "--epochs", "8", "-o", "whole.pt")
    assert Path("x.pt").read_bytes() == Path("whole.pt").read_bytes()


def test_the_command_that_is_remembered_can_be_typed(data):
    (data / "data").rename(data / "my data")
    (run,) = as_json("train", "--data", "my data", *WORDS[3:], "--epochs", "1", "-o", "x.pt")["runs"]
    assert shlex.split(run["command"])[:4] == ["spikeloom", "train", "--data", "my data"]


def test_one_process_works_on_a_file(data):
    pytest.importorskip("fcntl")
    with only_one(Path("x.pt")):
        assert Path("x.pt.lock").exists()
        for options in ([], ["--resume"]):
            assert refusal(*WORDS, "--epochs", "1", "-o", "x.pt", *options) == (
                "x.pt: another process is working on it; wait for it, or give another output"
            )
        as_json(*WORDS, "--epochs", "1", "-o", "y.pt")
    Path("x.pt.lock").write_bytes(b"")  # as a killed process leaves it
    as_json(*WORDS, "--epochs", "1", "-o", "x.pt")
    assert sorted(file.name for file in data.glob("*.pt*")) == ["x.pt", "y.pt"]


def test_resume_does_not_take_another_training_for_this_one(data):
    as_json(*WORDS, "--epochs", "1", "--keep", "best", "-o", "x.pt")
    assert refusal(*WORDS, "--epochs", "2", "--seed", "3", "-o", "x.pt", "--resume") == (
        "x.pt: holds another training (other epochs, seed); give its options, or another -o"
    )
    Path("x.pt").write_bytes(b"old")
    assert refusal(*WORDS, "--epochs", "1", "-o", "x.pt", "--resume").startswith("x.pt: ")


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes under /proc")
def test_no_worker_outlives_the_command(data):
    process = started(
        "--epochs",
        "5000",
        "--seeds",
        "2",
        "-o",
        "x.pt",
        until=lambda: len(list(data.glob("x-seed?.pt.state.*"))) == 2,
    )
    workers = children(process.pid)
    assert len(workers) >= 2
    process.kill()
    process.communicate(timeout=60)
    assert gone(workers)
    assert not list(data.glob(".*")), "half-written files are left"


@dataclass(frozen=True)
class Named:
    output: Path
    state: Path = Path("x.state")


def dies(_job):
    os._exit(9)


def fails(_job):
    raise DataError("epoch 1: the loss is nan")


@pytest.mark.filterwarnings("ignore")  # of tasks that joblib cancels
@pytest.mark.parametrize(
    ("run", "error", "told"),
    [(dies, OptionError, "go on with --resume"), (fails, DataError, "the loss is nan")],
)
def test_a_worker_that_fails_ends_all(run, error, told, monkeypatch, tmp_path):
    monkeypatch.setattr(trainings, "run_job", run)
    jobs = [Named(output=tmp_path / name) for name in ("x.pt", "y.pt")]
    with pytest.raises(error, match=told):
        trainings.train_seeds(jobs, resume=False)


def swept_here(folder, made, **how):
    return sweep(made, square, folder / "x.store", label="squares", **how)


def keys(store):
    """Keys that a store holds, while a sweep may be writing to it."""
    try:
        with closing(sqlite3.connect(store)) as database:
            return [key for (key,) in database.execute("SELECT key FROM results")]
    except sqlite3.OperationalError:
        return []


def expected(count):
    return [{"square": n * n, "third": n / 3, "pair": [n, None]} for n in range(count)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_are_the_same_however_many_work(tmp_path, jobs):
    log = tmp_path / "log"
    made = points(log, 5)
    found = swept_here(tmp_path, made, jobs=jobs)
    assert list(found) == [point.key for point in made]
    assert list(found.values()) == expected(5)
    assert sorted(begun(log)) == list(range(5))
    assert swept_here(tmp_path, made, jobs=jobs) == found
    assert len(begun(log)) == 5, "measured again"
    assert list(swept_here(tmp_path, points(log, 7), jobs=jobs).values()) == expected(7)
    assert sorted(begun(log)) == list(range(7))


def test_equal_keys_are_measured_once_and_no_points_are_none(tmp_path):
    made = points(tmp_path / "log", 2)
    twin = Square(key=made[0].key, label="twin", payload=made[1].payload)
    assert [each["square"] for each in swept_here(tmp_path, [made[0], twin, made[1]], jobs=1).values()] == [
        0,
        1,
    ]
    assert begun(tmp_path / "log") == [0, 1]
    assert swept_here(tmp_path, []) == {}


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_sweep_goes_on_with_what_it_had(tmp_path, end):
    store, log = tmp_path / "x.store", tmp_path / "log"
    words = [sys.executable, swept.__file__, str(store), str(log), "60", "2"]
    process = subprocess.Popen(
        words, env=os.environ | {"PYTHONPATH": str(ROOT / "src")}, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while len(keys(store)) < 6 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(end)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, "Exception in thread" in err) == (-end, False)
    made = points(tmp_path / "again", 60)  # a worker may still end its measurement: count in another log
    kept = set(keys(store))
    assert 6 <= len(kept) < 60
    assert list(swept_here(tmp_path, made, jobs=1).values()) == expected(60)
    assert Counter(begun(tmp_path / "again")) == Counter(
        n for n, point in enumerate(made) if point.key not in kept
    )


def test_a_process_that_dies_leaves_what_the_others_had(tmp_path):
    made = points(tmp_path / "log", 6, trouble={5: "die"}, seconds={5: 1.0})
    with pytest.raises(
        UnfinishedError, match=r"ended early.*\n5 of 6 measurements of this stage are kept in"
    ):
        swept_here(tmp_path, made, jobs=2)
    assert list(swept_here(tmp_path, points(tmp_path / "log", 6), jobs=2).values()) == expected(6)


@pytest.mark.parametrize("jobs", [1, 2])
def test_nothing_is_begun_when_time_is_up(tmp_path, jobs):
    made = points(tmp_path / "log", 3)
    assert swept_here(tmp_path, made, jobs=jobs, until=time.monotonic()) == {}
    assert begun(tmp_path / "log") == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_measurement_raises_arrives_and_results_are_kept(tmp_path, jobs):
    made = points(tmp_path / "log", 4, trouble={2: "data"}, seconds={2: 0.5})
    with pytest.raises(DataError, match="is empty") as raised:
        swept_here(tmp_path, made, jobs=jobs)
    assert raised.value.__notes__[0] == "number 2"
    assert raised.value.__notes__[1].endswith(
        f"of 4 measurements of this stage are kept in {tmp_path / 'x.store'}"
    )
    refused(
        ZeroDivisionError,
        "a defect",
        swept_here,
        tmp_path,
        points(tmp_path / "log", 5, trouble={4: "defect"}),
        jobs=jobs,
    )


def test_an_interrupt_keeps_all(tmp_path):
    said = r"2 of 3 measurements of this stage are kept in .*; go on with the same command"
    with pytest.raises(KeyboardInterrupt, match=said):  # a note
        swept_here(tmp_path, points(tmp_path / "log", 3, trouble={2: "interrupt"}), jobs=1)


def test_where_nothing_can_be_locked_it_is_said(tmp_path, monkeypatch, capsys):
    def without(*_, **__):
        raise NotImplementedError

    monkeypatch.setattr("filelock.FileLock.acquire", without)
    with only_one(tmp_path / "x.pt"):
        pass
    assert "x.pt: its file system has no locks" in capsys.readouterr().err


def test_what_is_refused(tmp_path):
    made = points(tmp_path / "log", 2)
    refused(OptionError, "--jobs 0", swept_here, tmp_path, made, jobs=0)
    swept_here(tmp_path, made, jobs=1)
    with (
        only_one(tmp_path / "x.store"),
        pytest.raises(OptionError, match="another process is working on it"),
    ):
        swept_here(tmp_path, made)
    (tmp_path / "x.store").write_text("precious" * 100)
    refused(DataError, "x.store: is truncated or damaged, or something else", swept_here, tmp_path, made)
    assert (tmp_path / "x.store").read_text() == "precious" * 100


def test_the_command_to_go_on_with_is_printed(monkeypatch, capsys):
    error = UnfinishedError("3 of 4 points")

    def fail(_words):
        raise error

    monkeypatch.setattr(cli, "_parse", fail)
    assert cli.main(["chart", "a b.pt"]) == 1
    assert capsys.readouterr().err.splitlines() == [
        "spikeloom: 3 of 4 points",
        "spikeloom: go on with: spikeloom chart 'a b.pt'",
    ]
