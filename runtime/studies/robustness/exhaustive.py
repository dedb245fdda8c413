"""Certificates of recordings: every small change is tried, or shown to be as harmless as one that was."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from itertools import islice

import numpy as np

from spikeloom.compiler.passes.calibrate import evenly_spaced
from spikeloom.compiler.targets.netlist_file import names_of
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.changes import PART, Effects, joined, single
from spikeloom.runtime.studies.robustness.definition import TAXEL, Exhaustive
from spikeloom.runtime.studies.robustness.perturbations import EXHAUSTIVE
from spikeloom.runtime.studies.robustness.proofs.attack import attack
from spikeloom.runtime.studies.robustness.proofs.bounds import PASTS, REACH, Proven, lower_bound, needed
from spikeloom.runtime.studies.robustness.proofs.counting import Tally, least, tally_of
from spikeloom.runtime.studies.robustness.proofs.entries import (
    Cells,
    Events,
    cells_of,
    channels_of,
)
from spikeloom.runtime.studies.robustness.results import (
    PHASES,
    Certificate,
    Certificates,
    Decided,
    Evidence,
)
from spikeloom.runtime.studies.robustness.threads import in_threads

EACH, ANY, NEAR, COUNTS = 1, 2, 3, 4
"""Rules of a certificate: each single event was run; bounds of groups, whatever came before; by what is known of the
group before; what counters make of other numbers of events."""

PROBED = 64
"""Single events whose time tells that of all."""


def expected_seconds(machine: Machine, data: Recordings, jobs: int | None) -> float | None:
    """About how long single events of recordings take if all must be run; None for counters, which need few of them."""
    if tally_of(machine) is not None:
        return None
    longest = int(data.step_counts.argmax())
    events = data.events[longest : longest + 1, ..., : data.steps_of(longest)]
    channels = channels_of(events, machine.netlist)[0]
    cells = cells_of(events[0], machine.netlist).cells
    chosen = cells[evenly_spaced(np.arange(len(cells)), PROBED)]
    machine.effects(channels, single(chosen[:1]))  # which prepares what the first needs
    begun = time.perf_counter()
    machine.effects(channels, single(chosen))
    each = (time.perf_counter() - begun) / len(chosen)
    beside = min(jobs or os.cpu_count() or 1, len(data))
    return each * len(cells) * float(data.step_counts.sum() / data.steps_of(longest)) / beside


def certify(
    machine: Machine, data: Recordings, *, shift: int, most: int, jobs: int | None = None
) -> Certificates:
    """Certificates of recordings in their own bins; `jobs` of them at a time, one a core by default.

    A recording is shifted by at most `shift` bins, a proof is looked for up to `most` changed events. Raises
    DataError for another sensor, NumericRangeError where a register overflows.
    """
    tally = tally_of(machine)
    recordings = [
        (events[..., :length], label, file)
        for events, length, label, file in zip(
            data.events, data.step_counts.tolist(), data.labels.tolist(), data.files, strict=True
        )
    ]
    prove = partial(certificate, machine, shift=shift, most=most, tally=tally)
    certificates = in_threads(prove, recordings, "certifying", jobs)
    netlist = machine.netlist
    return Certificates(
        target=netlist.target,
        taxels=netlist.taxels,
        classes=netlist.classes,
        shift=shift,
        most=most,
        certificates=tuple(certificates),
        class_names=names_of(netlist.provenance, netlist.classes),
    )


def certificate(
    machine: Machine,
    recording: tuple[Events, int, str],
    *,
    shift: int,
    most: int,
    tally: Tally | None,
) -> Certificate:
    """What is known of one recording, (taxels, polarities, bins), its label and its file.

    `tally` is that of a counting network.
    """
    events, label, file = recording
    singles = _flip_each(machine, events, most, tally)
    cells = singles.cells
    kinds = {}
    taxels = {}
    known = {_digest(events): singles.decision}
    for kind in EXHAUSTIVE.values():
        if kind.to == "there":
            kinds[kind.name], taxels[kind.name] = _decide_flips(machine, kind, singles)
        else:
            kinds[kind.name], hanging = _decide_cases(machine, kind, events, shift, singles.decision, known)
            if kind.unit == TAXEL:
                taxels[kind.name] = hanging
    rule, flips, proven = _bounds(machine, singles, most)
    at_least = proven.events
    at_most = int(cells.cost[flips].sum()) or None
    steps = max(int(cells.cells[-1, 1]) + 1, 1)
    phase = cells.cells[singles.altering, 1] * PHASES // steps
    decision, gaps = needed(singles.votes)
    return Certificate(
        file=file,
        label=label,
        decision=decision,
        ahead=int(np.delete(gaps, decision).min(initial=int(singles.votes[decision]))),
        kinds=kinds,
        at_least=at_least,
        at_most=at_most,
        exact=at_most == at_least + 1,
        attack=tuple(cells.words_of(flip, machine.netlist) for flip in flips),
        taxels=taxels,
        phases=tuple(np.bincount(phase, minlength=PHASES).tolist()),
        evidence=Evidence(
            rule=rule,
            unaltered=min(at_least, rule) if rule <= EACH else at_least,
            bins=np.where(cells.there, cells.cost, 0).reshape(steps, -1).T,
            changes=cells.cells[flips],
            pasts=proven.pasts,
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Singles:
    """A recording, and what becomes of it when each of its entries is flipped alone."""

    channels: Events
    votes: IntArray
    cells: Cells
    counted: tuple[int, IntArray | None] | None  # What :func:`least` knows of a counting network
    effects: Effects | None  # None where no group of events alters the decision, so that none was run
    decided: IntArray  # By entry

    @property
    def decision(self) -> int:
        """Of the recording as it is."""
        return int(self.votes.argmax())

    @property
    def altering(self) -> IntArray:
        """Entries of one event that alter the decision; those of several are no single events."""
        return np.flatnonzero((self.decided != self.decision) & (self.cells.cost == 1))


def _flip_each(machine: Machine, events: Events, most: int, tally: Tally | None) -> _Singles:
    """Run a recording with each entry flipped; where entries are known to do the same, one of them."""
    channels = channels_of(events[None], machine.netlist)[0]
    votes = machine.votes(channels[None])[0]
    cells = cells_of(events, machine.netlist)
    decision = int(votes.argmax())
    counted = None if tally is None else least(tally, channels != 0, votes, cells, most)
    effects = None
    by_bounds = _proven(machine, channels, votes, cells, 1) if most == 1 and counted is None else {}
    if ANY in by_bounds and by_bounds[ANY].events == 1:
        decided = np.full(len(cells.cells), decision)
    else:
        alike = np.arange(len(cells.cells))
        if tally is not None and counted is not None:
            alike = 2 * tally.groups(*cells.cells.T) + cells.there
        _, first, those = np.unique(alike, return_index=True, return_inverse=True)
        effects = machine.effects(channels, single(cells.cells[first]))
        decided = (effects.votes + votes).argmax(axis=1)[those]
    return _Singles(
        channels=channels, votes=votes, cells=cells, counted=counted, effects=effects, decided=decided
    )


def _proven(
    machine: Machine, channels: Events, votes: IntArray, cells: Cells, most: int
) -> dict[int, Proven]:
    """Events, up to `most`, that are proven not to alter a decision, by rule; empty for a chip without bounds.

    Of one event it does not ask what is known of the past: that takes longer than to run each.
    """
    steps = int(cells.cells[-1, 1]) + 1
    rules = {ANY: PASTS[:1]} if most == 1 else {ANY: PASTS[:1], NEAR: PASTS}
    groups = machine.groups(channels, steps, int(votes.argmax()), REACH)
    if groups is None:
        return {}
    return {rule: lower_bound(votes, groups, pasts, most) for rule, pasts in rules.items()}


def _decide_flips(machine: Machine, kind: Exhaustive, singles: _Singles) -> tuple[Decided, tuple[int, ...]]:
    """A perturbation of single events, and the taxels on which the decision hangs."""
    cells = singles.cells
    chosen = kind(cells.there)
    tried = int(np.count_nonzero(chosen & (cells.cost == 1)))  # the others change nothing
    altering = singles.altering[chosen[singles.altering]]
    if not len(altering):
        return Decided(tried, 0), ()
    first = altering[0]
    words = cells.words_of(first, machine.netlist)
    taxels = np.unique(cells.cells[altering, 0] // machine.netlist.polarities)
    return Decided(tried, len(altering), words, int(singles.decided[first])), tuple(taxels.tolist())


def _digest(events: Events) -> bytes:
    """What tells changed recordings apart: a taxel without events can die, and a silent bin go, unnoticed."""
    return sha256(events.tobytes()).digest()


def _decide_cases(
    machine: Machine, kind: Exhaustive, events: Events, shift: int, decision: int, known: dict[bytes, int]
) -> tuple[Decided, tuple[int, ...]]:
    """A perturbation of which each case is run once, and the first number of those that alter the decision.

    `known` are decisions of recordings by digest, of all perturbations.
    """
    tried = 0
    altering: list[tuple[tuple[int, ...], int]] = []
    cases = kind.cases(events, shift)
    while part := list(islice(cases, PART)):
        digests = [_digest(each) for _, each in part]
        new = {digest: each for digest, (_, each) in zip(digests, part, strict=True) if digest not in known}
        if new:
            changed = channels_of(np.stack(list(new.values())), machine.netlist)
            known.update(zip(new, machine.votes(changed).argmax(axis=1).tolist(), strict=True))
        tried += len(part)
        decided = [(numbers, known[digest]) for (numbers, _), digest in zip(part, digests, strict=True)]
        altering += [(numbers, to) for numbers, to in decided if to != decision]
    if not altering:
        return Decided(tried, 0), ()
    numbers, to = altering[0]
    size = abs(numbers[0]) if kind.sized else None
    decided_first = Decided(tried, len(altering), kind.words(numbers), to, size)
    return decided_first, tuple(each[0] for each, _ in altering)


def _bounds(machine: Machine, singles: _Singles, most: int) -> tuple[int, IntArray, Proven]:
    """The rule, entries whose flips alter the decision, none if unknown, and how many changed events alter nothing."""
    cells = singles.cells
    flips = singles.altering[:1]
    proven = Proven(1)
    rule = EACH
    if len(flips):
        proven = Proven(0)
        rule = 0
    elif singles.counted is not None:
        at_least, fewest = singles.counted
        proven = Proven(at_least)
        rule = COUNTS
        flips = flips if fewest is None else fewest
    elif singles.effects is None:
        rule = ANY
    else:
        rule, flips, proven = _several(machine, singles, singles.effects, most)
    if len(flips):
        changed = machine.effects(singles.channels, joined([cells.cells[flips]])).votes + singles.votes
        if changed.argmax() == singles.decision:
            flips = flips[:0]
    return rule, flips, proven


def _several(
    machine: Machine, singles: _Singles, effects: Effects, most: int
) -> tuple[int, IntArray, Proven]:
    """The same where no single event alters the decision; only these are known of a chip that has no bounds."""
    by_rule = {} if most == 1 else _proven(machine, singles.channels, singles.votes, singles.cells, most)
    if not by_rule:
        return EACH, np.zeros(0, np.int64), Proven(1)
    rule, proven = max(by_rule.items(), key=lambda each: each[1].events)
    if proven.events < 1:
        rule, proven = EACH, Proven(1)
    return rule, attack(machine, singles.channels, singles.votes, singles.cells, effects), proven


def share_robust_to_one_event(machine: Machine, data: Recordings) -> float:
    """Share of recordings, in their own bins, whose decision no single event alters."""
    tally = tally_of(machine)
    recordings = zip(data.events, data.step_counts.tolist(), strict=True)
    singles = (_flip_each(machine, events[..., :length], 1, tally) for events, length in recordings)
    return sum(not len(each.altering) for each in singles) / len(data)
