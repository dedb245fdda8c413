"""ONNX files with faults: bytes and structure of good ones changed at random, the same for the same seed."""

import random
from functools import cache

from fuzzed_bytes import changed_bytes
from made_modules import NETS, example_of, one_step
from made_onnx import looped, scanned, two_layers
from onnx import AttributeProto, ModelProto

NAMES = """
Add Sub Mul Div Pow MatMul Gemm Conv AveragePool GlobalAveragePool BatchNormalization Relu Sigmoid Sign Greater
Less Equal Where Not And Cast Reshape Transpose Squeeze Unsqueeze Flatten Concat Split Slice Gather GatherND
GatherElements ScatterElements ScatterND Expand Tile Pad Shape Size ConstantOfShape Range ReduceSum ReduceMean
Einsum NonZero Identity Clip Min Max Sum Mean Loop Scan If LSTM Softmax MaxPool Dropout Constant Mod Neg CumSum
"""
OPERATORS = NAMES.split()
NUMBERS = (-(2**63), -(2**31), -100, -2, -1, 0, 1, 2, 3, 4, 7, 100, 2**20, 2**31, 2**40, 2**63 - 1)


@cache
def sources():
    """Good files of every form."""
    made = [two_layers(spelling) for spelling in ("product", "where", "truth", "after")]
    made += [one_step(NETS[name](), example_of(name)) for name in ("mlp", "tag", "grid", "gcn")]
    return (*made, scanned(), looped())


def _graphs(graph):
    yield graph
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == AttributeProto.GRAPH:
                yield from _graphs(attribute.g)


def _change(graph, rng):  # noqa: PLR0912 one branch a kind of fault
    """One fault in a graph."""
    names = [name for node in graph.node for name in node.output] + [t.name for t in graph.initializer]
    names += [value.name for value in graph.input]
    node = rng.choice(graph.node) if graph.node else None
    tensor = rng.choice(graph.initializer) if graph.initializer else None
    kind = rng.randrange(15)
    if kind == 0 and node:
        node.op_type = rng.choice(OPERATORS)
    elif kind == 1 and node and node.input:
        node.input[rng.randrange(len(node.input))] = rng.choice([*names, "", "nothing"])
    elif kind == 2 and node and node.output:
        node.output[rng.randrange(len(node.output))] = rng.choice([*names, "new"])
    elif kind == 3 and node:
        graph.node.remove(node)
    elif kind == 4 and node:
        graph.node.add().CopyFrom(node)
    elif kind == 5 and node and node.attribute:
        attribute = rng.choice(node.attribute)
        attribute.i = rng.choice(NUMBERS)
        attribute.f = rng.choice((0.0, float("nan"), float("inf"), -1e30))
        if attribute.ints:
            attribute.ints[rng.randrange(len(attribute.ints))] = rng.choice(NUMBERS)
    elif kind == 6 and node:
        attribute = node.attribute.add()
        attribute.name = rng.choice(
            ("axis", "axes", "perm", "to", "group", "pads", "kernel_shape", "reduction", "body")
        )
        attribute.type = rng.randrange(15)
        attribute.i = rng.choice(NUMBERS)
        attribute.ints.extend(rng.choices(NUMBERS, k=rng.randrange(4)))
    elif kind == 7 and node and node.attribute:
        rng.choice(node.attribute).type = rng.randrange(15)
    elif kind == 8 and tensor:
        tensor.data_type = rng.randrange(24)
    elif kind == 9 and tensor and tensor.dims:
        tensor.dims[rng.randrange(len(tensor.dims))] = rng.choice(NUMBERS)
    elif kind == 10 and tensor and tensor.raw_data:
        tensor.raw_data = changed_bytes(tensor.raw_data, rng)
    elif kind == 11 and tensor:
        tensor.data_location = 1
        entry = tensor.external_data.add()
        entry.key, entry.value = "location", rng.choice(("../x", "/etc/passwd", "net.onnx", "none", "", "a\0b", "."))
    elif kind == 12 and graph.input:
        value = rng.choice(graph.input).type.tensor_type
        if value.shape.dim:
            value.shape.dim[rng.randrange(len(value.shape.dim))].dim_value = rng.choice(NUMBERS)
    elif kind == 13 and graph.output:
        rng.choice(graph.output).name = rng.choice([*names, "nothing"])
    elif kind == 14 and tensor and node:
        node.input.append(tensor.name)


def changed_structure(content, rng):
    """A few faults in a file that can still be parsed."""
    model = ModelProto.FromString(content)
    for _ in range(rng.choice((1, 1, 2, 4))):
        _change(rng.choice(list(_graphs(model.graph))), rng)
    if rng.random() < 0.02 and model.opset_import:
        model.opset_import[0].version = rng.choice(NUMBERS)
    return model.SerializeToString()


def faulty(seed):
    """A file for a seed."""
    rng = random.Random(seed)
    content = rng.choice(sources())
    content = changed_structure(content, rng) if rng.random() < 0.7 else content
    return changed_bytes(content, rng) if rng.random() < 0.45 else content
