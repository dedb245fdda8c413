"""The paper's tables come out of their stored cells to the byte, and cells are what a network really gives."""

import importlib
from dataclasses import replace
from pathlib import Path

import pytest

from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.recordings.release import write_released

PAPER = Path(__file__).parents[1] / "benchmarks" / "paper"


@pytest.fixture(scope="module")
def module():
    """Import a script of the folder, as one that is run finds its neighbours."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(PAPER))
        yield importlib.import_module


@pytest.fixture(scope="module")
def cells(module):
    return module("cells").read_cells(module("cells").RESULTS)


def test_stored_tables_are_those_of_the_stored_cells(module, cells):
    written = module("tables").files(cells, drawn=False)
    assert sorted(written) == ["graphs.csv", "graphs.md", "methods.csv", "methods.md"]
    for name, content in written.items():
        assert content == (module("cells").RESULTS / name).read_bytes()


def test_every_planned_cell_is_there_and_adds_up(module, cells):
    planned = [module("cells").planned(table) for table in ("methods", "graphs")]
    assert {row.cell(seed) for rows in planned for row, seeds in rows.items() for seed in range(seeds)} == set(cells)
    for cell in cells.values():
        for which in ("last", "best", "clean"):
            assert cell[which]["accuracy"] == cell[which]["correct"] / cell["test_samples"]


def test_tables_of_some_cells(module, cells):
    few = {name: cell for name, cell in cells.items() if name.endswith(("e100-s0", "e100-s1"))}
    one = "objects-tactilesgnet-knn-1-e60-s0"
    few[one] = cells[one]
    written = module("tables").files(few)
    assert b"16 of 36 trainings are there" in written["methods.md"]
    accuracy = f"{100 * few[one]['best']['accuracy']:.2f} (one seed)"
    assert f"| knn:1 | 1 | not available here | {accuracy} |" in written["graphs.md"].decode()
    assert all(content.startswith(b"\x89PNG") for name, content in written.items() if name.endswith(".png"))


def test_statistics(module):
    spreads = module("spreads")
    spread = spreads.Spread((90.0, 88.0))
    assert (spread.mean, spread.std, spread.interval) == (
        89.0,
        pytest.approx(1.4142136),
        (pytest.approx(76.2938, abs=1e-4), 100.0),
    )
    assert spreads.Spread((90.0, 90.0)).interval is None
    found = spreads.variance([[6, 8, 4, 5, 3, 4], [8, 12, 9, 11, 6, 8], [13, 9, 11, 8, 7, 12]])
    assert (found.rows, round(found.f, 2), round(found.p, 4)) == (3, 9.26, 0.0024)
    assert spreads.variance([[1.0, 2.0], [3.0]]) is None
    rho, p = spreads.rank_correlation([1, 2, 3, 4, 5], [5, 6, 7, 8, 7])
    assert (round(rho, 2), round(p, 2)) == (0.82, 0.09)
    assert spreads.rank_correlation([1, 2, 3], [1, 2, 3]) is None


@pytest.mark.slow
def test_a_cell_is_trained_measured_and_kept(module, tmp_path):
    cells, train = module("cells"), module("train")
    splits = [
        replace(synthetic_grasps(per_class=2, steps=14, seed=seed), split=split)
        for split, seed in (("train", 1), ("test", 2))
    ]
    write_released(tmp_path / "grasps", splits)
    row = cells.Row(data="grasps", system="mlp", form="none", epochs=1)
    name, cell = train.make(row, 0, str(tmp_path / "grasps"), tmp_path / "net.pt")
    assert name == "grasps-mlp-none-e1-s0"
    assert cell["chip"]["last"]["float_correct"] == cell["last"]["correct"]
    assert cell["chip"]["last"]["first_layer"]["neurons"] == 64
    assert train.make(row, 0, str(tmp_path / "grasps"), tmp_path / "net.pt") == (name, cell)  # taken over
    cells.write_cells(tmp_path, {name: cell})
    assert cells.read_cells(tmp_path) == {name: cell}
