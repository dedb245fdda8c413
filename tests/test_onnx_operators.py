"""Each operator as numbers against ONNX's own reference, and as coefficients against itself as numbers."""

import numpy as np
import pytest
from onnx import helper
from onnx.reference import ReferenceEvaluator

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.onnx.file import Node
from spikeloom.compiler.formats.onnx.operators import apply
from spikeloom.compiler.formats.onnx.values import INPUT_ATOM, Affine, Table

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
    ("Gemm", [numbers(3, 2), numbers(4, 3), numbers(2, 1)], {"transA": 1, "transB": 1, "alpha": 0.5, "beta": 2.0}),
    ("Einsum", [numbers(2, 3), numbers(3, 4)], {"equation": "ij,jk->ki"}),
    ("Einsum", [numbers(2, 3, 3), numbers(3)], {"equation": "bij,j->bi"}),
    ("Einsum", [numbers(2, 3)], {"equation": "ij->ji"}),
    ("Conv", [numbers(1, 2, 5, 4), numbers(3, 2, 3, 2), numbers(3)], {"pads": [1, 0, 1, 1], "strides": [2, 1]}),
    ("Conv", [numbers(1, 4, 6), numbers(2, 2, 3)], {"group": 2, "dilations": [2]}),
    ("Conv", [numbers(2, 3, 4, 4), numbers(2, 3, 1, 1)], {}),
    ("AveragePool", [numbers(1, 2, 5, 5)], {"kernel_shape": [2, 3], "pads": [1, 1, 0, 1], "strides": [2, 2]}),
    ("AveragePool", [numbers(1, 2, 5)], {"kernel_shape": [3], "pads": [1, 1], "count_include_pad": 1}),
    ("GlobalAveragePool", [numbers(1, 2, 3, 4)], {}),
    ("BatchNormalization", [numbers(2, 3, 4), *[abs(numbers(3)) for _ in range(4)]], {"epsilon": 0.25}),
    ("ReduceSum", [numbers(2, 3, 4), whole(0, -1)], {"keepdims": 0}),
    ("ReduceMean", [numbers(2, 3, 4), whole(1)], {}),
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
    ("ScatterElements", [numbers(3, 2), EDGES.reshape(4, 1).repeat(2, 1), numbers(4, 2)], {"reduction": "add"}),
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
            value = sum((terms @ operands[place].ravel() for terms in result.terms.values()), start=result.bias)
            assert result.shape == theirs.shape
            assert np.allclose(value, theirs.ravel(), rtol=1e-9, atol=1e-9)
    assert ran >= 1


def test_integers_are_divided_toward_zero():
    node = ours("Div", {})
    assert apply(node, Table(), [whole(-7, 7, -8), whole(2, -2, 4)])[0].tolist() == [-3, -3, -2]


def test_both_operands_of_a_product_may_not_vary():
    table = Table()
    x, y = (table.value(table.atom(INPUT_ATOM, name, 4), (2, 2)) for name in "xy")
    with pytest.raises(ModelError, match=r"^is not affine in its input; only affine operators"):
        apply(ours("MatMul", {}), table, [x, y])
