"""History-free networks whose sums travel in time: levels, every spike on the chip, saturation, and the commands."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import STEPS, own_file, recordings_folder
from random_crossbars import assert_same
from random_networks import chain

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.interpret import run_float
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.builder import crossing_points
from spikeloom.compiler.targets.truenorth.codebook import (
    BIN_TICKS,
    COPIES,
    MOST,
    WEIGHTS,
    Layer,
    LevelNetwork,
    codebook,
    in_levels,
    run_levels,
)
from spikeloom.compiler.targets.truenorth.in_time import first_spikes, lower_in_time
from spikeloom.compiler.targets.truenorth.legalize import faults
from spikeloom.runtime.machines.truenorth import engine, spec

CHIP = load_target("truenorth")
NARROW = replace(CHIP, limits=dict(CHIP.limits) | {"core.axons": replace(CHIP.limits["core.axons"], value=60)})
"""The same chip with few axons, so that small layers are split."""


def forgetful(seed, *sizes, spread=0.5, bias=0.3):
    rng = np.random.default_rng(seed)
    weights = [rng.normal(0, spread, (after, before)) for before, after in pairwise(sizes)]
    return chain(*weights, biases=[rng.normal(0, bias, len(weight)) for weight in weights], beta=0.0)


def assert_equal(levels, netlist, recording):
    """Every spike of every copy is the model's, in its tick, and no other tick of its data has one."""
    trace = engine.simulate(netlist, recording[None], spikes=True, membranes=True)
    assert_same(spec.simulate(netlist, recording), replace_first(trace))
    assert trace.counts.overflows.sum() == 0
    model = run_levels(levels, recording)
    steps = recording.shape[1]
    for index, (name, first) in enumerate(first_spikes(levels).items()):
        chosen = np.flatnonzero(netlist.layer == netlist.layers.index(name))
        on_chip = trace.spikes[0, first : first + steps * BIN_TICKS][:, chosen]
        due = np.zeros_like(on_chip)
        due[::BIN_TICKS] = model.spikes[index][:, netlist.neuron[chosen]]
        np.testing.assert_array_equal(on_chip, due, name)
    votes = np.zeros(levels.classes, int)
    np.add.at(votes, netlist.readout_class[netlist.readout_class >= 0],
              trace.counts.votes[0, netlist.readout_class >= 0])  # fmt: skip
    expected = np.bincount(levels.label, weights=model.spikes[-1].sum(axis=0), minlength=levels.classes)
    np.testing.assert_array_equal(votes, expected)
    return model


def replace_first(trace):
    counts = type(trace.counts)(**{n: getattr(trace.counts, n)[0] for n in trace.counts.__dataclass_fields__})
    return type(trace)(counts=counts, spikes=trace.spikes[0], membranes=trace.membranes[0])


# -- levels ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copies", COPIES)
def test_axons_make_every_level(copies):
    low, high = (-1, 1) if copies == 2 else (-(1 << copies - 1), (1 << copies - 1) - 1)
    levels = np.arange(low, high + 1)
    made = crossing_points(levels, WEIGHTS[copies]) @ np.array(WEIGHTS[copies])
    np.testing.assert_array_equal(made, levels)


@pytest.mark.parametrize("largest", [1, 2, 3, -4])
def test_weights_in_levels_are_found_again(largest):
    weight = 0.37 * np.array([[largest, 0, 1, -1], [largest, largest, 0, 0]])
    book = codebook(weight, 3)
    np.testing.assert_allclose(book.level * book.step[:, None], weight, rtol=1e-6)


def test_a_network_in_levels_is_the_float_network_with_rounded_weights():
    network = forgetful(0, 20, 15, 8, 4)
    levels = in_levels(network, 3, CHIP)
    books = [codebook(projection.weight.toarray(), 3) for projection in network.projections]
    rounded = chain(
        *((book.level * book.step[:, None]).astype(np.float64) for book in books),
        biases=[population.bias for population in network.populations],
        beta=0.0,
    )
    events = (np.random.default_rng(1).random((20, 30)) < 0.3).astype(np.uint8)
    found = run_levels(levels, events)
    for mine, expected in zip(found.spikes, run_float(rounded, events.T[None]).spikes, strict=True):
        np.testing.assert_array_equal(mine, expected[0])
    assert found.partial == found.saturated == found.largest == (0, 0, 0)


def test_partial_sums_saturate_and_are_counted():
    layer = Layer(name="fc1", level=np.full((1, 60), 1), threshold=np.array([MOST + 21]), copies=2, width=40)
    network = LevelNetwork(taxels=60, polarities=1, classes=1, layers=(layer,), label=np.array([0]))
    events = np.zeros((60, 3), np.uint8)
    events[:25, 0] = events[:19, 1] = 1
    events[40:, :2] = 1
    found = run_levels(network, events)
    assert (found.partial, found.saturated, found.largest) == ((6,), (3,), (25,))
    assert found.spikes[0][:, 0].tolist() == [False, False, False]  # 19 and 19 of 25 and 20
    assert not run_levels(replace(network, layers=(replace(layer, threshold=np.array([39])),)), events).spikes[0].any()
    assert run_levels(replace(network, layers=(replace(layer, threshold=np.array([38])),)), events).spikes[0][0, 0]


def test_layers_that_hear_a_clock_take_three_axons_an_input():
    levels = in_levels(forgetful(2, 8, 300, 6, bias=0.0), 4, CHIP)
    assert [(layer.copies, layer.is_split) for layer in levels.layers] == [(4, False), (3, True)]
    lifted = in_levels(forgetful(2, 8, 30, 6, bias=3.0), 4, CHIP)  # some would spike without inputs
    assert {layer.copies for layer in lifted.layers} == {3}


def test_what_cannot_be_in_levels():
    network = forgetful(0, 6, 5, 3)
    second = network.populations[1]
    for population, told in (
        (replace(second, beta=0.2), "fc2: keeps 0.2 of its membranes a step, sums in time forget all"),
        (replace(second, alpha=0.5), "fc2: keeps 0.5 of its currents a step, sums in time forget all"),
    ):
        with pytest.raises(ModelError) as caught:
            in_levels(replace(network, populations=(network.populations[0], population)), 3, CHIP)
        assert str(caught.value) == told
    first, second_projection = network.projections
    skipping = replace(network, projections=(first, replace(second_projection, pre=-1)))
    with pytest.raises(ModelError) as caught:
        in_levels(skipping, 3, CHIP)
    assert str(caught.value) == "fc2: does not receive from the layer before and nothing else"
    clocked = replace(network, input=replace(network.input, clocks=Clocks(channels=2, steps=5)))
    with pytest.raises(ModelError) as caught:
        in_levels(clocked, 3, CHIP)
    assert str(caught.value) == "has clocks; sums in time are for networks without"


# -- on the chip -------------------------------------------------------------------------------------------------------

SHAPES = st.sampled_from([(9, 12, 4), (24, 30, 12, 3), (30, 4), (25, 26, 5), (8, 40, 33, 6)])


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), shape=SHAPES, copies=st.sampled_from(COPIES), bias=st.sampled_from([0.0, 0.3, 2.0]))
def test_every_spike_on_the_chip_is_the_models(seed, shape, copies, bias):
    levels = in_levels(forgetful(seed, *shape, bias=bias), copies, NARROW)
    netlist = lower_in_time(levels, NARROW)
    assert faults(netlist, NARROW) == ()
    recording = (np.random.default_rng(seed).random((shape[0], 6)) < 0.5).astype(np.uint8)
    assert_equal(levels, netlist, recording)


@pytest.mark.parametrize("sign", [1, -1])
def test_sums_that_saturate_leave_nothing_for_the_next_step(sign):
    level = sign * np.array([[3] * 60, [1] * 60])
    threshold = np.array([sign * 2 * MOST + (sign < 0), 1])
    layer = Layer(name="fc1", level=level, threshold=threshold, copies=3, width=30)
    network = LevelNetwork(taxels=60, polarities=1, classes=2, layers=(layer,), label=np.array([0, 1]))
    recording = np.zeros((60, 5), np.uint8)
    recording[:, 0] = recording[:, 2] = 1
    recording[3, 3] = 1
    model = assert_equal(network, lower_in_time(network, CHIP), recording)
    assert model.saturated == (8,)
    assert model.spikes[0][0].any() == (sign > 0)


def test_shorter_recordings_count_for_their_own_length():
    levels = in_levels(forgetful(5, 24, 30, 4), 3, NARROW)
    netlist = lower_in_time(levels, NARROW)
    recording = (np.random.default_rng(5).random((1, 24, 9)) < 0.5).astype(np.uint8)
    whole = engine.simulate(netlist, recording, lengths=np.array([6])).counts
    part = engine.simulate(netlist, recording[..., :6]).counts
    np.testing.assert_array_equal(whole.votes, part.votes)
    assert part.votes.sum() > 0


def test_what_does_not_fit():
    wide = forgetful(0, 252 * 60, 1)
    narrow = replace(CHIP, limits=dict(CHIP.limits) | {"core.axons": replace(CHIP.limits["core.axons"], value=100)})
    with pytest.raises(CapacityError) as caught:
        lower_in_time(in_levels(wide, 2, narrow), narrow)
    assert str(caught.value) == (
        "fc1, a neuron: 726 used, 100 allowed (truenorth.core.axons); partial sums of 315 groups and the clocks "
        "beside; use fewer inputs or copies"
    )
    heavy = chain(np.full((1, 4), 1e-3), beta=0.0)
    with pytest.raises(CapacityError) as caught:
        lower_in_time(in_levels(heavy, 3, CHIP), CHIP)
    assert str(caught.value) == (
        "fc1, neuron 0: 500 used, 255 allowed (truenorth.neuron.leak_bits); its threshold in steps of its weights; "
        "use fewer axons an input"
    )
    few = replace(CHIP, limits=dict(CHIP.limits) | {"chip.cores": replace(CHIP.limits["chip.cores"], value=2)})
    with pytest.raises(CapacityError) as caught:
        lower_in_time(in_levels(forgetful(0, 300, 200, 4), 3, few), few)
    assert str(caught.value).endswith(
        "used, 2 allowed (truenorth.chip.cores); use fewer axons an input, or train with fewer features"
    )


# -- the commands ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("in_time")
    own_file(folder / "free.pt", beta=0.0)
    own_file(folder / "keeps.pt")
    recordings_folder(folder / "data")
    return folder


COMPILE = ("compile", "free.pt", "--target", "truenorth", "--in-time", "3", "-o", "free.loom")
VERIFY = ("verify", "free.loom", "--checkpoint", "free.pt", "--data", "data")


def test_from_a_checkpoint_to_decisions(spikeloom):
    code, out, _ = spikeloom(*COMPILE, "--json")
    assert code == 0
    made = json.loads(out)
    assert made["ticks_per_step"] == BIN_TICKS
    assert made["provenance"]["in_time"] == 3
    code, out, _ = spikeloom(*VERIFY, "--json")
    assert code == 0
    found = json.loads(out)
    assert found["exact"]
    assert (found["E0"], found["spec_steps"]) == ({"samples": 3, "differences": 0}, 5)
    assert sum(layer["spikes"] for layer in found["E1"]["layers"]) > 0
    code, out, _ = spikeloom("run", "free.loom", "--data", "data", "--json")
    assert code == 0
    assert json.loads(out)["accuracy"] == found["correct"] / found["samples"]
    code, out, _ = spikeloom("estimate", "free.loom", "--data", "data", "--json")
    assert json.loads(out)["per_inference"]["ticks"] == STEPS * BIN_TICKS + made["drain_ticks"]


def test_what_verify_says_of_sums(spikeloom, place):
    rng = np.random.default_rng(0)
    free = {"conv1.hops": rng.normal(0, 1, (2, 60, 2)), "conv1.bias": np.zeros(60)}
    sizes = (6 * 60, 9, 4)
    for i, (before, after) in enumerate(pairwise(sizes), 1):
        free |= {f"fc{i}.weight": rng.normal(0, 0.3, (after, before)), f"fc{i}.bias": np.zeros(after)}
    own_file(place / "wide.pt", beta=0.0, last={name: array.astype(np.float32) for name, array in free.items()})
    words = ("compile", "wide.pt", "--target", "truenorth", "--in-time", "3", "-o", "wide.loom")
    assert spikeloom(*words)[0] == 0
    code, out, _ = spikeloom("verify", "wide.loom", "--checkpoint", "wide.pt", "--data", "data", "--spec-samples", "1")
    assert code == 0
    lines = out.splitlines()
    assert lines[0].startswith("E0 specification = engine: equal in every spike on 1 recording (the first 5 steps of")
    (head,) = (at for at, line in enumerate(lines) if line.split()[:3] == ["layer", "partial", "sums"])
    assert lines[head + 1].split()[0] == "fc1"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((*COMPILE[:4], "--in-time", "5", *COMPILE[6:]), "--in-time 5: allowed are 2, 3, 4"),
        ((*COMPILE, "--calibrate", "data"), "--calibrate data: is not for truenorth"),
        ((*COMPILE, "--planes", "2"), "--planes 2: is not for truenorth"),
        (("compile", "free.pt", "--in-time", "3", "-o", "x.loom"), "--in-time 3: loihi1 has no such option"),
        (("compile", "keeps.pt", *COMPILE[2:]), "keeps.pt: conv1: keeps 0.2 of its membranes a step"),
    ],
)
def test_mistakes(spikeloom, words, said):
    code, out, err = spikeloom(*words)
    assert (code, out) == (2, "")
    assert err.startswith(f"spikeloom: {said}")


def test_another_checkpoint_is_told(spikeloom, place):
    assert spikeloom(*COMPILE)[0] == 0
    own_file(place / "other.pt", beta=0.0, theta=0.6)
    code, _, err = spikeloom("verify", "free.loom", "--checkpoint", "other.pt", "--data", "data")
    assert code == 2
    assert err == "spikeloom: --checkpoint other.pt: free.loom was compiled from another file; give that one\n"
