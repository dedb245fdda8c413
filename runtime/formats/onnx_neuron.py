"""The nodes of one layer: synaptic sums and one step of its neurons, as :mod:`loihi1.spec` defines them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    DECAY_BITS,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    IntArray,
)
from spikeloom.runtime.formats.onnx_nodes import Nodes
from spikeloom.runtime.formats.onnx_plan import Layer, digits

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

    Parameters
    ----------
    graph : Nodes
        Where to append.
    layer : Layer
        Which hears.
    spikes : sequence of str
        Of each of its sources, (…, neurons) uint8.
    name : str
        Of the results, before a number.
    sign : {0, 1, -1}
        All weights, or magnitudes of the positive or the negative ones.
    """
    found: list[tuple[str, str]] = []
    for heard, source in zip(spikes, layer.sources, strict=True):
        for digit, factor in digits(source.weight(sign)):
            own = f"{name}/{len(found)}"
            product = graph.add("MatMulInteger", [heard, graph.constant(f"{own}/weight", digit, np.int8)], own)
            found.append((product, graph.column(f"{own}/unit", factor << MEMBRANE_SHIFT, layer.kind)))
    return tuple(found)


def gathered(graph: Nodes, layer: Layer, found: Products, name: str) -> str | None:
    """Add up products to synaptic sums in membrane units; None where the layer hears nobody."""
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

    Parameters
    ----------
    graph : Nodes
        Where to append.
    layer : Layer
        Whose neurons.
    inflow : str or None
        Synaptic sums in membrane units, (batch, n), or None for none.
    state : (membrane, current)
        Registers after the step before; None where no current outlasts its step.
    window : str, optional
        Scalar, 1 while the layer integrates and 0 while it is held at zero.
    biased : bool
        Whether biases are in `inflow` already.
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

    Parameters
    ----------
    graph : Nodes
        Where to append.
    layer : Layer
        Whose registers.
    signed : sequence of str
        Sums of positive and of negative weights as magnitudes, membrane units.
    current : str or None
        Current register of this step, where it outlasts the step.
    is_open : str
        Bool scalar: the layer integrates.
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
