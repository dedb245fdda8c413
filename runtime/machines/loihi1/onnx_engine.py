"""The integer ONNX graph of a netlist, run by onnxruntime: an engine whose arithmetic nobody here wrote.

It takes recordings as :func:`engine.simulate` does and gives the same spikes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.compiler.formats.onnx.writer import Layer, plan
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.runtime.machines.base import require_channels
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.engine import Engine
from spikeloom.runtime.machines.votes import class_counts

PART = 16
"""Recordings that run together: few enough for the caches."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OnnxEngine:
    """A netlist in onnxruntime: its layers as the graph has them, and the graph, in the form ``scan``, loaded."""

    netlist: Netlist
    layers: tuple[Layer, ...]
    session: Any


def open_session(model: bytes) -> Any:
    """Load a model into onnxruntime's CPU provider."""
    import onnxruntime  # slow to load, so only where it is used

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    settings.log_severity_level = 3
    return onnxruntime.InferenceSession(model, settings, providers=["CPUExecutionProvider"])


def prepare(netlist: Netlist) -> OnnxEngine:
    """Export a netlist and load the file's content; raises as :func:`onnx_writer.plan`."""
    return OnnxEngine(
        netlist=netlist, layers=plan(netlist), session=open_session(onnx_writer.export(netlist, "scan")[0])
    )


def simulate(
    prepared: OnnxEngine, events: EventArray, *, lengths: IntArray | None = None
) -> tuple[BoolArray, IntArray]:
    """Run recordings (recordings, n_inputs, T), each from rest; of so many steps where some are shorter than T.

    Returns spikes (recordings, chip steps, compartments), as in :class:`trace.Trace`, and the votes
    (recordings, classes) that the graph counts. Raises DataError if the recordings have other channels than
    the network.
    """
    netlist = prepared.netlist
    require_channels(netlist, events.shape[1])
    recordings, _, length = events.shape
    spikes = np.zeros((recordings, length + netlist.max_depth, netlist.n_compartments), np.bool_)
    votes = np.zeros((recordings, netlist.classes), np.int64)
    names = [port.name for port in prepared.session.get_outputs()]
    ends = np.full(recordings, length) if lengths is None else np.asarray(lengths)
    for end in np.unique(ends[ends > 0]).tolist():
        which = np.flatnonzero(ends == end)
        given = np.ascontiguousarray((events[which, :, :end] != 0).transpose(2, 0, 1)).view(np.uint8)
        outputs = dict(zip(names, prepared.session.run(names, {"events": given}), strict=True))
        for layer in prepared.layers:
            window = np.arange(layer.depth, layer.depth + end)
            spikes[np.ix_(which, window, layer.ids)] = outputs[f"{layer.name}.spikes"].transpose(1, 0, 2)
        votes[which] = outputs.get("votes", 0)
    return spikes, votes


def differences(onnx: OnnxEngine, ours: Engine, events: EventArray, lengths: IntArray | None) -> int:
    """Spikes (recording, chip step, compartment) and votes in which onnxruntime and our engine differ."""
    different = 0
    for start in range(0, len(events), PART):
        part = events[start : start + PART]
        ends = None if lengths is None else lengths[start : start + PART]
        expected = engine.simulate(ours, part, lengths=ends, spikes=True)
        spikes, votes = simulate(onnx, part, lengths=ends)
        different += int(np.count_nonzero(spikes != expected.spikes))
        different += int(np.count_nonzero(votes != class_counts(onnx.netlist, expected.counts.spikes)))
    return different
