"""The command ``anytime`` and its proof: figures are those of a chip that stopped, and no decision ever changes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import events, own_file, recordings_folder, weights
from numpy.testing import assert_allclose, assert_array_equal
from random_netlists import Axon, Neuron, build, large_netlist, netlists, recordings

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.formats.counters import counting_network
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.recordings.events import load_data, of_length
from spikeloom.models.recordings.grasps import synthetic_split
from spikeloom.models.training.counters import Plan, counters_of, fit, run_counters
from spikeloom.runtime import cli
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.capabilities import LONGEST, Stoppable
from spikeloom.runtime.machines.loihi1 import engine, kernel
from spikeloom.runtime.machines.loihi1.costs import cost, estimate
from spikeloom.runtime.machines.loihi1.trace import Counts
from spikeloom.runtime.machines.votes import class_counts, predictions
from spikeloom.runtime.studies.anytime import exits

STEPS = 60

WORDS = ("anytime", "net.loom", "--data", "data")
ALL = (*WORDS, "--calibrate", "data")


def made(seed, samples):
    return events(seed, samples=samples, steps=STEPS, rate=0.3)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, a checkpoint and its netlist."""
    folder = tmp_path_factory.mktemp("anytime")
    recordings_folder(folder / "data", train=made(1, 40), test=made(2, 12))
    own_file(folder / "net.pt", last=weights(3, gain=2.5))
    assert cli.main(["compile", str(folder / "net.pt"), "-o", str(folder / "net.loom"), "--json"]) == 0
    return folder


@pytest.fixture
def report(as_json, place):
    """What the command found with everything, made once."""
    if not (place / "all.json").exists():
        found = as_json(*ALL, "--differ", "0.25", "-o", "all.json")
        assert json.loads((place / "all.json").read_text()) == found
    return json.loads((place / "all.json").read_text())


def test_a_netlist_in_which_nobody_votes(as_json, place, monkeypatch):
    monkeypatch.chdir(place)
    netlist = read_netlist("net.loom")
    write_netlist(replace(netlist, readout_class=0 * netlist.readout_class - 1), "mute.loom")
    assert as_json("anytime", "mute.loom", "--data", "data", "--limit", "2")["rules"]


def test_all_figures_of_a_stopped_chip(report, place, monkeypatch):
    monkeypatch.chdir(place)
    netlist, data = read_netlist("net.loom"), load_data("data", "test")
    target, flat = load_target("loihi1"), with_clocks(data.events, netlist.clocks)
    stepped, meter = engine.prepare(netlist, stepwise=True), cost.prepare(netlist, target)
    assert [rule["allowed"] for rule in report["rules"]] == [None, 0.0, 0.005, 0.01, 0.02, 0.05, 0.25]
    assert report["chosen"] == 6
    full, whole = engine.simulate(netlist, flat), estimate.estimate(netlist, target, flat)[1]
    joule = {name: each.sum(axis=1) for name, each in whole.costs.energy.items()}
    second = {name: each.duration_ns.sum(axis=1) * 1e-9 for name, each in whole.simple.items()}
    assert report["decisions"] == predictions(netlist, full.counts.spikes).tolist()
    for rule in (report["rules"][0], report["rules"][6]):
        for i, ends in enumerate(rule["samples"]["chip_steps"]):
            state = kernel.state_of(netlist)
            engine.advance(stepped, state, flat[i], length=STEPS, steps=ends)
            updates = np.bincount(netlist.layer, state.updates)[None].astype(np.int64)
            counts = Counts(
                inputs=state.inputs[None],
                **dict.fromkeys(("spikes", "votes"), state.spikes[None]),
                **{"updates": updates, "saturations": 0 * updates},
            )
            assert rule["samples"]["decisions"][i] == predictions(netlist, counts.spikes)[0]
            found = cost.price(meter, counts, ends)
            left = whole.costs.synaptic_operations[i].sum() - found.synaptic_operations.sum()
            assert rule["samples"]["saved_operations"][i] == left
            for name, each in found.energy.items():
                assert_allclose(
                    rule["samples"]["saved_energy_j"][name][i], joule[name][i] - each.sum(), atol=1e-18
                )
            spent = whole.simple["sanafe"].duration_ns[i, :ends].sum() * 1e-9
            assert_allclose(
                rule["samples"]["saved_time_s"]["sanafe"][i], second["sanafe"][i] - spent, atol=1e-15
            )
    proof = report["rules"][0]
    assert proof["differ"] == proof["gained"] == proof["lost"] == 0
    assert proof["samples"]["decisions"] == report["decisions"]
    saved = np.mean(proof["samples"]["saved_energy_j"]["sanafe"])
    assert_allclose(proof["mean"]["energy_j"]["sanafe"], joule["sanafe"].mean() - saved)


def test_windows_are_those_of_shortened_recordings(report):
    netlist, data = read_netlist("net.loom"), load_data("data", "test")
    assert [window["percent"] for window in report["windows"]] == list(range(5, 101, 5))
    for window in report["windows"]:
        steps = max(STEPS * window["percent"] // 100, 1)
        assert window["bins"] == steps
        flat = with_clocks(data.events[..., :steps], netlist.clocks)
        decided = predictions(netlist, engine.simulate(netlist, flat).counts.spikes)
        assert window["chip"]["correct"] == np.count_nonzero(decided == data.labels)


def test_recordings_of_different_length_end_on_their_own(place, monkeypatch):
    monkeypatch.chdir(place)
    netlist, data = read_netlist("net.loom"), load_data("data", "test")
    lengths = np.array([60, 1, 7, 24, 33, 2, 50, 59, 60, 60, 3, 40])
    ran = Stoppable.required(machine_of(netlist)).cumulative(data.events, lengths)
    at = exits.standing(ran.votes, lengths)
    sure = exits.proven(ran.votes, at, exits.most_votes(Stoppable.required(machine_of(netlist)), STEPS))
    ends = exits.exits(sure, at)
    assert np.all(ends < lengths)
    for i, length in enumerate(lengths):
        flat = with_clocks(data.events[i : i + 1, ..., :length], netlist.clocks)
        trace, alone = estimate.estimate(netlist, load_target("loihi1"), flat)
        assert_array_equal(ran.votes[i, -1], class_counts(netlist, trace.counts.spikes)[0])
        assert at.leader[i, ends[i]] == predictions(netlist, trace.counts.spikes)[0]
        assert ran.operations[i, -1] == alone.costs.synaptic_operations.sum()
        for name, each in alone.costs.energy.items():
            assert_allclose(ran.energy[name][i, -1], each.sum())
        assert_allclose(ran.time["sanafe"][i, -1], alone.simple["sanafe"].duration_ns.sum() * 1e-9)


def test_held_out_recordings_calibrate_by_their_decisions(as_json, report, place, monkeypatch):
    monkeypatch.chdir(place)
    seen = load_data("data", "train")
    lengths = np.full(len(seen), STEPS)
    votes = Stoppable.required(machine_of(read_netlist("net.loom"))).cumulative(seen.events, lengths).votes
    held, races = (exits.turning_points(race(votes, lengths)) for race in (exits.standing, exits.races))
    factors = [rule["factor"] for rule in as_json(*ALL, "--held-out")["rules"][1:]]
    assert factors == [exits.calibrate(held, allowed).factor for allowed in (0.0, 0.005, 0.01, 0.02, 0.05)]
    assert report["rules"][1]["factor"] == exits.calibrate(races, 0.0).factor != factors[0]


@st.composite
def gains(draw):
    """Votes of each step: (samples, steps, classes) 0 or 1, and the steps of each recording."""
    samples, steps, classes = draw(st.integers(1, 4)), draw(st.integers(1, 12)), draw(st.integers(1, 4))
    bits = draw(
        st.lists(st.booleans(), min_size=samples * steps * classes, max_size=samples * steps * classes)
    )
    found = np.array(bits, np.int64).reshape(samples, steps, classes)
    lengths = np.array(draw(st.lists(st.integers(1, steps), min_size=samples, max_size=samples)))
    return found * (np.arange(steps) < lengths[:, None])[:, :, None], lengths


def settled(votes, lengths, most=None):
    at = exits.standing(votes, lengths)
    steps = votes.shape[1]
    one_each = np.broadcast_to(np.arange(steps + 1), (votes.shape[2], steps + 1))
    return at, exits.proven(votes, at, one_each if most is None else most)


@given(gains(), st.floats(0, 5))
def test_the_proof_changes_no_decision_comes_as_early_as_one_can_and_factors_end_earlier(drawn, factor):
    gained, lengths = drawn
    votes = np.cumsum(gained, axis=1)
    at, sure = settled(votes, lengths)
    ends = exits.exits(sure, at)
    assert np.all(ends < lengths)
    assert np.all(exits.exits(sure, at, factor) <= ends)
    assert np.all(exits.exits(sure, at, factor) <= exits.exits(sure, at, factor + 0.5))
    for i, end in enumerate(ends):
        assert at.leader[i, end] == vote(votes[i, -1:])[0] == at.decision[i]
        for step in range(lengths[i]):
            left = lengths[i] - 1 - step
            rivals = votes[i, step] + left * (1 - np.eye(votes.shape[2], dtype=int))[at.leader[i, step]]
            # what may follow at worst: every rival gets a vote in every step, the leader none
            assert sure[i, step] == (np.argmax(rivals) == at.leader[i, step])


@given(gains())
def test_no_factor_from_the_turning_point_on_changes_a_decision(drawn):
    gained, lengths = drawn
    at = exits.standing(np.cumsum(gained, axis=1), lengths)
    never = np.zeros(at.leader.shape, bool)
    never[:, -1] = True
    points = exits.turning_points(at)
    for i, point in enumerate(points):
        for factor in (point, point * 1.5 + 0.01):
            end = exits.exits(never, at, factor)[i]
            assert at.leader[i, end] == at.decision[i]
        if point > 0:
            end = exits.exits(never, at, np.nextafter(point, 0))[i]
            assert at.leader[i, end] != at.decision[i]


def test_races_are_for_second_place():
    gained = np.array([[[1, 0, 1], [1, 1, 0], [1, 1, 0]]])
    at = exits.races(np.cumsum(gained, axis=1), np.array([3]))
    assert at.leader.tolist() == [[2, 1, 1]]
    assert exits.turning_points(at).tolist() == [pytest.approx(1 / np.sqrt(2))]
    two = exits.races(np.cumsum(gained[..., :2], axis=1), np.array([3]))
    assert two.leader.tolist() == [[0, 0, 0]]
    assert exits.turning_points(two).tolist() == [0]


def test_calibration_allows_what_it_says():
    points = np.concatenate([np.zeros(90), np.arange(1.0, 11)])
    for allowed, factor, differ in ((0.0, 10.0, 0), (0.01, 9.0, 1), (0.05, 5.0, 5), (0.1, 0.0, 10)):
        found = exits.calibrate(points, allowed)
        assert (found.factor, found.differ, found.races) == (factor, differ, 100)
        assert np.count_nonzero(points > found.factor) <= allowed * 100
    # 1 - 0.05 ** (1 / 100): no failure among a hundred
    assert exits.calibrate(points, 0.0).bound == round(1 - 0.05**0.01, 4)


def two_classes(*neurons):
    """Output neurons of classes 0, 1, …; input 0 excites all of them by 100."""
    netlist = build(
        list(neurons),
        [Axon(source=0, targets=tuple((i, 100) for i in range(len(neurons))))],
        n_inputs=1,
        depths=[0],
    )
    return replace(netlist, classes=len(neurons), readout_class=read_only(range(len(neurons))))


def test_how_often_an_output_neuron_can_spike():
    netlist = two_classes(
        Neuron(threshold=99),
        Neuron(threshold=100),
        Neuron(threshold=110, decay_v=3277),
        Neuron(threshold=124, decay_v=3277),  # 100 + 19.99 + … stays below 125
        Neuron(threshold=125, decay_v=3277),
        Neuron(threshold=250, decay_v=0),
        Neuron(threshold=150, decay_u=2047),  # the current adds up to twice the weight
        Neuron(threshold=1, bias=-101, bias_exponent=6),
    )
    assert Stoppable.required(machine_of(netlist)).least_intervals.tolist() == [1, 2, 2, 4, 0, 3, 1, 0]
    most = exits.most_votes(Stoppable.required(machine_of(netlist)), 5)[[0, 1, 3, 4]]
    assert most.tolist() == [[0, 1, 2, 3, 4, 5], [0, 1, 1, 2, 2, 3], [0, 1, 1, 1, 1, 2], [0] * 6]
    slow = two_classes(Neuron(threshold=2**17 - 1, decay_v=0), Neuron(threshold=1))
    quiet = replace(slow, bias_mantissa=read_only([0, 0]), synapse_weight=read_only([2, 2]))
    assert Stoppable.required(machine_of(quiet)).least_intervals.tolist() == [
        LONGEST,
        1,
    ]  # looked at only so far


@given(st.data())
def test_no_output_neuron_spikes_more_often(data):
    netlist = data.draw(netlists())
    votes = np.arange(netlist.n_compartments) % 4 - (netlist.n_compartments > 1)
    netlist = replace(netlist, classes=4, readout_class=read_only(votes))
    events = data.draw(recordings(netlist, max_length=12))
    try:
        spikes = engine.simulate(netlist, events[None], spikes=True, threads=1).spikes[0]
    except NumericRangeError:
        return
    voters = np.flatnonzero(netlist.readout_class >= 0)
    machine = Stoppable.required(machine_of(netlist))
    length = events.shape[1]
    for voter, interval, steady in zip(voters, machine.least_intervals, machine.steady, strict=True):
        times = np.flatnonzero(spikes[:, voter])
        end = length + netlist.layers[netlist.layer[voter]].depth
        assert not steady or len(times) == (end - times[0] if len(times) else 0)
        assert interval or not len(times)
        assert np.all(np.diff(times) >= interval)
    if length:
        counted = machine.cumulative(events[None, :, None], np.array([length])).votes
        at = exits.standing(counted, np.array([length]))
        sure = exits.proven(counted, at, exits.most_votes(machine, length))
        assert np.all(at.leader[sure] == at.decision[0])


def test_a_vote_that_never_ceases_is_a_proof():
    training, seen = (synthetic_split(split, limit=48) for split in ("train", "test"))
    data = run_counters(training, Plan())
    made = counters_of(data, fit(data, 6), training, 6)
    machine = Stoppable.required(machine_of(compile_network(counting_network(made)).netlist))
    steps = of_length(seen, made.clocks.length)
    ran = machine.cumulative(steps.events, steps.step_counts)
    at = exits.standing(ran.votes, steps.step_counts)
    most, steady = exits.most_votes(machine, steps.steps), exits.steady_classes(machine)
    assert steady.all()
    ends = exits.exits(exits.proven(ran.votes, at, most, steady), at)
    assert_array_equal(ends, (ran.votes > 0).any(axis=2).argmax(axis=1))  # with the first vote
    assert_array_equal(at.leader[np.arange(48), ends], at.decision)
    assert np.all(ends < exits.exits(exits.proven(ran.votes, at, most), at))
    netlist = large_netlist(10, proved=True)
    assert not Stoppable.required(machine_of(netlist)).steady.any()
