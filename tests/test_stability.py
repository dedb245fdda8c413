"""The command ``certify``: quick runs of changed recordings are the slow ones, and what it proves no attack breaks."""

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from commands import as_json, run
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from made_files import CLASSES, TAXELS, events, recorded, recordings_folder, sparse_events
from numpy.testing import assert_array_equal
from random_crossbars import random_events, random_network
from random_netlists import large_netlist, lively, netlists, recordings, voting
from random_networks import chain, random_checkpoint, ring

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.formats.counters import counting_network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.netlist import write_netlist
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.truenorth.passes import compile_crossbars
from spikeloom.models.training.counters import Plan, counters_of, fit, run_counters
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.changes import Changes, Past, by_running, joined, single
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.changes.chip import overflows
from spikeloom.runtime.report.encode import decode
from spikeloom.runtime.studies.robustness.certify_sections import hanging_on
from spikeloom.runtime.studies.robustness.exhaustive import certify, share_robust_to_one_event
from spikeloom.runtime.studies.robustness.perturbations import EXHAUSTIVE
from spikeloom.runtime.studies.robustness.proofs.bounds import PASTS, REACH, lower_bound, needed
from spikeloom.runtime.studies.robustness.proofs.counting import least, tally_of
from spikeloom.runtime.studies.robustness.proofs.entries import cells_of, channels_of
from spikeloom.runtime.studies.robustness.results import Certificates

REPEATABLE = settings(max_examples=40, derandomize=True)


def small_netlist(seed, taxels=TAXELS):
    """A small TactileSGNet on the chip, lively."""
    made = random_checkpoint(seed=seed, taxels=taxels, features=5, sizes=(9, 8, CLASSES))
    return compile_network(expand(made, ring(taxels))).netlist


def every_cell(channels):
    step, channel = np.indices(channels.T.shape).reshape(2, -1)
    return np.stack([channel, step], axis=1)


def assert_as_by_running(machine, channels, changes):
    found, wanted = machine.effects(channels, changes), by_running(machine.votes, channels, changes)
    assert_array_equal(found.votes, wanted.votes)
    assert np.all(found.come >= wanted.come)
    assert np.all(found.gone >= wanted.gone)
    return found


def kept(netlist, recordings):
    trace = engine.simulate(netlist, recordings, spikes=True, membranes=True)
    return trace.spikes, trace.membranes


@REPEATABLE
@given(st.data())
def test_changed_runs_are_whole_runs_on_networks_of_any_kind(data):
    netlist = voting(data.draw(netlists(weight_exponents=(-1, 0, 1))))
    assume(not overflows(netlist))
    channels = data.draw(recordings(netlist))
    cells = every_cell(channels)
    assume(len(cells))
    machine = machine_of(netlist)
    assert_as_by_running(machine, channels, single(cells))
    chance = st.lists(st.integers(0, len(cells) - 1), max_size=6, unique=True)
    several = data.draw(st.lists(chance, min_size=1, max_size=5))
    assert_as_by_running(machine, channels, joined([cells[each] for each in several]))


def test_where_a_register_may_overflow_every_change_is_run():
    netlist = replace(voting(large_netlist(3, proved=False)), taxels=20)
    assert overflows(netlist)
    machine, channels = machine_of(netlist), np.zeros((20, 3), np.uint8)
    assert machine.groups(channels, 3, 0, 1) is None
    changes = single(every_cell(channels)[:5])
    assert_array_equal(
        machine.effects(channels, changes).votes, by_running(machine.votes, channels, changes).votes
    )


@pytest.mark.parametrize("seed", range(4))
def test_no_past_and_no_future_make_a_group_turn_more_votes_than_its_bound(seed):
    rng = np.random.default_rng(seed)
    netlist = lively() if seed == 0 else small_netlist(seed)
    inputs, steps, reach = netlist.n_inputs, 40, 8
    pasts = [Past(1), Past(3), Past(6), Past(1, single=True), Past(3, single=True)]
    channels = sparse_events(rng, inputs, steps, rate=0.1)
    machine = machine_of(netlist)
    (spikes,) = kept(netlist, channels[None])[0]
    decision = int(machine.votes(channels[None])[0].argmax())
    lag, lost, after = machine.groups(channels, steps, decision, reach)
    tight = 0
    for _ in range(250):
        past, count = pasts[rng.integers(len(pasts))], rng.integers(2)
        t = int(rng.integers(past.steps if past.single else 0, steps))
        later = rng.integers(1, reach + 1)
        runs = np.repeat(channels[None], 24, axis=0)
        before = max(t - past.steps + (not past.single), 0)
        runs[:, :, :before] = rng.random((24, inputs, before)) < rng.random((24, 1, 1))
        if later < reach:
            runs[:, :, t + later :] = rng.random((24, inputs, max(steps - t - later, 0))) < rng.random(
                (24, 1, 1)
            )
        for each in runs:
            if past.single:
                each[rng.integers(inputs), before] ^= 1
            each[rng.choice(inputs, rng.integers(1, inputs + 1) if count else 1, replace=False), t] ^= 1
        window = slice(t + lag, t + lag + later if later < reach else None)
        others = kept(netlist, runs)[0][:, window].astype(np.int64)
        more = (others - spikes[window]).sum(axis=1)
        votes = np.stack(
            [more[:, netlist.readout_class == each].sum(axis=1) for each in range(netlist.classes)]
        )
        sharp = after(past, t)
        assert np.all(sharp <= lost[t])
        for each in set(range(netlist.classes)) - {decision}:
            bound = sharp[count, later - 1, each]
            assert np.all(votes[each] - votes[decision] <= bound)
            tight += int(np.any(votes[each] - votes[decision] == bound))
    assert tight > 20 or seed == 0


def study_of(netlist, given, **options):
    return certify(machine_of(netlist), recorded(given), jobs=1, **{"shift": 25, "most": 16} | options)


def decided(netlist, given):
    return machine_of(netlist).votes(channels_of(given, netlist)).argmax(axis=1)


def bounded(machine, one, most=8):
    """A recording, what flips of its entries do alone, its votes and how many events are proven to be harmless."""
    channels, cells = channels_of(one[None], machine.netlist)[0], cells_of(one, machine.netlist)
    votes = machine.votes(channels[None])[0]
    alone = machine.effects(channels, single(cells.cells))
    steps = int(cells.cells[-1, 1]) + 1
    groups = machine.groups(channels, steps, int(votes.argmax()), REACH)
    return channels, cells, alone, votes, lower_bound(votes, groups, PASTS, most).events


def test_none_of_all_pairs_and_triples_breaks_what_is_proven_of_them():
    proven = []
    for seed in (1, 4, 6, 11):
        machine = machine_of(small_netlist(seed, taxels=2))
        for one in events(seed, samples=2, taxels=2, steps=18, rate=0.15):
            channels, cells, _, votes, bound = bounded(machine, one)
            broken = []
            for count in range(1, min(max(bound, 1), 3) + 1):
                every = np.array(list(combinations(range(len(cells.cells)), count)))
                changes = Changes(cells.cells[every.ravel()], np.arange(len(every) + 1) * count)
                found = machine.effects(channels, changes).votes + votes
                broken.append(bool(np.any(found.argmax(axis=1) != votes.argmax())))
            assert broken == [False] * len(broken) or bound == 0
            proven.append(bound)
    assert {0, 1, 3} <= set(proven)


def test_a_neuron_that_fires_by_itself_does_not_make_all_votes_doubtful():
    weights = ([[0.3, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.01, 0.0]])
    machine = machine_of(compile_network(chain(*weights, biases=[[0.42, 0.0], [0.0, 0.0]])).netlist)
    one = np.zeros((2, 1, 160), np.uint8)
    one[1, :, 80:] = 1  # until then it keeps whatever phase an event gives it
    *_, proven = bounded(machine, one)
    assert proven == 8


@pytest.mark.parametrize("seed", [0, 1, 4, 6])
def test_no_attack_breaks_what_is_proven(seed):
    machine, rng, proven = machine_of(small_netlist(seed)), np.random.default_rng(seed), []
    for one in events(seed, samples=3, steps=80, rate=0.1):
        channels, cells, alone, votes, bound = bounded(machine, one)
        decision, gaps = needed(votes)
        worst = int(np.argmin(np.where(gaps > 0, gaps, len(one) * 100)))
        hurts = np.argsort(alone.votes[:, decision] - alone.votes[:, worst], kind="stable")
        step, attacks = cells.cells[:, 1], []
        for _ in range(400):  # what does most damage alone, then anything close to each other
            attacks.append(rng.choice(hurts[:40], bound, replace=False))
            close = np.flatnonzero(np.abs(step - rng.choice(step)) < 4)
            attacks.append(rng.choice(close, bound, replace=False))
        found = machine.effects(channels, joined([cells.cells[each] for each in attacks])).votes + votes
        assert np.all(found.argmax(axis=1) == decision)
        proven.append(bound)
    assert max(proven) >= 2


@pytest.mark.parametrize(
    "plan", [Plan(thresholds=(1, 2, 4), ramp=40), Plan(thresholds=(1, 3), parts=2, bins=2, ramp=30)], ids=str
)
def test_counters_bear_exactly_so_many_events(plan):
    rng, labels = np.random.default_rng(3), np.arange(24) % 3
    often = np.random.default_rng(4).random((3, 2, 2, 1))
    given = sparse_events(rng, 24, 2, 2, 16, rate=0.6 * often[labels])
    data = recorded(given, labels)
    seen = run_counters(data, plan)
    made = counters_of(seen, fit(seen, 3), data, 3)
    machine = machine_of(compile_network(counting_network(made)).netlist)
    tally, exact = tally_of(machine), set()
    for one, found in zip(
        given[:5], certify(machine, data.part(slice(5)), jobs=1, shift=25, most=2).certificates, strict=True
    ):
        channels, cells = channels_of(one[None], machine.netlist)[0], cells_of(one, machine.netlist)
        votes, broken = machine.votes(channels[None])[0], 3
        known = least(tally, channels != 0, votes, cells, 2)
        for count in (2, 1):
            every = np.array(list(combinations(range(len(cells.cells)), count)))
            every = every[cells.cost[every].sum(axis=1) <= 2]
            changes = Changes(cells.cells[every.ravel()], np.arange(len(every) + 1) * count)
            decisions = (machine.effects(channels, changes).votes + votes).argmax(axis=1)
            altering = cells.cost[every].sum(axis=1)[decisions != votes.argmax()]
            broken = min(broken, int(altering.min(initial=3)))
            if count == 1:
                assert sum(found.kinds[kind].alter for kind in ("removed", "added")) == np.sum(altering == 1)
        assert found.at_least < broken
        if known is not None:
            assert found.at_least == broken - 1
            assert found.at_most == (broken if broken < 3 else None)
            exact.add(broken)
    assert {1, 2} <= exact
    assert (
        share_robust_to_one_event(machine, data.part(slice(5)))
        == certify(machine, data.part(slice(5)), jobs=1, shift=25, most=16).certified(1) / 5
    )


@pytest.mark.parametrize(("bins", "clocks"), [(1, Clocks()), (3, Clocks(length=12))])
def test_verdicts_are_those_of_plain_runs(bins, clocks):
    netlist = replace(small_netlist(1), bins=bins, clocks=clocks)
    given = events(5, samples=2, steps=20, rate=0.1)
    for one, found in zip(given, study_of(netlist, given, shift=3, most=4).certificates, strict=True):
        known = decided(netlist, one[None])[0]
        assert found.decision == known
        wanted = dict.fromkeys(EXHAUSTIVE, 0)
        hanging = {kind: set() for kind in ("removed", "added", "dead", "stuck")}

        def tally(kind, changed, taxel=None, known=known, wanted=wanted, hanging=hanging):
            if decided(netlist, changed[None])[0] != known:
                wanted[kind] += 1
                hanging.get(kind, set()).add(taxel)

        seen = set()
        for taxel, polarity, step in np.ndindex(one.shape):
            changed = one.copy()
            changed[taxel, polarity, step] ^= 1
            kind = "removed" if one[taxel, polarity, step] else "added"
            if (
                place := (kind, taxel, polarity, step // bins)
            ) not in seen:  # events of one step do the same
                seen.add(place)
                tally(kind, changed, taxel)
        for taxel in range(TAXELS):
            for kind, value in (("dead", 0), ("stuck", 1)):
                changed = one.copy()
                changed[taxel] = value
                tally(kind, changed, taxel)
        for pair in combinations(range(TAXELS), 2):
            changed = one.copy()
            changed[list(pair)] = 0
            tally("two dead", changed)
        for by in (-3, -2, -1, 1, 2, 3):
            changed = np.zeros_like(one)
            changed[..., max(by, 0) : 20 + min(by, 0)] = one[..., max(-by, 0) : 20 - max(by, 0)]
            tally("shifted", changed)
        for cut in range(1, 20):
            for kind, part in (("start cut", np.s_[..., :cut]), ("end cut", np.s_[..., 20 - cut :])):
                changed = one.copy()
                changed[part] = 0
                tally(kind, changed)
        assert {kind: each.alter for kind, each in found.kinds.items()} == wanted
        assert {kind: set(each) for kind, each in found.taxels.items()} == hanging
        assert (found.at_least >= 1) == (wanted["removed"] + wanted["added"] == 0)
        assert found.at_most is None or found.at_most > found.at_least
        assert all(
            (each.alter > 0) == (each.to is not None and each.to != known) for each in found.kinds.values()
        )


def test_a_chip_that_knows_no_short_cut_runs_every_change():
    network = random_network(1, taxels=2)
    netlist = compile_crossbars(network).netlist
    given = random_events(5, network)
    for one, found in zip(given, study_of(netlist, given, shift=1).certificates, strict=True):
        cells, alter = cells_of(one, netlist), 0
        for channel, step in cells.cells.tolist():
            changed = one.copy()
            changed.reshape(-1, one.shape[-1])[channel, step] ^= 1
            alter += int(decided(netlist, changed[None])[0] != found.decision)
        assert found.kinds["removed"].alter + found.kinds["added"].alter == alter
        assert (found.at_least, found.at_most) == ((0, 1) if alter else (1, None))


def test_an_attack_alters_the_decision_with_the_events_that_it_names():
    netlist, given = small_netlist(0), events(8, samples=4, steps=60, rate=0.1)
    result = study_of(netlist, given)
    assert any(each.at_most is not None and each.at_most > 1 for each in result.certificates)
    for each, quick in zip(result.certificates, study_of(netlist, given, most=1).certificates, strict=True):
        assert (quick.kinds, quick.phases) == (each.kinds, each.phases)
        assert quick.at_least == min(each.at_least, 1)
    for one, found in zip(given, result.certificates, strict=True):
        changed = one.copy()
        for words in found.attack:
            taxel, polarity, step = (
                int(word.strip(",:")) for word in words.split() if word.strip(",:").isdigit()
            )
            assert words.endswith("removed" if one[taxel, polarity, step] else "added")
            changed[taxel, polarity, step] ^= 1
        assert np.count_nonzero(changed != one) == (found.at_most or 0)
        assert (decided(netlist, changed[None])[0] != found.decision) == (found.at_most is not None)


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_netlist(small_netlist(1), "net.loom")
    recordings_folder(tmp_path / "data", test=events(3, samples=4))
    words = ["certify", "net.loom", "--data", "data", "--shift", "2"]
    found = as_json(*words, "-o", "found.json", "--picture", "map.svg")
    assert json.loads((tmp_path / "found.json").read_text()) == found
    assert (tmp_path / "map.svg").read_bytes().startswith(b"<?xml")
    result = decode(Certificates, found)
    assert len(result.certificates) == 4
    assert result.unaltered("dead") == sum(not each.taxels["dead"] for each in result.certificates)
    assert sum(hanging_on(result)["dead"]) == sum(each.kinds["dead"].alter for each in result.certificates)
    code, out, err = run(*words)
    assert code == 0
    singles = events(3, samples=4).size
    assert err == f"spikeloom: trying {singles:,} single events of 4 recordings, then every other change\n"
    assert f"no single event alters the decision: {25 * result.certified(1):.2f} %" in out
    assert f"a taxel sends nothing  {'':35}{result.unaltered('dead')} of 4".replace(" ", "") in out.replace(
        " ", ""
    )
    for wrong in ("--shift -1", "--most 0", "--jobs 0"):
        assert run(*words[:-2], *wrong.split())[0] == 2
