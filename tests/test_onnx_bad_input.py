"""ONNX files that cannot be lowered or trusted: one clear line each, exit code 2, nothing written; and fuzzed ones."""

from collections import Counter

import numpy as np
import pytest
import torch
from fuzzed_onnx import faulty
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_modules import exported
from made_onnx import CONSTANTS, STAGE, STATE_IN, model, neuron, node, scanned, two_layers
from onnx import ModelProto, TensorProto, helper

from spikeloom.compiler.errors import SpikeloomError
from spikeloom.compiler.formats.onnx import file as onnx_file
from spikeloom.compiler.formats.onnx.reader import read_onnx
from spikeloom.models.networks.lif import LIF
from spikeloom.runtime import cli

AFFINE = "is not affine in its input"
INPUTS = [("x", [1, 4]), *STATE_IN[:2]]


@pytest.fixture
def refusal(tmp_path, monkeypatch, capsys):
    """Compile a file that must be refused; returns its only line after the file's name."""
    monkeypatch.chdir(tmp_path)

    def compile_bytes(content, *words, name="net.onnx"):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        before = sorted(path.name for path in tmp_path.rglob("*"))
        code = cli.main(["compile", name, *words, "-o", "out.loom"])
        out, err = capsys.readouterr()
        assert (code, out) == (2, "")
        assert err.count("\n") == 1, err
        assert sorted(path.name for path in tmp_path.rglob("*")) == before
        return err.removeprefix("spikeloom: ").removesuffix("\n").removeprefix(f"{name}: ")

    return compile_bytes


def with_stage(*nodes, result="stage", domains=(), **constants):
    """One layer whose current goes through some more operators."""
    every = [*STAGE, *nodes, *neuron(0, result)]
    return model(every, INPUTS, ["s0_new", "u0_new"], constants, domains=domains)


def one_neuron(*nodes, outputs=("s0_new", "u0_new"), inputs=(), theta="theta", **constants):
    """A layer whose membrane the nodes make from u0, s0 and the current."""
    fire = [node("Greater", f"u0_new {theta}", "hot"), node("Cast", "hot", "s0_new", to=1)]
    return model([*STAGE, *nodes, *fire], [*INPUTS, *inputs], outputs, constants)


def plain(*more, spelling="product", inputs=INPUTS, outputs=("s0_new", "u0_new"), **constants):
    """A good layer, with more nodes or other constants."""
    return model([*STAGE, *neuron(0, "current", spelling), *more], inputs, outputs, constants)


def changed(change):
    """The file of two layers, changed."""
    proto = ModelProto.FromString(two_layers())
    change(proto.graph.initializer[0], proto)
    return proto.SerializeToString()


def one(op, inputs="current", **attributes):
    """A stage of one operator."""
    return lambda: with_stage(node(op, inputs, "stage", **attributes))


RESET = node("Mul", "u0 beta", "d"), node("Sub", "one s0", "q"), node("Mul", "d q", "k")
SUM = node("Add", "k current", "u0_new")

REFUSED = [
    # operators
    *[(f"node stage ({op}): {AFFINE}", one(op)) for op in ("Relu", "Softmax")],
    (f"node stage (MaxPool): {AFFINE}", one("MaxPool", "current", kernel_shape=[1])),
    (f"node stage (Div): {AFFINE}", one("Div", "one current")),
    (f"node stage (Mul): multiplies x by x, so it {AFFINE}", one("Mul", "x x")),
    (f"node stage (Cast): rounds its input to whole numbers, so it {AFFINE}", one("Cast", to=7)),
    ("node stage (Gather): takes indices or sizes from what varies", one("Gather", "w current")),
    ("node stage (LSTM): keeps a state that is no leaky", one("LSTM", "current w w", hidden_size=3)),
    (
        f"node stage (MatMul): {AFFINE}",
        lambda: with_stage(node("Transpose", "current", "t", perm=[1, 0]), node("MatMul", "current t", "stage")),
    ),
    (
        "node stage (Strange): is of the domain my.own, allowed are the",
        lambda: with_stage(helper.make_node("Strange", ["current"], ["stage"], domain="my.own"), domains=["my.own"]),
    ),
    (
        "node odd (Softmax): is computed from constants by an operator",
        lambda: with_stage(node("Softmax", "b", "odd"), node("Add", "current odd", "stage")),
    ),
    (
        "node stage (Reshape): cannot be evaluated (cannot reshape",
        lambda: with_stage(node("Reshape", "current seven", "stage"), seven=np.array([7])),
    ),
    (
        "node huge (Expand): makes 3000000000000 values or",
        lambda: with_stage(
            node("Expand", "current big", "huge"),
            node("ReduceSum", "huge axis", "stage"),
            big=np.array([10**12, 1]),
            axis=np.array([0]),
        ),
    ),
    (
        "node odd (Greater): compares two values that both vary",
        lambda: one_neuron(
            *RESET,
            node("Add", "k current", "u0_sum"),
            node("Greater", "u0_sum u0", "odd"),
            node("Cast", "odd", "odd_s", to=1),
            node("Add", "u0_sum odd_s", "u0_new"),
        ),
    ),
    # neurons
    ("node u0_new (Add): loses 0.5 for a spike of s0, a reset by", lambda: plain(spelling="subtract")),
    (
        "node u0_new (Add): takes the membrane of u0 as a state, and no",
        lambda: one_neuron(*RESET, SUM, outputs=("s0_new",)),
    ),
    (
        "node u0_new (Add): mixes or weighs the neurons of u0",
        lambda: one_neuron(node("Mul", "u0 betas", "d"), *RESET[1:], SUM, betas=np.array([0.1, 0.2, 0.3], np.float32)),
    ),
    (
        "node u0_new (Add): keeps 0.5 of a membrane and 0.3 of it after",
        lambda: one_neuron(
            node("Mul", "u0 s0", "p"),
            node("Mul", "p beta", "d"),
            node("Mul", "u0 half", "h"),
            node("Sub", "h d", "k"),
            SUM,
            half=np.array(0.5, np.float32),
        ),
    ),
    (
        "node u0_new (Add): has thresholds from 0.5 to 1 in one layer",
        lambda: one_neuron(*RESET, SUM, theta="thetas", thetas=np.array([0.5, 0.5, 1.0], np.float32)),
    ),
    (
        "node u0_new (Add): takes the state s0 of a layer as its input,",
        lambda: one_neuron(
            *RESET,
            node("MatMul", "s0 v", "again"),
            node("Add", "current again", "both"),
            node("Add", "k both", "u0_new"),
            v=np.arange(9, dtype=np.float32).reshape(3, 3),
        ),
    ),
    (
        "node u0_new (Add): 2 inputs are no state of a neuron: x (4), y",
        lambda: one_neuron(
            *RESET, node("Add", "current y", "both"), node("Add", "k both", "u0_new"), inputs=[("y", [1, 3])]
        ),
    ),
    ("holds no spiking layer: no membrane is compared with a", lambda: model(STAGE, [("x", [1, 4])], ["current"])),
    (
        "node current (Gemm): keeps no membrane from step to step, so",
        lambda: model(
            [*STAGE, node("Greater", "current theta", "hot"), node("Cast", "hot", "s0_new", to=1)],
            [("x", [1, 4])],
            ["s0_new"],
        ),
    ),
    (
        "outputs u0_new, s0_also: none counts the spikes of the last",
        lambda: plain(
            node("Neg", "s0_new", "s0_also"), spelling="where", inputs=INPUTS[:2], outputs=["u0_new", "s0_also"]
        ),
    ),
    (
        "node u0_new (Add): is compared in several ways, which is no",
        lambda: plain(
            node("Greater", "u0_new one", "hotter"),
            node("Cast", "hotter", "more", to=1),
            outputs=["s0_new", "u0_new", "more"],
        ),
    ),
    ("layer layer1: keeps 1.5 of its membrane in a step, allowed", lambda: plain(beta=np.array(1.5, np.float32))),
    ("layer layer1: has the threshold -0.5, allowed are", lambda: plain(theta=np.array(-0.5, np.float32))),
    ("node u0_new (Add): has coefficients that are not finite", lambda: plain(w=np.full((4, 3), np.nan, np.float32))),
    ("node end0 (Scan): runs backwards in time", lambda: scanned(reverse=True)),
    # files
    ("holds no graph, so it is not an ONNX file", lambda: b""),
    ("is not an ONNX file, or is truncated", lambda: b"PK\x03\x04 not at all"),
    ("no such file", lambda: None),
    ("operators of version 99, allowed are", lambda: changed(lambda _, m: setattr(m.opset_import[0], "version", 99))),
    ("(Nodes in a graph must be topologically sorted, however input 'nobody'", one("Add", "current nobody")),
    ("too small for the declared shape", lambda: changed(lambda w, _: w.dims.__setitem__(0, 2 * 10**12))),
    ("tensor w: cannot be read", lambda: changed(lambda w, _: w.dims.__setitem__(0, 2))),
    ("tensor w: has element type 16", lambda: changed(lambda w, _: setattr(w, "data_type", TensorProto.BFLOAT16))),
    ("makes 1000000000000 values or", lambda: plain(inputs=[("x", [10**6, 10**6]), *STATE_IN[:2]])),
    ("input x: has an open size 'taxels', allowed", lambda: plain(inputs=[("x", [1, "taxels"]), *STATE_IN[:2]])),
]


@pytest.mark.parametrize(("words", "made"), REFUSED, ids=[words for words, _ in REFUSED])
def test_one_line_says_where_and_why(refusal, words, made):
    assert words in refusal(made())


def test_limits_of_files(refusal, monkeypatch):
    monkeypatch.setattr(onnx_file, "NODE_LIMIT", 5)
    assert "has more than 5 nodes" in refusal(two_layers())
    monkeypatch.setattr(onnx_file, "SIZE_LIMIT", 100)
    assert "more than 100 bytes, the limit of a network" in refusal(two_layers())


def beside(location, **more):
    """A file whose first tensor lies elsewhere."""

    def change(tensor, _):
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        for key, text in {"location": location, **more}.items():
            entry = tensor.external_data.add()
            entry.key, entry.value = key, str(text)

    return changed(change)


@pytest.mark.parametrize(
    ("location", "more", "words"),
    [
        ("../secret.bin", {}, "'../secret.bin'"),
        ("/etc/passwd", {}, "'/etc/passwd'"),
        ("link.bin", {}, "symbolic link"),
        ("gone.bin", {}, "'gone.bin'"),
        ("few.bin", {"length": 48}, "exceeds available data (8 bytes"),
        ("large.bin", {}, "more than 10000 bytes, the limit of a network"),
        ("few.bin", {}, "raw_data size (8 bytes) is too small"),
    ],
)
def test_data_beside_the_file(refusal, tmp_path, monkeypatch, location, more, words):
    monkeypatch.setattr(onnx_file, "SIZE_LIMIT", 10_000)
    folder = tmp_path / "inner"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(bytes(48))
    (folder / "few.bin").write_bytes(bytes(8))
    (folder / "large.bin").write_bytes(bytes(10_001))
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    assert words in refusal(beside(location, **more), name="inner/net.onnx")


def test_data_beside_the_file_that_is_right(tmp_path):
    (tmp_path / "w.bin").write_bytes(b"head" + CONSTANTS["w"].tobytes())
    (tmp_path / "net.onnx").write_bytes(beside("w.bin", offset=4, length=48))
    (tmp_path / "whole.onnx").write_bytes(two_layers())
    found, whole = (read_onnx(tmp_path / name) for name in ("net.onnx", "whole.onnx"))
    assert np.array_equal(found.network.projections[0].weight.toarray(), whole.network.projections[0].weight.toarray())
    assert found.sha256 != whole.sha256


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--beta", "0.3"], "--beta: is for checkpoints, the ONNX file net.onnx holds all"),
        (["--polarities", "0"], "--polarities 0: allowed are numbers from 1"),
        (["--polarities", "3"], "the input [1, 4] is no whole number of taxels with 3"),
    ],
)
def test_options(refusal, words, line):
    assert line in refusal(two_layers(), *words)


class Drifting(torch.nn.Module):
    """Steps with weights of their own."""

    def __init__(self):
        super().__init__()
        self.linear, self.lif = torch.nn.Linear(4, 3), LIF()

    def forward(self, x):
        return sum(self.lif(self.linear(x[..., step]) * (step + 1)) for step in range(3))


def test_steps_that_differ(refusal):
    content = exported(Drifting(), (torch.zeros(1, 4, 3),))
    assert "step 1 differs from step 0 in weights, bias, decay or threshold" in refusal(content)


def outcome(path, content):
    """How reading ends: fine, or with one line."""
    path.write_bytes(content)
    said = ""
    try:
        read_onnx(path)
    except SpikeloomError as error:
        said = str(error)
    assert "\n" not in said
    assert not said or said.startswith(f"{path}: ")
    return ("node" if ": node " in said else "other") if said else "read"


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**64 - 1), st.binary(max_size=200))
def test_fuzzed_files(tmp_path, seed, content):
    outcome(tmp_path / "net.onnx", faulty(seed))
    assert outcome(tmp_path / "net.onnx", content) == "other"


def test_the_fuzzer_reaches_far(tmp_path):
    """Its files are neither all refused at the door nor all unharmed."""
    found = Counter(outcome(tmp_path / "net.onnx", faulty(seed)) for seed in range(200))
    assert min(found[kind] for kind in ("read", "node", "other")) > 10, found
    assert faulty(7) == faulty(7)
