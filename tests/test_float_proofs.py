"""What is proven of a float model beside the chip: no change of so many events alters its decision either."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from commands import as_json, refusal, run
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import CLASSES, own_file, recordings_folder, sparse_events, weights
from numpy.testing import assert_array_equal
from random_networks import chain, float_networks, random_checkpoint, ring, stored, with_population

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.interpret import float_simulation
from spikeloom.compiler.ir import INPUT, Input, Network, Population, Projection, Readout
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.bounds.floats import laid_out
from spikeloom.runtime.machines.changes import Past
from spikeloom.runtime.report.encode import decode
from spikeloom.runtime.studies.robustness.float_proof import verdict
from spikeloom.runtime.studies.robustness.proofs.bounds import PASTS, REACH, lower_bound
from spikeloom.runtime.studies.robustness.results import Certificates

REPEATABLE = settings(max_examples=60, derandomize=True)


def votes_of(network, runs):
    """Of recordings (runs, channels, steps), (runs, steps, classes), in float32."""
    fired = float_simulation(network, np.float32).run(runs.transpose(0, 2, 1) != 0).spikes
    spikes = fired[network.readout.population].astype(np.int64)
    return np.stack(
        [spikes[:, :, network.readout.label == each].sum(axis=2) for each in range(network.classes)], axis=2
    )


def decided(network, runs):
    return votes_of(network, runs).sum(axis=1).argmax(axis=1)


def every_change(channels, count):
    """All recordings in which so many entries of one (channels, steps) are flipped."""
    every = np.array(list(combinations(range(channels.size), count)))
    runs = np.repeat(channels.reshape(1, -1), len(every), axis=0)
    np.put_along_axis(runs, every, 1 - np.take_along_axis(runs, every, axis=1), axis=1)
    return runs.reshape(-1, *channels.shape)


def proven(network, channels, most=3):
    model = laid_out(network, channels.shape[1])
    votes, groups = model.groups(channels, (*channels.shape, network.classes), REACH)
    assert_array_equal(votes, votes_of(network, channels[None])[0].sum(axis=0))
    return lower_bound(votes, groups, PASTS, most).events


def small_network(seed, taxels=2):
    return expand(
        random_checkpoint(seed=seed, taxels=taxels, features=5, sizes=(9, 8, CLASSES)), ring(taxels)
    )


def lasting(network, alpha=0.5):
    """The same with currents that outlast a step."""
    for index in range(len(network.populations)):
        network = with_population(network, index, alpha=alpha)
    return network


def tied(network):
    """Weights in tenths, of which sums are near thresholds and hang on how float32 rounds."""
    projections = [
        replace(each, weight=stored(np.round(each.weight.toarray(), 1))) for each in network.projections
    ]
    network = replace(network, projections=tuple(projections))
    for index, each in enumerate(network.populations):
        network = with_population(network, index, bias=np.round(each.bias, 1))
    return network


KINDS = {
    "plain": lambda network: network,
    "tied": tied,
    "lasting": lasting,
    "tied and lasting": lambda n: tied(lasting(n, 0.9)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_none_of_all_pairs_and_triples_breaks_what_is_proven(kind):
    bounds = []
    for seed in (1, 4, 6, 11, 13):
        network = KINDS[kind](small_network(seed))
        for one in sparse_events(seed, 2, 2, 2, 12, rate=0.2):
            channels = one.reshape(4, 12)
            decision = decided(network, channels[None])[0]
            bound = proven(network, channels)
            bounds.append(bound)
            for count in range(1, min(bound, 3) + 1):
                assert np.all(decided(network, every_change(channels, count)) == decision)
    assert {0, 1} <= set(bounds)


@REPEATABLE
@given(data=st.data())
def test_no_event_alters_what_is_proven_of_networks_of_any_wiring(data):
    """Recurrent layers, several populations a depth, neurons that never decay nor spike."""
    network = data.draw(float_networks(betas=(0.0, 0.2, 0.9, 1.0)))
    network = lasting(network, data.draw(st.sampled_from([0.0, 0.5])))
    channels = sparse_events(data.draw(st.integers(0, 99)), network.input.size, 9, rate=0.3)
    if proven(network, channels, most=1):
        assert np.all(decided(network, every_change(channels, 1)) == decided(network, channels[None]))


@pytest.mark.parametrize("kind", KINDS)
def test_no_past_and_no_future_make_a_group_turn_more_votes_than_its_bound(kind):
    rng = np.random.default_rng(5)
    network = KINDS[kind](small_network(5, taxels=5))
    inputs, steps, reach = network.input.size, 40, 8
    pasts = [Past(1), Past(3), Past(6), Past(1, single=True), Past(3, single=True)]
    channels = sparse_events(rng, inputs, steps, rate=0.1)
    votes, (lag, lost, after) = laid_out(network, steps).groups(channels, (inputs, steps, CLASSES), reach)
    depth = len(network.populations) - 1  # chip steps that votes lag behind
    known = votes_of(network, channels[None])[0]
    tight = 0
    for _ in range(150):
        past, count = pasts[rng.integers(len(pasts))], rng.integers(2)
        t = int(rng.integers(past.steps if past.single else 0, steps))
        later = rng.integers(1, reach + 1)
        runs = np.repeat(channels[None], 24, axis=0)
        before = max(t - past.steps + (not past.single), 0)
        runs[:, :, :before] = rng.random((24, inputs, before)) < rng.random((24, 1, 1))
        if later < reach:
            after_it = max(steps - t - later, 0)
            runs[:, :, t + later :] = rng.random((24, inputs, after_it)) < rng.random((24, 1, 1))
        for each in runs:
            if past.single:
                each[rng.integers(inputs), before] ^= 1
            each[rng.choice(inputs, rng.integers(1, inputs + 1) if count else 1, replace=False), t] ^= 1
        begin = t + lag - depth
        window = slice(max(begin, 0), max(begin + later, 0) if later < reach else None)
        more = (votes_of(network, runs)[:, window] - known[window]).sum(axis=1)
        sharp = after(past, t)
        assert np.all(sharp <= lost[t])
        for other in set(range(CLASSES)) - {int(votes.argmax())}:
            turned = more[:, other] - more[:, votes.argmax()]
            assert np.all(turned <= sharp[count, later - 1, other])
            tight += int(np.any(turned == sharp[count, later - 1, other]))
    assert tight > 20


def voters(weight, **registers):
    """A layer that votes, its first neuron for class 1, its second for class 0."""
    weight = np.array(weight)
    return Network(
        input=Input(taxels=weight.shape[1], polarities=1),
        populations=(Population(name="votes", bias=np.zeros(2), **registers),),
        projections=(Projection(pre=INPUT, post=0, weight=stored(weight, weight != 0)),),
        readout=Readout(population=0, label=np.array([1, 0])),
        classes=2,
    )


def test_a_current_that_lasts_is_seen_behind_a_membrane_that_does_not():
    """A spike more clears the membrane, below the known one; what caused it comes back from the current."""
    network = voters([[0.45, 0.6, 0.0], [0.0, 0.0, 0.9]], beta=0.0, theta=0.5, alpha=0.5)
    channels = np.array([[1, 0, 0], [0, 0, 0], [1, 0, 0]], np.uint8)
    assert not np.all(decided(network, every_change(channels, 1)) == decided(network, channels[None]))
    assert proven(network, channels) == 0


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_layers_whose_currents_last_and_that_vote(beta):
    rng = np.random.default_rng(7)
    shown = set()
    for _ in range(60):
        weight = np.round(rng.normal(0, 0.5, (2, 3)), 1)
        network = voters(weight, beta=beta, theta=0.5, alpha=float(rng.choice([0.5, 0.95])))
        channels = sparse_events(rng, 3, 20, rate=0.3)  # beyond the step in which small numbers are flushed
        altered = np.any(decided(network, every_change(channels, 1)) != decided(network, channels[None]))
        bound = proven(network, channels)
        assert not (bound and altered)
        shown.add(bool(bound))
    assert shown == {False, True}


def test_what_a_current_rounds_comes_back_as_often_as_it_lasts():
    """Held just below 2, a current adds pairs that cancel; an event lifts it above, where each of them is rounded."""
    alpha, steps, pairs, ulp = np.float32(0.99), 200, 200, 2.0**-23
    charge = 0.050633639097213745  # with which 50 steps end a little below 2
    weight = np.array([[16 * ulp, charge, 0.0, *[1.001 * ulp, -0.999 * ulp] * pairs]]).repeat(2, axis=0)
    weight[1] = 0
    channels = np.zeros((weight.shape[1], steps), np.uint8)
    channels[1, :50] = 1
    channels[2:, 50:] = 1
    current = np.float32(0)
    for _ in range(50):
        current = current * alpha + np.float32(charge)
    weight[0, 2] = float(current) - float(current * alpha)
    changed = channels.copy()
    changed[0, 51] = 1

    def highest(runs, theta):
        network = voters(weight, beta=0.99, theta=theta, alpha=0.99)
        run = float_simulation(network, np.float32).run(runs.transpose(0, 2, 1) != 0, membranes=True)
        return network, run.membranes[0][..., 0].max(axis=1)

    low, high = highest(np.stack([channels, changed]), 1e6)[1]
    assert high > low
    network, _ = highest(channels[None], float(low + 0.75 * (high - low)))
    model = laid_out(network, steps)
    _, groups = model.groups(channels, (1, steps, 2), REACH)
    assert not np.array_equal(*votes_of(network, np.stack([channels, changed])).sum(axis=1))
    assert groups.after(Past(52), 51)[0, -1, 1] >= 1


def test_networks_without_bounds_are_refused():
    network = chain([[1.0, 0.5]], [[1.0]], [[1.0]])
    skips = Projection(pre=0, post=2, weight=stored([[0.5]]))
    with pytest.raises(OptionError, match=r"fc3 receives from layers of several depths.* omit it"):
        laid_out(replace(network, projections=(*network.projections, skips)), 9)
    for large in (3e38, 1e300):
        with pytest.raises(OptionError, match=r"may exceed float32.* omit it"):
            laid_out(voters([[large, large, -large], [0, 0, 0]], beta=0.0, theta=0.5), 1)


def test_single_events_are_decided_exactly():
    """Where all events of a step together might alter a decision, each is tried alone."""
    shown = set()
    for seed in (1, 2, 3, 5):
        network = tied(small_network(seed, taxels=5))
        netlist = compile_network(network).netlist
        for one in sparse_events(seed, 6, 5, 2, 20, rate=0.2):
            model = verdict(laid_out(network, 20), netlist, 1, one)
            channels = one.reshape(10, 20)
            alters = np.any(decided(network, every_change(channels, 1)) != model.decision)
            assert model.at_least == int(not alters)
            shown.add((model.at_least, proven(network, channels, most=1)))
    assert shown == {(0, 0), (1, 0), (1, 1)}


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own_file("net.pt")
    recordings_folder(tmp_path / "data")
    as_json("compile", "net.pt", "-o", "net.loom")
    words = ["certify", "net.loom", "--data", "data", "--shift", "2", "--most", "3"]
    alone = as_json(*words)
    beside = as_json(*words, "--checkpoint", "net.pt")
    assert beside["provenance"]["checkpoint"] == "net.pt"
    result = decode(Certificates, beside)
    both = [each["float"] for each in beside["certificates"]]
    for each, model in zip(result.certificates, both, strict=True):
        alike = model["decision"] == each.decision
        assert each.alike == (min(each.at_least, model["at_least"]) if alike else None)
    for each in beside["certificates"]:
        del each["float"]
    assert beside["certificates"] == alone["certificates"]
    out = run(*words, "--checkpoint", "net.pt")[1]
    assert "float model alike" in out
    assert "float model and chip decide alike: " in out
    assert (
        refusal(*words, "--graph", "manual") == "--graph manual: it says how --checkpoint is read; omit it"
    )
    own_file("other.pt", last=weights(seed=2))
    assert "give the one that it was compiled from" in refusal(*words, "--checkpoint", "other.pt")
