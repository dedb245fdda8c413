"""Requests about what to deploy: smallest, chart, lean, anytime."""

from __future__ import annotations

from dataclasses import dataclass

from spikeloom.compiler.targets import DEFAULT_TARGET
from spikeloom.runtime.requests.choices import (
    NETWORK_FILES,
    CheckpointChoice,
    ClusterChoice,
    ConditionChoice,
    DataChoice,
    NetlistChoice,
    NetworkChoice,
    RecordingsChoice,
    SensorChoice,
    ShownConditionChoice,
)
from spikeloom.runtime.requests.fields import option


@dataclass(frozen=True, kw_only=True)
class SmallestRequest(ClusterChoice, SensorChoice, ConditionChoice):
    """The cheapest of many networks that is about as accurate as the best, compiled and verified."""

    target: str = option("chip", default=DEFAULT_TARGET)
    levels: int | None = option(
        "every N classes in a row are levels of one thing, for counting networks (default: 1)", metavar="N"
    )
    budget: tuple[str, ...] = option(
        "energy=5uJ, time=5ms, operations=25000, cores=1, accuracy=88, certified=90; all must hold",
        default=(),
        metavar="WHAT=LIMIT[,…]",
    )
    time: str | None = option(
        "start nothing new after this time, as in 30m; the same command continues (default: 15m)",
        metavar="TIME",
    )
    store: str | None = option(
        "file that keeps measurements (default: NET.sqlite, beside the netlist)", metavar="FILE"
    )
    jobs: int | None = option("processes at a time (default: one a core)", metavar="N")
    html: str | None = option("also write the result as a page", metavar="PAGE.html")
    output: str = option(
        "netlist; NET.pt is the network", required=True, metavar="NET.loom", flags=("-o", "--output")
    )


@dataclass(frozen=True, kw_only=True)
class ChartRequest(ClusterChoice, CheckpointChoice, ShownConditionChoice, DataChoice):
    """Accuracy against energy, time and size for a grid of configurations, and which one to deploy."""

    checkpoints: tuple[str, ...] = option(
        "trained networks of one data set", positional=True, metavar="CKPT"
    )
    grid: str | None = option(
        "configurations, as in bits=2-6,8,planes=1-2,window=25-100%% (default: bits=2-6,8,window=25-100%%)",
        metavar="AXIS=V,V,…",
    )
    budget: tuple[str, ...] = option(
        "limit for the point to deploy: energy=0.1mJ, time=5ms, accuracy=88 or certified=90; may be repeated, all must "
        "hold",
        default=(),
        metavar="WHAT=LIMIT",
    )
    table: str | None = option(
        "energy table to choose and draw by: davies2018 or sanafe (default: davies2018)", metavar="NAME"
    )
    jobs: int | None = option("processes at a time (default: one a core)", metavar="N")
    output: str = option("folder of the chart", required=True, metavar="FOLDER", flags=("-o", "--output"))


@dataclass(frozen=True, kw_only=True)
class LeanRequest(NetworkChoice, RecordingsChoice):
    """Which neurons, taxels and hops its recordings do not need, and a netlist without them."""

    checkpoint: str = option("trained network", positional=True, metavar=NETWORK_FILES)
    differ: float = option("share of training decisions that may change", default=0.01, metavar="X")
    output: str | None = option(
        "write the netlist without what is not needed", metavar="OUT.loom", flags=("-o", "--output")
    )
    network: str | None = option(
        "write the float network without neurons of dense layers that are not needed", metavar="OUT.pt"
    )


@dataclass(frozen=True, kw_only=True)
class AnytimeRequest(NetlistChoice, RecordingsChoice):
    """How early decisions could be taken, and what that saves."""

    calibrate: str | None = option(
        "recordings whose training split sets when a vote is sure", metavar="PATH"
    )
    held_out: bool = option(
        "the network was not trained on --calibrate: set that by its decisions, not by its races for second place",
        default=False,
    )
    differ: float | None = option(
        "share of these races, or decisions, that may end otherwise (default: 0)", metavar="X"
    )
    output: str | None = option(
        "write the result with figures of every recording", metavar="OUT.json", flags=("-o", "--output")
    )
