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
from spikeloom.runtime.requests.choices import (
    GROUPS_HELP,
    NETWORK_FILES,
    ClusterChoice,
    DataChoice,
    NetworkChoice,
    SensorChoice,
)
from spikeloom.runtime.requests.fields import Request, option

if TYPE_CHECKING:
    from spikeloom.compiler.ir import Network

EPOCHS = ", ".join(f"{recipe.epochs} ({name})" for name, recipe in RECIPES.items())

ALL_SYSTEMS = (*SYSTEMS, NATIVE, COUNTING)


@dataclass(frozen=True, kw_only=True)
class TrainRequest(ClusterChoice, SensorChoice, DataChoice):
    """Train networks, and report the last, best and clean epoch."""

    groups: str | None = option(
        f"train again without each value of these conditions, and without random parts: {GROUPS_HELP}",
        metavar="NAME[,NAME]",
        group="recordings",
    )
    join: int = option(
        "bins of the recordings per step; a step has an event where any of its bins has one",
        default=1,
        metavar="N",
    )
    system: str | None = option(
        f"{', '.join(ALL_SYSTEMS)} (default: {TACTILESGNET}; {', '.join((*GRAPH_SYSTEMS, NATIVE))} need a graph)",
        choices=ALL_SYSTEMS,
        group="network",
    )
    padding: str | None = option(
        "padding of a grid-cnn: none, with stride 2 (default), or same, with which fc1 has more inputs than a core",
        choices=tuple(PADDINGS),
    )
    recipe: str = option(
        "released: as TactileSGNet was; timed: lasting currents and clocks; rates: for small networks",
        default=RELEASED.name,
        choices=tuple(RECIPES),
    )
    current_decay: str | None = option(
        "share of the synaptic current that each step keeps, as in fc1=0.95", metavar="LAYER=X[,…]"
    )
    membrane_decay: str | None = option(
        "share of the membrane that each step keeps, as in fc1=0.5 (default: 0.2)", metavar="LAYER=X[,…]"
    )
    clocks: int | None = option("clock inputs: each is active in one K-th of the recording", metavar="K")
    features: int | None = option(
        "neurons of the first layer for each taxel, or each position of a window", metavar="N"
    )
    hops: int | None = option("hops of a tactilesgnet's graph convolution (default: 3)", metavar="K")
    hidden: str | None = option(
        "neurons of each dense layer but the last, or none (default: 128,256)", metavar="N[,N]"
    )
    copies: int | None = option(
        f"axons per input of {NATIVE} (default: {DEFAULT_COPIES})", choices=tuple(BASES)
    )
    thresholds: str | None = option(
        "event counts at which counters spike (default: 1,4,16,64)", metavar="K[,K]", group="counters"
    )
    parts: int | None = option(
        "equal parts of a recording that are counted separately (default: 1)", metavar="N", group="counters"
    )
    ramp: int | None = option(
        "steps after the recording in which sums rise until one reaches the threshold (default: 32)",
        metavar="N",
        group="counters",
    )
    levels: int | None = option(
        "every N classes in a row are levels of one thing, as of a container's fill (default: 1)",
        metavar="N",
        group="counters",
    )
    weight_bits: int | None = option(
        "bits of a weight, 2 to 8 (default: 8; truenorth holds up to 5)", metavar="N", group="counters"
    )
    window: str | None = option("train on this first part of each recording", metavar="PERCENT")
    batch: int | None = option("recordings per optimizer step", metavar="N")
    spike_penalty: float | None = option(
        "penalty for spikes: what the loss grows by if every synapse carries a spike in every step",
        metavar="X",
    )
    robust: float | None = option(
        "probability with which training drops each event and each taxel, as in 0.1", metavar="X"
    )
    epochs: int | None = option(f"passes over the training recordings (default: {EPOCHS})", metavar="N")
    decay_epochs: int | None = option(
        "divide the learning rate by 10 every N epochs, first after epoch N + 1 (default: 40)", metavar="N"
    )
    seed: int = option("seed of initial weights and of the order of recordings", default=0, metavar="N")
    seeds: int = option("train N seeds side by side", default=1, metavar="N")
    resume: bool = option("resume an interrupted training with the same options", default=False)
    keep: tuple[str, ...] = option(
        "epoch to store: last, best (on test) or clean (on validation); may be repeated (default: all three)",
        default=(),
        choices=WEIGHTS,
    )
    picture: str | None = option("draw learning curves", metavar="OUT.png|svg|pdf")
    output: str = option("checkpoint to write", required=True, metavar="OUT.pt", flags=("-o", "--output"))


@dataclass(frozen=True, kw_only=True)
class FinetuneRequest(NetworkChoice, DataChoice):
    """Fine-tune a network on the integers of the chip, down to ternary weights."""

    checkpoint: str | Network = option(
        "trained network, or pretrained:NAME", positional=True, metavar=NETWORK_FILES
    )
    target: str = option("chip", default=DEFAULT_TARGET)
    weight_bits: str | None = option(
        "bits of a stored weight, for all layers or one each: 2 to 6 or 8 (default: as compile --calibrate chooses)",
        metavar="N[,N]",
    )
    scale_groups: int | None = option("scales in a layer, with --weight-bits (default: 8)", metavar="N")
    robust: float | None = option(
        "probability with which training drops each event and each taxel, as in 0.1", metavar="X"
    )
    epochs: int = option("passes over the training recordings", default=40, metavar="N")
    seed: int = option("seed of the order of recordings", default=0, metavar="N")
    resume: bool = option("resume an interrupted fine-tuning with the same options", default=False)
    output: str = option(
        "a checkpoint is written as a checkpoint, any other network as NIR with its netlist OUT.loom beside it",
        required=True,
        metavar="OUT.pt|OUT.nir",
        flags=("-o", "--output"),
    )


@dataclass(frozen=True, kw_only=True)
class JoinRequest(Request):
    """Join trained networks into one whose votes add up."""

    checkpoints: tuple[str, ...] = option(
        "networks of the same system, graph, decays and bins", positional=True, metavar="CKPT"
    )
    weights: str | None = option(
        "epoch to take from each (default: the first of these that it holds)", choices=WEIGHTS
    )
    output: str = option("checkpoint to write", required=True, metavar="OUT.pt", flags=("-o", "--output"))
