"""Quantisation-aware fine-tuning: train a network on the very integers that the chip will hold.

The storage of each layer is fixed first: a width, an exponent and a scale for every group of neurons, chosen so that
the rounded weights, weighted by how often their inputs spike, are nearest to the trained ones. Then the network is
trained on, with every weight rounded in the forward pass [1]_. Everything runs on one thread and from one seed, so
the same input gives the same weights.

References
----------
.. [1] Y. Bengio, N. Léonard, A. Courville, "Estimating or propagating gradients through stochastic neurons for
   conditional computation", 2013, arXiv:1308.3432: the straight-through estimator.
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

from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.towers import arrays_of
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.ir import Form
from spikeloom.compiler.passes.calibrate import calibrate, evenly_spaced
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import Target
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.networks import Weights
from spikeloom.models.networks.quantised import QuantisedNet
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.evaluate import evaluate, one_thread, rate_loss, require_finite
from spikeloom.models.training.initial_storage import initial_forms
from spikeloom.models.training.resume import restore, set_rate, write_state

BATCH = 4
"""Recordings per step of the optimizer: the weights are rounded anew for each."""

LEARNING_RATE = 1e-3
"""At the start; it falls to zero along half a cosine."""


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


def check_bits(bits: Sequence[int], layers: int, target: Target) -> tuple[int, ...]:
    """One width for each layer; OptionError if the chip does not store one, or they are as many as neither."""
    if len(bits) not in (1, layers):
        raise OptionError(
            f"--weight-bits: {len(bits)} widths, the network has {layers} layers; give one, or one for each"
        )
    allowed = target.choices["synapse.weight_bits"]
    for width in bits:
        if width not in allowed:
            raise OptionError(
                f"--weight-bits {width}: {target.title} does not store that width; "
                f"allowed: {', '.join(map(str, allowed))}"
            )
    return tuple(bits) if len(bits) == layers else tuple(bits) * layers


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
    state: Path | None = None,
    resume: bool = False,
    after_epoch: Callable[[TunedEpoch], None] | None = None,
) -> Tuned:
    """Train a network on chip integers: storage of `bits`, one or one a layer, with at most so many `groups` of scales.

    Nothing is chosen on `test`, it is read before the first epoch and after the last. The `seed` is that of the order
    of recordings. The file `state` holds the state after each epoch, which the caller removes when the result is safe;
    `resume` goes on from it, to the same weights as without interruption.

    OptionError, ModelError or DataError if options, network or recordings cannot be used, or the loss is no longer a
    number.
    """
    widths = check_bits(bits, 1 + len(checkpoint.dense), target)
    for name, value, least in (("--epochs", epochs, 1), ("--seed", seed, 0)):
        if value < least:
            raise OptionError(f"{name} {value}: allowed are {least} or more; choose another")
    slots = target.limit("core.threshold_slots")
    if not 1 <= groups <= slots:
        raise OptionError(f"--scale-groups {groups}: allowed are 1 to {slots}, the thresholds of a core; choose one")
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
    }
    order = np.random.default_rng(seed)
    history: list[TunedEpoch] = []
    with one_thread():
        model = QuantisedNet(checkpoint, adjacency, forms)
        model.make_legal()
        optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, amsgrad=True)
        _, before = evaluate(model, test)
        if resume and state is not None and state.exists():
            epochs_before, _ = restore(state, options, model, optimizer, order)
            history = [TunedEpoch(**epoch) for epoch in epochs_before]
            model.round()
        with tqdm(total=epochs, initial=len(history), desc="finetune", unit="epoch", disable=None) as bar:
            for index in range(len(history), epochs):
                history.append(_epoch(model, optimizer, training, order.permutation(len(training)), index, epochs))
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
    order: NDArray[np.int64],
    index: int,
    epochs: int,
) -> TunedEpoch:
    steps = math.ceil(len(order) / BATCH)
    total, correct = 0.0, 0
    for step in range(steps):
        set_rate(optimizer, LEARNING_RATE * 0.5 * (1 + math.cos(math.pi * (index * steps + step) / (epochs * steps))))
        chosen = order[step * BATCH : (step + 1) * BATCH]
        optimizer.zero_grad()
        labels = training.labels[chosen]
        lengths = None if training.lengths is None else torch.tensor(training.lengths[chosen])
        rates = model(time_first(training.events[chosen]), lengths)
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
