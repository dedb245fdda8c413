"""The command ``smallest``: what goes on, what is chosen, and that the choice is what the other commands make of it."""

import shlex
from dataclasses import replace

import numpy as np
import pytest
from commands import as_json, refusal, run
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings.grasps import synthetic_split
from spikeloom.models.training import folds, record
from spikeloom.models.training.counters import Plan, counters_of, fit, run_counters
from spikeloom.runtime.commands.choose import smallest
from spikeloom.runtime.commands.options import request_of
from spikeloom.runtime.inputs import recordings as recordings_input
from spikeloom.runtime.requests.training import TrainRequest
from spikeloom.runtime.studies.counting import decisions_of
from spikeloom.runtime.studies.search.budgets import parse_budgets
from spikeloom.runtime.studies.search.choice import lead
from spikeloom.runtime.studies.search.results import NetlistCosts
from spikeloom.runtime.studies.smallest import baselines, sections, space, study, work
from spikeloom.runtime.studies.smallest.results import Tried
from spikeloom.runtime.studies.smallest.space import Candidate
from spikeloom.runtime.studies.training.plan import recipe_of

RECORDINGS = 40
UJ = 1e-6


def tried(number, right, joules, rung=3, other=None, cores=1, order=0):
    """A candidate that is right in the first recordings, or in others where the `order` is another."""
    decided = np.roll(np.arange(RECORDINGS) < right, order)
    costs = NetlistCosts(
        operations=1e9 * joules,
        energy_j={"one": joules, "two": joules if other is None else other},
        time_s={"clock": 100 * joules},
        cores=cores,
        neurons=1,
        synapses=1,
    )
    return Tried(
        right=tuple(5 * decided),
        tried=(5,) * RECORDINGS,
        number=number,
        candidate=Candidate(system="counters", options={"thresholds": str(number)}),
        rung=rung,
        accuracy=right / RECORDINGS,
        low=0.0,
        high=1.0,
        setting=0.1,
        costs=costs,
    )


POOL = (
    tried(1, 36, 40 * UJ, cores=2),
    tried(2, 35, 10 * UJ, other=9 * UJ),  # 1 of 40 behind: as much as the error, not more
    tried(3, 35, 11 * UJ, other=8 * UJ),
    tried(4, 32, 2 * UJ),
    tried(5, 36, 1 * UJ, rung=2),  # it was dropped
)


def test_the_best_of_a_system_is_the_most_accurate_of_those_in_the_last_round_or_beyond():
    (family,) = study.families((*POOL, tried(6, 35, 10 * UJ, rung=4), tried(7, 40, UJ, rung=2)))
    assert (family.best, family.tried) == (1, 7)


def budgets(*words):
    return parse_budgets(words, study.LIMITS)


def test_a_share_is_no_per_cent():
    refused(OptionError, "--budget accuracy=0.9: allowed is 1 to 100 per cent", budgets, "accuracy=0.9")


@pytest.fixture
def any_margin(monkeypatch):
    """One of these recordings is more than the margin."""
    monkeypatch.setattr(study, "MARGIN", 1.0)


def test_the_margin():
    assert study.pick(POOL, ()).cheapest == {"one": 1, "two": 1}


@pytest.mark.usefixtures("any_margin")
def test_the_cheapest_that_is_not_shown_to_be_worse():
    found = study.pick(POOL, ())
    assert (found.best, found.cheapest, found.allowed, found.fits) == (
        1,
        {"one": 2, "two": 3},
        (1, 2, 3),
        True,
    )
    assert found.ahead == 1
    ahead, error = lead(POOL[0].shares, POOL[3].shares)
    wrong = np.repeat([1.0, 0.0], [4, 36])
    assert (ahead, error) == (pytest.approx(0.1), pytest.approx(wrong.std(ddof=1) / np.sqrt(40)))
    # as good as number 4, wrong elsewhere: less is known of the difference
    shifted = tried(6, 32, UJ, order=8)
    assert not study.worse(tried(1, 33, UJ), shifted)
    assert study.pick([POOL[0], POOL[3]], ()).cheapest["one"] == 1


@pytest.mark.usefixtures("any_margin")
@pytest.mark.parametrize(("joules", "chosen"), [(10.4 * UJ, 3), (10.6 * UJ, 2)])
def test_of_energies_that_are_alike_the_most_accurate_is_taken(joules, chosen):
    pool = [tried(1, 36, 40 * UJ), tried(2, 35, 10 * UJ), tried(3, 36, joules)]
    assert study.pick(pool, ()).cheapest["one"] == chosen


def test_the_difference_is_of_recordings_that_both_decided():
    fold = work.Measured(right=(1, 0, 0, 0), tried=(1, 1, 0, 0), setting=0.1)
    assert study.accuracy(fold) == 0.5
    none = work.Measured(right=(0,) * 4, tried=(0,) * 4, setting=0.1, refused="too large")
    assert (study.accuracy(none), lead(fold.shares, none.shares)) == (0.0, (0.0, 0.0))
    ahead, error = lead(work.Measured(right=(5, 3, 0, 0), tried=(5,) * 4, setting=0.1).shares, fold.shares)
    assert (ahead, error) == (pytest.approx(0.3), pytest.approx(0.3))


@pytest.mark.usefixtures("any_margin")
@pytest.mark.parametrize(
    ("words", "chosen", "fits"),
    [
        (["energy=5uJ"], 4, True),
        (["accuracy=80"], 4, True),
        (["accuracy=81", "cores=1"], 2, True),
        (["time=1.05ms"], 4, True),  # 3 of 40 behind are not shown to be worse
        (["operations=1500"], 5, True),  # none of the last rung fits
        (["energy=1nJ"], 4, False),  # nothing fits, the nearest of the last rung
    ],
)
def test_budgets(words, chosen, fits):
    found = study.pick(POOL, budgets(*words))
    assert (found.cheapest["one"], found.fits, found.budgets) == (chosen, fits, tuple(words))


@pytest.mark.usefixtures("any_margin")
def test_decisions_that_no_event_alters_are_a_budget():
    pool = [
        replace(each, certified=share) for each, share in zip(POOL, (0.96, 0.8, 0.9, 0.5, None), strict=True)
    ]
    for share, chosen, fits in ((85, 3, True), (95, 1, True), (97, 1, False)):
        found = study.pick(pool, budgets(f"certified={share}"))
        assert (found.cheapest["one"], found.fits) == (chosen, fits)
    assert study.promote(pool, 1, budgets("certified=99")) == study.promote(
        pool, 1
    )  # it is known on the last rung


def test_budgets_that_are_none():
    for words in ("energy=5", "power=1W", "cores=none", "operations=0", "certified=101"):
        with pytest.raises(OptionError, match="--budget"):
            budgets(words)
    timeless = replace(POOL[0], costs=replace(POOL[0].costs, time_s={}))
    with pytest.raises(OptionError, match="no time table"):
        study.pick([timeless], budgets("time=5ms"))
    with pytest.raises(OptionError, match="no candidate can be had; counters 1: too large"):
        study.pick([replace(POOL[0], costs=None, refused="too large")], ())


def test_who_goes_on():
    assert [each.number for each in study.promote(POOL[:4], 1)] == [1, 2, 3, 4]
    dominated = tried(6, 20, 20 * UJ)
    assert study.promote([dominated, *POOL], 1)[-1] == dominated
    assert study.promote([replace(dominated, costs=None)], 2) == []
    assert len(study.promote([dominated] * 30, 2)) == study.KEPT[2]
    for words, on in (("energy=8.5uJ", [2, 4]), ("cores=1", [2, 3, 4]), ("energy=1nJ", [1, 2, 3, 4])):
        assert sorted(each.number for each in study.promote(POOL[:4], 1, budgets(words))) == on


@pytest.mark.parametrize(
    "plan",
    [Plan(parts=2, ramp=5), Plan(bins=5, ramp=8), Plan(thresholds=(1, 2), parts=5, window=50)],
    ids=str,
)
def test_decisions_are_those_of_the_spiking_network(plan):
    training, test = (synthetic_split(split, limit=72) for split in ("train", "test"))
    data = run_counters(training, plan)
    made = counters_of(data, fit(data, 6), training, 6)
    for each in (training, test):
        assert_array_equal(
            work.decisions(made, run_counters(each, plan, data.steps)), decisions_of(made, each)
        )


def test_candidates_can_all_be_trained():
    every = list(space.counting(250))
    assert 60 <= len(every) == len({each.name for each in every}) <= 140
    for each in every:
        each.plan().require_possible()
    assert [each.words[-2:] for each in space.variants(every[0], 1)] == [["--ramp", "16"], ["--ramp", "64"]]
    few = next(space.counting(250, bits=5))
    for each, bits in ((every[0], (8, 5, 4)), (few, (5, 4, 3))):
        assert tuple(other.plan().bits for other in (each, *space.variants(each, 2))) == bits
    systems = ("tactilesgnet", "mlp", "gcn", "grid-cnn")
    first = list(space.networks(250, systems))
    trained = [*first, *(other for each in first for other in space.other_ways(each, 250))]
    assert len({each.name for each in trained}) == len(trained) > 50
    assert {each.system for each in trained} == set(systems)
    assert {each.options["join"] for each in trained} == {2, 5, 10}
    assert {each.options["join"] for each in space.networks(30, systems)} == {1}
    for each in trained:
        recipe_of(request_of(TrainRequest, [*each.words, "--data", "d", "-o", "o.pt"]))


@pytest.fixture
def few(monkeypatch, tmp_path):
    """A small space and few recordings, in a folder of its own."""
    small = {"JOINS": (10,), "PARTS": (1,), "THRESHOLDS": ((1,), (1, 4)), "WINDOWS": (100,), "RAMPS": (16,)}
    for name, values in small.items():
        monkeypatch.setattr(space, name, values)
    monkeypatch.setattr(
        recordings_input, "synthetic_split", lambda split, **_: synthetic_split(split, limit=90)
    )
    monkeypatch.setattr(work, "PRICED", 12)
    monkeypatch.setattr(space, "SIZES", ())
    monkeypatch.setattr(baselines, "PARTS", (1,))
    monkeypatch.setattr(work, "ROUNDS", 2)
    monkeypatch.setattr(folds, "FOLDS", 2)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("target", "table"), [("loihi1", "davies2018"), ("truenorth", "all_in")])
def test_the_command(few, monkeypatch, target, table):
    words = ["smallest", "--data", "synthetic", "--target", target, "--jobs", "1", "-o", "a.loom"]
    found = as_json(*words)
    names = [each["name"] for each in found["tried"]]
    bits = "" if target == "loihi1" else " weight_bits=5"
    for name in ("counters 1 join=10", "counters 1 ramp=16 join=10"):
        assert f"{name}{bits}" in names
    assert any("weight_bits=4" in name for name in names)
    chosen = found["tried"][found["choice"]["cheapest"][table] - 1]
    best = found["tried"][found["choice"]["best"] - 1]
    assert best["behind"] == 0
    assert chosen["rung"] == 3
    assert chosen["costs"]["energy_j"][table] <= best["costs"]["energy_j"][table]
    assert ("whole" in chosen) == (target == "loihi1")  # the other runs whole recordings
    assert all(
        each["whole"]["operations"] > each["costs"]["operations"]
        for each in found["tried"]
        if "whole" in each
    )
    assert chosen["behind"] <= chosen["behind_error"]
    assert found["checked"]["different"] == {"train": 0, "test": 0}
    assert "static power dominates" in found["checked"]["pace"]

    if target == "loihi1":
        certified = as_json(*words, "--budget", "certified=1")["tried"]
        assert len({each.pop("certified") for each in certified if each["rung"] == 3}) > 1
        assert certified == found["tried"]

    # once more from the store alone, and the same by hand
    files = {name: (few / name).read_bytes() for name in ("a.pt", "a.loom")}
    monkeypatch.setattr(work, "measure", lambda _: pytest.fail("it is known"))
    assert as_json(*words) == found
    for command in found["commands"][:2]:
        assert run(*shlex.split(command)[1:])[0] == 0
    assert files == {name: (few / name).read_bytes() for name in files}
    assert as_json(*words, "--budget", "accuracy=100,energy=1nJ", codes=(1,))["choice"]["fits"] is False
    assert "nothing fits" in run(*words, "--budget", "energy=1nJ")[1]


@pytest.fixture
def trained(few, monkeypatch):
    """Two networks that are trained by gradients, for a few epochs, and no others."""
    monkeypatch.setattr(smallest, "counting", lambda *_: [])
    monkeypatch.setattr(space, "SIZES", (("mlp", 8, None, "8", 0.0), ("mlp", 4, None, "none", 0.0)))
    monkeypatch.setattr(space, "STEPS", (10, 10))
    monkeypatch.setattr(study, "other_ways", lambda *_: [])
    monkeypatch.setattr(space, "EPOCHS", (2, 4, 8, 12))
    return few


WORDS = ("smallest", "--data", "synthetic", "--jobs", "1", "-o", "a.loom")


def test_networks_that_are_trained_by_gradients(trained, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(record, "training_record", interrupt)
        assert refusal(*WORDS) == "interrupted; what was found is kept; go on with the same command"
    found = as_json(*WORDS, "--html", "a.html", "--budget", "certified=1")
    large, small = found["tried"]
    assert [each["name"] for each in (large, small)] == [
        f"mlp recipe=rates join=10 features={features} hidden={hidden}"
        for features, hidden in ((8, 8), (4, "none"))
    ]
    assert all(0.01 < each["certified"] <= 1 for each in found["tried"])
    for each in (large, small):
        assert [epochs for epochs, _ in each["curve"]] == [2, 4, 8, 12][: each["rung"]]
        assert each["curve"][-1] == [each["setting"], each["accuracy"]]
        assert each["finished"] == (each["rung"] == 3 or each["finished"])
        assert each["costs"]["operations"] <= each["whole"]["operations"]
    written = (trained / "a.html").read_text()
    assert "no single event alters" in written
    assert "conditions not seen in training were not tested" in written
    (family,) = found["families"]
    assert ("mlp: tried to the end" in written) == family["finished"]
    assert len(found["baselines"]) in (0, 5)
    netlist = (trained / "a.loom").read_bytes()
    for command in found["commands"][:2]:
        assert run(*shlex.split(command)[1:])[0] == 0
    assert (trained / "a.loom").read_bytes() == netlist
    assert "The smallest network for synthetic" in written


@pytest.mark.parametrize(
    ("far", "why"), [(1.0, "more epochs still helped"), (0.0, "behind the best then, it went no further")]
)
def test_a_crippled_network_is_not_called_tried_to_the_end(trained, monkeypatch, far, why):
    monkeypatch.setattr(study, "TRAINED", {1: 1, 2: 1, 3: 1})
    for module in (study, sections):
        monkeypatch.setattr(module, "FAR", far)
    monkeypatch.setattr(space, "SIZES", (("gcn", 4, None, "none", 0.0), ("mlp", 4, None, "none", 0.0)))
    measure = work.measure

    def cripple(job):
        found = measure(job)
        if job.candidate.system == "mlp":  # as if it learned, but late
            early = np.arange(RECORDINGS) < 5 * job.rung
            found["right"] = (np.resize(early, len(found["tried"])) * found["tried"]).tolist()
        return found

    monkeypatch.setattr(work, "measure", cripple)
    status, text, _ = run(*WORDS, "--graph", "manual")
    assert status == 0
    assert "mlp: not tried to the end" in text
    assert why in text


def test_time_that_is_short_is_shared_by_the_rungs(trained, monkeypatch):
    """The first rung of networks takes all of its time: those that were measured go on, the other is said."""
    monkeypatch.setattr(space, "SIZES", (("mlp", 4, None, "none", 0.0), ("gcn", 4, None, "none", 0.0)))
    clock = [0.0]
    monkeypatch.setattr(study.time, "monotonic", lambda: clock[0])
    measure = work.measure

    def slow(job):
        clock[0] += 25.0 if job.rung == 1 and job.fold is not None else 0.1
        return measure(job)

    monkeypatch.setattr(work, "measure", slow)
    words = (*WORDS, "--graph", "manual", "--time", "100s")
    text = run(*words)[1]
    assert "not tried, time was short: gcn" in text
    assert "mlp: " in text
    assert [each["system"] for each in as_json(*words)["tried"]] == ["mlp", "gcn"]  # it goes on


def test_a_rung_tries_one_candidate_however_late_it_is(trained, monkeypatch):
    monkeypatch.setattr(study, "SHARES_OF_TIME", dict.fromkeys(study.SHARES_OF_TIME, (0.0,) * 4))
    (only,) = as_json(*WORDS)["tried"]
    assert only["rung"] >= 3


@pytest.mark.usefixtures("trained")
def test_time_that_is_up_is_said():
    assert "--time: was too short" in refusal(*WORDS, "--time", "0.001s")
    assert "--time 5: is no time" in refusal(*WORDS, "--time", "5")


def test_conditions_are_left_out_in_turn(few):
    data = few / "own"
    table = ["file,label,hand"]
    for split in ("train", "test"):
        grasps = synthetic_split(split, limit=72)
        (data / split).mkdir(parents=True)
        for index, (events, label) in enumerate(zip(grasps.events, grasps.labels, strict=True)):
            name = f"{split}{index}.npy"
            np.save(data / split / name, events)
            table.append(f"{split}/{name},class {label},{'left' if index % 3 else 'right'}")
    (data / "recordings.csv").write_text("\n".join(table))
    words = [
        "smallest",
        "--data",
        data,
        "--graph",
        "manual",
        "--taxels",
        "39",
        "--jobs",
        "1",
        "-o",
        "a.loom",
    ]
    found = as_json(*words[:3], "--jobs", "1", "-o", "a.loom")
    assert found["conditions"] == ["hand=left", "hand=right"]
    chosen = found["tried"][found["choice"]["cheapest"]["davies2018"] - 1]
    assert set(chosen["conditions"]) == {"hand=left", "hand=right"}
    assert 0 < found["at_random"] <= 1
    status, text, _ = run(*words[:3], "--jobs", "1", "-o", "a.loom")
    assert status == 0
    assert "left out in turn: hand=left, hand=right" in text
    assert "% where hand is new" in text
    assert "where all conditions are known it reaches" in text
    other = {"left": "right", "right": "left", "hand": "hand"}
    rows = [row.rsplit(",", 1) for row in table]
    table = [f"{row},{hand if index % 5 else other[hand]}" for index, (row, hand) in enumerate(rows)]
    (data / "recordings.csv").write_text("\n".join(table))
    again = as_json(*words[:3], "--jobs", "1", "-o", "a.loom")  # takes nothing from the store
    assert again["tried"][0]["conditions"] != found["tried"][0]["conditions"]


def test_workers_number_classes_as_the_command_does(tmp_path):
    for name in ("train/s_label_c", "test/s_label_a"):
        (tmp_path / name).parent.mkdir()
        np.save(tmp_path / f"{name}.npy", np.ones((2, 2, 9), np.uint8))
    assert work._training_of(str(tmp_path), 2, 0.02, None, ("a", "c"), ("", "")).labels.tolist() == [1]


def test_a_candidate_that_does_not_spike_is_refused_alone(few, monkeypatch):
    tries = work.cross_validated

    def silent(data, *about):
        if data.plan.thresholds == (1,):
            raise DataError("none of them spikes")
        return tries(data, *about)

    monkeypatch.setattr(work, "cross_validated", silent)
    why = {each["name"]: each.get("refused") for each in as_json(*WORDS)["tried"]}
    assert why["counters 1 join=10"] == "none of them spikes"
    assert why["counters 1,4 join=10"] is None


def test_a_condition_that_holds_all_other_classes(few):
    sides = [folds.Fold(held=np.repeat(side, 2)) for side in ([True, False], [False, True])]
    labels = np.array([0, 0, 1, 1])
    assert baselines.decided(baselines.LINEAR, 1.0, np.eye(4), labels, sides).tolist() == [1, 1, 0, 0]


def test_few_recordings_make_few_folds():
    (parts,) = folds.folds_of(synthetic_split("train", limit=3), 1)
    assert [int(part.held.sum()) for part in parts] == [1, 1, 1]


def test_time_that_ends_before_anything_may_be_chosen_is_said(monkeypatch):
    monkeypatch.setattr(study, "search", lambda *_: [POOL[4], replace(POOL[4], costs=None, refused="why")])
    monkeypatch.setattr(study, "train_all", lambda *_: [])
    refused(OptionError, "--time: was too short", study.try_all, [], [], 2, [], None, None, 10)


def test_a_training_that_is_not_of_this_choice_is_left_alone(trained):
    state = trained / "a.pt.state.whole"
    state.write_bytes(b"weeks of work")
    assert "a.pt.state.whole: is no training state, or was altered; delete it and train anew" in refusal(
        *WORDS
    )
    assert state.read_bytes() == b"weeks of work"


def test_files_that_would_be_lost(few):
    (few / "a.training").mkdir()
    (few / "a.training" / "own.csv").write_text("precious")
    assert "a.training keeps trainings, and holds other files" in refusal(*WORDS)
    assert (few / "a.training" / "own.csv").read_text() == "precious"
    for output in ("a.pt", "missing/a.loom"):
        assert f"-o {output}" in refusal("smallest", "--data", "synthetic", "-o", output)
