"""A live stream is a run of the whole recording, bit for bit, chip step by chip step; and its own promises."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_netlists import Axon, Neuron, build, lively, netlists, recordings, voting

from spikeloom.compiler.errors import DataError, NumericRangeError
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.stream import Step, Stream
from spikeloom.runtime.machines.votes import class_counts


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


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.data())
def test_any_network(data):
    netlist = voting(data.draw(netlists(weight_exponents=(-1, 0, 0, 3))), data.draw(st.integers(1, 3)))
    events = data.draw(recordings(netlist, max_length=12))
    stream = Stream(engine.prepare(netlist, stepwise=True))
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


FORMS = {
    "list": lambda column: column.tolist(),
    "float32": lambda column: column.astype(np.float32),
    "bool": lambda column: column.astype(np.bool_),
    "int64": lambda column: column.astype(np.int64),
    "sensor": lambda column: column.reshape(10, 2),
    "fortran": lambda column: np.asfortranarray(column.reshape(10, 2)),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_forms_of_events(form):
    netlist = lively()
    events = events_of(netlist, 4)
    stream, steps = Stream(engine.prepare(netlist, stepwise=True)), []
    for column in events.T:
        given_events = form(column)
        steps.append(stream.step(given_events))
        if isinstance(given_events, np.ndarray) and not np.shares_memory(given_events, events):
            given_events[:] = 1  # is not kept
    assert_is_run(netlist, [*steps, *stream.finish()], events)


@pytest.mark.parametrize(
    ("counts", "decision", "margin"),
    [([0, 0, 0], 0, 0), ([1, 4, 2], 1, 2), ([3, 5, 5], 1, 0), ([7], 0, 7), ([2, 9], 1, 7)],
)
def test_decision_and_margin(counts, decision, margin):
    step = Step(index=0, spikes=(), counts=np.array(counts))
    assert (step.decision, step.margin) == (decision, margin)


def test_a_network_without_lag_is_final_at_once():
    netlist = voting(build([Neuron(), Neuron()], [Axon(source=0, targets=((1, 110),))], n_inputs=1, depths=[0]), 1)
    stream = Stream(engine.prepare(netlist, stepwise=True))
    assert stream.step([1]).counts.tolist() == [1]
    assert stream.finish() == ()


@pytest.mark.parametrize(
    ("events", "found"),
    [
        (np.zeros(19), r"shape \(19,\) found, allowed are \(10, 2\) \(taxels, polarities\) and \(20,\)"),
        (1, r"shape \(\) found"),
        (["1"] * 20, "type <U1 found, allowed are numbers and bool"),
        ([0] * 19 + [2], "the value 2 found, allowed are 0 and 1"),
    ],
)
def test_events_that_are_none(events, found):
    netlist = lively()
    stream = Stream(engine.prepare(netlist, stepwise=True))
    with pytest.raises(DataError, match=f"stream: a bin .*{found}"):
        stream.step(events)
    # nothing has happened: the grasp goes on
    good = events_of(netlist, 6)
    assert_is_run(netlist, play(stream, good), good)


def test_nothing_after_the_end():
    stream = Stream(engine.prepare(lively(), stepwise=True))
    stream.finish()
    with pytest.raises(DataError, match=r"a step after the end found.*call reset\(\)"):
        stream.step(np.zeros(20))
    with pytest.raises(DataError, match=r"a second end found.*call reset\(\)"):
        stream.finish()


def test_an_overflow_ends_the_stream_until_reset():
    axons = [Axon(source=0, exponent=7, targets=((0, 254), (0, 254))), Axon(source=1, targets=((0, 110),))]
    netlist = build([Neuron()], axons, n_inputs=2, depths=[0])
    stream = Stream(engine.prepare(netlist, stepwise=True))
    with pytest.raises(NumericRangeError):
        stream.step([1, 0])
    for again in (lambda: stream.step([0, 0]), stream.finish):
        with pytest.raises(DataError):
            again()
    stream.reset()
    assert stream.step([0, 1]).spikes[0].tolist() == [True]
