"""When a vote is decided: the proof never changes a decision and is never late, calibration keeps its word."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from random_netlists import Axon, Neuron, build, large_netlist, netlists, recordings

from spikeloom.compiler import compile_network
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.machines.integer import LONGEST, integer_machine_of
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cumulative
from spikeloom.runtime.machines.votes import predictions
from spikeloom.runtime.studies.anytime import exits


@st.composite
def gains(draw):
    """Votes of each step: (samples, steps, classes) 0 or 1, and the steps of each recording."""
    samples, steps, classes = draw(st.integers(1, 4)), draw(st.integers(1, 12)), draw(st.integers(1, 4))
    bits = draw(st.lists(st.booleans(), min_size=samples * steps * classes, max_size=samples * steps * classes))
    found = np.array(bits, np.int64).reshape(samples, steps, classes)
    lengths = np.array(draw(st.lists(st.integers(1, steps), min_size=samples, max_size=samples)))
    return found * (np.arange(steps) < lengths[:, None])[:, :, None], lengths


def settled(votes, lengths, most=None):
    at = exits.standing(votes, lengths)
    steps = votes.shape[1]
    one_each = np.broadcast_to(np.arange(steps + 1), (votes.shape[2], steps + 1))
    return at, exits.proven(votes, at, one_each if most is None else most)


@given(gains())
def test_the_proof_changes_no_decision_and_comes_as_early_as_one_can(drawn):
    gained, lengths = drawn
    votes = np.cumsum(gained, axis=1)
    at, sure = settled(votes, lengths)
    ends = exits.exits(sure, at)
    assert np.all(ends < lengths)
    for i, end in enumerate(ends):
        assert at.leader[i, end] == vote(votes[i, -1:])[0] == at.decision[i]
        for step in range(lengths[i]):
            left = lengths[i] - 1 - step
            rivals = votes[i, step] + left * (1 - np.eye(votes.shape[2], dtype=int))[at.leader[i, step]]
            # what may follow at worst: every rival gets a vote in every step, the leader none
            assert sure[i, step] == (np.argmax(rivals) == at.leader[i, step])


@given(gains(), st.floats(0, 5))
def test_an_infinite_factor_is_the_proof_alone_and_smaller_ones_end_earlier(drawn, factor):
    gained, lengths = drawn
    votes = np.cumsum(gained, axis=1)
    at, sure = settled(votes, lengths)
    assert np.all(exits.exits(sure, at, factor) <= exits.exits(sure, at))
    assert np.all(exits.exits(sure, at, factor) <= exits.exits(sure, at, factor + 0.5))


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


def test_a_small_vote_step_by_step():
    gained = np.array([[[0, 1], [0, 1], [0, 1], [0, 0], [1, 0]], [[1, 0], [0, 0], [0, 1], [0, 0], [0, 0]]])
    at, sure = settled(np.cumsum(gained, axis=1), np.array([5, 4]))
    assert at.leader.tolist() == [[1, 1, 1, 1, 1], [0, 0, 0, 0, 0]]
    assert at.lead.tolist() == [[1, 2, 3, 3, 2], [1, 1, 0, 0, 0]]
    assert at.left.tolist() == [[4, 3, 2, 1, 0], [3, 2, 1, 0, 0]]
    # class 1 needs more than can come; class 0 wins ties
    assert sure.tolist() == [[False, False, True, True, True], [False, False, False, True, True]]
    assert exits.exits(sure, at).tolist() == [2, 3]
    assert exits.exits(sure, at, 0.7).tolist() == [1, 1]
    assert at.confidence[0].round(3).tolist() == [0.5, 1.155, 2.121, 3.0, np.inf]


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
    assert integer_machine_of(netlist).least_intervals.tolist() == [1, 2, 2, 4, 0, 3, 1, 0]
    most = exits.most_votes(integer_machine_of(netlist), 5)[[0, 1, 3, 4]]
    assert most.tolist() == [[0, 1, 2, 3, 4, 5], [0, 1, 1, 2, 2, 3], [0, 1, 1, 1, 1, 2], [0] * 6]


def test_slow_neurons_are_looked_at_only_so_far():
    netlist = two_classes(Neuron(threshold=2**17 - 1, decay_v=0), Neuron(threshold=1))
    quiet = replace(netlist, bias_mantissa=read_only([0, 0]), synapse_weight=read_only([2, 2]))
    assert integer_machine_of(quiet).least_intervals.tolist() == [LONGEST, 1]


@settings(deadline=None)
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
    for voter, interval in zip(voters, integer_machine_of(netlist).least_intervals, strict=True):
        times = np.flatnonzero(spikes[:, voter])
        assert interval or not len(times)
        assert np.all(np.diff(times) >= interval)
    length = events.shape[1]
    if length:
        counted = cumulative.votes_of(netlist, events[None], np.array([length]))
        at = exits.standing(counted, np.array([length]))
        sure = exits.proven(counted, at, exits.most_votes(integer_machine_of(netlist), length))
        assert np.all(at.leader[sure] == at.decision[0])


def test_live_and_recorded_votes_end_alike():
    netlist = large_netlist(10, proved=True)
    netlist = replace(netlist, classes=3, readout_class=read_only(np.arange(netlist.n_compartments) % 4 - 1))
    events = (np.random.default_rng(1).random((6, netlist.n_inputs, 40)) < 0.3).astype(np.uint8)
    lengths = np.full(6, 40)
    machine = integer_machine_of(netlist)
    votes, depth = cumulative.votes_of(netlist, events, lengths), machine.read_out_lag
    at = exits.standing(votes, lengths)
    sure = exits.proven(votes, at, exits.most_votes(machine, 40))
    assert depth == 3
    for factor in (np.inf, 2.0, 0.0):
        may_end = exits.live(machine, 40, factor)
        assert not may_end(depth - 1, votes[0, 0])
        for i, end in enumerate(exits.exits(sure, at, factor)):
            ended = [may_end(step + depth, votes[i, step]) for step in range(40)]
            assert ended.index(True) == end


@pytest.mark.recordings
@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("which", ["objects", "containers"])
def test_no_recording_is_decided_otherwise_by_proof(which, split, shipped_netlists, request):
    netlist = shipped_netlists[which]
    data = load_data(request.getfixturevalue(f"{which}_zip"), split)
    lengths = np.full(len(data), data.steps)
    votes = cumulative.votes_of(netlist, with_clocks(data.events, netlist.clocks), lengths)
    at = exits.standing(votes, lengths)
    sure = exits.proven(votes, at, exits.most_votes(integer_machine_of(netlist), data.steps))
    ends = exits.exits(sure, at)
    assert_array_equal(at.leader[np.arange(len(data)), ends], at.decision)
    counts = engine.simulate(netlist, with_clocks(data.events, netlist.clocks)).counts.spikes
    assert_array_equal(at.decision, predictions(netlist, counts))
    assert ends.mean() < 0.95 * data.steps


@pytest.fixture(scope="module")
def shipped_netlists():
    """Netlists of the shipped checkpoints, scales from their weights."""
    found = {}
    for name in ("objects", "containers"):
        checkpoint = read_checkpoint(shipped(f"pretrained:{name}"))
        adjacency = normalised_adjacency(checkpoint.edges, checkpoint.taxels)
        found[name] = compile_network(expand(checkpoint, adjacency)).netlist
    return found
