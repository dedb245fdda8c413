"""The verdict: every number in it a second time, by the specification and by plain loops."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import STEPS, events, recorded, small_checkpoint, weights
from numpy.testing import assert_allclose, assert_array_equal
from random_netlists import Neuron, build
from scipy import stats

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.networks.reference import float_membranes, float_spikes
from spikeloom.runtime.equivalence.reference import realised
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.machines.loihi1 import engine, spec
from spikeloom.runtime.machines.votes import class_counts, predictions
from spikeloom.runtime.report.numbers import wilson

LAYERS = ["conv1", "fc1", "fc2", "fc3"]
GIVEN = recorded(events(2))


def rungs(verdict):
    """Different entries of each layer by rung of the ladder."""
    return {rung.stage: rung.different for rung in verdict.ladder}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A checkpoint, its propagation matrix and a coarse netlist that often strays from it."""
    checkpoint, adjacency = small_checkpoint(tmp_path_factory.mktemp("small"))
    netlist = compile_network(
        expand(checkpoint, adjacency), Options(storage=Fixed((Packing(bits=4),)))
    ).netlist
    return checkpoint, adjacency, netlist


@pytest.fixture(scope="module")
def verdict(small):
    checkpoint, adjacency, netlist = small
    return verify(netlist, expand(checkpoint, adjacency), GIVEN)


def by_specification(netlist, recordings):
    """Spikes and membranes of each layer on the chip, (samples, steps, neurons), shifted back by hand."""
    traces = [spec.simulate(netlist, recording.reshape(netlist.n_inputs, -1)) for recording in recordings]
    steps = recordings.shape[3]
    spikes, membranes = [], []
    for index, layer in enumerate(netlist.layers):
        window = slice(layer.depth, layer.depth + steps)
        ids = netlist.compartments_of(index)
        spikes.append(np.array([trace.spikes[window][:, ids] for trace in traces]))
        membranes.append(np.array([trace.membranes[window][:, ids] for trace in traces]))
    return spikes, membranes


def test_spikes_and_decisions(small, verdict):
    checkpoint, adjacency, netlist = small
    narrow = list(float_spikes(expand(checkpoint, adjacency), events(2)).values())
    wide = list(float_spikes(expand(checkpoint, adjacency), events(2), dtype="float64").values())
    chip, _ = by_specification(netlist, events(2))
    assert list(verdict.spikes) == LAYERS
    for name, a, b, c in zip(LAYERS, narrow, chip, wide, strict=True):
        found = verdict.spikes[name]
        assert (found.float, found.chip) == (int(a.sum()), int(b.sum()))
        assert found.different == int((a ^ b).sum()) > 0
        assert found.ill_posed == int((a ^ c).sum())
    decisions = [spikes[-1].sum(axis=1).argmax(axis=1) for spikes in (narrow, chip)]
    assert verdict.float_predictions.tolist() == decisions[0].tolist()
    assert verdict.chip_predictions.tolist() == decisions[1].tolist()
    assert verdict.accuracy["float"] == np.mean(decisions[0] == GIVEN.labels)
    assert verdict.accuracy["chip"] == np.mean(decisions[1] == GIVEN.labels)
    assert verdict.decision_agreement == np.mean(decisions[0] == decisions[1])
    assert (verdict.files, verdict.labels.tolist()) == (GIVEN.files, GIVEN.labels.tolist())
    assert verdict.spec_equals_engine
    assert verdict.spec_samples == 3


@pytest.mark.parametrize(("seed", "bits"), [(0, 4), (1, 6)])
def test_the_first_divergence_is_the_first(tmp_path, seed, bits):
    checkpoint, adjacency = small_checkpoint(tmp_path, last=weights(seed))
    options = Options(storage=Fixed((Packing(bits=bits),)), keep_all=bits == 6)
    netlist, recordings = (
        compile_network(expand(checkpoint, adjacency), options).netlist,
        events(2 + seed, samples=3),
    )
    found = verify(
        netlist, expand(checkpoint, adjacency), recorded(recordings), spec_samples=1
    ).first_divergence
    reference = list(float_spikes(expand(checkpoint, adjacency), recordings).values())
    chip, registers = by_specification(netlist, recordings)
    sample, step, layer, neuron = next(
        (sample, step, layer, neuron)
        for sample in range(3)
        for step in range(STEPS)
        for layer in range(4)
        for neuron in range(reference[layer].shape[2])
        if reference[layer][sample, step, neuron] != chip[layer][sample, step, neuron]
    )
    compartment = netlist.compartments_of(layer)[neuron]
    assert (found.file, found.step, found.layer, found.neuron) == (
        f"{sample}.npy",
        step,
        LAYERS[layer],
        neuron,
    )
    assert (found.taxel, found.feature) == ((neuron // 5, neuron % 5) if layer == 0 else (None, None))
    membranes = list(float_membranes(expand(checkpoint, adjacency), recordings).values())
    assert found.float_membrane == membranes[layer][sample, step, neuron]
    assert found.chip_register == registers[layer][sample, step, neuron]
    assert found.chip_membrane == found.chip_register / (64 * netlist.scale[compartment])
    assert (found.theta, found.chip_theta) == (
        0.5,
        netlist.threshold[compartment] / netlist.scale[compartment],
    )
    # one side fired, the other did not
    assert (found.float_membrane > found.theta) != (found.chip_membrane > found.chip_theta)
    assert not found.ill_posed


def test_each_rung_adds_one_deviation(small):
    checkpoint, adjacency, netlist = small
    network, integer = expand(checkpoint, adjacency), lift(netlist)
    beta, scaled, full = realised(network, integer)
    for index in range(len(netlist.layers)):
        ids = netlist.compartments_of(index)
        plain, decayed, weighed, shifted = (n.populations[index] for n in (network, beta, scaled, full))
        assert (plain.beta, decayed.beta, weighed.beta, shifted.beta) == (
            0.2,
            819 / 4096,
            819 / 4096,
            819 / 4096,
        )
        assert decayed.theta == weighed.theta == plain.theta == 0.5
        assert shifted.theta == 0.5
        scale = netlist.scale[ids[0]]
        assert_array_equal(weighed.bias, plain.bias)
        register = netlist.bias_mantissa[ids] * 2.0 ** netlist.bias_exponent[ids]
        assert_allclose(shifted.bias, register / (64 * scale), rtol=1e-15)
        assert_allclose(shifted.bias, plain.bias, atol=0.51 / (64 * scale) * 2**7)
        exact, rounded = (n.projections[index].weight.toarray() for n in (network, scaled))
        assert_array_equal(beta.projections[index].weight.toarray(), exact)
        step = 2.0 ** (9 - 4) * 2.0 ** int(netlist.format_exponent.max())
        assert 0 < np.abs(rounded - exact).max() <= step / scale


def test_saturation_is_a_rung_of_its_own(tmp_path):
    # a bias pulls the membrane below its register for thirty steps, then input pulls it up again: the register, which
    # stopped at its end, is back earlier than a number without an end
    arrays = {name: np.zeros_like(array) for name, array in weights(sizes=(2, 2, 2)).items()}
    arrays["conv1.hops"][0] = 1.0
    arrays["fc1.weight"][:] = 0.5
    arrays["fc1.bias"][:] = -8.0
    checkpoint, adjacency = small_checkpoint(tmp_path, last=arrays, beta=4095 / 4096)
    recordings = np.zeros((1, 6, 2, 80), np.uint8)
    recordings[:, :, :, 30:] = 1
    netlist = compile_network(expand(checkpoint, adjacency)).netlist
    found = verify(netlist, expand(checkpoint, adjacency), recorded(recordings))
    ladder = rungs(found)
    assert ladder["rounding"]["fc1"] < ladder["saturation"]["fc1"] == found.spikes["fc1"].different
    assert found.first_divergence.layer == "fc1"
    # the other way round than in the register: it clipped what the float model holds
    assert found.spikes["fc1"].chip > found.spikes["fc1"].float > 0


def test_ill_posed_spikes_are_told_from_faults(tmp_path):
    # one plus 2**-25 rounds to one in float32, which is not above the threshold of one; in float64 it is
    arrays = {name: np.zeros_like(array) for name, array in weights(sizes=(8, 8, 2)).items()}
    arrays["fc1.bias"][:] = 2.0
    arrays["fc2.weight"][:, :2] = [1.0, 2.0**-25]
    checkpoint, adjacency = small_checkpoint(tmp_path, last=arrays, beta=0.0, theta=1.0)
    netlist = compile_network(expand(checkpoint, adjacency), Options(keep_all=True)).netlist
    found = verify(netlist, expand(checkpoint, adjacency), recorded(events(0)))
    assert found.spikes["fc2"].float == 0
    assert found.spikes["fc2"].ill_posed == 6 * STEPS * 8
    assert found.spikes["fc1"].ill_posed == 0
    assert rungs(found)["float64"] == {"conv1": 0, "fc1": 0, "fc2": 6 * STEPS * 8, "fc3": 0}
    # a finer chip would have sided with float64; this one stands for it
    finer = dataclasses.replace(netlist, threshold=read_only(netlist.threshold - 8 * (netlist.layer == 2)))
    first = verify(finer, expand(checkpoint, adjacency), recorded(events(0))).first_divergence
    assert (first.layer, first.step, first.neuron, first.ill_posed) == ("fc2", 0, 0, True)


@pytest.mark.parametrize(
    "field", ["spikes", "membranes", "inputs", "counted spikes", "updates", "saturations"]
)
def test_a_single_wrong_bit_is_found_out(small, monkeypatch, field):
    checkpoint, adjacency, netlist = small
    simulate = engine.simulate

    def wrong(*words, **options):
        trace = simulate(*words, **options)
        if trace.membranes is not None and trace.spikes is not None:
            if field in ("spikes", "membranes"):
                getattr(trace, field)[0, -1, -1] ^= 1
            else:
                getattr(trace.counts, field.removeprefix("counted "))[0, -1] += 1
        return trace

    assert verify(netlist, expand(checkpoint, adjacency), GIVEN, spec_samples=1).spec_equals_engine
    monkeypatch.setattr(engine, "simulate", wrong)
    assert not verify(netlist, expand(checkpoint, adjacency), GIVEN, spec_samples=1).spec_equals_engine


def test_the_ladder_carries_thresholds_that_differ(small):
    """A threshold that is off counts on the rung of thresholds, whatever the other neurons of the layer have."""
    checkpoint, adjacency, netlist = small
    threshold = netlist.threshold.copy()
    threshold[netlist.compartments_of(0)[:2]] += 40
    changed = dataclasses.replace(netlist, threshold=read_only(threshold))
    network, recordings = expand(checkpoint, adjacency), channels_last(events(2))
    rungs = [run_float(rung, recordings).spikes[0] for rung in realised(network, lift(changed))]
    plain = [run_float(rung, recordings).spikes[0] for rung in realised(network, lift(netlist))]
    assert_array_equal(rungs[1], plain[1])
    moved = (rungs[2] != plain[2]).any(axis=(0, 1))
    assert moved.any()
    assert not moved[2:].any()


def test_votes_of_several_neurons_add_up():
    netlist = build([Neuron()] * 5, [], n_inputs=1, depths=[0])
    netlist = dataclasses.replace(netlist, classes=3, readout_class=read_only([2, 0, -1, 2, 1]))
    spikes = np.array([[3, 5, 100, 4, 7], [1, 2, 0, 1, 2], [0, 0, 9, 0, 0]])
    assert class_counts(netlist, spikes).tolist() == [[5, 7, 7], [2, 2, 2], [0, 0, 0]]
    assert predictions(netlist, spikes).tolist() == [1, 0, 0]  # ties go to the lowest class


@given(st.integers(1, 500), st.data())
def test_wilson_is_that_of_scipy(trials, data):
    successes = data.draw(st.integers(0, trials))
    theirs = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    assert wilson(successes, trials) == pytest.approx((theirs.low, theirs.high), abs=1e-12)
