"""Networks read from ONNX files: every spelling of a neuron, round trips of torch modules, the released network."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from made_modules import NETS, AllSteps, example_of, exported, one_step
from made_onnx import (
    BIAS,
    FIRES,
    SECOND,
    STAGE,
    STATE_IN,
    WEIGHTS,
    fire,
    model,
    neuron,
    node,
    two_layers,
    written,
)
from onnx import helper
from onnx.reference import ReferenceEvaluator
from oracles import assert_same_network, refused

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.affine import Affine
from spikeloom.compiler.formats.onnx.atoms import INPUT_ATOM, Table
from spikeloom.compiler.formats.onnx.file import Node
from spikeloom.compiler.formats.onnx.operators import apply
from spikeloom.compiler.formats.onnx.reader import read_onnx
from spikeloom.compiler.formats.sensor_layout import sensor_layout
from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.networks.module import module_network
from spikeloom.runtime import cli

needs_dynamo = pytest.mark.skipif(
    importlib.util.find_spec("onnxscript") is None, reason="torch's newer exporter needs onnxscript"
)


@pytest.fixture
def read(tmp_path):
    def from_bytes(content, **options):
        path = tmp_path / "net.onnx"
        path.write_bytes(content)
        return read_onnx(path, **options)

    return from_bytes


def require_the_two_layers(network, theta=0.5):
    """The network that all hand-written graphs spell."""
    assert [(p.size, p.beta, p.theta) for p in network.populations] == [(3, 0.2, theta), (2, 0.2, theta)]
    first, second = network.projections
    assert np.array_equal(first.weight.toarray(), WEIGHTS.astype(float))
    assert np.array_equal(second.weight.toarray(), SECOND.astype(float))
    assert np.array_equal(network.populations[0].bias, BIAS.astype(float))
    assert not network.populations[1].bias.any()
    assert (network.classes, network.readout.population, network.readout.label.tolist()) == (2, 1, [0, 1])


@pytest.mark.parametrize("spelling", ["product", "difference", "where", "less", "truth", "after"])
def test_every_spelling_of_the_reset(read, spelling):
    found = read(two_layers(spelling))
    require_the_two_layers(found.network)
    assert "one step" in found.facts[0]


@pytest.mark.parametrize("kind", FIRES)
def test_every_spelling_of_the_spike(read, kind):
    nodes = [*STAGE, *neuron(0, "current")[:-2], *fire(kind, "u0_new", "s0_new")]
    network = read(model(nodes, [("x", [1, 4]), *STATE_IN[:2]], ["s0_new", "u0_new"])).network
    assert [(p.size, p.beta, p.theta) for p in network.populations] == [(3, 0.2, 0.5)]
    assert np.array_equal(network.projections[0].weight.toarray(), WEIGHTS.astype(float))


def test_at_the_threshold_is_the_next_number_below(read):
    nodes = [*STAGE, *neuron(0, "current")[:-2]]
    nodes += [node("GreaterOrEqual", "u0_new theta", "hot"), node("Cast", "hot", "s0_new", to=1)]
    found = read(model(nodes, [("x", [1, 4]), *STATE_IN[:2]], ["s0_new", "u0_new"]))
    (population,) = found.network.populations
    below = float(np.nextafter(np.float32(0.5), np.float32(0)))
    assert population.theta == below
    assert any("fires at u >= 0.5" in fact and "the next number below" in fact for fact in found.facts)
    # in float32, the arithmetic of the file, every membrane is decided as the file decides it
    for membrane in (0.5, below, np.nextafter(np.float32(0.5), np.float32(1))):
        assert (np.float32(membrane) >= np.float32(0.5)) == (
            np.float32(membrane) > np.float32(population.theta)
        )


@pytest.mark.parametrize(
    ("last", "inputs", "label"),
    [
        (node("Add", "count s0_new", "classes"), [("count", [1, 3])], [0, 1, 2]),  # a running count
        (node("MatMul", "s0_new votes", "classes"), [], [0, 1, 0]),
        (
            node("MatMul", "sums votes", "classes"),
            [("count", [1, 3])],
            [0, 1, 0],
        ),  # of a count of each neuron
    ],
)
def test_how_spikes_are_counted(read, last, inputs, label):
    votes = {"votes": np.array([[1, 0], [0, 1], [1, 0]], np.float32)}
    sums = [node("Add", "count s0_new", "sums")] if "sums" in last.input else []
    nodes = [*STAGE, *neuron(0, "current"), *sums, last]
    outputs = ["classes", "u0_new", "s0_new", *(["sums"] if sums else [])]
    network = read(model(nodes, [("x", [1, 4]), *STATE_IN[:2], *inputs], outputs, votes)).network
    assert network.readout.label.tolist() == label
    assert network.classes == max(label) + 1


def test_a_difference_from_the_threshold_in_every_step(read):
    """Of the last step nothing but the difference is used, so that there it is the membrane."""
    nodes = []
    for step in range(3):
        nodes += [
            node("Gather", f"x step{step}", f"x{step}", axis=0),
            node("Gemm", f"x{step} w b", f"c{step}"),
        ]
        kept = f"d{step} = Mul(u{step - 1}, beta); r{step} = Mul(d{step}, s{step - 1}); k{step} = Sub(d{step}, r{step})"
        sums = f"{kept}; u{step} = Add(k{step}, c{step})" if step else "u0 = Identity(c0)"
        nodes += written(
            f"{sums}; v{step} = Sub(u{step}, theta); h{step} = Greater(v{step}, zero); s{step} = Cast(h{step})"
        )
    nodes.append(node("Sum", "s0 s1 s2", "votes"))
    steps = {f"step{step}": np.array(step) for step in range(3)}
    for outputs in (["votes"], ["votes", "u2"]):
        network = read(model(nodes, [("x", [3, 1, 4])], outputs, steps)).network
        assert [(p.size, p.beta, p.theta) for p in network.populations] == [(3, 0.2, 0.5)]
        np.testing.assert_allclose(network.populations[0].bias, BIAS, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "opset"), [("tag", 11), ("grid", 13), ("mlp", 17), ("gcn", 17), ("averaged", 20)]
)
def test_modules_come_back_with_the_same_integers(read, name, opset):
    """One step, and all steps."""
    net, example = NETS[name](), example_of(name)
    ours = module_network(net, example)
    step = read(one_step(net, example, opset_version=opset))
    several = read(exported(AllSteps(net), (torch.zeros(*example.shape, 5),)))
    assert "5 steps unrolled" in several.facts[0]
    options = Options(storage=Fixed((Packing(bits=6),)))
    integers = [
        compile_network(network, options).integer for network in (ours, step.network, several.network)
    ]
    for found in integers[1:]:
        assert_same_network(found, integers[0])
    # torch's exporter folds a batch norm into the convolution before it, in float32
    error = 1e-7 if name == "grid" else 1e-14
    for a, b in zip(ours.populations, step.network.populations, strict=True):
        assert (a.beta, a.theta) == (b.beta, b.theta)
        assert np.abs(a.bias - b.bias).max() < error
    for a, b in zip(ours.projections, step.network.projections, strict=True):
        assert abs(a.weight - b.weight).max() < error


@needs_dynamo
@pytest.mark.parametrize("name", [*NETS])
def test_the_newer_exporter(read, name):
    net, example = NETS[name](), example_of(name)
    ours = compile_network(module_network(net, example)).integer
    one = read(one_step(net, example, dynamo=True))
    several = read(exported(AllSteps(net), (torch.zeros(*example.shape, 3),), dynamo=True))
    for found in (one, several):
        assert_same_network(ours, compile_network(found.network).integer)


def test_layers_are_called_as_the_modules_are(read):
    class Named(torch.nn.Module):
        def __init__(self, inner):
            super().__init__()
            self.conv1, self.lif1, _, self.fc1, self.lif2, self.fc2, self.lif3 = inner

        def forward(self, x):
            x = self.lif1(self.conv1(x)).flatten(1)
            return self.lif3(self.fc2(self.lif2(self.fc1(x))))

    found = read(one_step(Named(NETS["tag"]()), example_of("tag"))).network
    assert [population.name for population in found.populations] == ["conv1", "fc1", "fc2"]


def test_open_size_in_front_is_one_recording(read):
    net, example = NETS["mlp"](), example_of("mlp")
    axes = {"input": {0: "batch"}}
    found = read(one_step(net, example, input_names=["input"], dynamic_axes=axes))
    assert "the open size 'batch' is the batch's, read as 1" in found.facts
    assert_same_network(
        compile_network(module_network(net, example)).integer, compile_network(found.network).integer
    )


def test_taxels_in_front_are_no_batch(read):
    """A network on a graph, without a batch: three taxels in front of all inputs, which its weights mix."""
    constants = {"graph": np.array([[1, 0.5, 0], [0.5, 1, 0.5], [0, 0.5, 1]], np.float32)}
    nodes = [node("MatMul", "graph x", "mixed"), node("MatMul", "mixed w", "current"), *neuron(0, "current")]
    ends = [("x", [3, 2]), ("u0", [3, 4]), ("s0", [3, 4])]
    constants["w"] = np.array([[0.5, -0.25, 1.0, 0.125], [0.75, 0.5, -0.5, 0.25]], np.float32)
    network = read(model(nodes, ends, ["s0_new", "u0_new"], constants)).network
    assert (network.input.taxels, network.input.polarities, network.classes) == (3, 2, 12)


def test_the_largest_of_the_votes_is_what_is_counted(read):
    nodes = [*STAGE, *neuron(0, "current"), node("ArgMax", "s0_new", "class", axis=1)]
    found = read(model(nodes, [("x", [1, 4]), *STATE_IN[:2]], ["class", "u0_new", "s0_new"]))
    assert found.network.readout.label.tolist() == [0, 1, 2]
    assert found.facts[0] == "output class: the class of the largest of s0_new"


@pytest.mark.parametrize(
    ("shape", "options", "expected"),
    [
        ([39, 2], {}, (39, 2, "[taxels, polarities]")),
        ([2, 39], {}, (39, 2, "[polarities, taxels]")),
        ([39, 1], {}, (39, 1, "[taxels, polarities]")),
        ([39, 3], {"polarities": 3}, (39, 3, "[taxels, polarities]")),
        ([2, 2], {"polarities_first": True}, (2, 2, "[polarities, taxels]")),
        ([78], {}, (39, 2, "flat, channel = taxel * polarities + polarity; 2 polarities are assumed")),
        ([1, 39], {"polarities": 1}, (39, 1, "flat, channel = taxel * polarities + polarity")),
        ([78], {"polarities": 2, "polarities_first": True}, (39, 2, "flat, polarity by polarity")),
        ([2, 4, 5], {}, (20, 2, "[polarities, height, width], taxels row by row")),
        ([1, 1, 4, 5], {}, (20, 1, "[polarities, height, width], taxels row by row")),
        ([4, 5, 2], {}, (20, 2, "[height, width, polarities], taxels row by row")),
    ],
)
def test_shapes_of_inputs(shape, options, expected):
    sensor, positions, words = sensor_layout(shape, **options)
    taxels, polarities, spelled = expected
    assert (sensor.taxels, sensor.polarities) == (taxels, polarities)
    assert words == f"{taxels} taxels, {polarities} polarities, as {spelled}"
    turned = "[polarities" in spelled or "polarity by polarity" in spelled
    flat = np.arange(taxels * polarities)
    assert positions.tolist() == (flat.reshape(polarities, taxels).T.ravel() if turned else flat).tolist()


@pytest.mark.parametrize(
    ("shape", "options", "words"),
    [
        ([39, 5], {}, "the input [39, 5]: no axis is the polarities"),
        ([2, 2], {}, "the input [2, 2]: both axes could be the polarities"),
        ([77], {}, "the input [77] is no whole number of taxels with 2 polarities"),
        ([3, 4, 5], {}, "the input [3, 4, 5]: no axis is the polarities"),
        ([2, 3, 4, 5], {}, "the input [2, 3, 4, 5] is none of [taxels, polarities]"),
        ([39, 2], {"polarities": 0}, "--polarities 0: allowed are numbers from 1"),
    ],
)
def test_shapes_that_do_not_tell(shape, options, words):
    refused(OptionError if options else ModelError, words, sensor_layout, shape, **options)


def test_dropout_passes_on_what_it_gets(read):
    nodes = [*STAGE, node("Dropout", "current one", "kept mask"), *neuron(0, "kept")]
    nodes += [node("MatMul", "s0_new w2", "more"), *neuron(1, "more")]
    content = model(nodes, [("x", [1, 4]), *STATE_IN], ["s1_new", "u0_new", "s0_new", "u1_new"])
    require_the_two_layers(read(content).network)


@pytest.mark.recordings
def test_the_released_network_by_torch_geometric(released_checkpoint, tmp_path):
    """Its ONNX files, written by the released code, compile to the integers of its checkpoint, weight by weight."""
    code = os.environ.get("SPIKELOOM_RELEASED_CODE")
    if code is None or importlib.util.find_spec("torch_geometric") is None:
        pytest.skip("needs torch_geometric, and SPIKELOOM_RELEASED_CODE as the folder of the released code")
    script = Path(__file__).parents[1] / "benchmarks" / "released_onnx.py"
    subprocess.run([sys.executable, str(script), code, str(released_checkpoint), str(tmp_path)], check=True)
    words = [
        "compile",
        str(released_checkpoint),
        "--graph",
        "manual",
        "-o",
        str(tmp_path / "t7.loom"),
        "--json",
    ]
    assert cli.main(words) == 0
    for path in sorted(tmp_path.glob("*.onnx")):
        found = compile_network(read_onnx(path).network).netlist
        assert_same_network(lift(found), lift(read_netlist(tmp_path / "t7.loom")))


RNG = np.random.default_rng(0)
EDGES = np.array([0, 2, 2, 1])


def numbers(*shape):
    return RNG.normal(size=shape)


def whole(*values):
    return np.array(values, np.int64)


CASES = [
    ("Add", [numbers(2, 3), numbers(3)], {}),
    ("Sub", [numbers(2, 3), numbers(2, 1)], {}),
    ("Mul", [numbers(2, 3), numbers(3)], {}),
    ("Div", [numbers(2, 3), numbers(1, 3)], {}),
    ("Neg", [numbers(2, 3)], {}),
    ("Sum", [numbers(2, 3), numbers(3), numbers(1)], {}),
    ("Mean", [numbers(2, 3), numbers(3)], {}),
    ("Identity", [numbers(2)], {}),
    ("Cast", [numbers(2)], {"to": 11}),
    ("MatMul", [numbers(2, 3), numbers(3, 4)], {}),
    ("MatMul", [numbers(3), numbers(3, 4)], {}),
    ("MatMul", [numbers(5, 2, 3), numbers(3)], {}),
    ("MatMul", [numbers(5, 1, 2, 3), numbers(4, 3, 2)], {}),
    ("Gemm", [numbers(2, 3), numbers(3, 4), numbers(4)], {}),
    (
        "Gemm",
        [numbers(3, 2), numbers(4, 3), numbers(2, 1)],
        {"transA": 1, "transB": 1, "alpha": 0.5, "beta": 2.0},
    ),
    ("Einsum", [numbers(2, 3), numbers(3, 4)], {"equation": "ij,jk->ki"}),
    ("Einsum", [numbers(2, 3, 3), numbers(3)], {"equation": "bij,j->bi"}),
    ("Einsum", [numbers(2, 3)], {"equation": "ij->ji"}),
    ("Einsum", [numbers(2, 3), numbers(3, 4)], {"equation": "bi,Io->bo"}),
    (
        "Conv",
        [numbers(1, 2, 5, 4), numbers(3, 2, 3, 2), numbers(3)],
        {"pads": [1, 0, 1, 1], "strides": [2, 1]},
    ),
    ("Conv", [numbers(1, 4, 6), numbers(2, 2, 3)], {"group": 2, "dilations": [2]}),
    ("Conv", [numbers(2, 3, 4, 4), numbers(2, 3, 1, 1)], {}),
    (
        "AveragePool",
        [numbers(1, 2, 5, 5)],
        {"kernel_shape": [2, 3], "pads": [1, 1, 0, 1], "strides": [2, 2]},
    ),
    ("AveragePool", [numbers(1, 2, 5)], {"kernel_shape": [3], "pads": [1, 1], "count_include_pad": 1}),
    ("GlobalAveragePool", [numbers(1, 2, 3, 4)], {}),
    ("BatchNormalization", [numbers(2, 3, 4), *[abs(numbers(3)) for _ in range(4)]], {"epsilon": 0.25}),
    ("ReduceSum", [numbers(2, 3, 4), whole(0, -1)], {"keepdims": 0}),
    ("ReduceMean", [numbers(2, 3, 4), whole(1)], {}),
    ("ReduceSum", [numbers(2, 3)], {"noop_with_empty_axes": 1}),
    ("Reshape", [numbers(2, 6), whole(0, 2, -1)], {}),
    ("Flatten", [numbers(2, 3, 4)], {"axis": 2}),
    ("Squeeze", [numbers(1, 3, 1), whole(0)], {}),
    ("Unsqueeze", [numbers(3), whole(0, 2)], {}),
    ("Transpose", [numbers(2, 3, 4)], {"perm": [2, 0, 1]}),
    ("Transpose", [numbers(2, 3)], {}),
    ("Gather", [numbers(4, 3), EDGES], {"axis": -2}),
    ("Gather", [numbers(4, 3), whole(-1)], {"axis": 1}),
    ("GatherElements", [numbers(3, 2), whole(0, 2, -1, 1).reshape(2, 2)], {"axis": 0}),
    ("GatherND", [numbers(3, 2), whole(0, 2, -1).reshape(3, 1)], {}),
    ("GatherND", [numbers(3, 2), whole(0, 1, 2, 0).reshape(2, 2)], {}),
    ("Slice", [numbers(5, 4), whole(1, 3), whole(4, -5), whole(0, 1), whole(2, -1)], {}),
    ("Split", [numbers(5, 2), whole(2, 3)], {"axis": 0}),
    ("Concat", [numbers(2, 3), numbers(2, 1)], {"axis": -1}),
    ("Expand", [numbers(3, 1), whole(2, 1, 4)], {}),
    ("Tile", [numbers(2, 2), whole(1, 3)], {}),
    ("Pad", [numbers(2, 2), whole(0, 1, 2, 0), np.array(0.5)], {}),
    ("Pad", [numbers(2, 2), whole(0, 1, 2, 0)], {}),
    ("Where", [np.array([True, False, True]), numbers(2, 3), numbers(3)], {}),
    (
        "ScatterElements",
        [numbers(3, 2), EDGES.reshape(4, 1).repeat(2, 1), numbers(4, 2)],
        {"reduction": "add"},
    ),
    ("ScatterElements", [numbers(3, 2), whole(2, -1).reshape(1, 2), numbers(1, 2)], {"axis": 0}),
    ("ScatterND", [numbers(3, 2), EDGES.reshape(4, 1), numbers(4, 2)], {"reduction": "add"}),
    ("ScatterND", [numbers(3, 2), whole(1, 0).reshape(1, 2), numbers(1)], {}),
]


def ours(op, attributes, outputs=("o0",), inputs=2):
    names = tuple(f"x{place}" for place in range(inputs))
    return Node(name="n", op=op, inputs=names, outputs=outputs, attributes=attributes)


def reference(op, operands, attributes, outputs):
    """Results of ONNX's own evaluator."""
    names = [f"i{k}" for k in range(len(operands))]
    kinds = [helper.np_dtype_to_tensor_dtype(operand.dtype) for operand in operands]
    inputs = [helper.make_tensor_value_info(n, k, None) for n, k in zip(names, kinds, strict=True)]
    ends = [helper.make_tensor_value_info(name, 11, None) for name in outputs]
    graph = helper.make_graph([helper.make_node(op, names, outputs, **attributes)], "g", inputs, ends)
    session = ReferenceEvaluator(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)]))
    return session.run(None, dict(zip(names, operands, strict=True)))


@pytest.mark.parametrize("case", range(len(CASES)), ids=[f"{i}-{case[0]}" for i, case in enumerate(CASES)])
def test_numbers_and_coefficients(case):
    op, operands, attributes = CASES[case]
    outputs = ("o0", "o1") if op == "Split" else ("o0",)
    expected = reference(op, operands, attributes, outputs)
    node = ours(op, attributes, outputs, len(operands))
    for mine, theirs in zip(apply(node, Table(), operands), expected, strict=True):
        assert mine.shape == theirs.shape
        assert np.allclose(mine, theirs, rtol=1e-12, atol=1e-12)
    ran = 0
    for place in [place for place, operand in enumerate(operands) if operand.dtype == np.float64]:
        table = Table()
        atom = table.atom(INPUT_ATOM, "x", operands[place].size)
        mixed = [table.value(atom, o.shape) if k == place else o for k, o in enumerate(operands)]
        try:
            results = apply(node, table, mixed)
        except ModelError:
            continue  # not affine in this operand: a divisor, a filter, a variance
        ran += 1
        for result, theirs in zip(results, expected, strict=True):
            assert isinstance(result, Affine)
            assert set(result.terms) <= {atom}
            value = sum(
                (terms @ operands[place].ravel() for terms in result.terms.values()), start=result.bias
            )
            assert result.shape == theirs.shape
            assert np.allclose(value, theirs.ravel(), rtol=1e-9, atol=1e-9)
    assert ran >= 1


def test_integers_are_divided_toward_zero():
    node = ours("Div", {})
    assert apply(node, Table(), [whole(-7, 7, -8), whole(2, -2, 4)])[0].tolist() == [-3, -3, -2]


def test_both_operands_of_a_product_may_not_vary():
    table = Table()
    x, y = (table.value(table.atom(INPUT_ATOM, name, 4), (2, 2)) for name in "xy")
    refused(
        ModelError,
        "is not affine in its input; only affine operators",
        apply,
        ours("MatMul", {}),
        table,
        [x, y],
    )
