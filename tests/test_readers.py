"""Damaged and made-up files end in their values or in one short line with their name; the table is in ``readers``."""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import commands
import pytest
import typed
from readers import READERS, damaged, goods, meant, outcome

from spikeloom.compiler.errors import SpikeloomError

FINE = {"read", "refused"}


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory):
    """A working folder of their own."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("readers"))
    yield
    os.chdir(before)


@pytest.mark.parametrize("name", READERS)
def test_good_files_are_read(name):
    for index in range(len(goods(name))):
        meant(name, index)


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_right_or_refused_in_one_short_line(name):
    found = Counter(outcome(name, *damaged(name, seed)) for seed in range(25))
    assert set(found) <= FINE
    assert found["refused"]
    assert damaged(name, 7) == damaged(name, 7)


@pytest.mark.slow
def test_a_hundred_thousand(tmp_path):
    script = Path(__file__).parents[1] / "benchmarks" / "fuzz.py"
    subprocess.run([sys.executable, script, tmp_path / "fuzz.json"], check=True)
    found = json.loads((tmp_path / "fuzz.json").read_text())
    assert found["tried"] >= 100_000
    assert found["did_not"] == 0


@pytest.fixture(scope="module", autouse=True)
def _all_candidates_afterwards():
    """Tests of other files meet the whole search again."""
    before = [(m, name, getattr(m, name)) for m, changes in typed.FEW_CANDIDATES for name in changes]
    yield
    for each in before:
        setattr(*each)


@pytest.mark.parametrize("name", [name for name in READERS if not name.startswith("run: ")])
def test_a_pipe_is_no_file(name):
    """Nothing waits for what will never come."""
    goods(name)  # some leave files that their reader needs
    pipe = Path(f"pipe{READERS[name].suffix}")
    pipe.unlink(missing_ok=True)
    os.mkfifo(pipe)
    with pytest.raises(
        SpikeloomError, match=rf"pipe{READERS[name].suffix}: (is not a|no such folder or) file; "
    ):
        READERS[name].read(pipe)
    code, _, err = commands.run("inspect", pipe)
    assert (code, err.count("\n")) == (2, 1)
