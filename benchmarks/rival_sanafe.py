"""SANA-FE as a worker: ``rival_sanafe.py TASK.npz simple|detailed``; its own Loihi, our cores, events and energy.

Inputs sit on a core of their own; our core k is its core k + 1. It quantises the membrane itself, to 1/64.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
import sanafe
from worker import Job, Task, serve


def make_network(task: Task, architecture: Any) -> Any:
    """Neurons, synapses and their cores."""
    network = sanafe.Network()
    cores = architecture.cores()
    channels = network.create_neuron_group("in", task.events.shape[2])
    for channel in range(task.events.shape[2]):
        channels[channel].set_attributes(
            soma_hw_name=f"loihi_inputs[{channel}]", log_spikes=False, model_attributes={"spikes": []}
        )
        channels[channel].map_to_core(cores[0])
    groups = {-1: channels}
    for i, layer in enumerate(task.layers):
        groups[i] = group = network.create_neuron_group(
            f"layer{i}",
            layer.size,
            soma_hw_name="loihi_lif",
            log_spikes=True,
            default_synapse_hw_name="loihi_dense_synapse" if layer.dense else "loihi_sparse_synapse",
            default_dendrite_hw_name="loihi_dendrites",
            model_attributes={
                "reset": 0.0,
                "leak_decay": 1 - layer.decay / 4096,
                "input_decay": 0.0,
                "reset_mode": "hard",
                "force_update": True,
            },
        )
        for neuron, (bias, threshold, core) in enumerate(
            zip(layer.bias, layer.threshold, layer.core, strict=True)
        ):
            group[neuron].set_attributes(model_attributes={"bias": bias / 64, "threshold": threshold / 64})
            group[neuron].map_to_core(cores[1 + core])
    for i, layer in enumerate(task.layers):
        for before, weight in layer.weights.items():
            to, frm = np.nonzero(weight)
            pairs = list(zip(frm.tolist(), to.tolist(), strict=True))
            groups[before].connect_neurons_sparse(
                groups[i], {"weight": weight[to, frm].astype(float).tolist()}, pairs
            )
    return network


def prepare_job(task: Task, options: list[str]) -> Job:
    steps = task.events.shape[1] + len(task.layers)
    architecture = sanafe.load_loihi()
    chip = sanafe.SpikingChip(architecture)
    chip.load(make_network(task, architecture))

    def reset(unit: int) -> None:
        chip.reset()
        events = task.events[task.few[unit]]
        for channel, neuron in enumerate(chip.mapped_neuron_groups["in"]):
            # attributes of the soma would end up in the dendrite of a neuron that is mapped already
            neuron.set_attributes(model_attributes={"spikes": [bool(event) for event in events[:, channel]]})

    def simulate(*, trace: bool) -> Any:
        return chip.sim(
            steps,
            timing_model=options[0],
            processing_threads=1,
            scheduler_threads=0,
            spike_trace=True if trace else None,
        )

    def differing(_results: list[Any]) -> list[int]:
        """Of a run of its own: what is timed keeps no spikes, only energy, time and counts."""
        layers = [np.zeros((len(task.few), steps, layer.size), np.bool_) for layer in task.layers]
        for unit in range(len(task.few)):
            reset(unit)
            for step, fired in enumerate(simulate(trace=True)["spike_trace"]):
                for neuron in fired:
                    layers[int(neuron.group_name.removeprefix("layer"))][
                        unit, step, neuron.neuron_offset
                    ] = True
        return task.differing("piped1", layers)

    return Job(
        name=f"SANA-FE {version('sanafe')}, {options[0]} time model",
        units=len(task.few),
        recordings=len(task.few),
        run=lambda _unit: simulate(trace=False),
        differing=differing,
        reset=reset,
    )


if __name__ == "__main__":
    serve(prepare_job)
