"""The float model: against the released outputs, and against the equations written out step by step."""

import json

import numpy as np
import pytest
from made_files import events, ring, small_checkpoint, weights

from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.reference import BATCH, float_membranes, float_spikes
from spikeloom.models.recordings.evtouch import load_recordings


def step_by_step(checkpoint, adjacency, recording, dtype):
    """Spikes and membranes of one recording, (steps, neurons) per layer, in plain loops as the equations say."""
    a, theta, beta = adjacency.astype(dtype), dtype(checkpoint.theta), dtype(checkpoint.beta)
    stages = [dense.weight.astype(dtype) for dense in checkpoint.dense]
    biases = [dense.bias.astype(dtype) for dense in checkpoint.dense]
    sizes = [len(a) * checkpoint.hops.shape[1], *(len(bias) for bias in biases)]
    u, s = [np.zeros(size, dtype) for size in sizes], [np.zeros(size, dtype) for size in sizes]
    spikes, membranes = [[] for _ in sizes], [[] for _ in sizes]
    for t in range(recording.shape[2]):
        x = recording[:, :, t].astype(dtype)  # (taxels, channels)
        total = x @ checkpoint.hops[0].astype(dtype).T
        for hop in checkpoint.hops[1:]:
            x = a @ x
            total = total + x @ hop.astype(dtype).T
        signal = (total + checkpoint.conv_bias.astype(dtype)).reshape(-1)  # taxel-major
        for layer in range(len(sizes)):
            u[layer] = beta * u[layer] * (1 - s[layer]) + signal
            s[layer] = (u[layer] > theta).astype(dtype)
            membranes[layer].append(u[layer].copy())
            spikes[layer].append(s[layer].astype(bool))
            if layer < len(stages):
                signal = stages[layer] @ s[layer] + biases[layer]
    return [np.array(trace) for trace in spikes], [np.array(trace) for trace in membranes]


@pytest.mark.parametrize(("name", "dtype"), [("float32", np.float32), ("float64", np.float64)])
@pytest.mark.parametrize("constants", [{}, {"beta": 0.9, "theta": 0.8}, {"beta": 0.0, "theta": 0.1}])
def test_against_the_equations(tmp_path, name, dtype, constants):
    checkpoint, adjacency = small_checkpoint(tmp_path, **constants)
    recordings = events(3)
    spikes = float_spikes(checkpoint, adjacency, recordings, dtype=name)
    membranes = float_membranes(checkpoint, adjacency, recordings, dtype=name)
    assert list(spikes) == list(membranes) == ["conv1", "fc1", "fc2", "fc3"]
    # sums may be added in another order than here, so a membrane beside the threshold could fall to either side;
    # none does on these recordings
    tolerance = 1e-5 if name == "float32" else 1e-12
    for sample, recording in enumerate(recordings):
        expected = step_by_step(checkpoint, adjacency, recording, dtype)
        for layer, one, wanted, membrane in zip(spikes, spikes.values(), *expected, strict=True):
            assert one.dtype == np.bool_
            np.testing.assert_array_equal(one[sample], wanted, err_msg=layer)
            assert membranes[layer].dtype == dtype
            np.testing.assert_allclose(membranes[layer][sample], membrane, rtol=tolerance, atol=tolerance)
    assert all(0 < trace.mean() < 1 for trace in spikes.values())


def test_recordings_do_not_influence_each_other(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    recordings = events(4, samples=BATCH + 3)  # two batches
    together = float_spikes(checkpoint, adjacency, recordings)
    for sample in (0, BATCH - 1, BATCH, BATCH + 2):
        alone = float_spikes(checkpoint, adjacency, recordings[sample : sample + 1])
        for layer, spikes in together.items():
            np.testing.assert_array_equal(alone[layer][0], spikes[sample])


def test_a_spike_needs_more_than_the_threshold(tmp_path):
    arrays = weights(sizes=(4, 4, 4))
    arrays = {name: np.zeros_like(array) for name, array in arrays.items()}
    arrays["fc1.bias"][:] = [0.5, np.nextafter(np.float32(0.5), np.float32(1)), 0.0, -1.0]
    checkpoint, adjacency = small_checkpoint(tmp_path, last=arrays, beta=0.0)
    spikes = float_spikes(checkpoint, adjacency, events(0))["fc1"]
    assert spikes.mean(axis=(0, 1)).tolist() == [0, 1, 0, 0]


def test_membranes_are_those_before_the_reset(tmp_path):
    arrays = {name: np.zeros_like(array) for name, array in weights(sizes=(3, 2, 2)).items()}
    arrays["fc1.bias"][:] = [0.5, 0.625, 0.25]  # exact in every type
    checkpoint, adjacency = small_checkpoint(tmp_path, last=arrays, beta=0.5, theta=0.7)
    membrane = float_membranes(checkpoint, adjacency, events(0, steps=4))["fc1"][0]
    spikes = float_spikes(checkpoint, adjacency, events(0, steps=4))["fc1"][0]
    # the first two pass 0.7 in the second step and start from rest again
    assert membrane.T.tolist() == [
        [0.5, 0.75, 0.5, 0.75],
        [0.625, 0.9375, 0.625, 0.9375],
        [0.25, 0.375, 0.4375, 0.46875],
    ]
    assert spikes.T.tolist() == [[False, True, False, True]] * 2 + [[False] * 4]


def test_weights_act_taxel_by_taxel(tmp_path):
    """One taxel sends: the others answer by how far along the ring they are."""
    arrays = {name: np.zeros_like(array) for name, array in weights(hops=3).items()}
    arrays["conv1.hops"][1] = [[1, 0], [0, 1], [2, 0], [0, 0], [0, 0]]
    arrays["conv1.hops"][2, 3] = [4, 8]
    checkpoint, adjacency = small_checkpoint(tmp_path, last=arrays)
    np.testing.assert_array_equal(adjacency, normalised_adjacency(ring().edges, 6))
    recording = np.zeros((1, 6, 2, 1), np.uint8)
    recording[0, 2, 0, 0] = 1
    membrane = float_membranes(checkpoint, adjacency, recording)["conv1"][0, 0].reshape(6, 5)
    expected = np.zeros((6, 5))
    expected[[1, 3]] = [0.5, 0, 1, 0, 0]  # one hop
    expected[[0, 4], 3] = 4 / 4  # two hops, out
    expected[2, 3] = 4 / 2  # and back
    np.testing.assert_allclose(membrane, expected, rtol=1e-6)


# -- the released checkpoint -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def released_run(released_checkpoint, objects_zip, shared_dir):
    """Checkpoint, propagation matrix, recordings, float32 spikes and the published outputs."""
    from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint

    checkpoint, graph = read_checkpoint(released_checkpoint), build_graph("manual")
    adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
    data = load_recordings(objects_zip, "test", classes=checkpoint.classes, taxels=checkpoint.taxels)
    expected = json.loads((shared_dir / "checkpoints" / "objects_manual.expected.json").read_text())
    return checkpoint, adjacency, data, float_spikes(checkpoint, adjacency, data.events), expected


@pytest.mark.recordings
def test_every_released_spike_count(released_run):
    _, _, data, spikes, expected = released_run
    assert list(data.files) == expected["files"]
    assert data.labels.tolist() == expected["labels"]
    counts = spikes["fc3"].sum(axis=1)
    assert counts.tolist() == expected["spike_counts"]
    predictions = counts.argmax(axis=1)
    assert predictions.tolist() == expected["predictions"]
    assert int(np.count_nonzero(predictions == data.labels)) == expected["right"] == 127


@pytest.mark.recordings
def test_float64_beside_it(released_run):
    checkpoint, adjacency, data, spikes, _ = released_run
    wide = float_spikes(checkpoint, adjacency, data.events[:8], dtype="float64")
    for layer, narrow in spikes.items():
        # the sums of both types round apart by some 1e-7 of the threshold; a spike that this decides is rare
        different = np.count_nonzero(wide[layer] != narrow[:8])
        assert different <= narrow[:8].size // 100_000, layer
        assert narrow[:8].any()


@pytest.mark.recordings
def test_the_graph_matters(released_run):
    checkpoint, _, data, spikes, _ = released_run
    other = build_graph("knn:3")
    found = float_spikes(checkpoint, normalised_adjacency(other.edges, 39), data.events[:4])
    assert np.count_nonzero(found["conv1"] != spikes["conv1"][:4]) > 1000
