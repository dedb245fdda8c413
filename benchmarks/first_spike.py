"""Bounds and exact search on networks that others verify: ``first_spike.py REPOSITORY IMAGES.gz OUT.json``.

REPOSITORY is a clone of brseong/SNN-Verification-Optimization (Seong, Kim and Ko, arXiv 2408.10900): trained weights,
their search, and ``results.csv`` with the times of their SMT, MILP and direct searches. IMAGES is MNIST's
``t10k-images-idx3-ubyte.gz``; theirs were training images. Their search imports ``z3-solver pulp python-mnist
torchvision snntorch scikit-learn``, beside what spikeloom needs.

Their question: a pixel spikes once, the brighter the earlier; neurons add weights up without a leak and spike once; the
class that spikes first decides. Do changes of the pixels' times by `delta` steps in all leave it first? It is another
encoding than that of ``spikeloom certify``, so the way of its proofs is written down for it here: bounds of spike times
through the layers, and where they do not decide, every single change at once.
"""

import argparse
import csv
import gzip
import importlib
import json
import math
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from made import made
from numpy.typing import NDArray

Times = NDArray[np.int64]
Numbers = NDArray[np.float64]

V = TypeVar("V")

THRESHOLD = 100.0
NETWORKS = ((5, 10), (5, 20), (64, 256), (64, 512), (256, 128))
"""Steps and hidden neurons."""

DELTAS = (1, 2, 3)
IMAGES = 14
FURTHEST = 16
"""Largest delta that bounds are asked for."""

EXACT = 2
"""Steps in all up to which every change is tried where bounds do not decide; one more takes a thousand times longer."""

PATIENCE = 100
"""Seconds in which their search answered an image, so that it is run here, too, until it took as long in all."""


class Network:
    """Weights (neurons, inputs) of two layers, and the steps of an inference."""

    def __init__(self, weights: list[Numbers], steps: int) -> None:
        self.weights = weights
        self.steps = steps

    def potentials(self, layer: int, times: Times) -> Numbers:
        """Potentials (neurons, steps) of a layer whose inputs spike at these times."""
        arriving = np.zeros((self.steps, len(self.weights[layer])))
        np.add.at(arriving, times, self.weights[layer].T)
        return arriving.cumsum(axis=0).T

    def times(self, potentials: Numbers) -> Times:
        """When neurons spike, a step after they cross the threshold, and in the last step at the latest."""
        crossed = potentials > THRESHOLD
        crossed[..., -1] = True
        return np.asarray(np.minimum(crossed.argmax(axis=-1) + 1, self.steps - 1))

    def outputs(self, pixels: Times) -> Times:
        """When each class spikes."""
        return self.times(self.potentials(1, self.times(self.potentials(0, pixels))))


def first_alone(outputs: Times, decision: int) -> Any:
    """Whether a class spikes before all others, by their times (..., classes)."""
    others = np.delete(outputs, decision, axis=-1)
    return others.min(axis=-1) > outputs[..., decision]


def proven(network: Network, pixels: Times, decision: int, delta: int) -> bool:
    """Whether bounds of spike times show that no changes by `delta` steps in all alter a decision.

    In each step a hidden potential lies within what the worst changes for this step add and take. A hidden
    neuron then spikes between two times, and counts for the output where this is worse for the decision.
    """
    potentials = network.potentials(0, pixels)
    up, down = np.zeros_like(potentials), np.zeros_like(potentials)
    for step in range(network.steps - 1):
        by = pixels - step  # steps by which a pixel has to change, so as to count in this step, or not to
        cost = np.where(by > 0, by, 1 - by)
        near = np.flatnonzero(cost <= delta)
        gain = np.where(by > 0, 1, -1)[near] * network.weights[0][:, near]
        up[:, step] = most(gain, cost[near], delta)
        down[:, step] = most(-gain, cost[near], delta)
    early, late = network.times(potentials + up), network.times(potentials - down)
    steps = np.arange(network.steps)
    sure = late[:, None] <= steps
    may = (early[:, None] <= steps) & ~sure
    weights = network.weights[1]
    known = weights @ sure
    first = network.times(known + np.maximum(weights, 0) @ may)
    last = network.times(known + np.minimum(weights, 0) @ may)
    return bool(np.delete(first, decision).min() > last[decision])


def most(gain: Numbers, cost: Times, delta: int) -> Numbers:
    """At least what changes that cost `delta` in all add up to, (neurons,): the best by cost, the last one in part."""
    rate = np.maximum(gain, 0) / cost
    order = np.argsort(-rate, axis=1)
    costs = cost[order]
    left = delta - (costs.cumsum(axis=1) - costs)
    return np.asarray((np.take_along_axis(rate, order, axis=1) * np.clip(left, 0, costs)).sum(axis=1))


def single_holds(network: Network, pixels: Times, decision: int) -> bool:
    """Whether no pixel alone, a step earlier or later, alters a decision: all are tried at once.

    A change by a step alters hidden potentials in one step, so each hidden neuron crosses there, no longer
    crosses there, or stays as it is.
    """
    steps, weights = network.steps, network.weights
    potentials = network.potentials(0, pixels)
    crossed = potentials > THRESHOLD
    crossed[:, -1] = True
    first = crossed.argmax(axis=1)
    beyond = crossed & (np.arange(steps) > first[:, None])
    beyond[:, -1] = True
    again = beyond.argmax(axis=1)

    later, earlier = np.flatnonzero(pixels < steps - 1), np.flatnonzero(pixels > 0)
    pixel = np.concatenate([later, earlier])
    sign = np.repeat([-1, 1], [len(later), len(earlier)])
    step = pixels[pixel] - (sign > 0)
    pixel, sign, step = (each[step < steps - 1] for each in (pixel, sign, step))
    crosses = potentials.T[step] + sign[:, None] * weights[0].T[pixel] > THRESHOLD
    change, neuron = np.nonzero((crosses != crossed.T[step]) & (step[:, None] <= first))
    if not len(change):
        return True
    before = np.minimum(first + 1, steps - 1)
    after = np.minimum(np.where(crosses[change, neuron], step[change], again[neuron]) + 1, steps - 1)
    changes, row = np.unique(change, return_inverse=True)
    arriving = np.zeros((len(changes), steps, len(weights[1])))
    np.add.at(arriving, (row, after), weights[1].T[neuron])
    np.add.at(arriving, (row, before[neuron]), -weights[1].T[neuron])
    changed = network.potentials(1, before) + arriving.cumsum(axis=1).transpose(0, 2, 1)
    return bool(first_alone(network.times(changed), decision).all())


def holds(network: Network, pixels: Times, decision: int, delta: int) -> bool:
    """Whether no changes by up to `delta` steps in all alter a decision, which spikes first alone without any."""
    if not first_alone(network.outputs(pixels), decision):
        return False
    if proven(network, pixels, decision, delta):
        return True
    if not single_holds(network, pixels, decision):
        return False
    return delta == 1 or all(
        holds(network, each, decision, delta - 1) for each in changed_by_one(pixels, network.steps)
    )


def changed_by_one(pixels: Times, steps: int) -> Iterator[Times]:
    """Images of which a pixel is a step earlier or later."""
    for pixel in range(len(pixels)):
        for by in (-1, 1):
            if 0 <= pixels[pixel] + by < steps:
                changed = pixels.copy()
                changed[pixel] += by
                yield changed


def furthest(network: Network, pixels: Times, decision: int) -> int:
    """Largest delta that bounds prove, up to FURTHEST."""
    low, high = 0, FURTHEST + 1
    while high - low > 1:
        middle = (low + high) // 2
        if proven(network, pixels, decision, middle):
            low = middle
        else:
            high = middle
    return low


def verdict(network: Network, pixels: Times, decision: int, delta: int) -> bool | None:
    """The same, and None where `delta` is beyond EXACT, bounds do not decide, and no fewer steps alter the decision."""
    if delta <= EXACT or proven(network, pixels, decision, delta):
        return holds(network, pixels, decision, delta)
    return None if holds(network, pixels, decision, EXACT) else False


class Theirs:
    """Their direct search, from their repository."""

    def __init__(self, repository: Path) -> None:
        sys.path.insert(0, str(repository))
        self.module = importlib.import_module("adv_rob_mnist_module")
        self.forward = importlib.import_module("utils.mnist_net").forward
        self.config = importlib.import_module("utils.config").CFG

    def holds(self, network: Network, pixels: Times, decision: int, delta: int) -> bool:
        """What their search says, in the order in which it goes through pixels by itself."""
        hidden = len(network.weights[0])
        shapes = ((28, 28), (hidden, 1), (10, 1))
        config = self.config(
            *("log", "mnist", None),
            n_layer_neurons=(784, hidden, 10),
            layer_shapes=shapes,
            num_steps=network.steps,
        )
        weights = [network.weights[0].reshape(hidden, 28, 28), network.weights[1].reshape(10, hidden, 1)]
        image = pixels.reshape(28, 28)
        order = np.mgrid[0:28, 0:28].reshape(2, -1).T
        for changed in self.module.search_perts(config, image, decision, delta, order, set(), {0}, weights):
            layers: list[Times] = []
            wins = self.forward(config, weights, changed, layers)
            rest = [each for each in range(10) if each != wins]
            if np.any(layers[-1][rest] <= layers[-1][decision]):
                return False
        return True


def published(repository: Path) -> dict[tuple[int, int, int], dict[str, float]]:
    """Their seconds by image, by steps, hidden neurons and delta: the least mean of each kind of search."""
    found: dict[tuple[int, int, int], dict[str, float]] = defaultdict(dict)
    with (repository / "results.csv").open() as file:
        for row in csv.DictReader(file):
            if (row["dataset"], row["coding"]) != ("mnist", "latency"):
                continue
            delta = int("".join(each for each in row["delta"] if each.isdigit()))
            seconds = [float(value) for name, value in row.items() if name.startswith("sample ") and value]
            mean = statistics.fmean(seconds) if seconds else math.inf
            kinds = found[int(row["steps"]), int(row["hidden"]), delta]
            if math.isfinite(mean):
                kinds[row["backend"]] = min(mean, kinds.get(row["backend"], math.inf))
    return found


def timed(holding: Callable[..., V], *question: Any) -> tuple[V, float]:
    """What comes out, and seconds of a core."""
    begun = time.process_time()
    return holding(*question), time.process_time() - begun


def row_of(network: Network, images: Times, delta: int, theirs: Theirs | None) -> dict[str, Any]:
    """Verdicts and seconds of ours and, where it is given time, of theirs, and how many images they differ on."""
    found: dict[str, Any] = {"hold": 0, "open": 0, "by_bounds": 0, "seconds": [], "theirs": [], "differ": 0}
    for pixels in images:
        decision = int(network.outputs(pixels).argmin())
        ours, seconds = timed(verdict, network, pixels, decision, delta)
        found["hold"] += ours is True
        found["open"] += ours is None
        found["by_bounds"] += proven(network, pixels, decision, delta)
        found["seconds"].append(round(seconds, 4))
        if theirs is not None and sum(found["theirs"]) < PATIENCE:
            other, seconds = timed(theirs.holds, network, pixels, decision, delta)
            found["theirs"].append(round(seconds, 3))
            found["differ"] += ours != other
    return found


def main() -> None:
    """Load, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("repository", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    grey = np.frombuffer(gzip.decompress(arguments.images.read_bytes()), np.uint8)[16:].reshape(-1, 784)
    theirs, times = Theirs(arguments.repository), published(arguments.repository)
    rows = []
    for steps, hidden in NETWORKS:
        folder = arguments.repository / "models" / f"{steps}_784_{hidden}_10"
        loaded = [np.load(folder / f"weights_{layer}.npy") for layer in (0, 1)]
        network = Network([each.reshape(len(each), -1) for each in loaded], steps)
        images = (255 - grey[:IMAGES].astype(np.int64)) * (steps - 1) // 255
        reach = [furthest(network, each, int(network.outputs(each).argmin())) for each in images]
        for delta in DELTAS:
            known = times[steps, hidden, delta]
            asked = theirs if known.get("np", math.inf) < PATIENCE else None
            row = {"steps": steps, "hidden": hidden, "delta": delta} | row_of(network, images, delta, asked)
            rows.append(row | {"furthest": reach, "published": known})
            print(json.dumps(rows[-1]), file=sys.stderr)
    arguments.output.write_text(json.dumps(made() | {"images": IMAGES, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
