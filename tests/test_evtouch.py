import io
import struct
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from made_files import events, zipped
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.archive import npy_bytes as npy
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings import evtouch
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import Recordings, first_part, parse_window

EVENTS = (np.arange(3 * 2 * 5) % 3 == 0).reshape(3, 2, 5)
SAMPLE = "sample_0_label_0.npy"


GOOD = npy(EVENTS.astype(np.float32))


def folder(path: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        target = path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    return path


def archive(path: Path, files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    path.write_bytes(zipped(files, method))
    return path


message = partial(refused, DataError, "", load_data)


def refuse(tmp_path: Path, data: bytes, **options) -> str:
    """Message for one bad recording, the same from a folder and from a zip."""
    files = {f"test/{SAMPLE}": data}
    from_folder = message(folder(tmp_path / "data", files), **options)
    from_zip = message(archive(tmp_path / "data.zip", files), **options)
    assert from_folder == from_zip.replace("data.zip", "data")
    assert from_folder.startswith(f"data: test/{SAMPLE}: ")
    return from_folder.removeprefix(f"data: test/{SAMPLE}: ")


def test_files_sort_as_strings_and_limit_takes_the_first(tmp_path):
    names = [f"sample_{n}_label_{n % 7}.npy" for n in (2, 10, 1, 100)]
    path = archive(tmp_path / "my.zip", {f"top/train/{name}": GOOD for name in names})
    recordings = load_data(path, "train")
    assert recordings.files == tuple(f"sample_{n}_label_{n % 7}.npy" for n in (100, 10, 1, 2))
    assert recordings.labels.tolist() == [2, 3, 1, 2]
    assert load_data(path, "train", limit=3).files == recordings.files[:3]


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
    assert load_data(folder(tmp_path / "data", files)).files == (SAMPLE,)
    assert load_data(archive(tmp_path / "data.zip", files)).files == (SAMPLE,)


@given(
    events=arrays.arrays(
        np.uint8,
        st.tuples(st.integers(1, 4), st.integers(1, 5), st.just(2), st.integers(1, 6)),
        elements=st.integers(0, 1),
    ),
    method=st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]),
    dtype=st.sampled_from(["<f4", "<f8", "u1", "?", ">i2"]),
    order=st.sampled_from("CF"),
)
def test_what_was_written_is_read(tmp_path, events, method, dtype, order):
    files = {
        f"train/sample_{n}_label_{n}.npy": npy(sample.astype(dtype, order))
        for n, sample in enumerate(events)
    }
    recordings = load_data(archive(tmp_path / "any.zip", files, method), "train")
    assert np.array_equal(recordings.events, events)
    assert recordings.labels.tolist() == list(range(len(events)))


@pytest.mark.parametrize(
    ("names", "split", "words"),
    [
        (
            [f"elsewhere/{SAMPLE}"],
            "test",
            "no recordings (train/ or test/ with .csv, .npz or sample_N_label_L.npy)",
        ),
        ([f"train/{SAMPLE}"], "test", "split 'test' is missing or empty; splits with recordings: train"),
        ([f"train/{SAMPLE}", f"test/{SAMPLE}"], "val", "splits with recordings: test, train"),
        ([f"a/test/{SAMPLE}", f"b/train/{SAMPLE}"], "test", "several data sets (a, b); give one of them"),
        *(
            ([f"test/{name}"], "test", f"test/{name}: no label in the name, allowed is sample_N_label_L.npy")
            for name in ("sample_0.npy", "sample_0_label_.npy", "sample_0_label_-1.npy", "label_3.npy")
        ),
        (
            ["test/sample_0_label_36.npy"],
            "test",
            "label_36.npy: label 36, the network has 36 classes (0..35)",
        ),
    ],
)
def test_data_sets_that_cannot_be(tmp_path, names, split, words):
    files = dict.fromkeys(names, GOOD)
    for path in (folder(tmp_path / "data", files), archive(tmp_path / "data.zip", files)):
        assert words in message(path, split, classes=36)


def pickled() -> bytes:
    content = io.BytesIO()
    np.save(content, np.array([[[None]]]), allow_pickle=True)
    return content.getvalue()


def with_value(dtype, value) -> bytes:
    events = EVENTS.astype(dtype)
    events[1, 0, 3] = events[2, 1, 4] = value
    return npy(events)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (npy(EVENTS.astype(np.complex64)), "dtype '<c8', allowed are numbers"),
        (npy(np.zeros((3, 2, 5), dtype=[("a", "<f4")])), "allowed are numbers"),
        *(
            (npy(np.zeros(shape)), f"shape {shape}, allowed is (taxels, polarities, steps)")
            for shape in ((30,), (1, 3, 2, 5), (), (0, 2, 5), (3, 50, 2))
        ),
        (npy(np.zeros((40, 2, 5))), "has 40 taxels, the network has 3; use recordings of its sensor"),
        *(
            (
                with_value(dtype, value),
                f"value {shown} at taxel 1, polarity 0, step 3, allowed are 0 and 1; recordings",
            )
            for dtype, value, shown in (
                ("float32", 0.5, "0.5"),
                ("float64", 1 + 2**-52, "1"),
                ("int8", -1, "-1"),
                ("float32", np.nan, "nan"),
                ("uint8", 2, "2"),
            )
        ),
        (npy(EVENTS)[:-1] + b"\x02", "value 2 at taxel 2, polarity 1, step 4"),
    ],
)
def test_arrays_that_are_no_recording(tmp_path, data, words):
    assert words in refuse(tmp_path, data, taxels=3)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        pickled(),
        GOOD[:-1],
        GOOD.replace(b"False", b"open(", 1),
        GOOD.replace(b"(3, 2, 5), }" + b" " * 16, b"(99999999, 2, 9999999), }   "),
        b"\x93NUMPY\x01\x00" + struct.pack("<H", 4000) + b"(" * 4000,
    ],
)
def test_what_is_no_array(tmp_path, data):
    """Neither is a thing unpickled, nor memory taken for what is only announced."""
    assert data != GOOD
    assert refuse(tmp_path, data).startswith(
        ("is truncated or damaged", "holds an array of objects, or one of ")
    )


def test_sizes_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(evtouch, "MAX_FILE_BYTES", len(GOOD) - 1)
    assert refuse(tmp_path, GOOD) == f"more than {len(GOOD) - 1} bytes, the limit of a recording; split it"
    monkeypatch.setattr(evtouch, "MAX_FILE_BYTES", len(GOOD))
    assert load_data(tmp_path / "data.zip").files == (SAMPLE,)
    files = {f"test/sample_{n}_label_0.npy": GOOD for n in range(3)}
    monkeypatch.setattr(evtouch, "MAX_TOTAL_BYTES", 89)
    assert (
        message(folder(tmp_path / "three", files))
        == "three: recordings of 90 bytes, limit 89; split the data set"
    )
    monkeypatch.setattr(evtouch, "MAX_TOTAL_BYTES", 3 * len(GOOD) - 1)
    assert f"recordings of {3 * len(GOOD)} bytes, limit" in message(archive(tmp_path / "three.zip", files))


@pytest.mark.parametrize("size", [64, 128])
def test_a_bomb_is_read_no_further_than_it_announces(tmp_path, size):
    path = archive(tmp_path / "bomb.zip", {f"test/{SAMPLE}": GOOD + bytes(16 << 20)})
    data = bytearray(path.read_bytes())
    local, central = data.index(b"PK\x03\x04"), data.index(b"PK\x01\x02")
    data[local + 22 : local + 26] = data[central + 24 : central + 28] = struct.pack("<I", size)
    path.write_bytes(data)
    assert message(path).startswith(f"bomb.zip: test/{SAMPLE}: ")


def made(lengths=None, *, samples=3, steps=10):
    return Recordings(
        held=events(samples=samples, steps=steps),
        labels=np.arange(samples),
        files=tuple("abcdefgh"[:samples]),
        split="test",
        source="made",
        lengths=lengths,
    )


def test_whole_steps_and_one_at_least():
    whole = made()
    for percent, steps in ((1, 1), (10, 1), (19, 1), (20, 2), (25, 2), (50, 5), (99, 9)):
        found = first_part(whole, percent)
        assert found.lengths is None
        assert_array_equal(found.events, whole.events[..., :steps])
        assert (found.files, found.labels.tolist()) == (whole.files, whole.labels.tolist())
    assert first_part(whole, 100) is whole


def test_every_recording_keeps_its_part_of_its_own_length():
    whole = made(np.array([10, 5, 1]))
    assert whole.events[1, ..., 2:5].any()
    found = first_part(whole, 50)
    assert found.lengths.tolist() == [5, 2, 1]
    assert found.steps == 5
    for index, steps in enumerate(
        (5, 2, 1)
    ):  # what is behind a part is silence: bins that are joined may reach there
        assert_array_equal(found.events[index, ..., :steps], whole.events[index, ..., :steps])
        assert not found.events[index, ..., steps:].any()


@pytest.mark.parametrize(("words", "percent"), [("1%", 1), ("50", 50), (" 100% ", 100)])
def test_whole_per_cent(words, percent):
    assert parse_window(words) == percent


@pytest.mark.parametrize("words", ["0", "0%", "101%", "-5%", "12.5%", "half", "", "٣%", "50%%", "1000"])
def test_what_is_no_part(words):
    with pytest.raises(OptionError, match=r"give whole per cent from 1% to 100%$"):
        parse_window(words)
