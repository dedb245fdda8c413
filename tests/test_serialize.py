"""Netlist files: round trips and damage of every kind; files are written whole or not at all."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import sys
import zipfile

import numpy as np
import pytest
from hypothesis import given
from made_files import zipped
from numpy.testing import assert_array_equal
from random_networks import compiled, integer_chain, integer_networks

from spikeloom.compiler import archive
from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.errors import CapacityError, FormatError
from spikeloom.compiler.files import remove_leftovers, write_atomically
from spikeloom.compiler.targets.loihi1.netlist import (
    FILE,
    Netlist,
    inconsistencies,
    netlist_bytes,
    read_netlist,
    write_netlist,
)

ARRAYS = FILE.arrays


@pytest.fixture(scope="module")
def netlist() -> Netlist:
    """Two layers on one core: 6 inputs of 3 taxels, 3 neurons, then 2."""
    network = integer_chain(
        [[2, 4, 0, 0, 8, -6], [6, 8, 254, 2, 2, 2], [2] * 6],
        [[2, 4, 6], [-2, -4, -256]],
        thresholds=[[1, 2, 131071], 7],
        polarities=2,
    )
    return compiled(
        network, provenance={"graph": "manual", "options": {"weight_bits": 8}, "checkpoint": "0" * 64}
    )


@pytest.fixture
def path(tmp_path, netlist):
    """The netlist, written."""
    write_netlist(netlist, tmp_path / "a.loom")
    return tmp_path / "a.loom"


def refused(path) -> str:
    """Message of the refusal without the path that starts it; one line."""
    with pytest.raises(FormatError) as caught:
        read_netlist(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def write_members(path, members, *, sign=True, compression=zipfile.ZIP_STORED):
    """Write members as a netlist file, with a matching hash unless told otherwise."""
    if sign:
        held = {name: members[name] for name in ("manifest", *ARRAYS) if name in members}
        members = members | {"sha256": np.array(archive.digest(held))}
    named = {f"{name}.npy": archive.npy_bytes(np.asarray(array)) for name, array in members.items()}
    path.write_bytes(zipped(named, compression))


def rewrite(path, **changes):
    """Change members of a netlist file; the hash fits again."""
    write_members(path, archive.read_members(path) | changes)


def rewrite_manifest(path, **changes):
    manifest = json.loads(str(archive.read_members(path)["manifest"])) | changes
    dropped = {key: value for key, value in manifest.items() if value is not None}
    rewrite(path, manifest=np.array(json.dumps(dropped)))


@given(integer_networks())
def test_every_netlist_comes_back_whole(tmp_path_factory, network):
    try:
        original = compiled(network)
    except CapacityError:  # too many weight formats for a core
        return
    path = tmp_path_factory.mktemp("netlist") / "a.loom"
    sha256 = write_netlist(original, path)
    assert sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert netlist_bytes(read_netlist(path)) == path.read_bytes() == netlist_bytes(original)
    assert inconsistencies(original) == []


def test_numpy_alone_reads_the_file(path, netlist):
    with np.load(path, allow_pickle=False) as members:
        assert set(members.files) == {"manifest", "sha256", *ARRAYS}
        assert_array_equal(members["synapse_weight"], netlist.synapse_weight)
        kinds = {name: members[name].dtype.str for name in ("synapse_weight", "readout_class", "threshold")}
        assert kinds == {"synapse_weight": "<i2", "readout_class": "|i1", "threshold": "<i4"}
        manifest = json.loads(str(members["manifest"]))
    assert manifest["format"] == "spikeloom-netlist"
    assert (manifest["version"], manifest["bins"], manifest["clocks"]) == (5, 1, {"channels": 0, "steps": 1})
    assert manifest["layers"][0] == dataclasses.asdict(netlist.layers[0]) | {"unread": []}
    assert manifest["provenance"] == netlist.provenance


def test_a_netlist_is_told_from_other_files(path, tmp_path):
    renamed = tmp_path / "a.bin"
    renamed.write_bytes(path.read_bytes())
    (tmp_path / "other").write_bytes(b"PK not really")
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    assert is_netlist(path)
    assert is_netlist(renamed)
    assert is_netlist(tmp_path / "missing.loom")
    assert not is_netlist(tmp_path / "other")
    assert not is_netlist(tmp_path / "other.npz")
    assert not is_netlist(tmp_path / "missing")


def unsigned(name, changed):
    def change(path):
        members = archive.read_members(path)
        write_members(path, members | {name: changed(members[name])}, sign=False)

    return change


def stating(**entries):
    return lambda path: rewrite_manifest(path, **entries)


def manifest(text):
    return lambda path: rewrite(path, manifest=np.array(text))


def without(name):
    return lambda path: write_members(
        path, {k: v for k, v in archive.read_members(path).items() if k != name}
    )


LAYER = {
    "name": "fc1",
    "neurons": 3,
    "unread": [],
    "depth": 0,
    "weight_bits": 8,
    "synapses": 9,
    "max_fan_in": 6,
}
LAYER |= {"beta": 0.2, "theta": 0.5, "alpha": 0.0}
DAMAGES = [
    *(
        (lambda path, content=content: path.write_bytes(content), "something else")
        for content in (b"", bytes(9999))
    ),
    (unsigned("synapse_weight", lambda weights: weights + 2), "does not match its hash"),
    (
        unsigned("manifest", lambda text: np.array(str(text).replace("manual", "knn:3 "))),
        "does not match its hash",
    ),
    (
        lambda path: write_members(path, {"weights": np.zeros(3)}, sign=False),
        "not a netlist (no manifest and no sha256)",
    ),
    (
        lambda path: write_members(path, archive.read_members(path), compression=zipfile.ZIP_DEFLATED),
        "compressed members",
    ),
    *((stating(version=version), f"format version {version}, this program reads 5") for version in (4, 6)),
    *((manifest(text), "something else") for text in ("{", "[" * 100_000)),
    *((manifest(text), "not a netlist") for text in ("[]", "3", "{}", '{"format": "spikeloom-checkpoint"}')),
    *(
        (stating(layers=[LAYER | {name: value}]), "no usable layers")
        for name, value in {
            "neurons": -1,
            "scale": 0,
            "depth": 0.5,
            "name": 7,
            "beta": -1,
            "colour": "red",
        }.items()
    ),
    (stating(layers=[]), "no usable layers"),
    (stating(target="loihi9"), "is for 'loihi9', this program knows loihi1"),
    (lambda path: rewrite(path, axon_sauce=np.zeros(1, "<i1")), "unknown members (axon_sauce)"),
    (without("threshold"), "missing or unknown members (threshold)"),
]


@pytest.mark.parametrize(("change", "words"), DAMAGES)
def test_a_damaged_file(path, change, words):
    change(path)
    assert words in refused(path)


def test_more_bytes_than_there_may_be(path, monkeypatch):
    size = path.stat().st_size
    monkeypatch.setattr(archive, "SIZE_LIMIT", size - 1)
    assert f"more than {size - 1} bytes" in refused(path)


def test_an_array_of_objects_is_never_unpickled(path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(path.parent / "unpickled"),)

    content = io.BytesIO()
    np.lib.format.write_array(content, np.array([Trap()], object), allow_pickle=True)
    with zipfile.ZipFile(path, "a") as file, pytest.warns(UserWarning, match="Duplicate name"):
        file.writestr("neuron.npy", content.getvalue())
    assert "an array of objects" in refused(path)
    assert not (path.parent / "unpickled").exists()


@pytest.mark.parametrize("value", [None, 1.5, "three", [1], {"name": "fc1"}, True, -1, 2**32])
def test_manifest_entries_of_another_kind(path, value):
    fine = {str: "target", dict: "provenance"}.get(type(value))
    keys = {"target", "taxels", "polarities", "classes", "layers", "provenance", "clocks", "bins"} - {fine}
    rewrite_manifest(path, **dict.fromkeys(keys, value))
    said = refused(path).removeprefix("the manifest has no usable ").partition(";")[0]
    assert set(said.split(", ")) == keys


@pytest.mark.parametrize(
    "change",
    [
        *(lambda array, kind=kind: array.astype(kind) for kind in (float, str, np.uint16, bool)),
        lambda array: np.asarray(array[0]),
        lambda array: array[:, None],
    ],
)
def test_members_of_another_type(path, change):
    names = ("neuron", "core_axons", "synapse_weight", "format_exponent")
    rewrite(path, **{name: change(archive.read_members(path)[name]) for name in names})
    assert all(f"{name} is no list of integers" in refused(path) for name in names)


def lengthened(name):
    return lambda netlist: {name: np.append(getattr(netlist, name), 0)}


def with_value(name, value, place=0):
    def change(netlist):
        array = getattr(netlist, name).copy()
        array[place] = value
        return {name: array}

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lengthened("core_compartments"), "core_compartments does not divide 5 entries in 1 parts"),
        (with_value("core_axons", 1), "core_axons does not divide 9 entries in 1 parts"),
        (with_value("axon_synapses", 99, 3), "axon_synapses does not divide 22 entries in 9 parts"),
        (lengthened("threshold"), "threshold has 6 entries, 5 are needed"),
        (lengthened("synapse_target"), "synapse_target has 23 entries, 22 are needed"),
        (lengthened("format_weight_bits"), "format_weight_bits has 2 entries, 1 are needed"),
        (with_value("layer", 2), "layer has values outside 0 … 1"),
        (
            with_value("neuron", 1),
            "layer fc1 holds none of its 3 neurons, one twice or one that is not there",
        ),
        (with_value("axon_source", 11), "axon_source has values outside 0 … 10"),
        (with_value("axon_format", 7), "axon_format has values outside 0 … 0"),
        (with_value("readout_class", 2), "readout_class has values outside -1 … 1"),
        (with_value("decay_u", 4096), "decay_u has values outside 0 … 4095"),
        (with_value("threshold", 2**17), "threshold has values outside 0 … 131071"),
        (with_value("bias_mantissa", 4096), "bias_mantissa has values outside -4096 … 4095"),
        (with_value("synapse_target", 5), "synapse_target points beyond its core"),
        (with_value("format_exponent", -2), "format_exponent has values outside -1 … 7"),
        (with_value("core_tile", -1), "core_tile has values outside 0 … 65535"),
    ],
)
def test_indices_that_point_nowhere(path, netlist, change, message):
    changed = {name: array.astype("<i4") for name, array in change(netlist).items()}
    rewrite(path, **changed)
    assert message in refused(path)


def interrupted_at(line: int, write):
    """Run `write`; an interrupt strikes at that line of all that it runs (0: none). How many lines there were."""
    seen = 0

    def trace(_frame, what, _value):
        nonlocal seen
        seen += what == "line"
        if what == "line" and seen == line:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        write()
    finally:
        sys.settrace(before)
    return seen


@pytest.mark.filterwarnings("ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_anywhere_leaves_nothing_half_written(tmp_path):
    path = tmp_path / "x.json"

    def write():
        with write_atomically(path) as file:
            file.write(b"new")

    interrupted_at(0, write)  # the first call runs lines that later ones skip
    lines = interrupted_at(0, write)
    assert lines > 20
    ends, struck = set(), 0
    for line in range(1, lines + 1):
        path.write_bytes(b"old")
        try:
            interrupted_at(line, write)
        except KeyboardInterrupt:
            struck += 1
        assert [file.name for file in tmp_path.iterdir()] == ["x.json"], line
        ends.add(path.read_bytes())
    assert ends == {b"old", b"new"}
    assert struck > 0.9 * lines


@pytest.mark.parametrize("value", [10**400, float("inf"), -1.0, "1", True], ids=lambda each: str(each)[:9])
def test_what_is_no_real_number_of_a_manifest(value):
    assert archive._is(0.5, float)
    assert not archive._is(value, float)


def test_leftovers_are_those_of_one_file(tmp_path):
    path = tmp_path / "x[1].json"
    with write_atomically(path) as file:
        (written,) = tmp_path.iterdir()
        file.write(b"new")
    for name in (written.name, written.name.replace("x[1]", "x1")):
        (tmp_path / name).write_bytes(b"half")
    remove_leftovers(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        written.name.replace("x[1]", "x1"),
        "x[1].json",
    ]


def test_a_file_that_is_replaced_hands_its_permissions_on(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"old")
    path.chmod(0o600)
    with write_atomically(path) as file:
        file.write(b"new")
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o600)


def test_of_a_link_the_target_is_replaced(tmp_path):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "a", tmp_path / "b"
    for content in (b"old", b"new"):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        with write_atomically(link) as file:
            file.write(content)
        assert link.is_symlink()
        assert target.read_bytes() == content
        assert [file.name for file in target.parent.iterdir()] == ["a"]
