"""``.net`` files that cannot be used: one line each."""

import numpy as np
import pytest
from made_netx import conv, dense, given_input, neuron, write

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.runtime.cli import main


def line(tmp_path, *layers, **more):
    path = write(tmp_path / "bad.net", *layers, **more)
    with pytest.raises(ModelError) as caught:
        read_netx(path)
    return str(caught.value).removeprefix(f"{path}: ")


W = np.full((4, 6), 2)


@pytest.mark.parametrize(
    ("block", "said"),
    [
        (
            dense(W / 4),
            "layer 0 (dense): weight holds 0.5, allowed are whole numbers",
        ),
        (
            dense(W * 150),
            "layer 0 (dense): has weights from 300 to 300, allowed are -256",
        ),
        (dense(W, bias=[5000] * 4), "layer 0 (dense): has biases up to 5000, allowed are 4095 steps"),
        (
            dense(W, bias=[1, 2]),
            "layer 0 (dense): bias has 2 values for 4 neurons",
        ),
        (
            dense(W, shape=[6]),
            "layer 0 (dense): weight has the shape [4, 6], wanted [6, 6]",
        ),
        (dense(W, shape=[0]), "layer 0 (dense): has the shape [0], which is none"),
        (
            dense(W, delay=np.array([0, 0, 3, 0])),
            "layer 0 (dense): has synaptic delays, allowed are none here",
        ),
        (
            dense(W, neuron=neuron(u=0)),
            "layer 0 (dense): has iDecay 0 and vDecay 1024, allowed are 1",
        ),
        (
            dense(W, neuron=neuron(threshold=2**17)),
            "layer 0 (dense): vThMant is 131072, allowed are 0 to 131071",
        ),
        (dense(W, neuron=neuron(refDelay=2)), "layer 0 (dense): refDelay is 2, allowed is 1"),
        (dense(W, neuron=neuron(wgtExp=1)), "layer 0 (dense): wgtExp is 1, allowed is 0"),
        (
            dense(W, neuron=neuron(kind="SDNN")),
            "layer 0 (dense): has neurons of type 'SDNN', allowed are CUBA",
        ),
        (
            dense(W, neuron=neuron(gradedSpike=True)),
            "layer 0 (dense): sends graded spikes, which Loihi 1 does not",
        ),
        (
            {key: value for key, value in dense(W).items() if key != "neuron"},
            "layer 0 (dense): has no neuron, so its membranes are the",
        ),
        (
            dense(W) | {"type": ["dense_rec"]},
            "layer 0 (dense_rec): has no weight_rec",
        ),
        (
            dense(W) | {"type": ["dense_rec"], "weight_rec": W},
            "layer 0 (dense_rec): weight_rec has the shape [4, 6], wanted",
        ),
        (
            {"type": ["conv"], "shape": [1, 2, 2]},
            "layer 0 (conv): the shape of its input is nowhere, wanted is a",
        ),
    ],
)
def test_blocks_that_cannot_be_used(tmp_path, block, said):
    assert said in line(tmp_path, block)


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("pool", "pools, which netx itself does not load"),
        ("average", "averages spikes into numbers"),
        ("concat", "joins layers that lie differently deep"),
    ],
)
def test_types_without_a_place(tmp_path, kind, why):
    block = dense(W) | {"type": [kind]}
    said = f"layer 1 ({kind}): {why}"
    assert said in line(tmp_path, given_input(6), block)


def test_structure(tmp_path):
    assert "has no layers, so it is no netx file" in line(tmp_path, other={"a": 1})
    said = "layer 1 (strange): is of a type that is not known, allowed are"
    assert said in line(tmp_path, given_input(6), dense(W) | {"type": ["strange"]})
    assert "has no layer of neurons" in line(tmp_path, given_input(6))
    kernel = np.full((2, 2, 2, 2), 2)
    said = "layer 1 (conv): gives [2, 4, 5], the file says [2, 5, 4]"
    assert said in line(tmp_path, given_input(2, 5, 6), conv(kernel, (2, 5, 4)))
    said = "layer 1 (dense): weight has the shape [4, 6], wanted [4, 8]"
    assert said in line(tmp_path, given_input(8), dense(W))
    own = {"taxels": 3, "polarities": 2, "clocks": 0, "clock_steps": 1, "label": np.zeros(3, int)}
    said = "group spikeloom is for 6 inputs and 3 voting neurons, the"
    assert said in line(tmp_path, dense(W), spikeloom=own)


def test_files_that_are_none(tmp_path, capsys):
    def said(path, *words):
        assert main(["compile", str(path), *words, "-o", str(tmp_path / "x.loom")]) == 2
        return capsys.readouterr().err

    good = write(tmp_path / "a.net", dense(W))
    cut = tmp_path / "cut.net"
    cut.write_bytes(good.read_bytes()[:3000])
    assert f"spikeloom: {cut}: is truncated or damaged (OSError)" in said(cut)
    assert f"spikeloom: --weight-bits: is for float networks, {good}" in said(good, "--weight-bits", "4")
    assert "spikeloom: --optimize: weighs layouts by what a float network" in said(good, "--optimize", "energy")
    assert f"spikeloom: --graph: is for checkpoints, the netx file {good} holds all it needs" in said(
        good, "--graph", "manual"
    )
    words = ["verify", str(tmp_path / "x.loom"), "--checkpoint", str(good), "--data", "synthetic"]
    assert main(["compile", str(good), "-o", str(tmp_path / "x.loom")]) == 0
    capsys.readouterr()
    assert main(words) == 2
    assert f"spikeloom: {good}: holds integers, no float network to" in capsys.readouterr().err
