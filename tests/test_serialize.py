import dataclasses
import errno
import hashlib
import io
import json
import os
import re
import stat
import zipfile
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from random_networks import LOIHI, integer_chain, integer_networks

from spikeloom.compiler import archive
from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.errors import CapacityError, FormatError
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import (
    ARRAYS,
    LARGE,
    inconsistencies,
    netlist_bytes,
    read_netlist,
    write_netlist,
)


def placed(network, provenance=None):
    parts = partition(network, LOIHI)
    return emit(network, parts, tuple(range(len(parts.cores))), LOIHI, provenance or {})


@pytest.fixture(scope="module")
def netlist() -> Netlist:
    """Two layers on one core: 6 inputs of 3 taxels, 3 neurons, then 2."""
    network = integer_chain(
        [[2, 4, 0, 0, 8, -6], [6, 8, 254, 2, 2, 2], [2] * 6],
        [[2, 4, 6], [-2, -4, -256]],
        thresholds=[[1, 2, 131071], 7],
        polarities=2,
    )
    return placed(network, {"graph": "manual", "options": {"weight_bits": 8}, "checkpoint": "0" * 64})


@pytest.fixture
def path(tmp_path, netlist):
    """The netlist, written."""
    write_netlist(netlist, tmp_path / "a.loom")
    return tmp_path / "a.loom"


def equal(left: Netlist, right: Netlist) -> bool:
    for field in fields(Netlist):
        one, other = getattr(left, field.name), getattr(right, field.name)
        if not (np.array_equal(one, other) if field.name in ARRAYS else one == other):
            return False
    return True


def refused(path) -> str:
    with pytest.raises(FormatError) as caught:
        read_netlist(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def members_of(path):
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def write_members(path, members, *, sign=True, compression=zipfile.ZIP_STORED):
    """Write members as a netlist file, with a matching hash unless told otherwise."""
    members = dict(members)
    if sign:
        digest = hashlib.sha256()
        for name in ("manifest", *ARRAYS):
            if name in members:
                digest.update(f"{name} {members[name].dtype.str} {members[name].shape}\n".encode())
                digest.update(np.ascontiguousarray(members[name]).tobytes())
        members["sha256"] = np.array(digest.hexdigest())
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, array in members.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array), allow_pickle=False)
            archive.writestr(f"{name}.npy", content.getvalue())


def rewrite(path, **changes):
    """Change members of a netlist file; the hash fits again."""
    write_members(path, members_of(path) | changes)


def rewrite_manifest(path, **changes):
    manifest = json.loads(str(members_of(path)["manifest"])) | changes
    dropped = {key: value for key, value in manifest.items() if value is not None}
    rewrite(path, manifest=np.array(json.dumps(dropped)))


# --- round trip


def test_a_netlist_comes_back_whole(path, netlist):
    found = read_netlist(path)
    assert equal(found, netlist)
    for name in ARRAYS:
        array = getattr(found, name)
        if name in LARGE:
            assert array.dtype == np.dtype("<i2" if name == "synapse_weight" else "<i1")  # as stored
        else:
            assert array.dtype == (np.float64 if name == "scale" else np.int64)
        assert not array.flags.writeable


@settings(deadline=None, max_examples=50)
@given(integer_networks())
def test_every_netlist_comes_back_whole(tmp_path_factory, network):
    try:
        original = placed(network)
    except CapacityError:  # too many weight formats for a core
        return
    path = tmp_path_factory.mktemp("netlist") / "a.loom"
    sha256 = write_netlist(original, path)
    assert equal(read_netlist(path), original)
    assert sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert path.read_bytes() == netlist_bytes(original)


def test_equal_netlists_give_equal_bytes(netlist, tmp_path):
    copy = dataclasses.replace(
        netlist, synapse_weight=netlist.synapse_weight.copy(), provenance=dict(reversed(netlist.provenance.items()))
    )
    assert netlist_bytes(netlist) == netlist_bytes(copy)
    for name in "ab":
        write_netlist(netlist, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("name", ARRAYS)
def test_every_array_changes_the_bytes(netlist, name):
    array = getattr(netlist, name).copy()
    array[-1] += 1
    assert netlist_bytes(dataclasses.replace(netlist, **{name: array})) != netlist_bytes(netlist)


def test_numpy_alone_reads_the_file(path, netlist):
    with np.load(path, allow_pickle=False) as archive:
        assert set(archive.files) == {"manifest", "sha256", *ARRAYS}
        np.testing.assert_array_equal(archive["synapse_weight"], netlist.synapse_weight)
        assert archive["synapse_weight"].dtype == np.dtype("<i2")
        assert archive["readout_class"].dtype == np.dtype("<i1")
        assert archive["threshold"].dtype == np.dtype("<i4")
        manifest = json.loads(str(archive["manifest"]))
    assert manifest["format"] == "spikeloom-netlist"
    assert (manifest["version"], manifest["bins"], manifest["clocks"]) == (5, 1, {"channels": 0, "steps": 1})
    assert manifest["layers"][0] == dataclasses.asdict(netlist.layers[0]) | {"unheard": []}
    assert manifest["provenance"] == netlist.provenance


def test_the_documented_hash_is_the_one_in_the_file(path):
    stated = str(members_of(path)["sha256"])
    write_members(path, members_of(path))
    assert str(members_of(path)["sha256"]) == stated


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


# --- files that are no netlist


def test_a_missing_file(tmp_path):
    assert refused(tmp_path / "a.loom") == "no such file; write one with spikeloom compile"


def test_a_folder(tmp_path):
    assert refused(tmp_path) == "is not a file; write one with spikeloom compile"


@pytest.mark.parametrize("content", [b"", b"hello", bytes(range(256)) * 50])
def test_random_bytes(tmp_path, content):
    path = tmp_path / "a.loom"
    path.write_bytes(content)
    assert refused(path) == "is truncated or not a netlist (File is not a zip file); compile it again"


def test_a_file_cut_at_any_place(path):
    content = path.read_bytes()
    for end in range(0, len(content), 97):
        path.write_bytes(content[:end])
        assert re.fullmatch(r"is truncated or not a netlist \(.+\); compile it again", refused(path)), end


def test_a_file_altered_at_any_place(path, netlist):
    """Either it is refused, or the byte says nothing (dates and the like)."""
    content = path.read_bytes()
    accepted = 0
    for place in range(0, len(content), 23):
        for value in (content[place] ^ 1, 255 - content[place]):
            path.write_bytes(content[:place] + bytes([value]) + content[place + 1 :])
            try:
                found = read_netlist(path)
            except FormatError:
                assert refused(path)
            else:
                assert equal(found, netlist)
                accepted += 1
    assert accepted < len(content) // 23


def test_an_altered_weight_does_not_match_the_hash(path):
    members = members_of(path)
    weights = members["synapse_weight"].copy()
    weights[0] += 2
    write_members(path, members | {"synapse_weight": weights}, sign=False)
    assert refused(path) == "its content does not match its hash, so it was altered; compile it again"


def test_an_altered_manifest_does_not_match_the_hash(path):
    members = members_of(path)
    text = str(members["manifest"]).replace("manual", "knn:3 ")
    write_members(path, members | {"manifest": np.array(text)}, sign=False)
    assert refused(path) == "its content does not match its hash, so it was altered; compile it again"


def test_another_archive_of_arrays(tmp_path):
    np.savez(tmp_path / "a.npz", weights=np.zeros(3))
    assert refused(tmp_path / "a.npz") == (
        "is not a netlist (no manifest and no sha256); write one with spikeloom compile"
    )


def test_no_hash(path):
    members = members_of(path)
    del members["sha256"]
    write_members(path, members, sign=False)
    assert refused(path) == "is not a netlist (no sha256); write one with spikeloom compile"


def test_compressed_members(path):
    write_members(path, members_of(path), compression=zipfile.ZIP_DEFLATED)
    assert "has compressed members" in refused(path)


def test_more_bytes_declared_than_there_are(path, monkeypatch):
    """A stored member cannot be larger than its file."""
    with zipfile.ZipFile(path) as archive:
        infos = archive.infolist()
    infos[0].file_size = 10**9
    monkeypatch.setattr(zipfile.ZipFile, "infolist", lambda _: infos)
    assert "bytes claim to hold 1000" in refused(path)


def test_a_file_too_large_to_read(path, monkeypatch):
    size = path.stat().st_size
    monkeypatch.setattr(archive, "SIZE_LIMIT", size - 1)
    assert refused(path) == f"{size} bytes, {size - 1} allowed; this is no netlist of one chip"


def test_an_array_of_objects_is_never_unpickled(path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(path.parent / "unpickled"),)

    content = io.BytesIO()
    np.lib.format.write_array(content, np.array([Trap()], object), allow_pickle=True)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("neuron.npy", content.getvalue())
    assert "an array of objects" in refused(path)
    assert not (path.parent / "unpickled").exists()


def test_an_array_that_announces_more_than_memory_holds(path):
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": "<i8", "fortran_order": False, "shape": (2**60,)})
    members = members_of(path)
    del members["neuron"]
    write_members(path, members)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("neuron.npy", content.getvalue())
    assert re.fullmatch(r"is truncated or not a netlist \(.+\); compile it again", refused(path))


# --- manifests


@pytest.mark.parametrize("version", [4, 6])
def test_another_version(path, version):
    rewrite_manifest(path, version=version)
    assert refused(path) == f"has format version {version}, this program reads 5; compile it again or update spikeloom"


@pytest.mark.parametrize("text", ["{", "[" * 100_000])
def test_a_manifest_that_is_no_json(path, text):
    rewrite(path, manifest=np.array(text))
    assert refused(path) == "has an unreadable manifest; compile it again"


@pytest.mark.parametrize("text", ["[]", "3", "{}", '{"format": "spikeloom-checkpoint", "version": 1}'])
def test_a_manifest_of_something_else(path, text):
    rewrite(path, manifest=np.array(text))
    assert refused(path) == "is not a netlist; write one with spikeloom compile"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (key, value)
        for key in ("target", "taxels", "polarities", "classes", "layers", "provenance")
        for value in (None, 1.5, "three", [1], {"name": "fc1"}, True, -1)
        if (key, type(value)) not in {("target", str), ("provenance", dict)}
    ],
)
def test_manifest_entries_of_another_kind(path, key, value):
    rewrite_manifest(path, **{key: value})
    assert refused(path) == f"the manifest has no usable {key}; compile it again"


@pytest.mark.parametrize(
    ("field", "value"), [("neurons", "3"), ("scale", None), ("depth", -1), ("scale", 0), ("name", 7), ("depth", 0.5)]
)
def test_layers_of_another_kind(path, field, value):
    layers = json.loads(str(members_of(path)["manifest"]))["layers"]
    layers[0][field] = value
    rewrite_manifest(path, layers=layers)
    assert refused(path) == "the manifest has no usable layers; compile it again"


def test_a_layer_with_a_field_too_many(path):
    layers = json.loads(str(members_of(path)["manifest"]))["layers"]
    layers[0]["colour"] = "red"
    rewrite_manifest(path, layers=layers)
    assert refused(path) == "the manifest has no usable layers; compile it again"


def test_a_chip_that_this_program_does_not_know(path):
    rewrite_manifest(path, target="loihi3")
    assert refused(path) == "is for 'loihi3', this program knows loihi1; update spikeloom"


def test_missing_and_unknown_members(path):
    members = members_of(path)
    del members["axon_source"]
    write_members(path, members)
    assert refused(path) == "has missing or unknown members (axon_source); compile it again"
    write_members(path, members | {"axon_sauce": np.zeros(1, "<i1")})
    assert refused(path) == "has missing or unknown members (axon_sauce, axon_source); compile it again"


@pytest.mark.parametrize("name", ["neuron", "core_axons", "synapse_weight", "format_exponent"])
@pytest.mark.parametrize("form", ["float", "text", "unsigned", "bool", "flat", "table"])
def test_members_of_another_type(path, name, form):
    array = members_of(path)[name]
    changed = {
        "float": array.astype(float),
        "text": array.astype(str),
        "unsigned": array.astype(np.uint16),
        "bool": array.astype(bool),
        "flat": array[0],
        "table": array[:, None],
    }[form]
    rewrite(path, **{name: np.asarray(changed)})
    assert refused(path) == f"{name} is no list of integers; compile it again"


# --- files that match their hash and are nonsense all the same


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
        (with_value("core_compartments", 4, -1), "core_compartments does not divide 5 entries in 1 parts"),
        (with_value("core_axons", 1), "core_axons does not divide 9 entries in 1 parts"),
        (with_value("axon_synapses", 99, 3), "axon_synapses does not divide 22 entries in 9 parts"),
        (with_value("axon_synapses", -1, 1), "axon_synapses does not divide 22 entries in 9 parts"),
        (lengthened("neuron"), "neuron has 6 entries for 5 compartments"),
        (lengthened("threshold"), "threshold has 6 entries for 5 compartments"),
        (lengthened("axon_format"), "axon_format or synapse_target has the wrong length"),
        (lengthened("synapse_target"), "axon_format or synapse_target has the wrong length"),
        (lengthened("format_weight_bits"), "the format arrays have different lengths"),
        (with_value("layer", 2), "layer has values outside 0 … 1"),
        (with_value("neuron", 1), "layer fc1 holds none of its 3 neurons, one twice or one that is not there"),
        (with_value("axon_source", 11), "axon_source has values outside 0 … 10"),
        (with_value("axon_source", -1), "axon_source has values outside 0 … 10"),
        (with_value("axon_format", 7), "axon_format has values outside 0 … 0"),
        (with_value("readout_class", 2), "readout_class has values outside -1 … 1"),
        (with_value("decay_u", 4096), "decay_u has values outside 0 … 4095"),
        (with_value("decay_v", -1), "decay_v has values outside 0 … 4095"),
        (with_value("threshold", 2**17), "threshold has values outside 0 … 131071"),
        (with_value("bias_mantissa", 4096), "bias_mantissa has values outside -4096 … 4095"),
        (with_value("bias_exponent", 8), "bias_exponent has values outside 0 … 7"),
        (with_value("synapse_weight", 256), "synapse_weight has values outside -256 … 255"),
        (with_value("synapse_target", 5), "synapse_target points beyond its core"),
        (with_value("synapse_target", -1), "synapse_target points beyond its core"),
        (with_value("format_exponent", -2), "format_exponent has values outside -1 … 7"),
        (with_value("core_tile", -1), "core_tile has values outside 0 … 2147483647"),
    ],
)
def test_indices_that_point_nowhere(path, netlist, change, message):
    changed = {name: array.astype("<i4") for name, array in change(netlist).items()}
    rewrite(path, **changed)
    assert refused(path) == f"{message}; compile it again"


@settings(deadline=None, max_examples=30)
@given(integer_networks())
def test_compiled_netlists_are_consistent(network):
    try:
        assert inconsistencies(placed(network)) == []
    except CapacityError:
        return


# --- writing


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_the_old_file(path, netlist, monkeypatch, error):
    def fail(_handle):
        raise error

    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(type(error)) as caught:
        write_netlist(dataclasses.replace(netlist, provenance={}), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == ["a.loom"]
    if isinstance(error, OSError):
        assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))


def test_a_write_into_a_folder_that_does_not_exist(netlist, tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        write_netlist(netlist, tmp_path / "no" / "a.loom")
    assert caught.value.filename == str(tmp_path / "no" / "a.loom")


def test_a_written_file_has_the_usual_permissions(path, tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_a_write_replaces_the_old_file(path, netlist):
    newer = dataclasses.replace(netlist, provenance={})
    write_netlist(newer, path)
    assert equal(read_netlist(path), newer)
