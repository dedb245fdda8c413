"""Requests that make networks: train, finetune, join."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.systems import GRAPH_SYSTEMS, SYSTEMS, TACTILESGNET
from spikeloom.compiler.targets import DEFAULT_TARGET
from spikeloom.compiler.targets.native import BASES, DEFAULT_COPIES
from spikeloom.compiler.targets.native import SYSTEM as NATIVE
from spikeloom.models.systems import PADDINGS
from spikeloom.models.training.recipes import RECIPES, RELEASED
from spikeloom.runtime.requests.choices import NETWORK_FILES, DataChoice, NetworkChoice, SensorChoice
from spikeloom.runtime.requests.fields import Request, option

if TYPE_CHECKING:
    from spikeloom.compiler.ir import Network

EPOCHS = ", ".join(f"{recipe.epochs} ({name})" for name, recipe in RECIPES.items())

ALL_SYSTEMS = (*SYSTEMS, NATIVE, COUNTING)


@dataclass(frozen=True, kw_only=True)
class TrainRequest(SensorChoice, DataChoice):
    """Train networks by the released recipe; last, best and clean epoch reported."""

    join: int = option("a step joins N bins, an event where one has any", default=1, metavar="N")
    system: str | None = option(
        f"{', '.join(ALL_SYSTEMS)} (default: {TACTILESGNET}; {', '.join((*GRAPH_SYSTEMS, NATIVE))} need a graph)",
        choices=ALL_SYSTEMS,
        group="network",
    )
    padding: str | None = option(
        "of a grid-cnn's window: none, moving by 2 (default), or same, of which no core holds all neurons",
        choices=tuple(PADDINGS),
    )
    recipe: str = option(
        "how: as the released code does, or with lasting currents and clocks",
        default=RELEASED.name,
        choices=tuple(RECIPES),
    )
    current_decay: str | None = option(
        "share of the synaptic current that a step keeps: fc1=0.95", metavar="LAYER=X[,…]"
    )
    membrane_decay: str | None = option("share of the membrane, where it is not 0.2: fc1=0.5", metavar="LAYER=X[,…]")
    clocks: int | None = option("inputs that tell which K-th of the recording it is", metavar="K")
    features: int | None = option("of the first layer, per place", metavar="N")
    hops: int | None = option("of a tactilesgnet's graph convolution (default: 3)", metavar="K")
    hidden: str | None = option("neurons of each dense layer but the last (default: 128,256)", metavar="N[,N]")
    copies: int | None = option(f"axons of an input of {NATIVE} (default: {DEFAULT_COPIES})", choices=tuple(BASES))
    thresholds: str | None = option(
        "events at which counters spike (default: 1,4,16,64)", metavar="K[,K]", group="counters"
    )
    parts: int | None = option("parts of a recording, counted apart (default: 1)", metavar="N", group="counters")
    ramp: int | None = option("silent steps of the read-out (default: 32)", metavar="N", group="counters")
    levels: int | None = option(
        "so many classes in a row are levels of one thing (default: 1)", metavar="N", group="counters"
    )
    weight_bits: int | None = option(
        "of a weight, 2 to 8 (default: 8; truenorth holds up to 5)", metavar="N", group="counters"
    )
    window: str | None = option("train on the first so many per cent of each recording", metavar="PERCENT")
    batch: int | None = option("recordings to a step of the optimizer", metavar="N")
    spike_penalty: float | None = option("loss of a spike on every synapse in every step: fewer spikes", metavar="X")
    robust: float | None = option("chance of an event, and of a taxel, to be lost while training: 0.1", metavar="X")
    epochs: int | None = option(f"passes over the training recordings (default: {EPOCHS})", metavar="N")
    decay_epochs: int | None = option(
        "the learning rate falls to a tenth every N epochs, after epoch N + 1 first (default: 40)", metavar="N"
    )
    seed: int = option("of initial weights and the order of recordings", default=0, metavar="N")
    seeds: int = option("train N seeds side by side", default=1, metavar="N")
    resume: bool = option("go on with an interrupted training of the same options", default=False)
    keep: tuple[str, ...] = option(
        "epoch to store: last, best (on test) or clean (on validation); may be repeated (default: all three)",
        default=(),
        choices=WEIGHTS,
    )
    picture: str | None = option("draw learning curves", metavar="OUT.png|svg|pdf")
    output: str = option("checkpoint to write", required=True, metavar="OUT.pt", flags=("-o", "--output"))


@dataclass(frozen=True, kw_only=True)
class FinetuneRequest(NetworkChoice, DataChoice):
    """Train a network further on the very integers of the chip, down to ternary weights."""

    checkpoint: str | Network = option("trained network, or pretrained:NAME", positional=True, metavar=NETWORK_FILES)
    target: str = option("chip", default=DEFAULT_TARGET)
    weight_bits: str | None = option(
        "storage width, one or one a layer: 2 to 6 or 8 (default: the storage that compile --calibrate chooses)",
        metavar="N[,N]",
    )
    scale_groups: int | None = option("scales in a layer, of that width (default: 8)", metavar="N")
    robust: float | None = option("chance of an event, and of a taxel, to be lost: 0.1", metavar="X")
    epochs: int = option("passes over the training recordings", default=40, metavar="N")
    seed: int = option("of the order of recordings", default=0, metavar="N")
    resume: bool = option("go on with an interrupted one of the same options", default=False)
    output: str = option(
        "a checkpoint is written back as one; any other network as NIR, with its netlist OUT.loom beside it",
        required=True,
        metavar="OUT.pt|OUT.nir",
        flags=("-o", "--output"),
    )


@dataclass(frozen=True, kw_only=True)
class JoinRequest(Request):
    """Put several trained networks side by side in one, whose votes add up."""

    checkpoints: tuple[str, ...] = option("networks of one system, graph and timing", positional=True, metavar="CKPT")
    weights: str | None = option("epoch to take from each (default: the first of these that it holds)", choices=WEIGHTS)
    output: str = option("checkpoint to write", required=True, metavar="OUT.pt", flags=("-o", "--output"))
