"""A netlist as an integer ONNX graph: the chip's arithmetic, to be run by any program that reads the format.

Spikes are uint8 zeros and ones; membranes and currents are registers, int32 where no input can bring a product or a
sum beyond it and int64 otherwise. A layer is called by its name (``conv1``, ``fc1`` …), its neurons are those that the
chip holds, in the order of the layer; the metadata list them where some were left out.

Form ``step``: one chip step. Feed every output ``X_next`` back as input ``X``; at the start all are zero.

====================== ================== =============================================================================
``events``             (batch, channels)  input, uint8; channel ``taxel * polarities + polarity``, zeros after the end
``length``             ()                 input, int64: data steps of the recordings; run ``length + max_depth`` steps
``step``               ()                 int64, counts chip steps
``LAYER.spikes``       (batch, neurons)   uint8; received by others one step later
``LAYER.membrane``     (batch, neurons)   after the reset
``LAYER.current``      (batch, neurons)   only where a current outlasts its step
``votes``              (batch, classes)   int32, summed up; only where a layer votes
``overflow``           (batch,)           output, bool, only where ranges are not proven: this step would stop the chip
====================== ================== =============================================================================

Form ``scan``: whole recordings of the same length. Everything is aligned with the data: ``LAYER.spikes[t]`` is what the
layer did with data step ``t``, in chip step ``t + depth``.

====================== ======================= ========================================================================
``events``             (time, batch, channels) input, uint8
``LAYER.spikes``       (time, batch, neurons)  uint8
``LAYER.counts``       (batch, neurons)        int32, spikes of the recording
``votes``              (batch, classes)        int32
``class``              (batch,)                int64, most votes, the lowest on a tie
``overflow``           (batch,)                bool, only where ranges are not proven: the chip would have stopped
====================== ======================= ========================================================================

A network in which each layer receives the one before it only, with proven ranges, is run layer after layer: one product
over all steps (in wide layers one a step), then a ``Scan`` of the recurrence. Any other is a ``Scan`` over the form
``step``.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.formats.onnx.builder import Nodes, Port, counted, decided, model_bytes, read_sizes, rest, zeros
from spikeloom.compiler.formats.onnx.writer_layers import Layer, is_pipeline, plan
from spikeloom.compiler.formats.onnx.writer_step import (
    bias,
    chip_step,
    gathered,
    integrate,
    poll,
    products,
    states,
    voters,
)
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import netlist_bytes

FORMS = ("step", "scan")

END = 2**63 - 1
"""A slice with this end reaches to the end of its axis."""

WIDE = 512
"""Neurons from which on a layer's products are taken step by step too: sums of all steps would not fit the cache."""

CHIP = "chip/"
"""Names inside the loop over chip steps start with this."""

Model = tuple[Nodes, list[Port], list[Port]]
"""Nodes, inputs and outputs."""


def export(netlist: Netlist, form: str) -> bytes:
    """Content of the ONNX file of a netlist; equal netlists give equal bytes.

    Parameters
    ----------
    netlist : Netlist
        Network.
    form : {"step", "scan"}
        See the module.

    Raises
    ------
    ModelError
        If its weights as dense matrices are more than a file holds.
    OptionError
        If the package ``onnx`` is not installed.
    """
    layers = plan(netlist)
    build = _step_model if form == "step" else _scan_model
    graph, inputs, outputs = build(netlist, layers)
    return model_bytes(
        graph,
        inputs,
        outputs,
        name=f"spikeloom-{form}",
        about=__doc__.replace("``", "") if __doc__ else "",
        facts={
            "netlist_sha256": hashlib.sha256(netlist_bytes(netlist)).hexdigest(),
            "form": form,
            "input": f"{netlist.taxels} taxels x {netlist.polarities} polarities; "
            f"channel = taxel * {netlist.polarities} + polarity; 0 or 1{timing_words(netlist.clocks, netlist.bins)}",
            "max_depth": netlist.max_depth,
            "layers": [
                {
                    "name": layer.name,
                    "depth": layer.depth,
                    "neurons": netlist.layers[layer.index].neurons,
                    "held": netlist.neuron[layer.ids].tolist(),
                    "kind": np.dtype(layer.kind).name,
                }
                for layer in layers
            ],
        },
    )


def timing_words(clocks: Clocks, bins: int) -> str:
    """What an input receives beside the events of a bin, for the metadata of a file."""
    words = f"; a step joins {bins} bins of the recordings" if bins > 1 else ""
    if not clocks.channels:
        return words
    return (
        f"{words}; then {clocks.channels} clocks: the k-th, from 0, is 1 in the {clocks.steps} steps from k * "
        f"{clocks.steps}"
    )


def _step_model(netlist: Netlist, layers: tuple[Layer, ...]) -> Model:
    graph = Nodes()
    chip_step(graph, layers, netlist.classes)
    kept = states(layers, netlist.classes)
    inputs = [
        Port(name="events", kind=np.uint8, shape=("batch", netlist.n_inputs)),
        Port(name="length", kind=np.int64, shape=()),
        *kept,
    ]
    outputs = [Port(name=f"{state.name}_next", kind=state.kind, shape=state.shape) for state in kept]
    return graph, inputs, outputs + _stop(layers)


def _stop(layers: tuple[Layer, ...]) -> list[Port]:
    checked = any(layer.checked for layer in layers)
    return [Port(name="overflow", kind=np.bool_, shape=("batch",))] if checked else []


def _scan_model(netlist: Netlist, layers: tuple[Layer, ...]) -> Model:
    graph = Nodes()
    read_sizes(graph)
    if is_pipeline(netlist, layers) and not any(layer.checked for layer in layers):
        _layerwise(graph, layers)
    else:
        _stepwise(graph, netlist, layers)
    outputs = [port for layer in layers for port in counted(graph, layer.name, layer.size)]
    votes, voting = "", voters(layers)
    for layer in voting:
        label = poll(graph, layer, netlist.classes, np.int32)
        last = "votes" if layer is voting[-1] else f"{layer.name}/voted"
        more = graph.add("MatMul", [f"{layer.name}.counts", label], f"{layer.name}/votes" if votes else last)
        votes = graph.add("Add", [votes, more], last) if votes else more
    if voting:
        outputs += decided(graph, netlist.classes)
    return (
        graph,
        [Port(name="events", kind=np.uint8, shape=("time", "batch", netlist.n_inputs))],
        [*outputs, *_stop(layers)],
    )


def _layerwise(graph: Nodes, layers: tuple[Layer, ...]) -> None:
    """Each layer over all steps: its products, then a loop over the recurrence."""
    received = {INPUT: "events"}
    for layer in layers:
        name, body = layer.name, graph.inner()
        received[layer.index] = f"{name}.spikes"
        spikes = [received[source.pre] for source in layer.sources]
        size = ("batch", layer.size)
        # a current that lasts must not take the bias along
        early = layer.size < WIDE and not layer.remembers
        if early:
            sums = gathered(graph, layer, products(graph, layer, spikes, f"{name}/product"), name)
            sums = bias(graph, layer, sums, f"{name}/inflow")
            assert sums is not None, "a layer of a pipeline receives the one before"
            inflow: str | None = f"{name}/now"
            given = [(sums, Port(name=f"{name}/now", kind=layer.kind, shape=size))]
        else:
            now = [
                Port(name=f"{name}/now{i}", kind=np.uint8, shape=("batch", len(source.positive)))
                for i, source in enumerate(layer.sources)
            ]
            given = list(zip(spikes, now, strict=True))
            found = products(body, layer, [port.name for port in now], f"{name}/product")
            inflow = gathered(body, layer, found, name)
        registers = [f"{name}.membrane", *([f"{name}.current"] if layer.remembers else [])]
        state = registers[0], registers[1] if layer.remembers else None
        fired = integrate(body, layer, inflow, state, biased=early)
        left = [fired.membrane, *([fired.current] if fired.current is not None else [])]
        graph.scan(
            body,
            [
                (rest(graph, port), port, after, f"{port.name}/last")
                for port, after in zip(
                    [Port(name=register, kind=layer.kind, shape=size) for register in registers], left, strict=True
                )
            ],
            given,
            [(Port(name=fired.spiked, kind=np.bool_, shape=size), f"{name}/trains")],
            f"{name}/scan",
        )
        graph.cast(f"{name}/trains", f"{name}.spikes", np.uint8)


def _stepwise(graph: Nodes, netlist: Netlist, layers: tuple[Layer, ...]) -> None:
    """All layers together, chip step after chip step; trains are shifted back by the depths of their layers."""
    chip = tuple(replace(layer, name=f"{CHIP}{layer.name}") for layer in layers)
    body, drain = graph.inner(), netlist.max_depth
    chip_step(body, chip, netlist.classes, CHIP)
    graph.add("Squeeze", ["duration"], f"{CHIP}length")
    events = Port(name=f"{CHIP}events", kind=np.uint8, shape=("batch", netlist.n_inputs))
    sizes = [
        graph.constant("drain", [drain], np.int64),
        "batch",
        graph.constant("inputs", [netlist.n_inputs], np.int64),
    ]
    tail = zeros(graph, "tail", np.uint8, sizes)
    filled = graph.add("Concat", ["events", tail], "filled", {"axis": 0})
    kept = [
        (Port(name=f"{after.name}/fired", kind=np.bool_, shape=("batch", after.size)), f"{layer.name}/steps")
        for layer, after in zip(layers, chip, strict=True)
    ]
    if any(layer.checked for layer in layers):
        kept.append((Port(name=f"{CHIP}overflow", kind=np.bool_, shape=("batch",)), "overflow/steps"))
    begun = [
        (rest(graph, port), port, f"{port.name}_next", f"{port.name}/last")
        for port in states(chip, netlist.classes, CHIP)
    ]
    graph.scan(body, begun, [(filled, events)], kept, "chip")
    for layer in layers:
        end = layer.depth - drain or END
        window = [
            graph.constant(f"{layer.name}/{side}", [at], np.int64)
            for side, at in (("begin", layer.depth), ("end", end))
        ]
        graph.add("Slice", [f"{layer.name}/steps", *window], f"{layer.name}/trains")
        graph.cast(f"{layer.name}/trains", f"{layer.name}.spikes", np.uint8)
    if any(layer.checked for layer in layers):
        numbers = graph.cast("overflow/steps", "overflow/numbers", np.int32)
        most = graph.add("ReduceMax", [numbers], "overflow/most", {"axes": [0], "keepdims": 0})
        graph.cast(most, "overflow", np.bool_)
