"""Small ONNX graphs written by hand: two spiking layers, with the neuron spelled in every way."""

import re

import numpy as np
from onnx import TensorProto, helper, numpy_helper

WEIGHTS = np.array([[0.5, -0.25, 1.0, 0.125], [0.75, 0.5, -0.5, 0.25], [-1.0, 2.0, 0.375, 0.5]], np.float32)
SECOND = np.array([[1.0, -0.5, 0.25], [0.5, 0.75, -0.125]], np.float32)
BIAS = np.array([0.125, -0.25, 0.0625], np.float32)
CONSTANTS = {
    "w": WEIGHTS.T.copy(),
    "b": BIAS,
    "w2": SECOND.T.copy(),
    "beta": np.array(0.2, np.float32),
    "theta": np.array(0.5, np.float32),
    "one": np.array(1, np.float32),
    "zero": np.array(0, np.float32),
}
FLOAT, TRUTH = TensorProto.FLOAT, TensorProto.BOOL


def value(name, shape, kind=FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def node(op, inputs, outputs, **attributes):
    inputs, outputs = inputs.split(), outputs.split()
    return helper.make_node(
        op, ["" if i == "-" else i for i in inputs], outputs, name=outputs[0], **attributes
    )


def model(nodes, inputs, outputs, constants=None, *, opset=20, domains=()):
    """Serialised model; inputs and outputs as (name, shape) or (name, shape, kind)."""
    tensors = [numpy_helper.from_array(np.asarray(a), n) for n, a in (CONSTANTS | (constants or {})).items()]
    ends = [
        [value(*end) if isinstance(end, tuple) else value(end, None) for end in side]
        for side in (inputs, outputs)
    ]
    graph = helper.make_graph(nodes, "net", *ends, tensors)
    imports = [helper.make_opsetid("", opset), *(helper.make_opsetid(d, 1) for d in domains)]
    return helper.make_model(
        graph, opset_imports=imports, ir_version=9, producer_name="hand"
    ).SerializeToString()


def written(text, **names):
    """Nodes of lines such as ``d = Mul(u, beta)``; casts are to float, names are replaced."""
    found = []
    for output, op, inputs in re.findall(r"(\w+) = (\w+)\(([^)]*)\)", text):
        given = " ".join(names.get(name, name) for name in inputs.split(", "))
        found.append(node(op, given, names.get(output, output), **({"to": FLOAT} if op == "Cast" else {})))
    return found


RESETS = {
    "product": "d = Mul(u, beta); q = Sub(one, s); k = Mul(d, q)",
    "difference": "q = Mul(u, s); d = Sub(u, q); k = Mul(beta, d)",
    "where": "q = Greater(u, theta); d = Mul(u, beta); k = Where(q, zero, d)",
    "less": "q = LessOrEqual(u, theta); r = Cast(q); d = Mul(u, beta); k = Mul(d, r)",
    "truth": "q = Not(s); r = Cast(q); d = Mul(u, beta); k = Mul(d, r)",
    "subtract": "d = Mul(u, beta); q = Mul(s, theta); k = Sub(d, q)",
    "after": "k = Mul(u, beta)",
}
"""What is kept of a membrane ``u`` after its spikes ``s``: several spellings, and one that is another neuron."""


def neuron(k, source, spelling="product"):
    """Nodes of a layer whose current is `source`: u0 -> u0_new and so on."""
    names = {name: f"{name}{k}" for name in "usdqrk"} | {"new": f"u{k}_new", "source": source}
    names |= {"fired": f"s{k}_new", "bool": f"s{k}_new_b", "kept": f"u{k}_kept"}
    fire = (
        "fired = Greater(new, theta)"
        if spelling == "truth"
        else "bool = Greater(new, theta); fired = Cast(bool)"
    )
    after = "; kept = Where(bool, zero, new)" if spelling == "after" else ""
    return written(f"{RESETS[spelling]}; new = Add(k, source); {fire}{after}", **names)


FIRES = {
    "greater": "hot = Greater(u, theta); s = Cast(hot)",
    "less": "hot = Less(theta, u); s = Cast(hot)",
    "where": "hot = Greater(u, theta); s = Where(hot, one, zero)",
    "not": "c = LessOrEqual(u, theta); hot = Not(c); s = Cast(hot)",
    "shift": "d = Sub(u, theta); hot = Greater(d, zero); s = Cast(hot)",
    "share": "d = Div(u, theta); hot = Greater(d, one); s = Cast(hot)",
}


def fire(kind, u, s):
    """Nodes from a membrane to its spikes."""
    return written(FIRES[kind], u=u, s=s)


STAGE = [node("Gemm", "x w b", "current")]
STATE_IN = [("u0", [1, 3]), ("s0", [1, 3]), ("u1", [1, 2]), ("s1", [1, 2])]
STATE_OUT = ["u0_new", "s0_new", "u1_new", "s1_new"]


def two_layers(spelling="product"):
    """A whole step: 4 inputs, 3 neurons, 2 classes."""
    states, results, source = STATE_IN, STATE_OUT, "s0_new"
    nodes = STAGE + neuron(0, "current", spelling)
    if spelling == "truth":
        states = [(name, shape, TRUTH if name[0] == "s" else FLOAT) for name, shape in STATE_IN]
        nodes.append(node("Cast", "s0_new", "s0_float", to=FLOAT))
        source = "s0_float"
    if spelling in ("where", "less", "after"):
        states = [STATE_IN[0], STATE_IN[2]]
        results = ["u0_kept", "u1_kept"] if spelling == "after" else ["u0_new", "u1_new"]
    nodes += [node("MatMul", f"{source} w2", "more"), *neuron(1, "more", spelling)]
    outputs = ["s1_new", *[name for name in results if name != "s1_new"]]
    return model(nodes, [("x", [1, 4]), *states], outputs)
