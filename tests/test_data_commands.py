import argparse
import hashlib
import struct
import zipfile

import numpy as np
import pytest

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings import fetch
from spikeloom.models.recordings.counts import show_counts
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.fetch import DataSet
from spikeloom.models.recordings.grasps import synthetic_split
from spikeloom.models.recordings.release import write_event_lines, write_released
from spikeloom.runtime.commands.exchange.data import add_arguments
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal


def start(*words):
    """Report, text and exit code of a command."""
    parser = argparse.ArgumentParser(prog="spikeloom")
    add_arguments(parser)
    arguments = parser.parse_args(list(map(str, words)))
    outcome = arguments.action(arguments)
    return encode(outcome.result), terminal(outcome.sections(outcome.result)), outcome.code


def message(*words, error=DataError) -> str:
    with pytest.raises(error) as caught:
        start(*words)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Recordings of a sensor with four taxels, the last of them dead."""
    monkeypatch.chdir(tmp_path)
    files = {
        "own/train/a_label_0.csv": "time_s,taxel,polarity\n0,0,1\n0.03,1,-1\n0.01,2,1\n0.031,1,-1\n0.7,0,1\n",
        "own/train/b_label_1.csv": "0,0,1\n0.5,2,1\n",
        "own/test/c_label_1.csv": "0,0,1\n0.1,1,0\n",
        "coords.csv": "x,y\n0,0\n4,0\n0,4\n4,4\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


# describe


def test_describe(own):
    report, text, code = start("describe", "own", "--split", "train", "--taxels", "coords.csv")
    assert code == 0
    assert text == "\n".join(
        [
            "own, train: 2 recordings, 4 taxels, 0.52 … 0.72 s (median 0.62 s) in bins of 0.02 s",
            "  labels: 2 classes, 1 recording each",
            "  events: 6 after binning; 0.8 falling and 4.0 rising per second",
            "  found: 7 events read, 1 out of order, 1 duplicate in a bin, 1 gap over 0.5 s, "
            "1 recording shorter than the longest",
            "  dead taxels: 3 (no event in any of these recordings)",
            "  one-sided taxels: 0, 1, 2 (events of one polarity only)",
            "  hot taxels: none (more than 5 times the median rate of the taxels that are not dead)",
            "",
            "  taxel  falling/s  rising/s      looks",
            "  0           0.00      2.42  one-sided",
            "  1           0.81      0.00  one-sided",
            "  2           0.00      1.61  one-sided",
            "  3           0.00      0.00       dead",
        ]
    )
    assert report["found"] == {
        "events": 7,
        "out_of_order": 1,
        "duplicates": 1,
        "gaps": 1,
        "gap_s": 0.5,
        "shorter": 1,
    }
    assert report["dead"] == [3]
    assert report["one_sided"] == [0, 1, 2]
    assert report["labels"] == {"0": 1, "1": 1}
    assert report["rate"]["taxels"][1] == {"falling": pytest.approx(1 / 1.24), "rising": 0.0}


def test_describe_one_recording_without_a_label(own):
    (own / "grasp.csv").write_text("0,0,1\n0.1,1,0\n0.1,1,1\n")
    report, text, _ = start("describe", "grasp.csv", "--bin", "0.05")
    assert text.splitlines()[:3] == [
        "grasp.csv, test: 1 recording, 2 taxels, 0.15 s in bins of 0.05 s",
        "  labels: none",
        "  events: 3 after binning; 6.7 falling and 13.3 rising per second",
    ]
    assert (report["labels"], report["unlabelled"]) == ({}, 1)
    (own / "own" / "test" / "d.csv").write_text("0,0,1\n")
    _, text, _ = start("describe", "own")
    assert text.splitlines()[1] == "  labels: 1 class, 1 recording each; 1 recording without"


def test_describe_synthetic_grasps():
    report, text, _ = start("describe", "synthetic")
    assert (report["recordings"], report["taxels"], report["found"]) == (144, 39, None)
    assert "found" not in text


def png_size(path):
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", data[16:24])


def test_pictures(own):
    _, text, _ = start("describe", "synthetic", "--picture", "map.png")
    assert "  picture: map.png" in text.splitlines()
    assert png_size(own / "map.png") == (1650, 810)
    start("describe", "own", "--taxels", "coords.csv", "--picture", "own.png")
    assert png_size(own / "own.png") == (1650, 810)
    start("describe", "own", "--taxels", "4", "--picture", "plain.png")
    start("describe", "own", "--taxels", "4", "--picture", "again.png")
    assert png_size(own / "plain.png") == (1050, 810)
    assert (own / "again.png").read_bytes() == (own / "plain.png").read_bytes()


@pytest.mark.parametrize(
    ("rows", "taxels", "coords"),
    [
        ("0,0,1\n", "1", "0,0\n"),  # a sensor of one taxel, a recording of one bin
        ("".join(f"{i / 999},{i % 2},{i % 3 % 2}\n" for i in range(999)), "2", "0,0,1\n0,0,2\n"),  # one above the other
        ("0,0,1\n" * 3 + "".join(f"{i / 50},7,1\n" for i in range(50)), "9", "".join(f"{i},0\n" for i in range(9))),
    ],
)
def test_pictures_of_odd_sensors(own, rows, taxels, coords):
    (own / "odd $x_$ é\n.csv").write_text(rows)
    (own / "coords.csv").write_text(coords)
    start("describe", "odd $x_$ é\n.csv", "--taxels", "coords.csv", "--picture", "odd.png")
    assert png_size(own / "odd.png") == (1650, 810)
    start("describe", "odd $x_$ é\n.csv", "--taxels", taxels, "--bin", "0.0001", "--picture", "odd.png")
    assert png_size(own / "odd.png") == (1050, 810)


def test_pictures_have_a_place(own):
    for name, words in (("own.svg", "allowed is a PNG"), ("no/own.png", "the folder does not exist")):
        assert f"--picture {name}: {words}" in message("describe", "own", "--picture", name, error=OptionError)


# convert


@pytest.mark.parametrize("output", ["out", "out.zip"])
def test_convert(own, output):
    report, text, code = start("convert", "own", "-o", output)
    assert code == 0
    assert text == "\n".join(
        [
            f"{output}: 3 taxels, 36 bins",
            "  test: 1 recording",
            "    found: 2 events read, 0 out of order, 0 duplicates in a bin, 0 gaps over 0.5 s, "
            "1 recording padded at the end",
            "  train: 2 recordings",
            "    found: 7 events read, 1 out of order, 1 duplicate in a bin, 1 gap over 0.5 s, "
            "1 recording padded at the end",
            "  names: sources.csv in it says which recording became which",
        ]
    )
    assert report["splits"]["test"]["found"]["padded"] == 1
    for split in ("train", "test"):
        made = load_data(own / output, split)
        counts = made.counts
        before = load_data(own / "own", split, taxels=3)
        assert counts is None
        assert made.events.shape[1:] == (3, 2, 36)
        assert np.array_equal(made.events[..., : before.steps], before.events)
        assert made.events.sum() == before.events.sum()
        assert made.labels.tolist() == before.labels.tolist()
    if output == "out":
        assert (own / "out" / "sources.csv").read_text() == (
            "split,file,source\n"
            "test,sample_0_label_1.npy,c_label_1.csv\n"
            "train,sample_0_label_0.npy,a_label_0.csv\n"
            "train,sample_1_label_1.npy,b_label_1.csv\n"
        )
        values = np.load(own / "out" / "train" / "sample_0_label_0.npy")
        assert (values.dtype, values.shape) == (np.float32, (3, 2, 36))


def test_convert_to_more_taxels_and_other_bins(own):
    report, _, _ = start("convert", "own", "-o", "out", "--taxels", "coords.csv", "--bin", "0.1")
    assert (report["taxels"], report["steps"]) == (4, 7 + 1)


@pytest.mark.parametrize("split", ["train", "test"])
def test_convert_to_joined_bins(own, split):
    start("convert", "own", "-o", "fine.zip")
    report, _, _ = start("convert", "fine.zip", "-o", "coarse.zip", "--join", "10")
    fine, coarse = (load_data(own / f"{name}.zip", split).events for name in ("fine", "coarse"))
    assert (fine.shape[3], coarse.shape[3], report["steps"]) == (36, 4, 4)
    for bin_ in range(4):
        np.testing.assert_array_equal(coarse[..., bin_], fine[..., 10 * bin_ : 10 * bin_ + 10].any(axis=3))
    assert coarse.any()


def test_convert_one_recording_to_lines_of_joined_bins(own):
    (own / "one.csv").write_text("time_s,taxel,polarity\n0.01,1,1\n0.03,1,1\n0.05,0,0\n")
    start("convert", "one.csv", "-o", "lines.csv", "--join", "2")
    assert (own / "lines.csv").read_text() == "time_s,taxel,polarity\n0.02,1,1\n0.06,0,0\n"


def test_convert_what_is_converted(own):
    start("convert", "own", "-o", "out.zip")
    start("convert", "out.zip", "-o", "again.zip")
    start("convert", "again.zip", "-o", "third.zip")
    assert (own / "third.zip").read_bytes() == (own / "again.zip").read_bytes()
    with zipfile.ZipFile("out.zip") as once, zipfile.ZipFile("again.zip") as twice:
        assert once.namelist() == twice.namelist()
        assert all(once.read(name) == twice.read(name) for name in once.namelist() if name.endswith(".npy"))


def test_convert_synthetic_grasps_on_the_sensor_that_is_given(own):
    (own / "coords.csv").write_text("x,y\n" + "".join(f"{3 * i},{3 * j}\n" for j in range(3) for i in range(3)))
    report, _, _ = start("convert", "synthetic", "--taxels", "coords.csv", "-o", "grasps")
    assert report["taxels"] == 9
    assert {split: made["recordings"] for split, made in report["splits"].items()} == {"train": 360, "test": 144}
    assert load_data(own / "grasps", "test").events.shape == (144, 9, 2, 100)


@pytest.mark.parametrize(
    ("words", "error", "told"),
    [
        (("a.csv", "-o", "out"), DataError, "a.csv: no label, the released layout needs one"),
        (("own", "-o", "out.zip"), DataError, "own: train/c.csv: line 2: polarity is 'up'"),
        (("own", "-o", "coords.csv", "--bin", "nan"), OptionError, "--bin nan: not a duration"),
        (("own", "-o", "out", "--join", "0"), OptionError, "--join 0: allowed are 1 to 1000000"),
    ],
)
def test_convert_mistakes(own, words, error, told):
    (own / "a.csv").write_text("0,0,1\n")
    (own / "own" / "train" / "c.csv").write_text("0,0,1\n0,0,up\n")
    assert told in message("convert", *words, error=error)
    assert sorted(path.name for path in own.iterdir()) == ["a.csv", "coords.csv", "own"]


# fetch


def test_fetch(monkeypatch, tmp_path):
    content = b"recordings"
    made = DataSet(file="Ev-Objects.zip", url="http://localhost/x", size=10, sha256=hashlib.sha256(content).hexdigest())
    monkeypatch.setitem(fetch.DATA_SETS, "objects", made)
    monkeypatch.setenv("SPIKELOOM_DATA", str(tmp_path / "data"))
    for folder in ("data", "other"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "Ev-Objects.zip").write_bytes(content)
    report, text, code = start("fetch", "objects")
    path = tmp_path / "data" / "Ev-Objects.zip"
    assert (code, report["new"], report["path"], report["data"]) == (0, False, str(path), "objects")
    assert text == f"objects: already there, 10 bytes, sha256 as released\n  {path}\n  use it with --data objects"
    other = tmp_path / "other" / "Ev-Objects.zip"
    assert start("fetch", "objects", "--dir", other.parent)[1].endswith(f"use it with --data {other}")


# For the other commands


def test_counts_on_stderr(own, capsys):
    for path in ("own", "out"):
        recordings = load_data(own / path, "train")
        counts = recordings.counts
        show_counts(recordings.source, counts)
        if path == "own":
            start("convert", "own", "-o", "out")
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err == (
        "own: 7 events read, 1 out of order, 1 duplicate in a bin, 1 gap over 0.5 s, "
        "1 recording shorter than the longest\n"
    )


def test_matplotlib_is_loaded_for_pictures_only():
    import subprocess
    import sys

    code = (
        "import sys, spikeloom.runtime.commands.exchange.data, spikeloom.runtime.commands.exchange.data_picture\n"
        "assert not {'matplotlib', 'torch'} & set(sys.modules), 'loaded early'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_one_recording_becomes_event_lines_that_read_back_the_same(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    grasps = synthetic_split("test", limit=2)
    write_released(tmp_path / "two", [grasps])
    source = sorted((tmp_path / "two" / "test").iterdir())[1]
    report, _, code = start("convert", str(source), "-o", "one.csv")
    assert code == 0
    assert report["splits"]["test"]["recordings"] == 1
    lines = (tmp_path / "one.csv").read_text().splitlines()
    assert lines[0] == "time_s,taxel,polarity"
    assert len(lines) - 1 == int(grasps.events[1].sum())
    back = load_data(tmp_path / "one.csv", taxels=39)
    steps = back.steps
    assert np.array_equal(back.events[0], grasps.events[1][:, :, :steps])
    assert not grasps.events[1][:, :, steps:].any()


def test_event_lines_hold_one_recording(tmp_path):
    with pytest.raises(DataError) as refused:
        write_event_lines("x.csv", [synthetic_split("test", limit=3)], 0.02)
    assert str(refused.value) == (
        "-o x.csv: 3 recordings, a .csv holds one; give one recording, or a folder or zip to -o"
    )
