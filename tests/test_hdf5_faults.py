"""HDF5 files with random faults: read, or refused in one line; never a crash of ours."""

import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from fuzzed_hdf5 import content_outcome, sources

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats import hdf5

TESTS = Path(__file__).parent
BATCH = 2000


def test_contents_with_faults():
    found = Counter(content_outcome(seed) for seed in range(400))
    assert found["refused"] > 200
    assert found["read"] > 20


def test_bytes_that_the_library_cannot_read():
    rng = random.Random(5)
    for _ in range(4):
        content = bytearray(rng.choice(sources()))
        content[40:96] = rng.randbytes(56)  # where the root group is
        with pytest.raises(ModelError, match="is truncated or damaged"):
            hdf5.tree_of(bytes(content))


@pytest.mark.parametrize(
    ("trial", "said"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "the HDF5 library gave up"),
        ("raise SystemExit(3)", "the HDF5 library gave up"),
        ("import time; time.sleep(60)", "cannot be read within 0.4 s"),
    ],
)
def test_a_library_that_dies_or_spins(monkeypatch, trial, said):
    monkeypatch.setattr(hdf5, "TRIAL", trial)
    monkeypatch.setattr(hdf5, "SECONDS", 0.2)
    with pytest.raises(ModelError, match=said):
        hdf5.try_reading(b"")


@pytest.mark.slow
def test_a_hundred_thousand_files():
    found = Counter(f"content {content_outcome(seed)}" for seed in range(60_000))
    first, last = 0, 40_000
    while first < last:
        command = [sys.executable, str(TESTS / "fuzzed_hdf5.py"), str(first), str(min(BATCH, last - first))]
        env = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(TESTS)])}
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
        words = done.stdout.split()
        found.update(f"bytes {word}" for word in words if word in ("read", "refused", "damaged"))
        if words[-1] == "done":
            first += BATCH
            continue
        assert done.returncode < 0, done.stderr  # the library was stopped, by its clock or by itself
        found["bytes died"] += 1
        first = int(words[-1]) + 1
    sys.stderr.write(f"{dict(found)}\n")
    assert sum(found.values()) == 100_000
    assert found["bytes died"] < 400
