"""The integer ONNX graph of a netlist, run by onnxruntime: an engine whose arithmetic nobody here wrote.

It takes recordings as :func:`engine.simulate` does and gives the same spikes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.compiler.formats.onnx.writer import Layer, plan
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.engine import Engine, EventArray
from spikeloom.runtime.machines.loihi1.trace import MembraneArray, check_channels
from spikeloom.runtime.machines.votes import class_counts

PART = 64
"""Recordings whose spikes are held at a time."""

BATCH = {"step": 144, "scan": 16}
"""Recordings that run together: few enough for the caches."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OnnxEngine:
    """A netlist in onnxruntime: its layers as the graph of a form has them, and the graph, loaded."""

    netlist: Netlist
    layers: tuple[Layer, ...]
    form: str
    session: Any


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OnnxTrace:
    """What it did.

    spikes: (recordings, chip steps, compartments) bool; as in :class:`trace.Trace`.
    votes: (recordings, classes) int64; spikes of the read-out, as the graph counts them.
    membranes: (recordings, chip steps, compartments) int32, or None; after the reset: zero where a compartment
        spiked or its window is closed. Form ``step`` only.
    """

    spikes: BoolArray
    votes: IntArray
    membranes: MembraneArray | None


def open_session(model: bytes) -> Any:
    """Load a model into onnxruntime's CPU provider."""
    import onnxruntime  # slow to load, so only where it is used

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    settings.log_severity_level = 3
    return onnxruntime.InferenceSession(model, settings, providers=["CPUExecutionProvider"])


def prepare(netlist: Netlist, *, form: str = "scan") -> OnnxEngine:
    """Export a netlist in a form, ``step`` or ``scan``, and load the file's content.

    Raises ModelError if a file cannot hold the network.
    """
    session = open_session(onnx_writer.export(netlist, form))
    return OnnxEngine(netlist=netlist, layers=plan(netlist), form=form, session=session)


def simulate(
    prepared: OnnxEngine, events: EventArray, *, lengths: IntArray | None = None, membranes: bool = False
) -> OnnxTrace:
    """Run recordings (recordings, n_inputs, T), each from rest; of so many steps where some are shorter than T.

    Raises DataError if they have other channels than the network, NumericRangeError if a register overflows, where the
    chip is not defined.
    """
    netlist = prepared.netlist
    check_channels(netlist, events.shape[1])
    recordings, _, length = events.shape
    shape = (recordings, length + netlist.max_depth, netlist.n_compartments)
    trace = OnnxTrace(
        spikes=np.zeros(shape, np.bool_),
        votes=np.zeros((recordings, netlist.classes), np.int64),
        membranes=np.zeros(shape, np.int32) if membranes else None,
    )
    ends = np.full(recordings, length) if lengths is None else np.asarray(lengths)
    run, size = _run_steps if prepared.form == "step" else _run_scan, BATCH[prepared.form]
    for end in np.unique(ends[ends > 0]).tolist():
        group = np.flatnonzero(ends == end)
        for which in np.split(group, range(size, len(group), size)):
            given = np.ascontiguousarray((events[which, :, :end] != 0).transpose(2, 0, 1)).view(np.uint8)
            run(prepared, given, which, trace)
    return trace


def _run_scan(prepared: OnnxEngine, events: EventArray, which: IntArray, trace: OnnxTrace) -> None:
    """Run some recordings (steps, recordings, n_inputs); `which` is where they belong in the trace."""
    found = _run(prepared.session, {"events": events})
    _require_range(which, found, "")
    spikes = np.zeros((len(which), *trace.spikes.shape[1:]), np.bool_)
    for layer in prepared.layers:
        window = slice(layer.depth, layer.depth + len(events))
        spikes[:, window, layer.ids] = found[f"{layer.name}.spikes"].transpose(1, 0, 2)
    trace.spikes[which] = spikes
    trace.votes[which] = found.get("votes", 0)


def _run_steps(prepared: OnnxEngine, events: EventArray, which: IntArray, trace: OnnxTrace) -> None:
    """The same, chip step by chip step."""
    steps, batch, channels = events.shape
    drain = prepared.netlist.max_depth
    given = {
        port.name: np.zeros([batch if size == "batch" else size for size in port.shape], port.type[len("tensor(") : -1])
        for port in prepared.session.get_inputs()
    }
    given["length"][...] = steps
    for step, now in enumerate(np.concatenate([events, np.zeros((drain, batch, channels), np.uint8)])):
        found = _run(prepared.session, given | {"events": now})
        _require_range(which, found, f", chip step {step}")
        given |= {name.removesuffix("_next"): array for name, array in found.items() if name.endswith("_next")}
        for layer in prepared.layers:
            trace.spikes[which[:, None], step, layer.ids] = given[f"{layer.name}.spikes"]
            if trace.membranes is not None:
                trace.membranes[which[:, None], step, layer.ids] = given[f"{layer.name}.membrane"]
    trace.votes[which] = given.get("votes", 0)


def _run(session: Any, given: dict[str, Any]) -> dict[str, Any]:
    """Outputs by name."""
    names = [port.name for port in session.get_outputs()]
    return dict(zip(names, session.run(names, given), strict=True))


def _require_range(which: IntArray, found: dict[str, Any], where: str) -> None:
    if "overflow" in found and found["overflow"].any():
        raise NumericRangeError(
            f"onnx: recording {which[found['overflow']][0]}{where}: a register overflows, where the chip is not defined"
        )


def different_spikes(onnx: OnnxEngine, ours: Engine, events: EventArray, lengths: IntArray | None) -> int:
    """Entries (recording, chip step, compartment) in which onnxruntime's spikes are not our engine's."""
    found = 0
    for start in range(0, len(events), PART):
        part, ends = events[start : start + PART], None if lengths is None else lengths[start : start + PART]
        spikes = engine.simulate(ours, part, lengths=ends, spikes=True).spikes
        found += int(np.count_nonzero(simulate(onnx, part, lengths=ends).spikes != spikes))
    return found


def same_state(onnx: OnnxEngine, ours: Engine, recording: EventArray) -> bool:
    """Whether every spike, membrane after the reset and vote of one recording (channels, steps) is our engine's."""
    expected = engine.simulate(ours, recording[None], spikes=True, membranes=True)
    assert expected.spikes is not None, "spikes were wanted"
    assert expected.membranes is not None, "membranes were wanted"
    found = simulate(onnx, recording[None], membranes=True)
    pairs = (
        (found.spikes, expected.spikes),
        (found.membranes, np.where(expected.spikes, 0, expected.membranes)),
        (found.votes, class_counts(onnx.netlist, expected.counts.spikes)),
    )
    return all(one is not None and np.array_equal(one, other) for one, other in pairs)
