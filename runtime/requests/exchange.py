"""Requests that exchange files with other programs: export, watch, data."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from spikeloom.models.recordings.fetch import DATA_SETS
from spikeloom.runtime.requests.choices import BIN_HELP, DATA_HELP, NetlistChoice
from spikeloom.runtime.requests.fields import Request, option

if TYPE_CHECKING:
    from spikeloom.models.recordings.evtouch import Recordings


@dataclass(frozen=True, kw_only=True)
class ExportRequest(Request):
    """Write a network in the format of another program."""

    source: str = option("a netlist", positional=True, metavar="NET.loom")
    to: str = option("format of another program", required=True)
    form: str | None = option(
        "onnx: a step and its state, or whole recordings (default: scan)", choices=("step", "scan")
    )
    data: str | Recordings | None = option(f"ranc: a recording to add; {DATA_HELP}", metavar="PATH")
    bin: float | None = option(BIN_HELP, metavar="S")
    split: str | None = option("ranc: split to read (default: test)")
    recording: int | None = option("ranc: which of them (default: 0)", metavar="N")
    dt: float | None = option("nir: length of a step (default: that of the recordings)", metavar="SECONDS")
    output: str = option("file to write", required=True, metavar="FILE", flags=("-o", "--output"))


@dataclass(frozen=True, kw_only=True)
class WatchRequest(NetlistChoice):
    """Read event lines (time_s,taxel,polarity) and print the running decision."""

    json: bool = field(default=False)  # Whether each decision is printed as JSON

    input: str = option("event lines; - is standard input", default="-", metavar="FILE")
    bin: str | None = option("bin of the recordings (default: the network's, else 0.02)", metavar="SECONDS")
    bins: int | None = option(
        "steps of every grasp: shorter ones are padded, longer ones cut; counters know theirs, read-out included",
        metavar="N",
    )
    origin: str = option(
        "where the first bin of a grasp begins: at time 0 or at the first event",
        default="zero",
        choices=("zero", "first"),
    )
    speed: str = option(
        "keep the sensor's pace, or go on as soon as events allow",
        default="full",
        choices=("real", "full"),
    )
    until_sure: float | None = option(
        "end a grasp of --bins once nothing can change the vote, or it leads by A*sqrt(bins left) (see anytime)",
        metavar="A",
        bare=math.inf,
    )


@dataclass(frozen=True, kw_only=True)
class FetchRequest(Request):
    """Download released recordings; --data then takes their name."""

    name: str = option("data set", positional=True, choices=tuple(DATA_SETS))
    url: str | None = option("another address of the same file")


@dataclass(frozen=True, kw_only=True)
class DescribeRequest(Request):
    """Counts, rates by taxel and polarity, duration, dead and hot taxels."""

    source: str = option(
        f"folder, zip, .csv, .npz or .npy with recordings, 'synthetic', or {' or '.join(map(repr, DATA_SETS))}",
        positional=True,
        metavar="SRC",
    )
    bin: float | None = option(BIN_HELP, metavar="S")
    taxels: str | None = option("how many there are, or where: x,y[,z] in mm", metavar="N|COORDS.csv")
    split: str = option("split to read, or that of recordings that have none", default="test")


@dataclass(frozen=True, kw_only=True)
class ConvertRequest(DescribeRequest):
    """Write the released layout: SPLIT/sample_N_label_L.npy."""

    join: int = option("make one bin of N, with an event where any of them has one", default=1, metavar="N")
    output: str = option(
        "new folder or zip, or a .csv of event lines for one recording",
        required=True,
        metavar="OUT",
        flags=("-o", "--output"),
    )
