"""The side of a rival: reads the task, runs it when told, answers with CPU seconds. Needs NumPy only.

A worker is started as ``python rival_X.py TASK.npz OPTIONS…`` and answers on its standard output in JSON, one line
each: first what it is and how many spikes differ from the reference, then one lap for every line that it reads.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

LEAST_LAP_S = 0.1
"""CPU time under which a lap repeats its work, so that one tick of the clock does not decide."""


class UnfitError(Exception):
    """The rival cannot run this network; the message says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """A layer as rivals see it; membranes, biases and thresholds count in 1/64 of a weight unit.

    Parameters
    ----------
    weights : dict of int to (neurons, sources) int64
        Weight units, by the layer that is listened to; the input is -1.
    bias, threshold, core : (neurons,) int64
        A spike needs a membrane above the threshold; `core` is where our placer put the neuron.
    decay : int
        4096ths of the membrane that a step takes.
    dense : bool
        Whether most of its synapses are stored in dense lists.
    """

    weights: dict[int, Any]
    bias: Any
    threshold: Any
    core: Any
    decay: int
    dense: bool

    @property
    def weight(self) -> Any:
        """Weights of a layer that listens to one other."""
        (weight,) = self.weights.values()
        return weight

    @property
    def size(self) -> int:
        """Number of neurons."""
        return len(self.bias)

    def mantissas(self, source: int | None = None) -> tuple[Any, int]:
        """Weights from a layer, by default the only one, as int8, and the power of two that they count.

        Raises
        ------
        UnfitError
            If 8 bits do not hold them.
        """
        weight, unit = self.weight if source is None else self.weights[source], 1
        while not np.any(weight % (2 * unit)) and np.any(weight):
            unit *= 2
        small = weight // unit
        if np.any(small != small.astype(np.int8)):
            raise UnfitError("its weights take more than 8 bits")
        return small.astype(np.int8), unit

    def common_threshold(self) -> int:
        """The threshold of all neurons.

        Raises
        ------
        UnfitError
            If they have several.
        """
        if np.any(self.threshold != self.threshold[0]):
            raise UnfitError("its thresholds differ within a layer")
        return int(self.threshold[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What the driver wrote down for all rivals of one network.

    Parameters
    ----------
    path : path
        Of the file; the netlist lies beside it.
    layers : list of Layer
        First to last.
    events : (recordings, steps, channels) uint8
        All recordings.
    few : (few,) int64
        Recordings that slow rivals run, and on which all are checked.
    """

    path: Path
    layers: list[Layer]
    events: Any
    few: Any

    def expected(self, kind: str, layer: int) -> Any:
        """Reference spikes of the few recordings, (few, steps, neurons) bool.

        Parameters
        ----------
        kind : {"aligned", "piped0", "piped1"}
            All layers in one step; or one step from layer to layer, biases on from the start, and 0 or 1 from the
            input to the first layer, with as many steps more as there are layers.
        layer : int
            Index.
        """
        with np.load(self.path) as arrays:
            steps = arrays["events"].shape[1] + (0 if kind == "aligned" else len(self.layers))
            shape = (len(self.few), steps, self.layers[layer].size)
            return (
                np.unpackbits(arrays[f"{kind}{layer}"], count=math.prod(shape)).reshape(shape).view(np.bool_)
            )

    def differing(self, kind: str, spikes: Sequence[Any]) -> list[int]:
        """Spikes of each layer that are not those of the reference."""
        return [int(np.count_nonzero(found != self.expected(kind, i))) for i, found in enumerate(spikes)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A rival, ready to run.

    Parameters
    ----------
    name : str
        Tool and version.
    units : int
        Parts that it runs one after the other: recordings, or one batch.
    recordings : int
        Recordings in all units together.
    run : callable
        Runs a unit and returns what `spikes` understands; this is what is timed.
    differing : callable
        Takes the results of all units of one pass; spikes of each layer that differ from the reference.
    reset : callable
        Brings a unit back to its start, not timed.
    """

    name: str
    units: int
    recordings: int
    run: Callable[[int], Any]
    differing: Callable[[list[Any]], list[int]]
    reset: Callable[[int], object] = lambda _unit: None


def read_task(path: str) -> Task:
    """Load a task file."""
    with np.load(path) as arrays:
        layers = [
            Layer(
                weights={
                    source: arrays[f"weight{i} {source}"].astype(np.int64)
                    for source in range(-1, int(arrays["layers"]))
                    if f"weight{i} {source}" in arrays
                },
                bias=arrays[f"bias{i}"],
                threshold=arrays[f"threshold{i}"],
                core=arrays[f"core{i}"],
                decay=int(arrays[f"decay{i}"]),
                dense=bool(arrays[f"dense{i}"]),
            )
            for i in range(int(arrays["layers"]))
        ]
        return Task(path=Path(path), layers=layers, events=arrays["events"], few=arrays["few"])


def peak_bytes() -> int:
    """Largest resident set of this process so far, its start included."""
    # the usual getrusage would still count the memory of the process that forked this one
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise OSError("/proc/self/status has no VmHWM")


def _pass(job: Job) -> tuple[list[Any], float]:
    """Run all units once; their results, and CPU seconds without resets."""
    results, spent = [], 0.0
    for unit in range(job.units):
        job.reset(unit)
        begun = time.process_time()
        results.append(job.run(unit))
        spent += time.process_time() - begun
    return results, spent


def serve(prepare: Callable[[Task, list[str]], Job]) -> None:
    """Answer the driver until it closes our input.

    Parameters
    ----------
    prepare : callable
        Makes the job of a task from the options on the command line; imports its tool.
    """
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what the tool prints is no answer

    def answer(message: dict[str, Any]) -> None:
        answers.write(json.dumps(message) + "\n")
        answers.flush()

    try:
        begun = time.process_time()
        job = prepare(read_task(sys.argv[1]), sys.argv[2:])
        prepared = time.process_time() - begun
    except UnfitError as error:
        answer({"skipped": str(error)})
        return
    results, first = _pass(job)
    differing = job.differing(results)
    del results
    answer({"tool": job.name, "differing_spikes": differing, "set_up_cpu_s": prepared, "first_cpu_s": first})
    passes = 0
    for _ in sys.stdin:
        passes = passes or max(1, math.ceil(LEAST_LAP_S / max(_pass(job)[1], 1e-6)))
        spent = sum(_pass(job)[1] for _ in range(passes))
        answer({"cpu_s": spent / passes / job.recordings, "peak_bytes": peak_bytes()})
