import dataclasses
import os
import pickle
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings import evtouch, stored
from spikeloom.models.recordings.conditions import conditions
from spikeloom.models.recordings.counts import GAP_S
from spikeloom.models.recordings.eventfiles import EventStream, read_stream
from spikeloom.models.recordings.events import (
    MAX_STEPS,
    bin_events,
    data_splits,
    joined_bins,
    load_data,
    need_labels,
    of_length,
)
from spikeloom.models.recordings.evtouch import BIN_S, UNLABELLED, Recordings, first_part
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.recordings.release import write_event_lines, write_released
from spikeloom.runtime.studies.datasets import describe

HEADER = "time_s,taxel,polarity\n"


@pytest.fixture
def save(tmp_path):
    def save(name: str, **arrays) -> Path:
        path = tmp_path / name
        np.savez(path, **arrays)
        return path

    return save


message = partial(refused, DataError, "")


def made(events, **changes) -> Recordings:
    """Recordings of these events in the test split."""
    known = {
        "labels": np.arange(len(events)),
        "files": tuple("abcdefghijklmnop"[: len(events)]),
        "split": "test",
    }
    return Recordings(held=np.asarray(events, np.uint8), source="made", **known | changes)


def one(path, **options):
    """Events of one recording as (taxel, polarity, bin), and the counts."""
    recordings = load_data(path, **options)
    return np.argwhere(recordings.events[0]).tolist(), recordings.counts


@pytest.mark.parametrize("bin_s", ["0.02", "0.001", "0.1", "0.03", "0.7", "1"])
def test_decimal_times_on_an_edge_begin_their_bin(write, bin_s):
    from decimal import Decimal

    steps = [*range(0, 2000, 7), MAX_STEPS - 1]
    text = "".join(f"{Decimal(bin_s) * step},0,1\n" for step in steps)
    stream = read_stream(write("a.csv", text))
    grid, counts = bin_events(stream, float(bin_s))
    assert np.flatnonzero(grid[0, 1]).tolist() == steps
    assert counts.duplicates == 0


def test_what_is_odd_is_counted(write):
    rows = "0.00,0,1\n0.30,0,1\n0.10,1,0\n0.31,0,1\n0.305,0,1\n0.31,1,1\n0.25,1,1\n0.8001,0,0\n1.3,0,0\n1.81,0,0\n"
    found, counts = one(write("a.csv", HEADER + rows))
    assert (counts.events, counts.out_of_order, counts.duplicates, counts.gaps) == (10, 3, 2, 1)
    assert len(found) == 8
    assert GAP_S == 0.5  # 0.31 to 0.8001 and on to 1.3 are shorter, 1.3 to 1.81 is longer


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("0,0,1\nnan,0,1\n", "a.csv: line 3: time nan s, allowed are finite times from 0"),
        ("inf,0,1\n", "a.csv: line 2: time inf s, allowed are finite times from 0"),
        ("1600000000,0,1\n", "a.csv: line 2: time 1.6e+09 s is past 1000000 bins of 0.02 s"),
        ("0,0,1\n0,39,1\n", "a.csv: line 3: taxel 39, allowed are whole numbers 0..38; count from 0"),
        ("0,1.5,1\n", "a.csv: line 2: taxel 1.5, allowed are whole numbers 0..38"),
        ("0,0,1\n0,0,2\n", "a.csv: line 3: polarity 2, allowed are 0 and 1, or -1 and 1"),
        (
            "0,0,1\n0,0,0\n0,0,-1\n",
            "a.csv: polarities -1 and 0 in one file, allowed are 0 and 1, or -1 and 1",
        ),
        ("0,0,up\n", "a.csv: line 2: polarity is 'up', not a number"),
    ],
)
def test_events_that_cannot_be(write, rows, words):
    path = write("a.csv", HEADER + rows)
    assert message(load_data, path, taxels=39).startswith(words)
    assert message(load_data, path.parent, taxels=39).startswith(f"{path.parent.name}: {words}")


def test_taxels_and_bins_have_limits(write):
    assert "taxel 4096, allowed are whole numbers 0..4095" in refused(
        DataError, "", load_data, write("a.csv", "0,4096,1\n")
    )
    path = write("a.csv", "1,0,1\n")
    assert "time 1 s is past 1000000 bins of 4.94066e-324 s" in message(load_data, path, bin_s=5e-324)
    for bin_s in (0.0, -0.02, float("nan"), float("inf")):
        assert f"--bin {bin_s:g}: not a duration" in refused(OptionError, "", load_data, path, bin_s=bin_s)


@pytest.mark.parametrize(
    ("name", "text", "label"),
    [
        ("a.csv", "time_s,taxel,polarity,label\n0,0,1,4\n0.1,0,1,4\n", 4),
        ("a.csv", "0,0,1,4\n0.1,0,1,4\n", 4),
        ("sample_3_label_17.csv", "0,0,1\n", 17),
        ("grasp_label_2.csv", "0,0,1,2\n", 2),
        ("a.csv", "0,0,1\n", UNLABELLED),
        ("label_2.csv", "0,0,1\n", UNLABELLED),
    ],
)
def test_labels(write, name, text, label):
    recordings = load_data(write(name, text))
    assert recordings.labels.tolist() == [label]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "0,0,1,4\n0,0,1,5\n", "a.csv: labels 4 and 5 in one file, allowed is one"),
        ("a_label_3.csv", "0,0,1,4\n", "a_label_3.csv: label 4 in the file and 3 in its name"),
        ("a.csv", "0,0,1,-1\n", "a.csv: label -1, allowed are whole numbers 0..999999"),
        ("a.csv", "0,0,1,6\n", "a.csv: label 6, the network has 6 classes (0..5)"),
    ],
)
def test_labels_that_cannot_be(write, name, text, words):
    assert message(load_data, write(name, text), classes=6).startswith(words)


def test_who_needs_labels_says_so(write):
    write("d/a_label_1.csv", "0,0,1\n")
    recordings = load_data(write("d/b.csv", "0,0,1\n").parent)
    assert recordings.labels.tolist() == [1, UNLABELLED]
    assert message(need_labels, recordings, "training") == (
        "d: b.csv: no label, training needs one for every recording; "
        "add a label column, name the file like grasp_7_label_3.csv, or list it with its label in recordings.csv"
    )
    recordings = load_data(write("d/b.csv", "0,0,1,1\n").parent)
    assert need_labels(recordings, "training") is recordings


@pytest.mark.parametrize("dtype", ["f8", "f4", "i4", ">i2", "u1"])
def test_npz(save, dtype):
    path = save(
        "a.npz", time_s=np.array([0.5, 0.1]), taxel=np.array([2, 0], dtype), polarity=np.array([1, 0], dtype)
    )
    found, counts = one(path)
    assert found == [[0, 0, 5], [2, 1, 25]]
    assert counts.out_of_order == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"polarity": None}, "a.npz: holds taxel, time_s, without polarity"),
        (
            {"taxel": [0, 1]},
            "a.npz: shapes time_s (1,), taxel (2,), polarity (1,), allowed is one number per event",
        ),
        ({"time_s": [[0.1]], "taxel": [[0]], "polarity": [[1]]}, "a.npz: shapes time_s (1, 1)"),
        ({"polarity": ["up"]}, "a.npz: polarity: dtype '<U2', allowed are numbers"),
        ({"taxel": np.array([0], dtype=object)}, "a.npz: taxel: holds an array of objects"),
        ({"time_s": [-1]}, "a.npz: event 0: time -1 s, allowed are finite times from 0"),
    ],
)
def test_npz_that_cannot_be(save, change, words):
    arrays = {"time_s": [0.1], "taxel": [0], "polarity": [1]} | change
    path = save("a.npz", **{name: array for name, array in arrays.items() if array is not None})
    assert message(load_data, path).startswith(words)


def test_flat_folders_stand_for_any_split(write, save, tmp_path):
    write("d/b_label_1.csv", "0.1,1,1\n")
    write("d/a_label_0.CSV", "0.5,0,0\n")
    write("d/.hidden.csv", "no")
    write("d/notes.txt", "no")
    save("d/c.npz", time_s=[0.0], taxel=[0], polarity=[0], label=2)
    np.save(tmp_path / "d" / "sample_4_label_5.npy", np.ones((2, 2, 3), dtype=np.float32))
    for split in ("train", "test", "third"):
        recordings = load_data(tmp_path / "d", split)
        assert recordings.files == ("a_label_0.CSV", "b_label_1.csv", "c.npz", "sample_4_label_5.npy")
        assert recordings.labels.tolist() == [0, 1, 2, 5]
        assert recordings.split == split
        assert recordings.events.shape == (4, 2, 2, 26)
        assert recordings.step_counts.tolist() == [26, 6, 1, 3]
        assert (recordings.counts.events, recordings.counts.shorter) == (3 + 12, 3)
        assert recordings.events[3].sum(axis=(0, 1)).tolist() == [4] * 3 + [0] * 23  # padded at the end
    assert data_splits(tmp_path / "d") == ()
    first = load_data(tmp_path / "d", limit=2, taxels=7)
    assert first.events.shape == (2, 7, 2, 26)
    assert first.counts.shorter == 1


def test_folders_with_splits(write, tmp_path):
    write("d/train/a_label_0.csv", "0.1,1,1\n")
    write("d/test/b_label_1.csv", "0.3,0,1\n")
    write("d/coords.csv", "0,0\n1,1\n")  # beside the splits anything may lie
    assert load_data(tmp_path / "d", "train").files == ("a_label_0.csv",)
    assert load_data(tmp_path / "d", "test").labels.tolist() == [1]
    assert data_splits(tmp_path / "d") == ("test", "train")
    assert message(load_data, tmp_path / "d", "dev") == (
        "d: split 'dev' is missing or empty; splits with recordings: test, train"
    )
    assert load_data(tmp_path / "d" / "train").files == ("a_label_0.csv",)


def test_a_label_does_not_depend_on_what_else_is_read(write):
    for name in ("train/a_label_oak", "train/b_label_cork", "test/c_label_oak"):
        write(f"d/{name}.csv", HEADER + "0,0,1\n")
    folder = write("d/test/d_label_ball.csv", HEADER + "0,0,1\n").parent.parent
    assert load_data(folder, "train").labels.tolist() == [2, 1]
    assert load_data(folder, "test").labels.tolist() == [2, 0]
    assert load_data(folder, "test", limit=1).labels.tolist() == [2]
    names = ("ball", "cork", "oak", "3")
    assert [load_data(folder, "test").class_name(label) for label in range(4)] == [*names]


def test_one_released_recording(tmp_path):
    grasps = synthetic_grasps(per_class=1, steps=40, seed=0)
    np.save(tmp_path / "sample_0_label_3.npy", grasps.events[3].astype(np.float32))
    np.save(tmp_path / "grasp.npy", grasps.events[3])
    for name, label in (("sample_0_label_3.npy", 3), ("grasp.npy", UNLABELLED)):
        recordings = load_data(tmp_path / name, taxels=39, classes=6)
        counts = recordings.counts
        assert np.array_equal(recordings.events, grasps.events[3:4])
        assert recordings.labels.tolist() == [label]
        assert (counts.events, counts.duplicates, recordings.steps) == (grasps.events[3].sum(), 0, 40)
    said = refused(OptionError, "", load_data, tmp_path / "grasp.npy", bin_s=0.05)
    assert said == (
        "--bin 0.05: grasp.npy holds bins, of 0.02 s as nothing says it: write it to bins.npy; "
        "give a multiple of that, or omit --bin"
    )
    np.save(tmp_path / "bad.npy", np.full((3, 2, 4), 0.5))
    assert message(load_data, tmp_path / "bad.npy") == (
        "bad.npy: value 0.5 at taxel 0, polarity 0, step 0, allowed are 0 and 1; recordings are events, not pressures"
    )


def test_silence_in_bins_is_a_gap(tmp_path):
    grid = np.zeros((1, 2, 100), dtype=np.uint8)
    grid[0, 0, [0, 26, 53]] = 1  # 25 empty bins are half a second, 26 are more
    np.save(tmp_path / "a.npy", grid)
    assert load_data(tmp_path / "a.npy").counts.gaps == 1


def test_the_released_layout_goes_its_own_way(tmp_path):
    grasps = synthetic_grasps(per_class=2, steps=30, seed=1)
    split = grasps.part(slice(None), "test")
    for name in ("d", "d.zip", "again.zip"):
        write_released(tmp_path / name, [split])
        recordings = load_data(tmp_path / name, classes=6, taxels=39)
        assert recordings.counts is None
        assert np.array_equal(recordings.events, grasps.events)
        assert recordings.files == tuple(f"sample_{i:02}_label_{i % 6}.npy" for i in range(12))
        assert data_splits(tmp_path / name) == ("test",)
    assert (tmp_path / "d.zip").read_bytes() == (tmp_path / "again.zip").read_bytes()


@settings(max_examples=60)
@given(data=st.data())
def test_any_recording_survives_as_events(tmp_path, data):
    """Bins to event lines, in any order and with repeats, and back."""
    taxels, steps = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 60))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    grid = rng.random((taxels, 2, steps)) < data.draw(st.sampled_from([0.02, 0.3, 0.9]))
    grid[0, 0, 0] = grid[-1, 0, -1] = True
    found = np.argwhere(grid)
    rows = np.concatenate([found, found[: len(found) // 2]])
    rng.shuffle(rows)
    inside = rng.random(len(rows)) * rng.integers(0, 2) * 0.0199
    falling = data.draw(st.sampled_from([0, -1]))
    text = "".join(
        f"{step * BIN_S + late:.6f},{taxel},{polarity or falling}\n"
        for (taxel, polarity, step), late in zip(rows.tolist(), inside.tolist(), strict=True)
    )
    (tmp_path / "a.csv").write_text(text)
    recordings = load_data(tmp_path / "a.csv")
    counts = recordings.counts
    assert np.array_equal(recordings.events[0], grid)
    assert (counts.events, counts.duplicates) == (len(rows), len(found) // 2)


def test_hot_taxels_exceed_five_times_the_median_and_silence_is_dead():
    grid = np.zeros((1, 6, 2, 100), dtype=np.uint8)
    grid[0, :3, :, :5] = 1
    grid[0, 3, :, :25] = 1
    grid[0, 4, :, :26] = 1  # taxel 5 is dead and does not lower the median
    found = describe(made(grid))
    assert (found.dead, found.hot) == ((5,), (4,))
    found = describe(made(np.zeros((1, 3, 2, 4))))
    assert (found.dead, found.hot, found.events) == ((0, 1, 2), (), 0)


def test_the_table_of_sources_holds_no_formula(tmp_path):
    write_released(tmp_path / "out", [made(np.ones((1, 2, 2, 3)), files=("=1+1.csv",))])
    assert (tmp_path / "out" / "sources.csv").read_text().endswith(",'=1+1.csv\n")
    write_released(tmp_path / "numbers", [made(np.ones((1, 2, 2, 3)), groups={"angle": ("-5",)})])
    assert (tmp_path / "numbers" / "recordings.csv").read_text().endswith(",-5\n")


def test_writing_is_all_or_nothing(tmp_path, monkeypatch):
    grasps = synthetic_grasps(per_class=1, steps=20, seed=1)
    calls = []
    original = np.lib.format.write_array

    def breaks(*arguments, **options):
        calls.append(1)
        if len(calls) == 4:
            raise OSError(28, "No space left on device")
        original(*arguments, **options)

    monkeypatch.setattr(np.lib.format, "write_array", breaks)
    for name in ("d", "d.zip"):
        calls.clear()
        refused(OSError, "No space left on device", write_released, tmp_path / name, [grasps])
    assert list(tmp_path.iterdir()) == []


def warned(path, **options) -> tuple[str, ...]:
    return load_data(path, **options).counts.notes


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_times_in_another_unit_are_noticed(write, factor):
    rows = [f"{int(0.005 * factor * i)},{i % 3},1" for i in range(400)]
    path = write("odd/a.csv", "\n".join([HEADER.strip(), *rows]))
    write("odd/b.csv", path.read_text())
    write("odd/c.csv", "0,0,1\n0.7,1,1\n60,2,1\n")
    if factor <= 1e3:
        note = "times up to 1995 s with less than an event a second; write seconds"
        assert warned(path.parent) == (f"odd: a.csv (and 1 more): {note}",)
    else:
        assert message(load_data, path) == (
            f"a.csv: line 401: time {1.995 * factor:g} s is past 1000000 bins of 0.02 s, the limit of a recording; "
            "write seconds"
        )


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 600), st.integers(1, 2000))
def test_a_touch_of_several_events_a_second_is_never_taken_for_another_unit(seed, duration, count):
    times = np.random.default_rng(seed).random(max(count, int(4 * duration))) * duration
    nothing = np.zeros(len(times), np.int64)
    stream = EventStream(name="a", time_s=times, taxel=nothing, polarity=nothing, label=0, at=str)
    assert bin_events(stream)[1].notes == ()


def test_times_that_do_not_count_from_the_start_are_noticed(write):
    write("late/a.csv", f"{HEADER}100,0,1\n100.7,1,1\n")
    note = "events begin at 100 s; count times from the start of the recording"
    assert warned(write("late/b.csv", f"{HEADER}4,0,1\n").parent) == (f"late: a.csv: {note}",)


def test_a_silent_recording_is_a_recording(write, tmp_path):
    for index, last in enumerate((0.09, 0.19, 0.39)):
        write(f"own/a{index}_label_0.csv", f"{HEADER}0,0,1\n{last},1,1\n")
    write("own/b_label_1.csv", HEADER)
    np.savez(tmp_path / "own/c_label_2.npz", time_s=[], taxel=[], polarity=[])
    recordings = load_data(tmp_path / "own")
    assert recordings.step_counts.tolist() == [5, 10, 20, 10, 10]
    assert recordings.labels.tolist() == [0, 0, 0, 1, 2]
    assert not recordings.events[3:].any()
    assert recordings.counts.notes == ("own: 2 recordings without events: taken as long as the others",)


def test_recordings_that_are_all_silent(write):
    path = write("own/b.csv", HEADER)
    assert message(load_data, path) == "b.csv: no events in any recording; check how they were written"


def test_arrays_of_unequal_length(tmp_path):
    (tmp_path / "own/test").mkdir(parents=True)
    for index, steps in enumerate((4, 6)):
        np.save(tmp_path / f"own/test/sample_{index}_label_{index}.npy", np.ones((2, 2, steps), np.uint8))
    recordings = load_data(tmp_path / "own")
    assert recordings.step_counts.tolist() == [4, 6]
    assert recordings.events.sum(axis=(1, 2, 3)).tolist() == [16, 24]


def test_taxels_that_count_from_one(write):
    rows = "".join(f"0.{i},{i},1\n" for i in range(1, 6))
    path = write("one/a.csv", HEADER + rows)
    note = "one: no event at taxel 0, some at each of 1..5: if these count from 1, count from 0"
    assert warned(path.parent) == (note,)
    assert message(load_data, path, taxels=5) == (
        "a.csv: line 6: taxel 5, allowed are whole numbers 0..4; count from 0, they seem to count from 1"
    )
    assert warned(path, taxels=6) == ()
    write("one/b.csv", HEADER + "0,0,1\n")
    assert warned(path.parent) == ()


@pytest.fixture
def listed(write):
    write("own/a.csv", HEADER + "0,0,1\n")
    write("own/b_label_2.csv", HEADER + "0,1,1\n")
    write("own/c.csv", HEADER + "0,2,1\n")
    return write


def test_a_table_gives_labels(listed):
    folder = listed(
        "own/labels.csv", "File, weight ,LABEL\na.csv,3.5,7\n\nb_label_2.csv,,2\nother.csv,,1\n"
    ).parent
    recordings = load_data(folder)
    assert recordings.files == ("a.csv", "b_label_2.csv", "c.csv")
    assert recordings.labels.tolist() == [7, 2, UNLABELLED]
    assert recordings.counts.notes == (
        "own: labels.csv: describes 2 of 3 recordings",
        "own: 1 of 2 recordings have no weight: no condition",
    )


def test_a_table_names_classes_and_conditions(listed):
    rows = "a.csv,wood,10,left\nb_label_2.csv,cork,9,\nc.csv,cork,10,left\n"
    folder = listed("own/recordings.csv", f"file,label,speed,hand\n{rows}").parent
    (folder / "b_label_2.csv").rename(folder / "b.csv")
    (folder / "recordings.csv").write_text((folder / "recordings.csv").read_text().replace("b_label_2", "b"))
    recordings = load_data(folder)
    assert recordings.labels.tolist() == [1, 0, 0]  # in the order of their names
    assert recordings.groups == {"speed": ("10", "9", "10")}  # not every recording has a hand
    found = conditions(recordings.part([0, 1]))
    assert {name: held.tolist() for name, held in found["speed"].items()} == {
        "speed=9": [False, True],
        "speed=10": [True, False],
    }
    assert conditions(recordings.part([0, 2])) == {}
    line = (
        "own: b.csv: has no hand; --groups names columns of recordings.csv, or fields of file names as in "
    )
    assert message(load_data, folder, groups=["hand"]) == f"{line}hand3_label_7.csv"


def test_conditions_in_file_names(write):
    for index in range(20):
        write(f"own/speed{index}_force0.5_label_1.csv", HEADER + "0,0,1\n")
    recordings = load_data(tmp := write("own/speed3_force1.0_label_1.csv", HEADER + "0,0,1\n").parent)
    assert recordings.groups == {}
    recordings = load_data(tmp, groups=["force", "speed"])
    found = conditions(recordings)
    assert list(found["force"]) == ["force=0.5", "force=1.0"]
    assert [int(held.sum()) for held in found["speed"].values()] == [
        4,
        4,
        4,
        5,
        4,
    ]  # many are dealt into parts
    assert sum(held.astype(int) for held in found["speed"].values()).tolist() == [1] * 21


def test_a_table_above_the_splits(write):
    for split in ("train", "test"):
        write(f"own/{split}/a.csv", HEADER + "0,0,1\n")
    folder = write("own/Labels.csv", "name,class\ntrain/a.csv,1\ntest/a.csv,0\n").parent
    assert load_data(folder, "train").labels.tolist() == [1]
    assert load_data(folder, "test").labels.tolist() == [0]
    assert data_splits(folder) == ("test", "train")


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        ("b_label_2.csv,3\n", "own: b_label_2.csv: label 2, and 3 in its table; fix one of them"),
        (
            "a.csv,x\nc.csv,-1\n",
            "own: labels.csv: row 3: label '-1'; give numbers from 0, or names, in all rows",
        ),
        ("a.csv,1\na.csv,2\n", "own: labels.csv: row 3: a.csv stands there twice; keep one of the rows"),
        ("a.csv\n", "own: labels.csv: row 2: ['a.csv']; give a file, and one value in each column"),
    ],
)
def test_a_table_that_cannot_be(listed, rows, line):
    assert message(load_data, listed("own/labels.csv", f"file,label\n{rows}").parent) == line


def test_any_number_of_polarities(tmp_path):
    """Arrays have as many as the sensor, all alike; event lines and rates by polarity are for two."""
    for number, polarities in enumerate((3, 3, 1)):
        np.save(tmp_path / f"sample_{number}_label_0.npy", np.ones((2, polarities, 4), np.uint8))
    assert load_data(tmp_path, limit=2).events.shape == (2, 2, 3, 4)
    refused(DataError, "shape (2, 1, 4), the recordings before it have (2, 3, 4)", load_data, tmp_path)
    refused(
        DataError,
        "has 3 polarities",
        write_event_lines,
        tmp_path / "lines.csv",
        [load_data(tmp_path, limit=1)],
        0.02,
    )


@pytest.mark.skipif(not hasattr(os, "pread"), reason="this system has no forked processes")
def test_reading_from_disk_moves_nothing_that_forked_processes_share(monkeypatch):
    monkeypatch.setattr(stored, "IN_MEMORY", 1)
    file = stored.EventFile()
    grids = [np.full((2, 2, steps), 1, np.uint8) for steps in (9, 20)]
    for grid in grids:
        file.append(grid)
    end = os.lseek(file._on_disk, 0, os.SEEK_CUR)
    for index, grid in enumerate(grids):
        assert_array_equal(file.read(index), grid)
    assert os.lseek(file._on_disk, 0, os.SEEK_CUR) == end


@pytest.mark.parametrize("in_memory", [1, 1 << 20])
def test_events_that_lie_in_a_file_are_those_of_an_array(tmp_path, monkeypatch, in_memory):
    monkeypatch.setattr(stored, "IN_MEMORY", in_memory)
    rng = np.random.default_rng(3)
    grids = [rng.random((5, 2, steps)) < 0.3 for steps in (9, 4, 7, 9)]
    for index, grid in enumerate(grids):
        np.save(tmp_path / f"sample_{index}_label_{index % 2}.npy", grid)
    data = load_data(tmp_path)
    events = np.zeros((4, 5, 2, 9), np.uint8)
    for target, grid in zip(events, grids, strict=True):
        target[..., : grid.shape[2]] = grid
    array = dataclasses.replace(data, held=events)
    again = pickle.loads(pickle.dumps(data))
    assert isinstance(data.held, stored.Stored)
    changes = {
        "none": lambda each: each,
        "bins": lambda each: joined_bins(each, 2),
        "part": lambda each: first_part(each, 50),
        "length": lambda each: of_length(each, 12),
        "all": lambda each: of_length(joined_bins(first_part(each, 70), 2), 3),
    }
    for change in changes.values():
        wanted, found = change(array), change(data)
        monkeypatch.setattr(evtouch, "PART_BYTES", wanted.held[:3].nbytes)
        assert [len(part) for part in found.parts()] == [3, 1]
        assert_array_equal(
            np.concatenate([part.events for part in found.parts()]), wanted.events, strict=True
        )
        assert_array_equal(found.events, wanted.events, strict=True)
        assert_array_equal(change(again).events, wanted.events, strict=True)
        assert_array_equal(found[::-2].events, wanted.events[::-2], strict=True)
        assert_array_equal(found[1][0], wanted[1][0], strict=True)
        assert found.sha256 == wanted.sha256
        assert_array_equal(found.step_counts, wanted.step_counts)
