"""Joined networks: towers side by side, from files to the chip and through every command."""

from dataclasses import replace

import numpy as np
import pytest
from commands import as_json, refusal
from made_files import checkpoint_bytes, rebuilt
from numpy.testing import assert_array_equal
from oracles import refused
from timed_networks import GRAPH, TIMING, events_of, written
from zoo import stored, tuned

from spikeloom.compiler.checkpoint import SHARED, towers_of
from spikeloom.compiler.dynamics import PLAIN, Clocks, Dynamics
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.tensors import arrays_of, join, members
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph
from spikeloom.models.networks.reference import float_membranes, float_spikes
from spikeloom.runtime.machines.votes import readout_counts

CASES = pytest.mark.parametrize(
    ("system", "dynamics"),
    [("tactilesgnet", TIMING), ("mlp", PLAIN), ("grid-cnn", TIMING)],
    ids=lambda each: str(each)[:8],
)
SEEDS = (1, 2, 3)


def joined(folder, system="tactilesgnet", dynamics=TIMING, seeds=SEEDS, **sizes):
    """Networks, the one joined of them and what their first layer sees."""
    singles = []
    for seed in seeds:
        _, seen = written(folder / f"{seed}.pt", system, dynamics, seed=seed, **sizes)
        singles.append(read_checkpoint(folder / f"{seed}.pt"))
    return singles, stored(folder / "wide.pt", join(singles, [f"{seed}.pt" for seed in seeds])), seen


def one_by_one(single_runs, wide, name, kind=bool):
    """Values of a joined layer, spelled out: those of each network where its neurons lie, relays after them."""
    layers = list(wide.neurons)
    index, width = layers.index(name), single_runs[0][name].shape[-1]
    clocks = 0 if index else wide.dynamics.clocks.channels
    own, many = width - clocks, len(single_runs)
    found = np.zeros((*single_runs[0][name].shape[:-1], own * many + clocks), kind)
    for tower, run in enumerate(single_runs):
        for neuron in range(own):
            place = tower * own + neuron
            if not index:
                features = wide.hops.shape[1] // many
                if wide.system == "grid-cnn":
                    feature, position = divmod(neuron, wide.places)
                    place = (tower * features + feature) * wide.places + position
                else:
                    position, feature = divmod(neuron, features)
                    place = position * features * many + tower * features + feature
            found[..., place] = run[name][..., neuron]
        if clocks:
            found[..., -clocks:] = run[name][..., -clocks:]
    return found


@CASES
def test_a_file_holds_its_towers_and_nothing_between_them(tmp_path, system, dynamics):
    singles, wide, _ = joined(tmp_path, system, dynamics)
    assert (wide.towers, wide.classes, wide.taxels, wide.places) == (3, 4, 39, singles[0].places)
    assert wide.dynamics == dynamics
    clocks = dynamics.clocks.channels
    assert wide.neurons == {
        "conv1": 3 * (singles[0].neurons["conv1"] - clocks) + clocks,
        "fc1": 24,
        "fc2": 18,
        "fc3": 12,
    }
    size = (tmp_path / "wide.pt").stat().st_size
    assert size < sum((tmp_path / f"{seed}.pt").stat().st_size for seed in SEEDS)
    for single, member in zip(singles, members(wide), strict=True):
        assert member.towers == 1
        for name, array in arrays_of(single).items():
            assert_array_equal(arrays_of(member)[name], array)


def test_joined_networks_join_again(tmp_path):
    singles, wide, _ = joined(tmp_path)
    again = join([wide, singles[1]], ["wide.pt", "2.pt"])
    assert again.towers == 4
    for single, member in zip([*singles, singles[1]], members(again), strict=True):
        assert_array_equal(member.dense[1].weight, single.dense[1].weight)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m, _: m.update(towers="3"), "the manifest has no usable towers"),
        (
            lambda m, _: m.update(towers=2),
            "conv1.bias is (9,), not as much for each of 2 towers|conv1.hops is (3, 9, 2)",
        ),
        (
            lambda m, _: m.update(classes=12),
            "39 taxels and 4 classes, the manifest says 39 taxels and 12 classes",
        ),
    ],
)
def test_signed_but_wrong(tmp_path, change, expected):
    joined(tmp_path)
    path = tmp_path / "wide.pt"
    path.write_bytes(rebuilt(path.read_bytes(), change))
    refused(ModelError, f"{path}: |{expected}|; copy or train it again", read_checkpoint, path)


@CASES
def test_towers_spike_as_the_single_networks_bit_for_bit(tmp_path, system, dynamics):
    singles, wide, seen = joined(tmp_path, system, dynamics)
    dtype = "float32" if system == "grid-cnn" else "float64"
    events = events_of(5, samples=4, steps=30)
    alone = [float_spikes(expand(single, seen), events, dtype=dtype) for single in singles]
    found = float_spikes(expand(wide, seen), events, dtype=dtype)
    assert list(found) == ["conv1", "fc1", "fc2", "fc3"]
    for name, spikes in found.items():
        assert_array_equal(spikes, one_by_one(alone, wide, name), err_msg=name)
        assert spikes.any(), name
    summed = sum(run["fc3"].sum(axis=1, dtype=np.int64) for run in alone)
    assert_array_equal(readout_counts(wide.readout, wide.classes, found["fc3"]), summed)
    assert summed.any()
    still = float_membranes(expand(wide, seen), events, dtype=dtype)
    single_membranes = [float_membranes(expand(single, seen), events, dtype=dtype) for single in singles]
    for name, membranes in still.items():
        assert_array_equal(
            membranes, one_by_one(single_membranes, wide, name, membranes.dtype), err_msg=name
        )


@CASES
def test_the_expanded_network_is_sparse_in_blocks(tmp_path, system, dynamics):
    singles, wide, seen = joined(tmp_path, system, dynamics)
    network, alone = expand(wide, seen), [expand(single, seen) for single in singles]
    owners = towers_of(wide)
    clocks = dynamics.clocks.channels
    for layer, projection in enumerate(network.projections):
        stored_in_all = sum(single.projections[layer].weight.nnz for single in alone)
        assert projection.weight.nnz == stored_in_all - (0 if layer else 2 * clocks), (
            layer
        )  # one set of relays
        rows, columns = projection.weight.tocoo().coords
        if layer:
            before = owners[layer - 1][columns]
            assert np.all((before == owners[layer][rows]) | (before == SHARED))
            assert projection.weight.has_sorted_indices
    assert [population.relays for population in network.populations] == [clocks, 0, 0, 0]
    assert network.classes == 4
    assert network.readout.label.tolist() == [0, 1, 2, 3] * 3


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Three networks, each with a record and two sets of weights; joined."""
    place = tmp_path_factory.mktemp("joined-data")
    for seed in SEEDS:
        path = place / f"timed{seed}.pt"
        network, _ = written(path, seed=seed)
        last = network.export_weights()
        record = {"command": f"spikeloom train --seed {seed}", "seed": seed, "data_sha256": f"{seed:064}"}
        known = {
            "beta": 0.2,
            "theta": 0.5,
            "dynamics": TIMING,
            "training": record | {"last": {"correct": seed}},
        }
        sets = {"last": last, "clean": {key: array / 2 for key, array in last.items()}}
        path.write_bytes(checkpoint_bytes(sets, GRAPH, **known))
    as_json(
        "join", *(place / f"timed{seed}.pt" for seed in SEEDS), "-o", place / "timed.pt", "--weights", "last"
    )
    return place


def test_the_record_tells_every_tower(data):
    inspected = as_json(*f"inspect {data}/timed.pt".split())
    assert inspected["towers"] == 3
    assert inspected["classes"] == 4
    record = inspected["training"]
    assert record["command"] == "spikeloom join timed1.pt timed2.pt timed3.pt --weights last"
    assert [tower["seed"] for tower in record["towers"]] == list(SEEDS)
    for seed, tower in zip(SEEDS, record["towers"], strict=True):
        single = as_json(*f"inspect {data}/timed{seed}.pt".split())
        assert tower["file"] == f"timed{seed}.pt"
        assert (tower["sha256"], tower["weights"]) == (single["sha256"], "last")
        for key in ("command", "seed", "data_sha256", "last"):
            assert tower[key] == single["training"][key], key


def test_equal_input_gives_equal_bytes_and_other_sets_other_ones(data):
    words = " ".join(f"{data}/timed{seed}.pt" for seed in SEEDS)
    as_json(*f"join {words} --weights last -o {data}/a.pt".split())
    assert (data / "a.pt").read_bytes() == (data / "timed.pt").read_bytes()
    report = as_json(*f"join {words} --weights clean -o {data}/c.pt".split())
    assert [tower["weights"] for tower in report["towers"]] == ["clean"] * 3
    for seed, member in zip(SEEDS, members(read_checkpoint(data / "c.pt")), strict=True):
        clean = read_checkpoint(data / f"timed{seed}.pt", weights="clean")
        assert_array_equal(member.dense[0].weight, clean.dense[0].weight)


def test_what_disagrees_is_listed_in_one_line(tmp_path):
    written(tmp_path / "a.pt")
    other = Dynamics(
        betas=(0.2, 0.3, 0.1, 0.4), alphas=(0.0, 0.9, 0.5, 0.0), clocks=Clocks(channels=2, steps=5)
    )
    written(tmp_path / "b.pt", "gcn", other, classes=5, features=2, hidden=(8, 7))
    said = refusal(*f"join {tmp_path}/a.pt {tmp_path}/b.pt -o {tmp_path}/x.pt".split())
    for word in ("system", "classes", "layers", "membrane decays", "clocks"):
        assert f"{word} ({tmp_path}/b.pt)" in said
    assert not (tmp_path / "x.pt").exists()


def test_graphs_and_storage_must_agree(tmp_path):
    written(tmp_path / "a.pt", dynamics=PLAIN)
    one = read_checkpoint(tmp_path / "a.pt")
    turned = replace(one, edges=one.edges[::-1], graph="the same, listed the other way round")
    assert join([one, turned], ["a", "b"]).towers == 2
    pair = [tuned(one, seed) for seed in (1, 2)]
    for member, single in zip(members(join(pair, ["a", "b"])), pair, strict=True):
        for ours, theirs in zip(member.forms, single.forms, strict=True):
            assert_array_equal(ours.threshold, theirs.threshold)
    another = replace(one, edges=build_graph("knn:1").edges, graph="knn:1")
    for other, what in ((another, "graph"), (tuned(one, 1), "storage")):
        with pytest.raises(ModelError, match=rf"differ from a in {what} \(b\);"):
            join([one, other], ["a", "b"])
