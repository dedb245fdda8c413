"""The float network of a checkpoint as an ONNX graph: static, with the graph convolution unrolled.

The graph of the taxels is in the file as the matrix ``A`` that a hop multiplies with; there are no lists of edges, no
gathers and no scatters. Each hop is propagated and filtered in the released order, hop 0 first and the bias last, in
float32; neurons are ``u <- beta * u * (1 - s) + I``, ``s = u > theta``.

Form ``step`` is one step of the data, without any lag between layers: feed ``LAYER.membrane_next`` back as
``LAYER.membrane`` and ``votes_next`` as ``votes``, zeros at the start. Form ``scan`` is a loop over it.

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
    Model,
    Nodes,
    Port,
    model_bytes,
    next_of,
    require_room,
    whole_recordings,
)
from spikeloom.compiler.formats.onnx.writer import input_words
from spikeloom.compiler.passes.expand import expand_dense
from spikeloom.compiler.types import FloatArray


def export_float(checkpoint: Checkpoint, adjacency: FloatArray, form: str, *, graph_name: str) -> bytes:
    """Content of the ONNX file of a checkpoint in a form, see the module; equal checkpoints give equal bytes.

    adjacency: (taxels, taxels) float64; normalised propagation matrix, rounded to float32.
    graph_name: of the taxel graph, for the metadata.

    Raises ModelError if its weights are more than a file holds, or it has clocks or decays of single layers.
    """
    if not checkpoint.dynamics.is_plain:
        raise ModelError(
            "--to onnx-float: the network has clocks, or decays of single layers, which this form does not say; "
            "compile it and export the netlist with --to onnx"
        )
    held = sum(checkpoint.towers * dense.weight.size for dense in checkpoint.dense)  # as whole matrices
    require_room(4 * (held + checkpoint.hops.size + adjacency.size))
    polarities = checkpoint.hops.shape[2]
    sizes = {"conv1": checkpoint.taxels * checkpoint.hops.shape[1]}
    sizes |= {dense.name: len(dense.bias) for dense in checkpoint.dense}
    model = _step(checkpoint, adjacency, sizes)
    if form == "scan":
        model = whole_recordings(model, {name: (size, 0) for name, size in sizes.items()}, checkpoint.classes)
    return model_bytes(
        model,
        name=f"spikeloom-float-{form}",
        about=__doc__ or "",
        facts={
            "checkpoint_sha256": checkpoint.sha256,
            "weights": checkpoint.weights,
            "graph": graph_name,
            "form": form,
            "input": input_words(checkpoint.taxels, polarities, NO_CLOCKS, checkpoint.bins),
            "layers": [{"name": name, "neurons": size, "kind": "float32"} for name, size in sizes.items()],
            "beta": checkpoint.beta,
            "theta": checkpoint.theta,
        },
    )


def _step(checkpoint: Checkpoint, adjacency: FloatArray, sizes: dict[str, int]) -> Model:
    """The form ``step``: each layer takes what the one before fired in the same step."""
    nodes, channels = Nodes(), checkpoint.taxels * checkpoint.hops.shape[2]
    inputs, outputs, received = [Port(name="events", kind=np.uint8, shape=("batch", channels))], [], ""
    for layer, (name, size) in enumerate(sizes.items()):
        if layer:
            current = _dense(nodes, checkpoint, layer, received)
        else:
            current = _convolution(nodes, checkpoint, adjacency, size)
        spikes = Port(name=f"{name}.spikes", kind=np.uint8, shape=("batch", size))
        membrane = Port(name=f"{name}.membrane", kind=np.float32, shape=("batch", size))
        kept = nodes.add("Mul", [membrane.name, np.float32(checkpoint.beta)], f"{name}/kept")
        value = nodes.add("Add", [kept, current], f"{name}/value")
        fired = nodes.add("Greater", [value, np.float32(checkpoint.theta)], f"{name}/fired")
        nodes.add("Where", [fired, np.float32(0), value], next_of(membrane).name)
        received = nodes.cast(fired, spikes.name, np.uint8)
        inputs.append(membrane)
        outputs += [spikes, next_of(membrane)]
    votes = Port(name="votes", kind=np.int32, shape=("batch", checkpoint.classes))
    more = nodes.cast(received, "votes/more", np.int32)
    if checkpoint.towers > 1:  # their output neurons are summed by class
        poll = checkpoint.readout.label[:, None] == np.arange(checkpoint.classes)
        more = nodes.add("MatMul", [more, poll.astype(np.int32)], "votes/classes")
    nodes.add("Add", ["votes", more], "votes_next")
    return nodes, [*inputs, votes], [*outputs, next_of(votes)]


def _dense(nodes: Nodes, checkpoint: Checkpoint, layer: int, received: str) -> str:
    """Input current of a fully connected layer."""
    dense = checkpoint.dense[layer - 1]
    name = dense.name
    weight = dense.weight if checkpoint.towers == 1 else expand_dense(checkpoint, layer).toarray()
    spikes = nodes.cast(received, f"{name}/spikes", np.float32)
    product = nodes.add("MatMul", [spikes, weight.T.astype(np.float32)], f"{name}/product")
    return nodes.add("Add", [product, dense.bias.astype(np.float32)], f"{name}/current")


def _convolution(nodes: Nodes, checkpoint: Checkpoint, adjacency: FloatArray, size: int) -> str:
    """``sum_k A^k x g_k + b``, a hop at a time; (batch, taxels * features)."""
    taxels, channels = checkpoint.taxels, checkpoint.hops.shape[2]
    spread = nodes.constant("conv1/adjacency", adjacency.astype(np.float32))
    numbers, by_taxel = nodes.cast("events", "conv1/events", np.float32), np.array([-1, taxels, channels])
    events = nodes.add("Reshape", [numbers, by_taxel], "conv1/taxels")
    # taxels first: a hop is then one product with a wide matrix
    first = nodes.add("Transpose", [events], "conv1/first", perm=[1, 0, 2])
    reached = nodes.add("Reshape", [first, np.array([taxels, -1])], "conv1/hop0")
    total = ""
    for k, taps in enumerate(checkpoint.hops):
        if k:
            reached = nodes.add("MatMul", [spread, reached], f"conv1/hop{k}")
        apart = nodes.add("Reshape", [reached, np.array([taxels, -1, channels])], f"conv1/apart{k}")
        turned = nodes.add("Transpose", [apart], f"conv1/turned{k}", perm=[1, 0, 2])
        rows = nodes.add("Reshape", [turned, np.array([-1, channels])], f"conv1/rows{k}")
        term = nodes.add("MatMul", [rows, taps.T.astype(np.float32)], f"conv1/term{k}")
        total = nodes.add("Add", [total, term], f"conv1/sum{k}") if total else term
    biased = nodes.add("Add", [total, checkpoint.conv_bias.astype(np.float32)], "conv1/biased")
    return nodes.add("Reshape", [biased, np.array([-1, size])], "conv1/current")
