"""HDF5 files with random faults: read, or refused in one line; never a crash of ours."""

import copy
import io
import random
from collections import Counter
from functools import cache
from pathlib import Path

import made_netx
import numpy as np
import pytest

from spikeloom.compiler.errors import ModelError, SpikeloomError
from spikeloom.compiler.formats import hdf5
from spikeloom.compiler.formats.hdf5 import tree_of
from spikeloom.compiler.formats.netx.reader import integers_of
from spikeloom.compiler.formats.nir.file import graph_of
from spikeloom.compiler.formats.nir.reader import network_of
from spikeloom.compiler.formats.nir.stages import Steps
from spikeloom.compiler.invariants import verify


def test_contents_with_faults():
    found = Counter(content_outcome(seed) for seed in range(400))
    assert found["refused"] > 200
    assert found["read"] > 20


def test_bytes_that_the_library_cannot_read():
    rng = random.Random(5)
    for _ in range(4):
        content = bytearray(rng.choice(sources()))
        content[40:96] = rng.randbytes(56)  # where the root group is
        with pytest.raises(ModelError, match="truncated or damaged"):
            hdf5.tree_of(bytes(content))


FILES = Path(__file__).parent / "nir"

TYPES = ("Affine", "AvgPool2d", "Conv1d", "Conv2d", "CubaLIF", "Delay", "Flatten", "I", "IF", "Identity", "Input", "LI")
TYPES += ("LIF", "Linear", "NIRGraph", "Output", "Scale", "SumPool2d", "Threshold")
TYPES += ("conv", "dense", "dense_rec", "flatten", "input")
NUMBERS = (-(2**63), -(2**31), -100, -1, 0, 1, 2, 3, 7, 100, 2**20, 2**31, 2**62, 1e-300, 1e300, np.nan, np.inf, 0.5)


@cache
def sources():
    """Good files."""
    rng, file = np.random.default_rng(0), io.BytesIO()

    def even(*shape, **more):
        return made_netx.dense(made_netx.even(rng, *shape), bias=made_netx.even(rng, shape[0], most=16), **more)

    kernel = made_netx.even(rng, 3, 2, 2, 2, most=18)
    recurrent = even(6, 27, type=["dense_rec"], weight_rec=rng.integers(-60, 60, (6, 6)))
    image = made_netx.given_input(2, 4, 4), made_netx.conv(kernel, (3, 3, 3), bias=[2, 4, 6]), made_netx.flatten(27)
    made_netx.write(file, *image, recurrent, even(4, 6))
    return (*(path.read_bytes() for path in sorted(FILES.glob("*.ni[r]"))), file.getvalue())


@cache
def trees():
    """What is in them."""
    return tuple(tree_of(content) for content in sources())


def read(tree):
    """Read a content as both formats do; whatever may be raised is raised."""
    if "layer" in tree:
        network, facts = integers_of(tree)
    else:
        found = network_of(graph_of(tree, ""), Steps(dt=1e-4, convention="euler"))
        network, facts = found.network, found.facts
    verify(network)
    assert all("\n" not in fact for fact in facts)


def groups_of(tree):
    """All groups of a content."""
    found = [tree]
    for group in found:
        found += [entry for entry in group.values() if isinstance(entry, dict)]
    return found


def strange(rng, entry):
    """An entry that is something else."""
    found = [None, rng.choice((*TYPES, "", "a\nb", "ä" * 200, "same", "subtract")), {}, [["a", "b"], ["b"]]]
    found.append(np.array(rng.choice(NUMBERS)))
    if isinstance(entry, np.ndarray) and entry.size:
        numbers = entry.astype(np.float64)
        numbers.flat[rng.randrange(entry.size)] = rng.choice(NUMBERS)
        unsigned = np.abs(np.nan_to_num(entry.astype(np.float64))).astype(np.uint8)
        found += [numbers, entry.ravel()[: rng.randrange(entry.size)], entry[None], entry.T, unsigned]
    return rng.choice(found)


def changed_content(tree, rng):
    """A few faults in the content of a file."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 2, 4))):
        group = rng.choice(groups_of(tree))
        if not group:
            continue
        key = rng.choice(sorted(group))
        match rng.randrange(5):
            case 0:
                del group[key]
            case 1:
                group[rng.choice(("x", "1", "weight", "type", "delay", "metadata"))] = group[key]
            case 2 if isinstance(group.get("edges"), list) and group["edges"]:
                names = [name for pair in group["edges"] for name in pair]
                group["edges"].append([rng.choice(names), rng.choice([*names, "nothing"])])
            case 3 if isinstance(group.get("type"), str):
                group["type"] = rng.choice(TYPES)
            case _:
                group[key] = strange(rng, group[key])
    return tree


def content_outcome(seed):
    """How reading a content for a seed ends: fine, or with one clear line."""
    rng, said = random.Random(seed), ""
    with np.errstate(all="ignore"):  # the faults themselves
        tree = changed_content(rng.choice(trees()), rng)
        try:
            read(tree)
        except SpikeloomError as error:
            said = str(error)
    assert "\n" not in said, said
    assert len(said) < 600, said
    return "refused" if said else "read"
