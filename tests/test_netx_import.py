"""lava-dl's ``.net`` files: read as the integers that they are."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_netx import conv, dense, even, events, flatten, given_input, neuron, write
from numpy.testing import assert_array_equal

from spikeloom.compiler import compile_network, lift
from spikeloom.compiler.formats.netx.layout import read_blocks
from spikeloom.compiler.formats.netx.reader import integers_of, read_netx
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.sensor_layout import sensor_layout
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.runtime.cli import main
from spikeloom.runtime.machines.loihi1 import engine


def lif(weight, bias, spikes, *, u, v, threshold, own=None):
    """A second reading of a block: spikes of (steps, inputs) integers, in plain Python arithmetic."""
    rows = [np.zeros(len(weight), bool)]
    current, membrane = np.zeros(len(weight), np.int64), np.zeros(len(weight), np.int64)
    for now in spikes.astype(np.int64):
        arrived = weight @ now + (0 if own is None else own @ rows[-1].astype(np.int64))
        current = np.sign(current) * (np.abs(current) * (4096 - u) >> 12) + 64 * arrived
        membrane = np.sign(membrane) * (np.abs(membrane) * (4096 - v) >> 12) + current + 64 * bias
        rows.append(membrane > 64 * threshold)
        membrane = np.where(rows[-1], 0, membrane)
    return np.stack(rows[1:])


def test_dense_blocks(tmp_path):
    rng = np.random.default_rng(0)
    first, last, bias = even(rng, 12, 6), even(rng, 5, 12), even(rng, 12, most=20)
    block = dense(last, neuron=neuron(u=1024, v=128, threshold=80, kind="LOIHI", wgtExp=0, theta=1600))
    path = write(tmp_path / "a.net", dense(first, bias=bias), block, simulation={"Ts": 1, "tSample": 64})
    found = read_netx(path)
    verify(found.network)
    given_ = events(rng, 6)
    ours = run_integer(found.network, given_[None]).spikes
    hidden = lif(first, bias, given_, u=4096, v=1024, threshold=25)
    out = lif(last, np.zeros(5, int), hidden, u=1024, v=128, threshold=80)
    assert hidden.sum() > 20
    assert out.sum() > 20
    assert_array_equal(ours[0][0], hidden)
    assert_array_equal(ours[1][0], out)
    assert found.facts[0] == "netx, 2 layers, read as they stand"
    assert found.facts[3:] == (
        "dense1: 5 neurons, decay_u 1023, decay_v 128, fires at v > 64 * 80",
        "classes: the spikes of dense1, a neuron each",
    )


@pytest.mark.parametrize("groups", [1, 2])
def test_convolutions_are_those_of_torch(tmp_path, groups):
    rng = np.random.default_rng(1)
    kernel, bias = even(rng, 4, 2 // groups, 3, 2), even(rng, 4, most=10)
    torch_out = torch.nn.functional.conv2d
    given_ = events(rng, 2 * 5 * 6)
    images = torch.from_numpy(given_.reshape(-1, 2, 5, 6).astype(np.float64))
    more = {"stride": (2, 1), "padding": (1, 0), "dilation": (1, 2), "groups": groups}
    sums = torch_out(images, torch.from_numpy(kernel.astype(np.float64)), **more).numpy()
    shape = sums.shape[1:]
    last = even(rng, 3, int(np.prod(shape)))
    blocks = [
        given_input(2, 5, 6),
        conv(kernel[..., None] if groups == 2 else kernel, shape, bias=bias, **more),
        flatten(last.shape[1]),
        dense(last),
    ]
    found = read_netx(write(tmp_path / "a.net", *blocks)).network
    _, positions, _ = sensor_layout((2, 5, 6))
    ours = run_integer(found, given_[None][:, :, positions]).spikes
    flat = sums.reshape(len(sums), -1).astype(np.int64)
    hidden = lif(
        np.eye(flat.shape[1], dtype=int), np.repeat(bias, np.prod(shape[1:])), flat, u=4096, v=1024, threshold=25
    )
    assert hidden.sum() > 20
    assert_array_equal(ours[0][0], hidden)
    assert_array_equal(ours[1][0], lif(last, np.zeros(3, int), hidden, u=4096, v=1024, threshold=25))


def test_an_input_block_with_neurons_is_a_layer(tmp_path):
    rng = np.random.default_rng(2)
    weight = even(rng, 3, 6)
    block = given_input(6) | {"weight": np.array([36.0]), "bias": np.array([4.0]), "neuron": neuron()}
    found = read_netx(write(tmp_path / "a.net", block, dense(weight)))
    assert "it turns events into currents" in found.facts[2]
    given_ = events(rng, 6)
    hidden = lif(36 * np.eye(6, dtype=int), np.full(6, 4), given_, u=4096, v=1024, threshold=25)
    assert_array_equal(run_integer(found.network, given_[None]).spikes[0][0], hidden)


@pytest.mark.parametrize(("most", "exponents"), [(60, [-1]), (200, [0, -1])])
def test_odd_weights_are_exact(tmp_path, most, exponents):
    rng = np.random.default_rng(3)
    weight = rng.integers(-most, most + 1, (6, 4))
    weight[0, 0] = most | 1
    network = read_netx(write(tmp_path / "a.net", dense(weight))).network
    verify(network)
    assert [projection.exponent for projection in network.projections] == exponents
    assert_array_equal(sum(projection.effective().toarray() for projection in network.projections), weight)
    placed = compile_network(network)
    given_ = events(rng, 4)
    fast = engine.simulate(placed.netlist, given_.T[None].astype(np.uint8), spikes=True)
    back = lift(placed.netlist)
    assert_array_equal(
        fast.spikes[0][:40, placed.netlist.compartments_of(0)], run_integer(back, given_[None]).spikes[0][0]
    )


def test_a_network_on_the_chip(tmp_path, capsys):
    rng = np.random.default_rng(4)
    path = write(tmp_path / "a.net", dense(even(rng, 12, 6)), dense(even(rng, 5, 12)))
    assert main(["compile", str(path), "--cores-for", "dense0=2", "-o", str(tmp_path / "a.loom")]) == 0
    assert capsys.readouterr().out.startswith("netx, 2 layers, read as they stand\n")
    netlist = read_netlist(tmp_path / "a.loom")
    assert netlist.n_cores == 3
    assert netlist.provenance["format"] == "netx"
    given_ = events(rng, 6)
    fast = engine.simulate(netlist, given_.T[None].astype(np.uint8), spikes=True)
    network = read_netx(path).network
    for index, spikes in enumerate(run_integer(network, given_[None]).spikes):
        depth, ids = netlist.layers[index].depth, netlist.compartments_of(index)
        assert_array_equal(fast.spikes[0][depth : depth + 40, ids], spikes[0][:, netlist.neuron[ids]])


@pytest.mark.parametrize("most", [60, 127, 250])
def test_a_block_that_hears_itself(tmp_path, most):
    rng = np.random.default_rng(8)
    first, own, last = even(rng, 12, 6), rng.integers(-most, most + 1, (12, 12)), even(rng, 5, 12)
    block = dense(first) | {"type": ["dense_rec"], "weight_rec": own.astype(np.float32)}
    found = read_netx(write(tmp_path / "a.net", block, dense(last)))
    verify(found.network)
    given_ = events(rng, 6)
    ours = run_integer(found.network, given_[None]).spikes
    hidden = lif(first, 0, given_, u=4096, v=1024, threshold=25, own=own)
    assert np.count_nonzero(hidden != lif(first, 0, given_, u=4096, v=1024, threshold=25)) > 20
    assert_array_equal(ours[0][0], hidden)
    assert_array_equal(ours[1][0], lif(last, 0, hidden, u=4096, v=1024, threshold=25))
    assert found.facts[2].split("; ")[1] == "it is recurrent, fed by its own spikes of the step before"
    placed = compile_network(found.network).netlist
    fast = engine.simulate(placed, given_.T[None].astype(np.uint8), spikes=True)
    ids = placed.compartments_of(0)
    assert_array_equal(fast.spikes[0][:40, ids], hidden[:, placed.neuron[ids]])


def recorded(name):
    """A file of a checkout of lava-dl."""
    folder = os.environ.get("SPIKELOOM_LAVA_DL")
    if not folder:
        pytest.skip("set SPIKELOOM_LAVA_DL to a checkout of lava-dl")
    return Path(folder) / "tests/lava/lib/dl/netx" / name


def test_spikes_that_lava_dl_recorded():
    path = recorded("tiny.net")
    blocks, tree, _ = read_blocks(path)
    # the recording starts behind the input layer
    first = replace(blocks[0], entries={k: v for k, v in blocks[0].entries.items() if k != "neuron"})
    network, _ = integers_of([first, *blocks[1:]], tree, 3)
    _, positions, _ = sensor_layout((3, 16, 16), polarities=3)

    def spikes(name, size):
        return np.load(recorded(f"gts/tinynet/{name}.npy"))[0].reshape(size, 16).T > 0

    given_, hidden, out = spikes("input", 768)[:, positions], spikes("layer1", 864), spikes("output", 36)
    ours = run_integer(network, given_[None, 1:]).spikes  # a layer starts a step after the one before it
    assert hidden.sum() > 1000
    assert_array_equal(ours[0][0], hidden[1:])
    assert_array_equal(ours[1][0], out[1:])
