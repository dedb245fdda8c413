"""What handing input events to a chip takes: a range of published parts, since nobody published the whole.

A program on a microcontroller takes some cycles for an event or a tick of a clock; a chip's own parts are in its
``chip.toml``: pJ of an event, mW for as long as events may come. The cheapest part alone is the least that a decision
takes, all of them together the most.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.targets.base import POWER_UNIT, Quantity, Target
from spikeloom.compiler.types import EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.microcontroller import EVENT_CYCLES, PRICES
from spikeloom.runtime.report.numbers import si

PROGRAM = "a microcontroller's program"


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """Joules of an inference, mean and extremes, and the parts that they are of."""

    mean: float
    min: float
    max: float
    parts: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Injection:
    """Of so many events and clock ticks a mean inference."""

    events: float
    least: End
    most: End
    prices: Mapping[str, Quantity]  # Of each part: of an event, or power


def input_events(channels: EventArray, lengths: IntArray) -> IntArray:
    """Events and clock ticks of each recording (samples, channels, steps) within its data steps."""
    pairs = zip(channels, lengths.tolist(), strict=True)
    return np.array([np.count_nonzero(each[:, :length]) for each, length in pairs], np.int64)


def injection(target: Target, chips: int, events: IntArray, steps: IntArray, bin_s: float) -> Injection:
    """Price so many events of recordings of so many steps, (samples,), of so many seconds each."""
    cycle = PRICES["cycle"]
    source = f"{EVENT_CYCLES} cycles of {cycle.value:g} pJ an event, {cycle.source}"
    program = replace(cycle, value=EVENT_CYCLES * cycle.value, source=source)
    prices = {PROGRAM: program, **target.injection}
    parts: dict[str, FloatArray] = {}
    for name, price in prices.items():
        if price.unit == POWER_UNIT:
            amount, joules = steps, chips * bin_s * price.value * 1e-3
        else:
            amount, joules = events, price.value * 1e-12
        parts[name] = amount.astype(np.float64) * joules
    least = min(parts, key=lambda name: float(parts[name].sum()))
    return Injection(
        events=float(events.mean()),
        least=_end({least: parts[least]}),
        most=_end(parts),
        prices=prices,
    )


def _end(parts: Mapping[str, FloatArray]) -> End:
    joules = np.sum(list(parts.values()), axis=0)
    mean, low, high = (float(reduce(joules)) for reduce in (np.mean, np.min, np.max))
    return End(mean=mean, min=low, max=high, parts=tuple(parts))


def rows(found: Injection) -> list[list[str]]:
    """Two rows under the energies that they come on top of."""
    ends = {"least": found.least, "most": found.most}
    return [
        [f"events handed in, {name}", *(si(each, "J") for each in (end.mean, end.min, end.max))]
        for name, end in ends.items()
    ]


def line(found: Injection) -> str:
    """Where the range is from."""
    prices = "; ".join(
        f"{name}, {price.value:g} {price.unit} ({price.source})" for name, price in found.prices.items()
    )
    return (
        f"handing in {found.events:,.0f} events and clock ticks, in no energy above: at least "
        f"{found.least.parts[0]}, at most all of: {prices}"
    )
