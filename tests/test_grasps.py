import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.grasps import SHAPES, synthetic_grasps


def features(recordings) -> np.ndarray:
    """Event counts of each taxel and polarity, and a constant, (samples, 79)."""
    counts = recordings.events.sum(axis=3, dtype=np.int64).reshape(len(recordings), -1)
    return np.column_stack([counts / recordings.steps, np.ones(len(recordings))])


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


def test_seeds_differ():
    first, second = (synthetic_grasps(per_class=1, steps=40, seed=seed).events for seed in (0, 1))
    assert all((a != b).any() for a, b in zip(first, second, strict=True))


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


def test_other_layouts():
    rng = np.random.default_rng(0)
    for layout in (rng.random((12, 3)), rng.random((5, 1)), np.zeros((1, 2))):
        grasps = synthetic_grasps(coordinates=layout, per_class=3, steps=40, seed=0)
        assert grasps.events.shape == (18, len(layout), 2, 40)
        assert 0.02 < grasps.events.mean() < 0.3


@pytest.mark.parametrize("steps", [20, 100, 325])
def test_density_is_that_of_real_recordings(steps):
    grasps = synthetic_grasps(per_class=20, steps=steps, seed=3)
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


def test_a_taxel_falls_as_often_as_it_rises():
    """Each level that is crossed up is crossed down; the rest is noise and the end of the recording."""
    falling, rising = synthetic_grasps(per_class=20, steps=100, seed=0).events.sum(axis=(0, 1, 3)).tolist()
    assert abs(rising - falling) < 0.1 * rising


def test_ring_spares_its_middle_and_cone_seeks_it():
    grasps = synthetic_grasps(per_class=40, steps=100, seed=2, classes=("ring", "cone"))
    middle = np.hypot(*NEUTOUCH.T) < 1.6
    ring, cone = (grasps.events[grasps.labels == label] for label in (0, 1))
    assert ring[:, middle].mean() < ring[:, ~middle].mean()
    assert cone[:, middle].mean() > 2 * cone[:, ~middle].mean()


def test_classes_are_learnable_but_not_trivial():
    """Least squares on event counts: well above chance (1/6), short of certainty; on totals alone, far short."""
    train, test = (synthetic_grasps(per_class=n, steps=100, seed=seed) for n, seed in ((60, 1), (40, 2)))
    wanted = np.eye(len(SHAPES))[train.labels]

    def accuracy(learn: np.ndarray, judge: np.ndarray) -> float:
        weights = np.linalg.lstsq(
            np.vstack([learn, 0.3 * np.eye(learn.shape[1])]),
            np.vstack([wanted, np.zeros((learn.shape[1], len(SHAPES)))]),
            rcond=None,
        )[0]
        return float(((judge @ weights).argmax(axis=1) == test.labels).mean())

    a, b = features(train), features(test)
    assert 0.7 < accuracy(a, b) < 0.98
    totals = [np.column_stack([x[:, :-1].sum(axis=1), x[:, -1]]) for x in (a, b)]
    assert accuracy(*totals) < 0.6


NAMES = "sphere, cylinder, edge, ring, cone, box"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"per_class": 0}, "grasps: per_class is 0, allowed are 1 or more; choose another"),
        ({"steps": 9}, "grasps: steps is 9, allowed are 10 or more; choose another"),
        ({"seed": -1}, "grasps: seed is -1, allowed are 0 or more; choose another"),
        ({"classes": ()}, f"grasps: classes ; choose from {NAMES}, each once"),
        ({"classes": ("cube",)}, f"grasps: classes cube; choose from {NAMES}, each once"),
        ({"classes": ("box", "box")}, f"grasps: classes box, box; choose from {NAMES}, each once"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(OptionError) as caught:
        synthetic_grasps(**{"per_class": 1, "steps": 20, "seed": 0} | options)
    assert str(caught.value) == message


def test_bad_coordinates():
    with pytest.raises(ModelError) as caught:
        synthetic_grasps(coordinates=np.zeros(39), per_class=1, steps=20, seed=0)
    assert str(caught.value) == ("coordinates: shape (39,), allowed is (taxels, dimensions); give one row per taxel")
