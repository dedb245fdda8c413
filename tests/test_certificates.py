"""Certificates: what is certain is so in every arithmetic, and what is not certain is not claimed."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import CLASSES, FEATURES, TAXELS, events, recorded, ring, small_checkpoint, weights

from spikeloom.compiler import Options, Packing, compile_network, lift
from spikeloom.compiler.interpret import channels_last, run_float, vote
from spikeloom.compiler.passes.expand import Factored, expand
from spikeloom.compiler.passes.range_proof import open_ranges
from spikeloom.models.networks.reference import float_spikes
from spikeloom.runtime.equivalence.certificates import SPARE, Certainty, Certifier, _layers, _step
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.machines.votes import predictions, wins


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("certificates")


def on_chip(netlist, recordings):
    """Spikes of each layer and decisions."""
    flat = recordings.reshape(len(recordings), -1, recordings.shape[3])
    trace = engine.simulate(engine.prepare(netlist), flat, spikes=True)
    chip = [aligned(netlist, trace.spikes, layer) for layer in range(len(netlist.layers))]
    return chip, predictions(netlist, trace.counts.spikes)


def certified(model, integer, recordings, chip, decisions):
    """All recordings at once."""
    certifier = Certifier(model, integer, [slice(None)] * len(chip))
    certifier.add(recordings, chip, decisions)
    return certifier.certificate()


def shuffled(checkpoint, adjacency, recordings, seed):
    """A third order of sums: float32, input after input in random order, one rounding at a time."""
    rng, found = np.random.default_rng(seed), []
    spikes = channels_last(recordings)
    network = expand(checkpoint, adjacency)
    beta, theta = np.float32(checkpoint.beta), np.float32(checkpoint.theta)
    for population, projection in zip(network.populations, network.projections, strict=True):
        weight = projection.weight.toarray().astype(np.float32)
        current = np.zeros((*spikes.shape[:2], population.size), np.float32)
        for column in rng.permutation(weight.shape[1]):
            current += spikes[..., column, None] * weight[:, column]
        current += population.bias.astype(np.float32)
        u = np.zeros_like(current[:, 0])
        fired = np.zeros(current.shape, np.bool_)
        for step in range(current.shape[1]):
            u = beta * u + current[:, step]
            fired[:, step] = u > theta
            u = np.where(fired[:, step], np.float32(0), u)
        found.append(fired)
        spikes = fired
    return found


def runs(checkpoint, adjacency, recordings, seed=0):
    """The float model in five arithmetics."""
    network, inputs = expand(checkpoint, adjacency), channels_last(recordings)
    yield list(float_spikes(checkpoint, adjacency, recordings, dtype="float32").values())
    yield list(float_spikes(checkpoint, adjacency, recordings, dtype="float64").values())
    yield list(run_float(network, inputs, dtype=np.float32).spikes)
    yield list(run_float(network, inputs).spikes)
    yield shuffled(checkpoint, adjacency, recordings, seed)


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), gain=st.sampled_from([0.4, 1.6, 5.0]), beta=st.sampled_from([0.0, 0.2, 0.9, 0.99]))
def test_certain_spikes_are_those_of_every_run(folder, seed, gain, beta):
    checkpoint, adjacency = small_checkpoint(folder, last=weights(seed, gain=gain), beta=beta)
    recordings = events(seed, samples=3)
    certainty = Certainty(Factored(checkpoint, adjacency)).spikes(recordings)
    for run in runs(checkpoint, adjacency, recordings, seed):
        for (certain, doubt), spikes in zip(certainty, run, strict=True):
            assert not (certain & doubt).any()
            np.testing.assert_array_equal(certain[~doubt], spikes[~doubt])
    # lively networks without ties are certain almost everywhere
    assert np.mean([doubt.mean() for _, doubt in certainty]) < 0.05


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), step=st.sampled_from([0.125, 0.25, 0.5]), decimal=st.booleans())
def test_certain_spikes_among_many_ties(folder, seed, step, decimal):
    """Weights on a grid hit the threshold all the time; a grid of tenths does so up to a rounding."""
    unit = step * (0.8 if decimal else 1.0)
    last = {name: (np.round(array / 0.25) * unit).astype(np.float32) for name, array in weights(seed).items()}
    checkpoint, adjacency = small_checkpoint(folder, last=last, theta=4 * unit, beta=0.5)
    recordings = events(seed, samples=3)
    certainty = Certainty(Factored(checkpoint, adjacency)).spikes(recordings)
    for run in runs(checkpoint, adjacency, recordings, seed):
        for (certain, doubt), spikes in zip(certainty, run, strict=True):
            np.testing.assert_array_equal(certain[~doubt], spikes[~doubt])
        votes = run[-1].sum(axis=1)
        least = certainty[-1][0].sum(axis=1)
        most = least + certainty[-1][1].sum(axis=1)
        assert np.all((least <= votes) & (votes <= most))
        for label in range(CLASSES):
            assert np.all(vote(votes)[wins(np.full(3, label), least, most)] == label)


def test_uncertain_spikes_reach_the_next_layer(folder):
    """An uncertain input is uncertain for its listener only where its weight can cross the threshold."""
    arrays = {name: np.zeros_like(array) for name, array in weights(sizes=(2, 3, 2)).items()}
    arrays["fc1.bias"][:] = [0.5, 1.0]  # the first is at the threshold, the second far above
    arrays["fc2.bias"][:] = [0.25, 0.75, 0.75]
    arrays["fc2.weight"][:, 0] = [0.125, 0.125, -0.5]
    checkpoint, adjacency = small_checkpoint(folder, last=arrays, beta=0.0)
    (_, conv), (fc1, doubt1), (fc2, doubt2), (_, doubt3) = Certainty(Factored(checkpoint, adjacency)).spikes(events(0))
    assert not conv.any()
    assert doubt1[..., 0].all()
    assert fc1[..., 1].all()
    assert not doubt2[..., :2].any()
    assert doubt2[..., 2].all()
    assert not fc2[..., 0].any()
    assert fc2[..., 1].all()
    assert not doubt3.any()


def test_an_uncertain_spike_leaves_both_membranes(folder):
    """After a tie of the first step the membrane is either reset or half of the threshold; input then decides."""
    arrays = {name: np.zeros_like(array) for name, array in weights(sizes=(2, 2, 2)).items()}
    arrays["conv1.hops"][0] = [[0.5, 0.0], [0.375, 0.0], [0.0, 0.0], [0.0, 0.0], [0.5, 0.375]]
    checkpoint, adjacency = small_checkpoint(folder, last=arrays, beta=0.5)
    recordings = np.zeros((1, TAXELS, 2, 4), np.uint8)
    recordings[0, 0, 0, 0] = recordings[0, 0, 1, 1] = 1
    certain, doubt = (
        array[0, :, :FEATURES] for array in Certainty(Factored(checkpoint, adjacency)).spikes(recordings)[0]
    )
    assert doubt[0].tolist() == [True, False, False, False, True]
    # 0 + 0.375, or 0.25 + 0.375: below and above the threshold
    assert doubt[1].tolist() == [False, False, False, False, True]
    assert not doubt[2:].any()
    assert not certain.any()


def test_cancelling_hops_count_with_their_magnitudes(tmp_path):
    """Taxels in pairs: three hops lead where one does, and the weights cancel; roundings of the hops remain."""
    pairs = [(0, 1), (2, 3), (4, 5)]
    graph = dataclasses.replace(ring(), name="pairs", edges=np.array(pairs + [(b, a) for a, b in pairs]))
    arrays = {name: np.zeros_like(array) for name, array in weights(sizes=(2, 2, 2)).items()}
    arrays["conv1.hops"][1] = 2.0**20
    arrays["conv1.hops"][3] = -(2.0**20)
    arrays["conv1.bias"][:] = 0.45
    checkpoint, adjacency = small_checkpoint(tmp_path, last=arrays, graph=graph, beta=0.0)
    assert not expand(checkpoint, adjacency).projections[0].weight.toarray().any()
    recordings = np.ones((1, TAXELS, 2, 1), np.uint8)
    _, doubt = Certainty(Factored(checkpoint, adjacency)).spikes(recordings)[0]
    assert doubt.all()
    _, quiet = Certainty(Factored(checkpoint, adjacency)).spikes(np.zeros_like(recordings))[0]
    assert not quiet.any()


def test_a_membrane_that_was_not_reset_is_below_its_threshold():
    """A current of 0 to 10 may fire; if it did not, less than half of the threshold is left for the next step."""
    membrane, fired, unsure = np.zeros((2, 1)), np.zeros(1, np.uint8), np.zeros(1, np.uint8)
    found = []
    for centre, radius in ((5.0, 5.0), (0.2, 0.0)):
        _step.py_func(*membrane, np.array([centre]), np.array([radius]), 0.5, 0.5, 0.5, fired, unsure)
        found.append((bool(fired[0]), bool(unsure[0])))
    assert found == [(False, True), (False, False)]


def dense(synapses, neurons):
    """Weights as a matrix (sources, neurons)."""
    found = np.zeros((len(synapses.run) - 1, neurons))
    for source in range(len(found)):
        for run in range(synapses.run[source], synapses.run[source + 1]):
            weights_of_run = synapses.weight[synapses.offset[run] : synapses.offset[run + 1]]
            found[source, synapses.target[run] :][: len(weights_of_run)] += weights_of_run
    return found


def test_roundings_and_magnitudes_of_the_released_operator_are_those_of_its_loops(tmp_path):
    """Of K = 3 on a ring: each hop adds two neighbours to a taxel's sum, then channels and hops are summed."""
    checkpoint, adjacency = small_checkpoint(tmp_path, last=weights(3))
    first, *others = _layers(Factored(checkpoint, adjacency))
    sums = 3 * (2 + 1)
    assert (first.roundings, first.per_spike) == (SPARE + sums + 2 + 1 + 4, False)
    assert all((layer.roundings, layer.per_spike) == (SPARE, True) for layer in others)
    wanted = np.zeros((TAXELS, 2, TAXELS, FEATURES))
    powers = np.stack([np.linalg.matrix_power(np.abs(adjacency), hop) for hop in range(4)])
    for hop, taxel, source in np.ndindex(4, TAXELS, TAXELS):
        wanted[source, :, taxel] += powers[hop, taxel, source] * np.abs(checkpoint.hops[hop]).T
    np.testing.assert_allclose(dense(first.magnitude, TAXELS * FEATURES), wanted.reshape(2 * TAXELS, -1), rtol=1e-6)
    for layer, layer_given in zip(others, checkpoint.dense, strict=True):
        np.testing.assert_allclose(
            dense(layer.magnitude, len(layer_given.weight)), np.abs(layer_given.weight).T, rtol=1e-6
        )


def by_hand(checkpoint, adjacency, recordings, chip, kept, lengths):
    """Equal and different entries per layer, entry by entry."""
    found = []
    for layer, (certain, doubt) in enumerate(Certainty(Factored(checkpoint, adjacency)).spikes(recordings)):
        equal = different = 0
        for sample in range(len(recordings)):
            for step in range(lengths[sample]):
                for place, neuron in enumerate(kept[layer]):
                    if not doubt[sample, step, neuron]:
                        same = certain[sample, step, neuron] == chip[layer][sample, step, place]
                        equal, different = equal + bool(same), different + (not same)
        found.append((equal, different))
    return found


PARTS = [np.array([0, 7, 8]), np.arange(9), np.arange(2, 8), np.arange(CLASSES)]


@pytest.mark.parametrize("kept", [None, PARTS], ids=["whole", "parts"])
def test_entries_are_counted_once_each(folder, kept):
    """Of recordings of their own length, some after others; where parts of layers are compared, of these."""
    checkpoint, adjacency = small_checkpoint(folder, last=weights(3))
    netlist = compile_network(expand(checkpoint, adjacency), Options(packings=(Packing(bits=4),))).netlist
    recordings, lengths = events(4, samples=3, steps=12), np.array([5, 12, 9])
    for recording, length in zip(recordings, lengths, strict=True):
        recording[..., length:] = 0
    chip, decisions = on_chip(netlist, recordings)
    kept = kept or [np.arange(spikes.shape[2]) for spikes in chip]
    inside = (np.arange(12) < lengths[:, None])[:, :, None]
    parts = [spikes[..., part] & inside for spikes, part in zip(chip, kept, strict=True)]
    certifier = Certifier(Factored(checkpoint, adjacency), lift(netlist), kept)
    for rows in (slice(0, 1), slice(1, 3)):
        certifier.add(recordings[rows], [spikes[rows] for spikes in parts], decisions[rows], lengths[rows])
    found = certifier.certificate()
    assert list(found.layers) == ["conv1", "fc1", "fc2", "fc3"]
    assert [layer.entries for layer in found.layers.values()] == [26 * len(part) for part in kept]
    expected = by_hand(checkpoint, adjacency, recordings, parts, kept, lengths)
    assert [(layer.equal, layer.different) for layer in found.layers.values()] == expected
    assert all(layer.undecided == layer.entries - layer.equal - layer.different for layer in found.layers.values())
    assert sum(layer.different for layer in found.layers.values()) > 0
    assert found.samples == 3
    voted = float_spikes(checkpoint, adjacency, recordings)["fc3"] & inside
    # no tie in these networks, so that nothing stands between certainty and the reference
    assert found.decisions == np.count_nonzero(voted.sum(axis=1).argmax(axis=1) == decisions)


def far_from_thresholds():
    """Weights of one half and no bias: without a memory, sums are multiples of one half."""
    arrays = {name: np.sign(array) * np.float32(0.5) for name, array in weights(3).items()}
    arrays |= {name: np.zeros_like(array) for name, array in arrays.items() if name.endswith("bias")}
    arrays["conv1.hops"][1:] = 0
    return arrays


def verdict_far_from_thresholds(folder, **constants):
    checkpoint, adjacency = small_checkpoint(folder, last=far_from_thresholds(), **constants)
    netlist = compile_network(expand(checkpoint, adjacency)).netlist
    return verify(netlist, Factored(checkpoint, adjacency), recorded(events(2, steps=8)))


def test_a_network_far_from_its_thresholds_is_certified_whole(tmp_path):
    verdict = verdict_far_from_thresholds(tmp_path, beta=0.0, theta=0.25)
    found = verdict.certificate
    assert all(layer.equal == layer.entries > 0 for layer in found.layers.values())
    assert all(layer.chip > 0 for layer in verdict.spikes.values())
    assert (found.decisions, found.samples, found.unproven) == (6, 6, ())


def test_the_same_network_at_its_thresholds_is_not(tmp_path):
    verdict = verdict_far_from_thresholds(tmp_path, beta=0.5, theta=0.5)
    # these very sums are exact, so that no spike differs; another order of sums is not known to be
    assert verdict.first_divergence is None
    assert verdict.certificate.layers["conv1"].undecided > 0
    assert verdict.certificate.layers["conv1"].different == 0


def test_registers_without_a_proof_are_named(tmp_path):
    """Almost without leak a negative input adds up almost without end: the membrane may clip, and is said to."""
    checkpoint, adjacency = small_checkpoint(tmp_path, beta=4095 / 4096)
    netlist = compile_network(expand(checkpoint, adjacency), Options(keep_all=True)).netlist
    recordings = events(2, steps=8)
    found = certified(Factored(checkpoint, adjacency), lift(netlist), recordings, *on_chip(netlist, recordings))
    assert found.unproven == found.saturating == ("conv1", "fc1", "fc2", "fc3")
    said = "no register of conv1, fc1, fc2, fc3 overflows for any input, but some may saturate a membrane"
    assert list(open_ranges(found.unproven, found.saturating)) == [said]
    assert [*open_ranges(("a",), ())] == ["no proof of range for a: the simulator stops at the first overflow"]


@given(st.data())
def test_wins_is_whether_every_vote_agrees(data):
    counts = st.lists(st.integers(0, 2), min_size=3, max_size=3)
    least = np.array(data.draw(counts))
    most = least + data.draw(counts)
    label = data.draw(st.integers(0, 2))
    ranges = [np.arange(a, b + 1) for a, b in zip(least, most, strict=True)]
    votes = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = bool(np.all(votes.argmax(axis=1) == label))
    assert wins(np.array([label]), least[None], most[None]).tolist() == [expected]
