"""Quantisation-aware fine-tuning: train a network on the very integers that the chip will hold.

The storage of each layer is fixed first, and the integers to begin with: the compiler's. Then the network is
trained on, with every weight rounded in the forward pass [1]_. A checkpoint with the released dynamics
learns by its own loss, the squared error of its rates; of any other network nobody knows how it was trained,
so that it learns to decide as it does in floats [2]_. Everything runs on one thread and from one seed, so
the same input gives the same weights.

References
----------
.. [1] Y. Bengio, N. Léonard, A. Courville, "Estimating or propagating gradients through stochastic neurons for
   conditional computation", 2013, arXiv:1308.3432: the straight-through estimator.
.. [2] G. Hinton, O. Vinyals, J. Dean, "Distilling the knowledge in a neural network", 2015, arXiv:1503.02531.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import require_least
from spikeloom.compiler.interpret import channels_last, cut
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.storage import Cheapest, Fixed, Packing
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.compartments import Options, compile_network
from spikeloom.compiler.types import JsonObject
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.quantised import QuantisedNet
from spikeloom.models.networks.surrogate import RECTANGLE
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.evaluate import evaluate, one_thread, rate_loss, require_finite
from spikeloom.models.training.recipes import TIMED
from spikeloom.models.training.resume import Course, set_rate
from spikeloom.models.training.robust import disturb, require_chance

BATCH = 4
"""Recordings per step of the optimizer: the weights are rounded anew for each."""

LEARNING_RATE = 1e-3
"""At the start; it falls to zero along half a cosine."""

GENTLE_RATE = 3e-4
"""Learning rate of a network that learns to decide as in floats, which recurrence may drive far off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TunedEpoch:
    """One epoch, counted from 1: mean loss, and training recordings classified correctly meanwhile."""

    epoch: int
    loss: float
    correct: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tuned:
    """Outcome of a fine-tuning."""

    net: QuantisedNet  # With its weights in floats; rounded to its forms they are the chip's
    history: tuple[TunedEpoch, ...]
    # before, after: Test recordings that the chip's integers classify correctly, before and after training
    before: int
    after: int


def finetune(
    network: Network,
    training: Recordings,
    test: Recordings,
    target: Target,
    *,
    bits: Sequence[int] | None = None,
    groups: int = 8,
    epochs: int = 40,
    seed: int = 0,
    robust: float = 0.0,
    state: Path | None = None,
    resume: bool = False,
    after_epoch: Callable[[TunedEpoch], None] | None = None,
) -> Tuned:
    """Train a network on chip integers: `bits` wide, one or one a layer, with at most so many `groups` of scales.

    Without `bits` the storage is what the compiler chooses on held-out training recordings. Training starts
    from the compiler's integers; shared filters of a first layer start from its scales alone. Nothing is
    chosen on `test`. The `seed` orders the recordings, and draws what is lost of them (`robust`, see
    :func:`robust.disturb`). `state` and `resume` as of :func:`train.train`.

    A SpikeloomError if options, network or recordings cannot be used, or the loss is no longer a number.
    """
    require_least({"epochs": epochs, "seed": seed}, epochs=1, seed=0)
    require_chance(robust)
    packings = tuple(Packing(bits=width, groups=groups) for width in bits or ())
    storage = Fixed(packings) if packings else Cheapest()
    options = Options(storage=storage, keep_all=True, training_events=training.events)
    chosen = compile_network(network, options, target=target).integer
    released = has_released_dynamics(network)
    with one_thread():
        net = QuantisedNet(network, chosen.forms, RECTANGLE if released else TIMED.surrogate)
        teacher = None if released else float_rates(net.network, training)
        rate = LEARNING_RATE if released else GENTLE_RATE
        net.start_at(chosen)
        net.make_legal()
        settings = {"chip": target.name, "scale groups": groups, "epochs": epochs}
        settings |= {"seed": seed, "robust": robust}
        course = Course(
            options=_identity(net, training, test) | settings,
            network=net,
            optimizer=torch.optim.Adam(net.parameters(), lr=rate, amsgrad=True),
            draw=np.random.default_rng(seed),
            epoch=TunedEpoch,
        )
        _, before = evaluate(net, test)
        if resume and state is not None and state.exists():
            course.restore(state)
            net.round()
        course.run(
            epochs,
            lambda index: _run_epoch(course, net, training, teacher, robust, rate, index, epochs),
            state=state,
            after_epoch=after_epoch,
            shown=lambda epoch: _shown(epoch, len(training)),
            label="finetune",
        )
        _, after = evaluate(net, test)
    return Tuned(net=net, history=tuple(course.history), before=before, after=after)


def _shown(epoch: TunedEpoch, recordings: int) -> dict[str, str]:
    """What the bar says after an epoch."""
    return {"loss": f"{epoch.loss:.4f}", "training": f"{epoch.correct}/{recordings}"}


def _identity(net: QuantisedNet, training: Recordings, test: Recordings) -> JsonObject:
    """What the same fine-tuning begins with, as JSON values."""
    parameters = {name: parameter.detach().numpy() for name, parameter in net.named_parameters()}
    thresholds = {f"form.{i}": form.threshold for i, form in enumerate(net.forms)}
    return {
        "network": arrays_digest(parameters | thresholds),
        "beta": [population.beta for population in net.network.populations],
        "training data": arrays_digest(training.identity()),
        "test data": arrays_digest(test.identity()),
        "weight bits": [form.bits for form in net.forms],
    }


def has_released_dynamics(network: Network) -> bool:
    """Whether it comes from a checkpoint whose layers have one membrane decay, no lasting currents and no clocks."""
    decays = {(population.alpha, population.beta) for population in network.populations}
    plain = len(decays) == 1 and not network.populations[0].alpha and not network.input.clocks.channels
    return plain and network.convolution is not None


def float_rates(network: Network, recordings: Recordings) -> Tensor:
    """Spikes per step of each class in the float64 model, (samples, classes) float32."""
    known = calibrate(network, channels_last(recordings.events, network.input.clocks))
    spikes = cut(known.spikes[network.readout.population][:], recordings.lengths)
    votes = spikes.sum(axis=1) @ (network.readout.label[:, None] == np.arange(network.classes))
    return torch.tensor(votes / recordings.step_counts[:, None], dtype=torch.float32)


def _run_epoch(
    course: Course[TunedEpoch],
    model: QuantisedNet,
    training: Recordings,
    teacher: Tensor | None,
    robust: float,
    rate: float,
    index: int,
    epochs: int,
) -> TunedEpoch:
    """Train on all recordings once; `teacher` has the rates of the float model, where it is to decide as that does."""
    order = course.draw.permutation(len(training))
    steps = math.ceil(len(order) / BATCH)
    total = 0.0
    correct = 0
    for step in range(steps):
        set_rate(
            course.optimizer,
            rate * 0.5 * (1 + math.cos(math.pi * (index * steps + step) / (epochs * steps))),
        )
        chosen = order[step * BATCH : (step + 1) * BATCH]
        course.optimizer.zero_grad()
        lengths = None if training.lengths is None else torch.tensor(training.lengths[chosen])
        rates = model(time_first(disturb(training.events[chosen], robust, course.draw)), lengths)
        labels = training.labels[chosen]
        loss = rate_loss(rates, labels) if teacher is None else _distilled_loss(rates, teacher[chosen])
        loss.backward()  # type: ignore[no-untyped-call]
        require_finite(model, float(loss.detach()), index + 1, step + 1)
        course.optimizer.step()
        model.clip_weights()
        model.make_legal()
        total += float(loss.detach()) * len(chosen)
        correct += int(np.sum(rates.detach().numpy().argmax(axis=1) == labels))
    return TunedEpoch(epoch=index + 1, loss=total / len(order), correct=correct)


def _distilled_loss(rates: Tensor, teacher: Tensor) -> Tensor:
    """How far rates lead to other decisions than the float model's."""
    wanted = torch.softmax(TIMED.gain * teacher, dim=1)
    return torch.nn.functional.cross_entropy(TIMED.gain * rates, wanted)
