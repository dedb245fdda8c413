"""ONNX files that cannot be lowered or trusted: one clear line each, exit code 2, nothing written; and fuzzed ones."""

import time

import numpy as np
import pytest
import torch
from fuzzed_onnx import NUMBERS, faulty
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_modules import exported, one_step
from made_onnx import CONSTANTS, STAGE, STATE_IN, body, model, neuron, node, scanned, two_layers, value
from onnx import ModelProto, TensorProto, helper, numpy_helper

from spikeloom.compiler.errors import SpikeloomError
from spikeloom.compiler.formats.onnx import file as onnx_file
from spikeloom.compiler.formats.onnx.reader import read_onnx
from spikeloom.models.networks.lif import LIF
from spikeloom.runtime import cli

AFFINE = "is not affine in its input; only affine operators between two spiking layers can become synapses"
RESET = (
    "only u <- beta * u * (1 - s) + current, a reset to zero by the spike of the step before, can be lowered to the "
    "chip's neuron"
)
AGAIN = "is truncated or damaged; export it again"


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


def with_stage(*nodes, constants=None, result="stage", inputs=(), domains=()):
    """One layer whose current goes through some more operators."""
    rest = [*nodes, *neuron(0, result)]
    states = [("x", [1, 4]), *STATE_IN[:2], *inputs]
    return model([*STAGE, *rest], states, ["s0_new", "u0_new"], constants, domains=domains)


def changed(content, change):
    proto = ModelProto.FromString(content)
    change(proto)
    return proto.SerializeToString()


def one_neuron(*nodes, outputs=("s0_new", "u0_new"), inputs=(), constants=None):
    """A layer whose membrane the nodes make from u0, s0 and the current."""
    fire = [node("Greater", "u0_new theta", "hot"), node("Cast", "hot", "s0_new", to=1)]
    return model([*STAGE, *nodes, *fire], [("x", [1, 4]), *STATE_IN[:2], *inputs], outputs, constants)


PRODUCT = (node("Mul", "u0 beta", "d"), node("Sub", "one s0", "q"), node("Mul", "d q", "k"))
HALF, THIRD = {"half": np.array(0.5, np.float32)}, {"betas": np.array([0.1, 0.2, 0.3], np.float32)}
RAGGED = {"thetas": np.array([0.5, 0.5, 1.0], np.float32)}
SQUARE = {"v": np.eye(3, dtype=np.float32)}


STAGES = {
    f"node stage (Relu): {AFFINE}": lambda: with_stage(node("Relu", "current", "stage")),
    f"node stage (Sigmoid): {AFFINE}": lambda: with_stage(node("Sigmoid", "current", "stage")),
    f"node stage (Softmax): {AFFINE}": lambda: with_stage(node("Softmax", "current", "stage")),
    f"node stage (Mul): multiplies x by x, so it {AFFINE}": lambda: with_stage(
        node("Mul", "x x", "square"), node("MatMul", "square w", "other"), node("Mul", "x x", "stage")
    ),
    f"node stage (MatMul): {AFFINE}": lambda: with_stage(
        node("Transpose", "current", "turned", perm=[1, 0]), node("MatMul", "current turned", "stage")
    ),
    f"node stage (Max): {AFFINE}": lambda: with_stage(node("Max", "current zero", "stage")),
    f"node stage (Div): {AFFINE}": lambda: with_stage(node("Div", "one current", "stage")),
    f"node stage (Cast): rounds its input to whole numbers, so it {AFFINE}": lambda: with_stage(
        node("Cast", "current", "stage", to=7)
    ),
    f"node pooled (MaxPool): {AFFINE}": lambda: with_stage(
        node("Unsqueeze", "current axis", "deep"),
        node("MaxPool", "deep", "pooled", kernel_shape=[1]),
        node("Squeeze", "pooled axis", "stage"),
        constants={"axis": np.array([1])},
    ),
    "node stage (Gather): takes indices or sizes from what varies": lambda: with_stage(
        node("Gather", "w current", "stage")
    ),
    "node stage (LSTM): keeps a state that is no leaky": (
        lambda: with_stage(node("LSTM", "current w w", "stage", hidden_size=3))
    ),
    "node stage (Strange): is an operator that is not known here": lambda: with_stage(
        node("Strange", "current", "stage")
    ),
    "node stage (Strange): is of the domain my.own, allowed are the": lambda: with_stage(
        helper.make_node("Strange", ["current"], ["stage"], name="stage", domain="my.own"), domains=["my.own"]
    ),
    "node stage (Strange): is computed from constants by an": lambda: with_stage(
        node("Strange", "beta", "stage"), node("Add", "current stage", "sum"), result="sum"
    ),
    "node stage (Reshape): cannot be evaluated (cannot reshape": (
        lambda: with_stage(node("Reshape", "current seven", "stage"), constants={"seven": np.array([7])})
    ),
    "node huge (Expand): makes 3000000000000 values or": (
        lambda: with_stage(
            node("Expand", "current big", "huge"),
            node("ReduceSum", "huge axis", "stage"),
            constants={"big": np.array([10**12, 1]), "axis": np.array([0])},
        )
    ),
    "node back (Identity): needs its own result, a cycle": lambda: with_stage(
        node("Add", "current back", "stage"), node("Identity", "stage", "back")
    ),
    "node stage (Add): reads nobody, which nothing makes": lambda: with_stage(node("Add", "current nobody", "stage")),
    "node stage (Relu): makes stage again, each value is made once": lambda: with_stage(
        node("Add", "current one", "stage"), node("Relu", "current", "stage")
    ),
    "node odd (Greater): compares two values that both vary": lambda: one_neuron(
        *PRODUCT,
        node("Add", "k current", "u0_sum"),
        node("Greater", "u0_sum u0", "odd"),
        node("Cast", "odd", "odd_s", to=1),
        node("Add", "u0_sum odd_s", "u0_new"),
    ),
}

NEURONS = {
    "node u0_new (Add): loses 0.5 for a spike of s0, a reset by": lambda: model(
        [*STAGE, *neuron(0, "current", "subtract")], [("x", [1, 4]), *STATE_IN[:2]], ["s0_new", "u0_new"]
    ),
    "node u0_new (Add): takes the membrane of u0 as a state, and no": (
        lambda: one_neuron(*PRODUCT, node("Add", "k current", "u0_new"), outputs=("s0_new",))
    ),
    "node u0_new (Add): mixes or weighs the neurons of u0": lambda: one_neuron(
        node("Mul", "u0 betas", "d"), *PRODUCT[1:], node("Add", "k current", "u0_new"), constants=THIRD
    ),
    "node u0_new (Add): keeps 0.5 of a membrane and 0.3 of it after": lambda: one_neuron(
        node("Mul", "u0 s0", "p"),
        node("Mul", "p beta", "d"),
        node("Mul", "u0 half", "h"),
        node("Sub", "h d", "k"),
        node("Add", "k current", "u0_new"),
        constants=HALF,
    ),
    "node u0_new (Add): has thresholds from 0.5 to 1 in one layer": lambda: model(
        [
            *STAGE,
            *PRODUCT,
            node("Add", "k current", "u0_new"),
            node("Greater", "u0_new thetas", "hot"),
            node("Cast", "hot", "s0_new", to=1),
        ],
        [("x", [1, 4]), *STATE_IN[:2]],
        ["s0_new", "u0_new"],
        RAGGED,
    ),
    "node u0_new (Add): takes the state s0 of a layer as its input,": lambda: one_neuron(
        *PRODUCT,
        node("MatMul", "s0 v", "again"),
        node("Add", "current again", "both"),
        node("Add", "k both", "u0_new"),
        constants={"v": np.arange(9, dtype=np.float32).reshape(3, 3)},
    ),
    "node u0_new (Add): 2 inputs are no state of a neuron: x (4), y": lambda: one_neuron(
        *PRODUCT,
        node("Add", "current y", "both"),
        node("Add", "k both", "u0_new"),
        inputs=[("y", [1, 3])],
    ),
    "holds no spiking layer: no membrane is compared with a": lambda: model(STAGE, [("x", [1, 4])], ["current"]),
    "node current (Gemm): keeps no membrane from step to step, so": lambda: model(
        [*STAGE, node("Greater", "current theta", "hot"), node("Cast", "hot", "s0_new", to=1)],
        [("x", [1, 4])],
        ["s0_new"],
    ),
    "outputs u0_new, s0_also: none counts the spikes of the last": lambda: model(
        [*STAGE, *neuron(0, "current", "where"), node("Neg", "s0_new", "s0_also")],
        [("x", [1, 4]), ("u0", [1, 3])],
        ["u0_new", "s0_also"],
    ),
    "node u0_new (Add): is compared in several ways, which is no": lambda: model(
        [
            *STAGE,
            *neuron(0, "current"),
            node("Greater", "u0_new one", "hotter"),
            node("Cast", "hotter", "more", to=1),
        ],
        [("x", [1, 4]), *STATE_IN[:2]],
        ["s0_new", "u0_new", "more"],
    ),
    "layer layer1: keeps 1.5 of its membrane in a step, allowed are": lambda: model(
        [*STAGE, *neuron(0, "current")],
        [("x", [1, 4]), *STATE_IN[:2]],
        ["s0_new", "u0_new"],
        {"beta": np.array(1.5, np.float32)},
    ),
    "layer layer1: has the threshold -0.5, allowed are numbers": lambda: model(
        [*STAGE, *neuron(0, "current")],
        [("x", [1, 4]), *STATE_IN[:2]],
        ["s0_new", "u0_new"],
        {"theta": np.array(-0.5, np.float32)},
    ),
    "node u0_new (Add): has coefficients that are not finite": lambda: model(
        [*STAGE, *neuron(0, "current")],
        [("x", [1, 4]), *STATE_IN[:2]],
        ["s0_new", "u0_new"],
        {"w": np.full((4, 3), np.nan, np.float32)},
    ),
    "node end0 (Scan): runs backwards in time": lambda: scanned(reverse=True),
}

FILES = {
    "holds no graph, so it is not an ONNX file": lambda: b"",
    f"is not an ONNX file, or {AGAIN}": lambda: b"PK\x03\x04 not at all",
    "has operators of version 99, allowed are 9 to 26": lambda: changed(
        two_layers(), lambda m: setattr(m.opset_import[0], "version", 99)
    ),
    "tensor w: claims 4000000000000 values, the file holds 12": lambda: changed(
        two_layers(), lambda m: m.graph.initializer[0].dims.__setitem__(slice(None), [2 * 10**6, 2 * 10**6])
    ),
    "tensor w: has an impossible shape (-4, 3)": lambda: changed(
        two_layers(), lambda m: m.graph.initializer[0].dims.__setitem__(0, -4)
    ),
    "tensor w: has element type 8, allowed are numbers and truth": lambda: changed(
        two_layers(), lambda m: setattr(m.graph.initializer[0], "data_type", TensorProto.STRING)
    ),
    "tensor w is there twice": lambda: changed(
        two_layers(), lambda m: m.graph.initializer.add().CopyFrom(m.graph.initializer[0])
    ),
    "makes 1000000000000 values or coefficients, allowed are": lambda: model(
        [*STAGE, *neuron(0, "current")], [("x", [10**6, 10**6]), *STATE_IN[:2]], ["s0_new", "u0_new"]
    ),
    "input x: has an open size 'taxels', allowed are fixed ones": lambda: model(
        [*STAGE, *neuron(0, "current")], [("x", [1, "taxels"]), *STATE_IN[:2]], ["s0_new", "u0_new"]
    ),
    "input x: has an open size '?', allowed are fixed ones": lambda: model(
        [*STAGE, *neuron(0, "current")], [("x", [1, None]), *STATE_IN[:2]], ["s0_new", "u0_new"]
    ),
    "output more: nothing makes it": lambda: model(STAGE, [("x", [1, 4])], ["more"]),
}


@pytest.mark.parametrize("line", [*STAGES, *NEURONS, *FILES])
def test_one_line_says_where_and_why(refusal, line):
    made = (STAGES | NEURONS | FILES)[line]
    assert line in refusal(made())


def beside(location, **more):
    """A file whose first tensor lies elsewhere."""

    def change(proto):
        tensor = proto.graph.initializer[0]
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        for key, text in {"location": location, **more}.items():
            entry = tensor.external_data.add()
            entry.key, entry.value = key, str(text)

    return changed(two_layers(), change)


OUTSIDE = ", outside the folder of this file; allowed are files in it, do not trust this one"


@pytest.mark.parametrize(
    ("location", "more", "line"),
    [
        ("../secret.bin", {}, f"tensor w: its data lies in '../secret.bin'{OUTSIDE}"),
        ("/etc/passwd", {}, f"tensor w: its data lies in '/etc/passwd'{OUTSIDE}"),
        ("a/../../b", {}, f"tensor w: its data lies in 'a/../../b'{OUTSIDE}"),
        ("", {}, f"tensor w: its data lies in ''{OUTSIDE}"),
        ("link/secret.bin", {}, f"tensor w: its data lies in 'link/secret.bin'{OUTSIDE}"),
        ("gone.bin", {}, "tensor w: its data lies in 'gone.bin', which is not there"),
        (
            "few.bin",
            {"length": 48},
            "tensor w: its data lies in 'few.bin' beyond its 8 bytes",
        ),
        ("few.bin", {"offset": -1}, "tensor w: its data lies in 'few.bin' beyond its 8 bytes"),
        ("few.bin", {"offset": "x"}, "tensor w: its data lies in 'few.bin' at an unreadable place"),
        ("few.bin", {}, "tensor w: claims 12 values, the file holds 2"),
    ],
)
def test_data_beside_the_file(refusal, tmp_path, location, more, line):
    folder = tmp_path / "inner"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(bytes(48))
    (folder / "few.bin").write_bytes(bytes(8))
    (folder / "link").symlink_to(tmp_path)
    assert line in refusal(beside(location, **more), name="inner/net.onnx")


def test_data_beside_the_file_that_is_right(tmp_path):
    (tmp_path / "w.bin").write_bytes(b"head" + CONSTANTS["w"].tobytes())
    (tmp_path / "net.onnx").write_bytes(beside("w.bin", offset=4, length=48))
    (tmp_path / "whole.onnx").write_bytes(two_layers())
    found, whole = (read_onnx(tmp_path / name) for name in ("net.onnx", "whole.onnx"))
    assert np.array_equal(found.network.projections[0].weight.toarray(), whole.network.projections[0].weight.toarray())
    assert found.sha256 != whole.sha256


def test_a_file_above_the_limit(refusal, monkeypatch):
    monkeypatch.setattr(onnx_file, "SIZE_LIMIT", 100)
    assert "more than 100 bytes, the limit of a network" in refusal(two_layers())


def test_no_file(refusal):
    assert "no such file" in refusal(None, name="none.onnx")


def test_too_many_nodes_and_too_deep_graphs(refusal, monkeypatch):
    monkeypatch.setattr(onnx_file, "NODE_LIMIT", 5)
    assert "has more than 5 nodes" in refusal(two_layers())
    monkeypatch.setattr(onnx_file, "NODE_LIMIT", 1000)
    inside = body()
    for _ in range(9):
        inside = helper.make_graph([node("If", "yes", "out", then_branch=inside)], "deep", [], [value("out", None)])
    content = model([node("If", "yes", "out", then_branch=inside)], [("x", [1, 4])], ["out"], {"yes": np.array(True)})
    assert "has graphs nested deeper than 8" in refusal(content)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["--graph", "manual"],
            "--graph: is for checkpoints, the ONNX file net.onnx holds all",
        ),
        (["--beta", "0.3"], "--beta: is for checkpoints, the ONNX file net.onnx holds all"),
        (["--run", "1"], "--run: is for checkpoints, the ONNX file net.onnx holds all it"),
        (["--polarities", "0"], "--polarities 0: allowed are numbers from 1"),
        (
            ["--polarities", "3"],
            "the input [1, 4] is no whole number of taxels with 3",
        ),
    ],
)
def test_options(refusal, words, line):
    assert line in refusal(two_layers(), *words)


def test_options_of_the_other_kind(refusal):
    line = "--polarities: is for ONNX and NIR files, pretrained:grasps is"
    assert line in refusal(None, "--polarities", "2", name="pretrained:grasps")


def test_unrolled_steps_that_differ(refusal):
    """A network that starts from a membrane of its own, and one whose steps have other weights."""

    class Drifting(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.linear, self.lif = torch.nn.Linear(4, 3), LIF()

        def forward(self, x):
            total = 0
            for step in range(3):
                total = total + self.lif(self.linear(x[..., step]) * (step + 1))
            return total

    found = refusal(exported(Drifting(), (torch.zeros(1, 4, 3),)))
    assert found.endswith(
        ": step 1 differs from step 0 in weights, bias, decay or threshold; all steps must be the "
        "same, from a state of zero"
    )


def test_snntorch_like_reset_of_the_next_input_is_no_such_neuron(refusal):
    """There a spike also discards the input of the step after it; that is another neuron."""

    class Discarding(torch.nn.Module):
        def forward(self, x, membrane):
            fired = (membrane > 0.5).float()
            base = membrane * 0.2 + x
            membrane = base - fired * base
            return (membrane > 0.5).float(), membrane

    content = exported(Discarding(), (torch.zeros(1, 4), torch.zeros(1, 4)))
    assert AFFINE in refusal(content) or RESET in refusal(content)


@pytest.mark.parametrize("size", [1, 2, 10, 100, 1000, -1])
def test_truncated(tmp_path, size):
    content = one_step(torch.nn.Sequential(torch.nn.Linear(4, 3), LIF()), torch.zeros(1, 4))
    (tmp_path / "net.onnx").write_bytes(content[:size])
    with pytest.raises(SpikeloomError):
        read_onnx(tmp_path / "net.onnx")


def survives(path, seed):
    """Whether a faulty file is read or refused in one line, soon."""
    path.write_bytes(faulty(seed))
    begin, line = time.monotonic(), f"{path}: "
    try:
        read_onnx(path)
    except SpikeloomError as error:
        line = str(error)
    assert "\n" not in line
    assert line.startswith(f"{path}: ")
    assert time.monotonic() - begin < 60


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**64 - 1))
def test_fuzzed_files(tmp_path, seed):
    survives(tmp_path / "net.onnx", seed)


@pytest.mark.slow
@settings(max_examples=100_000, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**64 - 1))
def test_many_fuzzed_files(tmp_path, seed):
    survives(tmp_path / "net.onnx", seed)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200))
def test_any_bytes(tmp_path, content):
    (tmp_path / "net.onnx").write_bytes(content)
    with pytest.raises(SpikeloomError):
        read_onnx(tmp_path / "net.onnx")


def test_the_fuzzer_reaches_far(tmp_path):
    """Its files are neither all refused at the door nor all unharmed."""
    path, seen = tmp_path / "net.onnx", {"read": 0, "node": 0, "other": 0}
    for seed in range(200):
        path.write_bytes(faulty(seed))
        try:
            read_onnx(path)
            seen["read"] += 1
        except SpikeloomError as error:
            seen["node" if ": node " in str(error) else "other"] += 1
    assert min(seen.values()) > 10, seen
    assert faulty(7) == faulty(7)
    assert NUMBERS[0] < 0 < NUMBERS[-1]
    assert numpy_helper.to_array(ModelProto.FromString(two_layers()).graph.initializer[0]).shape == (4, 3)
