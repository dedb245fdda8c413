"""torch as a worker: ``rival_torch.py TASK.npz layers|steps all|few``; floating point, decay 0.2 without rounding.

``layers`` multiplies a layer's weights with all steps at once, then walks through the steps. ``steps`` is the loop of
the released code: in every step each layer in turn, ``u = 0.2 u (1 - s) + W x + b``, with the graph convolution
already multiplied out (the released one also builds a graph object in every step).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from worker import Job, Task, serve

Stage = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Weight, bias and threshold of a layer, float32, in weight units."""


def by_layers(stages: list[Stage], events: torch.Tensor) -> list[torch.Tensor]:
    """One product a layer; (recordings, steps, channels) in, the same of each layer's spikes out."""
    found, spikes = [], events
    for weight, bias, threshold in stages:
        current = torch.nn.functional.linear(spikes, weight, bias)
        spikes = torch.empty_like(current)
        membrane = torch.zeros_like(current[:, 0])
        for step in range(events.shape[1]):
            membrane = membrane * 0.2 + current[:, step]
            fired = membrane > threshold
            spikes[:, step] = fired
            membrane = membrane.masked_fill(fired, 0)
        found.append(spikes)
    return found


def by_steps(stages: list[Stage], events: torch.Tensor) -> list[torch.Tensor]:
    """All layers in each step; shapes as in `by_layers`."""
    batch, steps, _ = events.shape
    membranes = [torch.zeros(batch, len(bias)) for _, bias, _ in stages]
    spikes = [torch.zeros(batch, len(bias)) for _, bias, _ in stages]
    found = [torch.empty(batch, steps, len(bias)) for _, bias, _ in stages]
    for step in range(steps):
        source = events[:, step]
        for i, (weight, bias, threshold) in enumerate(stages):
            current = torch.nn.functional.linear(source, weight, bias)
            membranes[i] = membranes[i] * 0.2 * (1 - spikes[i]) + current
            spikes[i] = (membranes[i] > threshold).float()
            found[i][:, step] = source = spikes[i]
    return found


LOOPS: dict[str, Callable[[list[Stage], torch.Tensor], list[torch.Tensor]]] = {
    "layers": by_layers,
    "steps": by_steps,
}


def prepare_job(task: Task, options: list[str]) -> Job:
    loop, share = options
    stages = [
        tuple(
            torch.tensor(array.astype(np.float32))
            for array in (layer.weight, layer.bias / 64, layer.threshold / 64)
        )
        for layer in task.layers
    ]
    events = torch.tensor(task.events.astype(np.float32))
    units = [events] if share == "all" else [events[i : i + 1] for i in task.few]

    def run(unit: int) -> list[torch.Tensor]:
        with torch.inference_mode():
            return LOOPS[loop](stages, units[unit])

    def differing(results: list[list[torch.Tensor]]) -> list[int]:
        which = task.few if share == "all" else slice(None)
        layers = [torch.cat(parts).numpy()[which] != 0 for parts in zip(*results, strict=True)]
        return task.differing("aligned", layers)

    return Job(
        name=f"torch {torch.__version__}",
        units=len(units),
        recordings=sum(len(unit) for unit in units),
        run=run,
        differing=differing,
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    serve(prepare_job)
