"""Crossbar cores: the specification by hand, the engine against it, and RANC's simulator if ``RANC_SIM`` names it."""

import json
import os
import re
import subprocess
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_files import recordings_folder
from random_crossbars import CHIP, WEIGHTS, alone, assert_same, both, crossbars, events, recording_of, relays

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats import ranc
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, history_free
from spikeloom.compiler.targets.truenorth.legalize import faults
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_NONE, RESET_TO, write_crossbars
from spikeloom.runtime import cli
from spikeloom.runtime.machines.truenorth import engine, spec


# -- one neuron --------------------------------------------------------------------------------------------------------
def lives(neuron: Neuron, arrivals: list[int]) -> tuple[list[int], list[int]]:
    """Membranes at the ends of ticks and ticks with spikes of a neuron to which weights of type 0 arrive."""
    state = spec.Neuron(**{each.name: getattr(neuron, each.name, neuron.initial) for each in fields(spec.Neuron)})
    held, spikes = [], []
    for tick, arrived in enumerate(arrivals):
        spiked, _ = spec.neuron_tick(state, max(arrived, 0), max(-arrived, 0), 0, 20)
        held.append(state.membrane)
        spikes += [tick] * spiked
    return held, spikes


@pytest.mark.parametrize(
    ("neuron", "arrivals", "held", "spikes"),
    [
        # at least the threshold, not above it; leak comes before the comparison
        (Neuron(threshold=3), [2, 1, 5], [2, 0, 0], [1, 2]),
        (Neuron(threshold=3, leak=1), [2, 0, 1], [0, 1, 0], [0, 2]),
        # three resets
        (Neuron(threshold=3, reset_mode=RESET_TO, reset=2), [7, 0, 0], [2, 2, 2], [0]),
        (Neuron(threshold=3, reset_mode=RESET_LINEAR), [7, 0, 0], [4, 1, 1], [0, 1]),
        (Neuron(threshold=3, reset_mode=RESET_NONE), [7, 0, -5], [7, 7, 2], [0, 1]),
        # below the negative threshold: the same resets with the other sign, or saturation; at it nothing happens
        (Neuron(threshold=9, negative_threshold=4, reset=2), [-4, -1], [-4, -2], []),
        (Neuron(threshold=9, negative_threshold=4, reset_mode=RESET_LINEAR), [-7, 0], [-3, -3], []),
        (Neuron(threshold=9, negative_threshold=4, reset_mode=RESET_NONE), [-7, 0], [-7, -7], []),
        (Neuron(threshold=9, negative_threshold=4, negative_saturates=True), [-7, 1], [-4, -3], []),
        # leak: one direction, or by the sign of the membrane, which it does not change
        (Neuron(threshold=9, leak=-2, negative_threshold=99), [3, 0, 0], [1, -1, -3], []),
        (Neuron(threshold=9, leak=-2, leak_reversal=True, negative_threshold=99), [3, 0, 0], [1, 0, 0], []),
        (Neuron(threshold=9, leak=-2, leak_reversal=True, negative_threshold=99), [-5, 0, 0], [-3, -1, 0], []),
        (Neuron(threshold=9, leak=2, leak_reversal=True, negative_threshold=99), [-1, 0, 0], [-3, -5, -7], []),
        (Neuron(threshold=9, leak=2, leak_reversal=True, negative_threshold=99), [0, 0], [0, 0], []),
        # history-free: the threshold is the leak
        (history_free((1, 0, 0, 0), 3), [2, 2, 3, 0, -9, 4], [0] * 6, [2, 5]),
        # the register saturates at both ends
        (Neuron(threshold=2**18 - 1, reset_mode=RESET_NONE, initial=2**19 - 1), [5, -3], [524287, 524284], [0, 1]),
        (Neuron(negative_threshold=2**18 - 1, reset_mode=RESET_NONE, initial=-(2**19)), [-5], [-524288], []),
    ],
)
def test_a_neuron_by_hand(neuron, arrivals, held, spikes):
    assert lives(neuron, arrivals) == (held, spikes)


def test_a_register_that_some_order_would_leave_is_counted():
    neuron = spec.Neuron(0, False, 2**18 - 1, 0, RESET_NONE, 0, 0, True, 524_280)
    assert spec.neuron_tick(neuron, 10, 10, 0, 20) == (True, True)
    assert neuron.membrane == 524_280
    assert spec.neuron_tick(neuron, 7, 10, 0, 20) == (True, False)


# -- ticks, delays, clocks ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("delay", [1, 2, 15])
def test_when_spikes_arrive(delay):
    netlist = relays(delay=delay, tick=2, first=20).netlist(taxels=1, polarities=1, classes=1, bin_ticks=3)
    trace = both(netlist, np.array([[1, 0, 1]], np.uint8))
    assert int(trace.counts.ticks) == 3 * 3 + 20
    assert [np.flatnonzero(row).tolist() for row in trace.spikes.T] == [[2, 8], [2 + delay, 8 + delay]]


@pytest.mark.parametrize(("first", "votes"), [(0, 2), (1, 3), (2, 2), (3, 2), (4, 1), (5, 0)])
def test_votes_count_in_their_window_only(first, votes):
    netlist = relays(first=first).netlist(taxels=1, polarities=1, classes=1)
    assert both(netlist, np.array([[1, 0, 1, 1]], np.uint8)).counts.votes.tolist() == [0, votes]


def test_spikes_that_meet_on_an_axon_are_one():
    draft = alone(Neuron(threshold=2), channels=2)
    draft.clock(0, 0, period=2, phase=1)
    netlist = draft.netlist(taxels=2, polarities=1, classes=1)
    trace = both(netlist, np.array([[1, 1, 0, 0], [1, 0, 0, 0]], np.uint8))
    assert trace.counts.axons.tolist() == [3]
    assert int(trace.counts.merged) == 2
    assert np.flatnonzero(trace.spikes[:, 0]).tolist() == [1]
    assert trace.membranes[:, 0].tolist() == [1, 0, 0, 1]


# -- engine = specification --------------------------------------------------------------------------------------------
@settings(max_examples=80, deadline=None)
@given(crossbars(), st.integers(0, 2**31))
def test_engine_equals_specification(netlist, seed):
    assert faults(netlist, CHIP) == ()
    both(netlist, events(seed, 3, 20), seed=seed)


@settings(max_examples=15, deadline=None)
@given(crossbars(), st.integers(0, 2**31))
def test_recordings_of_a_batch_do_not_depend_on_each_other(netlist, seed):
    recordings, lengths = events(seed, 3, 12, samples=3), np.array([12, 7, 1])
    batch = engine.simulate(netlist, recordings, lengths=lengths, spikes=True, membranes=True)
    for sample, steps in enumerate(lengths):
        assert_same(spec.simulate(netlist, recordings[sample, :, :steps]), recording_of(batch, sample))


def large():
    """Ten full cores of history-free neurons that feed each other: 2,500 neurons, every line in use."""
    rng, draft = np.random.default_rng(7), Draft()
    for core in range(10):
        draft.core(core, 0)
        for number in range(250):
            neuron = Neuron(leak=-1, leak_reversal=True, threshold=9, reset_mode=RESET_LINEAR, negative_threshold=50)
            weights = tuple(int(weight) for weight in rng.integers(-3, 5, 4))
            draft.neuron(core, history_free(weights, 6) if core % 2 else neuron, layer="layer0", number=number)
        for _ in range(256):
            draft.axon(core, int(rng.integers(4)), rng.choice(250, 60, replace=False).tolist())
        for line in range(78):
            draft.feed(line, core, line)
    for core in range(10):
        for number in range(250):
            if number % 50 == 0:
                draft.vote((core, number), core % 3)
            else:
                draft.wire((core, number), int(rng.integers(10)), 78 + number % 178, 1 + number % 15)
    return draft.netlist(taxels=39, polarities=2, classes=3)


def test_full_cores_and_many_ticks():
    netlist, recording = large(), (np.random.default_rng(1).random((78, 60)) < 0.05).astype(np.uint8)
    assert faults(netlist, CHIP) == ()
    assert 1000 < both(netlist, recording).counts.spikes.sum() < 2500 * 60


def test_a_membrane_that_climbs_to_the_end_of_its_register():
    """A neuron that is given more in every tick than a spike takes from it."""
    draft = alone(Neuron(weights=(255, 0, 0, 0), reset_mode=RESET_LINEAR, negative_saturates=True), channels=0)
    draft.vote((0, 0), 0)
    draft.clock(0, 0, period=1)
    netlist = draft.netlist(taxels=1, polarities=1, classes=1)
    assert both(netlist, np.zeros((1, 2100), np.uint8)).counts.overflows.sum() > 0  # 254 a tick, 2**19 after 2,064
    assert [engine.prepare(netlist, careful=careful).wiring.steady.shape[1] for careful in (False, True)] == [1, 0]


def test_random_thresholds_depend_on_the_seed_alone():
    draft = alone(Neuron(threshold=0, leak=3, mask_bits=3), channels=0)
    netlist = draft.netlist(taxels=1, polarities=1, classes=1)
    silence = np.zeros((1, 1, 400), np.uint8)
    runs = [engine.simulate(netlist, silence, seed=seed).counts.spikes.item() for seed in (0, 0, 1)]
    assert runs[0] == runs[1] != runs[2]
    # eta is uniform in 0 … 7: of the resting values 3, 6, 9 … the first reached spikes with 4/8, the second 7/8
    assert 200 < runs[0] < 330


SHARED_WITH_RANC = st.builds(
    Neuron,
    weights=st.tuples(WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS),
    leak=st.integers(-5, 5),
    threshold=st.integers(0, 20),
    reset_mode=st.integers(0, 1),
    reset=st.integers(-4, 4),
    negative_threshold=st.integers(0, 20),
    initial=st.integers(-9, 9),
)


def small(**changes):
    """Two cores with a corner of the mesh at (5, 2); the second neuron votes, the third has no target."""
    draft = Draft()
    draft.core(5, 2)
    draft.core(6, 3)
    draft.neuron(0, Neuron(weights=(0, 4, 0, 0), threshold=3, negative_threshold=2, **changes), layer="layer0")
    for number in range(2):
        draft.neuron(1, Neuron(weights=(0, 0, 0, 1), reset_mode=RESET_LINEAR), layer="layer1", number=number)
    draft.axon(0, 1, [0])
    draft.axon(1, 3, [0, 1], line=2)
    draft.feed(0, 0, 0, tick=1)
    draft.clock(1, 2, period=3, phase=1)
    draft.wire((0, 0), 1, 2, 15)
    draft.vote((1, 0), 0, first=1)
    return draft.netlist(taxels=1, polarities=1, classes=1, bin_ticks=2)


def test_schema():
    written = json.loads("\n".join(ranc.export(small(), np.array([[1, 0]], np.uint8))))
    assert {key: value for key, value in written.items() if key.startswith(("num", "max", "neuron_r"))} == {
        "num_neurons": 256,
        "num_axons": 256,
        "num_weights": 4,
        "num_cores_x": 2,
        "num_cores_y": 3,
        "max_tick_offset": 16,
        "neuron_reset_type": 0,
    }
    assert written["output_bus"] == {"coordinates": [0, 2], "num_outputs": 2}
    packet = {"destination_core": [1, 1], "destination_axon": 2, "destination_tick": 0}
    fed = {"destination_core": [0, 0], "destination_axon": 0, "destination_tick": 0}
    assert written["packets"] == [[], [fed, packet], [], [], [packet]]
    first, second = written["cores"]
    assert first == {
        "axons": [1],
        "connections": [[1]],
        "coordinates": [0, 0],
        "neurons": [
            {
                "weights": [0, 4, 0, 0],
                "leak": 0,
                "positive_threshold": 3,
                "negative_threshold": -2,
                "reset_potential": 0,
                "reset_mode": 0,
                "current_potential": 0,
                "destination_core_offset": [1, 1],
                "destination_axon": 2,
                "destination_tick": 14,
            }
        ],
    }
    assert second["axons"] == [0, 0, 3]
    assert second["connections"] == [[0, 0, 1], [0, 0, 1]]
    voter, lost = second["neurons"]
    assert (voter["destination_core_offset"], voter["destination_axon"], voter["destination_tick"]) == ([-1, 1], 0, 0)
    assert (lost["destination_core_offset"], lost["destination_axon"]) == ([-1, 1], 1)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"leak": -1, "leak_reversal": True}, "a leak with reversal (1 neurons)"),
        ({"mask_bits": 1}, "a random threshold (1 neurons)"),
        ({"reset_mode": RESET_NONE}, "a reset that does nothing (1 neurons)"),
        ({"negative_saturates": True}, "a negative threshold that saturates (1 neurons)"),
    ],
)
def test_what_ranc_has_not(changes, what):
    with pytest.raises(ModelError, match=f"RANC has no {re.escape(what)}"):
        list(ranc.export(small(**changes)))


def test_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    draft = alone(Neuron(), channels=0)
    draft.feed(3, 0, 0)
    draft.vote((0, 0), 0, first=2)
    write_crossbars(draft.netlist(taxels=2, polarities=2, classes=2), "net.loom")
    recordings = np.zeros((2, 2, 2, 5), np.uint8)
    recordings[0, 1, 1, [0, 4]] = recordings[1, 1, 1, [1, 4]] = 1
    recordings_folder(tmp_path / "data", train=recordings, test=recordings)
    words = ["export", "net.loom", "--to", "ranc", "-o", "net.json"]
    assert cli.main(words) == 0
    assert json.loads(Path("net.json").read_text("utf-8"))["packets"] == [[]]
    first, second = capsys.readouterr().out.splitlines()
    assert "1 neurons and 1 synapses for ranc" in first
    assert second.startswith("run: ranc_sim net.json net.out net.json TICKS")
    words += ["--data", "data", "--json", "--recording"]
    assert cli.main([*words, "1"]) == 0
    assert json.loads(capsys.readouterr().out)["ticks"] == 5 + 2 + 1
    packets = json.loads(Path("net.json").read_text("utf-8"))["packets"]
    assert [len(tick) for tick in packets] == [0, 1, 0, 0, 1, 0, 0]
    assert cli.main([*words, "2"]) == 2
    assert "--recording 2: --data has recordings 0 to 1" in capsys.readouterr().err


@pytest.fixture(scope="module")
def simulator():
    path = os.environ.get("RANC_SIM")
    if not path:
        pytest.skip("RANC's simulator is not named by RANC_SIM")
    return path


def outputs_of(text, voters):
    """Spikes of the voters, (ticks, voters), from RANC's output of a run of one tick more."""
    rows = [[word == "1" for word in line.split()] for line in text.splitlines() if line.strip()]
    assert {len(row) for row in rows} == {voters + 1}  # the last is the share of all others
    return np.array(rows[1:], np.bool_).reshape(-1, voters + 1)[:, :voters]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(crossbars(SHARED_WITH_RANC), st.integers(0, 2**31))
def test_ranc_spikes_the_same(simulator, tmp_path, netlist, seed):
    recording = events(seed, 3, 20)
    expected = spec.simulate(netlist, recording)
    voters = np.flatnonzero(netlist.readout_class >= 0)
    source, result = tmp_path / "in.json", tmp_path / "out.txt"
    source.write_text("\n".join(ranc.export(netlist, recording)), "utf-8")
    ticks = str(int(expected.counts.ticks) + 1)
    done = subprocess.run([simulator, source, result, source, ticks], capture_output=True, text=True, check=True)
    assert "ERROR" not in done.stdout
    np.testing.assert_array_equal(outputs_of(result.read_text("utf-8"), len(voters)), expected.spikes[:, voters])
