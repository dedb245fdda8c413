"""Counting networks on crossbar cores: every spike is the model's, and the votes are the file's."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import as_json, run
from hypothesis import given
from hypothesis import strategies as st
from made_files import recordings_folder
from numpy.testing import assert_array_equal
from oracles import refused
from random_crossbars import CHIP, both, counter_events, random_counters, with_limit

from spikeloom.compiler.counters import BLOCK
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.formats.counters import counting_network, write_counters
from spikeloom.compiler.interpret import channels_last, float_simulation
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.truenorth.counting import LARGEST, planned, run_counters
from spikeloom.compiler.targets.truenorth.netlist import write_crossbars
from spikeloom.compiler.targets.truenorth.passes import compile_crossbars
from spikeloom.models.training.counters import round_weights
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.votes import class_counts


def assert_exact(counters, events, chip=CHIP):
    """Specification, engine and model agree in every spike, and votes with the network in the file; gives the votes."""
    netlist, plan = compile_crossbars(counters).netlist, planned(counters, chip)
    trace, steps = both(netlist, with_clocks(events[None], counters.clocks)[0]), events.shape[-1]
    assert trace.counts.overflows.sum() == 0
    model = run_counters(plan, events)
    for name, first in plan.first.items():
        chosen = np.flatnonzero(netlist.layer == netlist.layers.index(name))
        on_chip = trace.spikes[first : first + steps][:, chosen]
        assert_array_equal(on_chip, model[name][:, netlist.neuron[chosen]], name)
    votes = class_counts(netlist, trace.counts.votes[None])[0]
    assert_array_equal(votes, model["votes"].sum(axis=0))
    network = counting_network(counters)
    spikes = float_simulation(network).run(channels_last(events[None], counters.clocks)).spikes
    assert_array_equal(votes, spikes[-1][0].sum(axis=0))
    return votes


@given(
    st.integers(0, 2**31),
    st.sampled_from([1, 2, 3]),
    st.integers(1, 5),
    st.sampled_from([1, 3, LARGEST]),
    st.sampled_from([0.1, 0.5, 1.0]),
)
def test_every_spike_is_the_models_and_the_votes_are_the_files(seed, parts, classes, most, rate):
    counters = random_counters(seed, parts=parts, classes=classes, most=most)
    assert_exact(counters, counter_events(seed, counters, rate))


@pytest.mark.parametrize("most", [1, 7, 11, LARGEST])
def test_both_chips_have_the_same_whole_numbers_and_votes(most):
    counters = random_counters(most, taxels=6, classes=8, most=most, ramp=60)
    events = np.stack([counter_events(seed, counters) for seed in range(6)])
    made = compile_network(counting_network(counters)), compile_crossbars(counters)
    assert_array_equal(*(machine_of(each.netlist).run(events).votes for each in made))
    scales = [population.scale for population in made[0].integer.populations]
    for projection, held in zip(made[0].network.projections, made[0].integer.projections, strict=True):
        whole = projection.weight.toarray() * scales[projection.post][:, None]
        assert_array_equal(held.effective().toarray(), whole)


def test_sums_of_several_cores_come_together():
    counters = random_counters(1, taxels=40, classes=12, thresholds=(1, 3, 7), steps=30, ramp=400)
    netlist = compile_crossbars(counters).netlist
    groups = len(planned(counters, CHIP).groups)
    assert 2 * groups * 12 == np.count_nonzero(netlist.layer == netlist.layers.index("sums")) > 24
    assert netlist.n_cores < groups + 4, "counters use what sums and votes leave"
    assert assert_exact(counters, counter_events(2, counters)).max() > 0


def test_counters_spike_again_as_on_other_chips():
    counters = random_counters(0, taxels=1, thresholds=(3,), steps=400, ramp=20)
    events = np.zeros((1, 2, 420), np.uint8)
    events[..., :400] = 1
    spikes = run_counters(planned(counters, CHIP), events)["counters"]
    assert np.flatnonzero(spikes[:, 0]).tolist() == [2 + again * (3 + BLOCK) for again in range(4)]
    assert_exact(replace(counters, weight=np.abs(counters.weight) % 2, threshold=3000.5), events)


def test_it_leaves_for_ranc_with_joined_bins_and_its_ramp(tmp_path):
    netlist = compile_crossbars(replace(random_counters(3, taxels=2), bins=2)).netlist
    write_crossbars(netlist, tmp_path / "net.loom")
    touches = np.ones((1, 2, 2, 40), np.uint8)
    recordings_folder(tmp_path / "data", train=touches, test=touches)
    words = [
        "export",
        tmp_path / "net.loom",
        "--to",
        "ranc",
        "-o",
        tmp_path / "net.json",
        "--data",
        tmp_path / "data",
    ]
    assert as_json(*words)["ticks"] == netlist.ticks(20 + 12) + 1
    written = json.loads((tmp_path / "net.json").read_text("utf-8"))
    assert [bool(tick) for tick in written["packets"]] == [True] * 20 + [False] * (12 + netlist.drain)
    assert written["exact_ticks"] is None


def test_what_the_chip_cannot_hold_is_refused(tmp_path):
    counters = random_counters(0, most=127)
    with pytest.raises(
        ModelError, match=r"weights of up to \d+, 15 allowed; train it with --weight-bits 5 or fewer"
    ):
        compile_crossbars(counters)
    counters = random_counters(0)
    refused(ModelError, "a ramp of 0.5 a step", compile_crossbars, replace(counters, slope=0.5))
    refused(ModelError, "no register holds", compile_crossbars, replace(counters, threshold=1e308))
    refused(
        CapacityError,
        "chip: 2 used, 1 allowed |--weight-bits",
        compile_crossbars,
        counters,
        target=with_limit("chip.cores", 1),
    )
    write_counters(tmp_path / "c.pt", random_counters(0, most=127))
    code, _, err = run("compile", tmp_path / "c.pt", "--target", "truenorth", "-o", tmp_path / "c.loom")
    assert (code, "c.pt: weights of up to" in err) == (2, True)


def test_rounded_weights_keep_the_sums():
    rng = np.random.default_rng(0)
    spikes = (rng.random((200, 40)) < rng.random(40)).astype(float)
    weight = rng.normal(0, 2, (5, 40))
    whole = round_weights(weight, spikes, 7)
    assert set(np.unique(whole)) <= set(range(-7, 8))
    errors = [np.abs(spikes @ (each - weight).T).mean() for each in (whole, np.rint(weight).clip(-7, 7))]
    assert errors[0] < 0.8 * errors[1]
