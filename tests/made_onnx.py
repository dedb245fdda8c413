"""Small ONNX graphs written by hand: two spiking layers, with the neuron spelled in every way."""

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
    return helper.make_node(op, ["" if i == "-" else i for i in inputs], outputs, name=outputs[0], **attributes)


def model(nodes, inputs, outputs, constants=None, *, opset=20, domains=()):
    """Serialised model; inputs and outputs as (name, shape) or (name, shape, kind)."""
    tensors = [numpy_helper.from_array(np.asarray(a), n) for n, a in (CONSTANTS | (constants or {})).items()]
    ends = [[value(*end) if isinstance(end, tuple) else value(end, None) for end in side] for side in (inputs, outputs)]
    graph = helper.make_graph(nodes, "net", *ends, tensors)
    imports = [helper.make_opsetid("", opset), *(helper.make_opsetid(d, 1) for d in domains)]
    return helper.make_model(graph, opset_imports=imports, ir_version=9, producer_name="hand").SerializeToString()


def neuron(k, source, spelling="product"):
    """Nodes of a layer whose current is `source`: u0 -> u0_new and so on; several spellings of the same neuron."""
    u, s, new, fired = f"u{k}", f"s{k}", f"u{k}_new", f"s{k}_new"
    fire = [node("Greater", f"{new} theta", f"{fired}_b"), node("Cast", f"{fired}_b", fired, to=FLOAT)]
    match spelling:
        case "product":
            reset = [
                node("Mul", f"{u} beta", f"d{k}"),
                node("Sub", f"one {s}", f"q{k}"),
                node("Mul", f"d{k} q{k}", f"k{k}"),
            ]
        case "difference":
            reset = [
                node("Mul", f"{u} {s}", f"q{k}"),
                node("Sub", f"{u} q{k}", f"d{k}"),
                node("Mul", f"beta d{k}", f"k{k}"),
            ]
        case "where":
            reset = [
                node("Greater", f"{u} theta", f"q{k}"),
                node("Mul", f"{u} beta", f"d{k}"),
                node("Where", f"q{k} zero d{k}", f"k{k}"),
            ]
        case "less":
            reset = [
                node("LessOrEqual", f"{u} theta", f"q{k}"),
                node("Cast", f"q{k}", f"r{k}", to=FLOAT),
                node("Mul", f"{u} beta", f"d{k}"),
                node("Mul", f"d{k} r{k}", f"k{k}"),
            ]
        case "truth":
            reset = [
                node("Not", s, f"q{k}"),
                node("Cast", f"q{k}", f"r{k}", to=FLOAT),
                node("Mul", f"{u} beta", f"d{k}"),
                node("Mul", f"d{k} r{k}", f"k{k}"),
            ]
            fire = [node("Greater", f"{new} theta", fired)]
        case "subtract":
            reset = [
                node("Mul", f"{u} beta", f"d{k}"),
                node("Mul", f"{s} theta", f"q{k}"),
                node("Sub", f"d{k} q{k}", f"k{k}"),
            ]
        case _:
            reset = [node("Mul", f"{u} beta", f"k{k}")]
    add = [node("Add", f"k{k} {source}", new)]
    if spelling == "after":
        after = [node("Where", f"{fired}_b zero {new}", f"u{k}_kept")]
        return reset + add + fire + after
    return reset + add + fire


FIRES = {
    "greater": [("Greater", "{u} theta", "hot"), ("Cast", "hot", "{s}", {"to": FLOAT})],
    "less": [("Less", "theta {u}", "hot"), ("Cast", "hot", "{s}", {"to": FLOAT})],
    "where": [("Greater", "{u} theta", "hot"), ("Where", "hot one zero", "{s}")],
    "not": [("LessOrEqual", "{u} theta", "c"), ("Not", "c", "hot"), ("Cast", "hot", "{s}", {"to": FLOAT})],
    "shift": [("Sub", "{u} theta", "d"), ("Greater", "d zero", "hot"), ("Cast", "hot", "{s}", {"to": FLOAT})],
    "share": [("Div", "{u} theta", "d"), ("Greater", "d one", "hot"), ("Cast", "hot", "{s}", {"to": FLOAT})],
    "sign": [("Sub", "{u} theta", "d"), ("Sign", "d", "e"), ("Relu", "e", "{s}")],
    "heaviside": [
        ("Sub", "{u} theta", "d"),
        ("Equal", "d zero", "eq"),
        ("Less", "d zero", "lt"),
        ("Where", "lt zero one", "step"),
        ("Where", "eq zero step", "{s}"),
    ],
}


def fire(kind, u, s):
    """Nodes from a membrane to its spikes."""
    lines = []
    for line in FIRES[kind]:
        names = [word.format(u=u, s=s) for word in line[1:3]]
        attributes = line[3] if len(line) > 3 else {}
        lines.append(node(line[0], names[0], names[1], **attributes))
    return lines


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


def body(spelling="product"):
    """The same step as the body of a Scan: states in, states and spikes out."""
    nodes = STAGE + neuron(0, "current", spelling)
    nodes += [node("MatMul", "s0_new w2", "more"), *neuron(1, "more", spelling), node("Identity", "s1_new", "out")]
    inputs = [value(name, shape) for name, shape in [*STATE_IN, ("x", [1, 4])]]
    return helper.make_graph(nodes, "step", inputs, [value(name, None) for name in [*STATE_OUT, "out"]])


RESTS = {"r0": np.zeros((1, 3), np.float32), "r1": np.zeros((1, 2), np.float32), "axes": np.array([0])}


def scanned(steps=4, *, reverse=False):
    """All steps by a Scan over the last axis of (4, steps), then the mean."""
    more = {"body": body(), "num_scan_inputs": 1, "scan_input_axes": [0]}
    more |= {"scan_input_directions": [1]} if reverse else {}
    nodes = [
        node("Transpose", "events", "turned", perm=[1, 0]),
        node("Unsqueeze", "turned axis", "sequence"),
        node(
            "Scan",
            "r0 r0 r1 r1 sequence",
            "end0 end1 end2 end3 spikes",
            **more,
        ),
        node("ReduceMean", "spikes axes", "rate", keepdims=0),
    ]
    return model(nodes, [("events", [4, steps])], ["rate"], RESTS | {"axis": np.array([1])})


def looped(steps=4):
    """All steps by a Loop that adds up the spikes."""
    nodes = [node("Gather", "events step", "x", axis=2), *STAGE, *neuron(0, "current")]
    nodes += [node("MatMul", "s0_new w2", "more"), *neuron(1, "more"), node("Add", "total s1_new", "total_new")]
    nodes += [node("Identity", "going", "going_new")]
    inputs = [value("step", [], TensorProto.INT64), value("going", [], TRUTH)]
    inputs += [value(name, shape) for name, shape in [*STATE_IN, ("total", [1, 2])]]
    outputs = [value(name, None) for name in ["going_new", *STATE_OUT, "total_new"]]
    inside = helper.make_graph(nodes, "step", inputs, outputs)
    loop = node("Loop", "count yes r0 r0 r1 r1 r1", "end0 end1 end2 end3 rate", body=inside)
    constants = RESTS | {"count": np.array(steps), "yes": np.array(True)}
    return model([loop], [("events", [1, 4, steps])], ["rate"], constants)
