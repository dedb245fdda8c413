"""lava-dl's ``.net`` files: read as the integers that they are, or refused."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from made_netx import conv, dense, even, events, flatten, given_input, neuron, write
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats import hdf5
from spikeloom.compiler.formats.netx.reader import RECURRENT, integers_of, read_netx
from spikeloom.compiler.formats.sensor_layout import sensor_layout
from spikeloom.compiler.targets.loihi1.integers import run_integer, verify
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.loihi1 import engine

W = np.full((4, 6), 2)


def recurrent(**more):
    return dense(W) | {"type": ["dense_rec"]} | more


def of_type(kind):
    return [given_input(6), dense(W) | {"type": [kind]}]


REFUSED = [
    ("0 (dense): weight holds 0.5, allowed are whole numbers", [dense(W / 4)]),
    ("0 (dense): has weights from 300 to 300, allowed are -256", [dense(W * 150)]),
    ("0 (dense): has biases up to 5000, allowed are 4095 steps", [dense(W, bias=[5000] * 4)]),
    ("0 (dense): weight has the shape [4, 6], wanted [6, 6]", [dense(W, shape=[6])]),
    ("0 (dense): has synaptic delays", [dense(W, delay=np.array([0, 0, 3, 0]))]),
    ("0 (dense): iDecay is 0, allowed are 1 to 4096", [dense(W, neuron=neuron(u=0))]),
    ("0 (dense): vThMant is 131072, allowed are 0 to 131071", [dense(W, neuron=neuron(threshold=2**17))]),
    ("0 (dense): wgtExp is 1, allowed is 0", [dense(W, neuron=neuron(wgtExp=1))]),
    ("0 (dense): has neurons of type 'SDNN', allowed are CUBA", [dense(W, neuron=neuron(kind="SDNN"))]),
    ("0 (dense_rec): weight_rec has the shape [4, 6], wanted [4, 4]", [recurrent(weight_rec=W)]),
    ("0 (recurrent): has no recWeight", [recurrent(weight_rec=np.eye(4), type=["recurrent"])]),
    ("0 (recurrent): refDelay is 2", [recurrent(type=["recurrent"], neuron=neuron(refDelay=2))]),
    ("0 (conv): the shape of its input is nowhere", [{"type": ["conv"], "shape": [1, 2, 2]}]),
    (
        "1 (conv): gives [2, 4, 5], the file says [2, 5, 4]",
        [given_input(2, 5, 6), conv(np.full((2, 2, 2, 2), 2), (2, 5, 4))],
    ),
    *[
        (f"1 ({kind}): is of a type that has no place", of_type(kind))
        for kind in ("pool", "average", "strange")
    ],
]
REFUSED = [(f"layer {words}", layers) for words, layers in REFUSED]
REFUSED += [("has no layers, so it is no netx file", []), ("has no layer of neurons", [given_input(6)])]


@pytest.mark.parametrize(("words", "layers"), REFUSED, ids=[words for words, _ in REFUSED])
def test_files_that_cannot_be_used(tmp_path, words, layers):
    refused(ModelError, f"{tmp_path}/bad.net: {words}", read_netx, write(tmp_path / "bad.net", *layers))


def lif(weight, bias, spikes, *, u=4096, v=1024, threshold=25, own=None):
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


def require(network, given_, *layers):
    """The spikes of each layer of a network are these."""
    verify(network)
    for ours, wanted in zip(run_integer(network, given_[None]).spikes, layers, strict=True):
        assert wanted.sum() > 10
        assert_array_equal(ours[0], wanted)


def test_dense_blocks(tmp_path):
    rng = np.random.default_rng(0)
    first, last, bias = even(rng, 12, 6), even(rng, 5, 12), even(rng, 12, most=20)
    block = dense(last, neuron=neuron(u=1024, v=128, threshold=80, kind="LOIHI", wgtExp=0, theta=1600))
    path = write(tmp_path / "a.net", dense(first, bias=bias), block, simulation={"Ts": 1, "tSample": 64})
    found = read_netx(path)
    given_ = events(rng, 6)
    hidden = lif(first, bias, given_)
    require(found.network, given_, hidden, lif(last, 0, hidden, u=1024, v=128, threshold=80))
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
    flat = sums.reshape(len(sums), -1).astype(np.int64)
    hidden = lif(np.eye(flat.shape[1], dtype=int), np.repeat(bias, np.prod(shape[1:])), flat)
    require(found, given_[:, positions], hidden, lif(last, 0, hidden))


def test_an_input_block_with_neurons_is_a_layer(tmp_path):
    rng = np.random.default_rng(2)
    weight = even(rng, 3, 6)
    block = given_input(6) | {"weight": np.array([36.0]), "bias": np.array([4.0]), "neuron": neuron()}
    found = read_netx(write(tmp_path / "a.net", block, dense(weight)))
    assert "it turns events into currents" in found.facts[2]
    given_ = events(rng, 6)
    hidden = lif(36 * np.eye(6, dtype=int), 4, given_)
    require(found.network, given_, hidden, lif(weight, 0, hidden))


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


@pytest.mark.parametrize(("kind", "entry"), [*RECURRENT.items()])
@pytest.mark.parametrize("most", [60, 127, 250])
def test_a_recurrent_block(tmp_path, most, kind, entry):
    rng = np.random.default_rng(8)
    first, own, last = even(rng, 12, 6), rng.integers(-most, most + 1, (12, 12)), even(rng, 5, 12)
    block = dense(first) | {"type": [kind], entry: own.astype(np.float32)}
    found = read_netx(write(tmp_path / "a.net", block, dense(last)))
    given_ = events(rng, 6)
    hidden = lif(first, 0, given_, own=own)
    assert np.count_nonzero(hidden != lif(first, 0, given_)) > 20
    require(found.network, given_, hidden, lif(last, 0, hidden))
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
    tree, _ = hdf5.read_hdf5(path, "netx file")
    del tree["layer"]["0"]["neuron"]  # the recording starts behind the input layer
    network, _ = integers_of(tree, 3)
    _, positions, _ = sensor_layout((3, 16, 16), polarities=3)

    def spikes(name, size):
        return np.load(recorded(f"gts/tinynet/{name}.npy"))[0].reshape(size, 16).T > 0

    given_, hidden, out = spikes("input", 768)[:, positions], spikes("layer1", 864), spikes("output", 36)
    ours = run_integer(network, given_[None, 1:]).spikes  # a layer starts a step after the one before it
    assert hidden.sum() > 1000
    assert_array_equal(ours[0][0], hidden[1:])
    assert_array_equal(ours[1][0], out[1:])
