"""Sweeps: nothing is lost and nothing is done twice, whoever is killed; every message."""

import json
from pathlib import Path

import pytest
from swept import KIND, begun, points, square

from runtime.sweep import Point, sweep

ROOT = Path(__file__).resolve().parents[1]
HEADER = '{"spikeloom": "sweep", "format": 1, "kind": "test", "version": 1}\n'


def swept_here(folder: Path, made, *, version=1, kind=KIND, **how):
    return sweep(made, square, folder / "x.store", kind=kind, version=version, label="squares", **how)


def refused(error, folder, made=(), **how) -> str:
    with pytest.raises(error) as raised:
        swept_here(folder, made, **how)
    return str(raised.value)


def entries(store: Path) -> list[str]:
    return [json.loads(line)["key"] for line in store.read_text().splitlines()[1:]]


# --- results ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_are_the_same_however_many_work(tmp_path, jobs):
    made = points(tmp_path / "log", 5)
    found = swept_here(tmp_path, made, jobs=jobs)
    assert list(found) == [point.key for point in made]
    assert list(found.values()) == [
        {"square": n * n, "third": n / 3, "pair": [n, None], "threads": "1"} for n in range(5)
    ]
    assert sorted(begun(str(tmp_path / "log"))) == list(range(5))
    assert swept_here(tmp_path, made, jobs=jobs) == found
    assert len(begun(str(tmp_path / "log"))) == 5, "measured again"


def test_equal_keys_are_measured_once(tmp_path):
    made = points(tmp_path / "log", 2)
    twin = Point(key=made[0].key, label="twin", payload=made[1].payload)
    found = swept_here(tmp_path, [made[0], twin, made[1]], jobs=1)
    assert [each["square"] for each in found.values()] == [0, 1]
    assert begun(str(tmp_path / "log")) == [0, 1]
