import argparse
import hashlib
import io
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import requests
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings import fetch
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.fetch import DATA_SETS, DataSet, data_folder, fetch_data, find_data
from spikeloom.runtime.commands.exchange.data import add_arguments
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal


def start(*words):
    """Report, text and exit code of a command."""
    parser = argparse.ArgumentParser(prog="spikeloom")
    add_arguments(parser)
    arguments = parser.parse_args(list(map(str, words)))
    outcome = arguments.action(arguments.request.of(vars(arguments)))
    return encode(outcome.result), terminal(outcome.sections(outcome.result)), outcome.code


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


def test_describe(own):
    report, _, code = start("describe", "own", "--split", "train", "--taxels", "coords.csv")
    counted = {"events": 7, "out_of_order": 1, "duplicates": 1, "gaps": 1, "gap_s": 0.5, "shorter": 1}
    assert (code, report["found"]) == (0, counted)
    assert (report["recordings"], report["taxels"], report["events"], report["hot"]) == (2, 4, 6, [])
    assert (report["dead"], report["one_sided"], report["labels"]) == ([3], [0, 1, 2], {"0": 1, "1": 1})
    assert report["duration_s"] == {"shortest": 0.52, "median": 0.62, "longest": 0.72}
    rates = [(0, 3 / 1.24), (1 / 1.24, 0), (0, 2 / 1.24), (0, 0)]
    for found, (falling, rising) in zip(report["rate"]["taxels"], rates, strict=True):
        assert found == {"falling": pytest.approx(falling), "rising": pytest.approx(rising)}


def test_describe_one_recording_without_a_label(own):
    (own / "grasp.csv").write_text("0,0,1\n0.1,1,0\n0.1,1,1\n")
    report, _, _ = start("describe", "grasp.csv", "--bin", "0.05")
    assert (report["recordings"], report["events"], report["bin_s"]) == (1, 3, 0.05)
    assert (report["labels"], report["unlabelled"]) == ({}, 1)


@pytest.mark.parametrize("output", ["out", "out.zip"])
def test_convert(own, output):
    report, _, code = start("convert", "own", "-o", output)
    assert code == 0
    assert report["splits"]["test"]["found"]["shorter"] == 0
    for split in ("train", "test"):
        made = load_data(own / output, split)
        before = load_data(own / "own", split, taxels=3)
        assert made.counts is None
        assert (
            made.step_counts.tolist()
            == before.step_counts.tolist()
            == {"train": [36, 26], "test": [6]}[split]
        )
        assert_array_equal(made.events, before.events)
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
    bins = {"train": 4, "test": 1}[split]
    assert (fine.shape[3], coarse.shape[3], report["steps"]) == ({"train": 36, "test": 6}[split], bins, 4)
    for bin_ in range(bins):
        assert_array_equal(coarse[..., bin_], fine[..., 10 * bin_ : 10 * bin_ + 10].any(axis=3))
    assert coarse.any()


def test_convert_numbers_the_classes_of_all_splits_alike(own):
    for name, label in (("train/a", "oak wood"), ("train/b", "red ball"), ("test/a", "red ball")):
        path = own / "named" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"time_s,taxel,polarity,label\n0,0,1,{label}\n")
    start("convert", "named", "-o", "out")
    made = {file.relative_to("out").as_posix() for file in Path("out").rglob("sample*")}
    assert made == {"train/sample_0_label_0.npy", "train/sample_1_label_1.npy", "test/sample_0_label_1.npy"}
    path.write_text("time_s,taxel,polarity,label\n0,0,1,4\n")
    refused(DataError, "classes '4' and 'oak wood'; give numbers", start, "convert", "named", "-o", "mixed")


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
    (own / "coords.csv").write_text(
        "x,y\n" + "".join(f"{3 * i},{3 * j}\n" for j in range(3) for i in range(3))
    )
    report, _, _ = start("convert", "synthetic", "--taxels", "coords.csv", "-o", "grasps")
    assert report["taxels"] == 9
    assert {split: made["recordings"] for split, made in report["splits"].items()} == {
        "train": 360,
        "test": 144,
    }
    assert load_data(own / "grasps", "test").events.shape == (144, 9, 2, 100)


@pytest.mark.parametrize(
    ("words", "error", "told"),
    [
        (("a.csv", "-o", "out"), DataError, "a.csv: no label, the released layout needs one"),
        (("own", "-o", "out.zip"), DataError, "own: train/c.csv: line 2: polarity is 'up'"),
        (("own", "-o", "out", "--join", "0"), OptionError, "--join 0: allowed are 1 to 1000000"),
    ],
)
def test_convert_mistakes(own, words, error, told):
    (own / "a.csv").write_text("0,0,1\n")
    (own / "own" / "train" / "c.csv").write_text("0,0,1\n0,0,up\n")
    refused(error, told, start, "convert", *words)
    assert sorted(path.name for path in own.iterdir()) == ["a.csv", "coords.csv", "own"]


CONTENT = b"recordings" * 1000


@pytest.fixture
def server(monkeypatch, tmp_path):
    """Answers each request with the next status and body of its script, the last one for ever."""
    running = SimpleNamespace(script=[(200, CONTENT)], requests=0)

    def get(url, **_options):
        running.requests += 1
        answer = requests.Response()
        answer.url = url
        answer.status_code, body = running.script.pop(0) if len(running.script) > 1 else running.script[0]
        answer.raw = io.BytesIO(body)
        return answer

    monkeypatch.setattr("requests.get", get)
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setenv("SPIKELOOM_DATA", str(tmp_path / "data"))
    sha256 = hashlib.sha256(CONTENT).hexdigest()
    data = DataSet(file="Ev-Objects.zip", url="http://localhost/x.zip", size=len(CONTENT), sha256=sha256)
    monkeypatch.setitem(fetch.DATA_SETS, "objects", data)
    return running


def test_fetches_once_and_is_found(server, tmp_path):
    path = tmp_path / "data" / "Ev-Objects.zip"
    refused(
        DataError, "objects: not on this machine|run 'spikeloom data fetch objects'", find_data, "objects"
    )
    report, _, code = start("fetch", "objects")
    assert (code, report["new"], report["path"], report["data"]) == (0, True, str(path), "objects")
    assert path.read_bytes() == CONTENT
    assert (find_data("objects"), fetch_data("objects").new, server.requests) == (path, False, 1)
    path.unlink()
    assert start("fetch", "objects", "--url", DATA_SETS["objects"].url + "?mirror")[0]["path"] == str(path)
    assert path.read_bytes() == CONTENT


def test_tries_again(server):
    server.script = [(503, b"later"), (200, CONTENT[:99]), (200, CONTENT)]
    assert fetch_data("objects").path.read_bytes() == CONTENT
    assert server.requests == 3


@pytest.mark.parametrize(
    ("status", "body", "words"),
    [
        (404, b"nope", "cannot be fetched|404"),
        (200, b"<html>please log in</html>", "serves another file|sha256"),
        (200, bytes(len(CONTENT)), "serves another file"),
    ],
)
def test_other_content_is_never_kept(server, tmp_path, status, body, words):
    server.script = [(status, body)]
    refused(DataError, f"{DATA_SETS['objects'].url}|--url|{words}", fetch_data, "objects")
    assert server.requests == 1 + fetch.RETRIES
    assert list((tmp_path / "data").iterdir()) == []


def test_a_stranger_under_the_final_name_is_left_alone(server, tmp_path):
    path = tmp_path / "data" / "Ev-Objects.zip"
    path.parent.mkdir()
    path.write_bytes(b"my own")
    for action, words in (
        (fetch_data, "exists and is not the released file"),
        (find_data, "not the released file"),
    ):
        refused(DataError, words, action, "objects")
    assert path.read_bytes() == b"my own"


def test_the_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("SPIKELOOM_DATA", raising=False)
    for cache in (None, "relative/paths/do/not/count"):
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        if cache:
            monkeypatch.setenv("XDG_CACHE_HOME", cache)
        assert data_folder() == tmp_path / ".cache" / "spikeloom"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert data_folder() == tmp_path / "cache" / "spikeloom"
    monkeypatch.setenv("SPIKELOOM_DATA", "here")
    assert data_folder() == Path("here")


@pytest.mark.recordings
@pytest.mark.parametrize(("name", "fixture"), [("objects", "objects_zip"), ("containers", "containers_zip")])
def test_the_released_files_are_these(name, fixture, request):
    path = request.getfixturevalue(fixture)
    data = DATA_SETS[name]
    assert (path.name, path.stat().st_size) == (data.file, data.size)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == data.sha256
