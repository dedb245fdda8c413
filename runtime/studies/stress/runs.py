"""One perturbation at one level: what both sides hear, and what is counted of it.

Both sides run on all seeds at once where only recordings differ. Where recordings follow each other without a reset,
only the last one counts.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.models.recordings.events import join_bins
from spikeloom.runtime.equivalence.breakdowns import undecided
from spikeloom.runtime.studies.stress.battery import NAMES
from spikeloom.runtime.studies.stress.damages import Pair
from spikeloom.runtime.studies.stress.disturbances import Events
from spikeloom.runtime.studies.stress.perturbation import Level, Sensor
from spikeloom.runtime.studies.stress.side_by_side import SIDES, Inputs, Outcome, Ready, evaluate, ready

Json = dict[str, Any]


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
        In the bins of the recordings, which are disturbed before a network joins them.
    labels : (recordings,) int64
    files : tuple of str
    lengths : (recordings,) int64
        Bins of each.
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

    def heard(self) -> tuple[Events, IntArray]:
        """Recordings in steps of the network, and how many steps each has."""
        bins = self.pair.netlist.bins
        return join_bins(self.events, bins), -(-self.lengths // bins)


def generator(name: str, seed: int) -> np.random.Generator:
    """Source of a perturbation's chance: the same for all levels, so that a harsher one contains a milder one."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def whole(events: Events, netlist: Netlist, lengths: IntArray) -> Inputs:
    """Recordings from their first bin on."""
    joined = with_clocks(join_bins(events, netlist.bins), netlist.clocks)
    return Inputs(events=joined, lengths=-(-lengths // netlist.bins), begin=np.zeros_like(lengths))


def by_length(events: Events, lengths: IntArray, change: Callable[[Events], Events]) -> Events:
    """Disturb recordings of equal length together, none beyond its own."""
    found = np.zeros_like(events)
    for length in np.unique(lengths).tolist():
        own = np.flatnonzero(lengths == length)
        found[own, ..., :length] = change(events[own, ..., :length])
    return found


def after_others(bench: Bench, before: int, rng: np.random.Generator) -> Inputs:
    """Each recording after some others; clocks start again with each."""
    heard, lengths = bench.heard()
    flat = with_clocks(heard, bench.pair.netlist.clocks)
    order = np.stack([rng.permutation(len(flat)) for _ in range(before)] + [np.arange(len(flat))], axis=1)
    length = lengths[order].sum(axis=1)
    events = np.zeros((len(flat), flat.shape[1], int(length.max())), np.uint8)
    for i, parts in enumerate(order.tolist()):
        one = np.concatenate([flat[part, :, : lengths[part]] for part in parts], axis=1)
        events[i, :, : one.shape[1]] = one
    return Inputs(events=events, lengths=length, begin=length - lengths)


def going_round(bench: Bench, rounds: int) -> Inputs:
    """Each recording again and again; clocks run on and end, as they would."""
    heard, lengths = bench.heard()
    events = np.zeros((*heard.shape[:3], heard.shape[3] * rounds), np.uint8)
    for i, length in enumerate(lengths.tolist()):
        events[i, ..., : length * rounds] = np.tile(heard[i, ..., :length], rounds)
    begin = lengths * (rounds - 1)
    return Inputs(events=with_clocks(events, bench.pair.netlist.clocks), lengths=lengths * rounds, begin=begin)


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
