"""HDF5 files with random faults: read, or refused in one line; never a crash of ours."""

import random
from collections import Counter

import pytest
from fuzzed_hdf5 import bytes_for, content_outcome, outcome, sources

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats import hdf5


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


def bytes_outcome(seed):
    content = bytes_for(seed)
    try:
        hdf5.try_reading(content)
        tree = hdf5.tree_of(content)
    except ModelError:
        return "damaged"
    return outcome(tree)


@pytest.mark.slow
def test_many_files():
    assert sum(Counter(content_outcome(seed) for seed in range(60_000)).values()) == 60_000
    found = Counter(bytes_outcome(seed) for seed in range(500))
    assert min(found[ending] for ending in ("read", "refused", "damaged")) > 0, found
