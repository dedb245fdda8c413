"""How a network is trained, as data: the released way, and one for networks that tell the time.

A recipe is what ``train --recipe`` names; single values may be overridden there. It says nothing of the
data, the system or the graph, and nothing of how a training is reported (:mod:`training.train`).
"""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass

from spikeloom.compiler.dynamics import MOST_CLOCKS, Dynamics, clocks_over
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.compartments import decay_registers, kept_shares
from spikeloom.compiler.types import JsonObject
from spikeloom.models.networks.surrogate import FAST_SIGMOID, RECTANGLE, Surrogate
from spikeloom.models.systems import HOPS
from spikeloom.models.training.robust import require_chance

DECAY_EPOCHS = 40
"""Epochs after which the learning rate is multiplied by 0.1; it takes effect one epoch late."""

HIDDEN = (128, 256)
"""Dense layers of the released networks."""

MSE = "mse"
CROSS_ENTROPY = "cross-entropy"
ADAM = "adam"
ADAMW = "adamw"
STEPS = "steps"
COSINE = "cosine"
PLATEAU = "plateau"

Decays = tuple[tuple[str, float], ...]
"""Pairs of a layer's name and its decay."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Everything that determines a training, beside data, system, graph and seed."""

    name: str  # Which of ``RECIPES`` it is, or came from
    epochs: int = 100  # Unless the user says otherwise
    batch: int = 1  # Recordings to a step of the optimizer
    # {"mse", "cross-entropy"}; squared error of the spike rates against zeros and a one, or cross-entropy of
    # `gain` times the rates
    loss: str = MSE
    gain: float = 1.0  # Of the cross-entropy: factor before the softmax
    smoothing: float = 0.0  # Of the cross-entropy: share of the label that goes to all classes alike
    surrogate: Surrogate = RECTANGLE  # Derivative of a spike
    optimizer: str = ADAM  # {"adam", "adamw"}; both with amsgrad
    weight_decay: float = 0.0  # Of AdamW
    learning_rate: float = 1e-3  # At the start
    # {"steps", "cosine", "plateau"}; a tenth every `decay_epochs`, half a cosine down to zero over all epochs,
    # or a tenth for the last quarter of the epochs
    schedule: str = STEPS
    decay_epochs: int = DECAY_EPOCHS  # Of steps; the first epoch of each such block still has the old rate
    # features, hops: Outputs of the first layer per place; K of a graph convolution
    features: int = 64
    hops: int = HOPS
    hidden: tuple[int, ...] = HIDDEN  # Neurons of each dense layer but the last
    # betas, alphas: Membrane decays of single layers, all others have the common one; current decays that
    # are not zero. With the first, every layer's is rounded to what the chip holds.
    betas: Decays = ()
    alphas: Decays = ()
    clocks: int = 0  # Clock channels, see :mod:`compiler.dynamics`
    # Added to the loss for each synapse that carries a spike in every step: this times the share of the
    # synapses behind neurons that do so, mean over steps and recordings
    penalty: float = 0.0
    robust: float = 0.0  # Chance of an event and of a taxel to be lost, see :func:`robust.disturb`

    def to_json(self) -> JsonObject:
        """JSON values that are not the defaults; a training states its number of epochs by itself."""
        values = asdict(self) | {
            "betas": dict(self.betas),
            "alphas": dict(self.alphas),
            "hidden": list(self.hidden),
        }
        defaults = {"epochs": self.epochs, "hidden": list(HIDDEN), "penalty": 0, "robust": 0}
        return {
            name: value for name, value in values.items() if name not in defaults or value != defaults[name]
        }

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers of a network."""
        return ("conv1", *(f"fc{place}" for place in range(1, len(self.hidden) + 2)))

    def dynamics(self, layers: Iterable[str], beta: float, steps: int) -> Dynamics:
        """Dynamics of a network with these layers, a common membrane decay and recordings of so many steps.

        Decays are the nearest that the chip's registers hold: what is trained with them need not be rounded.
        """
        betas = dict(self.betas)
        alphas = dict(self.alphas)
        return Dynamics(
            betas=tuple(realised_decays(betas.get(name, beta), 0.0)[0] for name in layers) if betas else (),
            alphas=tuple(realised_decays(beta, alphas.get(name, 0.0))[1] for name in layers)
            if alphas
            else (),
            clocks=clocks_over(self.clocks, steps),
        )


RELEASED = Recipe(name="released")
"""The released code's, see :mod:`training.train`."""

TIMED = Recipe(
    name="timed",
    epochs=30,
    batch=4,
    loss=CROSS_ENTROPY,
    gain=20.0,
    surrogate=Surrogate(shape=FAST_SIGMOID, width=0.25, reset=False),
    optimizer=ADAMW,
    weight_decay=0.01,
    schedule=COSINE,
    features=32,
    betas=(("conv1", 0.2), ("fc1", 0.2), ("fc2", 0.2), ("fc3", 0.2)),
    alphas=(("fc1", 0.95), ("fc2", 0.95), ("fc3", 0.95)),
    clocks=8,
)
"""For recordings that differ in when their events come: currents that last 20 steps, and clocks."""

RATES = Recipe(
    name="rates",
    epochs=48,
    batch=4,
    loss=CROSS_ENTROPY,
    gain=20.0,
    surrogate=Surrogate(shape=FAST_SIGMOID, width=0.25, reset=False),
    optimizer=ADAMW,
    weight_decay=0.01,
    schedule=PLATEAU,
    features=16,
    hops=1,
    hidden=(64,),
)
"""Small networks that decide by how often taxels send events; they learn in half the epochs of the released recipe."""

RECIPES = {recipe.name: recipe for recipe in (RELEASED, TIMED, RATES)}


def plateau(epochs: int) -> int:
    """Epochs before the last quarter.

    >>> plateau(48), plateau(3)
    (36, 3)
    """
    return epochs - epochs // 4


def realised_decays(beta: float, alpha: float) -> tuple[float, float]:
    """Decays of membrane and current that the chip's registers hold instead of these.

    >>> realised_decays(0.5, 0.95) == (0.5, 3891 / 4096)
    True
    """
    held_alpha, held_beta = kept_shares(*decay_registers(beta, alpha))
    return held_beta, held_alpha


def parse_decays(words: str, option: str, layers: tuple[str, ...]) -> Decays:
    """Decays by layer, from the words of an option.

    >>> parse_decays("fc1=0.95,fc3=0.5", "--current-decay", ("conv1", "fc1", "fc2", "fc3"))
    (('fc1', 0.95), ('fc3', 0.5))
    """
    decays: dict[str, float] = {}
    for word in words.split(","):
        layer, _, number = word.strip().partition("=")
        try:
            decay = float(number)
        except ValueError:
            decay = -1.0
        if not 0 <= decay < 1:
            raise OptionError(
                f"{option} {words}: {word.strip()!r} is not LAYER=DECAY with 0 <= DECAY < 1; write for example fc1=0.95"
            )
        if layer not in layers:
            raise OptionError(f"{option} {words}: no layer {layer!r}; the layers are {', '.join(layers)}")
        if layer in decays:
            raise OptionError(f"{option} {words}: names {layer} twice; give it once")
        decays[layer] = decay
    return tuple(decays.items())


MOST_SIZE = 1024
MOST_HOPS = 16


def check_recipe(recipe: Recipe) -> None:
    """Refuse sizes that no network has."""
    sizes = (
        ("features", recipe.features),
        ("batch", recipe.batch),
        *(("hidden", size) for size in recipe.hidden),
    )
    for option, value in sizes:
        if not 1 <= value <= MOST_SIZE:
            raise OptionError(f"--{option} {value}: allowed are 1 to {MOST_SIZE}; choose another")
    if not 0 <= recipe.hops <= MOST_HOPS:
        raise OptionError(f"--hops {recipe.hops}: allowed are 0 to {MOST_HOPS}; choose another")
    require_chance(recipe.robust)
    if not 0 <= recipe.penalty < math.inf:
        raise OptionError(
            f"--spike-penalty {recipe.penalty:g}: allowed are numbers from 0 up; choose another"
        )
    if not 0 <= recipe.clocks <= MOST_CLOCKS:
        raise OptionError(f"--clocks {recipe.clocks}: allowed are 0 to {MOST_CLOCKS}; choose another")
    if recipe.clocks and dict(recipe.alphas).get("conv1"):
        raise OptionError(
            f"--clocks {recipe.clocks}: conv1 relays the clocks step for step, so its current cannot last; "
            "leave conv1 out of --current-decay, or give --clocks 0"
        )
