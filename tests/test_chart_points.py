"""Fronts, choices and budgets on points that are made up, so that every answer can be read off."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.studies.chart.budget import Budget, parse_budgets, pick
from spikeloom.runtime.studies.chart.points import (
    TRAINING,
    VALIDATION,
    front,
    recommended,
    saving,
    share,
    usual_point,
    with_expectations,
    with_fronts,
)

UJ, MS = 1e-6, 1e-3


def split(right, energy, time, samples=100, step=20e-6):
    return {
        "samples": samples,
        **share(right, samples),
        "energy_j": {"one": energy * UJ, "two": 1.5 * energy * UJ},
        "time_s": {"clock": time * MS},
        "step_s": {"clock": step},
        "synaptic_operations": 1e6 * energy,
    }


def point(number, train, test, energy, time, *, step=20e-6, **axes):
    """Right of 400 training and of 100 test recordings, µJ and ms of both splits."""
    usual = {"graph": "manual", "bits": [4], "planes": 1, "groups": 1, "prune": False, "cores": "cores", "window": 100}
    return {
        "number": number,
        "network": "net",
        "fine_tuned": False,
        "n_cores": 4,
        **usual,
        **axes,
        "train": split(train, energy, time, 400, step),
        "test": split(test, energy, time, step=step),
    }


def network(name="net", validation=0.9, training=1.0, bins=1):
    return {"name": name, "validation": validation, "float_training": training, "bins": bins}


def prepared(points, networks=None):
    networks = networks or [network()]
    with_expectations(points, networks)
    with_fronts(points, "one", "clock")
    return networks


@pytest.fixture
def points():
    found = [
        point(1, 400, 88, 200, 4.0, bits=[8]),
        point(2, 398, 90, 120, 3.0),
        point(3, 396, 70, 60, 2.0, bits=[3]),
        point(4, 395, 89, 40, 2.5, bits=[2]),
        point(5, 400, 60, 300, 1.0, cores="latency"),
    ]
    prepared(found)
    return found


# -- fronts ------------------------------------------------------------------------------------------------------------


def test_the_front_of_six_points():
    #        best   cheap  beaten equal  beaten by equal accuracy for less
    gains = [0.90, 0.50, 0.45, 0.80, 0.80, 0.90]
    costs = [9.0, 1.0, 2.0, 4.0, 5.0, 9.0]
    assert front(gains, costs) == [True, True, False, True, False, True]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=12))
def test_the_front_is_what_no_other_point_beats(found):
    gains, costs = [float(gain) for gain, _ in found], [float(cost) for _, cost in found]
    wanted = [
        not any(other[0] >= gain and other[1] <= cost and other != (gain, cost) for other in found)
        for gain, cost in found
    ]
    assert front(gains, costs) == wanted


def test_fronts_are_of_test_accuracy_and_each_cost(points):
    assert [each["front"]["energy"] for each in points] == [False, True, False, True, False]
    assert [each["front"]["latency"] for each in points] == [False, True, True, True, True]


# -- what is expected --------------------------------------------------------------------------------------------------


def test_expected_is_validation_times_what_is_kept_on_training_recordings():
    found = [point(1, 380, 50, 1, 1)]
    networks = [network(validation=0.9, training=0.99)]
    assert with_expectations(found, networks) == VALIDATION
    assert found[0]["expected"] == pytest.approx(0.9 * 0.95 / 0.99)
    assert networks[0]["expected"] == 0.9


def test_where_one_checkpoint_knows_no_validation_training_figures_stand_for_all():
    found = [point(1, 380, 50, 1, 1)]
    networks = [network(training=0.99), network("other", validation=None)]
    assert with_expectations(found, networks) == TRAINING
    assert found[0]["expected"] == pytest.approx(0.95)


# -- choices -----------------------------------------------------------------------------------------------------------


def test_recommended_points(points):
    # within one of a hundred test recordings: expected at least 89 %, that is 395.6 of 400 training recordings
    found = recommended(points, [network() | {"expected": 0.9}], energy="one", time="clock", bin_s=0.02)
    assert found == {"cheapest": 3, "fastest": 5, "best": 1}


def test_a_point_that_does_not_keep_pace_with_the_sensor_is_not_the_fastest(points):
    points[4]["train"]["step_s"]["clock"] = 0.03
    found = recommended(points, [network() | {"expected": 0.9}], energy="one", time="clock", bin_s=0.02)
    assert found["fastest"] == 3
    longer = network(bins=2) | {"expected": 0.9}  # steps of 40 ms
    assert recommended(points, [longer], energy="one", time="clock", bin_s=0.02)["fastest"] == 5


def test_no_point_is_near_the_float_model(points):
    found = recommended(points, [network() | {"expected": 0.99}], energy="one", time="clock", bin_s=0.02)
    assert found == {"cheapest": None, "fastest": None, "best": 1}


def test_choices_do_not_look_at_the_test_split(points):
    before = recommended(points, [network() | {"expected": 0.9}], energy="one", time="clock", bin_s=0.02)
    for each in points:
        each["test"] = split(1, 1, 1)
    assert recommended(points, [network() | {"expected": 0.9}], energy="one", time="clock", bin_s=0.02) == before
    assert pick(points, parse_budgets(["energy=100uJ"]), energy="one", time="clock")["point"] == 3


def test_saving_against_eight_bits(points):
    found = saving(points, "one")
    assert found["usual"] == 1
    assert found["chosen"]["point"] == 3
    assert found["chosen"]["energy"] == {"one": pytest.approx(200 / 60), "two": pytest.approx(200 / 60)}
    assert found["chosen"]["accuracy"] == pytest.approx(-0.18)
    assert found["seen"]["point"] == 4
    assert found["seen"]["energy"]["one"] == pytest.approx(5.0)
    assert found["seen"]["accuracy"] == pytest.approx(0.01)


def test_the_usual_mapping_is_the_manual_graph_at_eight_bits_on_whole_recordings(points):
    assert usual_point(points[1:]) is None
    assert saving(points[1:], "one") is None
    other = point(6, 400, 80, 100, 1, bits=[8], graph="knn:1")
    assert usual_point([other, *points])["number"] == 1
    assert usual_point([other, *points[1:]])["number"] == 6
    tuned = point(7, 400, 80, 100, 1, bits=[8], fine_tuned=True)
    assert usual_point([tuned]) is None


# -- budgets -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "limit"),
    [
        ("energy=0.1mJ", 1e-4),
        ("energy=100uJ", 1e-4),
        ("energy=100 µJ", 1e-4),
        ("energy=100μJ", 1e-4),
        ("energy=1e-4J", 1e-4),
        ("latency=5ms", 5e-3),
        ("latency= .5us", 5e-7),
        ("accuracy=88", 0.88),
        ("accuracy=88.5%", 0.885),
    ],
)
def test_a_budget_in_units(words, limit):
    (found,) = parse_budgets([words])
    assert found == Budget(what=words.partition("=")[0], limit=pytest.approx(limit), words=words)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["power=1W"], "power=1W: is none of energy, latency, accuracy; write for example energy=0.1mJ or accuracy=88"),
        (["energy"], "energy: is none of energy, latency, accuracy; write for example energy=0.1mJ or accuracy=88"),
        (["energy=0.1"], "energy=0.1: 0.1 is no energy; write it as in 0.1mJ (J, mJ, uJ, nJ, pJ)"),
        (["energy=1ms"], "energy=1ms: 1ms is no energy; write it as in 0.1mJ (J, mJ, uJ, nJ, pJ)"),
        (["latency="], "latency=: nothing is no latency; write it as in 5ms (s, ms, us, ns)"),
        (["latency=-1ms"], "latency=-1ms: -1ms is no latency; write it as in 5ms (s, ms, us, ns)"),
        (["energy=0mJ"], "energy=0mJ: allowed is more than 0"),
        (["accuracy=101"], "accuracy=101: allowed is 0 to 100"),
        (["accuracy=many"], "accuracy=many: many is no accuracy; write it in per cent, as in 88 (%)"),
        (["latency=1ms", "latency=2ms"], "latency=2ms: latency is limited twice; give it once"),
    ],
)
def test_a_budget_that_is_none(words, told):
    with pytest.raises(OptionError) as caught:
        parse_budgets(words)
    assert str(caught.value) == f"--budget {told}"


def picked(points, *words):
    return pick(points, parse_budgets(words), energy="one", time="clock")


def test_without_a_budget_nothing_is_picked(points):
    assert picked(points) is None


def test_energy_buys_the_best_that_fits(points):
    found = picked(points, "energy=150uJ")
    assert (found["fits"], found["fitting"], found["point"], found["best"]) == (True, 3, 2, 1)
    assert found["given_up"]["expected"] == pytest.approx(-0.0045)
    assert found["given_up"]["accuracy"] == pytest.approx(0.02)
    assert found["given_up"]["energy"]["one"] == pytest.approx(200 / 120)
    assert found["given_up"]["time"]["clock"] == pytest.approx(4 / 3)


def test_an_accuracy_is_reached_as_cheaply_as_can_be(points):
    assert picked(points, "accuracy=89")["point"] == 3
    assert picked(points, "accuracy=89.2")["point"] == 2
    assert picked(points, "accuracy=90")["point"] == 1


def test_all_budgets_hold(points):
    assert picked(points, "energy=150uJ", "latency=2.2ms")["point"] == 3
    assert picked(points, "accuracy=88", "latency=1.5ms")["point"] == 5


def test_the_nearest_point_of_a_budget_that_nothing_fits(points):
    found = picked(points, "energy=20uJ")
    assert (found["fits"], found["fitting"], found["point"]) == (False, 0, 4)
    assert found["misses"] == {"energy": {"limit": pytest.approx(20 * UJ), "found": pytest.approx(40 * UJ)}}
    both = picked(points, "energy=50uJ", "latency=2ms")
    assert both["point"] == 3
    assert list(both["misses"]) == ["energy"]


def test_time_cannot_be_limited_where_nothing_is_timed(points):
    with pytest.raises(OptionError) as caught:
        pick(points, parse_budgets(["latency=1ms"]), energy="one", time=None)
    assert str(caught.value) == "--budget latency: the chip has no time table, nothing is timed; leave it away"
