"""The train command: seeds side by side, both protocols, pictures, kill and resume."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compiler.frontends.checkpoint import read_checkpoint
from models.evtouch import load_recordings
from models.grasps import synthetic_grasps
from models.release import write_released
from runtime.cli import main
from runtime.training import draw_training, summary

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def data(tmp_path, monkeypatch) -> Path:
    """A small data set in the released layout; the working folder is where it is."""
    monkeypatch.chdir(tmp_path)
    splits = []
    for split, seed in (("train", 1), ("test", 2)):
        grasps = synthetic_grasps(per_class=3, steps=12, seed=seed)
        splits.append(replace(grasps, split=split))
    write_released(tmp_path / "data", splits)
    return tmp_path


def as_json(capsys, *words):
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_one_seed_reports_both_protocols_and_stores_three_epochs(data, capsys):
    report = as_json(capsys, "train", "--data", "data", "--graph", "manual", "--epochs", "2", "-o", "x.pt")
    (run,) = report["runs"]
    assert run["command"] == "spikeloom train --data data --graph manual --epochs 2 --seed 0"
    assert {name: run[name]["chosen_on"] for name in ("last", "best", "clean")} == {
        "last": "nothing",
        "best": "the test split",
        "clean": "a part of the training split",
    }
    assert report["protocols"] == summary([run])
    assert [file.name for file in data.glob("x.pt*")] == ["x.pt"], "states of the training are left"
    epochs = {name: read_checkpoint("x.pt", weights=name) for name in ("last", "best", "clean")}
    for name, checkpoint in epochs.items():
        other = next(n for n in epochs if n != name)
        same = np.array_equal(checkpoint.dense[0].weight, epochs[other].dense[0].weight)
        assert same == (run[name]["epoch"] == run[other]["epoch"])
    assert read_checkpoint("x.pt").weights == "last"


def test_keep_stores_what_is_asked_for(data, capsys):
    as_json(capsys, "train", "--data", "data", "--graph", "manual", "--epochs", "1", "--keep", "best", "-o", "x.pt")
    assert read_checkpoint("x.pt").weights == "best"
    assert main(["inspect", "x.pt", "--weights", "last"]) == 2
    assert capsys.readouterr().err == (
        "spikeloom: x.pt: --weights last: the file holds best; choose one that it holds\n"
    )


def test_seeds_side_by_side_equal_single_ones(data, capsys):
    words = ("train", "--data", "data", "--graph", "manual", "--epochs", "1")
    report = as_json(capsys, *words, "--seeds", "2", "--seed", "4", "-o", "x.pt", "--picture", "curves.png")
    assert [run["file"] for run in report["runs"]] == ["x-seed4.pt", "x-seed5.pt"]
    assert (data / "curves.png").read_bytes()[:4] == b"\x89PNG"
    single = as_json(capsys, *words, "--seed", "5", "-o", "y.pt")
    assert (data / "y.pt").read_bytes() == (data / "x-seed5.pt").read_bytes()
    accuracies = [run["last"]["accuracy"] for run in report["runs"]]
    assert report["protocols"]["last"]["mean"] == pytest.approx(np.mean(accuracies))
    assert report["protocols"]["last"]["std"] == pytest.approx(np.std(accuracies, ddof=1))
    assert single["runs"][0]["sha256"] == report["runs"][1]["sha256"]


def test_text_shows_every_seed_and_the_means(data, capsys):
    words = ["train", "--data", "data", "--graph", "manual", "--epochs", "1", "--seeds", "2", "-o", "x.pt"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split("  ")[-1].strip() == "file"
    assert [line.split()[1] for line in lines[2:4]] == ["0", "1"]
    assert lines[4].startswith("  mean of 2 seeds: last ")


def test_pictures_of_equal_trainings_are_equal(tmp_path):
    record = {
        "seed": 0,
        "test_samples": 4,
        "history": [[0.2, 0.3, 1], [0.1, 0.2, 3]],
        "clean": {"epoch": 2, "accuracy": 0.75},
    }
    labels = np.array([0, 1, 2, 2])
    for suffix in ("png", "svg"):
        files = [tmp_path / f"{name}.{suffix}" for name in "ab"]
        for file in files:
            draw_training(str(file), [record], labels, [np.array([0, 1, 2, 1])])
        if suffix == "png":
            assert files[0].read_bytes() == files[1].read_bytes()
        assert files[0].stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--seeds", "0"], "--seeds 0: at least 1 is needed; give a positive number"),
        (["--epochs", "0"], "epochs: 0, allowed are 1 or more; choose another"),
        (["--device", "tpu"], "--device tpu: unknown; allowed: cpu, cuda"),
        (["--picture", "x.jpg"], "--picture x.jpg: allowed are .png, .svg, .pdf; name one of these"),
        (["--picture", "none/x.png"], "--picture none/x.png: the folder does not exist; make it first"),
    ],
)
def test_wrong_options(data, capsys, words, line):
    assert main(["train", "--data", "data", "--graph", "manual", "-o", "x.pt", *words]) == 2
    assert capsys.readouterr().err == f"spikeloom: {line}\n"
    assert not (data / "x.pt").exists()


def test_a_graph_must_be_named(data, capsys):
    assert main(["train", "--data", "data", "-o", "x.pt"]) == 2
    assert capsys.readouterr().err == (
        "spikeloom: train: no graph; name it with --graph: manual, knn:K (K 1..8) or mst:SIGMA (mm, 0 = tree only), "
        "each also as released:NAME, or give --edges\n"
    )


def test_isolated_taxels_warn_and_train_all_the_same(data, capsys):
    Path("edges.csv").write_text("source,target\n0,1\n1,2\n")
    words = ["train", "--data", "data", "--taxels", "39", "--edges", "edges.csv", "--epochs", "1", "-o", "x.pt"]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "warning: " in err
    assert out.startswith("spikeloom train --data data --taxels 39 --edges edges.csv --epochs 1 --seed 0\n")
    assert read_checkpoint("x.pt").graph == "edges:edges.csv"


def test_killed_at_random_points_it_resumes_to_the_same_bytes(data):
    # the seed of the delays is fixed, the moment of a kill is not: wherever it falls, the result must be the same
    delays = random.Random(7)
    epochs = "40"
    words = [sys.executable, "-m", "runtime", "train", "--data", "data", "--graph", "manual", "--epochs", epochs]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([*words, "-o", "whole.pt"], check=True, env=environment, capture_output=True)
    killed = 0
    for attempt in range(6):
        resume = ["--resume"] if attempt else []
        process = subprocess.Popen(
            [*words, "-o", "parts.pt", *resume],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        deadline = time.monotonic() + 120
        while not list(data.glob("parts.pt.state.*")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(delays.uniform(0.0, 0.4))
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            killed += 1
        process.communicate()
    last = subprocess.run([*words, "-o", "parts.pt", "--resume"], env=environment, capture_output=True, check=False)
    assert last.returncode == 0, last.stderr
    assert killed >= 1
    assert Path("parts.pt").read_bytes() == Path("whole.pt").read_bytes()
    assert load_recordings("data", "train").steps == 12
