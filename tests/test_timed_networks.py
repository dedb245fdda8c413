"""Currents that outlast their step and clocks from checkpoint to chip: every pass and every command."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from random_netlists import Axon, Neuron, build
from random_networks import chain, integer_population
from timed_networks import TIMING, events_of, written

from spikeloom.compiler import Options, Packing, compile_network, lift
from spikeloom.compiler.dynamics import Dynamics, with_clocks
from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.fixedpoint import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    MEMBRANE_MAX,
    ONE_STEP_SUM_MAX,
    decay_registers,
    read_only,
)
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.ir import Input
from spikeloom.compiler.passes.expand import Factored, expand
from spikeloom.compiler.passes.prune import never_fires
from spikeloom.compiler.passes.range_proof import prove_ranges
from spikeloom.compiler.targets.loihi1.netlist import one_step_bounds
from spikeloom.compiler.targets.loihi1.storage.weight_storage import current_load
from spikeloom.models.networks.reference import float_spikes
from spikeloom.runtime.equivalence.certain_spikes import certain_spikes
from spikeloom.runtime.equivalence.rounding import check_rounding
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.machines.integer import integer_machine_of
from spikeloom.runtime.machines.loihi1 import engine, spec
from spikeloom.runtime.machines.loihi1.trace import aligned

REPEATABLE = settings(max_examples=4, deadline=None, derandomize=True)


def float_network(path, system="tactilesgnet", dynamics=TIMING, **options):
    """Checkpoint, what its first layer sees, and its float stage."""
    _, seen = written(path / "x.pt", system, dynamics, **options)
    checkpoint = read_checkpoint(path / "x.pt")
    return checkpoint, seen, expand(checkpoint, seen)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("timed")


@pytest.fixture(scope="module")
def timed(folder):
    return float_network(folder)


@pytest.fixture(scope="module")
def compiled(timed):
    return compile_network(timed[2], Options(training_events=events_of(5, samples=12)))


# --- registers -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("alpha", "register", "realised"),
    [(0.0, 4095, 0.0), (0.5, 2047, 0.5), (0.95, 204, 3891 / 4096), (0.9999, 0, 4095 / 4096), (0.0001, 4095, 0.0)],
)
def test_the_current_register_is_the_nearest(alpha, register, realised):
    assert decay_registers(0.2, alpha) == (register, 3277)
    assert replace(integer_population("fc1", 1), decay_u=register).realised_alpha == realised
    assert abs(realised - alpha) <= 1.5e-4  # half a step, at the end of the register a little more


def test_a_current_counts_by_the_register_that_it_fills_first():
    """Loses 205/4096 a step: 6,559 units a step add up to 6,559 * 64 * 4096 / 205 = 8,387,4xx of 8,388,607."""
    assert current_load(4095) == current_load(1023) == 1.0  # four times as wide a register
    assert current_load(204) == pytest.approx((4096 / 205) * 32767 * 64 / 8388607, rel=1e-12)
    most = int(ONE_STEP_SUM_MAX / current_load(204))
    assert most * 64 * 4096 // 205 <= CURRENT_MAX < (most + 1) * 64 * 4096 // 205


def one_synapse(weight, exponent, **neuron):
    return build(
        [Neuron(**neuron)], [Axon(source=0, targets=((0, weight),), exponent=exponent)], n_inputs=1, depths=[0]
    )


def test_the_largest_current_stays_and_one_unit_more_overflows():
    """52 * 2**7 = 6,656 units a step against 6,554 that fit: the step in which it leaves the register is found."""
    events = np.ones((1, 400), np.uint8)
    fits = one_synapse(102, 6, decay_u=204, threshold=2**17 - 1)  # 6,528
    trace = spec.simulate(fits, events)
    current = 0
    for _ in range(400):
        current = current * 3891 // 4096 + 6528 * 64
    assert trace.membranes[-1, 0] == current  # no membrane outlasts its step here
    assert 0.99 * CURRENT_MAX < current <= CURRENT_MAX
    over = one_synapse(104, 6, decay_u=204, threshold=2**17 - 1)  # 6,656
    messages = []
    for simulate in (spec.simulate, lambda n, e: engine.simulate(n, e[None])):
        with pytest.raises(NumericRangeError, match="current") as error:
            simulate(over, events)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


# --- the float stage -----------------------------------------------------------------------------------------------
def test_relays_hear_their_clock_and_nothing_else(timed):
    _, _, network = timed
    weight = network.projections[0].weight.toarray()
    assert weight.shape == (39 * 3 + 3, 39 * 2 + 3)
    assert_array_equal(weight[-3:, -3:], np.eye(3))  # twice the threshold of 0.5
    assert not weight[-3:, :-3].any()
    assert not weight[:-3, -3:].any()
    assert not network.populations[0].bias[-3:].any()


def test_a_neuron_that_only_fires_from_its_gathered_current_is_kept():
    """0.04 a step is 0.05 with the membrane alone, but 0.4 with a current that keeps nine tenths: 0.5 at the limit."""
    network = chain([[0.04]], [[1.0]])
    lasting = replace(network, populations=(replace(network.populations[0], alpha=0.9), network.populations[1]))
    assert [mask.tolist() for mask in never_fires(network)] == [[True], [False]]
    stronger = chain([[0.0401]], [[1.0]])
    stronger = replace(stronger, populations=(replace(stronger.populations[0], alpha=0.9), stronger.populations[1]))
    assert [mask.tolist() for mask in never_fires(stronger)] == [[False], [False]]
    events = np.ones((1, 400, 1), np.bool_)
    assert not run_float(network, events).spikes[0].any()
    assert run_float(stronger, events).spikes[0].any()
    assert never_fires(lasting)[0].tolist() == [False]  # exactly at its threshold: rounding may decide


# --- rounding ------------------------------------------------------------------------------------------------------
def test_ranges_are_proven_for_any_input(compiled):
    assert all(proof.holds for proof in compiled.proofs)
    lasting = compiled.proofs[1]
    assert 0.8 * MEMBRANE_MAX < max(lasting.current, lasting.membrane) <= MEMBRANE_MAX, "the scale is as fine as can be"
    assert lasting.accumulator < 0.3 * ACCUMULATOR_MAX
    assert_allclose(
        [p.accumulator for p in prove_ranges(lift(compiled.netlist))], [p.accumulator for p in compiled.proofs]
    )
    positive, negative = one_step_bounds(compiled.netlist)
    ids = compiled.netlist.compartments_of(1)
    assert np.all(np.maximum(positive, negative)[ids] * 64 * 4096 // 205 <= CURRENT_MAX)


@pytest.mark.parametrize(
    "options",
    [
        {"packings": (Packing(bits=2),)},
        {"packings": (Packing(planes=2, groups=8),)},
        {"packings": (Packing(bits=2),), "training_events": None},
    ],
)
def test_relays_tick_with_their_clocks_however_weights_are_stored(timed, options):
    _, _, network = timed
    netlist = compile_network(network, Options(**{"training_events": events_of(5, samples=12), **options})).netlist
    events = events_of(13, steps=14)
    trace = engine.simulate(netlist, with_clocks(events, TIMING.clocks), spikes=True)
    conv = aligned(netlist, trace.spikes, 0)
    held = np.isin(np.arange(120), netlist.neuron[netlist.compartments_of(0)])[-3:]
    assert held.any()
    for sample in conv:
        assert_array_equal(sample[:, -3:][:, held], TIMING.clocks.events(14).T[:, held])


# --- what judges the chip ------------------------------------------------------------------------------------------
@REPEATABLE
@given(seed=st.integers(0, 10**6), alpha=st.sampled_from([0.3, 0.95, 0.999]), beta=st.sampled_from([0.0, 0.2, 0.9]))
def test_what_is_certain_is_so_in_both_precisions(folder, seed, alpha, beta):
    dynamics = Dynamics(betas=(0.2, beta, beta, beta), alphas=(0.0, alpha, alpha, alpha), clocks=TIMING.clocks)
    checkpoint, seen, network = float_network(folder, dynamics=dynamics, seed=seed)
    events = events_of(seed, samples=2, steps=30)
    certainty = certain_spikes(Factored(checkpoint, seen), events)
    runs = [list(float_spikes(checkpoint, seen, events, dtype=kind).values()) for kind in ("float32", "float64")]
    runs.append(list(run_float(network, channels_last(events, TIMING.clocks), dtype=np.float32).spikes))
    for layer, (sure, doubt) in enumerate(certainty):
        for run in runs:
            assert not (sure & ~run[layer]).any()
            assert not (run[layer] & ~sure & ~doubt).any()
    assert np.mean(certainty[1][1]) < 0.05, "next to nothing is left open"


def test_a_radius_covers_the_gathered_rounding():
    """An entry whose current gathers to its threshold within the rounding of float32 is open, not certain."""
    network = chain([[0.025]], beta=0.0)
    network = replace(network, populations=(replace(network.populations[0], alpha=0.95),))
    network = replace(network, input=Input(taxels=1, polarities=1))
    events = np.ones((1, 1, 1, 2000), np.uint8)  # the current climbs to 0.5, the threshold, and stays below
    ((sure, doubt),) = certain_spikes(network, events)
    assert not sure[0, :100].any()
    assert not doubt[0, :100].any()
    assert doubt[0, -1].all()


def test_the_decay_alone_is_a_rung_of_the_ladder(tmp_path):
    """A decay that the register holds exactly moves nothing; one between two of its values does."""
    moved = []
    for alpha in (0.5, 0.50012):
        dynamics = Dynamics(betas=(0.5,) * 4, alphas=(0.0, alpha, alpha, alpha))
        checkpoint, seen, network = float_network(tmp_path, dynamics=dynamics, hidden=(64, 64))
        integer = lift(compile_network(network).netlist)
        assert [p.realised_alpha for p in integer.populations[1:]] == [0.5] * 3
        events = events_of(21, samples=8, steps=200)
        netlist = compile_network(network).netlist
        verdict = verify(netlist, Factored(checkpoint, seen), events, np.zeros(8, np.int64), ("r",) * 8, spec_samples=1)
        different = {rung.stage: sum(rung.different.values()) for rung in verdict.ladder}
        moved.append(different["beta"] - different["float64"])
    assert moved[0] == 0
    assert moved[1] > 0


def test_a_wrong_current_register_is_named(timed, compiled):
    _, _, network = timed
    decay = compiled.netlist.decay_u.copy()
    decay[compiled.netlist.compartments_of(1)] = 100
    wrong = replace(compiled.netlist, decay_u=read_only(decay))
    assert check_rounding(integer_machine_of(compiled.netlist), network).holds
    assert check_rounding(integer_machine_of(wrong), network).layers["fc1"].faults == (
        "fc1 has decay registers 100 and 2867 instead of 204 and 2867",
    )
