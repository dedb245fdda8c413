"""What provably does nothing is left out, and nothing else."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import events, small_checkpoint
from random_networks import assert_same_layers, chain, float_networks, integer_networks, recordings_for

from spikeloom.compiler import Options, compile_network
from spikeloom.compiler.interpret import channels_last, run_float, run_integer
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.passes.prune import compact, disconnect, either, never_fires, removable, removals
from spikeloom.runtime.equivalence.verify import verify


@settings(deadline=None, max_examples=40)
@given(float_networks(), st.data())
def test_what_never_fires_never_fires(network, data):
    recordings = data.draw(recordings_for(network.input.size))
    silent = never_fires(network)
    for dtype in (np.float32, np.float64):
        for mask, spikes in zip(silent, run_float(network, recordings, dtype=dtype).spikes, strict=True):
            assert not spikes[..., mask].any()
    assert not silent[network.readout.population].any()
    assert_same_layers(*(run_float(each, recordings).spikes for each in (disconnect(network, silent), network)))


@settings(deadline=None, max_examples=40)
@given(integer_networks(), st.data())
def test_leaving_out_moves_no_spike_that_is_left(network, data):
    recordings = data.draw(recordings_for(network.input.size))
    silent, unread = removable(network)
    laid, kept = compact(network, either(silent, unread))
    whole, rest = run_integer(network, recordings).spikes, run_integer(laid, recordings).spikes
    for post, ids in enumerate(kept):
        assert len(ids) >= 1
        assert not whole[post][..., silent[post]].any()
        np.testing.assert_array_equal(rest[post], whole[post][..., ids])
    voting = network.readout.population
    assert len(kept[voting]) == network.populations[voting].size


def test_a_bound_that_is_met_just_so():
    """Two inputs of 0.2 and a leak of one half add up to 0.8: silent at a threshold of 0.81, not at 0.79."""
    for theta, silent in ((0.81, True), (0.79, False)):
        network = chain([[0.2, 0.2]], [[1.0]], beta=0.5, theta=theta)
        assert never_fires(network)[0].tolist() == [silent]
    spikes = run_float(chain([[0.2, 0.2]], [[1.0]], beta=0.5, theta=0.79), np.ones((1, 40, 2), bool)).spikes[0]
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
    netlist, labels = compilation.netlist, np.zeros(6, np.int64)
    assert netlist.layers[0].unread == (0, 1, 2)
    verdict = verify(netlist, changed, adjacency, events(2), labels, tuple("abcdef"))
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
