"""Netlists as lava-dl's ``.net`` files, within their limits."""

import json
from itertools import pairwise

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_netx import dense, even, events, neuron, write
from numpy.testing import assert_array_equal
from random_networks import chain
from timed_networks import written

from spikeloom.compiler import Options, Recipe, compile_network, lift
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.netx import writer as netx_export
from spikeloom.compiler.formats.netx.layout import blocks_of
from spikeloom.compiler.formats.netx.reader import integers_of, read_netx
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.runtime.cli import main

SETTINGS = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@st.composite
def whole_networks(draw):
    """Networks that the format holds as they are."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sizes = draw(st.lists(st.integers(1, 6), min_size=2, max_size=4))
    blocks = [
        dense(
            even(rng, rows, columns, most=draw(st.sampled_from([4, 60, 254]))),
            bias=rng.integers(-30, 31, rows),
            neuron=neuron(
                u=draw(st.sampled_from([4096, 1024, 1])),
                v=draw(st.integers(0, 4095)),
                threshold=draw(st.integers(1, 300)),
            ),
        )
        for columns, rows in pairwise(sizes)
    ]
    for block in draw(st.lists(st.sampled_from(blocks), unique_by=id)):
        neurons = block["outFeatures"]
        block |= {"type": ["dense_rec"], "weight_rec": even(rng, neurons, neurons).astype(np.float32)}
    return blocks, rng


@SETTINGS
@given(whole_networks())
def test_what_the_format_holds_comes_back_exactly(drawn):
    blocks, rng = drawn
    tree = {"layer": {str(i): _as_read(block) for i, block in enumerate(blocks)}}
    network, _ = integers_of(blocks_of(tree), tree, 1)
    made = netx_export.blocks_for(network)
    assert not any(block.rounded or block.threshold_rounded or block.shift for block in made)
    written_ = netx_export.tree_of(network, made)
    again, _ = integers_of(blocks_of(written_), written_)
    for ours, back in zip(network.projections, again.projections, strict=True):
        assert_array_equal(ours.effective().toarray(), back.effective().toarray())
    for ours, back in zip(network.populations, again.populations, strict=True):
        for name in ("decay_u", "decay_v", "threshold", "bias"):
            assert_array_equal(getattr(ours, name), getattr(back, name))
    given_ = events(rng, network.input.size)
    moved = netx_export.moved_spikes(network, made, given_[None])
    assert all(changed == 0 for changed, _ in moved.values())


def _as_read(entries):
    return {
        key: _as_read(value) if isinstance(value, dict) else value if isinstance(value, str) else _leaf(key, value)
        for key, value in entries.items()
    }


def _leaf(key, value):
    return value if key == "type" else np.asarray(value)


def test_written_files_are_laid_out_as_documented(tmp_path):
    netlist = compile_network(chain(np.full((3, 4), 0.3), np.full((2, 3), 0.4), biases=[[0.01] * 3, [0.0] * 2])).netlist
    network = lift(netlist)
    blocks = netx_export.blocks_for(network)
    path = tmp_path / "a.net"
    path.write_bytes(netx_export.file_bytes(netx_export.tree_of(network, blocks)))
    with h5py.File(path) as file:
        assert [file[f"layer/{i}/type"][0] for i in range(3)] == [b"input", b"dense", b"dense"]
        for number, population in enumerate(network.populations, 1):
            block = file[f"layer/{number}"]
            assert block["neuron/type"][()] == b"CUBA"
            assert block["neuron/iDecay"][()] == population.decay_u + 1
            assert block["neuron/vDecay"][()] == population.decay_v
            assert block["neuron/refDelay"][()] == 1
            assert block["weight"].shape == (block["outFeatures"][()], block["inFeatures"][()])
            assert block["shape"][()].tolist() == [population.size]
            weight = block["weight"][()].astype(int)
            assert not np.any(weight % 2)
            assert weight.min() >= -256
            assert weight.max() <= 254
    assert path.read_bytes() == netx_export.file_bytes(netx_export.tree_of(network, blocks))


def run(capsys, *words):
    code = main([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_the_command_counts_what_it_moves(tmp_path, capsys):
    net, out = tmp_path / "g.loom", tmp_path / "g.net"
    assert run(capsys, "compile", "pretrained:grasps", "-o", net)[0] == 0
    code, text, _ = run(capsys, "export", net, "--to", "netx", "-o", out, "--data", "synthetic", "--limit", 8, "--json")
    report = json.loads(text)
    assert (code, report["exact"], report["recordings"]) == (0, False, 8)
    network = lift(read_netlist(net))
    blocks = netx_export.blocks_for(network)
    assert sum(layer["biases_rounded"] for layer in report["layers"]) == sum(block.rounded for block in blocks) > 0
    assert any(layer["spikes_moved"] for layer in report["layers"])
    back = read_netx(out).network
    assert back.input == network.input
    assert_array_equal(back.readout.label, network.readout.label)
    before = out.read_bytes()
    code, _, said = run(capsys, "export", net, "--to", "netx", "-o", out, "--strict")
    assert code == 2
    assert said.startswith(f"spikeloom: --strict: netx cannot hold {net} as it is (conv1: ")
    assert out.read_bytes() == before


def test_strict_writes_what_is_exact(tmp_path, capsys):
    rng = np.random.default_rng(6)
    path = write(tmp_path / "a.net", dense(even(rng, 12, 6), bias=even(rng, 12, most=8)), dense(even(rng, 5, 12)))
    assert run(capsys, "compile", path, "--keep-all", "-o", tmp_path / "a.loom")[0] == 0
    code, text, _ = run(capsys, "export", tmp_path / "a.loom", "--to", "netx", "--strict", "-o", tmp_path / "b.net")
    assert code == 0
    assert text.splitlines()[1] == "biases, thresholds and weights are the netlist's"
    assert run(capsys, "compile", tmp_path / "b.net", "--keep-all", "-o", tmp_path / "b.loom")[0] == 0
    ours, back = (lift(read_netlist(tmp_path / name)) for name in ("a.loom", "b.loom"))
    for one, other in zip(ours.projections, back.projections, strict=True):
        assert_array_equal(one.effective().toarray(), other.effective().toarray())


def test_currents_and_clocks_come_back(tmp_path, capsys):
    written(tmp_path / "net.pt")
    assert run(capsys, "compile", tmp_path / "net.pt", "--graph", "manual", "-o", tmp_path / "net.loom")[0] == 0
    assert run(capsys, "export", tmp_path / "net.loom", "--to", "netx", "-o", tmp_path / "net.net")[0] == 0
    ours, back = lift(read_netlist(tmp_path / "net.loom")), read_netx(tmp_path / "net.net").network
    assert back.input == ours.input
    assert [population.decay_u for population in back.populations] == [p.decay_u for p in ours.populations]


@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        (Recipe(groups=4), "fc1: has 4 thresholds, netx has one for a layer; compile with --scale-groups 1"),
        (Recipe(planes=2), "netx holds 8 bits without an exponent; compile with --planes 1 --weight-bits 8"),
    ],
)
def test_netlists_that_the_format_cannot_hold(recipe, words):
    weight = np.random.default_rng(7).normal(size=(20, 6)) * np.geomspace(0.01, 1, 20)[:, None]
    netlist = compile_network(chain(weight), Options(recipes=[recipe])).netlist
    with pytest.raises(ModelError, match=words):
        netx_export.blocks_for(lift(netlist))
