"""The words of ``--grid``: what they mean, and what they may be."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.options import GOALS
from spikeloom.runtime.studies.chart.grid import AXES, Grid, parse_grid

TARGET = load_target("loihi1")
WIDTHS = (2, 3, 4, 5, 6, 8)


def parsed(text):
    return parse_grid(text, TARGET)


def test_every_axis_of_the_whole_example():
    found = parsed("bits=2-6,8,planes=1-2,window=25-100%,cores=latency/fc1:6+conv1:4,prune=0/1,groups=2")
    assert found == Grid(
        bits=((2,), (3,), (4,), (5,), (6,), (8,)),
        planes=(1, 2),
        window=(25, 50, 75, 100),
        cores=("latency", "fc1:6+conv1:4"),
        prune=(0, 1),
        groups=(2,),
    )


def test_axes_that_are_not_named_keep_their_usual_value():
    assert parsed("bits=4") == Grid(bits=((4,),))
    assert Grid().bits == tuple((width,) for width in WIDTHS)
    assert Grid().window == (25, 50, 75, 100)


def test_values_stay_in_order_and_each_is_there_once():
    assert parsed("bits=8,2-4,3,4+4+4+4").bits == ((8,), (2,), (3,), (4,))
    assert parsed("bits=8+4+4+8/8").bits == ((8, 4, 4, 8), (8,))


@pytest.mark.parametrize(
    ("text", "windows"),
    [
        ("50", (50,)),
        ("50%", (50,)),
        ("25-100%", (25, 50, 75, 100)),
        ("25%-100%", (25, 50, 75, 100)),
        ("40-100%:20", (40, 60, 80, 100)),
        ("40-100%:50%", (40, 90, 100)),
        ("100-100", (100,)),
    ],
)
def test_windows(text, windows):
    assert parsed(f"window={text}").window == windows


@pytest.mark.parametrize(
    ("text", "telling"),
    [
        *((f"bits={value}", f"bits={value}: allowed are 2, 3, 4, 5, 6, 8") for value in ("2-x", "2-8", "7", "²", "")),
        *((f"bits={value}", "or a width for each layer as in 8+4+4+8") for value in ("8+4+9", "8+", "8+2-4", "6-2")),
        ("bits=3,,4", "bits=: allowed are 2"),
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


GRIDS = st.builds(
    Grid,
    bits=st.lists(
        st.one_of(
            st.tuples(st.sampled_from(WIDTHS)),
            st.tuples(*[st.sampled_from(WIDTHS)] * 3).filter(lambda widths: len(set(widths)) > 1),
        ),
        min_size=1,
        max_size=4,
        unique=True,
    ).map(tuple),
    planes=st.lists(st.integers(1, 3), min_size=1, max_size=3, unique=True).map(tuple),
    groups=st.lists(st.integers(1, 8), min_size=1, max_size=4, unique=True).map(tuple),
    prune=st.lists(st.integers(0, 1), min_size=1, max_size=2, unique=True).map(tuple),
    cores=st.lists(
        st.one_of(
            st.sampled_from(GOALS),
            st.dictionaries(st.sampled_from(["conv1", "fc1", "fc2"]), st.integers(1, 99), min_size=1).map(
                lambda layers: "+".join(f"{layer}:{count}" for layer, count in layers.items())
            ),
        ),
        min_size=1,
        max_size=3,
        unique=True,
    ).map(tuple),
    window=st.lists(st.integers(1, 100), min_size=1, max_size=4, unique=True).map(tuple),
)


@given(GRIDS, st.sampled_from([",", "/", " , ", "/ "]), st.permutations(AXES))
def test_what_is_written_is_read(grid, between, order):
    words = {
        "bits": ["+".join(map(str, widths)) for widths in grid.bits],
        "planes": grid.planes,
        "groups": grid.groups,
        "prune": grid.prune,
        "cores": grid.cores,
        "window": [f"{window}%" for window in grid.window],
    }
    text = ",".join(f"{axis}={between.join(map(str, words[axis]))}" for axis in order if words[axis])
    assert parsed(text) == grid
