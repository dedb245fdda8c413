"""The integer ONNX graph of a netlist, run by onnxruntime: an engine whose arithmetic nobody here wrote.

It takes recordings as :func:`runtime.engine.simulate` does and gives the same spikes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from compiler.errors import NumericRangeError, OptionError
from compiler.fixedpoint import IntArray
from compiler.netlist import Netlist
from runtime import onnx_graph
from runtime.engine import EventArray
from runtime.onnx_plan import Layer, plan
from runtime.trace import BoolArray, MembraneArray, check_channels

BATCH = {"step": 64, "scan": 16}
"""Recordings that run together: few enough for the caches."""

KINDS = {f"tensor({kind})": np.dtype(kind) for kind in ("bool", "uint8", "int32", "int64")}
"""Types of onnxruntime that the graphs use."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OnnxEngine:
    """A netlist in onnxruntime, made by :func:`prepare`; `session` is an ``onnxruntime.InferenceSession``."""

    netlist: Netlist
    layers: tuple[Layer, ...]
    form: str
    session: Any


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OnnxTrace:
    """What it did.

    Parameters
    ----------
    spikes : (recordings, chip steps, compartments) bool
        As in :class:`runtime.trace.Trace`.
    votes : (recordings, classes) int64
        Spikes of the read-out, as the graph counts them.
    membranes : (recordings, chip steps, compartments) int32, or None
        After the reset: zero where a compartment spiked or its window is closed. Form ``step`` only.
    """

    spikes: BoolArray
    votes: IntArray
    membranes: MembraneArray | None


def onnxruntime_package() -> Any:
    """The package ``onnxruntime``, imported when it is first needed.

    Raises
    ------
    OptionError
        If it is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise OptionError(
            "onnxruntime: the package is not installed; install it with pip install onnxruntime"
        ) from error
    return onnxruntime


def open_session(model: bytes, *, threads: int = 1) -> Any:
    """Load a model into onnxruntime's CPU provider."""
    package = onnxruntime_package()
    settings = package.SessionOptions()
    settings.intra_op_num_threads = threads
    settings.inter_op_num_threads = 1
    settings.log_severity_level = 3
    return package.InferenceSession(model, settings, providers=["CPUExecutionProvider"])


def prepare(netlist: Netlist, *, form: str = "scan", threads: int = 1) -> OnnxEngine:
    """Export a netlist and load the file's content.

    Parameters
    ----------
    netlist : Netlist
        Network.
    form : {"step", "scan"}
        See :mod:`runtime.onnx_graph`.
    threads : int
        Threads of one operator.

    Raises
    ------
    OptionError
        If ``onnx`` or ``onnxruntime`` is not installed.
    ModelError
        If the format cannot hold the network.
    """
    onnxruntime_package()
    session = open_session(onnx_graph.export(netlist, form), threads=threads)
    return OnnxEngine(netlist=netlist, layers=plan(netlist), form=form, session=session)


def simulate(
    engine: OnnxEngine,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    membranes: bool = False,
    batch: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> OnnxTrace:
    """Run recordings, each from rest.

    Parameters
    ----------
    engine : OnnxEngine
        Network.
    events : (recordings, n_inputs, T) uint8 or bool
        Input events; any value but zero is an event.
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
    DataError
        If the recordings have another number of input channels than the network.
    NumericRangeError
        If a register overflows: the chip is not defined there.
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
        spikes, ids = found[f"{layer.name}.spikes"].view(np.bool_), _span(layer.ids)
        for place, index in enumerate(which):
            trace.spikes[index, layer.depth : layer.depth + len(events)][:, ids] = spikes[:, place]
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
    spans = [(layer.name, _span(layer.ids)) for layer in engine.layers]
    for step in range(steps + engine.netlist.max_depth):
        given["events"][...] = events[step] if step < steps else 0
        session.run_with_iobinding(bindings[step % 2])
        found = results[step % 2]
        if "overflow" in found:
            _stop(which[found["overflow"]], step)
        for name, ids in spans:
            spikes = found[f"{name}.spikes_next"].view(np.bool_)
            for place, index in enumerate(which):
                trace.spikes[index, step][ids] = spikes[place]
                if trace.membranes is not None:
                    trace.membranes[index, step][ids] = found[f"{name}.membrane_next"][place]
    if "votes_next" in left:
        trace.votes[which] = found["votes_next"]


def _zeros(port: Any, batch: int) -> npt.NDArray[Any]:
    """Array for an input or output of a session."""
    return np.zeros([batch if size == "batch" else size for size in port.shape], KINDS[port.type])


def _bound(session: Any, given: dict[str, npt.NDArray[Any]], left: dict[str, npt.NDArray[Any]]) -> Any:
    """Bind arrays to inputs and outputs, in place."""
    wrap = onnxruntime_package().OrtValue.ortvalue_from_numpy
    binding = session.io_binding()
    for name, array in given.items():
        binding.bind_ortvalue_input(name, wrap(array))
    for name, array in left.items():
        binding.bind_ortvalue_output(name, wrap(array))
    return binding


def _span(ids: IntArray) -> slice | IntArray:
    """Compartments as a slice where they follow each other, which numpy copies faster."""
    first, last = int(ids[0]), int(ids[-1])
    return slice(first, last + 1) if np.all(np.diff(ids) == 1) else ids


def _stop(overflown: IntArray, step: int | None) -> None:
    if len(overflown):
        where = "" if step is None else f", chip step {step}"
        raise NumericRangeError(
            f"onnx: recording {overflown[0]}{where}: a register overflows, where the chip is not defined; "
            "compile with --ranges proven"
        )
