"""What run prints where some recordings have no label."""

import json

import pytest
from made_files import TAXELS, own_file

from spikeloom.runtime.cli import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Four recordings, the last two without a label, and a network; the working folder holds both."""
    monkeypatch.chdir(tmp_path)
    own_file(tmp_path / "x.pt")
    (tmp_path / "data").mkdir()
    for index, name in enumerate(("a_label_0", "b_label_1", "c", "d")):
        rows = [f"0.{step:02d},{(step + index) % TAXELS},{step % 2}" for step in range(0, 60, 2)]
        (tmp_path / "data" / f"{name}.csv").write_text("\n".join(rows))
    assert main(["compile", "x.pt", "-o", "x.loom"]) == 0
    return tmp_path / "data"


def ran(capsys, *words):
    capsys.readouterr()
    assert main(["run", "x.loom", "--data", "data", *words]) == 0
    return capsys.readouterr().out


def test_labelled_recordings_are_scored_and_counted(folder, capsys):
    report = json.loads(ran(capsys, "--json"))
    right = sum(report["predictions"][i] == report["labels"][i] for i in range(2))
    assert (report["samples"], report["labelled"], report["labels"]) == (4, 2, [0, 1, -1, -1])
    assert report["accuracy"] == right / 2
    lines = ran(capsys).splitlines()
    assert lines[0].startswith(f"chip accuracy: {50 * right:.2f} % ({right} of 2; ")
    assert lines[0].endswith(", 2 more without a label")
    assert [line.split()[:2] for line in lines[-2:]] == [
        [file, str(report["predictions"][i])] for i, file in ((2, "c.csv"), (3, "d.csv"))
    ]
    assert lines[-3].split("  ")[1] == "without a label"


def test_without_labels_there_is_no_accuracy(folder, capsys):
    for name in ("a_label_0", "b_label_1"):
        (folder / f"{name}.csv").unlink()
    report = json.loads(ran(capsys, "--json"))
    assert (report["labelled"], report["accuracy"]) == (0, None)
    assert ran(capsys).splitlines()[0].split() == ["recording", "decision", "votes"]


def test_a_table_of_labels_scores_the_rest(folder, capsys):
    (folder / "labels.csv").write_text("file,label\nc.csv,2\nd.csv,3\n")
    report = json.loads(ran(capsys, "--json"))
    assert (report["labels"], report["labelled"]) == ([0, 1, 2, 3], 4)
    assert main(["run", "x.loom", "--data", "data"]) == 0
    assert capsys.readouterr().err.splitlines() == [
        "data: 120 events read, 0 out of order, 0 duplicates in a bin, 0 gaps over 0.5 s, "
        "0 recordings shorter than the longest",
        "spikeloom: warning: data: labels.csv: gives the labels of 2 of 4 recordings",
    ]
