"""The words of ``--grid``: what they mean, and where exactly they are wrong."""

import re
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.options import GOALS
from spikeloom.runtime.studies.chart.grid import Grid, axes, parse_grid

TARGET = load_target("loihi1")
WIDTHS = (2, 3, 4, 5, 6, 8)


def parsed(text):
    return parse_grid(text, TARGET)


def test_every_axis_of_the_whole_example():
    found = parsed(
        "bits=2-6,8,graph=manual/knn:1,planes=1-2,window=25-100%,cores=latency/fc1:6+conv1:4,prune=0/1,groups=2"
    )
    assert found == Grid(
        bits=((2,), (3,), (4,), (5,), (6,), (8,)),
        graph=("manual", "knn:1"),
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
    ("text", "at", "what"),
    [
        ("bits=2-x", 8, "'x' is not a width"),
        ("bits=2-8", 6, "'2-8' holds 7"),
        ("bits=8+4+9", 10, "9 is not a width that the chip stores; allowed: 2, 3, 4, 5, 6, 8"),
        ("bits=6-2", 6, "'6-2' runs backwards; write 2-6"),
        ("bits=,planes=1", 6, "bits has an empty value"),
        ("bits=3,,4", 8, "bits has an empty value"),
        ("bits=3,", 8, "bits has an empty value"),
        ("bits=3,bits=4", 8, "bits is given twice"),
        ("planes=1, colour=2", 11, "'colour' is no axis; axes are bits, planes, groups, prune, cores, window, graph"),
        ("3,4", 1, "'3' belongs to no axis"),
        ("planes=4", 8, "4 is not a number of planes; allowed: 1 to 3"),
        ("groups=0", 8, "0 is not a number of scale groups; allowed: 1 to 8"),
        ("prune=2", 7, "2 is not 0 (keep) or 1 (leave out); allowed: 0, 1"),
        ("window=50-101%", 11, "101 is not a part in per cent; allowed: 1 to 100"),
        ("window=80-20%", 8, "'80-20%' runs backwards; write 20-80%"),
        ("window=20-80%:0", 15, "0 is not a step in per cent"),
        ("window=50%:5", 11, "'50%:5' is no range"),
        ("cores=fast", 7, "'fast' is no layout; allowed: cores, energy, latency"),
        ("cores=fc1:2+:3", 13, "':3' names no layer"),
        ("cores=fc1:2+fc1:3", 13, "fc1 is given twice"),
        ("bits=²", 6, "'²' is not a width"),
    ],
)
def test_a_mistake_is_pointed_at(text, at, what):
    with pytest.raises(OptionError) as caught:
        parsed(text)
    first, shown, caret = str(caught.value).split("\n")
    assert first.startswith(f"--grid, character {at}: {what}")
    assert (shown, caret) == (f"  {text}", f"  {' ' * (at - 1)}^")


def test_an_empty_grid_and_one_that_is_too_large():
    for text in ("", "   "):
        with pytest.raises(OptionError, match="--grid: is empty"):
            parsed(text)
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
    graph=st.lists(st.from_regex(r"[a-z]+(:[0-9.]+)?", fullmatch=True), max_size=3, unique=True).map(tuple),
)


@given(GRIDS, st.sampled_from([",", "/", " , ", "/ "]), st.permutations(axes(TARGET)))
def test_what_is_written_is_read(grid, between, order):
    words = {
        "bits": ["+".join(map(str, widths)) for widths in grid.bits],
        "planes": grid.planes,
        "groups": grid.groups,
        "prune": grid.prune,
        "cores": grid.cores,
        "window": [f"{window}%" for window in grid.window],
        "graph": grid.graph,
    }
    text = ",".join(f"{axis}={between.join(map(str, words[axis]))}" for axis in order if words[axis])
    assert parsed(text) == grid


@given(st.text(alphabet="bits=planewdocrgh0123456789-+,/:% x", max_size=30))
def test_any_text_is_a_grid_or_a_mistake_with_a_place(text):
    try:
        found = parsed(text)
    except OptionError as error:
        lines = str(error).splitlines()
        place = re.match(r"--grid, character ([0-9]+): .+", lines[0])
        if place is None:
            assert len(lines) == 1
        else:
            assert lines[1] == f"  {text}"
            assert lines[2] == " " * (int(place[1]) + 1) + "^"
            assert 1 <= int(place[1]) <= len(text) + 1
    else:
        assert all(getattr(found, name) for name in Grid.__slots__ if name != "graph")
