"""Counting networks: what they count, what they decide, their file, and that the chip has every spike of theirs."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import as_json, refusal, run
from made_files import recorded, recordings_folder, sparse_events
from numpy.testing import assert_array_equal
from oracles import refused

import spikeloom
from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.compiler.formats.counters import BLOCK, counting_network, read_counters, write_counters
from spikeloom.compiler.interpret import channels_last, float_simulation
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.recordings.events import joined_bins, load_data, of_length
from spikeloom.models.training import counters
from spikeloom.models.training.counters import (
    Plan,
    Rule,
    counters_of,
    cross_validate,
    fit,
    fit_rules,
    run_counters,
    split_folds,
)
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.studies.counting import decisions_of
from spikeloom.runtime.studies.robustness.bench import Bench, distances, whole
from spikeloom.runtime.studies.robustness.pair import Pair, evaluate
from spikeloom.runtime.studies.robustness.perturbations import SAMPLED, warm_state
from spikeloom.runtime.studies.robustness.sampled import clean

CLASSES, TAXELS, STEPS = 3, 4, 40
PLANS = [
    Plan(thresholds=(1, 3, 8), ramp=64),
    Plan(thresholds=(2,), parts=3, ramp=40),
    Plan(thresholds=(1, 4), parts=2, bins=2, window=75, bits=4),
]


def made(seed=0, samples=30, rate=0.3):
    """Recordings of classes that differ in how often each taxel sends, and late or early."""
    rng = np.random.default_rng(seed)
    labels = np.arange(samples) % CLASSES
    often = np.random.default_rng(9).random((CLASSES, TAXELS, 2, 4)).repeat(STEPS // 4, axis=3)
    events = sparse_events(rng, samples, TAXELS, 2, STEPS, rate=2 * rate * often[labels])
    return recorded(events, labels)


def network_spikes(counters, data):
    network = counting_network(counters)
    steps = of_length(joined_bins(data, counters.bins), counters.clocks.length)
    spikes = float_simulation(network).run(channels_last(steps.events, counters.clocks)).spikes
    return {population.name: each for population, each in zip(network.populations, spikes, strict=True)}


@pytest.mark.parametrize("plan", PLANS, ids=str)
def test_counters_spike_as_they_are_trained_to(plan):
    data = run_counters(made(), plan)
    fitted = fit(data, CLASSES)
    counters = counters_of(data, fitted, made(), CLASSES)
    found = network_spikes(counters, other := made(seed=1))
    wanted = run_counters(other, plan, data.steps)
    for threshold in plan.thresholds:
        rows = np.flatnonzero(counters.counter[:, 2] == threshold)
        places = [np.flatnonzero((wanted.counter == counters.counter[row]).all(axis=1))[0] for row in rows]
        spikes = found[f"count{threshold}"][:, : data.steps]
        assert_array_equal(spikes.sum(axis=1), wanted.spikes[:, places])
        first = np.where(spikes.any(axis=1), spikes.argmax(axis=1), data.steps)
        assert_array_equal(first, wanted.at[:, places])


@pytest.mark.parametrize("plan", PLANS, ids=str)
def test_the_largest_sum_is_that_of_any_recording_after_any_step(plan, monkeypatch):
    monkeypatch.setattr(counters, "TOGETHER", 7)
    data = run_counters(made(), plan)
    used = np.arange(1, len(data.counter), 2)
    rule = Rule(
        used=used, weight=np.random.default_rng(2).integers(-9, 9, (CLASSES, len(used))).astype(float)
    )
    sums = [
        rule.weight @ np.where(at <= step, spikes, 0)
        for at, spikes in zip(data.at[:, used], data.spikes[:, used], strict=True)
        for step in range(data.steps)
    ]
    assert rule.highest(data) == np.max(sums)
    assert rule.highest(data.part(data.spikes.sum(axis=1) < 0)) == -np.inf
    assert rule.highest(replace(data, spikes=0 * data.spikes)) == 0


def test_a_counter_is_blocked_for_a_while_and_not_for_ever():
    data = made(samples=3)
    events = np.zeros((3, TAXELS, 2, 400), np.uint8)
    for sample, ones in enumerate((2 * 3 + BLOCK - 1, 2 * 3 + BLOCK, 400)):
        events[sample, 0, 0, :ones] = 1
    spikes = run_counters(replace(data, held=events), Plan(thresholds=(3,))).spikes
    assert spikes[:, 0].tolist() == [1, 2, 4]
    busy = recorded(np.ones((1, 1, 1, 40_000), np.uint8), np.zeros(1, np.int64))
    assert run_counters(busy, Plan(thresholds=(1, 4))).spikes.tolist() == [[313, 306]]


@pytest.mark.parametrize("plan", PLANS, ids=str)
def test_network_decides_as_its_rule_and_the_chip_has_every_spike(plan):
    training, other = made(), made(seed=1)
    data = run_counters(training, plan)
    fitted = fit(data, CLASSES)
    counters = counters_of(data, fitted, training, CLASSES)
    whole = (
        counters.weight @ data.spikes[:, [*map(data.counter.tolist().index, counters.counter.tolist())]].T
    )
    decided = decisions_of(counters, training)
    tie = np.sort(whole, axis=0)[-1] - np.sort(whole, axis=0)[-2] < 2 * counters.slope
    assert_array_equal(decided[~tie], whole.argmax(axis=0)[~tie])
    assert np.mean(decisions_of(counters, other) == other.labels) > 0.6
    netlist = compile_network(counting_network(counters)).netlist
    machine = machine_of(netlist)
    steps = of_length(joined_bins(other, counters.bins), netlist.clocks.length).events
    assert machine.check(steps[:4], lengths=None) == 0
    ran = machine.run(steps, spikes=True)
    for name, spikes in network_spikes(counters, other).items():
        held = ~machine.unread[machine.layers.index(name)]
        assert_array_equal(ran.spikes[name][..., held], spikes[..., held])
    assert_array_equal(ran.decisions, decisions_of(counters, other))


@pytest.mark.parametrize("plan", PLANS, ids=str)
def test_stress_runs_them_to_the_end_of_their_ramp(plan):
    data = run_counters(made(), plan)
    counters = counters_of(data, fit(data, CLASSES), made(), CLASSES)
    network, other = counting_network(counters), made(seed=1)
    pair = Pair(netlist=compile_network(network).netlist, network=network)
    lengths = np.full(len(other), STEPS)
    nearness = distances(TAXELS, None, None)
    bench = Bench(
        pair=pair,
        distance=nearness,
        events=other.events,
        labels=other.labels,
        files=other.files,
        lengths=lengths,
    )
    late = SAMPLED["start_late"](other.events, 5)
    for found, recordings in (
        (clean(bench)[0], other),
        (evaluate(pair, whole(late, pair.netlist, lengths)), replace(other, held=late)),
    ):
        for side in ("float", "chip"):
            assert_array_equal(found.decisions(side), decisions_of(counters, recordings))
    assert set(warm_state(bench, 1, np.random.default_rng(0)).lengths) == {2 * counters.clocks.length}


def counters_file(place, plan=PLANS[1]):
    data = run_counters(made(), plan)
    counters = counters_of(data, fit(data, CLASSES), made(), CLASSES).trained({"seen": 3})
    write_counters(place, counters)
    return counters


def test_file_and_back(tmp_path):
    counters = counters_file(tmp_path / "c.pt")
    again, _ = read_counters(tmp_path / "c.pt")
    write_counters(tmp_path / "d.pt", again)
    assert (tmp_path / "c.pt").read_bytes() == (tmp_path / "d.pt").read_bytes()
    assert again.training == {"seen": 3}
    assert_array_equal(again.weight, counters.weight)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: replace(c, weight=c.weight + 200), "weight is no table"),
        (lambda c: replace(c, weight=c.weight[:, 1:]), "weight is no table"),
        (lambda c: replace(c, counter=np.add(c.counter, (0, 3, 0))), "do not exist"),
        (lambda c: replace(c, counter=c.counter * 0), "do not exist"),
        (lambda c: replace(c, taxels=0), "no usable taxels"),
        (lambda c: replace(c, taxels=2**20), "more than 1,048,576 channels"),
        (lambda c: replace(c, threshold=-1.0), "no usable threshold"),
        (lambda c: replace(c, ramp=2**20), "more than 1,048,576 steps"),
        (lambda c: c, "does not match its hash|is truncated"),  # once a byte is another
    ],
)
def test_inconsistent_and_damaged_files_are_refused(tmp_path, change, said):
    path = tmp_path / "c.pt"
    whole = counters_file(path)
    write_counters(path, made := change(whole))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= made is whole
    path.write_bytes(content)
    with pytest.raises(ModelError, match=rf"c\.pt: .*({said}).*; copy or train it again"):
        read_counters(path)


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        (Plan(thresholds=(4, 4)), "--thresholds 4,4"),
        (Plan(thresholds=(0,)), "--thresholds 0"),
        (Plan(parts=0), "--parts 0"),
        (Plan(ramp=0), "--ramp 0"),
        (Plan(parts=41), "--parts 41: a recording has 40 steps"),
    ],
)
def test_impossible_plans_are_refused(plan, said):
    refused(OptionError, said, run_counters, made(), plan)


def test_recordings_without_events_are_refused():
    silent = replace(made(), held=np.zeros((30, TAXELS, 2, STEPS), np.uint8))
    refused(DataError, "none of them spikes", fit, run_counters(silent, PLANS[0]), CLASSES)


@pytest.mark.parametrize("most", [2000, 0])
@pytest.mark.parametrize("plan", PLANS, ids=str)
def test_rule_is_where_the_loss_is_flat(plan, most, monkeypatch):
    """By the pairs of recordings, and by the counters where recordings are many."""
    monkeypatch.setattr(counters, "MOST_ALIKE", most)
    data = run_counters(made(samples=200, rate=0.2), plan)
    for strength, rule in fit_rules(data, CLASSES, [3.0, 0.01, 0.3]).items():
        sign = np.where(data.labels[:, None] == np.arange(CLASSES), 1, -1)
        short = np.maximum(1 - sign * rule.sums(data), 0)
        slope = rule.weight.T - 2 * strength * data.spikes[:, rule.used].T @ (sign * short)
        assert np.abs(slope).max() < 1e-8


def test_levels_are_told_apart_by_their_boundaries():
    data, rng = made(samples=90), np.random.default_rng(0)
    events = np.zeros_like(data.events)
    events[:, 3, 1, 0] = 1
    for sample, label in enumerate(data.labels):  # a level more is two channels more, whichever
        channel = rng.permutation(7)[: 1 + 2 * label]
        events[sample, channel // 2, channel % 2, 0] = 1
    plan = Plan(thresholds=(1,), strengths=(0.3,))
    right = [
        np.mean(
            cross_validate(run_counters(replace(data, held=events), each), CLASSES)[0.3].argmax(axis=1)
            == data.labels
        )
        for each in (plan, replace(plan, levels=3))
    ]
    assert right[0] < 0.9
    assert right[1] == 1
    refused(OptionError, "--levels 2: 3 classes", fit, run_counters(data, replace(plan, levels=2)), CLASSES)


def test_folds_share_out_every_class():
    labels = np.repeat([0, 1, 2], [10, 7, 3])
    fold = split_folds(labels, 5, np.random.default_rng(0))
    assert np.ptp(np.bincount(fold)) == 0
    assert all(np.ptp(np.bincount(fold[labels == each], minlength=5)) <= 1 for each in range(3))


def test_commands_take_a_counting_network(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    recordings_folder(
        tmp_path / "data", train=made(samples=90).events, test=made(seed=1).events, classes=CLASSES
    )
    words = "train --data data --system counters --join 5 --window 50 --parts 2 -o c.pt"
    record = as_json(*words.split())["record"]
    assert record["test_correct"] > 15
    shown = as_json("inspect", "c.pt")["training"]
    assert (shown["plan"]["bins"], shown["strength"]) == (5, record["strength"])
    assert "whatever its own length" in run("compile", "c.pt", "--calibrate", "data", "-o", "c.loom")[1]
    found = as_json("verify", "c.loom", "--checkpoint", "c.pt", "--data", "data")
    share = record["test_correct"] / record["test_samples"]
    assert found["accuracy"] == {"float": share, "chip": share}
    few = ["c.loom", "--checkpoint", "c.pt", "--data", "data", "--limit", "3"]
    decided = as_json("run", "c.loom", "--data", "data", "--limit", "3")
    page = as_json("report", *few, "-o", "c.html")
    assert page["decisions"]["chip"] == decided["predictions"]
    assert page["recording"]["votes"]["chip"] == decided["counts"][0]
    words = "chart c.pt --data data --grid bits=8,window=50%/100% --jobs 1 -o ch"
    points = as_json(*words.split())["points"]
    half = as_json("run", "c.loom", "--data", "data", "--window", "50")
    right = sum(map(int.__eq__, half["predictions"], half["labels"]))
    assert [point["test"]["correct"] for point in points] == [right, record["test_correct"]]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A network of 40 steps that count and 40 to read out, its netlist and its recordings."""
    folder = tmp_path_factory.mktemp("counters")
    counters_file(folder / "c.pt")
    recordings_folder(folder / "data", train=made().events, test=made(seed=1).events, classes=CLASSES)
    as_json("compile", folder / "c.pt", "--weight-bits", "8", "-o", folder / "c.loom")
    return folder / "c.pt", folder / "c.loom", folder / "data"


def test_what_is_taken_away_is_measured_to_the_end_of_the_ramp(trained, tmp_path):
    network, _, data = trained
    found = as_json("lean", network, "--data", data, "--differ", "0.3", "-o", tmp_path / "l.loom")
    row = found["rows"][found["taken"]]
    assert row["name"] != "nothing"
    costs = as_json("estimate", tmp_path / "l.loom", "--data", data)
    assert costs["per_inference"]["synaptic_operations"] == pytest.approx(row["operations"])
    decided = as_json("run", tmp_path / "l.loom", "--data", data)
    assert sum(map(int.__eq__, decided["predictions"], decided["labels"])) == row["test"]["right"] > 10


def test_events_that_come_too_late_are_said(trained, tmp_path):
    network, netlist, data = trained
    late = np.zeros((2, TAXELS, 2, 100), np.uint8)
    late[:, 0, 0, [3, 79, 80, 99]] = 1
    recordings_folder(tmp_path / "late", train=late, test=late, classes=CLASSES)
    for command, *words in (("run",), ("estimate",), ("verify", "--checkpoint", network)):
        said = run(command, netlist, *words, "--data", tmp_path / "late")[2]
        line = "6 events after the network's 40 steps: they may move votes until step 80, later ones are not used"
        assert said == f"spikeloom: warning: late: {line}\n"
        assert not run(command, netlist, *words, "--data", data)[2]


def test_live_it_runs_to_the_end_of_the_ramp(trained, tmp_path, capsys):
    _, netlist, data = trained
    decided = as_json("run", netlist, "--data", data)
    events = load_data(data, "test").events
    stream = spikeloom.load(str(netlist)).stream()
    for sample in (0, 1):
        for column in np.moveaxis(events[sample], -1, 0):
            step = stream.step(column)
        assert not step.counts.any()
        *rest, last = stream.finish()
        assert (last.counts.tolist(), rest[39].index) == (decided["counts"][sample], 79)
        stream.reset()
    for column in np.moveaxis(events[1], -1, 0):
        step = stream.step(column)
    assert "not final" in str(step)
    assert (stream.decision, stream.decision) == (decided["predictions"][1], decided["predictions"][1])
    stream.reset()
    refused(DataError, "no decision found", lambda: spikeloom.load(str(netlist)).stream().decision)
    for _ in range(80):
        step = stream.step(events[0, ..., 0])
    assert stream.step(np.zeros_like(events[0, ..., 0])).counts.tolist() == step.counts.tolist()
    assert not capsys.readouterr().err
    assert stream.step(events[0, ..., 0] | 1).index == 79
    assert "events after the network's 80 steps: not used" in capsys.readouterr().err
    stream.step(events[0, ..., 0] | 1)
    assert not capsys.readouterr().err
    lines = [
        f"{t * 0.02:.2f},{taxel},{polarity}\n"
        for t, taxel, polarity in np.argwhere(events[0].transpose(2, 0, 1))
    ]
    (tmp_path / "lines.csv").write_text("".join(lines))
    for words in ((), ("--bins", "80")):
        shown = run("watch", netlist, "--input", tmp_path / "lines.csv", *words, "--json")[1].splitlines()
        assert json.loads(shown[-2])["counts"] == decided["counts"][0]
    for bins in ("40", "81"):
        told = f"--bins {bins}: the network runs every grasp for 80 steps"
        assert told in refusal("watch", netlist, "--input", tmp_path / "lines.csv", "--bins", bins)


def test_a_nir_file_knows_how_long_a_recording_is_run(trained, tmp_path):
    counters_file(tmp_path / "c.pt", replace(PLANS[0], bins=2))
    as_json("compile", tmp_path / "c.pt", "-o", tmp_path / "c.loom")
    as_json("export", tmp_path / "c.loom", "--to", "nir", "-o", tmp_path / "c.nir")
    as_json("compile", tmp_path / "c.nir", "-o", tmp_path / "n.loom")
    decided = [
        as_json("run", tmp_path / f"{name}.loom", "--data", trained[2])["predictions"] for name in "cn"
    ]
    assert decided[0] == decided[1]
    assert len(set(decided[0])) == CLASSES
    for form, suffix in (("onnx", "onnx"), ("sanafe", "yaml")):
        as_json("export", tmp_path / "c.loom", "--to", form, "-o", tmp_path / f"c.{suffix}")
        assert b"every recording is run for 84 steps" in (tmp_path / f"c.{suffix}").read_bytes()


def test_anytime_counts_the_steps_of_the_ramp_too(trained):
    told = run("anytime", trained[1], "--data", trained[2])[1]
    assert "\n  run    steps  " in told
    assert "\n  50 %      40  " in told
    assert "--bins 80 --until-sure" in told
