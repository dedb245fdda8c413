"""What is tried: counting networks and networks that are trained by gradients, of many sizes, and baselines."""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.systems import GCN, GRID_CNN, MLP, TACTILESGNET
from spikeloom.models.recordings.evtouch import WHOLE
from spikeloom.models.training.counters import STRENGTHS, Plan
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import whole_numbers

JOINS = (1, 2, 5, 10, 25)
PARTS = (1, 2, 3, 5, 10)
WINDOWS = (100, 50)
THRESHOLDS = ((1,), (1, 4, 16, 64), (1, 3, 8, 20, 50), (1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 130))
"""Of counting networks."""

RAMPS = (16, 64)
"""Steps of the read-out that those which go on are tried with, too."""

BITS = (5, 4, 3)
"""Of their weights; the two next to those of the chip."""

MOST_COUNTERS = {100: 50, 50: 20}
"""Counters of a channel at most, by window: what is larger gains little and takes minutes."""


EPOCHS = (12, 24, 48, 96)
"""Of networks that are trained by gradients, by rung."""

SIZES = (
    (TACTILESGNET, 64, 3, "128,256"),
    (TACTILESGNET, 16, 1, "64,128"),
    (TACTILESGNET, 32, 1, "128"),
    (TACTILESGNET, 32, 2, "64"),
    (TACTILESGNET, 16, 1, "64"),
    (TACTILESGNET, 32, 1, "none"),
    (TACTILESGNET, 16, 1, "32"),
    (TACTILESGNET, 8, 1, "64"),
    (TACTILESGNET, 8, 1, "32"),
    (TACTILESGNET, 16, 1, "none"),
    (TACTILESGNET, 4, 1, "16"),
    (MLP, 64, None, "128,256"),
    (MLP, 32, None, "64"),
    (GCN, 32, None, "64"),
    (GRID_CNN, 32, None, "64"),
)
"""System, features, hops and dense layers of these, the largest first: they take longest."""

LASTING = (3, 6)
"""Those of them, by place, that are also trained with currents that last and clocks."""

STEPS = (25, 130)
"""Steps that a usual recording has in these, at least and at most, by the bins that are joined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A system and the options of ``train`` that make it, beside the data; or a baseline and its features."""

    system: str
    options: Mapping[str, Any]
    json_properties = ("name",)

    @property
    def name(self) -> str:
        """For tables."""
        options = dict(self.options)
        thresholds = [str(options.pop("thresholds"))] if "thresholds" in options else []
        return " ".join([self.system, *thresholds, *(f"{name}={value}" for name, value in options.items())])

    @property
    def words(self) -> list[str]:
        """As they are typed after ``train``."""
        return repeat.words({"system": self.system, **self.options})

    def plan(self, strengths: tuple[float, ...] = STRENGTHS) -> Plan:
        """Of a counting network."""
        about = dict(self.options)
        thresholds = tuple(whole_numbers(about.pop("thresholds"), "--thresholds"))
        about["bins"], about["bits"] = about.pop("join", 1), about.pop("weight_bits", 8)
        return Plan(thresholds=thresholds, strengths=strengths, **about)


def counting(steps: int, levels: int = 1, bits: int = 8) -> Iterator[Candidate]:
    """Counting networks for recordings of so many bins, in weights of some bits; usual options are left out.

    A counter sees one event a step at most, so thresholds above the steps of a part are omitted.

    >>> [each.name for each in counting(2)]
    ['counters 1', 'counters 1,2', 'counters 1 parts=2']
    """
    known: dict[tuple[Any, ...], None] = {}
    for join, window, parts, thresholds in product(JOINS, WINDOWS, PARTS, THRESHOLDS):
        seen = math.ceil(math.ceil(steps / join) * window / 100)
        length = math.ceil(seen / parts)
        able = tuple(each for each in thresholds if each <= length)
        whole = (parts - 1) * length < seen and join <= steps // 2  # no part is empty, and time passes
        closed = window == WHOLE or parts > 1  # gates: nothing else keeps later events from the counters
        if whole and closed and len(able) * parts <= MOST_COUNTERS[window]:
            known[join, window, parts, able] = None
    for join, window, parts, able in known:
        about = {"parts": parts, "levels": levels, "window": window, "join": join, "weight_bits": bits}
        yield _counters(thresholds=",".join(map(str, able)), **about)


def networks(steps: int, systems: Collection[str]) -> Iterator[Candidate]:
    """Networks of some systems that are trained by gradients, for recordings that usually have so many bins.

    >>> {each.options["join"] for each in networks(250, ["mlp"])}
    {2, 10, 5}
    """
    least, most = STEPS
    joins = [join for join in JOINS if least <= steps / join <= most] or [1]
    for place, (system, features, hops, hidden) in enumerate(SIZES):
        for join in joins if system in systems else ():
            for recipe in ("rates", "timed") if place in LASTING else ("rates",):
                options = {
                    "recipe": recipe,
                    "join": join,
                    "features": features,
                    "hops": hops,
                    "hidden": hidden,
                }
                given = {name: value for name, value in options.items() if value is not None}
                yield Candidate(system=system, options=given)


def _counters(**options: Any) -> Candidate:
    """Options that are usual are omitted."""
    usual = {
        "thresholds": None,
        "parts": 1,
        "ramp": 32,
        "levels": 1,
        "window": 100,
        "join": 1,
        "weight_bits": 8,
    }
    given = {name: options.get(name, value) for name, value in usual.items()}
    return Candidate(
        system=COUNTING, options={name: each for name, each in given.items() if each != usual[name]}
    )


def variants(candidate: Candidate, rung: int) -> list[Candidate]:
    """Counting networks that go on beside one: first with other lengths of the read-out, then with fewer bits."""
    known = candidate.options
    if rung == 1:
        return [_counters(**{**known, "ramp": ramp}) for ramp in RAMPS]
    fewer = [bits for bits in BITS if bits < known.get("weight_bits", 8)]
    return [_counters(**{**known, "weight_bits": bits}) for bits in fewer[:2]]
