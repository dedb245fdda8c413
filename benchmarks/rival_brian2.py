"""brian2-loihi as a worker: ``rival_brian2.py TASK.npz``; generated code in Cython.

It has no biases: a neuron that always fires stands in, with synapses of plain Brian 2 whose weights are the biases.
Of mixed-sign weights it drops the lowest bit, as the chip does, so twice the weight is stored at one exponent less.
"""

from __future__ import annotations

from importlib.metadata import version

import brian2
import numpy as np
from brian2_loihi import (
    LoihiNetwork,
    LoihiNeuronGroup,
    LoihiSpikeGeneratorGroup,
    LoihiSpikeMonitor,
    LoihiSynapses,
    synapse_sign_mode,
)
from worker import Job, Task, serve


def prepare_job(task: Task, _options: list[str]) -> Job:
    brian2.prefs.codegen.target = "cython"
    steps = task.events.shape[1] + len(task.layers)

    def of(unit: int) -> tuple[np.ndarray, np.ndarray]:
        step, channel = np.nonzero(task.events[task.few[unit]])
        return channel, step

    source = LoihiSpikeGeneratorGroup(task.events.shape[2], *of(0))
    always = LoihiSpikeGeneratorGroup(1, np.zeros(steps, int), np.arange(steps))
    groups = [
        LoihiNeuronGroup(
            layer.size,
            refractory=1,
            threshold_v_mant=layer.common_threshold() >> 6,
            decay_v=layer.decay,
            decay_I=4096,
        )
        for layer in task.layers
    ]
    monitors = [LoihiSpikeMonitor(neurons) for neurons in groups]
    parts = [source, always, *groups, *monitors]
    for layer, neurons in zip(task.layers, groups, strict=True):
        for before in layer.weights:
            weight, unit = layer.mantissas(before)
            synapses = LoihiSynapses(
                groups[before] if before >= 0 else source,
                neurons,
                sign_mode=synapse_sign_mode.MIXED,
                w_exp=unit.bit_length() - 2,
            )  # 2w at log2(unit) - 1
            to, frm = np.nonzero(weight)
            synapses.connect(i=frm, j=to)
            synapses.w = 2 * weight[to, frm].astype(int)
            parts.append(synapses)
        biases = brian2.Synapses(
            always, neurons, model="bias : 1 (constant)", on_pre="I_post += bias", delay=0 * brian2.ms
        )
        biases.connect(i=0, j=np.arange(layer.size))
        biases.bias = layer.bias.astype(float)
        parts.append(biases)
    network = LoihiNetwork(*parts)
    network.run(0)  # generates and compiles
    network.store()

    def reset(unit: int) -> None:
        network.restore()
        channel, step = of(unit)
        source.set_spikes(channel, step * brian2.ms)

    def run(_unit: int) -> list[np.ndarray]:
        network.run(steps)
        found = []
        for monitor, layer in zip(monitors, task.layers, strict=True):
            spikes = np.zeros((steps, layer.size), np.bool_)
            spikes[np.rint(np.asarray(monitor.t, float)).astype(int), np.asarray(monitor.i)] = True
            found.append(spikes)
        return found

    def differing(results: list[list[np.ndarray]]) -> list[int]:
        return task.differing("piped0", [np.stack(layers) for layers in zip(*results, strict=True)])

    return Job(
        name=f"brian2-loihi {version('brian2-loihi')} on Brian {version('brian2')}",
        units=len(task.few),
        recordings=len(task.few),
        run=run,
        differing=differing,
        reset=reset,
    )


if __name__ == "__main__":
    serve(prepare_job)
