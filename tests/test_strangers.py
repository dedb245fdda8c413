"""Files from strangers: sizes are checked before anything is read, and what is wrong is said in one line."""

import errno
import json
import sqlite3
import subprocess
import sys
import zipfile
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import refusal, run
from made_files import recordings_folder
from oracles import refused
from zoo import specimen

from spikeloom.compiler import archive
from spikeloom.compiler.errors import CapacityError, DataError, Violation
from spikeloom.compiler.files import FileFault, one_line
from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.models.recordings import evtouch
from spikeloom.runtime.cli import _mistake
from spikeloom.runtime.studies.jobs import Job, sweep


def nothing(_: Job) -> int:
    return 1


@pytest.mark.parametrize(
    "schema",
    [
        "CREATE VIEW results AS SELECT 'a' AS key, zeroblob(1000000000) AS result",
        "CREATE VIEW results AS WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT k, k FROM n",
        "CREATE TABLE results (key TEXT, result TEXT AS (zeroblob(1000000000)))",
        "CREATE TABLE results (key TEXT PRIMARY KEY, result TEXT); CREATE VIEW more AS SELECT 1",
    ],
)
def test_a_store_is_one_table(schema, tmp_path):
    store = tmp_path / "net.sqlite"
    with closing(sqlite3.connect(store)) as kept:
        kept.executescript(schema)
    refused(
        DataError,
        "net.sqlite: is no store of measurements",
        sweep,
        [Job(key="a", label="")],
        nothing,
        store,
        label="",
    )


def test_a_store_of_ours_goes_on(tmp_path):
    jobs = [Job(key="a", label="a")]
    for _ in range(2):
        assert sweep(jobs, nothing, tmp_path / "net.sqlite", jobs=1, label="") == {"a": 1}


def test_a_manifest_that_is_compressed_is_not_inflated(tmp_path):
    path = tmp_path / "net.loom"
    manifest = archive.npy_bytes(np.array(json.dumps({"format": "spikeloom-netlist"})))
    for how, found in ((zipfile.ZIP_STORED, "spikeloom-netlist"), (zipfile.ZIP_DEFLATED, None)):
        with zipfile.ZipFile(path, "w", how) as made:
            made.writestr("manifest.npy", manifest)
        assert archive.stated(path, "format") == found


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")  # as all who have such files
def test_a_program_of_torch_is_called_so(tmp_path):
    torch.jit.script(torch.nn.Linear(3, 2)).save(str(tmp_path / "net.pt"))
    assert "is a TorchScript program" in refusal("compile", tmp_path / "net.pt", "-o", tmp_path / "net.loom")


def test_a_header_of_signs_is_damaged():
    header = b"{'descr':'<f8','fortran_order':False,'shape':(" + b"-" * 9900 + b"1,)}\n"
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with pytest.raises((FileFault, ValueError)):
        archive.read_npy(content)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("digests", "x"),
        ("digests", {"conv1": "x"}),
        ("checkpoint_sha256", 5),
        ("compensated", 3),
        ("window", 0),
        ("bin_s", -1.0),
    ],
)
def test_a_provenance_of_another_kind_is_refused(entry, value, tmp_path):
    made = specimen("mlp")
    netlist = read_netlist(made.netlist)
    path = tmp_path / "net.loom"
    write_netlist(replace(netlist, provenance={**netlist.provenance, entry: value}), path)
    assert "has no usable" in refusal("verify", path, "--checkpoint", made.network, "--data", made.data)


def test_a_manifest_that_nests_is_refused(tmp_path):
    netlist = read_netlist(specimen("mlp").netlist)
    deep: list = []
    for _ in range(900):
        deep = [deep]
    write_netlist(replace(netlist, provenance={"more": deep}), tmp_path / "net.loom")
    assert "16 deep" in refusal("inspect", tmp_path / "net.loom")


def test_a_table_with_a_huge_cell_is_refused(tmp_path):
    folder = recordings_folder(tmp_path / "data")
    (folder / "labels.csv").write_text(f"file,label\nsample_0_label_0.npy,{'a' * 140_000}\n")
    said = refusal("data", "describe", folder)
    assert "labels.csv" in said
    assert len(said) < 300


def test_a_full_disk_is_said_with_the_name_of_what_was_written(tmp_path, monkeypatch):
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    said = refusal("data", "convert", specimen("mlp").data, "-o", tmp_path / "out")
    assert f"{tmp_path}/out: No space left on device" in said
    assert not [*tmp_path.iterdir()]


def test_few_events_make_no_large_array(tmp_path):
    (tmp_path / "grasp.csv").write_text("time_s,taxel,polarity\n19999,2000,1\n")
    assert "a recording of 4001803902 bytes, limit" in refusal("data", "describe", tmp_path / "grasp.csv")


def test_recordings_of_silence_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(evtouch, "MAX_SILENT_BYTES", 10_000)
    silent, lively = np.zeros((2, 50, 2, 51), np.uint8), np.zeros((2, 50, 2, 51), np.uint8)
    lively[0, 0, 0, 0] = 1
    recordings_folder(tmp_path / "data", train=silent, test=lively)
    said = refusal("data", "describe", tmp_path / "data", "--split", "train")
    assert "0 events in 10200 bytes of bins, limit 10000 and 4096 for each" in said
    assert run("data", "describe", tmp_path / "data")[0] == 0
    (tmp_path / "long").mkdir()
    (tmp_path / "long" / "a.csv").write_text("time_s,taxel,polarity\n0.01,50,1\n")
    (tmp_path / "long" / "recordings.csv").write_text("file,duration_s\na.csv,10\n")
    assert "1 event in 51000 bytes" in refusal("data", "describe", tmp_path / "long")


def test_what_names_hold_is_said_in_one_short_line():
    assert one_line("warning: a\nspikeloom: b") == "warning: a spikeloom: b"
    assert len(one_line("a" * 5000)) == 300
    (line,) = _mistake(DataError("a\nb"))
    assert "\n" not in one_line(line)
    one = Violation(owner="core 0", rule="r", used=2, allowed=1, remedy="x")
    assert len(_mistake(CapacityError((one, one)))) == 2


def test_half_written_files_of_a_killed_run_go(tmp_path):
    left = [tmp_path / f".net.loom.{number}123abcd.part" for number in (0, 1)]
    left[0].touch()
    left[1].mkdir()  # as of a folder of recordings
    assert run("compile", specimen("mlp").network, "-o", tmp_path / "net.loom")[0] == 0
    assert not any(each.exists() for each in left)


def test_an_exported_file_is_the_same_without_docstrings(tmp_path):
    made = specimen("mlp")
    written = []
    for optimised in ("", "2"):
        path = tmp_path / f"net{optimised}.onnx"
        words = ["-m", "spikeloom", "export", made.netlist, "--to", "onnx", "-o", path]
        environment = {"PYTHONOPTIMIZE": optimised, "PYTHONPATH": ":".join(sys.path)}
        subprocess.run([sys.executable, *words], check=True, env=environment, capture_output=True)
        written.append(path.read_bytes())
    assert written[0] == written[1]
