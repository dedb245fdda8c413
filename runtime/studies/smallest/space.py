"""What is tried: counting networks of many sizes, a few trained ones, and support vector machines beside them."""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.systems import MLP, SYSTEMS, TACTILESGNET
from spikeloom.models.recordings.evtouch import WHOLE
from spikeloom.models.training.counters import STRENGTHS, Plan
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.report.encode import OPTIONAL

JOINS = (1, 2, 5, 10, 25)
PARTS = (1, 2, 3, 5, 10)
WINDOWS = (100, 50)
THRESHOLDS = ((1,), (1, 4, 16, 64), (1, 3, 8, 20, 50), (1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 130))
"""Of counting networks."""

RAMPS = (16, 64)
"""Steps of the read-out that those which go on are tried with, too."""

BITS = (5, 4, 3)
"""Of their weights; the two next to those of the chip."""

STORAGE = 4
"""Bits in which networks that are trained by gradients are stored, too."""

MOST_COUNTERS = {100: 50, 50: 20}
"""Counters of a channel at most, by window: what is larger gains little and takes minutes."""


NETWORKS = ((TACTILESGNET, 10, 16, "64,64"), (TACTILESGNET, 10, 32, "128,256"), (MLP, 10, 16, "64,64"))
"""System, join, features and neurons of the dense layers of those that are trained by gradients."""

EPOCHS = 15
"""Of these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A system and the options of ``train`` that make it, beside the data; or a baseline and its features."""

    system: str
    options: Mapping[str, Any]
    storage: int | None = field(
        default=None, metadata=OPTIONAL
    )  # Bits of a weight, where not those of `compile`

    json_properties = ("name",)

    @property
    def name(self) -> str:
        """For tables."""
        options = dict(self.options)
        thresholds = [str(options.pop("thresholds"))] if "thresholds" in options else []
        options |= {} if self.storage is None else {"stored": self.storage}
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
    """Networks of some systems that are trained by gradients, for recordings of so many bins."""
    for system, join, features, hidden in NETWORKS:
        if system in systems and join <= steps // 2:
            options = {
                "recipe": "timed",
                "join": join,
                "features": features,
                "hidden": hidden,
                "epochs": EPOCHS,
            }
            yield Candidate(system=system, options=options)


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
    """What goes on from a rung beside a candidate: first other lengths of the read-out, then fewer bits of a weight."""
    known = candidate.options
    if candidate.system != COUNTING:
        return [replace(candidate, storage=STORAGE)] if rung > 1 and candidate.system in SYSTEMS else []
    if rung == 1:
        return [_counters(**{**known, "ramp": ramp}) for ramp in RAMPS]
    fewer = [bits for bits in BITS if bits < known.get("weight_bits", 8)]
    return [_counters(**{**known, "weight_bits": bits}) for bits in fewer[:2]]
