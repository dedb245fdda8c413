"""Netlists in hardware: in cores of our own writing (``tests/rtl``) where iverilog is installed, and in those of RANC
where ``SPIKELOOM_RANC`` names a clone of its repository.
"""

import json
import os
import shutil
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from made_files import recordings_folder, sparse_events
from random_crossbars import IN_RANCS_TERMS, crossbars, events
from random_netlists import lively

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.targets.loihi1.netlist import write_netlist
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron
from spikeloom.compiler.targets.truenorth.netlist import RESET_NONE, write_crossbars
from spikeloom.runtime.machines.truenorth.machine import TrueNorth

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "cosimulate.py"
OURS = Path(__file__).with_name("rtl")
STEPS = 6


def script():
    """What the script defines."""
    found = spec_from_file_location("cosimulate", SCRIPT)
    module = sys.modules["cosimulate"] = module_from_spec(found)
    found.loader.exec_module(module)
    return module


cosimulation = script()


@pytest.fixture(params=["ours", "RANC"])
def rtl(request):
    if not shutil.which("iverilog"):
        pytest.skip("iverilog is not installed")
    if request.param == "RANC" and "SPIKELOOM_RANC" not in os.environ:
        pytest.skip("RANC's repository is not named by SPIKELOOM_RANC")
    return OURS if request.param == "ours" else Path(os.environ["SPIKELOOM_RANC"])


def chain():
    """Three places in a row and one above: a neuron that is held at an odd floor, one that two reach late, a voter."""
    draft = Draft()
    for place in ((2, 3), (3, 3), (2, 4)):
        draft.core(*place)
    draft.neuron(
        0, Neuron(weights=(3, -4), threshold=3, negative_threshold=5, negative_saturates=True), layer="held"
    )
    draft.neuron(
        1, Neuron(weights=(2,), threshold=1, reset_mode=RESET_NONE, negative_threshold=9), layer="kept"
    )
    draft.neuron(2, Neuron(weights=(1, 1), threshold=2, leak=-1, initial=1), layer="out")
    draft.neuron(2, Neuron(weights=(1, 1)), layer="lost")
    draft.axon(0, 0, [0])
    draft.axon(0, 1, [0])
    draft.axon(1, 0, [0], line=255)
    draft.axon(2, 0, [0, 1])
    draft.axon(2, 1, [0])
    draft.feed(0, 0, 0)
    draft.feed(1, 0, 1, tick=1)
    draft.wire((0, 0), 1, 255, 15)
    draft.wire((1, 0), 2, 0)
    draft.clock(2, 1, period=2, phase=1)
    draft.vote((2, 0), 1, first=17)
    return draft.netlist(taxels=1, polarities=2, classes=2)


@pytest.fixture
def place(tmp_path):
    write_crossbars(chain(), tmp_path / "net.loom")
    recordings = sparse_events(0, 2, 1, 2, STEPS, rate=0.6)
    recordings_folder(tmp_path / "data", train=recordings, test=recordings, classes=2)
    return tmp_path


def wrong(found) -> int:
    return sum(
        count for name, count in found.items() if name.endswith(("different", "lost", "error_cycles"))
    )


def cosimulated(*words):
    command = [sys.executable, SCRIPT, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_script(place, rtl):
    words = [
        place / "net.loom",
        place / "data",
        "--rtl",
        rtl,
        "--simulator",
        "iverilog",
        "--work",
        place / "work",
    ]
    found = json.loads(cosimulated(*words, "--json").stdout)
    assert wrong(found) == 0
    assert found["spikes"] > 10
    assert found["membranes"] == 2 * 4 * (STEPS + 17)
    assert (found["doubled"], found["exact_ticks"]) == (1, None)
    assert found["clock_hz"] == found["cycles"] / 0.02
    # finished recordings are read, not run again
    kept = next((place / "work").glob("*.json"))
    kept.write_text(kept.read_text("utf-8").replace('"packets_lost": 0', '"packets_lost": 3'), "utf-8")
    again = cosimulated(*words)
    assert again.returncode == 1
    assert "lost in cores: 3" in again.stdout


@pytest.mark.parametrize(
    ("right", "wrong", "what"),
    [
        ("v >= threshold", "v > threshold", "spikes_different"),
        ("- floor : -reset", "- floor : reset", "membranes_different"),
        ("packet_out = scheduler_packet", "packet_out = 0 & scheduler_packet", "outputs_different"),
        ("token_controller_error = 0", "token_controller_error = scheduler_wen", "error_cycles"),
        ("scheduler_clr = 0", "scheduler_clr = scheduler_wen", "packets_lost"),
    ],
)
def test_what_hardware_does_wrong_is_counted(place, right, wrong, what):
    defective(place, right, wrong)
    words = [place / "net.loom", place / "data", "--rtl", place, "--simulator", "iverilog", "--json"]
    done = cosimulated(*words)
    assert done.returncode == 1
    found = json.loads(done.stdout)
    assert found[what] == sum(each[what] for each in found["recordings"].values()) > 0


def test_mistakes_in_one_line(place, monkeypatch):
    words = [place / "net.loom", place / "data", "--rtl", place]

    def refusal(*words):
        done = cosimulated(*words)
        assert done.returncode == 1
        assert "Traceback" not in done.stderr
        return done.stderr

    assert "no Core.v in it; give a clone of github.com/UA-RCL/RANC" in refusal(*words)
    defective(place, "scheduler_wen = here.size() > 0", "scheduler_wen = 0")
    assert "tick 0 does not end" in refusal(*words, "--simulator", "iverilog")
    defective(place, "module Core", "module Score")
    assert "iverilog fails" in refusal(*words, "--simulator", "iverilog")
    assert "File exists" in refusal(*words, "--work", place / "net.loom")
    monkeypatch.setenv("PATH", str(place))
    assert "verilator or iverilog: not found" in refusal(*words)
    write_netlist(lively(), place / "net.loom")
    assert "no hardware description of Intel Loihi 1 is known" in refusal(*words)


def defective(place, right, wrong):
    """A folder's ``Core.v``: ours with one thing wrong."""
    if not shutil.which("iverilog"):
        pytest.skip("iverilog is not installed")
    text = (OURS / "Core.v").read_text("utf-8")
    assert right in text
    (place / "Core.v").write_text(text.replace(right, wrong), "utf-8")


def built(netlist, rtl, folder, ticks):
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return cosimulation.build(
        TrueNorth(netlist), folder, cosimulation.sources_in(str(rtl)), "iverilog", ticks
    )


@settings(max_examples=8)
@given(crossbars(IN_RANCS_TERMS), st.integers(0, 2**31))
def test_any_network(rtl, tmp_path, netlist, seed):
    recording = events(seed, 3, 12)
    try:
        hardware = built(netlist, rtl, tmp_path / "hardware", netlist.ticks(12))
    except ModelError:
        assume(False)
    assert hardware.run(recording).differences == 0


def test_ranc_loses_what_comes_while_a_core_clears(rtl, tmp_path, monkeypatch):
    """All axons of a core with two neurons: the last come while the tick ends, unless in cycles of the other parity."""
    draft = Draft()
    draft.core()
    draft.neuron(0, Neuron(threshold=10**5), layer="count")
    for channel in range(256):
        draft.feed(channel, 0, draft.axon(0, 0, [0]))
    netlist, recording = draft.netlist(taxels=256, polarities=1, classes=1), np.ones((256, 3), np.uint8)
    assert built(netlist, rtl, tmp_path / "even", 3).run(recording).differences == 0
    shifted = tmp_path / "harness.v"
    shifted.write_text(
        cosimulation.HARNESS.read_text("utf-8").replace("since == 16", "since == 17"), "utf-8"
    )
    monkeypatch.setattr(cosimulation, "HARNESS", shifted)
    found = built(netlist, rtl, tmp_path / "odd", 3).run(recording)
    assert (found.packets_lost, found.membranes_different) == ((0, 0) if rtl == OURS else (2, 2))
