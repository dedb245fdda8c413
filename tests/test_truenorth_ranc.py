"""Files for RANC's simulator: their schema, and equal spikes where its binary is named by ``RANC_SIM``."""

import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_files import recordings_folder
from random_crossbars import WEIGHTS, alone, crossbars, events

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats import ranc
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_NONE, write_crossbars
from spikeloom.runtime import cli
from spikeloom.runtime.machines.truenorth import spec

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
