"""Requests of the main job: compile, inspect, run, verify, estimate, report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from spikeloom.compiler.storage import KEEP
from spikeloom.compiler.targets import DEFAULT_TARGET
from spikeloom.runtime.requests.choices import (
    BIN_HELP,
    DATA_HELP,
    NETWORK_FILES,
    CheckpointChoice,
    ComparisonChoice,
    NetlistChoice,
    NetworkChoice,
    RecordingsChoice,
    WindowChoice,
)
from spikeloom.runtime.requests.fields import option

if TYPE_CHECKING:
    from spikeloom.compiler.ir import Network
    from spikeloom.models.recordings.evtouch import Recordings

MIN_AGREEMENT = 0.95
"""Share of equal decisions that ``verify`` wants."""

ENGINES = ("spikeloom", "onnx")
"""What can be held against a chip's specification: our simulator, or another program beside it."""


@dataclass(frozen=True, kw_only=True)
class CompileRequest(NetworkChoice):
    """Compile a trained network to a netlist within the limits of the chip."""

    bin: float | None = option(BIN_HELP, metavar="S", group="recordings")
    checkpoint: str | Network = option(
        "checkpoint, or a network as an ONNX, NIR or netx file", positional=True, metavar=NETWORK_FILES
    )
    target: str = option("chip: loihi1, or truenorth", default=DEFAULT_TARGET)
    weight_bits: str | None = option(
        "bits of a stored weight, for all layers or one each: 2 to 6 or 8 (default: 8; --calibrate chooses)",
        metavar="N[,N]",
        group="storage",
    )
    planes: str | None = option(
        "synapses that together store one weight more finely, 1 to 3 (default: 1; --calibrate chooses)",
        metavar="N[,N]",
        group="storage",
    )
    scale_groups: str | None = option(
        "groups of neurons in a layer that have a scale of their own, 1 to 8 (default: 1; --calibrate chooses)",
        metavar="N[,N]",
        group="storage",
    )
    spike_exact: bool = option(
        "add planes and scales until the training spikes are the float model's",
        default=False,
        group="storage",
    )
    keep_all: bool = option(
        "keep neurons that never fire or reach no neuron", default=False, group="storage"
    )
    prune_unused: bool = option(
        "also leave out neurons that never fired on the training split", default=False, group="storage"
    )
    share_lists: bool = option(
        "with --calibrate: round equal weights of a convolution alike, for less memory",
        default=False,
        group="storage",
    )
    calibrate: str | Recordings | None = option(
        "recordings whose training split chooses storage and scales", metavar="PATH", group="storage"
    )
    keep: float | None = option(
        f"share of the float model's decisions, on held-out training recordings, to keep (default: {KEEP:g})",
        metavar="X",
        group="storage",
    )
    cores_for: str | None = option(
        "spread a layer over at least N cores of its own, as in conv1=4,fc1=6",
        metavar="LAYER=N[,…]",
        group="layout",
    )
    chips: int = option("use up to N chips", default=1, metavar="N", group="layout")
    free_running: bool = option(
        "for a chip that no host resets: layers always integrate, blank steps after each recording clear them",
        default=False,
        group="layout",
    )
    dump_after: tuple[str, ...] = option(
        "print the network after a pass, on stderr", default=(), metavar="PASS", group="output"
    )
    output: str = option(
        "netlist to write", required=True, metavar="NET.loom", group="output", flags=("-o", "--output")
    )


@dataclass(frozen=True, kw_only=True)
class InspectRequest(CheckpointChoice):
    """Show a netlist (layers, scales, cores, use of each limit) or a checkpoint."""

    path: str = option("netlist or checkpoint", positional=True)


@dataclass(frozen=True, kw_only=True)
class RunRequest(NetlistChoice, RecordingsChoice, WindowChoice):
    """Run a netlist in the integer arithmetic of the chip."""

    spikes: str | None = option("write the spikes of every layer, aligned with the data", metavar="OUT.npz")


@dataclass(frozen=True, kw_only=True)
class VerifyRequest(ComparisonChoice, WindowChoice):
    """Compare chip and float model, spike for spike."""

    data: str | Recordings | None = option(DATA_HELP, metavar="PATH", group="recordings")
    original: str | None = option(
        "float model for E2 and E3 (default: the weights of --checkpoint)", metavar="CKPT"
    )
    engine: str = option(
        "onnx: onnxruntime runs the integer graph beside our engine", default=ENGINES[0], choices=ENGINES
    )
    min_agreement: float | None = option(
        f"share of equal decisions that is enough to pass (default: {MIN_AGREEMENT:g})", metavar="X"
    )
    require: str | None = option(
        "levels to pass instead: E0 specification = engine, E1 chip = model trained in integers, E2 share of equal "
        "spikes in each layer, E3 share of equal decisions",
        metavar="E0,E1,E2=X,E3=X",
    )
    spec_samples: int = option(
        "recordings on which specification and engine are compared", default=3, metavar="N"
    )


@dataclass(frozen=True, kw_only=True)
class EstimateRequest(NetlistChoice, RecordingsChoice, WindowChoice):
    """Synaptic operations, energy and time of an inference."""

    detail: str = option(
        "counts: events, energy and simple times; cycle: also the time of every message",
        default="counts",
        choices=("counts", "cycle"),
        group="depth and prices",
    )
    table: str | None = option(
        "use this table of prices or times alone, or your own file",
        metavar="NAME|FILE.toml",
        group="depth and prices",
    )
    against_processor: bool = option(
        "train a linear rule for a small processor on the same recordings, and compare its costs",
        default=False,
    )
    neurobench: bool = option("add NeuroBench's metrics of the network as the chip holds it", default=False)


@dataclass(frozen=True, kw_only=True)
class ReportRequest(ComparisonChoice, RecordingsChoice):
    """One self-contained page: verdict, accuracy, cores, taxels, spikes, energy, time, provenance."""

    recording: str | None = option(
        "recording to draw, by name or by number from 0 (default: the first decided differently)",
        metavar="NAME|N",
    )
    stress: str | None = option("show what stress -o wrote about this netlist", metavar="STRESS.json")
    output: str = option("page to write", required=True, metavar="OUT.html", flags=("-o", "--output"))
    spec_samples: int = option(
        "recordings on which specification and engine are compared", default=3, metavar="N"
    )
