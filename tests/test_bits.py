"""The command ``bits``: what it recommends is what it builds; what it found is found again; mistakes are one line."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from made_files import TAXELS, events, own_file, recordings_folder, weights

from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.compiler.targets.loihi1.storage.width_search import WidthPoint, WidthSearch
from spikeloom.models.recordings.fetch import data_folder
from spikeloom.runtime import cli
from spikeloom.runtime.commands.choose import bits

COMMAND = ("bits", "net.pt", "--calibrate", "data", "--widths", "2,4", "--samples", "9")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to work in, with recordings, a checkpoint and a cache of its own."""
    monkeypatch.setenv("SPIKELOOM_DATA", str(tmp_path / "cache"))
    recordings_folder(tmp_path / "data", train=events(1, samples=12))
    own_file(tmp_path / "net.pt", last=weights(4))
    return tmp_path


def refuse_search(*_, **__):
    raise AssertionError("searched anew")


def test_the_recommended_widths_are_built_by_the_printed_command(spikeloom):
    code, out, err = spikeloom(*COMMAND, "--agreement", "0.5", "-o", "found.loom", "--json")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["layers"] == ["conv1", "fc1", "fc2", "fc3"]
    assert (report["recordings"], report["of"]) == (9, 12)
    recommended = report["recommended"]
    assert recommended in report["front"]
    assert recommended["agreement"] >= 0.5
    assert all(p["agreement"] < 0.5 for p in report["front"] if p["words"] < recommended["words"])
    netlist = read_netlist("found.loom")
    assert [layer.weight_bits for layer in netlist.layers] == recommended["weight_bits"]
    assert netlist.n_cores == recommended["cores"]
    words = shlex.split(report["command"])
    assert words[:2] == ["spikeloom", "compile"]
    assert words[-2:] == ["-o", "found.loom"]
    assert cli.main([*words[1:-1], "again.loom"]) == 0
    assert Path("found.loom").read_bytes() == Path("again.loom").read_bytes()


def test_its_figures_are_those_of_the_netlist(spikeloom):
    """All training recordings are decided, so run on the training split must count the same."""
    code, out, _ = spikeloom(*COMMAND[:-1], 50, "--accuracy", "0.1", "-o", "found.loom", "--json")
    assert code == 0
    report = json.loads(out)
    _, out, _ = spikeloom("run", "found.loom", "--data", "data", "--split", "train", "--json")
    assert json.loads(out)["accuracy"] == report["recommended"]["accuracy"]
    _, out, _ = spikeloom(
        "verify", "found.loom", "--checkpoint", "net.pt", "--data", "data", "--split", "train", "--json"
    )
    verdict = json.loads(out)
    assert verdict["decision_agreement"] == report["recommended"]["agreement"]
    assert verdict["accuracy"]["float"] == report["float_accuracy"]


def test_another_share_is_answered_from_the_cache(spikeloom, monkeypatch):
    _, first, _ = spikeloom(*COMMAND, "--agreement", "0.5", "--json")
    _, anew, _ = spikeloom(*COMMAND, "--accuracy", "0.4", "--no-cache", "--json")
    monkeypatch.setattr(bits, "search_widths", refuse_search)
    _, again, _ = spikeloom(*COMMAND, "--agreement", "0.5", "--json")
    _, other, err = spikeloom(*COMMAND, "--accuracy", "0.4", "--json")
    first, anew, again, other = (json.loads(out) for out in (first, anew, again, other))
    assert [report.pop("cached") for report in (first, anew, again, other)] == [False, False, True, True]
    assert again == first
    assert other == anew
    assert err == ""
    _, out, _ = spikeloom(*COMMAND, "--agreement", "0.5")
    assert "kept from an earlier call" in out
    with pytest.raises(AssertionError, match="searched anew"):
        spikeloom(*COMMAND, "--agreement", "0.5", "--scale-groups", "2")
    with pytest.raises(AssertionError, match="searched anew"):
        spikeloom(*COMMAND, "--agreement", "0.5", "--no-cache")
    own_file(data_folder().parent / "net.pt", last=weights(5))
    with pytest.raises(AssertionError, match="searched anew"):
        spikeloom(*COMMAND, "--agreement", "0.5")


@pytest.mark.parametrize(
    "spoil",
    [
        lambda file: file.write_bytes(file.read_bytes()[:-40]),
        lambda file: file.write_text(file.read_text().replace('"equal"', '"equals"')),
        lambda file: file.write_text("[]"),
        lambda file: file.write_bytes(b"\xff\xfe"),
    ],
)
def test_a_damaged_cache_is_left_out(spikeloom, spoil):
    _, first, _ = spikeloom(*COMMAND, "--agreement", "0.5", "--json")
    (file,) = (data_folder() / "bits").iterdir()
    whole = file.read_bytes()
    spoil(file)
    assert file.read_bytes() != whole
    code, again, err = spikeloom(*COMMAND, "--agreement", "0.5", "--json")
    assert code == 0
    assert err == f"spikeloom: warning: {file}: is damaged or of another version; it is ignored\n"
    assert again == first
    assert file.read_bytes() == whole


def test_a_cache_that_cannot_be_written_is_no_mistake(spikeloom, place):
    (place / "cache").write_text("in the way")
    code, out, err = spikeloom(*COMMAND, "--agreement", "0.5", "--json")
    assert code == 0
    (file,) = [line for line in err.splitlines() if "the search is not kept for the next call" in line]
    assert file.startswith(f"spikeloom: warning: {place / 'cache' / 'bits'}")
    assert json.loads(out)["recommended"]


def test_a_search_survives_its_file(place):
    points = tuple(WidthPoint(bits=(2, b), words=b * 10, equal=b, right=None) for b in (2, 4))
    built = (WidthPoint(bits=(2, 4), words=39, equal=3, right=None, cores=2),)
    made = WidthSearch(samples=5, float_right=None, points=points, built=built)
    bits.write_search(place / "one.json", made)
    assert bits.read_search(place / "one.json") == made
    assert bits.read_search(place / "none.json") is None


def test_a_share_that_nothing_reaches_is_a_failed_check(spikeloom):
    draw = np.random.default_rng(0)
    own_file(data_folder().parent / "net.pt", last={k: draw.normal(0, 1, w.shape) for k, w in weights(1).items()})
    code, out, _ = spikeloom(
        "bits", "net.pt", "--calibrate", "data", "--widths", "2", "--agreement", "1", "-o", "no.loom", "--json"
    )
    report = json.loads(out)
    assert report["front"][-1]["agreement"] < 1
    assert (code, report["recommended"], report["command"], report["netlist"]) == (1, None, None, None)
    assert not (data_folder().parent / "no.loom").exists()
    code, out, _ = spikeloom("bits", "net.pt", "--calibrate", "data", "--widths", "2", "--agreement", "1")
    assert code == 1
    best = report["front"][-1]["agreement"]
    assert out.splitlines()[-2:] == [
        f"no combination reaches agreement 1; the best has {best:.4f}",
        "  more --scale-groups or --widths may reach it; else fine-tune the network",
    ]


def test_the_text_shows_the_front_and_says_that_it_is_training(spikeloom):
    code, out, _ = spikeloom(*COMMAND, "--agreement", "0.5", "--top", "1")
    lines = out.splitlines()
    assert code == 0
    assert lines[0].endswith(" combinations of widths on 9 of 12 training recordings")
    assert lines[1].startswith("training figures: ")
    assert lines[2].startswith("float64 model: ")
    assert lines[3].startswith("most agreement for the memory, least memory first (1 of ")
    assert lines[4].split() == ["conv1,fc1,fc2,fc3", "words", "cores", "accuracy", "agreement"]
    assert lines[5].endswith("<-")
    assert lines[6].startswith("agreement 0.5 needs ")
    assert lines[7].startswith("  spikeloom compile net.pt --calibrate data --weight-bits ")
    assert lines[7].endswith(" -o NET.loom")


def test_the_printed_command_repeats_every_option():
    parser = cli.build_parser()
    words = (
        "bits 'my net.pt' --graph knn2 --run 1 --weights best --beta 0.3 --theta 0.4 --calibrate data --bin 0.01 "
        "--scale-groups 4 --agreement 0.9"
    )
    command = bits._command(parser.parse_args(shlex.split(words)), (2, 4))
    assert shlex.join(command) == (
        "spikeloom compile 'my net.pt' --graph knn2 --run 1 --weights best --beta 0.3 --theta 0.4 --calibrate data "
        "--bin 0.01 --weight-bits 2,4 --scale-groups 4 -o NET.loom"
    )
    assert parser.parse_args(command[1:]).weight_bits == "2,4"
    own = "bits x.pt --taxels t.csv --edges e.csv --directed --calibrate d --accuracy 0.9 -o a.loom"
    assert shlex.join(bits._command(parser.parse_args(own.split()), (8,))) == (
        "spikeloom compile x.pt --taxels t.csv --edges e.csv --calibrate d --weight-bits 8 --directed -o a.loom"
    )


def test_accuracy_needs_labels_and_agreement_does_not(spikeloom, place):
    (place / "plain" / "train").mkdir(parents=True)
    rng = np.random.default_rng(3)
    for index in range(4):
        lines = [
            f"{0.02 * step + 0.01:.2f},{taxel},{polarity}"
            for step, taxel, polarity in np.argwhere(rng.random((20, TAXELS, 2)) < 0.3)
        ]
        table = "\n".join(["time_s,taxel,polarity", *lines, ""])
        (place / "plain" / "train" / f"grasp_{index}.csv").write_text(table)
    words = ("bits", "net.pt", "--calibrate", "plain", "--widths", "8")
    code, out, err = spikeloom(*words, "--accuracy", "0.5")
    assert (code, out) == (2, "")
    assert err.splitlines()[-1] == (
        "spikeloom: plain: grasp_0.csv: no label, --accuracy needs one for every recording; "
        "add a label column or name the file like grasp_7_label_3.csv"
    )
    code, out, _ = spikeloom(*words, "--agreement", "0", "--json")
    report = json.loads(out)
    assert code == 0
    assert report["float_accuracy"] is None
    assert report["recommended"]["accuracy"] is None
    assert "float64 model" not in spikeloom(*words, "--agreement", "0")[1]


@pytest.mark.recordings
def test_released_recordings(spikeloom, objects_zip, released_checkpoint):
    """One width and few recordings: the figure is that of the netlist on the same recordings."""
    words = ("bits", released_checkpoint, "--graph", "manual", "--calibrate", objects_zip, "--samples", 12)
    code, out, _ = spikeloom(*words, "--widths", "8", "--agreement", "0.5", "--json")
    report = json.loads(out)
    assert code == 0
    assert report["combinations"] == 1
    assert report["recommended"]["weight_bits"] == [8, 8, 8, 8]
    assert report["recommended"]["agreement"] == 1.0
    assert (report["recordings"], report["of"]) == (12, 576)


@pytest.mark.parametrize(
    ("words", "telling"),
    [
        ("--accuracy 1.5", "--accuracy 1.5|from 0 to 1"),
        ("--agreement nan", "--agreement nan|from 0 to 1"),
        ("--agreement 1 --samples 0", "--samples 0|1 or more"),
        ("--agreement 1 --top -1", "--top -1|1 or more"),
        ("--agreement 1 --widths two", "--widths two|2,4,8"),
        ("--agreement 1 --widths 7", "--widths 7|2, 3, 4, 5, 6, 8"),
        ("--agreement 1 -o nowhere/x.loom", "-o nowhere/x.loom|folder"),
        ("--agreement 1 -o net.pt", "-o net.pt|input"),
        ("", "--accuracy --agreement is required"),
    ],
)
def test_mistakes_take_one_line(spikeloom, words, telling):
    code, out, err = spikeloom(*COMMAND, *words.split())
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert all(word in err for word in telling.split("|"))


def test_a_netlist_has_no_widths_left(spikeloom):
    assert spikeloom("compile", "net.pt", "-o", "net.loom")[0] == 0
    code, _, err = spikeloom("bits", "net.loom", "--calibrate", "data", "--agreement", "1")
    assert (code, "net.loom: is a netlist" in err) == (2, True)
