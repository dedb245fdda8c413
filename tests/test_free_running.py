"""Chips that nobody resets: what blank steps clear, and that then each recording is simulated as it runs in a row."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from oracles import refused
from random_netlists import SIMULATORS, Axon, Neuron, build, by_engine, netlists, recordings

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.loihi1.idle import forgotten
from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.runtime.machines.loihi1.machine import Loihi


def one(blank=0, **registers):
    """A neuron with an input of two thresholds."""
    built = build([Neuron(**registers)], [Axon(source=0, targets=((0, 200),))], n_inputs=1, depths=[0])
    return replace(built, blank=blank)


@pytest.mark.parametrize("simulate", SIMULATORS)
def test_biases_act_in_all_steps_and_votes_are_those_of_data(simulate):
    trace = simulate(one(blank=2, decay_v=2048, bias=1000), np.array([[0, 1, 0]], np.uint8))
    assert trace.membranes[:, 0].tolist() == [1750, 14675, 1000, 1500, 1750]  # 1000 and 1500 came before
    counts = simulate(one(blank=4, bias=3500, bias_exponent=1), np.zeros((1, 3), np.uint8)).counts
    assert (counts.spikes.tolist(), counts.votes.tolist(), counts.updates.tolist()) == ([7], [3], [7])


def test_what_blank_steps_leave():
    assert forgotten(one()).steps == 6  # of 6,400, the threshold: 1279, 255, 50, 9, 1, 0
    for registers, restless, unsettled in (
        ({"bias": 3, "decay_u": 2048}, 0, 0),
        ({"bias": 5}, 0, 1),  # of 5 nothing is kept, of 6 is 1: both stay
        ({"bias": 3500, "bias_exponent": 1}, 0, 0),  # it fires in every step, and is reset
        ({"bias": 3000, "bias_exponent": 1}, 1, 0),  # it fires in every other
    ):
        found = forgotten(one(**registers))
        assert (found.restless, found.unsettled, found.residue > 0) == (restless, unsettled, unsettled > 0)
    for registers in ({"decay_v": 0}, {"decay_v": 1, "threshold": 100_000}):
        refused(OptionError, "do not decay, or not in 4096 blank steps", forgotten, one(**registers))


@given(data=st.data())
def test_where_nothing_is_left_a_row_is_each_alone(data):
    netlist = data.draw(netlists(weight_exponents=(-1, 0)))
    registers = {name: np.maximum(getattr(netlist, name), 3277) for name in ("decay_u", "decay_v")}
    registers |= {"bias_mantissa": np.clip(netlist.bias_mantissa, -3, 3), "bias_exponent": 0 * netlist.layer}
    found = forgotten(netlist := replace(netlist, **registers))
    assume(not found.restless + found.unsettled)
    netlist, row = replace(netlist, blank=found.steps), [data.draw(recordings(netlist)) for _ in range(3)]
    pauses = [np.pad(events, ((0, 0), (0, netlist.blank))) for events in row]
    whole, ends = (
        by_engine(netlist, np.concatenate(pauses, axis=1)),
        np.cumsum([each.shape[1] for each in pauses]),
    )
    for events, end in zip(row, ends.tolist(), strict=True):
        alone = by_engine(netlist, events)
        for name in ("spikes", "membranes"):
            assert_array_equal(getattr(alone, name), getattr(whole, name)[end - len(alone.spikes) : end])
    events = np.stack([np.pad(each, ((0, 0), (0, 10 - each.shape[1])))[:, None] for each in row])
    machine, lengths = Loihi(netlist), np.array([each.shape[1] for each in row])
    assert machine.check(events, lengths=lengths) == 0
    assert_array_equal(machine.in_a_row(events, lengths), machine.run(events, lengths=lengths).votes)


def test_commands(spikeloom, as_json, refusal):
    facts = as_json("compile", "net.pt", "--weight-bits", "8", "--free-running", "-o", "free.loom")[
        "free_running"
    ]
    windows, free = (as_json("estimate", name, "--data", "data") for name in ("net.loom", "free.loom"))
    paces = [
        each["static"][0]["real_time_j"] / each["static"][0]["chip_w"] / 0.02 for each in (windows, free)
    ]
    assert paces[1] - paces[0] == pytest.approx(facts["steps"])
    assert free["chip_steps"] - windows["chip_steps"] == facts["steps"] - read_netlist("net.loom").max_depth
    assert [any("reset of" in line for line in each["not_priced"]) for each in (windows, free)] == [
        True,
        False,
    ]
    data = ("--checkpoint", "net.pt", "--data", "data")
    verdict = as_json("verify", "free.loom", *data)
    assert (verdict["row_different"], verdict["spec_equals_engine"]) == (0, True)
    assert verdict["ladder"][-1]["stage"] == "free_running"
    for command, options in (("explain", data), ("anytime", data[2:]), ("certify", data[2:])):
        assert refusal(command, "free.loom", *options).startswith(
            "netlist: is free-running, which this cannot take"
        )
    assert refusal("export", "free.loom", "--to", "onnx", "-o", "x.onnx").startswith(
        "onnx: a free-running netlist"
    )
    write_netlist(replace(read_netlist("free.loom"), blank=facts["steps"] - 1), "short.loom")
    code, out, _ = spikeloom("verify", "short.loom", "--checkpoint", "net.pt")
    assert (code, "blank steps instead of" in out) == (1, True)
