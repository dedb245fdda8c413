"""Sections as text and as a page; results as JSON and back."""

import json
import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from spikeloom.runtime.report import drawing, html
from spikeloom.runtime.report.encode import OPTIONAL, decode, encode, key
from spikeloom.runtime.report.sections import Code, Details, Facts, Figure, Section, Table, Text, terminal

NUMBERS = Table(["layer", "spikes"], [["conv1", "12"], ["fc1", "3 < 4"]], "Spikes by layer")
CHAPTER = Section(
    "What was found",
    [
        Facts({"accuracy": ("90 %", "9 of 10")}),
        Text("first\nsecond"),
        Section(
            "Spikes", [Figure("spikes", lambda: drawing.bars("Spikes", {"conv1": [12]}, ["n"]), "By layer.", [NUMBERS])]
        ),
        Details("More", [Text("folded")], group="more"),
        Code(["spikeloom run 'a b'"]),
    ],
    chapter=True,
)


def test_text_shows_all_but_what_is_folded_or_for_the_eye():
    assert terminal([CHAPTER, Section("", [NUMBERS])]) == (
        "What was found\n--------------\nfirst\nsecond\n\n"
        "  layer  spikes\n  conv1      12\n  fc1     3 < 4\n\n"
        "$ spikeloom run 'a b'\n\n"
        "  layer  spikes\n  conv1      12\n  fc1     3 < 4"
    )


def test_a_page_is_whole_escaped_and_the_same_each_time():
    page = html.page("a <b>", "about", [CHAPTER])
    assert page == html.page("a <b>", "about", [CHAPTER])
    assert "<h1>a &lt;b&gt;</h1>" in page
    assert '<section id="what-was-found"><h2>What was found</h2>' in page
    assert "3 &lt; 4" in page
    assert '<details name="more">' in page
    values = json.loads(page.partition('<script type="application/json">')[2].partition("</script>")[0])
    ((_, _, tip),) = values["tips"]
    assert tip == "conv1, n: 12"


def test_values_of_a_drawing_lie_on_its_marks():
    drawn = drawing.bars("bars", {"a": [1.0], "b": [2.0], "c": [3.0]}, ["n"])
    drawn.svg("x")
    (left, high), (middle, _), (right, low) = (tip[:2] for tip in drawn.values()["tips"])
    assert left < middle < right <= 72 * drawing.WIDTH
    assert 0 <= high < low
    assert middle == pytest.approx((left + right) / 2, abs=0.2)


@dataclass(frozen=True)
class Inner:
    share: float
    name: str | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class Outer:
    json_properties = ("twice",)
    inner: tuple[Inner, ...]
    by_window: dict[int, float] = field(metadata=key("windows"))
    pair: tuple[str, int] = ("a", 1)

    @property
    def twice(self) -> int:
        return 2 * self.pair[1]


def test_a_result_is_written_as_json_and_read_back():
    result = Outer(inner=(Inner(0.5), Inner(1.0, "x")), by_window={50: 1.0})
    value = json.loads(json.dumps(encode(result)))
    wanted = {"inner": [{"share": 0.5}, {"share": 1.0, "name": "x"}], "windows": {"50": 1.0}, "pair": ["a", 1]}
    assert value == wanted | {"twice": 2}
    assert decode(Outer, value) == result
    for wrong in ({}, [], value | {"inner": [{"share": "much"}]}, value | {"pair": ["a"]}):
        with pytest.raises((TypeError, ValueError, KeyError)):
            decode(Outer, wrong)


def test_numbers_of_numpy_are_plain_and_what_has_no_form_is_refused():
    assert encode({"a": np.float32(0.5), "b": np.arange(2), "c": math.nan}) == {"a": 0.5, "b": [0, 1], "c": None}
    with pytest.raises(TypeError):
        encode(object())
