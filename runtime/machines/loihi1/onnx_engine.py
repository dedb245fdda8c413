"""The integer ONNX graph of a netlist, run by onnxruntime: an engine whose arithmetic nobody here wrote.

It takes recordings as :func:`engine.simulate` does and gives the same spikes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.compiler.formats.onnx.builder import package
from spikeloom.compiler.formats.onnx.writer_layers import Layer, plan
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

KINDS = {f"tensor({kind})": np.dtype(kind) for kind in ("bool", "uint8", "int32", "int64")}
"""Types of onnxruntime that the graphs use."""

Runs = list[tuple[slice, slice]]
"""Where runs of neighbours lie in a large array, and in a small one that holds them alone."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OnnxEngine:
    """A netlist in onnxruntime, made by :func:`prepare`.

    netlist: what it was made from.
    layers: its layers, as the graph has them.
    form: {"step", "scan"}; of the graph.
    session: the graph, loaded.
    runs: compartments of each layer, by its name.
    """

    netlist: Netlist
    layers: tuple[Layer, ...]
    form: str
    session: Any
    runs: Mapping[str, Runs]


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


def open_session(model: bytes, *, threads: int = 1) -> Any:
    """Load a model into onnxruntime's CPU provider; OptionError if ``onnxruntime`` is not installed."""
    onnxruntime = package("onnxruntime")
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = threads
    settings.inter_op_num_threads = 1
    settings.log_severity_level = 3
    return onnxruntime.InferenceSession(model, settings, providers=["CPUExecutionProvider"])


def prepare(netlist: Netlist, *, form: str = "scan", threads: int = 1) -> OnnxEngine:
    """Export a netlist in a form, ``step`` or ``scan``, and load the file's content.

    Raises
    ------
    OptionError
        If ``onnx`` or ``onnxruntime`` is not installed.
    ModelError
        If the format cannot hold the network.
    """
    package("onnxruntime")  # before any work
    session = open_session(onnx_writer.export(netlist, form), threads=threads)
    layers = plan(netlist)
    runs = {layer.name: _runs(layer.ids) for layer in layers}
    return OnnxEngine(netlist=netlist, layers=layers, form=form, session=session, runs=runs)


def simulate(
    engine: OnnxEngine,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    membranes: bool = False,
    batch: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> OnnxTrace:
    """Run recordings (recordings, n_inputs, T), each from rest.

    Parameters
    ----------
    lengths : (recordings,) int64, optional
        Steps of each recording where some are shorter than T; those of one length run together.
    membranes : bool
        Whether to keep membranes; the form ``step`` alone has them.
    batch : int, optional
        Recordings that run together.
    progress : callable, optional
        Called with the number of recordings finished so far.

    Raises
    ------
    DataError, NumericRangeError
        If the recordings have other channels than the network, or a register overflows: the chip is not defined there.
    """
    netlist = engine.netlist
    check_channels(netlist, events.shape[1])
    recordings, _, length = events.shape
    shape = (recordings, length + netlist.max_depth, netlist.n_compartments)
    trace = OnnxTrace(
        spikes=np.zeros(shape, np.bool_),
        votes=np.zeros((recordings, netlist.classes), np.int64),
        membranes=np.zeros(shape, np.int32) if membranes else None,
    )
    ends = np.full(recordings, length) if lengths is None else np.asarray(lengths)
    run = _run_steps if engine.form == "step" else _run_scan
    size, done = batch or BATCH[engine.form], 0
    for end in np.unique(ends[ends > 0]).tolist():
        group = np.flatnonzero(ends == end)
        for start in range(0, len(group), size):
            which = group[start : start + size]
            # time first, zeros and ones
            run(
                engine,
                np.ascontiguousarray((events[which, :, :end] != 0).transpose(2, 0, 1)).view(np.uint8),
                which,
                trace,
            )
            done += len(which)
            if progress is not None:
                progress(done)
    return trace


def _run_scan(engine: OnnxEngine, events: EventArray, which: IntArray, trace: OnnxTrace) -> None:
    """Run some recordings of one length; `which` is where they belong in the trace."""
    names = [port.name for port in engine.session.get_outputs()]
    found = dict(zip(names, engine.session.run(names, {"events": events}), strict=True))
    if "overflow" in found:
        _stop(which[found["overflow"]], None)
    for layer in engine.layers:
        spikes = found[f"{layer.name}.spikes"].view(np.bool_).transpose(1, 0, 2)
        window = slice(layer.depth, layer.depth + len(events))
        _keep(trace.spikes[:, window], _runs(which), engine.runs[layer.name], spikes)
    if "votes" in found:
        trace.votes[which] = found["votes"]


def _run_steps(engine: OnnxEngine, events: EventArray, which: IntArray, trace: OnnxTrace) -> None:
    """The same, chip step by chip step; states go to and fro between two sets of arrays, without being copied."""
    steps, batch, _ = events.shape
    session = engine.session
    given = {port.name: _zeros(port, batch) for port in session.get_inputs()}
    left = {port.name: _zeros(port, batch) for port in session.get_outputs()}
    given["length"][...] = steps
    states = [name.removesuffix("_next") for name in left if name.endswith("_next")]
    swapped = given | {name: left[f"{name}_next"] for name in states}
    results = left, left | {f"{name}_next": given[name] for name in states}
    bindings = [_bound(session, *sides) for sides in zip((given, swapped), results, strict=True)]
    rows = _runs(which)
    for step in range(steps + engine.netlist.max_depth):
        given["events"][...] = events[step] if step < steps else 0
        session.run_with_iobinding(bindings[step % 2])
        found = results[step % 2]
        if "overflow" in found:
            _stop(which[found["overflow"]], step)
        for name, ids in engine.runs.items():
            _keep(trace.spikes[:, step], rows, ids, found[f"{name}.spikes_next"].view(np.bool_))
            if trace.membranes is not None:
                _keep(trace.membranes[:, step], rows, ids, found[f"{name}.membrane_next"])
    if "votes_next" in left:
        trace.votes[which] = found["votes_next"]


def _zeros(port: Any, batch: int) -> npt.NDArray[Any]:
    """Array for an input or output of a session."""
    return np.zeros([batch if size == "batch" else size for size in port.shape], KINDS[port.type])


def _bound(session: Any, given: dict[str, npt.NDArray[Any]], left: dict[str, npt.NDArray[Any]]) -> Any:
    """Bind arrays to inputs and outputs, in place."""
    wrap = package("onnxruntime").OrtValue.ortvalue_from_numpy
    binding = session.io_binding()
    for name, array in given.items():
        binding.bind_ortvalue_input(name, wrap(array))
    for name, array in left.items():
        binding.bind_ortvalue_output(name, wrap(array))
    return binding


def _runs(ids: IntArray) -> Runs:
    """Cut indices into runs of neighbours, which numpy copies many times faster than single ones."""
    ends = np.append(np.flatnonzero(np.diff(ids) != 1) + 1, len(ids)).tolist()
    begins = [0, *ends[:-1]]
    return [(slice(int(ids[a]), int(ids[a]) + b - a), slice(a, b)) for a, b in zip(begins, ends, strict=True)]


def _keep(kept: npt.NDArray[Any], rows: Runs, ids: Runs, values: npt.NDArray[Any]) -> None:
    """Write into some recordings and some compartments, the first and the last axis."""
    for row, own_row in rows:
        for place, own in ids:
            kept[row, ..., place] = values[own_row, ..., own]


def _stop(overflown: IntArray, step: int | None) -> None:
    if len(overflown):
        where = "" if step is None else f", chip step {step}"
        raise NumericRangeError(
            f"onnx: recording {overflown[0]}{where}: a register overflows, where the chip is not defined; "
            "compile with --ranges proven"
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
