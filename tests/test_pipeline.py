"""The passes, one after the other: expansion of the graph convolution, pruning; and a third chip."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import events, recorded, small_checkpoint
from numpy.testing import assert_allclose, assert_array_equal
from oracles import probed, refused
from random_networks import (
    assert_same_layers,
    chain,
    float_networks,
    integer_networks,
    random_checkpoint,
    recordings_for,
    ring,
)

from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.formats.text import text
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.ir import fan_in
from spikeloom.compiler.passes.expand import expand, hop_powers, synapses
from spikeloom.compiler.passes.prune import disconnect, either, never_fires
from spikeloom.compiler.pipeline import run
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.bounds import prove_ranges
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.layout.partition import core_bound
from spikeloom.compiler.targets.loihi1.layout.place import Placement
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import PASSES, compile_network, start
from spikeloom.compiler.targets.loihi1.remove import compact, removable, removals
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.runtime.equivalence.verify import verify


def test_the_passes_run_in_order_and_hand_on_what_they_make():
    seen = {}
    source = expand(checkpoint=random_checkpoint(), propagation=ring(5))
    done = compile_network(source, after=lambda name, made: seen.setdefault(name, made.newest))
    assert list(seen) == [step.name for step in PASSES]
    assert [seen[name] for name in ("calibrate", "quantize", "remove", "emit")] == [
        done.network,
        done.integer,
        done.held,
        done.netlist,
    ]
    assert text(done.network) == text(expand(random_checkpoint(), ring(5)))
    assert done.proofs == prove_ranges(done.integer)
    assert all(proof.holds for proof in done.proofs)
    assert [choice.layer for choice in done.choices] == ["conv1", "fc1", "fc2", "fc3"]
    assert tuple(done.netlist.core_tile) == done.placement.tiles
    assert (core_bound(done.held, done.target), done.netlist.n_cores) == (1, 1)
    assert all(use.used <= use.allowed for use in done.uses)
    assert done.netlist.provenance["compensated"] == []
    assert list(done.netlist.provenance["digests"]) == ["conv1", "fc1", "fc2", "fc3"]


def test_changed_weights_are_no_longer_those_of_the_filters():
    network = expand(random_checkpoint(), ring(5))
    silent = tuple(np.arange(population.size) == 0 for population in network.populations)
    assert network.convolution is not None
    assert disconnect(network, silent).convolution is None


def test_the_table_of_passes_in_the_docs():
    docs = (Path(__file__).parents[1] / "docs" / "compile.md").read_text("utf-8")
    for step in PASSES:
        assert f"| {step.name} | {step.does} | {step.keeps} |" in docs


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("calibrate", lambda done: replace(done, network=replace(done.network, classes=0))),
        ("disconnect", lambda done: replace(done, connected=replace(done.connected, classes=0))),
        ("quantize", lambda done: replace(done, integer=replace(done.integer, classes=0))),
        ("remove", lambda done: replace(done, held=replace(done.held, classes=0))),
        ("place", lambda done: replace(done, layout=replace(done.layout, cores=done.layout.cores[1:]))),
        ("place", lambda done: replace(done, layout=replace(done.layout, cores=2 * done.layout.cores))),
        (
            "place",
            lambda done: replace(
                done, layout=replace(done.layout, placement=Placement(tiles=(-1,), spike_hops=0))
            ),
        ),
        ("emit", lambda done: replace(done, netlist=replace(done.netlist, layer=done.netlist.layer + 9))),
    ],
)
def test_a_pass_that_breaks_a_rule_is_named_at_once(name, change):
    passes = [
        replace(step, apply=lambda done, apply=step.apply: change(apply(done)))
        if step.name == name
        else step
        for step in PASSES
    ]
    work = start(expand(random_checkpoint(), ring(5)), Options(), load_target("loihi1"))
    seen = []
    refused(VerifyError, "", run, passes, work, lambda name, _: seen.append(name))
    assert name not in seen


# Pairs of taxels within three hops times 64 features and 2 polarities. The hand-drawn graph, the tree and 1, 3 and 4
# neighbours are also published counts.
CONV_SYNAPSES = {
    "manual": (97_920, 60),
    "mst:0": (45_440, 36),
    "knn:1": (27_776, 16),
    "knn:2": (49_792, 28),
    "knn:3": (104_576, 62),
    "knn:4": (117_888, 62),
    "knn:5": (138_368, 78),
    "knn:6": (155_520, 78),
    "knn:7": (167_040, 78),
    "knn:8": (181_120, 78),
}
"""Structural synapses and largest fan-in."""


def convolution(adjacency, hops):
    return synapses(hop_powers(adjacency, len(hops)), hops)


def adjacency_of(name):
    graph = build_graph(name)
    return normalised_adjacency(graph.edges, graph.n_taxels)


def factored(adjacency, hops):
    """The graph convolution as models compute it: propagate, then filter, hop by hop."""
    taxels, channels = len(adjacency), hops.shape[2]

    def stage(x):
        signal = x.reshape(len(x), taxels, channels)
        total = np.zeros((len(x), taxels, hops.shape[1]))
        for k, filters in enumerate(hops):
            if k:
                signal = np.einsum("ij,bjc->bic", adjacency, signal)
            total = total + np.einsum("bic,fc->bif", signal, filters)
        return total.reshape(len(x), -1)

    return stage


@st.composite
def graphs(draw):
    """Adjacency of up to seven taxels, directed, with repeated edges and isolated taxels."""
    taxels = draw(st.integers(1, 7))
    node = st.integers(0, taxels - 1)
    edges = draw(st.lists(st.tuples(node, node), max_size=14))
    return normalised_adjacency(np.array(edges, np.int64).reshape(-1, 2), taxels)


@given(graphs(), st.integers(1, 5), st.integers(1, 3), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_the_expanded_convolution_is_the_probed_one(adjacency, n_hops, features, channels, seed):
    hops = np.random.default_rng(seed).normal(size=(n_hops, features, channels))
    expanded = convolution(adjacency, hops)
    weight, bias = probed(factored(adjacency, hops), len(adjacency) * channels)
    assert_allclose(expanded.toarray(), weight, rtol=0, atol=1e-12)
    assert not bias.any()


@pytest.mark.parametrize("name", CONV_SYNAPSES)
def test_structural_synapses_of_each_graph(name):
    for prefix in ("", "released:"):
        weight = convolution(adjacency_of(prefix + name), np.ones((4, 64, 2)))
        assert (weight.nnz, np.diff(weight.indptr).max()) == CONV_SYNAPSES[name]


def test_structure_does_not_depend_on_the_weights():
    zero = convolution(adjacency_of("manual"), np.zeros((4, 64, 2)))
    assert zero.nnz == 97_920
    cancelled = convolution(np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[[1.0]], [[0.0]], [[-1.0]]]))
    assert cancelled.nnz == 4
    assert not zero.data.any()
    assert not cancelled.toarray().any()
    checkpoint = random_checkpoint()
    zeroed = dataclasses.replace(checkpoint.dense[0], weight=np.zeros_like(checkpoint.dense[0].weight))
    network = expand(dataclasses.replace(checkpoint, dense=(zeroed, *checkpoint.dense[1:])), ring(5))
    assert fan_in(network, 1).tolist() == [15] * 6


@given(float_networks(), st.data())
def test_what_never_fires_never_fires(network, data):
    recordings = data.draw(recordings_for(network.input.size))
    silent = never_fires(network)
    for dtype in (np.float32, np.float64):
        for mask, spikes in zip(silent, run_float(network, recordings, dtype=dtype).spikes, strict=True):
            assert not spikes[..., mask].any()
    assert not silent[network.readout.population].any()
    assert_same_layers(
        *(run_float(each, recordings).spikes for each in (disconnect(network, silent), network))
    )


@given(integer_networks(), st.data())
def test_leaving_out_moves_no_spike_that_is_left(network, data):
    recordings = data.draw(recordings_for(network.input.size))
    silent, unread = removable(network)
    laid, kept = compact(network, either(silent, unread))
    whole, rest = run_integer(network, recordings).spikes, run_integer(laid, recordings).spikes
    for post, ids in enumerate(kept):
        assert len(ids) >= 1
        assert not whole[post][..., silent[post]].any()
        assert_array_equal(rest[post], whole[post][..., ids])
    voting = network.readout.population
    assert len(kept[voting]) == network.populations[voting].size


def test_a_bound_that_is_met_just_so():
    """Two inputs of 0.2 and a leak of one half add up to 0.8: silent at a threshold of 0.81, not at 0.79."""
    for theta, silent in ((0.81, True), (0.79, False)):
        network = chain([[0.2, 0.2]], [[1.0]], beta=0.5, theta=theta)
        assert never_fires(network)[0].tolist() == [silent]
    spikes = run_float(chain([[0.2, 0.2]], [[1.0]], beta=0.5, theta=0.79), np.ones((1, 40, 2), bool)).spikes[
        0
    ]
    assert spikes.any()


def test_silence_spreads():
    """The second layer has a synapse only from a neuron that cannot fire, and no bias."""
    network = chain([[0.1], [5.0]], [[9.0, 0.0], [0.0, 9.0]], np.eye(2))
    silent = never_fires(network)
    assert [mask.tolist() for mask in silent] == [[True, False], [True, False], [False, False]]


def test_what_is_left_out_is_counted():
    """Of fc1 the first two go: four synapses that are not zero into them, two from them."""
    network = chain([[1, 0, 2], [3, 4, 0], [5, 6, 7]], [[1, 0, 2], [0, 3, 4]])
    first, second, none = (np.array(mask, bool) for mask in ([1, 0, 0], [0, 1, 0], [0, 0, 0]))

    def counted(quiet):
        found = removals(network, (first, none[:2]), (second, none[:2]), (quiet, none[:2]))
        return [(r.layer, r.silent, r.unread, r.never_fired, r.synapses) for r in found]

    assert counted(none) == [("fc1", 1, 1, 0, 4), ("fc2", 0, 0, 0, 2)]
    assert counted(second) == [("fc1", 1, 0, 1, 4), ("fc2", 0, 0, 0, 2)]
    assert counted(first | second) == [("fc1", 0, 0, 2, 4), ("fc2", 0, 0, 0, 2)]


def test_unread_neurons_are_not_compared(tmp_path):
    """The weights from them round to zero at two bits: they fire in the float model and are not on the chip."""
    checkpoint, adjacency = small_checkpoint(tmp_path)
    weak = checkpoint.dense[0].weight.copy()
    weak[:, :3] *= 1e-6
    changed = replace(checkpoint, dense=(replace(checkpoint.dense[0], weight=weak), *checkpoint.dense[1:]))
    compilation = compile_network(expand(changed, adjacency))
    netlist = compilation.netlist
    assert netlist.layers[0].unread == (0, 1, 2)
    verdict = verify(netlist, expand(changed, adjacency), recorded(events(2)))
    reference = run_float(compilation.network, channels_last(events(2))).spikes[0]
    assert reference[..., :3].any()
    assert verdict.spikes["conv1"].float == int(reference[..., 3:].sum())


def test_pruning_by_evidence_is_optional(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    quiet = events(1, rate=0.002)
    plain = compile_network(expand(checkpoint, adjacency), Options(training_events=quiet))
    fewer = compile_network(expand(checkpoint, adjacency), Options(training_events=quiet, prune_unused=True))
    assert sum(r.never_fired for r in plain.removals) == 0
    assert sum(r.never_fired for r in fewer.removals) > 0
    assert fewer.netlist.n_compartments < plain.netlist.n_compartments
