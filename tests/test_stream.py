"""A live stream is a run of the whole recording, bit for bit, chip step by chip step; and its own promises."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_netlists import Axon, Neuron, build, large_netlist, netlists, recordings

from spikeloom.compiler import compile_network
from spikeloom.compiler.errors import DataError, NumericRangeError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.formats.checkpoint import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.recordings.evtouch import load_recordings
from spikeloom.runtime.machines.base import machine_for
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.stream import Step, Stream, open_stream
from spikeloom.runtime.machines.votes import class_counts


def voting(netlist: Netlist, classes: int = 3) -> Netlist:
    """Let compartments vote for the classes in turn, and every so often for none."""
    votes = np.arange(netlist.n_compartments) % (classes + 1) - 1
    return replace(netlist, classes=classes, readout_class=read_only(votes))


def lively() -> Netlist:
    """Some hundred compartments, 10 taxels with two polarities, a lag of three steps."""
    return replace(voting(large_netlist(10, proved=True)), taxels=10, polarities=2)


def events_of(netlist: Netlist, seed: int, length: int = 30) -> np.ndarray:
    return (np.random.default_rng(seed).random((netlist.n_inputs, length)) < 0.15).astype(np.uint8)


def play(stream: Stream, events: np.ndarray) -> list[Step]:
    """All steps of a recording (n_inputs, T), to its end."""
    return [*(stream.step(column) for column in events.T), *stream.finish()]


def assert_is_run(netlist: Netlist, steps: list[Step], events: np.ndarray) -> None:
    """Spikes of every layer, votes and decisions of all chip steps are those of the engine."""
    trace = engine.simulate(netlist, events[None], spikes=True, threads=1)
    assert [step.index for step in steps] == list(range(events.shape[1] + netlist.max_depth))
    for layer in range(len(netlist.layers)):
        found = np.array([step.spikes[layer] for step in steps], np.bool_)
        found = found.reshape(len(steps), netlist.layers[layer].neurons)
        expected = np.zeros_like(found)
        ids = netlist.compartments_of(layer)
        expected[:, netlist.neuron[ids]] = trace.spikes[0][:, ids]
        np.testing.assert_array_equal(found, expected, strict=True)
    so_far = np.cumsum(trace.spikes[0], axis=0)
    votes = class_counts(netlist, so_far)
    np.testing.assert_array_equal(
        np.array([s.counts for s in steps], np.int64).reshape(votes.shape), votes, strict=True
    )
    assert [step.decision for step in steps] == votes.argmax(axis=1).tolist()
    if steps:
        np.testing.assert_array_equal(steps[-1].counts, class_counts(netlist, trace.counts.spikes)[0])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.data())
def test_any_network(data):
    netlist = voting(data.draw(netlists(weight_exponents=(-1, 0, 0, 3))), data.draw(st.integers(1, 3)))
    events = data.draw(recordings(netlist, max_length=12))
    stream = open_stream(netlist)
    expected = None
    try:
        engine.simulate(netlist, events[None], threads=1)
    except NumericRangeError as error:
        expected = str(error)
    if expected is None:
        assert_is_run(netlist, play(stream, events), events)
    else:
        with pytest.raises(NumericRangeError) as caught:
            play(stream, events)
        assert str(caught.value) == expected
        with pytest.raises(DataError):
            stream.step(events[:, 0] * 0)


@pytest.mark.parametrize("proved", [True, False])
def test_large_networks(proved):
    netlist = voting(large_netlist(10, proved=proved))
    events = events_of(netlist, 1)
    steps = play(open_stream(netlist), events)
    assert_is_run(netlist, steps, events)
    assert all(any(step.spikes[layer].any() for step in steps) for layer in range(4))


@pytest.fixture(scope="module")
def released_netlist(released_checkpoint: Path) -> Netlist:
    graph = build_graph("manual")
    adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
    return compile_network(expand(read_checkpoint(str(released_checkpoint)), adjacency)).netlist


@pytest.mark.recordings
def test_the_released_network_on_its_recordings(released_netlist, objects_zip, tmp_path):
    write_netlist(released_netlist, tmp_path / "net.loom")
    live = machine_for(tmp_path / "net.loom")
    data = load_recordings(objects_zip, "test", limit=3).events
    # three grasps at the same time, in turns
    streams = [live.stream() for _ in data]
    steps = [[] for _ in data]
    for t in range(data.shape[-1]):
        for stream, taken, recording in zip(streams, steps, data, strict=True):
            taken.append(stream.step(recording[:, :, t]))
    for stream, taken, recording in zip(streams, steps, data, strict=True):
        taken.extend(stream.finish())
        assert_is_run(released_netlist, taken, recording.reshape(released_netlist.n_inputs, -1))
    assert all(taken[-1].counts.sum() > 10 for taken in steps)


def test_reset_forgets_everything():
    netlist = lively()
    stream = open_stream(netlist)
    for length in (0, 7, 30):
        for column in events_of(netlist, 2, length).T:
            stream.step(column)
        if length == 7:
            stream.finish()
        stream.reset()
        assert stream.index == 0
        events = events_of(netlist, 3)
        assert_is_run(netlist, play(stream, events), events)
        stream.reset()


def test_streams_in_threads_share_nothing():
    netlist = lively()
    prepared = engine.prepare(netlist, stepwise=True)
    batch = [events_of(netlist, seed, 60) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        for events, steps in zip(batch, pool.map(lambda e: play(open_stream(prepared), e), batch), strict=True):
            assert_is_run(netlist, steps, events)


@pytest.mark.parametrize("form", [list, np.float32, np.bool_, np.int64, "sensor", "fortran"])
def test_forms_of_events(form):
    netlist = lively()
    events = events_of(netlist, 4)
    shape = (netlist.taxels, netlist.polarities)
    stream = open_stream(netlist)
    steps = []
    for column in events.T:
        if form is list:
            given_events = column.tolist()
        elif form == "sensor":
            given_events = column.reshape(shape)
        elif form == "fortran":
            given_events = np.asfortranarray(column.reshape(shape))
        else:
            given_events = column.astype(form)
        steps.append(stream.step(given_events))
    assert_is_run(netlist, [*steps, *stream.finish()], events)


def test_events_are_not_kept():
    netlist = lively()
    events = events_of(netlist, 5)
    stream = open_stream(netlist)
    steps = []
    reused = np.zeros(netlist.n_inputs, np.uint8)
    for column in events.T:
        reused[:] = column
        steps.append(stream.step(reused))
        reused[:] = 1
    assert_is_run(netlist, [*steps, *stream.finish()], events)


@pytest.mark.parametrize(
    ("counts", "decision", "margin"),
    [([0, 0, 0], 0, 0), ([1, 4, 2], 1, 2), ([3, 5, 5], 1, 0), ([7], 0, 7), ([2, 9], 1, 7)],
)
def test_decision_and_margin(counts, decision, margin):
    step = Step(index=0, spikes=(), counts=np.array(counts))
    assert (step.decision, step.margin) == (decision, margin)


def test_steps_cannot_be_changed():
    step = open_stream(lively()).step(np.ones(20, np.uint8))
    with pytest.raises(FrozenInstanceError):
        step.index = 3
    with pytest.raises(ValueError, match="read-only"):
        step.counts[0] = 3
    with pytest.raises(ValueError, match="read-only"):
        step.spikes[1][0] = True


def test_a_network_without_lag_is_final_at_once():
    netlist = voting(build([Neuron(), Neuron()], [Axon(source=0, targets=((1, 110),))], n_inputs=1, depths=[0]), 1)
    stream = open_stream(netlist)
    assert stream.step([1]).counts.tolist() == [1]
    assert stream.finish() == ()


def test_a_grasp_without_events_ends_like_a_run():
    netlist = lively()
    stream = open_stream(netlist)
    steps = stream.finish()
    assert_is_run(netlist, list(steps), np.zeros((netlist.n_inputs, 0), np.uint8))
    assert len(steps) == 3


SHAPES = "allowed are (10, 2) (taxels, polarities) and (20,); give the events of one bin of this network's sensor"


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (np.zeros(19), f"stream: a bin of shape (19,) found, {SHAPES}"),
        (np.zeros((2, 10)), f"stream: a bin of shape (2, 10) found, {SHAPES}"),
        (np.zeros((20, 1)), f"stream: a bin of shape (20, 1) found, {SHAPES}"),
        (1, f"stream: a bin of shape () found, {SHAPES}"),
        ([[1, 0], [1]], "stream: a bin with rows of unequal length found; give one row per taxel"),
        (["1"] * 20, "stream: a bin of type <U1 found, allowed are numbers and bool; give 0 and 1"),
        ([None] * 20, "stream: a bin of type object found, allowed are numbers and bool; give 0 and 1"),
        ([0] * 19 + [2], "stream: a bin with the value 2 found, "),
        ([0] * 19 + [-1], "stream: a bin with the value -1 found, "),
        ([0] * 19 + [0.5], "stream: a bin with the value 0.5 found, "),
        ([0] * 19 + [np.nan], "stream: a bin with the value nan found, "),
    ],
)
def test_events_that_are_none(events, message):
    if message.endswith("found, "):
        message += "allowed are 0 and 1; give 1 for any number of events of a channel"
    netlist = lively()
    stream = open_stream(netlist)
    with pytest.raises(DataError) as caught:
        stream.step(events)
    assert str(caught.value) == message
    # nothing has happened: the grasp goes on
    good = events_of(netlist, 6)
    assert_is_run(netlist, play(stream, good), good)


def test_nothing_after_the_end():
    stream = open_stream(lively())
    stream.finish()
    with pytest.raises(DataError) as caught:
        stream.step(np.zeros(20))
    assert str(caught.value) == (
        "stream: a step after the end found, finish() or an overflow ends a stream; "
        "call reset() to begin the next grasp"
    )
    with pytest.raises(DataError) as caught:
        stream.finish()
    assert str(caught.value) == ("stream: a second end found, a grasp has one; call reset() to begin the next grasp")


def test_an_overflow_ends_the_stream_until_reset():
    axons = [Axon(source=0, exponent=7, targets=((0, 254), (0, 254))), Axon(source=1, targets=((0, 110),))]
    netlist = build([Neuron()], axons, n_inputs=2, depths=[0])
    stream = open_stream(netlist)
    with pytest.raises(NumericRangeError):
        stream.step([1, 0])
    for again in (lambda: stream.step([0, 0]), stream.finish):
        with pytest.raises(DataError):
            again()
    stream.reset()
    assert stream.step([0, 1]).spikes[0].tolist() == [True]


def test_streams_do_not_load_torch():
    code = (
        "import sys, spikeloom.runtime.machines.loihi1.stream, "
        "spikeloom.runtime.commands.exchange.watch; "
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
