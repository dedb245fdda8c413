"""One perturbation at one level: float network and chip on the same disturbed recordings, counted and compared.

Both sides run on all seeds at once where only recordings differ. What is counted is what spikes after `begin`: where
recordings follow each other without a reset, only the last one is looked at.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from compiler.dynamics import with_clocks
from compiler.errors import NumericRangeError
from compiler.fixedpoint import IntArray
from compiler.interpret import vote
from compiler.netlist import Netlist
from runtime import engine, float_engine
from runtime.battery import NAMES
from runtime.breakdowns import undecided
from runtime.damages import Pair
from runtime.disturbances import Events
from runtime.perturbation import Level, Sensor

Json = dict[str, Any]
Words = npt.NDArray[np.uint64]

SIDES = ("float", "chip")

STOPPED = -1
"""Decision where a register of the chip overflows and the simulator stops."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ready:
    """A pair, prepared to run.

    Parameters
    ----------
    chip : Engine
    model : FloatEngine
    masks : (layers, words) uint64
        Bits of each layer's compartments in ``Trace.packed``.
    voters, label : (voters,) int64
        Compartments that vote, and for which class.
    """

    chip: engine.Engine
    model: float_engine.FloatEngine
    masks: Words
    voters: IntArray
    label: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """What is stressed, and on what.

    Parameters
    ----------
    pair : Pair
        As compiled.
    ready : Ready
        The same, prepared.
    sensor : Sensor
    events : (recordings, taxels, polarities, T) uint8
    labels : (recordings,) int64
    files : tuple of str
    lengths : (recordings,) int64
        Steps of each.
    threads : int
        Recordings that run at a time.
    """

    pair: Pair
    ready: Ready
    sensor: Sensor
    events: Events
    labels: IntArray
    files: tuple[str, ...]
    lengths: IntArray
    threads: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inputs:
    """Recordings as channels of a network.

    Parameters
    ----------
    events : (recordings, channels, T) uint8
    lengths, begin : (recordings,) int64
        Steps of each, and the first that counts.
    """

    events: npt.NDArray[np.uint8]
    lengths: IntArray
    begin: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """What both sides did.

    Parameters
    ----------
    votes : dict of str to (recordings, classes) int64
        By side.
    spikes : (recordings, layers, 3) int64
        Of the float network, of the chip, and those in which they differ.
    stopped : (recordings,) bool
        Where a register of the chip would overflow.
    saturated : (recordings,) int64
        Membranes that were clipped.
    """

    votes: dict[str, IntArray]
    spikes: IntArray
    stopped: npt.NDArray[np.bool_]
    saturated: IntArray

    def decisions(self, side: str) -> IntArray:
        """Class of each recording."""
        found = vote(self.votes[side])
        return np.where(self.stopped, STOPPED, found) if side == "chip" else found


def ready(pair: Pair) -> Ready:
    """Prepare a pair for runs."""
    netlist = pair.netlist
    masks = np.zeros((len(netlist.layers), -(-netlist.n_compartments // 64)), np.uint64)
    seat = np.arange(netlist.n_compartments)
    np.bitwise_or.at(masks, (netlist.layer, seat // 64), np.left_shift(np.uint64(1), (seat % 64).astype(np.uint64)))
    voters = np.flatnonzero(netlist.readout_class >= 0)
    return Ready(
        chip=engine.prepare(netlist),
        model=float_engine.prepare(pair.network, netlist),
        masks=masks,
        voters=voters,
        label=netlist.readout_class[voters],
    )


def evaluate(prepared: Ready, inputs: Inputs, *, threads: int = 1) -> Outcome:
    """Run both sides from rest."""
    netlist = prepared.chip.netlist
    model = float_engine.run(prepared.model, inputs.events, lengths=inputs.lengths, begin=inputs.begin, threads=threads)
    packed, stopped, saturated = _chip(prepared.chip, inputs, threads)
    spikes = np.zeros((len(inputs.events), len(netlist.layers), 3), np.int64)
    votes = np.zeros((len(inputs.events), netlist.classes), np.int64)
    depth = np.array([layer.depth for layer in netlist.layers])
    _tally(
        packed,
        model.packed,
        prepared.masks,
        depth,
        inputs.begin,
        inputs.lengths,
        prepared.voters,
        depth[netlist.layer[prepared.voters]],
        prepared.label,
        spikes,
        votes,
    )
    spikes[:, :, 0] = model.spikes
    spikes[:, :, 2] += model.elsewhere
    return Outcome(votes={"float": model.votes, "chip": votes}, spikes=spikes, stopped=stopped, saturated=saturated)


def _chip(prepared: engine.Engine, inputs: Inputs, threads: int) -> tuple[Words, npt.NDArray[np.bool_], IntArray]:
    """Packed spikes, which recordings stopped the simulator, and clipped membranes."""

    def simulate(part: slice) -> tuple[Words, IntArray]:
        trace = engine.simulate(
            prepared, inputs.events[part], lengths=inputs.lengths[part], packed=True, threads=threads
        )
        assert trace.packed is not None, "spikes were asked for"
        return trace.packed, trace.counts.saturations.sum(axis=1)

    stopped = np.zeros(len(inputs.events), np.bool_)
    try:
        packed, saturated = simulate(slice(None))
    except NumericRangeError:  # by one recording at least: run them one by one
        steps = inputs.events.shape[2] + prepared.drain
        packed = np.zeros((len(inputs.events), steps, -(-prepared.netlist.n_compartments // 64)), np.uint64)
        saturated = np.zeros(len(inputs.events), np.int64)
        for index in range(len(inputs.events)):
            try:
                packed[index : index + 1], saturated[index : index + 1] = simulate(slice(index, index + 1))
            except NumericRangeError:
                stopped[index] = True
    return packed, stopped, saturated


@numba.njit(cache=True, nogil=True)
def _ones(word: Any) -> Any:
    """Bits of a word that are set."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@numba.njit(cache=True, nogil=True)
def _tally(
    chip: Any,
    model: Any,
    masks: Any,
    depth: Any,
    begin: Any,
    end: Any,
    voters: Any,
    lag: Any,
    label: Any,
    spikes: Any,
    votes: Any,
) -> None:
    """Count spikes of the chip and those that differ, (recordings, layers, 3), and its votes, where steps count."""
    for i in range(len(chip)):
        for layer in range(len(masks)):
            for word in range(masks.shape[1]):
                mask = masks[layer, word]
                if mask:
                    for t in range(begin[i] + depth[layer], end[i] + depth[layer]):
                        spikes[i, layer, 1] += _ones(chip[i, t, word] & mask)
                        spikes[i, layer, 2] += _ones((chip[i, t, word] ^ model[i, t, word]) & mask)
        for v in range(len(voters)):
            word, bit = voters[v] >> 6, np.uint64(voters[v] & 63)
            for t in range(begin[i] + lag[v], end[i] + lag[v]):
                votes[i, label[v]] += np.int64((chip[i, t, word] >> bit) & np.uint64(1))


# -- what happens to recordings ----------------------------------------------------------------------------------------


def generator(name: str, seed: int) -> np.random.Generator:
    """Source of a perturbation's chance: the same for all levels, so that a harsher one contains a milder one."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def whole(events: Events, netlist: Netlist, lengths: IntArray) -> Inputs:
    """Recordings from their first step on."""
    return Inputs(events=with_clocks(events, netlist.clocks), lengths=lengths, begin=np.zeros_like(lengths))


def by_length(events: Events, lengths: IntArray, change: Callable[[Events], Events]) -> Events:
    """Disturb recordings of equal length together, none beyond its own."""
    found = np.zeros_like(events)
    for length in np.unique(lengths).tolist():
        own = np.flatnonzero(lengths == length)
        found[own, ..., :length] = change(events[own, ..., :length])
    return found


def after_others(bench: Bench, before: int, rng: np.random.Generator) -> Inputs:
    """Each recording after some others; clocks start again with each."""
    flat = with_clocks(bench.events, bench.pair.netlist.clocks)
    order = np.stack([rng.permutation(len(flat)) for _ in range(before)] + [np.arange(len(flat))], axis=1)
    length = bench.lengths[order].sum(axis=1)
    events = np.zeros((len(flat), flat.shape[1], int(length.max())), np.uint8)
    for i, parts in enumerate(order.tolist()):
        one = np.concatenate([flat[part, :, : bench.lengths[part]] for part in parts], axis=1)
        events[i, :, : one.shape[1]] = one
    return Inputs(events=events, lengths=length, begin=length - bench.lengths)


def going_round(bench: Bench, rounds: int) -> Inputs:
    """Each recording again and again; clocks run on and end, as they would."""
    events = np.zeros((*bench.events.shape[:3], bench.events.shape[3] * rounds), np.uint8)
    for i, length in enumerate(bench.lengths.tolist()):
        events[i, ..., : length * rounds] = np.tile(bench.events[i, ..., :length], rounds)
    lengths = bench.lengths * rounds
    return Inputs(events=with_clocks(events, bench.pair.netlist.clocks), lengths=lengths, begin=lengths - bench.lengths)


# -- one point ---------------------------------------------------------------------------------------------------------


def clean(bench: Bench) -> tuple[Outcome, Json]:
    """Nothing is wrong."""
    inputs = whole(bench.events, bench.pair.netlist, bench.lengths)
    found = evaluate(bench.ready, inputs, threads=bench.threads)
    return found, _run(bench, found, None, slice(None), inputs, found)


def measure(bench: Bench, name: str, level: Level, seeds: Sequence[int], reference: Outcome) -> list[Json]:
    """One perturbation at one level, once for each seed.

    Parameters
    ----------
    bench : Bench
    name : str
        A key of ``NAMES``.
    level : float or str
    seeds : sequence of int
        One for what has no part in chance.
    reference : Outcome
        Of the clean recordings.

    Returns
    -------
    list of dict
        For each seed: ``right`` by side, ``equal`` decisions, ``layers`` (spikes of float, of chip, different ones,
        entries), ``signs`` of breakdowns by side, ``most`` decided class and how often, ``stopped``, ``saturated``.
    """
    known, count = NAMES[name], len(bench.events)
    if known.damage is not None:
        runs = []
        for seed in seeds:
            damaged = known.damage(bench.pair, level, bench.sensor, generator(name, seed))
            inputs = whole(bench.events, damaged.netlist, bench.lengths)
            found = evaluate(ready(damaged), inputs, threads=bench.threads)
            runs.append(_run(bench, found, seed, slice(None), inputs, reference))
        return runs
    many = [_inputs(bench, name, level, generator(name, seed)) for seed in seeds]
    longest = max(inputs.events.shape[2] for inputs in many)
    inputs = Inputs(
        events=np.concatenate([_filled_up(inputs.events, longest) for inputs in many]),
        lengths=np.concatenate([inputs.lengths for inputs in many]),
        begin=np.concatenate([inputs.begin for inputs in many]),
    )
    found = evaluate(bench.ready, inputs, threads=bench.threads)
    return [
        _run(bench, found, seed, slice(i * count, (i + 1) * count), inputs, reference) for i, seed in enumerate(seeds)
    ]


def _inputs(bench: Bench, name: str, level: Level, rng: np.random.Generator) -> Inputs:
    """What both sides hear."""
    disturb = NAMES[name].disturb
    if disturb is not None:
        events = by_length(bench.events, bench.lengths, lambda part: disturb(part, float(level), bench.sensor, rng))
        return whole(events, bench.pair.netlist, bench.lengths)
    if name == "warm_state":
        return after_others(bench, int(level), rng)
    return going_round(bench, int(level))


def _filled_up(events: npt.NDArray[np.uint8], steps: int) -> npt.NDArray[np.uint8]:
    return np.pad(events, ((0, 0), (0, 0), (0, steps - events.shape[2])))


def _run(bench: Bench, found: Outcome, seed: int | None, part: slice, inputs: Inputs, reference: Outcome) -> Json:
    """Counts over the recordings of one seed."""
    netlist = bench.pair.netlist
    decided = {side: found.decisions(side)[part] for side in SIDES}
    spikes = found.spikes[part].sum(axis=0).tolist()
    steps = int((inputs.lengths - inputs.begin)[part].sum())
    held = np.bincount(netlist.layer, minlength=len(netlist.layers)).tolist()
    most = {side: np.unique_counts(values) for side, values in decided.items()}
    return {
        "seed": seed,
        "right": {side: int(np.count_nonzero(values == bench.labels)) for side, values in decided.items()},
        "equal": int(np.count_nonzero(decided["float"] == decided["chip"])),
        "layers": {
            layer.name: [*counts, neurons * steps]
            for layer, counts, neurons in zip(netlist.layers, spikes, held, strict=True)
        },
        "signs": {
            side: {
                sign.kind: sign.count for sign in undecided(reference.votes[side], found.votes[side][part], bench.files)
            }
            for side in SIDES
        },
        "most": {
            side: [int(kinds.values[np.argmax(kinds.counts)]), int(kinds.counts.max())] for side, kinds in most.items()
        },
        "stopped": int(np.count_nonzero(found.stopped[part])),
        "saturated": int(found.saturated[part].sum()),
    }
