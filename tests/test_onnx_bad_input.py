"""ONNX files that cannot be lowered or trusted: one clear line each, exit code 2, nothing written."""

import commands
import numpy as np
import pytest
import torch
from made_modules import exported
from made_onnx import CONSTANTS, STAGE, STATE_IN, model, neuron, node, two_layers, value, written
from onnx import ModelProto, TensorProto, helper

from spikeloom.compiler import files
from spikeloom.compiler.formats.onnx import file as onnx_file
from spikeloom.compiler.formats.onnx.reader import read_onnx
from spikeloom.models.networks.lif import LIF

AFFINE = "is not affine in its input"
INPUTS = [("x", [1, 4]), *STATE_IN[:2]]


@pytest.fixture
def refusal(tmp_path, monkeypatch):
    """Compile a file that must be refused; returns its only line after the file's name."""
    monkeypatch.chdir(tmp_path)

    def compile_bytes(content, *words, name="net.onnx"):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        before = sorted(path.name for path in tmp_path.rglob("*"))
        line = commands.refusal("compile", name, *words, "-o", "out.loom")
        assert sorted(path.name for path in tmp_path.rglob("*")) == before
        return line.removeprefix(f"{name}: ")

    return compile_bytes


RESET = "d = Mul(u0, beta); q = Sub(one, s0); k = Mul(d, q)"
FIRE = "hot = Greater(u0_new, theta); s0_new = Cast(hot)"
GOOD = f"{RESET}; u0_new = Add(k, current); {FIRE}"
MORE = {
    "axis": np.array([0]),
    "betas": np.array([0.1, 0.2, 0.3], np.float32),
    "big": np.array([10**12, 1]),
    "thetas": np.array([0.5, 0.5, 1.0], np.float32),
    "yes": np.array(True),
    "v": np.arange(9, dtype=np.float32).reshape(3, 3),
}


def layer(text, inputs=INPUTS, outputs=("s0_new", "u0_new"), **constants):
    """A layer that nodes make from ``u0``, ``s0`` and ``current``."""
    return model([*STAGE, *written(text)], inputs, outputs, MORE | constants)


def with_stage(nodes, domains=()):
    """A good layer whose current goes through some more operators, to ``stage``."""
    every = [*STAGE, *nodes, *neuron(0, "stage")]
    return model(every, INPUTS, ["s0_new", "u0_new"], MORE, domains=domains)


def changed(change):
    """The file of two layers, changed."""
    proto = ModelProto.FromString(two_layers())
    change(proto.graph.initializer[0], proto)
    return proto.SerializeToString()


def looped():
    """The steps of a recording by a loop."""
    body = helper.make_graph([node("Identity", "x", "y")], "step", [value("x", [4])], [value("y", None)])
    scan = node("Scan", "events", "end0", body=body, num_scan_inputs=1)
    return model([scan], [("events", [3, 4])], ["end0"])


def sparse_weights():
    """A layer whose weights are a sparse tensor."""
    proto = ModelProto.FromString(layer(GOOD))
    weights = proto.graph.initializer[0]
    places = helper.make_tensor("", TensorProto.INT64, [12], range(12))
    proto.graph.sparse_initializer.append(helper.make_sparse_tensor(weights, places, [4, 3]))
    del proto.graph.initializer[0]
    return proto.SerializeToString()


BRAIN = helper.make_tensor("w", TensorProto.BFLOAT16, (4, 3), [1] * 12)
STAGES = [
    (f"node stage (Relu): {AFFINE}", "stage = Relu(current)"),
    (f"node stage (Mul): multiplies x by x, so it {AFFINE}", "stage = Mul(x, x)"),
    ("node stage (Gather): takes indices or sizes from what varies", "stage = Gather(w, current)"),
    (
        "node odd (Softmax): is computed from constants by an operator",
        "odd = Softmax(b); stage = Add(current, odd)",
    ),
    (
        "node huge (Expand): makes 3000000000000 values or",
        "huge = Expand(current, big); stage = ReduceSum(huge, axis)",
    ),
    ("sorted, however input 'nobody'", "stage = Add(current, nobody)"),
]
NODES = [
    ("node stage (Einsum): cannot be used", node("Einsum", "current b b", "stage", equation="ij,j,k->ij")),
    (
        f"node stage (Cast): rounds its input to whole numbers, so it {AFFINE}",
        node("Cast", "current", "stage", to=7),
    ),
    (f"node stage (LSTM): {AFFINE}", node("LSTM", "current w w", "stage", hidden_size=3)),
    (
        "node stage (Strange): is of the domain my.own, allowed are the",
        helper.make_node("Strange", ["current"], ["stage"], domain="my.own"),
    ),
    ("node stage (Dropout): is in training mode; export", node("Dropout", "current one yes", "stage")),
]
KEEPS = "k = Mul(u0, beta); m = Add(k, current)"
AFTER = f"{KEEPS}; hot = Greater(m, theta); s0_new = Cast(hot)"
BEFORE = "k = Mul(z, beta); u0_new = Add(k, current); hot = Greater(u0_new, theta); s0_new = Cast(hot)"
ALONE = [("x", [1, 4]), ("u0", [1, 3])]
RESETS = [
    ("m (Add)", f"{AFTER}; p = Mul(s0_new, theta); u0_new = Sub(m, p)"),
    ("m (Add)", f"{AFTER}; y = Sub(m, theta); u0_new = Where(hot, y, m)"),
    ("m (Add)", f"{AFTER}; u0_new = Where(hot, b, m)"),
    ("m (Add)", f"{KEEPS}; hot = Less(m, theta); s0_new = Cast(hot); u0_new = Where(hot, zero, m)"),
    ("u0_new (Add)", f"low = Greater(u0, theta); y = Sub(u0, theta); z = Where(low, y, u0); {BEFORE}"),
]
"""Resets after the spike or before the next step that are none to zero: which operator is named."""

ZEROED = (
    f"q = Greater(u0, theta); d = Mul(u0, beta); k = Where(q, zero, d); u0_new = Add(k, current); {FIRE}"
)
COUNTS = [
    ("m = Mul(n0, beta); n = Add(m, s0_new)", [("n0", [1, 3])]),
    ("n = Sub(s0_new, n0)", [("n0", [1, 3])]),
    ("n = Add(s0_new, u0)", []),
    ("m = MatMul(x, w); n = Add(m, s0_new)", []),
]
"""Sums of spikes and of what is no running count of them."""


def old_pad():
    """A layer on a padded input, as before its sizes were an operand."""
    padded = node("Pad", "wide", "padded", pads=[0, 1, 0, 1])
    every = [padded, node("Gemm", "padded w b", "current"), *neuron(0, "current")]
    return model(every, [("wide", [1, 2]), *STATE_IN[:2]], ["s0_new", "u0_new"], opset=10)


NEURONS = [
    (
        "loses 0.5 for a spike of s0, a reset by",
        GOOD.replace(RESET, "d = Mul(u0, beta); q = Mul(s0, theta); k = Sub(d, q)"),
    ),
    ("mixes or weighs the neurons of u0", GOOD.replace("Mul(u0, beta)", "Mul(u0, betas)")),
    ("has thresholds from 0.5 to 1 in one layer", GOOD.replace("theta", "thetas")),
    (
        "takes the state s0 of a layer as its input,",
        f"again = MatMul(s0, v); both = Add(current, again); {GOOD.replace('k, current', 'k, both')}",
    ),
]

REFUSED = [
    *[
        (f"node {where}: keeps u0, which its spikes do not reset to zero (but by", layer(text, inputs=ALONE))
        for where, text in RESETS
    ],
    (
        "resets u0 at u >= 0.5 and fires at u > 0.5; compare both alike",
        layer(f"low = Less(u0, theta); z = Where(low, u0, zero); {BEFORE}", inputs=ALONE),
    ),
    *[(words, with_stage(written(text))) for words, text in STAGES],
    *[(words, with_stage([made], domains=["my.own"])) for words, made in NODES],
    *[(f"node u0_new (Add): {words}", layer(text)) for words, text in NEURONS],
    ("node u0_new (Add): takes the membrane of u0 as a state, and no", layer(GOOD, outputs=["s0_new"])),
    (
        "node u0_new (Add): 2 inputs are no state of a neuron: x (4), y",
        layer(
            f"both = Add(current, y); {GOOD.replace('k, current', 'k, both')}",
            inputs=[*INPUTS, ("y", [1, 3])],
        ),
    ),
    (
        "node current (Gemm): keeps no membrane from step to step, so",
        layer("hot = Greater(current, theta); s0_new = Cast(hot)", inputs=INPUTS[:1], outputs=["s0_new"]),
    ),
    ("holds no spiking layer: no membrane is compared with a", model(STAGE, INPUTS[:1], ["current"])),
    (
        "layer layer1: keeps 1.5 of its membrane in a step, allowed",
        layer(GOOD, beta=np.array(1.5, np.float32)),
    ),
    (
        "node u0_new (Add): has coefficients that are not finite",
        layer(GOOD, w=np.full((4, 3), np.nan, np.float32)),
    ),
    (
        "all inputs hold 2 recordings; export it with a batch of 1",
        layer(GOOD, inputs=[(name, [2, *shape[1:]]) for name, shape in INPUTS]),
    ),
    (
        "s0_new: ArgMax along axis 0 of [1, 3] is no decision",
        layer(f"{GOOD}; class = ArgMax(s0_new)", outputs=["class", "u0_new", "s0_new"]),
    ),
    *[
        (
            "none counts the spikes of the last layer",
            layer(f"{ZEROED}; {sums}", [*INPUTS[:2], *more], ["n", "u0_new"]),
        )
        for sums, more in COUNTS
    ],
    ("node padded (Pad): is the Pad of operators before version 11", old_pad()),
    ("keeps constants as sparse tensors, which are not read", sparse_weights()),
    ("node end0 (Scan): holds a graph, a loop or a choice", looped()),
    # files
    ("holds no graph, so it is not an ONNX file", b""),
    ("or something else (DecodeError", b"PK\x03\x04 not at all"),
    ("no such file", None),
    ("too small for the declared shape", changed(lambda w, _: w.dims.__setitem__(0, 2 * 10**12))),
    ("tensor w: has element type 16", changed(lambda w, _: w.CopyFrom(BRAIN))),
    ("makes 1000000000000 values or", layer(GOOD, inputs=[("x", [10**6, 10**6]), *STATE_IN[:2]])),
    (
        "input x: has an open size 'taxels', allowed",
        layer(GOOD, inputs=[("x", [1, "taxels"]), *STATE_IN[:2]]),
    ),
]


@pytest.mark.parametrize(("words", "content"), REFUSED, ids=[words for words, _ in REFUSED])
def test_one_line_says_where_and_why(refusal, words, content):
    assert words in refusal(content)


def test_limits_of_files(refusal, monkeypatch):
    monkeypatch.setattr(onnx_file, "NODE_LIMIT", 5)
    assert "has more than 5 nodes" in refusal(two_layers())
    monkeypatch.setattr(files, "SIZE_LIMIT", 100)
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
        ("few.bin", {"length": 48}, "exceeds available data (8 bytes"),
        ("large.bin", {}, "more than 10000 bytes, the limit of a network"),
        ("few.bin", {}, "raw_data size (8 bytes) is too small"),
    ],
)
def test_data_beside_the_file(refusal, tmp_path, monkeypatch, location, more, words):
    monkeypatch.setattr(files, "SIZE_LIMIT", 10_000)
    folder = tmp_path / "inner"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(bytes(48))
    (folder / "few.bin").write_bytes(bytes(8))
    (folder / "large.bin").write_bytes(bytes(10_001))
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    assert words in refusal(beside(location, **more), name="inner/net.onnx")


def test_data_beside_the_file_that_is_right(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "SIZE_LIMIT", 10_000)  # of a file that tensors share each counts its own part
    (tmp_path / "w.bin").write_bytes(b"head" + CONSTANTS["w"].tobytes() + bytes(10_000))
    (tmp_path / "net.onnx").write_bytes(beside("w.bin", offset=4, length=48))
    (tmp_path / "whole.onnx").write_bytes(two_layers())
    found, whole = (read_onnx(tmp_path / name) for name in ("net.onnx", "whole.onnx"))
    assert np.array_equal(
        found.network.projections[0].weight.toarray(), whole.network.projections[0].weight.toarray()
    )
    assert found.sha256 != whole.sha256


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
