"""What a network may use of the chip beside one membrane decay for all: decays of its own a layer, and clocks.

*Decays.* ``i_t = alpha * i_{t-1} + W s_t`` and ``u_t = beta * u_{t-1} * (1 - s_{t-1}) + i_t + b``: a synaptic current
that outlasts its step. The bias goes to the membrane, past the current, and the reset leaves the current as it is.

*Clocks.* K input channels beside those of the sensor. The k-th has an event in each of the steps
``k * S … (k + 1) * S - 1``; after ``K * S`` steps there are none. A layer receives the one before it and nothing else,
so each clock channel is relayed by a neuron of its own, one of K at the end of the first layer: its only synapse has
twice the threshold, its bias is zero, so that it spikes when its channel has an event and at no other time. To the
first dense layer they are a bias that changes with time.
"""

from dataclasses import asdict, dataclass, field

import numpy as np

from spikeloom.compiler.types import AnyArray, EventArray, JsonObject

RELAY_WEIGHT = 2.0
"""Weight of a clock channel to its relay, in thresholds."""

MOST_CLOCKS = 64
"""Clock channels that a network may have."""

MOST_STEPS = 2**20
"""Largest number of steps that a clock may tick."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clocks:
    """Input channels that tell the time."""

    channels: int = 0  # How many; none by default
    steps: int = 1  # How long each of them has events
    # Steps that every recording is run: shorter ones end in silence, longer ones are cut; their own by
    # default
    length: int | None = field(default=None, metadata={"optional": True})

    def events(self, steps: int, *, first: int = 0) -> EventArray:
        """Events of the steps ``first … first + steps - 1``, (channels, steps)."""
        part = np.arange(first, first + steps) // self.steps
        return np.asarray((part == np.arange(self.channels)[:, None]).astype(np.uint8))

    def to_json(self) -> JsonObject:
        """JSON values."""
        return {name: value for name, value in asdict(self).items() if value is not None}


NO_CLOCKS = Clocks()


def clocks_over(channels: int, steps: int) -> Clocks:
    """Clocks that share recordings of so many steps among them."""
    return Clocks(channels=channels, steps=-(-steps // channels)) if channels else NO_CLOCKS


def with_clocks(events: AnyArray, clocks: Clocks) -> AnyArray:
    """Recordings (samples, taxels, polarities, steps) as the input channels of a network, its clocks last.

    Gives (samples, taxels * polarities + clocks, steps) of the same type.
    """
    samples, taxels, polarities, steps = events.shape
    flat = events.reshape(samples, taxels * polarities, steps)
    if not clocks.channels:
        return flat
    ticks = clocks.events(steps).astype(events.dtype)
    return np.concatenate([flat, np.broadcast_to(ticks, (samples, *ticks.shape))], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Dynamics:
    """Decays of each layer, and clocks."""

    betas: tuple[float, ...] = ()  # Share of the membrane that a step keeps, by layer; empty: the common one
    alphas: tuple[float, ...] = ()  # The same of the synaptic current; empty: none outlasts its step
    clocks: Clocks = NO_CLOCKS

    @property
    def is_plain(self) -> bool:
        """Whether nothing of this is used."""
        return self == PLAIN

    def beta(self, layer: int, common: float) -> float:
        """Share of a membrane that a layer keeps; layers count from 0."""
        return self.betas[layer] if self.betas else common

    def alpha(self, layer: int) -> float:
        """Current decay of a layer."""
        return self.alphas[layer] if self.alphas else 0.0

    def to_json(self) -> JsonObject:
        """JSON values."""
        return {"betas": list(self.betas), "alphas": list(self.alphas), "clocks": self.clocks.to_json()}


PLAIN = Dynamics()
"""One membrane decay for all layers, no current that outlasts its step, no clocks."""


def dynamics_faults(dynamics: Dynamics, layers: int) -> list[str]:
    """What is wrong about the dynamics of a network of so many layers.

    >>> dynamics_faults(Dynamics(alphas=(0.5, 1.0)), 2)
    ['a current decay of 1, allowed are 0 <= decay < 1']
    """
    faults = []
    for what, decays in (("membrane", dynamics.betas), ("current", dynamics.alphas)):
        if len(decays) not in (0, layers):
            faults.append(f"{len(decays)} {what} decays for {layers} layers")
        faults += [f"a {what} decay of {d:g}, allowed are 0 <= decay < 1" for d in decays if not 0 <= d < 1]
    clocks = dynamics.clocks
    if not 0 <= clocks.channels <= MOST_CLOCKS:
        faults.append(f"{clocks.channels} clocks, allowed are 0 to {MOST_CLOCKS}")
    if not 1 <= clocks.steps <= MOST_STEPS:
        faults.append(f"clocks of {clocks.steps} steps, allowed are 1 to {MOST_STEPS}")
    if clocks.channels and dynamics.alpha(0):
        faults.append("clocks need a first layer without current decay, which relays them step for step")
    return faults
