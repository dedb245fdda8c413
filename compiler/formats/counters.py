"""Counting networks: what one is, its file, and the spiking network that it stands for. Whole numbers from end to end.

A *counter* is a neuron without leak that receives one channel with weight 1 and itself with ``-BLOCK``: it
spikes when the channel has had `count` events, and then not before the ``2 * count + BLOCK``-th. *Sums*, one
neuron a class, add up the weights of the counters that spiked. A bias, the same for all, is a ramp: after
the data the largest sum crosses the threshold first. The *vote* of a class spikes from then on in every
step, so that spikes order the classes as sums do.

Where the recording has several parts, a *gate* for each channel and part spikes when the channel and the
clock of the part do, and the counters of the part receive the gate.

The file is an archive of :mod:`compiler.archive`: the ``manifest`` has the sizes and constants of
:class:`Counters` and ``training`` (how it was made and what it reached), ``counter`` and ``weight`` are
arrays.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler import archive
from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.counters import BLOCK, Counters
from spikeloom.compiler.dynamics import MOST_CLOCKS, MOST_STEPS
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import reading, sha256_of
from spikeloom.compiler.formats.assemble import Layer, ReadNetwork, assemble
from spikeloom.compiler.ir import INPUT, Input, Network, Sparse

VERSION = 1

SYSTEM = "counters"
"""Name of such networks among the systems that are trained."""

SIZES = ("taxels", "polarities", "classes", "bins", "steps", "parts", "ramp")
CONSTANTS = ("slope", "threshold")
MOST = 2**20
KINDS: dict[str, archive.Kind] = {
    **dict.fromkeys(SIZES, (1, MOST)),
    "parts": (1, MOST_CLOCKS),
    "ramp": (0, MOST),
    **dict.fromkeys(CONSTANTS, float),
    "training": dict,
}


def counting_network(counters: Counters) -> Network:
    """The populations and synapses of a counting network."""
    channels = counters.taxels * counters.polarities
    clocks = counters.clocks
    layers: list[Layer] = []

    def add(name: str, beta: float, theta: float, sources: Mapping[int, Sparse], bias: float = 0.0) -> int:
        neurons = next(iter(sources.values())).shape[0]
        layers.append(Layer(name=name, beta=beta, theta=theta, bias=np.full(neurons, bias), sources=sources))
        return len(layers) - 1

    source = INPUT
    width = channels
    if clocks.channels:
        width = channels * counters.parts
        every = sparse.vstack([sparse.eye_array(channels)] * counters.parts)
        clocked = sparse.kron(sparse.eye_array(counters.parts), np.ones((channels, 1)))
        gates = sparse.csr_array(sparse.hstack([every, clocked]))
        source = add("gates", 0.0, 1.5, {INPUT: gates})
    channel, part, count = counters.counter.T
    summed = {}
    for each in np.unique(count).tolist():
        rows = np.flatnonzero(count == each)
        ones = np.ones(len(rows))
        place = np.arange(len(rows)), part[rows] * channels + channel[rows]
        into = {source: sparse.csr_array((ones, place), shape=(len(rows), width))}
        into[len(layers)] = sparse.csr_array(sparse.diags_array(-BLOCK * ones))
        reached = add(f"count{each}", 1.0, each - 0.5, into)
        summed[reached] = sparse.csr_array(counters.weight[:, rows].astype(np.float64))
    sums = add("sums", 1.0, counters.threshold, summed, counters.slope)
    one = sparse.csr_array(sparse.eye_array(counters.classes))
    votes = add("votes", 0.0, 0.5, {sums: one, sums + 1: one.copy()})
    sensor = Input(taxels=counters.taxels, polarities=counters.polarities, clocks=clocks, bins=counters.bins)
    return assemble(layers, sensor, votes, np.arange(counters.classes), counters.classes)


def write_counters(path: str | os.PathLike[str], counters: Counters) -> str:
    """Write a file, whole or not at all; return its sha256. Equal input gives equal bytes."""
    manifest = {name: getattr(counters, name) for name in (*SIZES, *CONSTANTS)}
    manifest |= {"format": archive.COUNTERS, "version": VERSION, "training": dict(counters.training)}
    arrays = {name: getattr(counters, name) for name in ("counter", "weight")}
    return archive.write_archive(archive.archive_bytes(manifest, arrays), path)


def read_counters(path: str | os.PathLike[str]) -> tuple[Counters, str]:
    """Read and check a file; also its sha256. ModelError if it is damaged, altered, newer or inconsistent."""
    path = Path(path)
    with reading(path, ModelError, archive.AGAIN):
        manifest, members = archive.read_archive(
            path, archive.COUNTERS, VERSION, KINDS, lambda _: ("counter", "weight")
        )
        archive.require_none(_array_faults(manifest, members["counter"], members["weight"]))
        manifest = {
            **manifest,
            **{name: float(manifest[name]) for name in CONSTANTS},
        }  # too large: OverflowError
    counters = Counters(
        **{name: manifest[name] for name in (*SIZES, *CONSTANTS, "training")},
        counter=read_only(members["counter"]),
        weight=read_only(members["weight"]),
    )
    return counters, sha256_of(path)


def _array_faults(sizes: Mapping[str, Any], counter: archive.Array, weight: archive.Array) -> list[str]:
    """What in the arrays does not suit the sizes, or each other."""
    if sizes["taxels"] * sizes["polarities"] * sizes["parts"] > MOST:
        return [f"more than {MOST:,} channels of parts"]
    if sizes["steps"] + sizes["ramp"] > MOST_STEPS:
        return [f"more than {MOST_STEPS:,} steps, those of the read-out included"]
    if (
        (counter.dtype.kind, weight.dtype.kind) != ("i", "i")
        or counter.shape[1:] != (3,)
        or not len(counter)
    ):
        return ["counter is no table of whole numbers"]
    if weight.shape != (sizes["classes"], len(counter)) or np.abs(weight.astype(np.int64)).max() > BLOCK:
        return ["weight is no table of whole numbers for these counters"]
    most = sizes["taxels"] * sizes["polarities"] - 1, sizes["parts"] - 1, MOST_STEPS
    inside = bool(np.all((counter >= (0, 0, 1)) & (counter <= most)))
    return [] if inside else ["counters of channels, parts or counts that do not exist"]


def read_network(path: str | os.PathLike[str]) -> ReadNetwork[Network]:
    """Read a file as the spiking network that it stands for; raises as :func:`read_counters`."""
    counters, sha256 = read_counters(path)
    thresholds = ", ".join(map(str, np.unique(counters.counter[:, 2]).tolist()))
    parts = f" in each of {counters.parts} parts" if counters.parts > 1 else ""
    fact = (
        f"{len(counters.counter)} counters of {thresholds} events{parts}; {counters.steps} steps count, then "
        f"{counters.ramp} to read out"
    )
    with reading(path, ModelError, archive.AGAIN):
        network = counting_network(counters)
    return ReadNetwork(
        network=network,
        facts=(fact,),
        sha256=sha256,
        training={**counters.training, "steps": counters.steps},
    )
