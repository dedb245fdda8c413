"""Verdicts of recordings: every small change is tried, or shown to be as harmless as one that was."""

from __future__ import annotations

import os
from collections import Counter
from itertools import islice
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.changes import PART, joined, single
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.studies.stability.attack import attack
from spikeloom.runtime.studies.stability.bounds import lower_bound, needed
from spikeloom.runtime.studies.stability.counting import Tally, least, tally_of
from spikeloom.runtime.studies.stability.neighbours import (
    KINDS,
    SIZED,
    Events,
    Failure,
    cells_of,
    channels_of,
    failures,
    words_of,
)
from spikeloom.runtime.studies.stability.results import PHASES, Found, Stability, Verdict

SHIFT = 25
"""Bins that a recording is shifted by at most."""

MOST = 16
"""Changed events up to which a proof is looked for."""


def stability(
    machine: Machine, data: Recordings, *, shift: int = SHIFT, most: int = MOST, jobs: int | None = None
) -> Stability:
    """Verdicts of recordings in their own bins; `jobs` of them at a time, one a core by default.

    Raises DataError for another sensor, NumericRangeError where a register overflows.
    """
    machine.require_sensor(data.events)
    tally = tally_of(machine)
    work = Parallel(jobs or os.cpu_count(), backend="threading", return_as="generator")
    lengths, verdicts, progress = data.step_counts.tolist(), [], Progress(len(data))
    each = (
        delayed(verdict)(machine, events[..., :length], label, file, shift=shift, most=most, tally=tally)
        for events, length, label, file in zip(data.events, lengths, data.labels.tolist(), data.files, strict=True)
    )
    progress(0, "certifying")
    for done, found in enumerate(work(each), 1):
        verdicts.append(found)
        progress(done, "certifying")
    netlist = machine.netlist
    return Stability(
        target=netlist.target,
        taxels=netlist.taxels,
        classes=netlist.classes,
        shift=shift,
        most=most,
        verdicts=tuple(verdicts),
    )


def verdict(
    machine: Machine, events: Events, label: int, file: str, *, shift: int, most: int, tally: Tally | None = None
) -> Verdict:
    """What is known of one recording (taxels, polarities, bins); `tally` is that of a counting network."""
    netlist = machine.netlist
    channels, votes, cells, counted, effects, decided = _singly(machine, events, most, tally)
    decision, gaps = needed(votes)
    altering = (decided != decision) & (cells.cost == 1)
    kinds, taxels = _failures(machine, events, decision, shift)
    for kind, there in (("removed", True), ("added", False)):
        tried = (cells.there == there) & (cells.cost == 1)  # the others change nothing
        hits = np.flatnonzero(tried & altering)
        first, to = None, None
        if len(hits):
            first, to = words_of(cells.cells[hits[0]], there, netlist), int(decided[hits[0]])
        kinds[kind] = Found(int(tried.sum()), len(hits), first, to)
        taxels[kind] = tuple(np.unique(cells.cells[hits, 0] // netlist.polarities).tolist())
    taken = np.flatnonzero(altering)[:1]
    at_least = 1 - len(taken)
    if not len(taken) and counted is not None:
        at_least, found = counted
        taken = taken if found is None else found
    elif not len(taken) and (known := machine.forgetting(channels)) is not None:
        at_least = max(1, lower_bound(votes, cells, effects, known, most))
        taken = attack(machine, channels, votes, cells, effects)
    if len(taken) and (machine.effects(channels, joined([cells.cells[taken]])).votes + votes).argmax() == decision:
        taken = taken[:0]
    at_most = int(cells.cost[taken].sum()) or None
    phase = cells.cells[altering, 1] * PHASES // max(int(cells.cells[-1, 1]) + 1, 1)
    return Verdict(
        file=file,
        label=label,
        decision=decision,
        ahead=int(np.delete(gaps, decision).min(initial=int(votes[decision]))),
        kinds={kind: kinds[kind] for kind in KINDS},
        at_least=at_least,
        at_most=at_most,
        exact=at_most == at_least + 1,
        attack=tuple(words_of(cells.cells[each], bool(cells.there[each]), netlist) for each in taken),
        taxels=taxels,
        phases=tuple(np.bincount(phase, minlength=PHASES).tolist()),
    )


def _singly(machine: Machine, events: Events, most: int, tally: Tally | None) -> tuple[Any, ...]:
    """Channels, votes and entries of a recording, what :func:`least` knows of it; effects, and decisions by entry."""
    channels = channels_of(events[None], machine.netlist)[0]
    votes, cells = machine.votes(channels[None])[0], cells_of(events, machine.netlist)
    counted, alike = None, np.arange(len(cells.cells))
    if tally is not None and (counted := least(tally, channels != 0, votes, cells, most)) is not None:
        alike = 2 * tally.groups(*cells.cells.T) + cells.there
    _, first, those = np.unique(alike, return_index=True, return_inverse=True)
    effects = machine.effects(channels, single(cells.cells[first]))
    return channels, votes, cells, counted, effects, (effects.votes + votes).argmax(axis=1)[those]


def share_robust_to_one_event(machine: Machine, data: Recordings) -> float:
    """Share of recordings, in their own bins, whose decision no single event alters."""
    found, tally = 0, tally_of(machine)
    for events, length in zip(data.events, data.step_counts.tolist(), strict=True):
        _, votes, cells, *_, decided = _singly(machine, events[..., :length], 1, tally)
        found += not np.any((decided != votes.argmax()) & (cells.cost == 1))
    return found / len(data)


def _failures(
    machine: Machine, events: Events, decision: int, shift: int
) -> tuple[dict[str, Found], dict[str, tuple[int, ...]]]:
    """Run all changes that are no single events: what is said of each kind, and taxels of single failures."""
    tried: Counter[str] = Counter()
    alter: dict[str, list[tuple[Failure, int]]] = {kind: [] for kind in KINDS}
    changes = failures(events, shift)
    while part := list(islice(changes, PART)):
        changed = channels_of(np.stack([each.events for each in part]), machine.netlist)
        decided = machine.votes(changed).argmax(axis=1).tolist()
        tried.update(each.kind for each in part)
        for each, to in zip(part, decided, strict=True):
            if to != decision:
                alter[each.kind].append((each, to))
    found, taxels = {}, {}
    for kind, altering in alter.items():
        first, to = altering[0] if altering else (None, None)
        size = None if first is None or kind not in SIZED else abs(first.numbers[0])
        found[kind] = Found(tried[kind], len(altering), None if first is None else first.words, to, size)
        if kind in ("dead", "stuck"):
            taxels[kind] = tuple(each.numbers[0] for each, _ in altering)
    return found, taxels
