"""One chip step as ONNX nodes: the form ``step``, and the body of the loop over chip steps."""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.ir import INPUT
from spikeloom.runtime.formats.onnx_neuron import gathered, integrate, overflow, products
from spikeloom.runtime.formats.onnx_nodes import Nodes, Port
from spikeloom.runtime.formats.onnx_plan import Layer


def states(layers: tuple[Layer, ...], classes: int, prefix: str = "") -> list[Port]:
    """What one chip step hands to the next: it reads each and leaves ``…_next``; `prefix` goes before other names."""
    found = [Port(name=f"{prefix}step", kind=np.int64, shape=())]
    for layer in layers:
        found.append(Port(name=f"{layer.name}.spikes", kind=np.uint8, shape=("batch", layer.size)))
        found.append(Port(name=f"{layer.name}.membrane", kind=layer.kind, shape=("batch", layer.size)))
        if layer.remembers:
            found.append(Port(name=f"{layer.name}.current", kind=layer.kind, shape=("batch", layer.size)))
    if voters(layers):
        found.append(Port(name=f"{prefix}votes", kind=np.int32, shape=("batch", classes)))
    return found


def voters(layers: tuple[Layer, ...]) -> list[Layer]:
    """Layers that vote for classes."""
    return [layer for layer in layers if np.any(layer.label >= 0)]


def poll(graph: Nodes, layer: Layer, classes: int, kind: type[np.uint8] | type[np.int32]) -> str:
    """Hold the matrix (neurons, classes) of zeros and ones that says for what a spike votes."""
    return graph.constant(f"{layer.name}/label", layer.label[:, None] == np.arange(classes), kind)


def chip_step(graph: Nodes, layers: tuple[Layer, ...], classes: int, prefix: str = "") -> None:
    """Append one chip step.

    It reads ``events`` and ``length`` beside the states; where ranges are not proven it also leaves ``overflow``.
    `prefix` goes before all names that are not a layer's.
    """
    heard = {INPUT: f"{prefix}events"} | {layer.index: f"{layer.name}.spikes" for layer in layers}
    graph.add("Add", [f"{prefix}step", graph.constant("increment", 1, np.int64)], f"{prefix}step_next")
    windows = {depth: _window(graph, depth, prefix) for depth in sorted({layer.depth for layer in layers})}
    flags: list[str] = []
    for layer in layers:
        name, is_open = layer.name, windows[layer.depth]
        window = graph.cast(is_open, f"{name}/window", layer.kind)
        inflow, signed = _arrived(graph, layer, [heard[source.pre] for source in layer.sources])
        state = f"{name}.membrane", f"{name}.current" if layer.remembers else None
        fired = integrate(graph, layer, inflow, state, window=window)
        if fired.current is not None:
            graph.add("Mul", [fired.current, window], f"{name}.current_next")
        if layer.checked:
            flags.append(overflow(graph, layer, signed, fired.current, is_open))
        graph.cast(fired.spiked, f"{name}.spikes_next", np.uint8)
    if flags:
        most = graph.add("Max", flags, f"{prefix}overflow/most")
        graph.add("Greater", [most, graph.constant("nothing", 0, np.int32)], f"{prefix}overflow")
    votes, voting = f"{prefix}votes", voters(layers)
    for layer in voting:
        label = poll(graph, layer, classes, np.uint8)
        more = graph.add("MatMulInteger", [f"{layer.name}.spikes_next", label], f"{layer.name}/votes")
        last = f"{prefix}votes_next" if layer is voting[-1] else f"{layer.name}/voted"
        votes = graph.add("Add", [votes, more], last)


def _window(graph: Nodes, depth: int, prefix: str) -> str:
    """Whether layers of a depth integrate in this chip step; bool scalar."""
    name, step = f"{prefix}window{depth}", f"{prefix}step"
    begin = graph.constant(f"{name}/begin", depth, np.int64)
    begun = graph.add("GreaterOrEqual", [step, begin], f"{name}/begun")
    since = graph.add("Sub", [step, begin], f"{name}/since")
    return graph.add("And", [begun, graph.add("Less", [since, f"{prefix}length"], f"{name}/lasts")], name)


def _arrived(graph: Nodes, layer: Layer, spikes: list[str]) -> tuple[str | None, list[str]]:
    """Synaptic sums, and where ranges are not proven those of positive and of negative weights as magnitudes."""
    name = layer.name
    if not layer.checked:
        return gathered(graph, layer, products(graph, layer, spikes, f"{name}/product"), name), []
    signed = []
    for sign, word in ((1, "positive"), (-1, "negative")):
        total = gathered(graph, layer, products(graph, layer, spikes, f"{name}/{word}", sign), f"{name}/{word}")
        assert total is not None, "a layer that hears nobody overflows nothing"
        signed.append(total)
    return graph.add("Sub", signed, f"{name}/sum"), signed
