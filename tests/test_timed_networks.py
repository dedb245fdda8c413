"""Currents that outlast their step, clocks and recurrent layers, from checkpoint to chip: every pass."""

from dataclasses import replace

import numpy as np
import pytest
from made_files import recorded, sparse_events
from numpy.testing import assert_allclose, assert_array_equal
from oracles import refused
from random_networks import LOIHI, chain, integer_chain, integer_population, small_target, stored
from timed_networks import TIMING, events_of, written

from spikeloom.compiler.dynamics import Dynamics, with_clocks
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.ir import Projection
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.passes.prune import never_fires
from spikeloom.compiler.storage import Exact, Fixed, Packing
from spikeloom.compiler.targets.loihi1 import registers
from spikeloom.compiler.targets.loihi1.bounds import one_step_bounds, prove_ranges
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.integers import IntegerProjection, run_integer
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.loihi1.remove import removable
from spikeloom.compiler.targets.loihi1.storage.choose_storage import choose_storage
from spikeloom.compiler.targets.loihi1.storage.weight_storage import current_load
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned


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
def compilation(timed):
    return compile_network(timed[2], Options(training_events=events_of(5, samples=12)))


@pytest.mark.parametrize(
    ("alpha", "register", "realised"),
    [
        (0.0, 4095, 0.0),
        (0.5, 2047, 0.5),
        (0.95, 204, 3891 / 4096),
        (0.9999, 0, 4095 / 4096),
        (0.0001, 4095, 0.0),
    ],
)
def test_the_current_register_is_the_nearest(alpha, register, realised):
    assert registers.decay_registers(0.2, alpha) == (register, 3277)
    assert replace(integer_population("fc1", 1), decay_u=register).realised_alpha == realised
    assert abs(realised - alpha) <= 1.5e-4  # half a step, at the end of the register a little more


def test_a_current_counts_by_the_register_that_it_fills_first():
    """Loses 205/4096 a step: 6,559 units a step add up to 6,559 * 64 * 4096 / 205 = 8,387,4xx of 8,388,607."""
    assert current_load(4095) == current_load(1023) == 1.0  # four times as wide a register
    assert current_load(204) == pytest.approx((4096 / 205) * 32767 * 64 / 8388607, rel=1e-12)
    most = int(registers.ONE_STEP_SUM_MAX / current_load(204))
    assert most * 64 * 4096 // 205 <= registers.CURRENT_MAX < (most + 1) * 64 * 4096 // 205


def test_a_neuron_that_only_fires_from_its_gathered_current_is_kept():
    """0.04 a step is 0.05 with the membrane alone, but 0.4 with a current that keeps nine tenths: 0.5 at the limit."""
    network = chain([[0.04]], [[1.0]])
    lasting = replace(
        network, populations=(replace(network.populations[0], alpha=0.9), network.populations[1])
    )
    assert [mask.tolist() for mask in never_fires(network)] == [[True], [False]]
    stronger = chain([[0.0401]], [[1.0]])
    stronger = replace(
        stronger, populations=(replace(stronger.populations[0], alpha=0.9), stronger.populations[1])
    )
    assert [mask.tolist() for mask in never_fires(stronger)] == [[False], [False]]
    events = np.ones((1, 400, 1), np.bool_)
    assert not run_float(network, events).spikes[0].any()
    assert run_float(stronger, events).spikes[0].any()
    assert never_fires(lasting)[0].tolist() == [False]  # exactly at its threshold: rounding may decide


def test_ranges_are_proven_for_any_input(compilation):
    assert all(proof.holds for proof in compilation.proofs)
    lasting = compilation.proofs[1]
    widest = max(lasting.current, lasting.membrane)
    assert 0.8 * registers.MEMBRANE_MAX < widest <= registers.MEMBRANE_MAX, "the scale is as fine as can be"
    assert lasting.accumulator < 0.3 * registers.ACCUMULATOR_MAX
    assert_allclose(
        [p.accumulator for p in prove_ranges(lift(compilation.netlist))],
        [p.accumulator for p in compilation.proofs],
    )
    positive, negative = one_step_bounds(compilation.netlist)
    ids = compilation.netlist.compartments_of(1)
    assert np.all(np.maximum(positive, negative)[ids] * 64 * 4096 // 205 <= registers.CURRENT_MAX)


@pytest.mark.parametrize(
    "options",
    [
        {"storage": Fixed((Packing(bits=2),))},
        {"storage": Fixed((Packing(planes=2, groups=8),))},
        {"storage": Fixed((Packing(bits=2),)), "training_events": None},
    ],
)
def test_relays_tick_with_their_clocks_however_weights_are_stored(timed, options):
    _, _, network = timed
    netlist = compile_network(
        network, Options(**{"training_events": events_of(5, samples=12), **options})
    ).netlist
    events = events_of(13, steps=14)
    trace = engine.simulate(netlist, with_clocks(events, TIMING.clocks), spikes=True)
    conv = aligned(netlist, trace.spikes, 0)
    held = np.isin(np.arange(120), netlist.neuron[netlist.compartments_of(0)])[-3:]
    assert held.any()
    for sample in conv:
        assert_array_equal(sample[:, -3:][:, held], TIMING.clocks.events(14).T[:, held])


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
        verdict = verify(netlist, expand(checkpoint, seen), recorded(events), spec_samples=1)
        different = {rung.stage: sum(rung.different.values()) for rung in verdict.ladder}
        moved.append(different["beta"] - different["float64"])
    assert moved[0] == 0
    assert moved[1] > 0


def with_loop(network, post, weight):
    """A network with one more projection, from a population to itself."""
    own = Projection(pre=post, post=post, weight=stored(np.asarray(weight, float)))
    return replace(network, projections=(*network.projections, own))


def drawn(seed, *, hidden=12, gain=1.0, alpha=0.0):
    """Ten channels, a recurrent layer, four classes; weights of no special values."""
    rng = np.random.default_rng(seed)
    first, last = rng.normal(size=(hidden, 10)) * 0.4, rng.normal(size=(4, hidden)) * 0.5
    network = chain(
        first, last, beta=0.6, biases=[rng.normal(size=hidden) * 0.05, np.zeros(4)], polarities=2
    )
    recurring = replace(network.populations[0], alpha=alpha)
    network = replace(network, populations=(recurring, network.populations[1]))
    return with_loop(network, 0, rng.normal(size=(hidden, hidden)) * gain / hidden**0.5)


def events_of_five(seed, samples=6, steps=50):
    """Recordings (samples, taxels, polarities, steps) of five taxels."""
    return sparse_events(seed, samples, 5, 2, steps, rate=0.3)


@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_every_spike_of_the_calibration_is_kept_if_asked(alpha):
    network, events = drawn(1, gain=1.5, alpha=alpha), events_of_five(2)
    made = compile_network(network, Options(training_events=events, storage=Exact()))
    assert [layer.flips for layer in made.exactness] == [0, 0]
    given_ = channels_last(events)
    wanted, found = run_float(network, given_), run_integer(made.integer, given_)
    assert all(spikes.sum() > 30 for spikes in wanted.spikes)
    for ours, theirs in zip(found.spikes, wanted.spikes, strict=True):
        assert_array_equal(ours, theirs)


def test_spikes_are_judged_on_what_the_layer_itself_fired_a_step_before():
    network, events = drawn(3, gain=1.5), events_of_five(4)
    calibration = calibrate(network, channels_last(events))
    late = calibration.source(0, 0)
    assert_array_equal(late[:, 1:], calibration.spikes[0][:, :-1])
    assert not late[:, 0].any()
    assert_array_equal(calibration.source(0, 1), calibration.spikes[0][:])
    for packing in (Packing(), Packing(planes=2), Packing(groups=4)):
        _, choices = choose_storage(network, LOIHI, packings=(packing,), calibration=calibration)
        assert choices[0].flips < 0.1 * choices[0].spikes


def test_neurons_that_only_excite_each_other_are_silent():
    """Nothing starts the ring of the first two; the third is driven, and keeps the fourth going."""
    network = chain([[0, 0], [0, 0], [1, 1], [0, 0]], np.ones((1, 4)))
    own = np.zeros((4, 4))
    own[0, 1] = own[1, 0] = own[3, 2] = 2
    network = with_loop(network, 0, own)
    assert never_fires(network)[0].tolist() == [False, False, False, False]  # a ring might keep itself going
    cut = chain([[0.05, 0.05], [0.05, 0], [1, 1], [0, 0]], np.ones((1, 4)))
    cut = with_loop(cut, 0, own * [0.1, 0.1, 1, 0])
    assert never_fires(cut)[0].tolist() == [True, True, False, False]
    silent, unread = removable(compile_network(cut, Options(keep_all=True)).integer)
    assert silent[0].tolist() == [True, True, False, False]
    assert not unread[0].any()


def test_neurons_that_only_feed_each_other_are_left_out():
    """The first drives the second, which votes; the third and the fourth talk among themselves."""
    network = chain(np.ones((4, 2)), [[1, 1, 0, 0]])
    own = np.zeros((4, 4))
    own[1, 0] = own[3, 2] = 1
    network = with_loop(network, 0, own)
    made = compile_network(network)
    assert [removal.unread for removal in made.removals] == [2, 0]
    assert made.netlist.layers[0].unread == (2, 3)
    own[2, 2] = 1  # a neuron that receives itself counts as received
    made = compile_network(with_loop(replace(network, projections=network.projections[:2]), 0, own))
    assert made.netlist.layers[0].unread == (3,)


def in_pairs(own):
    """Four neurons with one input."""
    integer = integer_chain(np.full((4, 1), 2))
    loop = IntegerProjection(pre=0, post=0, weight=stored(2 * own, own), exponent=0, bits=8)
    return replace(integer, projections=(*integer.projections, loop))


def test_a_layer_is_cut_so_that_its_axons_to_itself_are_enough():
    pairs = np.kron(np.eye(2, dtype=int), np.ones((2, 2), int))
    target = small_target(core_axons_out=3)
    parts = partition(in_pairs(pairs), target)
    assert [[(chunk.first, chunk.last) for chunk in core] for core in parts] == [
        [(0, 2)],
        [(2, 3)],
        [(3, 4)],
    ]
    require_legal(emit(in_pairs(pairs), parts, (0, 1, 2), target, {}), target)
    words = "fc1 neuron 0: 4 used, 3 allowed (loihi1.core.axons_out)"
    refused(CapacityError, words, partition, in_pairs(np.ones((4, 4), int)), target)
