"""The float network of a checkpoint as an ONNX graph: static, with the graph convolution unrolled.

The graph of the taxels is in the file as the matrix ``A`` that a hop multiplies with; there are no lists of edges, no
gathers and no scatters. Each hop is propagated and filtered in the released order, hop 0 first and the bias last, in
float32; neurons are ``u <- beta * u * (1 - s) + I``, ``s = u > theta``.

Form ``step`` is one step of the data, without any lag between layers: feed ``LAYER.membrane_next`` back as
``LAYER.membrane`` and ``votes_next`` as ``votes``, zeros at the start. Form ``scan`` takes whole recordings.

=================== ====================================================== ===========================================
                    step                                                   scan
=================== ====================================================== ===========================================
``events``          uint8 (batch, channels)                                (time, batch, channels)
``LAYER.spikes``    uint8 (batch, neurons), output                         (time, batch, neurons)
``LAYER.membrane``  float32 (batch, neurons), after the reset              --
``LAYER.counts``    --                                                     int32 (batch, neurons)
``votes``           int32 (batch, classes), summed up                      (batch, classes)
``class``           --                                                     int64 (batch,)
=================== ====================================================== ===========================================

Channels are ``taxel * polarities + polarity``, neurons of conv1 ``taxel * features + feature``.
"""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import NO_CLOCKS
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.onnx.builder import (
    Nodes,
    Port,
    counted,
    decided,
    model_bytes,
    read_sizes,
    require_room,
    rest,
)
from spikeloom.compiler.formats.onnx.writer import timing_words
from spikeloom.compiler.passes.expand import expand_dense
from spikeloom.compiler.types import FloatArray


def export_float(checkpoint: Checkpoint, adjacency: FloatArray, form: str, *, graph_name: str) -> bytes:
    """Content of the ONNX file of a checkpoint; equal checkpoints give equal bytes.

    Parameters
    ----------
    checkpoint : Checkpoint
        Trained weights.
    adjacency : (taxels, taxels) float64
        Normalised propagation matrix; rounded to float32.
    form : {"step", "scan"}
        See the module.
    graph_name : str
        Of the taxel graph, for the metadata.

    Raises
    ------
    ModelError
        If its weights are more than a file holds, or it has clocks or decays of single layers.
    OptionError
        If the package ``onnx`` is not installed.
    """
    if not checkpoint.dynamics.is_plain:
        raise ModelError(
            "--to onnx-float: the network has clocks, or decays of single layers, which this form does not say; "
            "compile it and export the netlist with --to onnx"
        )
    held = sum(checkpoint.towers * dense.weight.size for dense in checkpoint.dense)  # as whole matrices
    require_room(4 * (held + checkpoint.hops.size + adjacency.size))
    nodes, channels = Nodes(), checkpoint.taxels * checkpoint.hops.shape[2]
    sizes = {"conv1": checkpoint.taxels * checkpoint.hops.shape[1]}
    sizes |= {dense.name: len(dense.bias) for dense in checkpoint.dense}
    build = _steps if form == "step" else _recordings
    inputs, outputs = build(nodes, checkpoint, adjacency, sizes, channels)
    return model_bytes(
        nodes,
        inputs,
        outputs,
        name=f"spikeloom-float-{form}",
        about=__doc__.replace("``", "") if __doc__ else "",
        facts={
            "checkpoint_sha256": checkpoint.sha256,
            "weights": checkpoint.weights,
            "graph": graph_name,
            "form": form,
            "input": f"{checkpoint.taxels} taxels x {checkpoint.hops.shape[2]} polarities; "
            f"channel = taxel * {checkpoint.hops.shape[2]} + polarity; 0 or 1"
            f"{timing_words(NO_CLOCKS, checkpoint.bins)}",
            "layers": [{"name": name, "neurons": size, "kind": "float32"} for name, size in sizes.items()],
            "beta": checkpoint.beta,
            "theta": checkpoint.theta,
        },
    )


def _steps(
    nodes: Nodes, checkpoint: Checkpoint, adjacency: FloatArray, sizes: dict[str, int], channels: int
) -> tuple[list[Port], list[Port]]:
    inputs = [Port(name="events", kind=np.uint8, shape=("batch", channels))]
    outputs, received = [], ""
    for name, size in sizes.items():
        current = _current(nodes, checkpoint, adjacency, name, received, [nodes.constant("rows", [-1], np.int64)], size)
        fired = _integrate(nodes, checkpoint, name, current)
        trains = Port(name=f"{name}.spikes", kind=np.uint8, shape=("batch", size))
        nodes.cast(fired, trains.name, np.uint8)
        received = trains.name
        inputs.append(Port(name=f"{name}.membrane", kind=np.float32, shape=("batch", size)))
        outputs += [trains, Port(name=f"{name}.membrane_next", kind=np.float32, shape=("batch", size))]
    votes = Port(name="votes", kind=np.int32, shape=("batch", checkpoint.classes))
    more = nodes.cast(received, "votes/more", np.int32)
    nodes.add("Add", ["votes", _by_class(nodes, checkpoint, more, "votes/classes")], "votes_next")
    return [*inputs, votes], [*outputs, Port(name="votes_next", kind=np.int32, shape=votes.shape)]


def _recordings(
    nodes: Nodes, checkpoint: Checkpoint, adjacency: FloatArray, sizes: dict[str, int], channels: int
) -> tuple[list[Port], list[Port]]:
    read_sizes(nodes)
    outputs, received = [], ""
    for name, size in sizes.items():
        current = _current(nodes, checkpoint, adjacency, name, received, ["duration", "batch"], size)
        body, shape = nodes.inner(), ("batch", size)
        membrane = Port(name=f"{name}.membrane", kind=np.float32, shape=shape)
        fired = Port(name=_integrate(body, checkpoint, name, f"{name}/now"), kind=np.bool_, shape=shape)
        nodes.scan(
            body,
            [(rest(nodes, membrane), membrane, f"{name}.membrane_next", f"{name}.membrane/last")],
            [(current, Port(name=f"{name}/now", kind=np.float32, shape=shape))],
            [(fired, f"{name}/trains")],
            f"{name}/scan",
        )
        received = nodes.cast(f"{name}/trains", f"{name}.spikes", np.uint8)
        outputs += counted(nodes, name, size)
    if checkpoint.towers > 1:
        _by_class(nodes, checkpoint, outputs[-1].name, "votes")
    else:
        nodes.add("Identity", [outputs[-1].name], "votes")
    events = Port(name="events", kind=np.uint8, shape=("time", "batch", channels))
    return [events], outputs + decided(nodes, checkpoint.classes)


def _by_class(nodes: Nodes, checkpoint: Checkpoint, counts: str, name: str) -> str:
    """Sum the counts of the output neurons by class, where towers vote together."""
    if checkpoint.towers == 1:
        return counts
    poll = checkpoint.readout.label[:, None] == np.arange(checkpoint.classes)
    return nodes.add("MatMul", [counts, nodes.constant("votes/label", poll, np.int32)], name)


def _current(
    nodes: Nodes, checkpoint: Checkpoint, adjacency: FloatArray, name: str, received: str, rows: list[str], size: int
) -> str:
    """Input current of a layer, (…, neurons) with the leading sizes `rows`."""
    if name == "conv1":
        total = _convolution(nodes, checkpoint, adjacency)
        form = nodes.add("Concat", [*rows, nodes.constant("conv1/size", [size], np.int64)], "conv1/form", {"axis": 0})
        return nodes.add("Reshape", [total, form], "conv1/current")
    layer, dense = next((i, dense) for i, dense in enumerate(checkpoint.dense, 1) if dense.name == name)
    weight = dense.weight if checkpoint.towers == 1 else expand_dense(checkpoint, layer).toarray()
    spikes = nodes.cast(received, f"{name}/spikes", np.float32)
    product = nodes.add("MatMul", [spikes, nodes.constant(f"{name}/weight", weight.T, np.float32)], f"{name}/product")
    return nodes.add("Add", [product, nodes.constant(f"{name}/bias", dense.bias, np.float32)], f"{name}/current")


def _convolution(nodes: Nodes, checkpoint: Checkpoint, adjacency: FloatArray) -> str:
    """``sum_k A^k x g_k + b``, a hop at a time; (rows * taxels, features)."""
    taxels, channels = checkpoint.taxels, checkpoint.hops.shape[2]
    split = nodes.constant("conv1/split", [-1, taxels, channels], np.int64)
    beside = nodes.constant("conv1/beside", [taxels, -1], np.int64)
    apart = nodes.constant("conv1/apart", [taxels, -1, channels], np.int64)
    column = nodes.constant("conv1/column", [-1, channels], np.int64)
    spread = nodes.constant("conv1/adjacency", adjacency, np.float32)
    turn = {"perm": [1, 0, 2]}
    events = nodes.add("Reshape", [nodes.cast("events", "conv1/events", np.float32), split], "conv1/taxels")
    # taxels first: a hop is then one product with a wide matrix
    reached = nodes.add("Reshape", [nodes.add("Transpose", [events], "conv1/first", turn), beside], "conv1/hop0")
    total = ""
    for k, taps in enumerate(checkpoint.hops):
        if k:
            reached = nodes.add("MatMul", [spread, reached], f"conv1/hop{k}")
        apart_k = nodes.add("Reshape", [reached, apart], f"conv1/apart{k}")
        turned = nodes.add("Transpose", [apart_k], f"conv1/turned{k}", turn)
        rows = nodes.add("Reshape", [turned, column], f"conv1/rows{k}")
        filters = nodes.constant(f"conv1/filter{k}", taps.T, np.float32)
        term = nodes.add("MatMul", [rows, filters], f"conv1/term{k}")
        total = nodes.add("Add", [total, term], f"conv1/sum{k}") if total else term
    return nodes.add("Add", [total, nodes.constant("conv1/bias", checkpoint.conv_bias, np.float32)], "conv1/biased")


def _integrate(nodes: Nodes, checkpoint: Checkpoint, name: str, current: str) -> str:
    """One step of the neurons, from ``LAYER.membrane`` to ``LAYER.membrane_next``; returns who fired (bool)."""
    kept = nodes.constant("beta", checkpoint.beta, np.float32)
    value = nodes.add("Add", [nodes.add("Mul", [f"{name}.membrane", kept], f"{name}/kept"), current], f"{name}/value")
    fired = nodes.add("Greater", [value, nodes.constant("theta", checkpoint.theta, np.float32)], f"{name}/fired")
    nodes.add("Where", [fired, nodes.constant("zero", 0, np.float32), value], f"{name}.membrane_next")
    return fired
