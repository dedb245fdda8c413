"""ONNX files with faults: bytes and structure of good ones changed at random, the same for the same seed."""

import random
from functools import cache

from fuzzed_bytes import changed_bytes
from made_modules import NETS, example_of, one_step
from made_onnx import looped, scanned, two_layers
from onnx import AttributeProto, ModelProto, defs

OPERATORS = sorted({schema.name for schema in defs.get_all_schemas()})
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


def _changed_attribute(node, rng):
    attribute = rng.choice(node.attribute)
    attribute.i = rng.choice(NUMBERS)
    attribute.f = rng.choice((0.0, float("nan"), float("inf"), -1e30))
    if attribute.ints:
        attribute.ints[rng.randrange(len(attribute.ints))] = rng.choice(NUMBERS)


def _new_attribute(node, rng):
    attribute = node.attribute.add()
    attribute.name = rng.choice(("axis", "axes", "perm", "to", "group", "pads", "kernel_shape", "reduction", "body"))
    attribute.type = rng.randrange(15)
    attribute.i = rng.choice(NUMBERS)
    attribute.ints.extend(rng.choices(NUMBERS, k=rng.randrange(4)))


def _elsewhere(tensor, rng):
    tensor.data_location = 1
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", rng.choice(("../x", "/etc/passwd", "net.onnx", "none", "", "a\0b", "."))


def _change(graph, rng):
    """One fault in a graph, if it has what the fault needs."""
    node = rng.choice(graph.node) if graph.node else None
    tensor = rng.choice(graph.initializer) if graph.initializer else None
    value = rng.choice(graph.input).type.tensor_type if graph.input else None
    names = [name for node in graph.node for name in node.output]
    names += [one.name for one in (*graph.initializer, *graph.input)]

    def replaced(items, *others):
        items[rng.randrange(len(items))] = rng.choice(others)

    faults = [
        (node, lambda: setattr(node, "op_type", rng.choice(OPERATORS))),
        (node and node.input, lambda: replaced(node.input, *names, "", "nothing")),
        (node and node.output, lambda: replaced(node.output, *names, "new")),
        (node, lambda: graph.node.remove(node)),
        (node, lambda: graph.node.add().CopyFrom(node)),
        (node and node.attribute, lambda: _changed_attribute(node, rng)),
        (node, lambda: _new_attribute(node, rng)),
        (node and node.attribute, lambda: setattr(rng.choice(node.attribute), "type", rng.randrange(15))),
        (tensor, lambda: setattr(tensor, "data_type", rng.randrange(24))),
        (tensor and tensor.dims, lambda: replaced(tensor.dims, *NUMBERS)),
        (tensor and tensor.raw_data, lambda: setattr(tensor, "raw_data", changed_bytes(tensor.raw_data, rng))),
        (tensor, lambda: _elsewhere(tensor, rng)),
        (value and value.shape.dim, lambda: setattr(rng.choice(value.shape.dim), "dim_value", rng.choice(NUMBERS))),
        (graph.output, lambda: setattr(rng.choice(graph.output), "name", rng.choice([*names, "nothing"]))),
        (tensor and node, lambda: node.input.append(tensor.name)),
    ]
    possible, fault = rng.choice(faults)
    if possible:
        fault()


def changed_structure(content, rng):
    """A few faults in a file that can still be parsed."""
    model = ModelProto.FromString(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        _change(rng.choice(list(_graphs(model.graph))), rng)
    if rng.random() < 0.02 and model.opset_import:
        model.opset_import[0].version = rng.choice(NUMBERS)
    return model.SerializeToString()


def faulty(seed):
    """A file for a seed."""
    rng = random.Random(seed)
    content = rng.choice(sources())
    content = changed_structure(content, rng) if rng.random() < 0.8 else content
    return changed_bytes(content, rng) if rng.random() < 0.25 else content
