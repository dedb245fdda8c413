"""Sweeps on this machine: nothing is lost and nothing is done twice, whoever is killed; every message."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import swept
from swept import KIND, VIOLATION, begun, points, square

from spikeloom.compiler.errors import CapacityError, DataError, OptionError, UnfinishedError
from spikeloom.runtime.cli import main
from spikeloom.runtime.studies.jobs.sweep import Point, content_key, sweep

ROOT = Path(__file__).resolve().parents[1]
HEADER = '{"spikeloom": "sweep", "format": 1, "kind": "test", "version": 1}\n'


def swept_here(folder: Path, made, *, version=1, kind=KIND, **how):
    return sweep(made, square, folder / "x.store", kind=kind, version=version, label="squares", **how)


def refused(error, folder, made=(), **how) -> str:
    with pytest.raises(error) as raised:
        swept_here(folder, made, **how)
    return " ".join([str(raised.value), *(f"({note})" for note in getattr(raised.value, "__notes__", ()))])


def entries(store: Path) -> list[str]:
    """Keys that a store holds in whole lines."""
    lines = store.read_text().splitlines(keepends=True)[1:] if store.exists() else []
    return [json.loads(line)["key"] for line in lines if line.endswith("\n")]


def expected(count: int) -> list[dict]:
    return [{"square": n * n, "third": n / 3, "pair": [n, None], "threads": "1"} for n in range(count)]


# --- results ----------------------------------------------------------------------------------------------------------


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
    more = points(log, 7)
    assert list(swept_here(tmp_path, more, jobs=jobs).values()) == expected(7)
    assert swept_here(tmp_path, made[1:3], jobs=jobs) == {point.key: found[point.key] for point in made[1:3]}
    assert sorted(begun(log)) == list(range(7))
    assert list(swept_here(tmp_path, made, jobs=jobs, fresh=True)) == list(found)
    assert len(begun(log)) == 12
    assert sorted(entries(tmp_path / "x.store")) == sorted(found)


def test_equal_keys_are_measured_once(tmp_path):
    made = points(tmp_path / "log", 2)
    twin = Point(key=made[0].key, label="twin", payload=made[1].payload)
    found = swept_here(tmp_path, [made[0], twin, made[1]], jobs=1)
    assert [each["square"] for each in found.values()] == [0, 1]
    assert begun(tmp_path / "log") == [0, 1]


def test_no_points(tmp_path):
    assert swept_here(tmp_path, []) == {}
    assert (tmp_path / "x.store").read_text() == HEADER


# --- kills ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_killed_sweep_goes_on_with_what_it_had(tmp_path, jobs):
    store, log = tmp_path / "x.store", tmp_path / "log"
    words = [sys.executable, swept.__file__, str(store), str(log), "60", jobs]
    process = subprocess.Popen(words, env=os.environ | {"PYTHONPATH": str(ROOT / "src")})
    deadline = time.monotonic() + 120
    while len(entries(store)) < 6 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait(timeout=60) == -signal.SIGKILL
    made = points(log, 60)
    numbers = {point.key: number for number, point in enumerate(made)}
    kept = {numbers[key] for key in entries(store)}
    assert 6 <= len(kept) < 60
    before = Counter(begun(log))
    time.sleep(0.1)  # workers end with their parent; one measurement each may still come to its end
    assert list(swept_here(tmp_path, made, jobs=1).values()) == expected(60)
    after = Counter(begun(log))
    assert all(after[number] == 1 for number in kept), "a finished point was measured again"
    assert all(after[number] == before[number] + 1 for number in range(60) if number not in kept)
    assert Counter(entries(store)) == Counter(numbers.keys())


def test_a_killed_worker_costs_its_point_only(tmp_path, capsys):
    made = points(tmp_path / "log", 6, trouble={2: "die once"})
    assert list(swept_here(tmp_path, made, jobs=2).values()) == expected(6)
    assert Counter(begun(tmp_path / "log")) == Counter({n: 1 + (n == 2) for n in range(6)})
    assert capsys.readouterr().err == "spikeloom: number 2: its process ended early (exit code -9); tried again\n"


def test_a_point_that_kills_its_worker_is_left_out(tmp_path):
    made = points(tmp_path / "log", 6, trouble={1: "die"})
    with pytest.raises(UnfinishedError) as raised:
        swept_here(tmp_path, made, jobs=2)
    assert str(raised.value) == (
        "number 1: its process ended early (exit code -9), 3 times, perhaps for lack of memory; left out\n"
        f"5 of 6 points are kept in {tmp_path / 'x.store'}"
    )
    assert list(raised.value.results.values()) == [each for each in expected(6) if each["square"] != 1]
    assert Counter(begun(tmp_path / "log")) == Counter({n: 3 if n == 1 else 1 for n in range(6)})


@pytest.mark.parametrize("cut", [1, 30])
def test_a_torn_last_line_is_measured_again(tmp_path, cut):
    store, log = tmp_path / "x.store", tmp_path / "log"
    made = points(log, 3)
    swept_here(tmp_path, made, jobs=1)
    content = store.read_bytes()
    store.write_bytes(content[:-cut])
    assert list(swept_here(tmp_path, made, jobs=1).values()) == expected(3)
    assert begun(log) == [0, 1, 2, 2]
    assert store.read_bytes() == content


@pytest.mark.parametrize("left", ["", HEADER[:20], HEADER[:-1]])
def test_a_store_that_was_cut_in_its_first_line_is_begun(tmp_path, left):
    (tmp_path / "x.store").write_text(left)
    assert list(swept_here(tmp_path, points(tmp_path / "log", 1), jobs=1).values()) == expected(1)
    assert (tmp_path / "x.store").read_text().startswith(HEADER)


def test_a_full_disk_keeps_whole_lines(tmp_path, monkeypatch):
    store = tmp_path / "x.store"
    made = points(tmp_path / "log", 3)
    swept_here(tmp_path, made[:1], jobs=1)
    content = store.read_bytes()

    def full(_handle):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", full)
        assert refused(OSError, tmp_path, made, jobs=1) == f"[Errno 28] No space left on device: '{store}'"
    assert store.read_bytes() == content


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_measurement_raises_arrives(tmp_path, jobs):
    made = points(tmp_path / "log", 3, trouble={2: "data"}, hold={2: str(tmp_path / "held")})
    assert refused(DataError, tmp_path, made[::-1][:1], jobs=jobs) == (
        f"x.zip: is empty; give another (number 2) (0 of 1 points are kept in {tmp_path / 'x.store'})"
    )
    made = points(tmp_path / "log", 3, trouble={1: "capacity"}, seconds={1: 0.5})
    with pytest.raises(CapacityError) as raised:
        swept_here(tmp_path, made, jobs=jobs)
    assert raised.value.violations == (VIOLATION,)
    assert str(raised.value) == str(CapacityError((VIOLATION,)))
    assert made[0].key in entries(tmp_path / "x.store")


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_defect_shows_where_it_is(tmp_path, jobs):
    made = points(tmp_path / "log", 2, trouble={0: "defect", 1: "defect"})
    with pytest.raises(RuntimeError, match=r'(?s)swept\.py", line \d+, in square.*ZeroDivisionError: a defect'):
        swept_here(tmp_path, made, jobs=jobs)


def test_an_interrupt_keeps_all(tmp_path):
    made = points(tmp_path / "log", 3, trouble={2: "interrupt"})
    assert refused(KeyboardInterrupt, tmp_path, made, jobs=1) == (
        f"2 of 3 points are kept in {tmp_path / 'x.store'}; go on with the same command"
    )
    assert len(entries(tmp_path / "x.store")) == 2


def test_wrong_options(tmp_path):
    assert refused(OptionError, tmp_path, jobs=0) == "--jobs 0: allowed are 1 or more; choose another"
    assert refused(OptionError, tmp_path, jobs=2, scheduler="tcp://h:1") == (
        "--jobs 2: counts processes on this machine, --scheduler has workers of its own; leave one away"
    )


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (HEADER.replace('"version": 1', '"version": 2'), "holds results of version 2, this is 1"),
        (HEADER.replace("test", "chart"), "holds results of kind chart, this is test"),
        (HEADER.replace('"format": 1', '"format": 7'), "holds results of format 7, this is 1"),
        (HEADER + '{"key": "a"}\n', "line 2: is no result"),
        (HEADER + "[]\n" + '{"key": "a", "result": {}}\n', "line 2: is no result"),
        (HEADER + '{"key": "a", "result": {}}\nx\n', "line 3: is no result"),
    ],
)
def test_stores_of_other_things(tmp_path, content, line):
    (tmp_path / "x.store").write_text(content)
    assert refused(DataError, tmp_path, jobs=1) == (
        f"{tmp_path / 'x.store'}: {line}; delete it or give --fresh to measure anew"
    )
    assert (tmp_path / "x.store").read_text() == content
    assert list(swept_here(tmp_path, points(tmp_path / "log", 1), jobs=1, fresh=True).values()) == expected(1)
    assert (tmp_path / "x.store").read_text().startswith(HEADER)


@pytest.mark.parametrize("content", ["something\n", "{}\n", "x", "\n"])
@pytest.mark.parametrize("fresh", [False, True])
def test_what_is_no_store_is_left_alone(tmp_path, content, fresh):
    (tmp_path / "x.store").write_text(content)
    assert refused(DataError, tmp_path, jobs=1, fresh=fresh) == (
        f"{tmp_path / 'x.store'}: is no store of results; give another output, or delete it"
    )
    assert (tmp_path / "x.store").read_text() == content


def test_one_sweep_at_a_time(tmp_path):
    pytest.importorskip("fcntl")
    from spikeloom.runtime.studies.jobs.sweep_store import opened

    with opened(tmp_path / "x.store", kind=KIND, version=1):
        assert refused(OptionError, tmp_path, fresh=True) == (
            f"{tmp_path / 'x.store'}: another sweep is writing to it; wait for that one, or give another output"
        )


def test_the_command_to_go_on_with_is_told(monkeypatch, capsys):
    def unfinished(_arguments):
        raise UnfinishedError("a: left out\n5 of 6 points are kept in x", resume=("--resume",))

    monkeypatch.setattr("spikeloom.runtime.commands.choose.chart.run", unfinished)
    assert main(["chart", "a.pt", "--data", "a b", "-o", "x"]) == 1
    assert capsys.readouterr().err.splitlines() == [
        "spikeloom: a: left out",
        "spikeloom: 5 of 6 points are kept in x",
        "spikeloom: go on with: spikeloom chart a.pt --data 'a b' -o x --resume",
    ]


def test_keys_name_all_that_decides():
    assert content_key({"a": 1}) == content_key({"a": 1}) != content_key({"a": 2})
    assert len(content_key({})) == 24
