"""Sweeps: nothing is lost and nothing is done twice, whoever is killed."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest
import swept
from swept import Square, begun, points, square

from spikeloom.compiler.errors import DataError, OptionError, UnfinishedError
from spikeloom.runtime import cli
from spikeloom.runtime.studies.jobs import only_one, sweep

ROOT = Path(__file__).resolve().parents[1]


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
    assert list(swept_here(tmp_path, made, jobs=jobs, fresh=True)) == list(found)
    assert len(begun(log)) == 12


def test_equal_keys_are_measured_once_and_no_points_are_none(tmp_path):
    made = points(tmp_path / "log", 2)
    twin = Square(key=made[0].key, label="twin", payload=made[1].payload)
    assert [each["square"] for each in swept_here(tmp_path, [made[0], twin, made[1]], jobs=1).values()] == [0, 1]
    assert begun(tmp_path / "log") == [0, 1]
    assert swept_here(tmp_path, []) == {}


def test_a_killed_sweep_goes_on_with_what_it_had(tmp_path):
    store, log = tmp_path / "x.store", tmp_path / "log"
    words = [sys.executable, swept.__file__, str(store), str(log), "60", "2"]
    process = subprocess.Popen(words, env=os.environ | {"PYTHONPATH": str(ROOT / "src")})
    deadline = time.monotonic() + 120
    while len(keys(store)) < 6 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.wait(timeout=60) == -signal.SIGKILL
    made = points(tmp_path / "again", 60)  # a worker may still end its measurement: count in another log
    kept = set(keys(store))
    assert 6 <= len(kept) < 60
    assert list(swept_here(tmp_path, made, jobs=1).values()) == expected(60)
    assert Counter(begun(tmp_path / "again")) == Counter(n for n, point in enumerate(made) if point.key not in kept)


def test_a_process_that_dies_leaves_what_the_others_had(tmp_path):
    made = points(tmp_path / "log", 6, trouble={5: "die"}, seconds={5: 1.0})
    with pytest.raises(UnfinishedError, match=r"ended early.*\n5 of 6 points are kept in"):
        swept_here(tmp_path, made, jobs=2)
    assert list(swept_here(tmp_path, points(tmp_path / "log", 6), jobs=2).values()) == expected(6)


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_measurement_raises_arrives_and_results_are_kept(tmp_path, jobs):
    made = points(tmp_path / "log", 4, trouble={2: "data"}, seconds={2: 0.5})
    with pytest.raises(DataError, match="is empty") as raised:
        swept_here(tmp_path, made, jobs=jobs)
    assert raised.value.__notes__[0] == "number 2"
    assert raised.value.__notes__[1].endswith(f"of 4 points are kept in {tmp_path / 'x.store'}")
    with pytest.raises(RuntimeError, match=r"(?s)swept.py.*a defect"):
        swept_here(tmp_path, points(tmp_path / "log", 5, trouble={4: "defect"}), jobs=jobs)


def test_an_interrupt_keeps_all(tmp_path):
    with pytest.raises(KeyboardInterrupt, match=r"2 of 3 points are kept in .*; go on with the same command"):
        swept_here(tmp_path, points(tmp_path / "log", 3, trouble={2: "interrupt"}), jobs=1)


def test_what_is_refused(tmp_path):
    made = points(tmp_path / "log", 2)
    with pytest.raises(OptionError, match="--jobs 0"):
        swept_here(tmp_path, made, jobs=0)
    swept_here(tmp_path, made, jobs=1)
    with only_one(tmp_path / "x.store"), pytest.raises(OptionError, match="another process is working on it"):
        swept_here(tmp_path, made)
    (tmp_path / "x.store").write_text("precious" * 100)
    with pytest.raises(DataError, match="is no store of results"):
        swept_here(tmp_path, made)
    assert (tmp_path / "x.store").read_text() == "precious" * 100


def test_the_command_to_go_on_with_is_printed(monkeypatch, capsys):
    error = UnfinishedError("3 of 4 points")

    def fail(_words):
        raise error

    monkeypatch.setattr(cli, "_parse", fail)
    assert cli.main(["chart", "a b.pt", "--fresh"]) == 1
    assert capsys.readouterr().err.splitlines() == [
        "spikeloom: 3 of 4 points",
        "spikeloom: go on with: spikeloom chart 'a b.pt'",
    ]
