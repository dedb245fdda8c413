"""The nodes of one layer, as :mod:`loihi1.spec` defines its neurons, and of one chip step of all layers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import ACCUMULATOR_MAX, CURRENT_MAX, DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.formats.onnx.builder import Nodes, Port
from spikeloom.compiler.formats.onnx.writer_layers import Layer, digits
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.types import IntArray

Products = tuple[tuple[str, str], ...]
"""Pairs of an int32 product of spikes with digits, and the constant of what a one in it adds, in membrane units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fired:
    """Names of what a step of a layer leaves: whether neurons spiked (bool), membranes after the reset, currents.

    `current` is the register before a window closes it; None where no current outlasts its step.
    """

    spiked: str
    membrane: str
    current: str | None


def products(graph: Nodes, layer: Layer, spikes: Sequence[str], name: str, sign: int = 0) -> Products:
    """Multiply spikes with the digits of weights.

    graph: where to append.
    layer: which receives.
    spikes: of each of its sources, (…, neurons) uint8.
    name: of the results, before a number.
    sign: {0, 1, -1}; all weights, or magnitudes of the positive or the negative ones.
    """
    found: list[tuple[str, str]] = []
    for received, source in zip(spikes, layer.sources, strict=True):
        for digit, factor in digits(source.weight(sign)):
            own = f"{name}/{len(found)}"
            product = graph.add("MatMulInteger", [received, graph.constant(f"{own}/weight", digit, np.int8)], own)
            found.append((product, graph.column(f"{own}/unit", factor << MEMBRANE_SHIFT, layer.kind)))
    return tuple(found)


def gathered(graph: Nodes, layer: Layer, found: Products, name: str) -> str | None:
    """Add up products to synaptic sums in membrane units; None where nothing feeds the layer."""
    total: str | None = None
    for i, (product, unit) in enumerate(found):
        wide = product if layer.kind is np.int32 else graph.cast(product, f"{name}/wide{i}", layer.kind)
        scaled = graph.add("Mul", [wide, unit], f"{name}/scaled{i}")
        total = scaled if total is None else graph.add("Add", [total, scaled], f"{name}/sum{i}")
    return total


def bias(graph: Nodes, layer: Layer, value: str | None, name: str) -> str | None:
    """Add biases, in membrane units, where there are any."""
    if not layer.bias.any():
        return value
    own = graph.column(f"{layer.name}/bias", layer.bias, layer.kind)
    return own if value is None else graph.add("Add", [value, own], name)


def integrate(
    graph: Nodes,
    layer: Layer,
    inflow: str | None,
    state: tuple[str, str | None],
    *,
    window: str | None = None,
    biased: bool = False,
) -> Fired:
    """Append one step of the neurons.

    graph: where to append.
    layer: whose neurons.
    inflow: synaptic sums in membrane units, (batch, n), or None for none.
    state: (membrane, current); registers after the step before; None where no current outlasts its step.
    window: scalar, 1 while the layer integrates and 0 while it is held at zero.
    biased: whether biases are in `inflow` already.
    """
    name, (membrane, current) = layer.name, state
    if current is not None:
        lasting = _decayed(graph, layer, current, layer.decay_u + 1, f"{name}/lasting")
        inflow = lasting if inflow is None else graph.add("Add", [lasting, inflow], f"{name}/current")
        current = inflow
    if not biased:
        inflow = bias(graph, layer, inflow, f"{name}/inflow")
    value = _decayed(graph, layer, membrane, layer.decay_v, f"{name}/decayed")
    if inflow is not None:
        value = graph.add("Add", [value, inflow], f"{name}/driven")
    if layer.saturates:
        ends = [
            graph.constant(f"{end}/{np.dtype(layer.kind).name}", sign * MEMBRANE_MAX, layer.kind)
            for end, sign in (("lowest", -1), ("highest", 1))
        ]
        value = graph.add("Clip", [value, *ends], f"{name}/clipped")
    if window is not None:
        value = graph.add("Mul", [value, window], f"{name}/gated")
    threshold = graph.column(f"{name}/threshold", layer.threshold, layer.kind)
    fired = graph.add("Greater", [value, threshold], f"{name}/fired")
    zero = graph.constant(f"zero/{np.dtype(layer.kind).name}", 0, layer.kind)
    left = graph.add("Where", [fired, zero, value], f"{name}.membrane_next")
    return Fired(spiked=fired, membrane=left, current=current)


def _decayed(graph: Nodes, layer: Layer, register: str, lost: IntArray, name: str) -> str:
    """Keep ``(4096 - lost) / 4096``: a product and an integer division, which truncates toward zero."""
    kept = graph.column(f"{name}/kept", 2**DECAY_BITS - lost, layer.kind)
    one = graph.constant(f"one/{np.dtype(layer.kind).name}", 2**DECAY_BITS, layer.kind)
    return graph.add("Div", [graph.add("Mul", [register, kept], f"{name}/product"), one], name)


def overflow(graph: Nodes, layer: Layer, signed: Sequence[str], current: str | None, is_open: str) -> str:
    """Whether the chip would stop at this step; (batch,) int32, 0 or 1.

    graph: where to append.
    layer: whose registers.
    signed: sums of positive and of negative weights as magnitudes, membrane units.
    current: current register of this step, where it outlasts the step.
    is_open: bool scalar: the layer integrates.
    """
    name, kind = f"{layer.name}/overflow", np.dtype(layer.kind).name
    found = [(register, graph.constant(f"sum/{kind}", ACCUMULATOR_MAX, layer.kind)) for register in signed]
    if current is not None:
        size = graph.add("Abs", [current], f"{name}/size")
        found.append((size, graph.constant(f"current/{kind}", CURRENT_MAX, layer.kind)))
    total = is_open
    for i, (register, limit) in enumerate(found):
        over = graph.add("Greater", [register, limit], f"{name}/over{i}")
        total = over if i == 0 else graph.add("Or", [total, over], f"{name}/any{i}")
    gated = graph.add("And", [total, is_open], f"{name}/gated")
    return graph.add("ReduceMax", [graph.cast(gated, f"{name}/number", np.int32)], name, {"axes": [-1], "keepdims": 0})


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
    received = {INPUT: f"{prefix}events"} | {layer.index: f"{layer.name}.spikes" for layer in layers}
    graph.add("Add", [f"{prefix}step", graph.constant("increment", 1, np.int64)], f"{prefix}step_next")
    windows = {depth: _window(graph, depth, prefix) for depth in sorted({layer.depth for layer in layers})}
    flags: list[str] = []
    for layer in layers:
        name, is_open = layer.name, windows[layer.depth]
        window = graph.cast(is_open, f"{name}/window", layer.kind)
        inflow, signed = _arrived(graph, layer, [received[source.pre] for source in layer.sources])
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
        assert total is not None, "a layer that receives nothing overflows nothing"
        signed.append(total)
    return graph.add("Sub", signed, f"{name}/sum"), signed
