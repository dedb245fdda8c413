"""Time training on one core: our epochs, and beside them the released code's steps on the same recordings.

    OMP_NUM_THREADS=1 taskset -c 0 python benchmarks/training_epoch.py RECORDINGS [--system tactilesgnet]
        [--graph manual] [--epochs 4] [--released CODE]

Prints CPU and wall seconds of each epoch, evaluation on the test split included; the first holds the compilation of
the kernels. With ``--released``, a folder with the released ``tactileSGNet.py`` and ``to_graph.py`` (run, not copied;
needs torch_geometric), both networks take training steps from the same weights on the same recordings, in turns: CPU
milliseconds a step, the ratio within each turn, and how far the losses of the first step are apart.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from spikeloom.compiler.systems import SYSTEMS, TACTILESGNET
from spikeloom.models.graphs import Graph, build_graph, normalised_adjacency
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import HOPS, filters_of, propagation_of, sensor_grid
from spikeloom.models.training.evaluate import rate_loss
from spikeloom.models.training.train import Epoch, train

TURNS, STEPS = 5, 6
RATE = 1e-3


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings")
    parser.add_argument("--system", choices=SYSTEMS, default=TACTILESGNET)
    parser.add_argument("--graph", default="manual")
    parser.add_argument("--epochs", type=int, default=4)
    parser.add_argument("--released", metavar="CODE")
    arguments = parser.parse_args()

    graph = build_graph(arguments.graph)
    training = load_data(arguments.recordings, "train")
    test = load_data(arguments.recordings, "test")
    found = {"system": arguments.system, "training_samples": len(training), "test_samples": len(test)}
    found |= _epochs(arguments.system, arguments.epochs, training, test, graph)
    if arguments.released:
        found["released"] = _beside_released(arguments.released, training, graph)
    print(json.dumps(found, indent=2))


def _epochs(system: str, epochs: int, training: Recordings, test: Recordings, graph: Graph) -> dict[str, Any]:
    taxels = graph.n_taxels
    grid = sensor_grid(graph.coordinates, "none") if system == "grid-cnn" else None
    marks = [(time.process_time(), time.perf_counter())]

    def mark(_epoch: Epoch) -> None:
        marks.append((time.process_time(), time.perf_counter()))

    train(
        training,
        test,
        propagation_of(system, graph.edges, taxels, grid, filters_of(system, taxels, HOPS)),
        Architecture(taxels=taxels, classes=int(training.labels.max()) + 1, system=system),
        epochs=epochs,
        after_epoch=mark,
    )
    spans = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(marks)]
    return {"cpu_s": [round(cpu, 2) for cpu, _ in spans], "wall_s": [round(wall, 2) for _, wall in spans]}


def _beside_released(code: str, training: Recordings, graph: Graph) -> dict[str, Any]:
    sys.path.insert(0, code)
    import tactileSGNet as released  # noqa: N813

    classes = int(training.labels.max()) + 1
    ours = SpikingNet(
        Architecture(taxels=graph.n_taxels, classes=classes), normalised_adjacency(graph.edges, graph.n_taxels)
    )
    theirs = released.TactileSGNet(classes, 0, device="cpu")  # 0: the manual graph
    weights = ours.export_weights()
    state = {f"conv1.lins.{k}.weight": hop for k, hop in enumerate(weights["conv1.hops"])}
    state |= {name: array for name, array in weights.items() if name != "conv1.hops"}
    theirs.load_state_dict({name: torch.tensor(array) for name, array in state.items()})

    def our_loss(index: int) -> Any:
        events = np.moveaxis(training.events[index : index + 1], -1, 0)
        return rate_loss(ours(torch.tensor(np.ascontiguousarray(events, np.float32))), training.labels[index, None])

    def their_loss(index: int) -> Any:
        rates = theirs(torch.tensor(training.events[index], dtype=torch.float32))
        return rate_loss(rates[None], training.labels[index, None])

    apart = [float((our_loss(index) - their_loss(index)).detach().abs()) for index in range(STEPS)]
    step_ours = _stepper(ours, our_loss, fused=True)
    step_theirs = _stepper(theirs, their_loss, fused=False)
    step_ours(0)  # compiled and warm
    step_theirs(0)
    pairs = []
    for turn in range(TURNS):
        indices = range(turn * STEPS, (turn + 1) * STEPS)
        pairs.append((_milliseconds(step_ours, indices), _milliseconds(step_theirs, indices)))
    ratios = [theirs_ms / ours_ms for ours_ms, theirs_ms in pairs]
    return {
        "ours_ms": round(statistics.median(ours_ms for ours_ms, _ in pairs), 2),
        "released_ms": round(statistics.median(theirs_ms for _, theirs_ms in pairs), 1),
        "ratio": round(statistics.median(ratios), 1),
        "ratios": [round(ratio, 1) for ratio in ratios],
        "loss_apart_before_training": max(apart),
    }


def _stepper(net: torch.nn.Module, loss_of: Callable[[int], Any], *, fused: bool) -> Callable[[int], None]:
    optimizer = torch.optim.Adam(net.parameters(), lr=RATE, amsgrad=True, fused=fused)

    def step(index: int) -> None:
        optimizer.zero_grad()
        loss_of(index).backward()
        optimizer.step()

    return step


def _milliseconds(step: Callable[[int], None], indices: range) -> float:
    start = time.process_time()
    for index in indices:
        step(index)
    return (time.process_time() - start) / len(indices) * 1e3


if __name__ == "__main__":
    main()
