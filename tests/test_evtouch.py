import contextlib
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from spikeloom.compiler.errors import DataError
from spikeloom.models.recordings import evtouch
from spikeloom.models.recordings.evtouch import Recordings, load_recordings

GIVE = "give the folder or zip that holds train/ and test/"
DAMAGED = "truncated or damaged; copy or download it again"
EVENTS = (np.arange(3 * 2 * 5) % 3 == 0).reshape(3, 2, 5)
SAMPLE = "sample_0_label_0.npy"


def npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


GOOD = npy(EVENTS.astype(np.float32))


def folder(path: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        target = path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    return path


def archive(path: Path, files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as file:
        for name, data in files.items():
            file.writestr(name, data)
    return path


def message(path, split="test", **options) -> str:
    with pytest.raises(DataError) as caught:
        load_recordings(path, split, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def refuse(tmp_path: Path, data: bytes, **options) -> str:
    """Message for one bad recording, the same from a folder and from a zip."""
    files = {f"test/{SAMPLE}": data}
    from_folder = message(folder(tmp_path / "data", files), **options)
    from_zip = message(archive(tmp_path / "data.zip", files), **options)
    where, zip_where = f"data: test/{SAMPLE}: ", f"data.zip: test/{SAMPLE}: "
    assert from_folder.startswith(where)
    assert from_zip.startswith(zip_where)
    assert from_folder.removeprefix(where) == from_zip.removeprefix(zip_where)
    return from_folder.removeprefix(where)


# The released recordings


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("data", "split", "shape", "classes", "mean"),
    [
        ("objects_zip", "train", (576, 39, 2, 250), 36, 0.12793296),
        ("objects_zip", "test", (144, 39, 2, 250), 36, 0.12723967),
        ("containers_zip", "train", (240, 39, 2, 325), 20, 0.10159073),
        ("containers_zip", "test", (60, 39, 2, 325), 20, 0.09943787),
    ],
)
def test_the_released_recordings(request, data, split, shape, classes, mean):
    path = request.getfixturevalue(data)
    recordings = load_recordings(path, split, classes=classes, taxels=39)
    assert recordings.events.shape == shape
    assert recordings.events.dtype == np.uint8
    assert recordings.events.flags.c_contiguous
    assert recordings.events.max() == 1
    assert recordings.events.mean() == pytest.approx(mean, abs=1e-8)
    assert np.bincount(recordings.labels).tolist() == [shape[0] // classes] * classes
    assert (len(recordings), recordings.taxels, recordings.steps) == (shape[0], shape[1], shape[3])
    assert (recordings.split, recordings.source) == (split, path.name)


@pytest.mark.recordings
def test_files_are_in_the_expected_order(objects_zip, shared_dir):
    expected = json.loads((shared_dir / "checkpoints/objects_manual.expected.json").read_text())
    recordings = load_recordings(objects_zip)
    assert list(recordings.files) == expected["files"]
    assert recordings.labels.tolist() == expected["labels"]


@pytest.mark.recordings
def test_a_folder_reads_like_its_zip(containers_zip, tmp_path):
    with zipfile.ZipFile(containers_zip) as file:
        file.extractall(tmp_path)
    from_zip = load_recordings(containers_zip, "test")
    for path in (tmp_path, tmp_path / "Ev-Containers"):
        from_folder = load_recordings(path, "test")
        assert np.array_equal(from_folder.events, from_zip.events)
        assert np.array_equal(from_folder.labels, from_zip.labels)
        assert from_folder.files == from_zip.files


@pytest.mark.recordings
def test_polarity_one_leads_at_first_contact(containers_zip):
    """The Containers recordings begin without contact; the first 40 events are mostly of polarity 1."""
    counts = load_recordings(containers_zip, "train").events.sum(axis=1, dtype=np.int64).cumsum(axis=2)
    first = np.argmax(counts.sum(axis=1) > 40, axis=1)
    negative, positive = counts[np.arange(len(counts)), :, first].T
    assert (positive > negative).mean() > 0.9


# What is accepted


@pytest.mark.parametrize("dtype", ["float32", "float64", "uint8", "bool"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_dtypes_and_orders(tmp_path, dtype, order):
    data = npy(np.asarray(EVENTS.astype(dtype), order=order))
    recordings = load_recordings(folder(tmp_path, {f"test/{SAMPLE}": data}))
    assert np.array_equal(recordings.events, EVENTS[None])
    assert recordings.events.dtype == np.uint8
    assert recordings.events.flags.c_contiguous


def test_files_sort_as_strings_and_limit_takes_the_first(tmp_path):
    names = [f"sample_{n}_label_{n % 7}.npy" for n in (2, 10, 1, 100)]
    path = archive(tmp_path / "my.zip", {f"top/train/{name}": GOOD for name in names})
    recordings = load_recordings(path, "train")
    assert recordings.files == (
        "sample_100_label_2.npy",
        "sample_10_label_3.npy",
        "sample_1_label_1.npy",
        "sample_2_label_2.npy",
    )
    assert recordings.labels.tolist() == [2, 3, 1, 2]
    assert load_recordings(path, "train", limit=3).files == recordings.files[:3]
    assert load_recordings(path, "train", limit=99).files == recordings.files


def test_other_files_are_left_alone(tmp_path):
    files = {
        f"set/test/{SAMPLE}": GOOD,
        "set/test/.DS_Store": b"x",
        "set/test/._sample_0_label_0.npy": b"x",
        "set/README.md": b"x",
        "set/notes/a.npy": b"x",
        "__MACOSX/test/sample_1_label_1.npy": b"x",
        "notes.npy": b"x",
    }
    assert load_recordings(folder(tmp_path / "data", files)).files == (SAMPLE,)
    assert load_recordings(archive(tmp_path / "data.zip", files)).files == (SAMPLE,)


def test_progress_counts_up(tmp_path):
    path = folder(tmp_path, {f"test/sample_{n}_label_0.npy": GOOD for n in range(3)})
    calls = []
    load_recordings(path, progress=lambda done, of: calls.append((done, of)))
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_recordings_are_read_only(tmp_path):
    recordings = load_recordings(folder(tmp_path, {f"test/{SAMPLE}": GOOD}))
    for array in (recordings.events, recordings.labels):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@given(
    events=arrays.arrays(
        np.uint8,
        st.tuples(st.integers(1, 4), st.integers(1, 5), st.just(2), st.integers(1, 6)),
        elements=st.integers(0, 1),
    ),
    method=st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]),
    dtype=st.sampled_from(["<f4", "<f8", "u1", "?"]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_what_was_written_is_read(tmp_path, events, method, dtype):
    files = {f"train/sample_{n}_label_{n}.npy": npy(sample.astype(dtype)) for n, sample in enumerate(events)}
    recordings = load_recordings(archive(tmp_path / "any.zip", files, method), "train")
    assert np.array_equal(recordings.events, events)
    assert recordings.labels.tolist() == list(range(len(events)))


# What is refused: the data set


def test_path_missing(tmp_path):
    path = tmp_path / "none.zip"
    assert message(path) == f"{path}: no such file or folder; {GIVE}"


def test_neither_folder_nor_zip(tmp_path):
    path = tmp_path / "text.zip"
    path.write_text("hello")
    assert message(path) == f"{path}: neither a folder nor a zip; {GIVE}"


def test_a_device_is_not_opened():
    assert message("/dev/null") == f"/dev/null: neither a folder nor a zip; {GIVE}"


def test_file_that_cannot_be_opened(tmp_path, monkeypatch):
    path = archive(tmp_path / "data.zip", {f"test/{SAMPLE}": GOOD})

    def refused(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)
    assert message(path) == f"{path}: cannot be read (Permission denied); check the disk"


def test_truncated_zip(tmp_path):
    path = archive(tmp_path / "data.zip", {f"test/{SAMPLE}": GOOD})
    path.write_bytes(path.read_bytes()[:-30])
    assert message(path) == f"{path}: zip {DAMAGED}"


def test_no_recordings(tmp_path):
    path = folder(tmp_path / "data", {"README.md": b"x"})
    expected = f"data: no recordings (train/ or test/ with sample_N_label_L.npy); {GIVE}"
    assert message(path) == expected
    (path / "test").mkdir()
    assert message(path) == expected


def test_split_missing_or_empty(tmp_path):
    path = folder(tmp_path / "data", {f"train/{SAMPLE}": GOOD})
    expected = "data: split 'test' is missing or empty; splits with recordings: train"
    assert message(path) == expected
    (path / "test").mkdir()
    assert message(path) == expected
    both = archive(tmp_path / "both.zip", {f"train/{SAMPLE}": GOOD, f"test/{SAMPLE}": GOOD})
    assert message(both, "val") == "both.zip: split 'val' is missing or empty; splits with recordings: test, train"


def test_several_data_sets(tmp_path):
    files = {f"a/test/{SAMPLE}": GOOD, f"b/train/{SAMPLE}": GOOD}
    assert message(folder(tmp_path / "data", files)) == "data: several data sets (a, b); give one of them"
    files = {f"a/test/{SAMPLE}": GOOD, f"test/{SAMPLE}": GOOD}
    assert message(archive(tmp_path / "d.zip", files)) == "d.zip: several data sets (., a); give one of them"


@pytest.mark.parametrize("limit", [0, -3])
def test_limit_too_small(tmp_path, limit):
    assert message(tmp_path, limit=limit) == (
        f"limit: {limit} recordings, allowed are 1 or more; leave it out to read all"
    )


@pytest.mark.parametrize("name", ["sample_0.npy", "sample_0_label_.npy", "sample_0_label_-1.npy", "label_3.npy"])
def test_name_without_label(tmp_path, name):
    path = folder(tmp_path / "data", {f"test/{name}": GOOD})
    assert message(path) == (
        f"data: test/{name}: no label in the name, allowed is sample_N_label_L.npy; rename or remove the file"
    )


def test_label_beyond_classes(tmp_path):
    path = folder(tmp_path / "data", {"test/sample_0_label_36.npy": GOOD})
    assert message(path, classes=36) == (
        "data: test/sample_0_label_36.npy: label 36, the network has 36 classes (0..35); "
        "use the network that was trained on these objects"
    )
    assert load_recordings(path, classes=37).labels.tolist() == [36]


def test_shapes_that_differ(tmp_path):
    files = {f"test/{SAMPLE}": GOOD, "test/sample_1_label_1.npy": npy(EVENTS[:, :, :4])}
    assert message(folder(tmp_path / "data", files)) == (
        "data: test/sample_1_label_1.npy: shape (3, 2, 4), the recordings before it have (3, 2, 5); "
        "all of a split must agree"
    )


def test_file_that_vanishes(tmp_path):
    path = folder(tmp_path / "data", {f"test/sample_{n}_label_0.npy": GOOD for n in range(2)})
    gone = path / "test/sample_1_label_0.npy"
    assert message(path, progress=lambda *_: gone.unlink()) == (
        "data: test/sample_1_label_0.npy: cannot be read (No such file or directory); check the disk"
    )


# What is refused: one recording


@pytest.mark.parametrize(
    ("dtype", "shown"),
    [("int16", "<i2"), ("int64", "<i8"), ("float16", "<f2"), (">f4", ">f4"), ("int8", "|i1"), ("complex64", "<c8")],
)
def test_wrong_dtype(tmp_path, dtype, shown):
    assert refuse(tmp_path, npy(EVENTS.astype(dtype))) == (
        f"dtype {shown!r}, allowed are float32, float64, uint8 and bool; convert it"
    )


def test_structured_and_pickled_dtypes(tmp_path):
    expected = "dtype {}, allowed are float32, float64, uint8 and bool; convert it"
    structured = npy(np.zeros((3, 2, 5), dtype=[("a", "<f4")]))
    assert refuse(tmp_path, structured) == expected.format("'structured'")
    pickled = io.BytesIO()
    np.save(pickled, np.array([[[None]]]), allow_pickle=True)
    assert refuse(tmp_path, pickled.getvalue()) == expected.format("'|O'")


@pytest.mark.parametrize("shape", [(30,), (3, 10), (1, 3, 2, 5), (), (3, 2, 0), (0, 2, 5)])
def test_wrong_dimensions(tmp_path, shape):
    assert refuse(tmp_path, npy(np.zeros(shape, dtype=np.float32))) == (
        f"shape {shape}, allowed is (taxels, 2, steps); one recording per file"
    )


def test_wrong_polarities(tmp_path):
    assert refuse(tmp_path, npy(np.zeros((3, 5, 2), dtype=np.float32))) == (
        "shape (3, 5, 2) has 5 polarities, allowed are 2; use (taxels, 2, steps)"
    )


def test_wrong_taxels(tmp_path):
    data = npy(np.zeros((40, 2, 5), dtype=np.float32))
    assert refuse(tmp_path, data, taxels=39) == ("has 40 taxels, the network has 39; use recordings of its sensor")


@pytest.mark.parametrize(
    ("dtype", "value", "shown"),
    [
        ("float32", 0.5, "0.5"),
        ("float64", 1 + 2**-52, "1"),
        ("float32", -1, "-1"),
        ("float32", np.nan, "nan"),
        ("float64", np.inf, "inf"),
        ("uint8", 2, "2"),
    ],
)
def test_wrong_values(tmp_path, dtype, value, shown):
    events = EVENTS.astype(dtype)
    events[1, 0, 3] = value
    events[2, 1, 4] = value
    assert refuse(tmp_path, npy(events)) == (
        f"value {shown} at taxel 1, polarity 0, step 3, allowed are 0 and 1; recordings are events, not pressures"
    )


def test_bool_bytes_beyond_one(tmp_path):
    data = npy(EVENTS)
    assert refuse(tmp_path, data[:-1] + b"\x02") == (
        "value 2 at taxel 2, polarity 1, step 4, allowed are 0 and 1; recordings are events, not pressures"
    )


@pytest.mark.parametrize(("change", "size"), [(-1, 119), (-120, 0), (3, 123)])
def test_truncated_or_longer_data(tmp_path, change, size):
    data = GOOD[:change] if change < 0 else GOOD + b"x" * change
    assert refuse(tmp_path, data) == f"{size} bytes of data, its header announces 120; {DAMAGED}"


@pytest.mark.parametrize(
    "data",
    [
        GOOD[:100],
        GOOD[:10],
        GOOD.replace(b"'descr'", b"'descx'"),
        GOOD.replace(b"(3, 2, 5)", b"(3, 2,-5)"),
        GOOD.replace(b"(3, 2, 5)", b"(3, 2,1.)"),
        GOOD.replace(b"(3, 2, 5)", b"[3, 2, 5]"),
        GOOD.replace(b"False", b"open(", 1),
        GOOD.replace(b"'descr'", b"'des\xff\xfe'"),
        b"\x93NUMPY\x01\x00" + struct.pack("<H", 4000) + b"(" * 4000,
        b"\x93NUMPY\x01\x00" + struct.pack("<H", 2) + b"42",
    ],
)
def test_unreadable_headers(tmp_path, data):
    assert refuse(tmp_path, data) == f"npy header {DAMAGED}"


@pytest.mark.parametrize("data", [b"", b"\x93NUMP", b"PK\x03\x04", b"\x93NUMPY\x07\x00" + GOOD[8:], b"\x80\x04."])
def test_not_npy(tmp_path, data):
    assert refuse(tmp_path, data) == "not an npy file of version 1 to 3; save it with numpy.save"


def test_header_size_is_bounded(tmp_path):
    data = b"\x93NUMPY\x02\x00" + struct.pack("<I", 5000) + b" " * 5000
    assert refuse(tmp_path, data) == "npy header of 5000 bytes, limit 4096; save it with numpy.save"


def test_header_versions_two_and_three(tmp_path):
    header = GOOD[10:128]
    for version in (2, 3):
        data = b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<I", len(header)) + header + GOOD[128:]
        path = folder(tmp_path / str(version), {f"test/{SAMPLE}": data})
        assert np.array_equal(load_recordings(path).events, EVENTS[None])


def test_announced_sizes_take_no_memory(tmp_path):
    """The header claims 2e15 bytes; nothing is allocated for it."""
    data = GOOD.replace(b"(3, 2, 5), }" + b" " * 16, b"(99999999, 2, 9999999), }   ")
    assert data != GOOD
    assert refuse(tmp_path, data) == f"120 bytes of data, its header announces 7999999120000008; {DAMAGED}"


def test_recording_size_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(evtouch, "MAX_FILE_BYTES", len(GOOD) - 1)
    assert refuse(tmp_path, GOOD) == f"more than {len(GOOD) - 1} bytes, the limit of a recording; split it"
    monkeypatch.setattr(evtouch, "MAX_FILE_BYTES", len(GOOD))
    assert load_recordings(tmp_path / "data.zip").files == (SAMPLE,)


def test_total_size_is_bounded(tmp_path, monkeypatch):
    files = {f"test/sample_{n}_label_0.npy": GOOD for n in range(3)}
    monkeypatch.setattr(evtouch, "MAX_TOTAL_BYTES", 89)
    assert message(folder(tmp_path / "data", files)) == ("data: recordings of 90 bytes, limit 89; split the data set")
    monkeypatch.setattr(evtouch, "MAX_TOTAL_BYTES", 3 * len(GOOD) - 1)
    assert message(archive(tmp_path / "data.zip", files)) == (
        f"data.zip: recordings of {3 * len(GOOD)} bytes, limit {3 * len(GOOD) - 1}; split the data set"
    )


# What is refused: hostile archives


@pytest.mark.parametrize(
    "name",
    [
        "../test/sample_0_label_0.npy",
        "test/../../sample_0_label_0.npy",
        "/test/sample_0_label_0.npy",
        "C:/test/sample_0_label_0.npy",
        "..\\test\\sample_0_label_0.npy",
        "\\\\host\\test\\sample_0_label_0.npy",
        "test/..",
        "test/a\nb_label_0.npy",
    ],
)
def test_unsafe_names(tmp_path, name):
    path = archive(tmp_path / "bad.zip", {f"test/{SAMPLE}": GOOD, name: GOOD})
    assert message(path) == f"bad.zip: unsafe name {name!r} in the zip; do not trust this file"


def test_dots_inside_names_are_safe(tmp_path):
    path = archive(tmp_path / "d.zip", {"a..b/test/sample_..0_label_0.npy": GOOD})
    assert load_recordings(path).files == ("sample_..0_label_0.npy",)


def test_listed_twice(tmp_path):
    path = tmp_path / "twice.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(f"test/{SAMPLE}", GOOD)
        with pytest.warns(UserWarning, match="Duplicate name"):
            file.writestr(f"test/{SAMPLE}", GOOD)
    assert message(path) == f"twice.zip: test/{SAMPLE} is listed twice; do not trust this file"


def forge_size(path: Path, size: int) -> None:
    """Overwrite the uncompressed size of the only entry, in its local and in its central header."""
    data = bytearray(path.read_bytes())
    local, central = data.index(b"PK\x03\x04"), data.index(b"PK\x01\x02")
    data[local + 22 : local + 26] = data[central + 24 : central + 28] = struct.pack("<I", size)
    path.write_bytes(data)


def test_bomb_by_announced_ratio(tmp_path):
    path = archive(tmp_path / "bomb.zip", {f"test/{SAMPLE}": GOOD})
    forge_size(path, 100 << 20)
    assert message(path) == (
        f"bomb.zip: {path.stat().st_size} bytes claim to hold 104857600, limit 1032 to 1; do not trust this file"
    )


def test_bomb_that_hides_its_size(tmp_path):
    """Sixteen megabytes that claim to be 128 bytes: reading stops there and the checksum differs."""
    path = archive(tmp_path / "bomb.zip", {f"test/{SAMPLE}": GOOD + bytes(16 << 20)})
    forge_size(path, 128)
    assert message(path) == f"bomb.zip: test/{SAMPLE}: {DAMAGED}"


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_cannot_be_bounded(tmp_path, method):
    path = archive(tmp_path / "data.zip", {f"test/{SAMPLE}": GOOD}, method)
    assert message(path) == f"data.zip: test/{SAMPLE} is encrypted or not deflated; zip it again plainly"


def test_encrypted(tmp_path):
    path = archive(tmp_path / "data.zip", {f"test/{SAMPLE}": GOOD})
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x03\x04") + 6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    assert message(path) == f"data.zip: test/{SAMPLE} is encrypted or not deflated; zip it again plainly"


def test_flipped_byte_in_an_entry(tmp_path):
    path = archive(tmp_path / "data.zip", {f"test/{SAMPLE}": GOOD}, zipfile.ZIP_STORED)
    data = bytearray(path.read_bytes())
    data[data.index(GOOD[128:]) + 3] ^= 1
    path.write_bytes(data)
    assert message(path) == f"data.zip: test/{SAMPLE}: {DAMAGED}"


ZIPPED = io.BytesIO()
with zipfile.ZipFile(ZIPPED, "w", zipfile.ZIP_DEFLATED) as _file:
    _file.writestr(f"test/{SAMPLE}", GOOD)
    _file.writestr("test/sample_1_label_1.npy", GOOD)


@given(
    changes=st.lists(st.tuples(st.integers(0, len(ZIPPED.getvalue()) - 1), st.integers(0, 255)), max_size=4),
    keep=st.integers(0, len(ZIPPED.getvalue())),
    cut=st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=300)
def test_a_damaged_zip_reads_right_or_not_at_all(tmp_path, changes, keep, cut):
    data = bytearray(ZIPPED.getvalue())
    for place, value in changes:
        data[place] = value
    path = tmp_path / "fuzz.zip"
    path.write_bytes(data[:keep] if cut else data)
    with contextlib.suppress(DataError):
        recordings = load_recordings(path)
        assert all(np.array_equal(events, EVENTS) for events in recordings.events)


@given(data=st.binary(max_size=200), keep=st.integers(0, 148))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=200)
def test_a_damaged_npy_reads_right_or_not_at_all(tmp_path, data, keep):
    path = folder(tmp_path / "fuzz", {f"test/{SAMPLE}": GOOD[:keep] + data})
    with contextlib.suppress(DataError):
        recordings = load_recordings(path)
        assert recordings.events.shape[2] == 2
        assert recordings.events.max() <= 1


def test_a_name_that_a_zero_byte_cuts_to_nothing(tmp_path):
    data = bytearray(ZIPPED.getvalue())
    data[data.rindex(b"test/sample_1")] = 0
    (tmp_path / "cut.zip").write_bytes(data)
    with pytest.raises(DataError) as caught:
        load_recordings(tmp_path / "cut.zip")
    name = "\0est/sample_1_label_1.npy"
    assert str(caught.value) == f"cut.zip: unsafe name {name!r} in the zip; do not trust this file"


def test_recordings_keep_what_they_are_given():
    events = np.zeros((2, 3, 2, 4), dtype=np.uint8)
    recordings = Recordings(events=events, labels=np.array([0, 1]), files=("a", "b"), split="test", source="memory")
    assert (len(recordings), recordings.taxels, recordings.steps) == (2, 3, 4)
