"""Made-up grasps, and what happens to recordings: each function keeps what it promises."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import sparse_events
from numpy.testing import assert_array_equal

from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.grasps import SHAPES, synthetic_grasps
from spikeloom.runtime.studies.robustness import perturbations as p


@st.composite
def recordings(draw, *, least=1):
    """Recordings (samples, taxels, 2, steps)."""
    shape = [draw(st.integers(1, 3)), draw(st.integers(2, 7)), 2, draw(st.integers(least, 30))]
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return sparse_events(rng, *shape, rate=draw(st.sampled_from([0.0, 0.1, 0.5, 1.0])))


SEEDS = st.integers(0, 2**32 - 1)


def drawn(seed):
    return np.random.default_rng(seed)


@given(recordings(), SEEDS, st.integers(0, 7))
def test_dead_and_stuck_taxels_and_no_others(events, seed, count):
    taxels = p.random_taxels(events, count, drawn(seed))
    others = np.setdiff1d(np.arange(events.shape[1]), taxels)
    assert len(set(taxels.tolist())) == min(count, events.shape[1])
    dead, stuck = p.set_taxels(events, taxels, 0), p.set_taxels(events, taxels, 1)
    assert not dead[:, taxels].any()
    assert stuck[:, taxels].all()
    for found in (dead, stuck):
        assert_array_equal(found[:, others], events[:, others])


@given(st.integers(2, 9), SEEDS)
def test_harsher_choices_contain_milder_ones(taxels, seed):
    places = np.random.default_rng(seed).random((taxels, 2))
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    for count in range(1, taxels):
        fewer, more = (
            set(p.random_taxels(np.zeros((1, taxels)), n, drawn(seed)).tolist()) for n in (count, count + 1)
        )
        assert fewer < more
        near, nearer = (p.neighbours(distance, n, drawn(seed)).tolist() for n in (count + 1, count))
        assert near[:count] == nearer


def test_neighbours_are_the_nearest_ones_the_lower_number_first():
    line = np.abs(np.arange(5.0)[:, None] - np.arange(5.0))
    centres = {
        p.neighbours(line, 3, drawn(seed))[0]: p.neighbours(line, 3, drawn(seed)).tolist()
        for seed in range(40)
    }
    assert centres == {0: [0, 1, 2], 1: [1, 0, 2], 2: [2, 1, 3], 3: [3, 2, 4], 4: [4, 3, 2]}


@given(recordings(), SEEDS, st.floats(0, 1), st.floats(0, 1))
def test_a_higher_rate_loses_and_invents_what_a_lower_one_does_and_more(events, seed, share, other):
    rates = (0.0, *sorted((share, other)), 1.0)
    kept = [p.events_lost(events, rate, drawn(seed)) for rate in rates]
    made = [p.events_spurious(events, rate, drawn(seed)) for rate in rates]
    assert_array_equal(kept[0], events)
    assert_array_equal(made[0], events)
    assert not kept[3].any()
    assert made[3].all()
    for milder, harsher in ((0, 1), (1, 2)):
        assert np.all(kept[harsher] <= kept[milder])
        assert np.all(made[harsher] >= made[milder])


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_rates_are_those_that_were_asked_for(share):
    full, none = np.ones((4, 39, 2, 250), np.uint8), np.zeros((4, 39, 2, 250), np.uint8)
    spread = 5 * np.sqrt(share * (1 - share) * full.size)  # five standard deviations of a binomial number
    assert abs(full.sum() - p.events_lost(full, share, drawn(1)).sum(dtype=int) - share * full.size) < spread
    assert abs(p.events_spurious(none, share, drawn(1)).sum(dtype=int) - share * full.size) < spread


@given(recordings(), SEEDS, st.floats(0, 8))
def test_jitter_moves_events_along_their_channel_and_makes_none(events, seed, sigma):
    found = p.time_jitter(events, sigma, drawn(seed))
    before, after = events.sum(axis=3, dtype=int), found.sum(axis=3, dtype=int)
    assert np.all(after <= before)  # less by what meets
    assert_array_equal(after > 0, before > 0)
    assert found.max(initial=0) <= 1
    assert_array_equal(p.time_jitter(events, 0.0, drawn(seed)), events)


def test_jitter_keeps_the_number_of_events_that_do_not_meet():
    events = np.zeros((1, 200, 2, 101), np.uint8)
    events[..., 50] = 1
    found = p.time_jitter(events, 5.0, drawn(3))
    assert_array_equal(found.sum(axis=3), events.sum(axis=3))
    moved = np.nonzero(found)[3] - 50
    assert abs(moved.mean()) < 1.5
    assert 4.0 < moved.std() < 6.0


@given(recordings(), st.integers(0, 40))
def test_a_late_start_and_an_early_one_undo_each_other_but_for_the_ends(events, steps):
    late, early = p.start_late(events, steps), p.start_early(events, steps)
    length = events.shape[3]
    assert not late[..., :steps].any()
    assert_array_equal(late[..., steps:], events[..., : max(length - steps, 0)])
    assert not early[..., max(length - steps, 0) :].any()
    assert_array_equal(
        p.start_early(late, steps)[..., : max(length - steps, 0)], events[..., : max(length - steps, 0)]
    )


def test_playing_faster_and_slower():
    events = np.zeros((1, 1, 2, 8), np.uint8)
    events[0, 0, 0] = [1, 0, 1, 1, 0, 0, 1, 1]
    assert p.play(events, 2.0)[0, 0, 0].tolist() == [1, 1, 0, 1, 0, 0, 0, 0]
    assert p.play(events, 0.5)[0, 0, 0].tolist() == [1, 0, 0, 0, 1, 0, 1, 0]


@given(recordings(), st.floats(0.1, 10))
def test_playing_makes_no_events(events, speed):
    found = p.play(events, speed)
    assert np.all(found.sum(axis=3, dtype=int) <= events.sum(axis=3, dtype=int))
    assert_array_equal(p.play(events, 1.0), events)


@given(recordings(), SEEDS, st.integers(0, 7))
def test_swapped_polarity_is_undone_by_doing_it_again(events, seed, count):
    taxels = p.random_taxels(events, count, drawn(seed))
    once = p.swap_polarity(events, taxels)
    assert_array_equal(once.sum(axis=2), events.sum(axis=2))
    assert_array_equal(once[:, taxels, 0], events[:, taxels, 1])
    assert_array_equal(p.swap_polarity(once, taxels), events)


@given(recordings(), SEEDS, st.floats(0, 1), st.floats(0, 1))
def test_densities_are_reached_from_their_side_alone(events, seed, density, other):
    room = events[0].size
    thin, full = p.near_empty(events, density, drawn(seed)), p.saturated(events, density, drawn(seed))
    assert np.all(thin <= events)
    assert np.all(full >= events)
    for i, own in enumerate(events.sum(axis=(1, 2, 3), dtype=int).tolist()):
        assert thin[i].sum(dtype=int) == min(own, int(np.floor(density * room)))
        assert full[i].sum(dtype=int) == max(own, int(np.ceil(density * room)))
    low, high = sorted((density, other))
    assert np.all(p.near_empty(events, low, drawn(seed)) <= p.near_empty(events, high, drawn(seed)))
    assert np.all(p.saturated(events, low, drawn(seed)) <= p.saturated(events, high, drawn(seed)))
    assert p.saturated(events, 1.0, drawn(seed)).all()
    assert not p.near_empty(events, 0.0, drawn(seed)).any()


@pytest.mark.parametrize("name", [name for name, each in p.SAMPLED.items() if each.to == "events"])
@settings(max_examples=5)
@given(events=recordings(), seed=SEEDS)
def test_recordings_that_were_given_stay_as_they_are(name, events, seed):
    before, distance = events.copy(), np.zeros((events.shape[1], events.shape[1]))
    for level in p.SAMPLED[name].levels:
        found, again = (p.SAMPLED[name].done(events, level, distance, drawn(seed)) for _ in range(2))
        assert (found.shape, found.dtype) == (events.shape, np.uint8)
        assert_array_equal(found, again)  # the same seed, the same events
        assert_array_equal(events, before)


def test_a_seed_gives_the_same_bytes_everywhere():
    events = synthetic_grasps(per_class=2, steps=40, seed=7).events
    assert hashlib.sha256(events.tobytes()).hexdigest() == (
        "440e823d181ad2246ab531753d3565784fbca31a944a5f041d1668a3ecc6fb95"
    )


@given(
    seed=st.integers(0, 2**32),
    steps=st.integers(10, 40),
    few=st.integers(1, 2),
    more=st.integers(0, 2),
    chosen=st.sets(st.sampled_from(SHAPES), min_size=1),
)
def test_each_grasp_has_a_stream_of_its_own(seed, steps, few, more, chosen):
    """More grasps go on where fewer stop, and leaving out classes changes nothing in the others."""
    everything = synthetic_grasps(per_class=few + more, steps=steps, seed=seed)
    classes = tuple(sorted(chosen))
    part = synthetic_grasps(per_class=few, steps=steps, seed=seed, classes=classes)
    for label, shape in enumerate(classes):
        whole = everything.events[everything.labels == SHAPES.index(shape)]
        assert np.array_equal(part.events[part.labels == label], whole[:few])


@given(shift=st.tuples(st.integers(-50, 50), st.integers(-50, 50)), power=st.integers(-3, 3))
def test_only_the_proportions_of_a_layout_matter(shift, power):
    """Positions on a grid of 1/8 mm, so that moving and doubling them is exact."""
    layout = np.round(NEUTOUCH * 8) / 8
    there = (layout + np.array(shift)) * 2.0**power
    first, second = (
        synthetic_grasps(coordinates=place, per_class=1, steps=20, seed=1) for place in (layout, there)
    )
    assert np.array_equal(first.events, second.events)
