"""Conditions of recordings in ``train``, ``chart`` and ``stress``: what is left out, and accuracies by condition."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import as_json, refusal, run
from made_files import CLASSES, TAXELS, events

from spikeloom.models.recordings.conditions import by_condition
from spikeloom.models.recordings.events import load_data
from spikeloom.models.training.counters import Plan, fit_rules, run_counters
from spikeloom.runtime.studies import left_out

TRAIN = (
    "train",
    "--data",
    "data",
    "--taxels",
    str(TAXELS),
    "--system",
    "mlp",
    "--features",
    "8",
    "--epochs",
    "3",
)
COUNT = ("train", "--data", "data", "--system", "counters", "--thresholds", "1,3")
STRESS = ("stress", "net.loom", "--checkpoint", "net.pt", "--data", "data", "--only", "events_lost")
CONDITIONS = ["speed=1", "speed=2", "speed=3", "force=0", "force=1"]


def write_split(folder: Path, seed: int, samples: int) -> None:
    """Recordings of four classes under three speeds and two forces; each class has a taxel that it likes."""
    folder.mkdir(parents=True)
    made = events(seed, samples=samples, rate=0.2)
    for i, recording in enumerate(made):
        recording[i % CLASSES] |= events(100 + i, samples=1, rate=0.5)[0, 0]
        speed, force = i // CLASSES % 3 + 1, i // (3 * CLASSES) % 2
        np.save(folder / f"sample_{i}_speed{speed}_force{force}_label_{i % CLASSES}.npy", recording)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Recordings in the folder where commands run."""
    write_split(tmp_path / "data/train", 1, 48)
    write_split(tmp_path / "data/test", 2, 24)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    return tmp_path / "data"


def without(data: Path, name: str) -> str:
    """The same recordings where those of a condition are the test split, and no other recording is left."""
    folder = data.with_name(name)
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
    for file in (data / "train").iterdir():
        shutil.copy(file, folder / ("test" if f"_{name}_" in file.name else "train"))
    return folder.name


def test_train_leaves_each_condition_out_and_parts_at_random(data, monkeypatch):
    plain = as_json(*TRAIN, "-o", "plain.pt")
    assert "left_out" not in plain
    words = (*TRAIN, "--groups", "speed, force", "-o", "net.pt")
    code, out, err = run(*words, "--json")
    assert code == 0
    assert err == (
        "spikeloom: --groups speed, force: 10 more trainings, without each of 5 conditions and of 5 parts at random\n"
    )
    found = json.loads(out)
    assert Path("net.pt").read_bytes() == Path("plain.pt").read_bytes()
    left = found["left_out"]
    assert list(left["conditions"]) == CONDITIONS
    assert [each["samples"] for each in left["conditions"].values()] == [16, 16, 16, 24, 24]
    assert left["at_random"]["samples"] == 48
    assert left["at_random"]["correct"] > 48 / CLASSES
    for name in ("speed2", "force1"):
        by_hand = (*TRAIN[:2], without(data, name), *TRAIN[3:], "-o", f"{name}.pt")
        reached = as_json(*by_hand)["runs"][0]["last"]
        condition = f"{name[:-1]}={name[-1]}"
        assert reached["correct"] == left["conditions"][condition]["correct"]

    # what is finished is kept
    monkeypatch.setattr(left_out, "measure", lambda _: pytest.fail("it is known"))
    code, out, _ = run(*words, "--resume")
    assert code == 0
    for name in ("parts at random", *CONDITIONS):
        assert f"\n  {name} " in out
    shares = [each["correct"] / each["samples"] for each in left["conditions"].values()]
    assert f"conditions not seen in training: worst {100 * min(shares):.1f} % (" in out
    assert f"best {100 * max(shares):.1f} % (" in out


def test_an_interrupt_says_how_to_go_on(data, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(left_out, "measure", interrupt)
    assert refusal(*TRAIN, "--groups", "speed", "-o", "net.pt") == (
        "interrupted; 0 of 8 measurements of this stage are kept in net.pt.folds.sqlite; go on with the same command "
        "and --resume"
    )
    assert Path("net.pt").exists()


def test_counters_leave_conditions_out(data):
    found = as_json(*COUNT, "--groups", "speed,force", "-o", "count.pt")
    left = found["left_out"]
    assert left["at_random"] == found["record"]["validation"]
    training = load_data(data, "train", groups=["speed", "force"])
    plan = Plan(thresholds=(1, 3))
    for name, held in by_condition(training).items():
        seen, new = training.part(~held), training.part(held)
        strength = found["record"]["strength"]
        rule = fit_rules(run_counters(seen, plan), CLASSES, [strength])[strength]
        right = int(np.count_nonzero(rule.right(run_counters(new, plan))))
        assert left["conditions"][name] == {"correct": right, "samples": len(new)}


def test_nothing_to_leave_out(data):
    assert "data: sample_0_speed1_force0_label_0.npy: has no hand" in refusal(
        *COUNT, "--groups", "hand", "-o", "a.pt"
    )
    assert "synthetic" in refusal(
        "train", "--data", "synthetic", "--system", "counters", "--groups", "speed", "-o", "a.pt"
    )
    for file in data.glob("*/*_speed[23]_*"):
        file.unlink()
    assert refusal(*COUNT, "--groups", "speed", "-o", "a.pt") == (
        "--groups speed: all training recordings of data have the same; name another, or omit it"
    )


def test_without_groups_it_is_said_once(data):
    for words in (TRAIN, COUNT):
        code, out, err = run(*words, "-o", "a.pt")
        assert code == 0
        assert out.count("conditions not seen in training were not tested") == 1
        assert "not tested" not in err


@pytest.fixture
def netlist(data):
    """A trained network and its netlist."""
    assert run(*TRAIN, "-o", "net.pt")[0] == 0
    assert run("compile", "net.pt", "--weight-bits", "8", "--calibrate", "data", "-o", "net.loom")[0] == 0
    return data


def test_stress_shows_accuracy_by_condition(netlist):
    words = (*STRESS, "--groups", "force", "-o", "stress.json")
    found = as_json(*words)
    assert list(found["conditions"]) == ["force=0", "force=1"]
    ran = as_json("run", "net.loom", "--data", "data")
    for name, each in found["conditions"].items():
        these = [f"_{name.replace('=', '')}_" in file for file in ran["files"]]
        right = np.array(ran["labels"]) == ran["predictions"]
        assert (each["recordings"], each["right"]["chip"]) == (12, right[these].sum())
    assert (
        sum(each["right"]["float"] for each in found["conditions"].values())
        == found["clean"]["right"]["float"]
    )
    _, out, _ = run(*words)
    worst = min(each["right"]["chip"] for each in found["conditions"].values()) / 12
    assert f"chip by condition: worst {100 * worst:.1f} % (force=" in out
    page = ("report", *STRESS[1:6], "--stress", "stress.json", "-o", "page.html")
    assert run(*page)[0] == 0
    assert "chip by condition: worst" in Path("page.html").read_text()
    bare = run(*STRESS)
    assert bare[1].count("conditions not seen in training were not tested") == 1
    assert bare[2] == ""


def test_a_table_beside_the_recordings_names_conditions(netlist):
    rows = [
        f"{file.relative_to(netlist)},{'left' if index % 2 else 'right'}"
        for index, file in enumerate(sorted(netlist.glob("*/*.npy")))
    ]
    (netlist / "recordings.csv").write_text("\n".join(["file,hand", *rows]))
    assert list(as_json(*STRESS)["conditions"]) == ["hand=left", "hand=right"]


def test_chart_shows_accuracy_by_condition(netlist):
    words = (
        "chart",
        "net.pt",
        "--data",
        "data",
        "--grid",
        "bits=4,8,window=100%",
        "--jobs",
        "1",
        "-o",
        "out",
    )
    assert "conditions not seen in training were not tested" in run(*words)[1]
    found = as_json(*words, "--groups", "speed")
    for point in found["points"]:
        for split in ("train", "test"):
            inside = point[split]["conditions"]
            assert list(inside) == ["speed=1", "speed=2", "speed=3"]
            assert sum(each["correct"] for each in inside.values()) == point[split]["correct"]
    chosen = found["points"][found["budget"]["point"] - 1]["test"]["conditions"]
    worst = min(each["accuracy"] for each in chosen.values())
    _, out, _ = run(*words, "--groups", "speed")
    assert f"by condition of the test recordings: worst {100 * worst:.1f} % (speed=" in out
    assert "--groups speed" in found["command"]
