"""``.net`` files that cannot be used: one line each."""

import numpy as np
import pytest
from made_netx import conv, dense, given_input, neuron, write

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.runtime.cli import main

W = np.full((4, 6), 2)


def recurrent(**more):
    return dense(W) | {"type": ["dense_rec"]} | more


def of_type(kind):
    return [given_input(6), dense(W) | {"type": [kind]}]


OWN = {"taxels": 3, "polarities": 2, "clocks": 0, "clock_steps": 1, "label": np.zeros(3, int)}

REFUSED = [
    ("0 (dense): weight holds 0.5, allowed are whole numbers", [dense(W / 4)]),
    ("0 (dense): has weights from 300 to 300, allowed are -256", [dense(W * 150)]),
    ("0 (dense): has biases up to 5000, allowed are 4095 steps", [dense(W, bias=[5000] * 4)]),
    ("0 (dense): bias has 2 values for 4 neurons", [dense(W, bias=[1, 2])]),
    ("0 (dense): weight has the shape [4, 6], wanted [6, 6]", [dense(W, shape=[6])]),
    ("1 (dense): weight has the shape [4, 6], wanted [4, 8]", [given_input(8), dense(W)]),
    ("0 (dense): has the shape [0], which is none", [dense(W, shape=[0])]),
    ("0 (dense): has synaptic delays", [dense(W, delay=np.array([0, 0, 3, 0]))]),
    ("0 (dense): has iDecay 0 and vDecay 1024, allowed are 1", [dense(W, neuron=neuron(u=0))]),
    ("0 (dense): vThMant is 131072, allowed are 0 to 131071", [dense(W, neuron=neuron(threshold=2**17))]),
    ("0 (dense): refDelay is 2, allowed is 1", [dense(W, neuron=neuron(refDelay=2))]),
    ("0 (dense): wgtExp is 1, allowed is 0", [dense(W, neuron=neuron(wgtExp=1))]),
    ("0 (dense): has neurons of type 'SDNN', allowed are CUBA", [dense(W, neuron=neuron(kind="SDNN"))]),
    ("0 (dense): sends graded spikes", [dense(W, neuron=neuron(gradedSpike=True))]),
    ("0 (dense): has no neuron", [{key: value for key, value in dense(W).items() if key != "neuron"}]),
    ("0 (dense_rec): has no weight_rec", [recurrent()]),
    ("0 (dense_rec): weight_rec has the shape [4, 6], wanted [4, 4]", [recurrent(weight_rec=W)]),
    ("0 (conv): the shape of its input is nowhere", [{"type": ["conv"], "shape": [1, 2, 2]}]),
    (
        "1 (conv): gives [2, 4, 5], the file says [2, 5, 4]",
        [given_input(2, 5, 6), conv(np.full((2, 2, 2, 2), 2), (2, 5, 4))],
    ),
    *[(f"1 ({kind}): is of a type that has no place", of_type(kind)) for kind in ("pool", "average", "strange")],
]


@pytest.mark.parametrize(("words", "layers"), REFUSED, ids=[words for words, _ in REFUSED])
def test_layers_that_cannot_be_used(tmp_path, words, layers):
    with pytest.raises(ModelError) as caught:
        read_netx(write(tmp_path / "bad.net", *layers))
    assert str(caught.value).startswith(f"{tmp_path}/bad.net: layer {words}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("words", "layers", "more"),
    [
        ("has no layers, so it is no netx file", [], {"other": {"a": 1}}),
        ("has no layer of neurons", [given_input(6)], {}),
        ("group spikeloom is for 6 inputs and 3 voting neurons, the", [dense(W)], {"spikeloom": OWN}),
        ("group spikeloom describes no sensor", [dense(W)], {"spikeloom": OWN | {"taxels": 0}}),
        ("group spikeloom describes no sensor", [dense(W)], {"spikeloom": OWN | {"clock_steps": 0}}),
    ],
)
def test_structure(tmp_path, words, layers, more):
    with pytest.raises(ModelError, match=words):
        read_netx(write(tmp_path / "bad.net", *layers, **more))


def test_files_and_options_of_the_command(tmp_path, capsys):
    good, cut, out = write(tmp_path / "a.net", dense(W)), tmp_path / "cut.net", f"{tmp_path}/x.loom"
    cut.write_bytes(good.read_bytes()[:3000])
    assert main(["compile", f"{good}", "-o", out]) == 0
    for words, said in (
        (["compile", f"{cut}"], f"{cut}: is truncated or damaged (OSError)"),
        (["compile", f"{good}", "--weight-bits", "4"], f"--weight-bits: is for float networks, {good}"),
        (["compile", f"{good}", "--optimize", "energy"], "--optimize: weighs layouts by what a float network"),
        (["compile", f"{good}", "--graph", "manual"], f"--graph: is for checkpoints, the netx file {good} holds"),
        (["verify", out, "--checkpoint", f"{good}", "--data", "synthetic"], f"{good}: holds integers, no float"),
    ):
        capsys.readouterr()
        assert main([*words, *(["-o", f"{tmp_path}/y.loom"] if words[0] == "compile" else [])]) == 2
        assert capsys.readouterr().err.startswith(f"spikeloom: {said}")
