"""The same decision on a small processor: a linear rule in whole numbers, trained on the same recordings.

A program raises the count of an event's channel; where that reaches a threshold, it adds a row of whole
weights, as wide as the netlist's, to the sums of the classes, of which the largest decides: a counting
network that reads its sums exactly. Thresholds and parts of the recording are chosen by cross-validation in
the training split, the fewest additions that are not shown to be worse than the best.

A decision takes at least its arithmetic and memory accesses, at most the cycles of a simple program on a
microcontroller that one can buy; ``machines/microcontroller.py`` has the prices. In between it sleeps, or idles
with all clocks running.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.errors import DataError
from spikeloom.compiler.targets.base import Quantity
from spikeloom.compiler.types import BoolArray, FloatArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.counters import (
    Plan,
    counter_spikes,
    counters_of,
    cross_validate,
    fit,
    run_counters,
)
from spikeloom.runtime.machines.base import Price
from spikeloom.runtime.machines.microcontroller import ADD_CYCLES, CLOCK_HZ, EVENT_CYCLES, PRICES
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.studies.search.choice import choose, is_worse

PLANS = tuple(product(((1, 4, 16, 64), (1, 2, 4, 8, 16, 32, 64)), (1, 5, 10)))
"""Thresholds and parts that are tried."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Processor:
    """An inference on a small processor: accesses to 64 bits, the model in bytes, joules at least and at most."""

    operations: float
    accesses: float
    size: int
    cycles: float
    least_j: float
    most_j: float


def processor(
    *, adds: float, multiplies: float = 0.0, accesses: Mapping[int, float], cycles: float
) -> Processor:
    """Price an inference; `accesses` are those to 64 bits, by the bytes of a memory, the model's the last."""
    least = adds * PRICES["add"].value + multiplies * PRICES["multiply"].value
    for held, count in accesses.items():
        memory = next((size for size in (8, 32) if held <= size << 10), 1024)
        least += count * PRICES[f"access_{memory}"].value
    return Processor(
        operations=adds + multiplies,
        accesses=sum(accesses.values()),
        size=list(accesses)[-1],
        cycles=cycles,
        least_j=1e-12 * least,
        most_j=1e-12 * cycles * PRICES["cycle"].value,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """Of a mean inference, at least and at most: what events take, static power, and both at the sensor's pace."""

    correct: int
    dynamic_j: tuple[float, float]
    static_w: tuple[float, float]
    pace_j: tuple[float, float]
    events_per_s: float  # At full speed; infinite where nothing says how long events take


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """A netlist and the rule of a processor on the same recordings, of mean `events` and `seconds`.

    `break_even` are the events a second from which on the chip takes less, where every price favours it;
    None where no rate is enough.
    """

    plan: Plan
    counters: int
    cross_validation: float
    samples: int
    events: float
    seconds: float
    work: Processor
    chip: Side
    processor: Side
    break_even: float | None
    verdict: str
    prices: Mapping[str, Quantity] = field(default_factory=PRICES.copy)
    not_priced: tuple[str, ...] = ("on both sides the sensor's interface, and waking up",)


def against_processor(
    training: Recordings, test: Recordings, bits: int, bin_s: float, price: Price, right: BoolArray
) -> Comparison:
    """Train a rule on the training recordings, in their own bins, and hold a netlist against it.

    The netlist's weights have so many `bits`; `price` and `right` (samples,) are of its run of the `test`
    recordings.
    """
    chosen = _rule(training, bits)
    rule = chosen.counters
    plan = chosen.plan
    spikes = counter_spikes(rule, run_counters(test, plan, rule.steps)).astype(np.int64)
    ours = (spikes @ rule.weight.T).argmax(axis=1) == test.labels
    events = float(test.events.sum()) / len(test)
    if not events:
        raise DataError(
            f"{test.source}: no events, so no rate of them to compare at; give recordings with some"
        )
    seconds = float(test.step_counts.mean()) * bin_s
    channels = rule.taxels * rule.polarities
    added = float(spikes.sum()) / len(test) * rule.classes
    work = processor(
        adds=2 * events + added + rule.classes,
        # of a sum 32 bits, there and back
        accesses={
            2 * channels: 3 * events + added,
            len(rule.counter) * rule.classes * bits // 8: added * bits / 64,
        },
        cycles=EVENT_CYCLES * events + ADD_CYCLES * (added + rule.classes),
    )

    def side(
        correct: BoolArray, dynamic: Iterable[float], static: Iterable[float], fastest_s: float
    ) -> Side:
        joules, watts = ((min(each), max(each)) for each in map(list, (dynamic, static)))
        low, high = (each + power * seconds for each, power in zip(joules, watts, strict=True))
        speed = events / fastest_s if fastest_s else math.inf
        count = int(correct.sum())
        return Side(correct=count, dynamic_j=joules, static_w=watts, pace_j=(low, high), events_per_s=speed)

    fastest = next((float(each.mean()) for each in price.time_s.values()), 0.0)
    chip = side(
        right, (float(each.mean()) for each in price.dynamic_j.values()), price.static_w.values(), fastest
    )
    static = (1e-3 * PRICES[name].value for name in ("asleep", "idle"))
    small = side(ours, (work.least_j, work.most_j), static, work.cycles / CLOCK_HZ)
    gain = (small.dynamic_j[1] - chip.dynamic_j[0]) / events
    return Comparison(
        plan=plan,
        counters=len(rule.counter),
        cross_validation=float(chosen.right.mean()),
        samples=len(test),
        events=events,
        seconds=seconds,
        work=work,
        chip=chip,
        processor=small,
        break_even=max(0.0, chip.static_w[0] - small.static_w[1]) / gain if gain > 0 else None,
        verdict=_verdict(chip, small),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rule:
    """A rule, its plan, which recordings it decides rightly in cross-validation, and its spikes."""

    counters: Counters
    plan: Plan
    right: FloatArray
    spikes: int

    @property
    def values(self) -> dict[str, float]:
        return {"energy": self.spikes, "accuracy": float(self.right.mean())}


def _rule(training: Recordings, bits: int) -> _Rule:
    """The cheapest rule that is not shown to be worse than the best."""
    classes = int(training.labels.max()) + 1
    rules = []
    progress = Progress(len(PLANS))
    for done, (thresholds, most) in enumerate(PLANS):
        progress(done, "training rules for a processor")
        parts = min(most, training.steps)
        if (parts - 1) * -(-training.steps // parts) >= training.steps:
            continue  # the last part would have no step
        plan = Plan(thresholds=thresholds, parts=parts, bits=bits)
        data = run_counters(training, plan)
        fitted = fit(data, classes)
        right = cross_validate(data, classes)[fitted.strength].argmax(axis=1) == data.labels
        counters = counters_of(data, fitted, training, classes)
        spikes = int(counter_spikes(counters, data).sum(dtype=np.int64))
        rules.append(_Rule(counters=counters, plan=plan, right=right.astype(float), spikes=spikes))
    close = choose(
        rules, lambda rule: rule.values, lambda best, other: is_worse(best.right, other.right)
    ).allowed
    return min(close, key=lambda rule: rule.spikes)


def _verdict(chip: Side, small: Side) -> str:
    """Who takes less at the sensor's pace."""
    if small.pace_j[1] < chip.pace_j[0]:
        least = chip.pace_j[0] / small.pace_j[1]
        most = chip.pace_j[1] / small.pace_j[0]
        return f"a microcontroller is cheaper at the sensor's pace: {least:,.0f} to {most:,.0f} times"
    if chip.pace_j[1] < small.pace_j[0]:
        return "the chip is cheaper than a microcontroller at the sensor's pace"
    return "whether the chip or a microcontroller is cheaper at the sensor's pace depends on the prices"


def sections(found: Comparison) -> Iterator[Section]:
    """The comparison for people."""
    plan = found.plan
    work = found.work
    about = (
        f"on a processor: {found.counters} counters of {', '.join(map(str, plan.thresholds))} events in "
        f"{plan.parts} parts, {plan.bits}-bit weights; {work.operations:,.0f} operations, "
        f"{work.accesses:,.0f} memory accesses, {work.cycles:,.0f} cycles"
    )
    rows = []
    for name, side in (("chip", found.chip), ("processor", found.processor)):
        ends = ((side.dynamic_j, "J"), (side.static_w, "W"), (side.pace_j, "J"))
        cells = [f"{si(low, unit)} … {si(high, unit)}" for (low, high), unit in ends]
        rows.append([name, percent(side.correct, found.samples), *cells])
    table = Table(
        ["", "right", "dynamic energy", "static power", f"a decision in {found.seconds:.3g} s"], rows
    )
    even = "break-even: at no event rate, an event takes more on the chip by any price"
    if found.break_even is not None:
        fastest = min(found.chip.events_per_s, found.processor.events_per_s)
        even = f"break-even: {found.break_even:,.0f} events/s where every price favours the chip, the sensor has "
        even += f"{found.events / found.seconds:,.0f}"
        even += f", more than the {fastest:,.0f} that both can take" if found.break_even > fastest else ""
    lines = [found.verdict, even, *(f"not priced: {line}" for line in found.not_priced)]
    yield Section("Against a processor", [Text(about), table, Text("\n".join(lines)), price_table()])


def price_table() -> Table:
    """What a processor's events and its standing cost, each with its source."""
    rows = [[name, f"{each.value:g} {each.unit}", each.source] for name, each in PRICES.items()]
    return Table(["of a processor", "price", "source"], rows, words=True)
