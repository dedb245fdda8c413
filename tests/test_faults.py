"""Faults on purpose, and whether ``explain`` names them: the confusion table of docs/verify.md."""

import sys
from collections import Counter

import numpy as np
import pytest
from faults import (
    KINDS,
    RELEASED_KINDS,
    Base,
    Injection,
    Machine,
    base_of,
    explain_base,
    inject,
    run_machine,
    small_base,
)

from spikeloom.compiler import Recipe
from spikeloom.compiler.formats.checkpoint import read_checkpoint
from spikeloom.compiler.interpret import channels_last
from spikeloom.models.graphs import build_graph
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.equivalence.suspects import CAUSES, TIE, TRUNCATION

EACH = 20
"""Faults of each kind in small networks."""

EACH_RELEASED = 1
"""The same in the released checkpoint, on released recordings."""


@pytest.fixture(scope="module")
def small() -> dict[bool, list[Base]]:
    """Twenty networks, and twenty whose thresholds are a few units."""
    return {
        coarse: [small_base(np.random.default_rng([int(coarse), i]), coarse=coarse) for i in range(20)]
        for coarse in (False, True)
    }


@pytest.fixture(scope="module")
def released(released_checkpoint, objects_zip) -> list[Base]:
    """The released checkpoint with two planes and with plain 8 bits, neither calibrated."""
    checkpoint, edges = read_checkpoint(released_checkpoint), build_graph("manual").edges
    events = load_data(objects_zip, "test", limit=6)[0].events
    return [
        base_of(checkpoint, edges, Recipe(planes=2, groups=8), events[[3, 0]]),
        base_of(checkpoint, edges, Recipe(), events[[4, 5]]),
    ]


def injections(kind: str, bases: list[Base], count: int) -> list[Injection]:
    """As many faults of a kind as asked for, all different."""
    found: dict[tuple[int, str], Injection] = {}
    for attempt in range(2000):
        place = attempt % len(bases)
        fault = inject(kind, np.random.default_rng([KINDS.index(kind), attempt]), bases[place])
        if fault is not None:
            found.setdefault((place, fault.what), fault)
        if len(found) == count:
            return list(found.values())
    raise AssertionError(f"{kind}: only {len(found)} faults move a spike")


def confusion(faults: list[Injection]) -> dict[str, Counter[str]]:
    """What each kind was named as."""
    table: dict[str, Counter[str]] = {}
    for fault in faults:
        named = explain_base(fault.base, fault.netlist, fault.observed).diagnosis
        table.setdefault(fault.kind, Counter())[str(named)] += 1
    return table


def share_right(faults: list[Injection]) -> float:
    """Share that is named right; writes the confusion table."""
    table = confusion(faults)
    named, total = sum(row[kind] for kind, row in table.items()), sum(row.total() for row in table.values())
    rows = [f"{kind:34} {', '.join(f'{name} {n}' for name, n in row.most_common())}" for kind, row in table.items()]
    sys.stdout.write("\n".join(["", *rows, f"{named} of {total} named right", ""]))
    return named / total


def test_every_cause_can_be_injected():
    assert set(KINDS) == set(CAUSES)


def test_the_copy_of_the_simulator_is_the_simulator_where_nothing_is_wrong(small):
    for base in (*small[False], *small[True]):
        copy = run_machine(base.integer, channels_last(base.events), Machine())
        for ours, theirs in zip(copy.spikes + copy.membranes, base.intact.spikes + base.intact.membranes, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_nothing_is_found_wrong_with_an_intact_chip(small):
    for base in (*small[False], *small[True]):
        assert explain_base(base, base.netlist, base.intact).suspects == ()


def test_faults_in_small_networks_are_named(small):
    faults = [fault for kind in KINDS for fault in injections(kind, small[kind in (TIE, TRUNCATION)], EACH)]
    assert len(faults) >= 200
    assert share_right(faults) >= 0.95


@pytest.mark.recordings
def test_faults_in_the_released_network_are_named(released):
    faults = [fault for kind in RELEASED_KINDS for fault in injections(kind, released, EACH_RELEASED)]
    assert share_right(faults) >= 0.95


@pytest.mark.recordings
def test_nothing_is_found_wrong_with_the_intact_released_network(released):
    for base in released:
        assert explain_base(base, base.netlist, base.intact).suspects == ()
