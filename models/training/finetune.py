"""Quantisation-aware fine-tuning: train a network on the very integers that the chip will hold.

The storage of each layer is fixed first, and the integers to begin with: the compiler's. Then the network is trained
on, with every weight rounded in the forward pass [1]_. A checkpoint with the released dynamics learns by its own loss,
the squared error of its rates; of any other network nobody knows how it was trained, so that it learns to decide as it
does in floats [2]_. Everything runs on one thread and from one seed, so the same input gives the same weights.

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
from tqdm import tqdm

from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import require_least
from spikeloom.compiler.interpret import channels_last, cut
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.storage import KEEP, Packing
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.compartments import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.quantised import QuantisedNet
from spikeloom.models.networks.surrogate import RECTANGLE
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.evaluate import evaluate, one_thread, rate_loss, require_finite
from spikeloom.models.training.recipes import TIMED
from spikeloom.models.training.resume import restore, set_rate, write_state
from spikeloom.models.training.robust import require_chance, worn

BATCH = 4
"""Recordings per step of the optimizer: the weights are rounded anew for each."""

LEARNING_RATE = 1e-3
"""At the start; it falls to zero along half a cosine."""

GENTLE_RATE = 3e-4
"""The same for a network that learns to decide as in floats, which recurrence may drive far off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TunedEpoch:
    """Figures of one epoch: counted from 1, mean loss, and training recordings decided right while it ran."""

    epoch: int
    loss: float
    correct: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tuned:
    """What a fine-tuning left."""

    net: QuantisedNet  # With its weights in floats; rounded to its forms they are the chip's
    history: tuple[TunedEpoch, ...]
    # before, after: Test recordings decided right on the chip's integers, before the first epoch and after the last
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
    """Train a network on chip integers: storage of `bits`, one or one a layer, with at most so many `groups` of scales.

    Without `bits` the storage is what the compiler chooses on held-out training recordings. Training begins with the
    compiler's integers; of a checkpoint's first layer, whose filters are shared, with its scales. Nothing is chosen on
    `test`, it is read before the first epoch and after the last. The `seed` is that of the order of recordings, and of
    what of them is lost (`robust`, see :func:`robust.worn`). The file `state` holds the state after each epoch, which
    the caller removes when the result is safe; `resume` goes on from it, to the same weights as without interruption.

    OptionError, ModelError, CapacityError or DataError if options, network or recordings cannot be used, or the loss is
    no longer a number.
    """
    require_least({"epochs": epochs, "seed": seed}, epochs=1, seed=0)
    require_chance(robust)
    packings = None if bits is None else [Packing(bits=width, groups=groups) for width in bits]
    asked = Options(packings=packings, keep=KEEP, keep_all=True, training_events=training.events)
    chosen = compile_network(network, asked, target=target).integer
    plain = has_released_dynamics(network)
    order = np.random.default_rng(seed)
    history: list[TunedEpoch] = []
    with one_thread():
        net = QuantisedNet(network, chosen.forms, RECTANGLE if plain else TIMED.surrogate)
        teacher = None if plain else float_rates(net.network, training)
        rate = LEARNING_RATE if plain else GENTLE_RATE
        net.start_at(chosen)
        net.make_legal()
        optimizer = torch.optim.Adam(net.parameters(), lr=rate, amsgrad=True)
        begun = {name: parameter.detach().numpy() for name, parameter in net.named_parameters()}
        options = {
            "network": arrays_digest({**begun, **{f"form.{i}": form.threshold for i, form in enumerate(net.forms)}}),
            "beta": [population.beta for population in net.network.populations],
            "chip": target.name,
            "training data": training.sha256,
            "test data": test.sha256,
            "weight bits": [form.bits for form in net.forms],
            "scale groups": groups,
            "epochs": epochs,
            "seed": seed,
            "robust": robust,
        }
        _, before = evaluate(net, test)
        if resume and state is not None and state.exists():
            history, _ = restore(state, options, net, optimizer, order, TunedEpoch)
            net.round()
        with tqdm(total=epochs, initial=len(history), desc="finetune", unit="epoch", disable=None) as bar:
            for index in range(len(history), epochs):
                history.append(_epoch(net, optimizer, training, teacher, order, robust, rate, index, epochs))
                if state is not None:
                    write_state(state, options, net, optimizer, order, history)
                bar.set_postfix(loss=f"{history[-1].loss:.4f}", training=f"{history[-1].correct}/{len(training)}")
                bar.update()
                if after_epoch is not None:
                    after_epoch(history[-1])
        _, after = evaluate(net, test)
    return Tuned(net=net, history=tuple(history), before=before, after=after)


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


def _epoch(
    model: QuantisedNet,
    optimizer: torch.optim.Optimizer,
    training: Recordings,
    teacher: Tensor | None,
    draw: np.random.Generator,
    robust: float,
    rate: float,
    index: int,
    epochs: int,
) -> TunedEpoch:
    order = draw.permutation(len(training))
    steps = math.ceil(len(order) / BATCH)
    total = 0.0
    correct = 0
    for step in range(steps):
        set_rate(optimizer, rate * 0.5 * (1 + math.cos(math.pi * (index * steps + step) / (epochs * steps))))
        chosen = order[step * BATCH : (step + 1) * BATCH]
        optimizer.zero_grad()
        labels = training.labels[chosen]
        lengths = None if training.lengths is None else torch.tensor(training.lengths[chosen])
        rates = model(time_first(worn(training.events[chosen], robust, draw)), lengths)
        if teacher is None:
            loss = rate_loss(rates, labels)
        else:  # as far as they lead to other decisions than the float model's
            wanted = torch.softmax(TIMED.gain * teacher[chosen], dim=1)
            loss = torch.nn.functional.cross_entropy(TIMED.gain * rates, wanted)
        loss.backward()  # type: ignore[no-untyped-call]
        require_finite(model, float(loss.detach()), index + 1, step + 1)
        optimizer.step()
        model.clip_weights()
        model.make_legal()
        total += float(loss.detach()) * len(chosen)
        correct += int(np.sum(rates.detach().numpy().argmax(axis=1) == labels))
    return TunedEpoch(epoch=index + 1, loss=total / len(order), correct=correct)
