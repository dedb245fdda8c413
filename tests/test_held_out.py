"""The default storage: the cheapest whose decisions are the float model's on recordings that chose no scale."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import sparse_events
from numpy.testing import assert_array_equal
from oracles import refused
from random_networks import chain, small_target

from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.passes.calibrate import FEW, evenly_spaced
from spikeloom.compiler.storage import Cheapest, Fixed, Packing
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.netlist import FILE
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.loihi1.storage.held_out import HELD, KEPT, split

LADDER = [Packing(planes=planes, groups=groups) for planes in (1, 2) for groups in (1, 8)]


def unlike(seed=3, samples=72):
    """A network whose largest weights leave few steps to the others, and recordings of ten taxels."""
    rng = np.random.default_rng(seed)
    hidden = rng.normal(0, 0.12, (24, 10)) * np.geomspace(0.3, 8, 24)[:, None]
    hidden[0, 0] = 90
    network = chain(hidden, rng.normal(0, 0.35, (5, 24)))
    return network, sparse_events(rng, samples, 10, 1, 40, rate=0.3)


def decisions(spikes):
    """Class of each quarter of each recording, and whether there were votes."""
    votes = np.array([each.sum(axis=0) for one in spikes for each in np.split(one, 4)])
    return votes.argmax(axis=1), votes.any(axis=1)


@given(st.integers(2, 700))
def test_what_is_held_out_chooses_no_scale(count):
    few, several, held = (part.tolist() for part in split(count))
    assert not set(several) & set(held)
    assert sorted([*several, *held]) == list(range(count))
    assert set(few) <= set(several)
    assert len(held) == min(HELD, count - len(few))
    if count >= 2 * FEW:
        assert few == evenly_spaced(np.arange(count)).tolist()


@pytest.mark.parametrize("keep", [0.0, 0.97, 1.0])
def test_the_cheapest_that_keeps_enough_is_chosen_and_what_was_tried_is_counted(keep):
    network, events = unlike()
    done = compile_network(network, Options(training_events=events, storage=Cheapest(keep)))
    few, _, held = split(len(events))
    draw = np.random.default_rng(0)
    thinned = channels_last(
        np.stack([one * (draw.random(one.shape, np.float32) < KEPT) for one in events[held]])
    )
    wanted, voted = decisions(run_float(network, thinned).spikes[-1])
    known, found = channels_last(events[few]), []
    sent = [known, *run_float(network, known).spikes]
    for trial, packing in zip(done.trials, LADDER, strict=False):
        one = compile_network(network, Options(storage=Fixed((packing,)), training_events=events))
        equal = (decisions(run_integer(one.integer, thinned).spikes[-1])[0] == wanted) & voted
        assert (trial.equal, trial.decisions) == (equal.sum(), voted.sum())
        assert trial.cores == one.netlist.n_cores
        lists = [np.asarray((p.weight != 0).sum(axis=0)).ravel() for p in one.integer.projections]
        spikes = [sent[p.pre + 1].sum(axis=(0, 1)) for p in one.integer.projections]
        assert trial.operations == pytest.approx(
            sum(a @ b for a, b in zip(lists, spikes, strict=True)) / len(few)
        )
        found.append(one)
    shares = [trial.equal / trial.decisions for trial in done.trials]
    assert all(share < keep for share in shares[:-1])
    assert len(found) == len(LADDER) or shares[-1] >= keep
    best = found[shares.index(max(shares))]
    for ours, theirs in zip(done.integer.projections, best.integer.projections, strict=True):
        assert_array_equal(ours.effective().toarray(), theirs.effective().toarray())
    chosen = LADDER[shares.index(max(shares))]
    assert done.netlist.provenance["planes"] == chosen.planes
    assert done.netlist.provenance["scale_groups"] == chosen.groups


@pytest.mark.parametrize("pruned", [False, True])
def test_storage_that_is_asked_for_gives_the_netlist_that_is_found(pruned):
    network, events = unlike(samples=200)
    options = Options(training_events=events, prune_unused=pruned)
    found = compile_network(network, replace(options, storage=Cheapest(1.0)))
    chosen = found.netlist.provenance
    packing = Packing(planes=chosen["planes"], groups=chosen["scale_groups"])
    assert packing.planes == 2
    typed = compile_network(network, replace(options, storage=Fixed((packing,))))
    for name in FILE.arrays:
        assert_array_equal(getattr(typed.netlist, name), getattr(found.netlist, name))


def test_storage_that_the_chip_does_not_hold_is_not_chosen():
    network, events = unlike()
    options = Options(training_events=events, storage=Cheapest(1.0))
    words = compile_network(network, replace(options, storage=Cheapest(0.0))).trials[0].synapse_words
    tight = small_target(core_synapse_words=words, chip_cores=1)
    done = compile_network(network, options, target=tight)
    assert [bool(trial.refused) for trial in done.trials] == [False, False, True, True]
    assert done.netlist.provenance["planes"] == 1
    tighter = small_target(core_synapse_words=words - 1, chip_cores=1)
    refused(CapacityError, "", lambda: compile_network(network, options, target=tighter))
    assert len(compile_network(network, options).trials) > 1


def test_a_single_recording_leaves_none_to_judge_by():
    network, events = unlike(samples=1)
    done = compile_network(network, Options(training_events=events, storage=Cheapest(1.0)))
    assert done.trials == ()
    assert [choice.planes for choice in done.choices] == [1, 1]


def test_the_command_says_what_cheaper_storage_lost_and_what_helps(spikeloom, as_json):
    words = ("compile", "net.pt", "--calibrate", "data", "--keep", "1", "-o", "kept.loom")
    found = as_json(*words)
    assert found["keep"] == 1
    best = max(found["trials"], key=lambda trial: trial["equal"])
    assert [found["provenance"][name] for name in ("planes", "scale_groups")] == [
        best["planes"],
        best["groups"],
    ]
    shown = spikeloom(*words)[1]
    for trial in found["trials"]:
        assert f"{trial['equal']} of {trial['decisions']}" in shown
    helped = "spikeloom finetune net.pt --data data --weight-bits 8" in shown
    assert helped == ("finetune" in found) == (best["equal"] < best["decisions"])
