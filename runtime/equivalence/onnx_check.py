"""onnxruntime beside our engine and the specification, for ``verify --engine onnx``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler import Netlist
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.runtime.machines.loihi1 import onnx_engine
from spikeloom.runtime.machines.loihi1.engine import EventArray
from spikeloom.runtime.machines.loihi1.onnx_engine import OnnxEngine
from spikeloom.runtime.machines.loihi1.trace import BoolArray, Trace

PART = 64
"""Recordings whose spikes are held at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Check:
    """The integer graph of a netlist in both forms, loaded before any long work begins."""

    scan: OnnxEngine
    step: OnnxEngine


def prepare(netlist: Netlist) -> Check:
    """Export and load both forms; raises as :func:`onnx_engine.prepare` does."""
    return Check(scan=onnx_engine.prepare(netlist, form="scan"), step=onnx_engine.prepare(netlist, form="step"))


def differing(check: Check, events: EventArray, lengths: IntArray | None, spikes: BoolArray) -> int:
    """Entries (recording, chip step, compartment) in which the form ``scan`` differs from our engine's spikes."""
    found = 0
    for start in range(0, len(events), PART):
        part = slice(start, start + PART)
        trace = onnx_engine.simulate(check.scan, events[part], lengths=None if lengths is None else lengths[part])
        found += int(np.count_nonzero(trace.spikes != spikes[part]))
    return found


def as_specified(check: Check, events: Sequence[EventArray], specified: Sequence[Trace]) -> bool:
    """Whether the form ``step`` has every spike, membrane and vote of the specification's runs.

    Recordings are (n_inputs, T) uint8, each of its own length; `specified` is what the specification made of them.
    """
    netlist = check.step.netlist
    for recording, expected in zip(events, specified, strict=True):
        assert expected.spikes is not None, "the specification keeps spikes"
        assert expected.membranes is not None, "the specification keeps membranes"
        found = onnx_engine.simulate(check.step, recording[None], membranes=True)
        assert found.membranes is not None, "membranes were wanted"
        votes = [expected.counts.spikes[netlist.readout_class == label].sum() for label in range(netlist.classes)]
        same = (
            np.array_equal(found.spikes[0], expected.spikes)
            and np.array_equal(found.membranes[0], np.where(expected.spikes, 0, expected.membranes))
            and np.array_equal(found.votes[0], votes)
        )
        if not same:
            return False
    return True
