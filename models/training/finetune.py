"""Quantisation-aware fine-tuning: train a network on the very integers that the chip will hold.

The storage of each layer is fixed first: a width, an exponent and a scale for every group of neurons, chosen so that
the rounded weights, weighted by how often their inputs spike, are nearest to the trained ones [2]_. Then the network is
trained on, with every weight rounded in the forward pass [1]_. Everything runs on one thread and from one seed, so
the same input gives the same weights.

References
----------
.. [1] Y. Bengio, N. Léonard, A. Courville, "Estimating or propagating gradients through stochastic neurons for
   conditional computation", 2013, arXiv:1308.3432: the straight-through estimator.
.. [2] F. Li, B. Zhang, B. Liu, "Ternary weight networks", 2016, arXiv:1605.04711: scales nearest to the weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from spikeloom.compiler import Packing, check_packings
from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.fixedpoint import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    MEMBRANE_SHIFT,
    THRESHOLD_MANTISSA_MAX,
    reach,
    step_units,
)
from spikeloom.compiler.formats.tensors import arrays_of
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.ir import Form, Network
from spikeloom.compiler.passes.calibrate import Calibration, calibrate, evenly_spaced
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import Target
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.networks import Weights
from spikeloom.models.networks.quantised import QuantisedNet
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.evaluate import evaluate, one_thread, rate_loss, require_finite
from spikeloom.models.training.resume import restore, set_rate, write_state
from spikeloom.models.training.robust import require_chance, worn

BATCH = 4
"""Recordings per step of the optimizer: the weights are rounded anew for each."""

LEARNING_RATE = 1e-3
"""At the start; it falls to zero along half a cosine."""

SILENT_RATE = 1e-4
"""Spike rate that an input without spikes is given, so that its weights still count."""

COARSEST = 12
"""Least threshold, in weight units: a coarser one would be off by more than the weights."""

SHARES = 40
"""Scales that are tried for each neuron."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TunedEpoch:
    """Figures of one epoch: counted from 1, mean loss, and training recordings decided right while it ran."""

    epoch: int
    loss: float
    correct: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tuned:
    """What a fine-tuning left."""

    weights: Weights  # As a checkpoint holds them; rounded by `forms` they are the chip's
    forms: tuple[Form, ...]  # Storage of each layer
    history: tuple[TunedEpoch, ...]
    # before, after: Test recordings decided right on the chip's integers, before the first epoch and after the last
    before: int
    after: int


def finetune(
    checkpoint: Checkpoint,
    adjacency: NDArray[np.float64],
    training: Recordings,
    test: Recordings,
    target: Target,
    *,
    bits: Sequence[int],
    groups: int = 8,
    epochs: int = 40,
    seed: int = 0,
    robust: float = 0.0,
    state: Path | None = None,
    resume: bool = False,
    after_epoch: Callable[[TunedEpoch], None] | None = None,
) -> Tuned:
    """Train a network on chip integers: storage of `bits`, one or one a layer, with at most so many `groups` of scales.

    Nothing is chosen on `test`, it is read before the first epoch and after the last. The `seed` is that of the order
    of recordings, and of what of them is lost (`robust`, see :func:`robust.worn`). The file `state` holds the state
    after each epoch, which the caller removes when the result is safe; `resume` goes on from it, to the same weights as
    without interruption.

    OptionError, ModelError or DataError if options, network or recordings cannot be used, or the loss is no longer a
    number.
    """
    packings = check_packings([Packing(bits=width, groups=groups) for width in bits], 1 + len(checkpoint.dense), target)
    widths = tuple(packing.bits for packing in packings)
    for name, value, least in (("--epochs", epochs, 1), ("--seed", seed, 0)):
        if value < least:
            raise OptionError(f"{name} {value}: allowed are {least} or more; choose another")
    require_chance(robust)
    network = expand(checkpoint, adjacency)
    calibration = calibrate(network, evenly_spaced(channels_last(training.events)))
    forms = initial_forms(network, calibration, widths, groups, target.choices["synapse.exponent"])
    options = {
        "checkpoint": checkpoint.sha256,
        "network": arrays_digest(arrays_of(checkpoint)),
        "beta": checkpoint.beta,
        "theta": checkpoint.theta,
        "chip": target.name,
        "graph": arrays_digest({"adjacency": adjacency}),
        "training data": arrays_digest(training.identity()),
        "test data": arrays_digest(test.identity()),
        "weight bits": list(widths),
        "scale groups": groups,
        "epochs": epochs,
        "seed": seed,
        "robust": robust,
    }
    order = np.random.default_rng(seed)
    history: list[TunedEpoch] = []
    with one_thread():
        model = QuantisedNet(checkpoint, adjacency, forms)
        model.make_legal()
        optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, amsgrad=True)
        _, before = evaluate(model, test)
        if resume and state is not None and state.exists():
            history, _ = restore(state, options, model, optimizer, order, TunedEpoch)
            model.round()
        with tqdm(total=epochs, initial=len(history), desc="finetune", unit="epoch", disable=None) as bar:
            for index in range(len(history), epochs):
                history.append(_epoch(model, optimizer, training, order, robust, index, epochs))
                if state is not None:
                    write_state(state, options, model, optimizer, order, history)
                bar.set_postfix(loss=f"{history[-1].loss:.4f}", training=f"{history[-1].correct}/{len(training)}")
                bar.update()
                if after_epoch is not None:
                    after_epoch(history[-1])
        _, after = evaluate(model, test)
    return Tuned(weights=_weights(model), forms=forms, history=tuple(history), before=before, after=after)


def _epoch(
    model: QuantisedNet,
    optimizer: torch.optim.Optimizer,
    training: Recordings,
    draw: np.random.Generator,
    robust: float,
    index: int,
    epochs: int,
) -> TunedEpoch:
    order = draw.permutation(len(training))
    steps = math.ceil(len(order) / BATCH)
    total, correct = 0.0, 0
    for step in range(steps):
        set_rate(optimizer, LEARNING_RATE * 0.5 * (1 + math.cos(math.pi * (index * steps + step) / (epochs * steps))))
        chosen = order[step * BATCH : (step + 1) * BATCH]
        optimizer.zero_grad()
        labels = training.labels[chosen]
        lengths = None if training.lengths is None else torch.tensor(training.lengths[chosen])
        rates = model(time_first(worn(training.events[chosen], robust, draw)), lengths)
        loss = rate_loss(rates, labels)
        loss.backward()  # type: ignore[no-untyped-call]
        require_finite(model, float(loss.detach()), index + 1, step + 1)
        optimizer.step()
        model.clip_weights()
        model.make_legal()
        total += float(loss.detach()) * len(chosen)
        correct += int(np.sum(rates.detach().numpy().argmax(axis=1) == labels))
    return TunedEpoch(epoch=index + 1, loss=total / len(order), correct=correct)


def _weights(model: QuantisedNet) -> Weights:
    found = {"conv1.hops": model.hops, "conv1.bias": model.conv_bias}
    for name, weight, bias in zip(model.names[1:], model.weights, model.biases, strict=True):
        found |= {f"{name}.weight": weight, f"{name}.bias": bias}
    return {name: parameter.detach().numpy().copy() for name, parameter in found.items()}


# -- the storage to begin with -----------------------------------------------------------------------------------------


def initial_forms(
    network: Network, calibration: Calibration, bits: Sequence[int], groups: int, exponents: tuple[int, ...]
) -> tuple[Form, ...]:
    """Storage whose rounded weights are nearest to the trained ones, neurons grouped by scale.

    `calibration` gives the rate of each input; every layer has its width in `bits` and so many scales at most.

    ModelError if no exponent gives a threshold and biases that the registers hold.
    """
    forms = []
    for post, (population, width) in enumerate(zip(network.populations, bits, strict=True)):
        incoming = [p for p in network.projections if p.post == post]
        weight = np.concatenate([p.weight.toarray() for p in incoming], axis=1)
        rate = np.concatenate([calibration.rate(p.pre, p.post) for p in incoming]) + SILENT_RATE
        step = _grouped(_nearest_steps(weight, rate, reach(width, (0,))), groups)  # model units in one step
        for exponent in sorted(exponents):
            threshold = np.rint(population.theta * step_units(width, (exponent,)) / step).astype(np.int64)
            if threshold.min() >= COARSEST:
                break
        largest = np.abs(threshold * population.bias).max(initial=0) / population.theta * (1 << MEMBRANE_SHIFT)
        if threshold.max() > THRESHOLD_MANTISSA_MAX or largest > BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX:
            raise ModelError(
                f"{population.name}: its weights are too small for its threshold or biases at {width} bits: the "
                "registers overflow; give it more bits"
            )
        forms.append(Form(bits=width, exponents=(exponent,), threshold=np.maximum(threshold, 1)))
    return tuple(forms)


def _nearest_steps(weight: NDArray[np.float64], rate: NDArray[np.float64], codes: int) -> NDArray[np.float64]:
    """Step of each neuron at which its rounded weights are nearest, in squares weighted by `rate`; shape (neurons,)."""
    peak = np.maximum(np.abs(weight).max(axis=1), 1e-9)
    best = np.full(len(weight), np.inf)
    chosen: NDArray[np.float64] = peak / codes
    for share in np.geomspace(1, 1 / 30, SHARES):
        step = peak * share / codes
        rounded = np.clip(np.rint(weight / step[:, None]), -codes, codes) * step[:, None]
        error = (rate * (weight - rounded) ** 2).sum(axis=1)
        better = error < best
        best[better], chosen[better] = error[better], step[better]
    unused = ~weight.any(axis=1)  # where a window sees no taxel any step will do
    if not unused.all():
        chosen[unused] = np.exp(np.log(chosen[~unused]).mean())
    return chosen


def _grouped(values: NDArray[np.float64], groups: int) -> NDArray[np.float64]:
    """Replace each value by the geometric mean of its group; groups by Lloyd's rule from quantiles."""
    logs = np.log(values)
    centres = np.quantile(logs, (np.arange(groups) + 0.5) / groups)
    nearest = np.zeros(len(logs), np.int64)
    for _ in range(50):
        nearest = np.abs(logs[:, None] - centres).argmin(axis=1)
        centres = np.array([logs[nearest == g].mean() if np.any(nearest == g) else centres[g] for g in range(groups)])
    shared: NDArray[np.float64] = np.exp(centres[nearest])
    return shared
