"""The command ``bits``: what it recommends is what it builds, and its figures are those of the netlist."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from made_files import TAXELS, events, own_file, recordings_folder, weights

from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.runtime import cli
from spikeloom.runtime.commands.choose import bits

WORDS = ("bits", "net.pt", "--calibrate", "data", "--widths", "2,4")
COMMAND = (*WORDS, "--samples", "9")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, some of them without labels, and checkpoints."""
    folder = tmp_path_factory.mktemp("bits")
    recordings_folder(folder / "data", train=events(1, samples=12))
    own_file(folder / "net.pt", last=weights(4))
    draw = np.random.default_rng(0)
    own_file(folder / "noise.pt", last={k: draw.normal(0, 1, w.shape) for k, w in weights(1).items()})
    (folder / "plain" / "train").mkdir(parents=True)
    for index in range(4):
        found = np.argwhere(draw.random((20, TAXELS, 2)) < 0.3)
        lines = [f"{0.02 * step + 0.01:.2f},{taxel},{polarity}" for step, taxel, polarity in found]
        table = "\n".join(["time_s,taxel,polarity", *lines, ""])
        (folder / "plain" / "train" / f"grasp_{index}.csv").write_text(table)
    return folder


def test_the_recommended_widths_are_built_by_the_printed_command(as_json):
    report = as_json(*COMMAND, "--agreement", "0.5", "-o", "found.loom")
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


def test_its_figures_are_those_of_the_netlist(as_json):
    """All training recordings are decided, so run on the training split must count the same."""
    report = as_json(*WORDS, "--samples", 50, "--accuracy", "0.1", "-o", "found.loom")
    words = ("found.loom", "--checkpoint", "net.pt", "--data", "data", "--split", "train")
    verdict = as_json("verify", *words, codes=(0, 1))
    assert verdict["accuracy"]["chip"] == report["recommended"]["accuracy"]
    assert verdict["decision_agreement"] == report["recommended"]["agreement"]
    assert verdict["accuracy"]["float"] == report["float_accuracy"]


def test_a_share_that_nothing_reaches_is_a_failed_check(spikeloom, place):
    words = ("bits", "noise.pt", "--calibrate", "data", "--widths", "2", "--agreement", "1", "-o", "no.loom")
    code, out, _ = spikeloom(*words, "--json")
    report = json.loads(out)
    best = report["front"][-1]["agreement"]
    assert best < 1
    assert (code, report["recommended"], report["command"], report["netlist"]) == (1, None, None, None)
    assert not (place / "no.loom").exists()


def test_the_printed_command_repeats_every_option():
    parser = cli.build_parser("bits")
    words = (
        "bits 'my net.pt' --graph knn2 --system gcn --run 1 --weights best --beta 0.3 --theta 0.4 --calibrate data "
        "--bin 0.01 --scale-groups 4 --agreement 0.9"
    )
    assert bits._command(parser.parse_args(shlex.split(words)), (2, 4)) == (
        "spikeloom compile 'my net.pt' --graph knn2 --system gcn --run 1 --weights best --beta 0.3 --theta 0.4 "
        "--calibrate data --bin 0.01 --weight-bits 2,4 --scale-groups 4 -o NET.loom"
    )
    own = "bits x.pt --taxels t.csv --edges e.csv --directed --calibrate d --accuracy 0.9 -o a.loom"
    assert bits._command(parser.parse_args(own.split()), (8,)) == (
        "spikeloom compile x.pt --taxels t.csv --edges e.csv --directed --calibrate d --weight-bits 8 -o a.loom"
    )


def test_agreement_needs_no_labels(as_json):
    report = as_json("bits", "net.pt", "--calibrate", "plain", "--widths", "8", "--agreement", "0")
    assert report["float_accuracy"] is None
    assert report["recommended"]["accuracy"] is None


@pytest.mark.parametrize(
    ("words", "telling"),
    [
        ("--accuracy 1.5", "--accuracy 1.5|from 0 to 1"),
        ("--agreement 1 --samples 0", "--samples 0|1 or more"),
        ("--agreement 1 --widths two", "--widths two|8,4,4,8"),
        ("--agreement 1 --widths 7", "--widths 7|2, 3, 4, 5, 6, 8"),
        ("--accuracy 0.5 --calibrate plain", "plain: grasp_0.csv: no label|--accuracy needs one"),
        ("", "--accuracy --agreement is required"),
    ],
)
def test_mistakes(refusal, words, telling):
    line = refusal(*COMMAND, *words.split())
    assert all(word in line for word in telling.split("|"))
