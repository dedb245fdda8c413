"""Random networks of whole numbers for TrueNorth, and their definition in plain loops."""

import numpy as np

from spikeloom.compiler.dynamics import clocks_over
from spikeloom.compiler.targets.truenorth.native import UNIT, NativeNetwork, Stage, highest_level, steepest_leak


def random_stage(rng, name, inputs, size, depth, *, copies, clocks) -> Stage:
    blocks, width = inputs.shape
    most = highest_level(copies)
    threshold = rng.integers(20, 400, blocks * size)
    reach = steepest_leak(threshold, depth) // 2
    return Stage(
        name=name,
        inputs=inputs,
        level=rng.integers(-most, most + 1, (blocks, width + clocks, size)),
        threshold=threshold,
        floor=threshold * rng.integers(1, 3, blocks * size),
        leak=rng.integers(-reach, reach + 1),
    )


def random_network(
    seed, *, copies=3, blocks=2, taxels=4, features=2, hidden=(6, 4), classes=3, clocks=2, steps=12
) -> NativeNetwork:
    """A first stage, hidden ones in blocks that receive a random half each, and two voters a class."""
    rng, fan_in = np.random.default_rng(seed), taxels * features
    stages = [random_stage(rng, "conv1", np.arange(2 * taxels)[None], fan_in, 0, copies=copies, clocks=0)]
    for depth, size in enumerate((*hidden, 2 * classes), 1):
        inputs = rng.permutation(fan_in).reshape(blocks, -1)
        stages.append(random_stage(rng, f"fc{depth}", inputs, size, depth, copies=copies, clocks=clocks))
        fan_in = blocks * size
    return NativeNetwork(
        taxels=taxels,
        polarities=2,
        classes=classes,
        copies=copies,
        stages=tuple(stages),
        clocks=clocks_over(clocks, steps),
    )


def random_events(seed, network, *, samples=2, steps=12):
    shape = (samples, network.taxels, network.polarities, steps)
    return (np.random.default_rng(seed).random(shape) < 0.4).astype(np.uint8)


def defined_spikes(network, events) -> dict[str, np.ndarray]:
    """Spikes (steps, neurons) of each layer for one recording (taxels, polarities, steps), as they are defined."""
    steps, found = events.shape[-1], {}
    before, ticks = events.reshape(-1, steps).T, network.clocks.events(steps).T
    for stage in network.stages:
        spikes = np.zeros((steps, stage.neurons), bool)
        for n in range(stage.neurons):
            block, column = divmod(n, stage.size)
            held = 0
            for t in range(steps):
                active = [*before[t, stage.inputs[block]], *ticks[t, : stage.clocks]]
                levels = zip(stage.level[block, :, column].tolist(), active, strict=True)
                held += UNIT * sum(level * int(x) for level, x in levels) + int(stage.leak[n])
                spikes[t, n] = held >= stage.threshold[n]
                held = 0 if spikes[t, n] else max(held, -int(stage.floor[n]))
        found[stage.name] = before = spikes
    return found
