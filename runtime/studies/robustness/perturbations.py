"""The one list of perturbations: of recordings, of the state that they find, of what the chip stores.

Those above are drawn by ``stress``, at several levels; of those at the end ``certify`` decides every case. A new
one is a function here, whose parameters :class:`definition.Sampled` or :class:`definition.Exhaustive` names.
All are pure functions. Those of events take and give (recordings, taxels, 2, T) uint8, zeros and ones, in
the recordings' own bins, before a network joins them; clocks are no taxels and not among them.

For one seed a stronger perturbation contains the weaker one wherever that makes sense: five dead taxels are
the three and two more, an event that is lost at a rate of 0.1 is lost at 0.2.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.capabilities import Memory
from spikeloom.runtime.studies.robustness.bench import Bench, in_a_row, in_steps, last_of
from spikeloom.runtime.studies.robustness.definition import (
    BINS,
    TAXEL,
    TAXELS,
    Case,
    Events,
    Exhaustive,
    Sampled,
    exhaustive,
    sampled,
)
from spikeloom.runtime.studies.robustness.pair import Inputs, Pair

COUNTS = (1, 3, 5, 10, 20)
STEPS = (2, 5, 10, 25, 50)
TEMPO = (1.1, 1.25, 1.5, 2, 4)
MOST_STEPS = 100_000

DENSITY = "share of entries with an event"
HIDDEN = "share of hidden neurons"


def random_taxels(events: Events, count: int, rng: np.random.Generator) -> IntArray:
    """Some taxels at random; (count,) int64."""
    return np.asarray(rng.permutation(events.shape[1])[:count])


def neighbours(distance: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """A taxel at random and those nearest to it, it among them; (count,) int64.

    Distances (taxels, taxels) are in any unit; of equal ones the lower number is nearer.
    """
    centre = int(rng.integers(len(distance)))
    order = np.argsort(distance[centre], kind="stable")
    return np.append(centre, order[order != centre])[:count]


@sampled(TAXELS, COUNTS, most=np.inf)
def taxels_dead(events: Events, count: int, rng: np.random.Generator) -> Events:
    """Random taxels send nothing."""
    return set_taxels(events, random_taxels(events, count, rng), 0)


@sampled(TAXELS, COUNTS, most=np.inf)
def taxels_dead_adjacent(
    events: Events, count: int, distance: FloatArray, rng: np.random.Generator
) -> Events:
    """A taxel and its nearest ones send nothing."""
    return set_taxels(events, neighbours(distance, count, rng), 0)


@sampled(TAXELS, COUNTS, most=np.inf)
def taxels_stuck(events: Events, count: int, rng: np.random.Generator) -> Events:
    """Random taxels send both polarities in every step."""
    return set_taxels(events, random_taxels(events, count, rng), 1)


@sampled(TAXELS, COUNTS, most=np.inf)
def taxels_stuck_adjacent(
    events: Events, count: int, distance: FloatArray, rng: np.random.Generator
) -> Events:
    """A taxel and its nearest ones send both polarities in every step."""
    return set_taxels(events, neighbours(distance, count, rng), 1)


def set_taxels(events: Events, taxels: IntArray, value: int) -> Events:
    """Some taxels are dead (0: no events) or stuck (1: an event of either polarity in every step)."""
    changed = events.copy()
    changed[..., taxels, :, :] = value
    return changed


@sampled("probability", (0.1, 0.25, 0.5, 0.75, 0.9))
def events_lost(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each event is lost with a probability."""
    return _one_by_one(events, lambda one: one & (rng.random(one.shape, np.float32) >= share))


@sampled("probability", (0.005, 0.01, 0.02, 0.05, 0.1))
def events_spurious(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each empty entry gets an event with a probability."""
    return _one_by_one(events, lambda one: one | (rng.random(one.shape, np.float32) < share))


def _one_by_one(events: Events, change: Callable[[Events], Events]) -> Events:
    """Change each recording on its own: numbers drawn for all entries of all would fill the memory."""
    changed = np.empty_like(events)
    for one, to in zip(events, changed, strict=True):
        to[...] = change(one)
    return changed


@sampled("steps, standard deviation", (1, 2, 5, 10, 25), most=MOST_STEPS)
def time_jitter(events: Events, sigma: float, rng: np.random.Generator) -> Events:
    """Each event moves by a normal number of steps.

    Not beyond the ends; what meets becomes one event.
    """
    last = events.shape[3] - 1

    def jittered(step: IntArray) -> FloatArray:
        return np.clip(step + np.rint(sigma * rng.standard_normal(len(step))), 0, last)

    return move_events(events, jittered)


@sampled("steps", STEPS, most=MOST_STEPS)
def start_late(events: Events, steps: int) -> Events:
    """The grasp begins later than the recording.

    Silence first, the end is cut off.
    """
    return move_events(events, lambda step: step + steps)


@sampled("steps", STEPS, most=MOST_STEPS)
def start_early(events: Events, steps: int) -> Events:
    """The first steps of the grasp are missing.

    Silence at the end.
    """
    return move_events(events, lambda step: step - steps)


@sampled("times", TEMPO, least=1, most=MOST_STEPS)
def faster(events: Events, times: float) -> Events:
    """The grasp takes place faster."""
    return play(events, times)


@sampled("times", TEMPO, least=1, most=MOST_STEPS)
def slower(events: Events, times: float) -> Events:
    """The grasp takes place more slowly, its end is cut off."""
    return play(events, 1 / times)


def play(events: Events, speed: float) -> Events:
    """Events come at step / speed; those that meet become one, and each stays one event."""
    return move_events(events, lambda step: step / speed)


def move_events(events: Events, to: Callable[[IntArray], FloatArray | IntArray]) -> Events:
    """Events at other steps, fractions cut off; what leaves the recording is lost."""
    sample, taxel, polarity, step = np.nonzero(events)
    there = to(step).astype(np.int64)
    kept = (0 <= there) & (there < events.shape[3])
    changed = np.zeros_like(events)
    changed[sample[kept], taxel[kept], polarity[kept], there[kept]] = 1
    return changed


def not_two_polarities(pair: Pair) -> str | None:
    """Why there is nothing to exchange."""
    count = pair.netlist.polarities
    return None if count == 2 else f"the sensor has {count} polarities"


@sampled("share of taxels", (0.1, 0.25, 0.5, 1), unless=not_two_polarities)
def polarity_swapped(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Random taxels exchange rise and fall."""
    return swap_polarity(events, random_taxels(events, round(share * events.shape[1]), rng))


def swap_polarity(events: Events, taxels: IntArray) -> Events:
    """Some taxels report rise as fall and fall as rise; done twice it is undone."""
    changed = events.copy()
    changed[:, taxels] = events[:, taxels, ::-1]
    return changed


@sampled(DENSITY, (0.1, 0.05, 0.02, 0.005, 0.001))
def near_empty(events: Events, density: float, rng: np.random.Generator) -> Events:
    """Events are taken away down to a density."""
    return _filled(events, density, rng, keep=True)


@sampled(DENSITY, (0.15, 0.2, 0.3, 0.5, 1))
def saturated(events: Events, density: float, rng: np.random.Generator) -> Events:
    """Events are added up to a density."""
    return _filled(events, density, rng, keep=False)


def _filled(events: Events, density: float, rng: np.random.Generator, *, keep: bool) -> Events:
    """Bring recordings to a density: from above if `keep`, else from below; others stay as they are."""
    flat = events.reshape(len(events), -1)
    wanted = int(np.floor(density * flat.shape[1]) if keep else np.ceil(density * flat.shape[1]))

    def filled(before: Events) -> Events:
        # entries that hold an event come first, each kind in random order: the first `wanted` ones hold an
        # event then
        ranked = np.argsort(rng.random(before.shape, np.float32) - before, kind="stable")
        there = int(np.count_nonzero(before))
        changed = np.zeros_like(before)
        changed[ranked[: min(there, wanted) if keep else max(there, wanted)]] = 1
        return changed

    return _one_by_one(flat, filled).reshape(events.shape)


@sampled("recordings before", (1, 2), least=1, most=100)
def warm_state(bench: Bench, before: int, rng: np.random.Generator) -> Inputs:
    """Other recordings run before, without a reset between.

    Clocks start again with each.
    """
    steps, lengths = in_steps(bench.events, bench.lengths, bench.pair.netlist)
    flat = with_clocks(steps, bench.pair.netlist.clocks)
    order = np.stack([rng.permutation(len(flat)) for _ in range(before)] + [np.arange(len(flat))], axis=1)
    return last_of(order, lengths, lambda rows: in_a_row(flat, lengths, order[rows]))


@sampled("times the length", (2, 10), least=1, most=100)
def longer(bench: Bench, rounds: int) -> Inputs:
    """The recording goes round again without a reset; decided on the last round alone.

    Clocks run on and end, as they would.
    """
    steps, lengths = in_steps(bench.events, bench.lengths, bench.pair.netlist)
    order = np.repeat(np.arange(len(steps))[:, None], rounds, axis=1)
    clocks = bench.pair.netlist.clocks
    return last_of(order, lengths, lambda rows: with_clocks(in_a_row(steps, lengths, order[rows]), clocks))


@sampled("probability", (1e-4, 1e-3, 0.01, 0.05))
def weight_bit_flips(memory: Memory, share: float, rng: np.random.Generator) -> Memory:
    """Each stored bit of a weight flips with a probability.

    Of synaptic memory; weights in two's complement.
    """
    code = memory.codes
    bits = memory.widths
    last = np.cumsum(bits)
    total = int(last[-1]) if len(last) else 0
    bit = np.unique(rng.integers(0, max(total, 1), rng.binomial(total, share)))
    synapse = np.searchsorted(last, bit, side="right")
    flips = np.zeros(len(code), np.int64)
    np.bitwise_or.at(flips, synapse, np.int64(1) << (last[synapse] - 1 - bit))
    half = np.int64(1) << (bits - 1)
    flipped = (((code + 2 * half) ^ flips) & (2 * half - 1)) + half
    return memory.with_codes((flipped & (2 * half - 1)) - half)


@sampled(HIDDEN, (0.05, 0.1, 0.25, 0.5))
def neurons_silent(memory: Memory, share: float, rng: np.random.Generator) -> Memory:
    """Random hidden neurons never fire."""
    return memory.with_stuck(_random_hidden(memory, share, rng), firing=False)


@sampled(HIDDEN, (0.005, 0.02, 0.05, 0.1))
def neurons_firing(memory: Memory, share: float, rng: np.random.Generator) -> Memory:
    """Random hidden neurons fire in every step."""
    return memory.with_stuck(_random_hidden(memory, share, rng), firing=True)


def _random_hidden(memory: Memory, share: float, rng: np.random.Generator) -> IntArray:
    """Numbers of a share of the hidden neurons, at random."""
    return rng.permutation(memory.hidden)[: round(share * len(memory.hidden))]


@sampled("standard deviation, share", (0.05, 0.1, 0.2, 0.4))
def threshold_spread(memory: Memory, spread: float, rng: np.random.Generator) -> Memory:
    """Each threshold drifts by a factor of its own.

    Normal around 1, not below a twentieth.
    """
    drift = rng.standard_normal(len(memory.thresholds))
    return scale_thresholds(memory, np.maximum(1 + spread * drift, 0.05))


@sampled("times", (1.05, 1.1, 1.25, 1.5, 2), least=1, most=1000)
def threshold_raised(memory: Memory, factor: float) -> Memory:
    """All thresholds rise: towards a silent network."""
    return scale_thresholds(memory, factor)


@sampled("times", (0.95, 0.9, 0.75, 0.5))
def threshold_lowered(memory: Memory, factor: float) -> Memory:
    """All thresholds fall: towards a saturated network."""
    return scale_thresholds(memory, factor)


def scale_thresholds(memory: Memory, factor: FloatArray | float) -> Memory:
    """Multiply all thresholds by a factor, or each by its own (neurons,); rounded to what registers hold."""
    return memory.with_thresholds(np.rint(memory.thresholds * np.asarray(factor)).astype(np.int64))


@sampled("units", (1, 2), most=1000)
def ties_fire(memory: Memory, units: int) -> Memory:
    """Thresholds fall by register units: at 1, more than every tie fires (>= for >)."""
    return memory.with_thresholds(memory.thresholds - units)


def no_windows(pair: Pair) -> str | None:
    """Why layers cannot be late."""
    return None if pair.memory is None or pair.memory.windows else "its layers have no windows"


@sampled("steps", (1, 2, 5, 25), most=1000, unless=no_windows)
def layers_late(memory: Memory, steps: int) -> Memory:
    """Layers after the first open their windows late, off by one and more.

    They miss the first steps of their input. The float network needs no change: it takes depths from the
    netlist.
    """
    return memory.with_late_layers(steps)


def several_planes(pair: Pair) -> str | None:
    """Why a stored weight has no bits of its own."""
    if pair.memory is None or pair.memory.planes == 1:
        return None
    return "weights are stored in several planes"


@sampled("bits", (6, 5, 4, 3, 2), least=2, most=8, unless=several_planes)
def fewer_bits(memory: Memory, width: int) -> Memory:
    """Weights keep fewer bits on the scale that they have."""
    code = memory.codes
    bits = memory.widths
    factor = np.int64(1) << np.maximum(bits - width, 0)
    most = (np.int64(1) << (np.minimum(bits, width) - 1)) - 1
    return memory.with_codes(np.clip(np.rint(code / factor).astype(np.int64), -most, most) * factor)


@sampled("times the decay", (0.75, 0.5, 0.25, 0))
def shorter_decay(memory: Memory, factor: float) -> Memory:
    """Membranes and lasting currents keep a smaller share."""
    return memory.with_decays(factor)


@exhaustive("events")
def removed(there: BoolArray) -> BoolArray:
    """One event removed."""
    return there


@exhaustive("events")
def added(there: BoolArray) -> BoolArray:
    """One event added."""
    return ~there


@exhaustive(TAXEL)
def dead(events: Events) -> Iterator[Case]:
    """A taxel sends nothing."""
    yield from _each_set(events, 1, 0)


@exhaustive(TAXEL)
def stuck(events: Events) -> Iterator[Case]:
    """A taxel sends both polarities in every bin."""
    yield from _each_set(events, 1, 1)


@exhaustive(TAXELS)
def two_dead(events: Events) -> Iterator[Case]:
    """Two taxels send nothing."""
    yield from _each_set(events, 2, 0)


def _each_set(events: Events, count: int, value: int) -> Iterator[Case]:
    """So many taxels at a time, dead or stuck."""
    for taxels in combinations(range(len(events)), count):
        yield taxels, set_taxels(events, np.array(taxels), value)


@exhaustive(BINS)
def shifted(events: Events, shift: int) -> Iterator[Case]:
    """All events earlier or later."""
    for size in range(1, min(shift, events.shape[-1] - 1) + 1):
        for by in (size, -size):
            yield (by,), move_events(events[None], partial(np.add, by))[0]


@exhaustive(BINS)
def start_cut(events: Events) -> Iterator[Case]:
    """No events in the first bins."""
    for size in range(1, events.shape[-1]):
        changed = events.copy()
        changed[..., :size] = 0
        yield (size,), changed


@exhaustive(BINS)
def end_cut(events: Events) -> Iterator[Case]:
    """No events in the last bins."""
    for size in range(1, events.shape[-1]):
        changed = events.copy()
        changed[..., -size:] = 0
        yield (size,), changed


SAMPLED = {each.name: each for each in list(vars().values()) if isinstance(each, Sampled)}
EXHAUSTIVE = {each.name: each for each in list(vars().values()) if isinstance(each, Exhaustive)}
