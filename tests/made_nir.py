"""NIR graphs for tests, and a second reading of them: node by node and step by step, as NIR's equations say."""

import itertools

import nir
import numpy as np
import torch
from torch.nn import functional

from spikeloom.compiler.formats.nir.file import graph_of
from spikeloom.compiler.formats.nir.reader import network_of
from spikeloom.compiler.formats.nir.stages import Steps


def tree_of(graph):
    """What reading the file of a graph gives."""

    def plain(value):
        if isinstance(value, dict):
            return {
                str(key): plain(entry)
                for key, entry in value.items()
                if not (key == "metadata" and not entry)
            }
        if isinstance(value, str) or value is None:
            return value
        if isinstance(value, list) and (not value or isinstance(value[0], tuple)):
            return [list(pair) for pair in value]
        return np.asarray(value)

    return {"version": "1.0.8", "node": plain(graph.to_dict())}


def lowered(graph, dt=0.02, convention="euler", **layout):
    """Network of a graph, without a file."""
    return network_of(graph_of(tree_of(graph), "0" * 64), Steps(dt=dt, convention=convention), **layout)


def chain(*nodes):
    """Nodes in a row, ``n0`` … between Input and Output."""
    names = [f"n{place}" for place in range(len(nodes))]
    shapes = nodes[0].input_type["input"], nodes[-1].output_type["output"]
    return graph_with(dict(zip(names, nodes, strict=True)), [*itertools.pairwise(names)], *shapes)


def graph_with(nodes, edges, shape, out, first=None, last=None):
    """Nodes and edges between an Input and an Output."""
    names = list(nodes)
    ends = {"input": nir.Input(np.array(shape)), **nodes, "output": nir.Output(np.array(out))}
    pairs = [("input", first or names[0]), *edges, (last or names[-1], "output")]
    return nir.NIRGraph(ends, pairs, type_check=False)


def lif(size, tau=0.05, r=1.0, threshold=0.5, leak=0.0, reset=0.0):
    """A LIF node; numbers or arrays."""
    full = [
        np.broadcast_to(np.asarray(value, float), size).copy() for value in (tau, r, leak, threshold, reset)
    ]
    return nir.LIF(tau=full[0], r=full[1], v_leak=full[2], v_threshold=full[3], v_reset=full[4])


def cuba(size, tau_syn=0.06, tau_mem=0.05, r=1.0, threshold=0.5, leak=0.0, weight=1.0):
    """A CubaLIF node, likewise."""
    full = [
        np.broadcast_to(np.asarray(v, float), size).copy()
        for v in (tau_syn, tau_mem, r, leak, threshold, weight)
    ]
    return nir.CubaLIF(
        tau_syn=full[0], tau_mem=full[1], r=full[2], v_leak=full[3], v_threshold=full[4], w_in=full[5]
    )


def affine(rng, rows, columns, gain=1.0, bias=0.3):
    """An Affine node with random numbers."""
    weight = rng.normal(size=(rows, columns)) * gain
    return nir.Affine(weight=weight, bias=rng.normal(size=rows) * bias)


def simulate(graph, events, dt, convention="euler", late=()):
    """Spikes (steps, neurons) of each spiking node by name, from rest; edges in `late` bring what was sent before."""
    received = {name: [a for a, b in graph.edges if b == name] for name in graph.nodes}
    order, ready = (
        [],
        {name: [a for a in sources if (a, name) not in late] for name, sources in received.items()},
    )
    while len(order) < len(received):
        order += [n for n in ready if n not in order and all(source in order for source in ready[n])]
    state, spikes = {}, {}
    before = {source: np.zeros(graph.nodes[source].output_type["output"]) for source, _ in late}
    for now in events:
        values = {}
        for name in order:
            node = graph.nodes[name]
            if isinstance(node, nir.Input):
                values[name] = now.reshape(node.input_type["input"]).astype(float)
                continue
            x = sum((before if (source, name) in late else values)[source] for source in received[name])
            values[name] = stepped(node, x, state.setdefault(name, {}), dt, convention)
            if isinstance(node, nir.LIF | nir.IF | nir.CubaLIF | nir.Threshold):
                spikes.setdefault(name, []).append(values[name].ravel() > 0)
        before = values
    return {name: np.stack(rows) for name, rows in spikes.items()}


def _kept(tau, dt, convention):
    return 1 - dt / tau if convention == "euler" else np.exp(-dt / tau)


def stepped(node, x, state, dt, convention):  # noqa: PLR0911 one return a node
    """What a node gives in a step, by NIR's equations."""
    match node:
        case nir.Affine():
            return x @ node.weight.T + node.bias
        case nir.Linear():
            return x @ node.weight.T
        case nir.Scale():
            return x * node.scale
        case nir.Conv1d() | nir.Conv2d():
            run = functional.conv1d if isinstance(node, nir.Conv1d) else functional.conv2d
            kinds = [
                torch.from_numpy(np.asarray(value, float)) for value in (x[None], node.weight, node.bias)
            ]
            plain = {key: _plain(getattr(node, key)) for key in ("stride", "padding", "dilation")}
            return run(*kinds, **plain, groups=int(node.groups))[0].numpy()
        case nir.SumPool2d() | nir.AvgPool2d():
            size, step, pad = (_plain(getattr(node, key)) for key in ("kernel_size", "stride", "padding"))
            mean = functional.avg_pool2d(torch.from_numpy(x[None]), size, step, pad)[0].numpy()
            return mean * (np.prod(size) if isinstance(node, nir.SumPool2d) else 1)
        case nir.Flatten():
            return x.reshape(-1)
        case nir.Output():
            return x
        case nir.Threshold():
            return (x > node.threshold).astype(float)
        case nir.LI():
            kept = _kept(node.tau, dt, convention)
            state["v"] = kept * state.get("v", 0) + (1 - kept) * (node.v_leak + node.r * x)
            return state["v"]
    return _neuron(node, x, state, dt, convention)


def _neuron(node, x, state, dt, convention):
    v = state.get("v", node.v_reset)
    if isinstance(node, nir.IF):
        v = v + dt * node.r * x
    elif isinstance(node, nir.LIF):
        kept = _kept(node.tau, dt, convention)
        v = kept * v + (1 - kept) * (node.v_leak + node.r * x)
    else:
        held, kept = (_kept(tau, dt, convention) for tau in (node.tau_syn, node.tau_mem))
        state["i"] = held * state.get("i", 0) + (1 - held) * node.w_in * x
        v = kept * v + (1 - kept) * (node.v_leak + node.r * state["i"])
    fired = v > node.v_threshold
    state["v"] = np.where(fired, node.v_reset, v)
    return fired.astype(float)


def _plain(value):
    if isinstance(value, str):
        return value
    values = [int(one) for one in np.ravel(value)]
    return values[0] if len(values) == 1 else tuple(values)
