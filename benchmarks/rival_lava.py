"""Lava's bit-accurate processes as a worker: ``rival_lava.py TASK.npz``; each recording in a network of its own.

A `Dense` delays by a step, from the input too, and its weights lose their lowest bit, so twice the weight is stored at
one exponent less.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
from lava.magma.core.run_conditions import RunSteps
from lava.magma.core.run_configs import Loihi1SimCfg
from lava.proc.dense.process import Dense
from lava.proc.io.sink import RingBuffer as Sink
from lava.proc.io.source import RingBuffer as Source
from lava.proc.lif.process import LIF
from worker import Job, Layer, Task, serve


def make_neurons(layer: Layer) -> LIF:
    """A layer without synapses; each bias at the smallest exponent that holds it."""
    exponent = np.zeros(layer.size, np.int64)
    while np.any(large := np.abs(layer.bias >> exponent) > 4095):
        exponent += large
    return LIF(
        shape=(layer.size,),
        vth=layer.common_threshold() >> 6,
        du=4095,
        dv=layer.decay,
        bias_mant=layer.bias >> exponent,
        bias_exp=exponent,
    )


def prepare_job(task: Task, _options: list[str]) -> Job:
    steps = task.events.shape[1] + len(task.layers)

    def run(unit: int) -> list[np.ndarray]:
        events = np.zeros((task.events.shape[2], steps), np.int32)
        events[:, : task.events.shape[1]] = task.events[task.few[unit]].T
        source, groups, sinks = Source(data=events), [make_neurons(layer) for layer in task.layers], []
        for layer, neurons in zip(task.layers, groups, strict=True):
            for before in layer.weights:
                weight, power = layer.mantissas(before)
                synapses = Dense(
                    weights=2 * weight.astype(np.int32), num_weight_bits=8, weight_exp=power.bit_length() - 2
                )
                (groups[before] if before >= 0 else source).s_out.connect(synapses.s_in)
                synapses.a_out.connect(neurons.a_in)
            sinks.append(Sink(shape=(layer.size,), buffer=steps))
            neurons.s_out.connect(sinks[-1].a_in)
        source.run(condition=RunSteps(num_steps=steps), run_cfg=Loihi1SimCfg(select_tag="fixed_pt"))
        found = [sink.data.get().T.astype(np.bool_) for sink in sinks]
        source.stop()
        return found

    def differing(results: list[Any]) -> list[int]:
        return task.differing("piped1", [np.stack(layers) for layers in zip(*results, strict=True)])

    return Job(
        name=f"lava {version('lava-nc')}",
        units=len(task.few),
        recordings=len(task.few),
        run=run,
        differing=differing,
    )


if __name__ == "__main__":
    serve(prepare_job)
