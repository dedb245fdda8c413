"""What ``certify`` proves of counting networks on crossbar cores holds for every change; planted errors do not."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from made_files import sparse_events
from numpy.testing import assert_array_equal
from random_crossbars import counter_events, random_counters, random_network, without_idle

from spikeloom.compiler.counters import BLOCK
from spikeloom.compiler.targets.compartments import MEMBRANE_SHIFT
from spikeloom.compiler.targets.truenorth.counting import planned
from spikeloom.compiler.targets.truenorth.passes import compile_crossbars
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.studies.robustness.exhaustive import COUNTS, certificate
from spikeloom.runtime.studies.robustness.proofs import counting
from spikeloom.runtime.studies.robustness.proofs.counting import least, tally_of
from spikeloom.runtime.studies.robustness.proofs.entries import cells_of, channels_of

MOST = 3


def counters_for(seed, **sizes):
    """A counting network all of whose counters have a weight, and a ramp that every class crosses."""
    return without_idle(random_counters(seed, **{"ramp": 60, **sizes}))


def lower(counters, share, slope):
    """The same with another ramp, and a threshold that some share of what is above zero crosses before the data end."""
    most = int(share * counters.weight.clip(min=0).sum(axis=1).max())
    return replace(counters, slope=slope, threshold=slope * counters.steps + most + 0.5)


def broken(machine, one):
    """Fewest events that alter the decision of a recording, of all changes of up to ``MOST``; else one more."""
    cells = cells_of(one, machine.netlist)
    channels = channels_of(one[None], machine.netlist)[0]
    decision = machine.votes(channels[None])[0].argmax()
    for events in range(1, MOST + 1):
        every = np.array(list(combinations(range(len(cells.cells)), events)))
        runs = np.repeat(channels[None], len(every), axis=0)
        for change in every.T:
            channel, step = cells.cells[change].T
            runs[np.arange(len(every)), channel, step] ^= 1
        if np.any(machine.votes(runs).argmax(axis=1) != decision):
            return events
    return MOST + 1


def proven(machine, one, change=lambda tally, _: tally):
    """Events that are proven to alter nothing, up to ``MOST``; None if nothing is known.

    `change` gives another tally, for one and the events of its counters.
    """
    channels = channels_of(one[None], machine.netlist)[0]
    tally = tally_of(machine)
    tally = change(tally, tally.events(channels)[-1, tally.group])
    votes = machine.votes(channels[None])[0]
    known = least(tally, channels != 0, votes, cells_of(one, machine.netlist), MOST)
    return None if known is None else known[0]


@pytest.fixture(scope="module")
def tried():
    """Machines, recordings of them, and the fewest events that alter each decision, all tried."""
    cases = []
    for seed, share in [*((seed, 1) for seed in range(5)), (0, 0.6), (14, 0.4), (40, 0.6)]:
        counters = counters_for(seed, taxels=2, steps=7, parts=1 + seed % 2)
        machine = machine_of(compile_crossbars(lower(counters, share, 1.0 + seed % 3)).netlist)
        recordings = sparse_events(seed, 3, 2, 2, 7, rate=0.3)
        cases += [(share, machine, one, broken(machine, one)) for one in recordings]
    return cases


def test_no_change_of_so_many_events_alters_what_is_proven_and_one_more_does(tried):
    sizes = set()
    for share, machine, one, fewest in tried:
        events = proven(machine, one)
        sizes.add(events)
        if events is None:
            assert share < 1
            continue
        assert events < fewest
        assert share < 1 or events == fewest - 1
        whole = certificate(machine, (one, 0, ""), shift=0, most=MOST, tally=tally_of(machine))
        assert whole.at_least == events
        assert whole.evidence.rule == (COUNTS if events else 0)
    assert sizes == {0, 1, 2, 3, None}


def test_planted_errors_are_caught(tried, monkeypatch):
    def caught(change=lambda tally, _: tally):
        bounds = [(proven(machine, one, change), fewest) for _, machine, one, fewest in tried]
        return any(events is not None and events >= fewest for events, fewest in bounds)

    def silent(tally, seen):
        return tally.times(slice(None), seen) == 0

    assert not caught()
    assert caught(lambda tally, seen: replace(tally, count=tally.count + silent(tally, seen)))
    assert caught(lambda tally, seen: replace(tally, weight=tally.weight * ~silent(tally, seen)))
    monkeypatch.setattr(counting, "_early", lambda *_: MOST + 1)
    assert caught()


def test_before_the_data_end_sums_are_within_what_comes_above_zero_later_and_below_before():
    counters = counters_for(3, steps=40)
    machine = machine_of(compile_crossbars(counters).netlist)
    tally = tally_of(machine)
    first = planned(counters, machine.target).first["votes"]
    votes = np.flatnonzero(machine.netlist.readout_class >= 0)
    beyond = 0
    for seed in range(20):
        channels = channels_of(counter_events(seed, counters)[None], machine.netlist)
        trace = machine.simulate(channels, None, spikes=False, membranes=True)
        ramp = np.arange(1, tally.steps + 1)[:, None] * counters.slope
        sums = (trace.membranes[0][first:, votes] - ramp) * 2**MEMBRANE_SHIFT
        events = tally.events(channels[0])[:, tally.group]
        assert np.all(sums <= tally.highest(slice(None), events, events[-1:]))
        due = tally.of(slice(None), events)
        assert_array_equal(sums[counters.steps - 1 :], due[counters.steps - 1 :])
        beyond += np.count_nonzero(sums > due)
    assert beyond > 0


@pytest.mark.parametrize("parts", [1, 2])
def test_the_netlist_is_read_back(parts):
    counters = counters_for(3, parts=parts)
    machine = machine_of(compile_crossbars(counters).netlist)
    for name in ("counter", "weight"):
        assert_array_equal(getattr(machine.counters, name), getattr(counters, name))
    for name in ("slope", "threshold", "parts", "clocks", "classes"):
        assert getattr(machine.counters, name) == getattr(counters, name)


def test_what_is_no_counting_network_to_the_last_register_is_none():
    netlist = compile_crossbars(counters_for(3)).netlist
    for name in ("threshold", "leak", "initial", "readout_first", "reset", "wire_delay", "feed_tick"):
        values = getattr(netlist, name).copy()
        values[-1] += 1
        assert machine_of(replace(netlist, **{name: values})).counters is None
    assert machine_of(compile_crossbars(random_network(1)).netlist).counters is None


def test_sums_that_may_not_be_sent_in_time_prove_nothing():
    counters = counters_for(3, taxels=20, classes=2)
    machine = machine_of(compile_crossbars(counters).netlist)
    first = planned(counters, machine.target).first
    assert first["votes"] - first["sums"] > BLOCK + 1
    assert machine.counters is None


@pytest.mark.parametrize("seed", range(4))
def test_votes_follow_from_counts_when_counters_spike_again(seed):
    counters = counters_for(seed, taxels=1, thresholds=(1, 2, 5), steps=420, ramp=500)
    highest = 4 * int(counters.weight.clip(min=0).sum(axis=1).max())
    counters = replace(counters, threshold=counters.slope * counters.steps + highest + 0.5)
    machine = machine_of(compile_crossbars(counters).netlist)
    tally = tally_of(machine)
    again = 0
    for rate in (0.3, 0.9, 1):
        one = counter_events(seed, counters, rate)
        channels = channels_of(one[None], machine.netlist)[0]
        events = tally.events(channels)[:, tally.group]
        sums = tally.of(slice(None), events[-1:])
        above = sums + tally.slope * np.arange(1, tally.steps + 1)[:, None] > tally.threshold
        assert not above[: counters.steps].any()
        assert_array_equal(machine.votes(channels[None])[0], above.sum(axis=0))
        again = max(again, int(tally.times(slice(None), events[-1]).max()))
    assert again > 2
