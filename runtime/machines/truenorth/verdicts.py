"""Crossbar cores against their definition and their model: every spike of every copy of every neuron."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.truenorth import engine, spec
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.intervals import wilson
from spikeloom.runtime.report.tables import table

Json = dict[str, Any]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """Chip against definition and model.

    Parameters
    ----------
    spec_samples, spec_differences : int
        Recordings on which engine and specification ran, and spikes, membranes and counts that differ.
    spikes : dict of str to int
        Spikes of the model by layer.
    differences : dict of str to int
        Of neurons on the chip, copies included, by layer: spikes that the model has not, or the reverse.
    overflows : int
        Ticks in which a membrane left its register.
    counts : (samples, classes) int64
        Votes on the chip.
    """

    spec_samples: int
    spec_differences: int
    spikes: dict[str, int]
    differences: dict[str, int]
    overflows: int
    counts: IntArray


def compare(
    netlist: CrossbarNetlist,
    model: Callable[[Any], Mapping[str, BoolArray]],
    first: Mapping[str, int],
    data: Recordings,
    *,
    spec_samples: int,
    spec_steps: int | None = None,
) -> Verdict:
    """Run the chip and the model on recordings, and count every spike that differs.

    Parameters
    ----------
    netlist : CrossbarNetlist
        Compiled from the model.
    model : callable
        Spikes (steps, neurons) of each layer for events (taxels, polarities, steps).
    first : mapping of str to int
        Tick in which a layer spikes for the first data step; for others as many data steps later.
    data : Recordings
        What to run.
    spec_samples : int
        Recordings, from the first, on which the specification runs, too.
    spec_steps : int, optional
        First steps of each to which that is confined.
    """
    prepared = engine.prepare(netlist)
    layers = list(netlist.layers)
    spikes, differences = dict.fromkeys(first, 0), dict.fromkeys(first, 0)
    counts, overflows, wrong = [], 0, 0
    for index in range(len(data)):
        progress(f"comparing: {index} of {len(data)}")
        events = data.events[index : index + 1, ..., : data.steps_of(index)]
        channels = with_clocks(events, netlist.clocks)
        deep = index < spec_samples and spec_steps is None
        trace = engine.simulate(prepared, channels, spikes=True, membranes=deep)
        assert trace.spikes is not None, "spikes were asked for"
        expected = model(events[0])
        steps = events.shape[-1]
        for name, late in first.items():
            chosen = np.flatnonzero(netlist.layer == layers.index(name))
            on_chip = trace.spikes[0, late : late + steps * netlist.bin_ticks][:, chosen]
            due = np.zeros_like(on_chip)
            due[:: netlist.bin_ticks] = expected[name][:, netlist.neuron[chosen]]
            spikes[name] += int(expected[name].sum())
            differences[name] += int(np.count_nonzero(on_chip != due))
        overflows += int(trace.counts.overflows.sum())
        counts.append(class_counts(netlist, trace.counts.votes)[0])
        if index < spec_samples and spec_steps is not None:
            trace = engine.simulate(prepared, channels[..., :spec_steps], spikes=True, membranes=True)
        if index < spec_samples:
            wrong += _against_spec(netlist, channels[0, :, :spec_steps], trace)
    return Verdict(
        spec_samples=min(spec_samples, len(data)),
        spec_differences=wrong,
        spikes=spikes,
        differences=differences,
        overflows=overflows,
        counts=np.array(counts, np.int64).reshape(len(data), netlist.classes),
    )


def _against_spec(netlist: CrossbarNetlist, channels: Any, trace: Any) -> int:
    """Spikes, membranes, and spikes on axons that differ between engine and specification."""
    slow = spec.simulate(netlist, channels)
    pairs = (
        (slow.spikes, trace.spikes[0]),
        (slow.membranes, trace.membranes[0]),
        (slow.counts.axons, trace.counts.axons[0]),
        (slow.counts.votes, trace.counts.votes[0]),
    )
    return sum(int(np.count_nonzero(one != other)) for one, other in pairs)


def verdict_json(verdict: Verdict, data: Recordings, chip: Target) -> Json:
    """JSON values of a comparison."""
    correct = int(np.count_nonzero(vote(verdict.counts) == data.labels))
    different = sum(verdict.differences.values())
    return {
        "target": chip.name,
        "samples": len(data),
        "E0": {"samples": verdict.spec_samples, "differences": verdict.spec_differences},
        "E1": {
            "differences": different,
            "layers": [
                {"name": name, "spikes": verdict.spikes[name], "differences": verdict.differences[name]}
                for name in verdict.spikes
            ],
        },
        "membranes_saturated": verdict.overflows,
        "correct": correct,
        "exact": not (different or verdict.spec_differences or verdict.overflows),
    }


def verdict_text(report: Json) -> str:
    """The same for people."""
    samples, correct = report["samples"], report["correct"]
    low, high = wilson(correct, samples)
    spec_part, model_part = report["E0"], report["E1"]
    rows = [[layer["name"], f"{layer['spikes']:,}", f"{layer['differences']:,}"] for layer in model_part["layers"]]
    return "\n".join(
        [
            f"E0 specification = engine: {_told(spec_part)}{_part(report)}, membranes and counts too",
            f"E1 model = chip: {_told(model_part | {'samples': samples})}, every copy of every neuron",
            table(["layer", "spikes of the model", "different"], rows),
            f"membranes that left their register: {report['membranes_saturated']:,}",
            *_sums(report),
            f"accuracy of the chip: {correct} of {samples}, {100 * correct / samples:.2f} % "
            f"(95 %: {100 * low:.1f} … {100 * high:.1f}); the model's is the same, vote for vote"
            if report["exact"]
            else f"accuracy of the chip: {correct} of {samples}, {100 * correct / samples:.2f} %",
        ]
    )


def _part(report: Json) -> str:
    return f" (the first {report['spec_steps']} steps of each)" if "spec_steps" in report else ""


def _sums(report: Json) -> list[str]:
    """Partial sums that travel in time, and those that saturate."""
    rows = [
        [
            sums["layer"],
            f"{sums['partial']:,}",
            f"{sums['saturated']:,} ({100 * sums['saturated'] / max(sums['partial'], 1):.2g} %)",
            str(sums["largest"]),
        ]
        for sums in report.get("sums", ())
    ]
    return [table(["layer", "partial sums", "saturated", "largest"], rows)] if rows else []


def _told(level: Json) -> str:
    on = f"on {level['samples']} recording{'s' * (level['samples'] != 1)}"
    return f"{level['differences']:,} differences {on}" if level["differences"] else f"equal in every spike {on}"
