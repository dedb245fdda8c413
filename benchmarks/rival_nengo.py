"""nengo-loihi's emulator as a worker: ``rival_nengo.py TASK.npz cores|layers``; integers of the chip, block by block.

``cores`` makes a block of the neurons of a layer on each core, ``layers`` one of each layer, which is faster but more
than a core holds; the emulator alone does not mind.
Its own builder would choose scales of its own, so blocks are filled by hand. It takes float weights only after
discretising them; blocks that already hold int32 are run as they are.
"""

from __future__ import annotations

from typing import Any

import nengo_loihi
import numpy as np
from nengo_loihi.block import Axon, LoihiBlock, Synapse
from nengo_loihi.builder import Model
from nengo_loihi.emulator import EmulatorInterface
from nengo_loihi.inputs import SpikeInput
from nengo_loihi.probe import LoihiProbe
from worker import Job, Layer, Task, serve

LIMIT = 2**23 - 1


def make_block(layer: Layer, ids: Any, name: str) -> LoihiBlock:
    """Some neurons of a layer, without synapses."""
    block = LoihiBlock(len(ids), label=name)
    neurons = block.compartment
    neurons.decay_u = np.full(len(ids), 4095, np.int32)
    neurons.decay_v = np.full(len(ids), layer.decay, np.int32)
    neurons.refract_delay = np.ones(len(ids), np.int32)
    neurons.vth = layer.threshold[ids].astype(np.int32)
    neurons.bias = layer.bias[ids].astype(np.int32)
    neurons.vmin, neurons.vmax = -LIMIT, LIMIT
    neurons.scale_u = neurons.scale_v = False
    neurons.noise_exp = neurons.noise_offset = 0
    return block


def connect(source: SpikeInput | LoihiBlock, block: LoihiBlock, weight: Any) -> None:
    """Synapses from all neurons of a source, one axon each; zeros are left out."""
    sources = weight.shape[1]
    targets = [np.flatnonzero(column) for column in weight.T]
    weights = [(column[ids] << 6).astype(np.int32) for column, ids in zip(weight.T, targets, strict=True)]
    synapse = Synapse(sources)
    synapse._set_weights_indices(
        [w.reshape(1, -1) for w in weights], [ids.reshape(1, -1) for ids in targets], weight_dtype=np.int32
    )
    block.add_synapse(synapse)
    axon = Axon(sources)
    axon.target = synapse
    axon.set_compartment_axon_map(np.arange(sources))
    source.add_axon(axon)


def prepare_job(task: Task, options: list[str]) -> Job:
    steps = task.events.shape[1] + len(task.layers)
    model = Model()
    spike_input = SpikeInput(task.events.shape[2])
    model.add_input(spike_input)
    sources: dict[int, list[tuple[SpikeInput | LoihiBlock, Any]]] = {
        -1: [(spike_input, np.arange(task.events.shape[2]))]
    }
    for i, layer in enumerate(task.layers):
        place = layer.core if options == ["cores"] else np.zeros(layer.size, np.int64)
        members = {int(core): np.flatnonzero(place == core) for core in np.unique(place)}
        sources[i] = [(make_block(layer, ids, f"layer{i} core{core}"), ids) for core, ids in members.items()]
    probes: list[list[tuple[LoihiProbe, Any]]] = []
    for i, layer in enumerate(task.layers):
        for block, ids in sources[i]:
            for before, weight in layer.weights.items():
                for source, neurons in sources[before]:
                    connect(source, block, weight[np.ix_(ids, neurons)])
            model.add_block(block)
        probes.append([(LoihiProbe(target=block, key="spiked"), ids) for block, ids in sources[i]])
        for probe, _ in probes[-1]:
            model.add_probe(probe)
    emulator: list[EmulatorInterface] = []

    def reset(unit: int) -> None:
        """A new emulator of the same blocks, with another recording."""
        spike_input.spikes.clear()
        for step, channels in enumerate(task.events[task.few[unit]]):
            spike_input.add_spikes(step + 1, np.flatnonzero(channels), permanent=True)
        emulator[:] = [EmulatorInterface(model, seed=0)]

    def run(_unit: int) -> list[np.ndarray]:
        emulator[0].run_steps(steps)
        found = []
        for layer, blocks in zip(task.layers, probes, strict=True):
            spikes = np.zeros((steps, layer.size), np.bool_)
            for probe, ids in blocks:
                spikes[:, ids] = emulator[0].probes.outputs[probe][0]
            found.append(spikes)
        return found

    def differing(results: list[list[np.ndarray]]) -> list[int]:
        return task.differing("piped1", [np.stack(parts) for parts in zip(*results, strict=True)])

    return Job(
        name=f"nengo-loihi {nengo_loihi.__version__}",
        units=len(task.few),
        recordings=len(task.few),
        run=run,
        differing=differing,
        reset=reset,
    )


if __name__ == "__main__":
    serve(prepare_job)
