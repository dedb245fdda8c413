"""Choices that several requests share: which network, which recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.formats.nir import CONVENTIONS
from spikeloom.models.graphs import CHOICES
from spikeloom.models.recordings.evtouch import BIN_S
from spikeloom.runtime.requests.fields import Request, option

if TYPE_CHECKING:
    from spikeloom.compiler.ir import Network
    from spikeloom.models.recordings.evtouch import Recordings

NETWORK_FILES = "CKPT|NET.onnx|NET.nir"
"""What a float network is read from."""

BIN_HELP = (
    f"seconds in a bin of events or arrays (default: those that the network was trained on, else {BIN_S:g})"
)

DATA_HELP = (
    "recordings: a folder or zip of the released layout, events (csv, npz) or arrays (npy, npz), one such file, "
    "'synthetic', 'objects' or 'containers'"
)


@dataclass(frozen=True, kw_only=True)
class ClusterChoice(Request):
    """Where work of many parts is done."""

    scheduler: str | None = option(
        "work on a Dask cluster: the address of its scheduler, or N workers here", metavar="ADDRESS|local:N"
    )


@dataclass(frozen=True, kw_only=True)
class NetlistChoice(Request):
    """Which compiled network."""

    netlist: str = option("compiled network", positional=True, metavar="NET.loom")


@dataclass(frozen=True, kw_only=True)
class SensorChoice(Request):
    """Which taxels, and which graph over them."""

    graph: str | None = option(f"taxel graph: {CHOICES}", group="network")
    taxels: str | None = option(
        "your own sensor: number of taxels, or their positions x,y[,z] in mm",
        metavar="N|COORDS.csv",
        group="network",
    )
    edges: str | None = option(
        "your own graph: a file of edges source,target", metavar="EDGES.csv", group="network"
    )
    directed: bool = option(
        "each of --edges goes one way, from source to target", default=False, group="network"
    )


@dataclass(frozen=True, kw_only=True)
class CheckpointChoice(SensorChoice):
    """How a checkpoint is read."""

    run: int = option(
        "which training run of a file that TactileSGNet's authors released",
        default=0,
        metavar="N",
        group="network",
    )
    weights: str | None = option(
        "epoch, if a checkpoint holds several (default: the first of these that it holds)",
        choices=WEIGHTS,
        group="network",
    )
    beta: float | None = option(
        "share of a membrane that a step keeps, if the file does not say (default: 0.2)", group="network"
    )
    theta: float | None = option("threshold, if the file does not say (default: 0.5)", group="network")


@dataclass(frozen=True, kw_only=True)
class NetworkChoice(CheckpointChoice):
    """How a network of any format is read."""

    polarities: int | None = option(
        "number of polarities of an ONNX or NIR input, if its shape is flat", metavar="N", group="network"
    )
    polarities_first: bool | None = option(
        "whether polarities are the first axis, if the shape of an ONNX or NIR input does not say",
        group="network",
        constants={
            "--polarities-first": (
                True,
                "polarities are the first axis, if the shape of an ONNX or NIR input does not say",
            ),
            "--polarities-last": (
                False,
                "polarities are the last axis, if the shape of an ONNX or NIR input does not say",
            ),
        },
    )
    dt: float | None = option(
        "time step at which a NIR file is read (default: its own)", metavar="SECONDS", group="network"
    )
    convention: str | None = option(
        f"a step keeps 1 - dt/tau (euler) or exp(-dt/tau) (exponential) of a state (default: {CONVENTIONS[0]})",
        choices=CONVENTIONS,
        group="network",
    )


@dataclass(frozen=True, kw_only=True)
class ComparisonChoice(NetlistChoice, NetworkChoice):
    """Which compiled network, beside which float model."""

    checkpoint: str | Network = option(
        "float model of the netlist", required=True, metavar=NETWORK_FILES, group="network"
    )


@dataclass(frozen=True, kw_only=True)
class DataChoice(Request):
    """Where recordings are, all splits of them."""

    data: str = option(DATA_HELP, required=True, metavar="PATH", group="recordings")
    bin: float | None = option(BIN_HELP, metavar="S", group="recordings")


GROUPS_HELP = "columns of recordings.csv, or fields of file names as in speed3_force1"


@dataclass(frozen=True, kw_only=True)
class ConditionChoice(DataChoice):
    """Recordings made under several conditions."""

    groups: str | None = option(
        f"conditions to leave out in turn: {GROUPS_HELP} (default: all columns)",
        metavar="NAME[,NAME]",
        group="recordings",
    )


@dataclass(frozen=True, kw_only=True)
class ShownConditionChoice(Request):
    """Conditions of recordings that a trained network runs."""

    groups: str | None = option(
        f"conditions to show accuracies by: {GROUPS_HELP} (default: all columns)",
        metavar="NAME[,NAME]",
        group="recordings",
    )


@dataclass(frozen=True, kw_only=True)
class SplitChoice(Request):
    """Which recordings of a source."""

    bin: float | None = option(BIN_HELP, metavar="S", group="recordings")
    split: str = option("split to read", default="test", group="recordings")
    limit: int | None = option("first N recordings only", metavar="N", group="recordings")


@dataclass(frozen=True, kw_only=True)
class WindowChoice(SplitChoice):
    """Which part of them."""

    window: str | None = option(
        "first part of every recording, as in 50%%; by default the part that trained the network",
        metavar="PERCENT",
        group="recordings",
    )


@dataclass(frozen=True, kw_only=True)
class RecordingsChoice(SplitChoice):
    """Which recordings."""

    data: str | Recordings = option(DATA_HELP, required=True, metavar="PATH", group="recordings")
