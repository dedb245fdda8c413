"""What is tried: counting networks and networks that are trained by gradients, of many sizes, and baselines."""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
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


EPOCHS = (12, 24, 48, 72)
"""Of networks that are trained by gradients, by rung, where the training split has few recordings."""

MANY = 600
"""Recordings from which on epochs are fewer, so that as many recordings pass."""

SIZES = (
    (MLP, 32, None, "32", 0.0),
    (TACTILESGNET, 4, 1, "16", 0.0),
    (GCN, 32, None, "64", 0.0),
    (GRID_CNN, 32, None, "64", 0.0),
    (MLP, 64, None, "64", 0.0),
    (TACTILESGNET, 8, 3, "32", 0.0),
    (TACTILESGNET, 16, 1, "32", 0.0),
    (TACTILESGNET, 16, 1, "64", 0.3),
    (MLP, 64, None, "128", 0.0),
    (TACTILESGNET, 32, 1, "none", 0.0),
    (TACTILESGNET, 32, 3, "64", 0.1),
    (TACTILESGNET, 32, 3, "128", 0.3),
    (MLP, 64, None, "128,256", 0.0),
    (TACTILESGNET, 64, 3, "64", 0.3),
    (TACTILESGNET, 64, 3, "128,256", 0.0),
)
"""System, features, hops, dense layers and penalty on spikes; the largest, which take longest, are begun last."""

USUAL_STEPS = 60
"""Steps near which the bins of a network are joined at first."""

STEPS = (25, 130)
"""Steps that a usual recording has in these, at least and at most, by the bins that are joined."""


def epochs_of(rung: int, count: int) -> int:
    """Epochs of a rung where so many recordings train: each rung has more than the one before.

    >>> [epochs_of(rung, 576) for rung in (1, 2, 3, 4)]
    [12, 24, 48, 72]
    >>> [epochs_of(rung, 6000) for rung in (1, 2, 3, 4)]
    [1, 2, 5, 7]
    """
    return max(rung, round(EPOCHS[rung - 1] * min(1.0, MANY / count)))


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
    {5}
    """
    join = min(_joins(steps), key=lambda join: abs(math.log(steps / join / USUAL_STEPS)))
    for system, features, hops, hidden, penalty in SIZES:
        options = {
            "recipe": "rates",
            "join": join,
            "features": features,
            "hops": hops,
            "hidden": hidden,
            "spike_penalty": penalty or None,
        }
        if system in systems:
            given = {name: value for name, value in options.items() if value is not None}
            yield Candidate(system=system, options=given)


def _joins(steps: int) -> list[int]:
    """Bins that may be joined, so that recordings keep as many steps as these networks need."""
    least, most = STEPS
    return [join for join in JOINS if least <= steps / join <= most] or [1]


def other_ways(candidate: Candidate, steps: int) -> list[Candidate]:
    """The same network in other bins, and with currents that last and clocks.

    >>> few = Candidate(system="mlp", options={"recipe": "rates", "join": 5, "hidden": "32"})
    >>> for each in other_ways(few, 50):
    ...     print(each.name)
    mlp recipe=rates join=1 hidden=32
    mlp recipe=rates join=2 hidden=32
    mlp recipe=timed join=5 hidden=32
    """
    options = candidate.options
    others = [join for join in _joins(steps) if join != options["join"]]
    changes: list[dict[str, Any]] = [*({"join": join} for join in others), {"recipe": "timed"}]
    return [replace(candidate, options={**options, **each}) for each in changes]


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
