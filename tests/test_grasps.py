import hashlib

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.grasps import SHAPES, synthetic_grasps


def test_shape_order_and_names():
    grasps = synthetic_grasps(per_class=2, steps=30, seed=5, classes=("ring", "box", "edge"))
    assert grasps.events.shape == (6, 39, 2, 30)
    assert grasps.events.dtype == np.uint8
    assert grasps.events.flags.c_contiguous
    assert set(np.unique(grasps.events).tolist()) == {0, 1}
    assert grasps.labels.tolist() == [0, 1, 2, 0, 1, 2]
    assert grasps.files[:4] == (
        "sample_0_label_0.npy",
        "sample_1_label_1.npy",
        "sample_2_label_2.npy",
        "sample_3_label_0.npy",
    )
    assert (grasps.split, grasps.source) == ("synthetic", "synthetic grasps, seed 5")


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
@settings(deadline=None, max_examples=30)
def test_each_grasp_has_a_stream_of_its_own(seed, steps, few, more, chosen):
    """More grasps go on where fewer stop, and leaving out classes changes nothing in the others."""
    everything = synthetic_grasps(per_class=few + more, steps=steps, seed=seed)
    classes = tuple(sorted(chosen))
    part = synthetic_grasps(per_class=few, steps=steps, seed=seed, classes=classes)
    for label, shape in enumerate(classes):
        whole = everything.events[everything.labels == SHAPES.index(shape)]
        assert np.array_equal(part.events[part.labels == label], whole[:few])


@given(shift=st.tuples(st.integers(-50, 50), st.integers(-50, 50)), power=st.integers(-3, 3))
@settings(deadline=None, max_examples=20)
def test_only_the_proportions_of_a_layout_matter(shift, power):
    """Positions on a grid of 1/8 mm, so that moving and doubling them is exact."""
    layout = np.round(NEUTOUCH * 8) / 8
    there = (layout + np.array(shift)) * 2.0**power
    first, second = (synthetic_grasps(coordinates=place, per_class=1, steps=20, seed=1) for place in (layout, there))
    assert np.array_equal(first.events, second.events)


def test_density_is_that_of_real_recordings():
    grasps = synthetic_grasps(per_class=20, steps=100, seed=3)
    assert 0.05 < grasps.events.mean() < 0.15
    by_class = [grasps.events[grasps.labels == label].mean() for label in range(len(SHAPES))]
    assert 0.03 < min(by_class) < max(by_class) < 0.25


def test_pressing_rises_and_lifting_falls():
    """Polarity 1 while the shape goes in, polarity 0 while it comes out, both while the hand trembles."""
    events = synthetic_grasps(per_class=20, steps=100, seed=0).events
    falling, rising = events.mean(axis=(0, 1))
    assert rising[10:30].mean() > 5 * falling[10:30].mean()
    assert falling[75:95].mean() > 5 * rising[75:95].mean()
    assert min(rising[45:60].mean(), falling[45:60].mean()) > 0.05
    assert max(rising[0], falling[0], rising[-1], falling[:10].mean()) < 0.03
