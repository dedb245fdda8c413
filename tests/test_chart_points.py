"""Grids as they are written, and fronts, choices and budgets on points that are made up."""

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_chart import BY, made_figures, made_network, made_point

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import load_target
from spikeloom.runtime.studies.chart.choices import (
    TRAINING,
    VALIDATION,
    Budget,
    front,
    parse_budgets,
    pick,
    recommended,
    saving,
    usual_point,
    with_expectations,
    with_fronts,
)
from spikeloom.runtime.studies.chart.grid import Grid, parse_grid
from spikeloom.runtime.studies.chart.results import ChosenBy

UJ = 1e-6


def point(number, train, test, energy, time, *, step=20e-6, bits=4, **about):
    """Right of 400 training and of 100 test recordings, µJ and ms of both splits."""
    figures = {
        "train": made_figures(train, 400, energy, time, step=step),
        "test": made_figures(test, 100, energy, time, step=step),
    }
    return made_point(number, bits=(bits,), n_cores=4, **figures, **about)


@pytest.fixture
def points():
    made = [
        point(1, 400, 88, 200, 4.0, bits=8),
        point(2, 398, 90, 120, 3.0),
        point(3, 396, 70, 60, 2.0, bits=3),
        point(4, 395, 89, 40, 2.5, bits=2),
        point(5, 400, 60, 300, 1.0, cores="latency"),
    ]
    return with_fronts(with_expectations(made, [made_network()])[0], BY)


# -- fronts and expectations -------------------------------------------------------------------------------------------
@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=12))
def test_the_front_is_what_no_other_point_beats(pairs):
    gains, costs = [float(gain) for gain, _ in pairs], [float(cost) for _, cost in pairs]
    wanted = [
        not any(other[0] >= gain and other[1] <= cost and other != (gain, cost) for other in pairs)
        for gain, cost in pairs
    ]
    assert front(gains, costs) == wanted


def test_fronts_are_of_test_accuracy_and_each_cost(points):
    assert [each.front["energy"] for each in points] == [False, True, False, True, False]
    assert [each.front["latency"] for each in points] == [False, True, True, True, True]
    assert points[0].front.keys() == {"energy", "operations", "cores", "latency"}


def test_expected_is_validation_times_what_is_kept_on_training_recordings():
    (reached,), (network,), words = with_expectations([point(1, 380, 50, 1, 1)], [made_network(trained=396)])
    assert (reached.expected, network.expected, words) == (pytest.approx(0.9 * 0.95 / 0.99), 0.9, VALIDATION)
    # where one checkpoint knows no validation, training figures stand for all
    networks = [made_network(trained=396), made_network("other", validation=None)]
    (reached,), _, words = with_expectations([point(1, 380, 50, 1, 1)], networks)
    assert (reached.expected, words) == (pytest.approx(0.95), TRAINING)


# -- choices -----------------------------------------------------------------------------------------------------------
def chosen(points, expected=0.9, bins=1):
    return recommended(points, [made_network(expected=expected, bins=bins)], BY, bin_s=0.02)


def test_recommended_points(points):
    # within one of a hundred test recordings: expected at least 89 %, that is 395.6 of 400 training recordings
    assert chosen(points) == {"cheapest": 3, "fastest": 5, "best": 1}
    assert chosen(points, expected=0.99) == {"cheapest": None, "fastest": None, "best": 1}


def test_a_point_that_does_not_keep_pace_with_the_sensor_is_not_the_fastest(points):
    points[4] = replace(points[4], train=replace(points[4].train, step_s={"clock": 0.03}))
    assert chosen(points)["fastest"] == 3
    assert chosen(points, bins=2)["fastest"] == 5  # steps of 40 ms


def test_choices_do_not_look_at_the_test_split(points):
    blind = [replace(each, test=made_figures(1, 100, 1, 1)) for each in points]
    assert chosen(blind) == chosen(points)
    assert pick(blind, parse_budgets(["energy=100uJ"]), BY).point == 3


def test_saving_against_eight_bits(points):
    found = saving(points, BY)
    assert (found.usual, found.chosen.point, found.seen.point) == (1, 3, 4)
    assert found.chosen.energy == {"one": pytest.approx(200 / 60), "two": pytest.approx(200 / 60)}
    assert found.chosen.accuracy == pytest.approx(-0.18)
    assert found.seen.energy["one"] == pytest.approx(5.0)
    assert found.seen.accuracy == pytest.approx(0.01)


def test_the_usual_mapping_is_the_manual_graph_at_eight_bits_on_whole_recordings(points):
    assert usual_point(points[1:]) is None
    assert saving(points[1:], BY) is None
    other = point(6, 400, 80, 100, 1, bits=8, graph="knn:1")
    assert usual_point([other, *points]).number == 1
    assert usual_point([other, *points[1:]]).number == 6
    for about in ({"fine_tuned": True}, {"prune": True}, {"window": 50}, {"planes": 2}, {"cores": "latency"}):
        assert usual_point([point(7, 400, 80, 100, 1, bits=8, **about)]) is None


# -- budgets -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("words", "limit"),
    [
        *((f"energy={value}", 1e-4) for value in ("0.1mJ", "100uJ", "100 µJ", "100μJ", "1e-4J")),
        ("latency=5ms", 5e-3),
        ("latency= .5us", 5e-7),
        ("accuracy=88", 0.88),
        ("accuracy=88.5%", 0.885),
    ],
)
def test_a_budget_in_units(words, limit):
    (budget,) = parse_budgets([words])
    assert budget == Budget(what=words.partition("=")[0], limit=pytest.approx(limit), words=words)


@pytest.mark.parametrize(
    "words",
    [
        "power=1W",
        *(f"energy{value}" for value in ("", "=0.1", "=1ms", "=0mJ")),
        *(f"latency={value}" for value in ("", "-1ms")),
        *(f"accuracy={value}" for value in ("101", "x")),
    ],
)
def test_a_budget_that_is_none(words):
    with pytest.raises(OptionError, match=f"--budget {words}: .*(write|allowed|give)"):
        parse_budgets([words])
    with pytest.raises(OptionError, match="--budget latency=2ms: latency is limited twice; give it once"):
        parse_budgets(["latency=1ms", "latency=2ms"])


@pytest.mark.parametrize(
    ("budgets", "number", "fitting"),
    [
        (["energy=150uJ"], 2, 3),  # energy buys the best that fits
        (["accuracy=89"], 3, 4),  # an accuracy is reached as cheaply as can be
        (["accuracy=89.2"], 2, 3),
        (["accuracy=90"], 1, 2),
        (["energy=150uJ", "latency=2.2ms"], 3, 1),
        (["accuracy=88", "latency=1.5ms"], 5, 1),
    ],
)
def test_the_point_that_fits_all_budgets(points, budgets, number, fitting):
    found = pick(points, parse_budgets(budgets), BY)
    assert (found.fits, found.point, found.fitting, found.misses) == (True, number, fitting, {})


def test_what_is_given_up_beside_the_best(points):
    assert pick(points, (), BY) is None
    found = pick(points, parse_budgets(["energy=150uJ"]), BY)
    assert found.best == 1
    assert found.given_up.expected == pytest.approx(-0.0045)
    assert found.given_up.accuracy == pytest.approx(0.02)
    assert found.given_up.energy["one"] == pytest.approx(200 / 120)
    assert found.given_up.time["clock"] == pytest.approx(4 / 3)


def test_the_nearest_point_of_a_budget_that_nothing_fits(points):
    found = pick(points, parse_budgets(["energy=20uJ"]), BY)
    assert (found.fits, found.fitting, found.point) == (False, 0, 4)
    (miss,) = found.misses.values()
    assert (miss["limit"], miss["found"]) == (pytest.approx(20 * UJ), pytest.approx(40 * UJ))
    both = pick(points, parse_budgets(["energy=50uJ", "latency=2ms"]), BY)
    assert (both.point, list(both.misses)) == (3, ["energy"])
    with pytest.raises(OptionError, match=r"--budget latency: .*no time table"):
        pick(points, parse_budgets(["latency=1ms"]), ChosenBy(energy="one", time=None))


TARGET = load_target("loihi1")
WIDTHS = (2, 3, 4, 5, 6, 8)


def parsed(text):
    return parse_grid(text, TARGET)


@pytest.mark.parametrize(
    ("text", "axes"),
    [
        (
            "bits=2-6,8,planes=1-2,window=25-100%,cores=latency/fc1:6+conv1:4,prune=0/1,groups=2",
            {
                "bits": ((2,), (3,), (4,), (5,), (6,), (8,)),
                "planes": (1, 2),
                "window": (25, 50, 75, 100),
                "cores": ("latency", "fc1:6+conv1:4"),
                "prune": (0, 1),
                "groups": (2,),
            },
        ),
        # in their order, each once
        ("bits=8,2-4,3,4+4+4+4", {"bits": ((8,), (2,), (3,), (4,))}),
        ("bits=8+4+4+8/8", {"bits": ((8, 4, 4, 8), (8,))}),
        (
            "groups=2 / 1,planes=3/ 1 , cores=cores/fc1:3",
            {"groups": (2, 1), "planes": (3, 1), "cores": ("cores", "fc1:3")},
        ),
        *((f"window={text}", {"window": (50,)}) for text in ("50", "50%")),
        *((f"window={text}", {"window": (25, 50, 75, 100)}) for text in ("25-100%", "25%-100%")),
        ("window=40-100%:20", {"window": (40, 60, 80, 100)}),
        ("window=40-100%:50%", {"window": (40, 90, 100)}),
        ("window=100-100", {"window": (100,)}),
    ],
)
def test_values_of_axes(text, axes):
    assert parsed(text) == Grid(**axes)
    assert Grid().bits == tuple((width,) for width in WIDTHS)
    assert Grid().window == (25, 50, 75, 100)


@pytest.mark.parametrize(
    ("text", "telling"),
    [
        *((f"bits={value}", f"bits={value}: allowed are 2, 3, 4, 5, 6, 8") for value in ("2-x", "7", "")),
        *((f"bits={value}", "or a width for each layer as in 8+4+4+8") for value in ("8+4+9", "6-2")),
        ("bits=3,", "bits=: allowed are 2"),
        ("bits=3,bits=4", "bits: give each of bits, planes, groups, prune, cores, window once"),
        ("planes=1, colour=2", "colour: give each of bits, planes"),
        ("3,4", "3: belongs to no axis; begin with one"),
        ("", ": belongs to no axis; begin with one"),
        ("planes=4", "planes=4: allowed are 1 to 3 planes"),
        ("groups=0", "groups=0: allowed are 1 to 8 scale groups"),
        ("prune=2", "prune=2: allowed are 0 (keep) and 1 (leave out)"),
        *((f"window={value}", "1 to 100 per cent") for value in ("50-101%", "0", "80-20%", "20-80%:0", "50%:5")),
        *((f"cores={value}", "cores, latency, or LAYER:N") for value in ("fast", "a:2+:3", "a:2+a:3", "a:0")),
    ],
)
def test_a_mistake_names_the_value_and_what_is_allowed(text, telling):
    with pytest.raises(OptionError) as caught:
        parsed(text)
    assert str(caught.value).startswith("--grid ")
    assert telling in str(caught.value)


def test_a_grid_that_is_too_large():
    every = "/".join("+".join(map(str, widths)) for widths in product(WIDTHS, repeat=4))
    with pytest.raises(OptionError, match="388,800 points a network, allowed are 100,000"):
        parsed(f"bits={every},planes=1-3,window=1-100%:1")
