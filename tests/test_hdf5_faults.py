"""HDF5 and JSON with random faults: read, or refused in one line; never a crash of ours."""

import json
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from fuzzed_bytes import changed_bytes
from fuzzed_hdf5 import content_outcome, sources
from random_networks import chain

from spikeloom.compiler.errors import FormatError, ModelError
from spikeloom.compiler.formats.hdf5 import tree_of
from spikeloom.compiler.formats.nir import writer as nir_export
from spikeloom.compiler.formats.nir.neurons import CONVENTIONS
from spikeloom.compiler.formats.nir.sidecar import restore, sidecar_bytes, sidecar_of
from spikeloom.compiler.targets.loihi1.compilation import compile_network

TESTS = Path(__file__).parent
BATCH = 2000


def test_contents_with_faults():
    found = Counter(content_outcome(seed) for seed in range(400))
    assert found["refused"] > 200
    assert found["read"] > 20


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A NIR file with its side-car."""
    netlist = compile_network(chain(np.full((3, 4), 0.3), np.full((2, 3), 0.4))).netlist
    path = tmp_path_factory.mktemp("side") / "x.nir"
    content = nir_export.export(netlist, 0.02)
    path.write_bytes(content)
    sidecar_of(path).write_bytes(sidecar_bytes(netlist, content, dt=0.02, convention="euler"))
    return path, sidecar_of(path).read_bytes()


def damaged_json(content, rng):
    """Bytes changed, or values."""
    if rng.random() < 0.5:
        return changed_bytes(content, rng)
    values = json.loads(content)
    group = rng.choice([values, values["manifest"], values["arrays"], values["manifest"]["layers"][0]])
    key = rng.choice(sorted(group))
    group[key] = rng.choice([None, [], {}, -1, 10**30, 1.5, "x", [[1]], [None], True, group[key]])
    return json.dumps(values).encode()


def side_car_outcome(exported, seed):
    path, content = exported
    sidecar_of(path).write_bytes(damaged_json(content, random.Random(seed)))
    said = None
    try:
        restore(path, CONVENTIONS)
    except FormatError as error:
        said = str(error)
    assert said is None or "\n" not in said
    return "read" if said is None else "refused"


def test_side_cars_with_faults(exported):
    found = Counter(side_car_outcome(exported, seed) for seed in range(300))
    assert found["refused"] > 200


def test_bytes_that_the_library_cannot_read_are_told_as_that():
    rng = random.Random(5)
    for _ in range(4):
        content = bytearray(rng.choice(sources()))
        content[40:96] = rng.randbytes(56)  # where the root group is
        with pytest.raises(ModelError) as caught:
            tree_of(bytes(content), "export it again")
        assert str(caught.value).startswith("is truncated or damaged (")


def test_a_library_that_dies_is_a_damaged_file(monkeypatch, tmp_path):
    from spikeloom.compiler.formats import hdf5

    for body in ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "raise SystemExit(3)", ""):
        child = tmp_path / "child.py"
        child.write_text(body)
        monkeypatch.setattr(hdf5, "CHILD", child)
        with pytest.raises(ModelError) as caught:
            tree_of(b"", "export it again")
        assert str(caught.value) == "is truncated or damaged (the HDF5 library gave up); export it again"
    child.write_text("import time; time.sleep(60)")
    monkeypatch.setattr(hdf5, "SECONDS", 0.2)
    with pytest.raises(ModelError) as caught:
        tree_of(b"", "export it again")
    assert str(caught.value) == "cannot be read within 0.2 s; export it again"


@pytest.mark.slow
def test_a_hundred_thousand_files(exported):
    found = Counter(f"content {content_outcome(seed)}" for seed in range(60_000))
    found.update(f"side-car {side_car_outcome(exported, seed)}" for seed in range(10_000))
    first, last = 0, 40_000
    while first < last:
        command = [sys.executable, str(TESTS / "fuzzed_hdf5.py"), str(first), str(min(BATCH, last - first))]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=TESTS.parent, env=path_env())
        words = done.stdout.split()
        found.update(f"bytes {word}" for word in words if word in ("read", "refused", "damaged"))
        if words[-1] == "done":
            first += BATCH
            continue
        assert done.returncode < 0, done.stderr  # the library was stopped, by its clock or by itself
        found["bytes died"] += 1
        first = int(words[-1]) + 1
    sys.stderr.write(f"{dict(found)}\n")
    assert sum(found.values()) == 110_000
    assert found["bytes died"] < 400


def path_env():
    import os

    return os.environ | {"PYTHONPATH": f"{TESTS.parent / 'src'}:{TESTS}"}


def test_the_same_seed_gives_the_same_ending():
    assert [content_outcome(seed) for seed in range(20)] == [content_outcome(seed) for seed in range(20)]
