"""What ``inspect`` says of a netlist of crossbar cores, and of a network that was trained for them."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.native import BASES, SYSTEM, highest_level
from spikeloom.compiler.targets.truenorth.native_file import Trained
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, read_crossbars
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text
from spikeloom.runtime.report.shown import Shown


@dataclass(frozen=True, slots=True)
class LayerSize:
    """A layer on the chip; `distinct` counts a neuron once, however often it was copied."""

    name: str
    neurons: int
    distinct: int
    max_fan_in: int
    cores: int


@dataclass(frozen=True, slots=True)
class LimitFill:
    """The fullest use of a limit."""

    name: str
    used: int
    allowed: int


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Description(Shown):
    """Sizes, layers and the fullest core by each limit."""

    target: str
    taxels: int
    classes: int
    clocks: Clocks | None = field(metadata=OPTIONAL)
    bins: int | None = field(metadata=OPTIONAL)
    ticks_per_step: int
    drain_ticks: int
    neurons: int
    axons: int
    crossing_points: int
    feeds: int
    tick_clocks: int
    wires: int
    cores: int
    layers: tuple[LayerSize, ...]
    limits: tuple[LimitFill, ...]
    max_crossing_points_of_an_axon: int
    provenance: Mapping[str, Any]
    sha256: str


def inspect(path: str | os.PathLike[str]) -> Outcome:
    """What a netlist file holds, which breaks no rule of the chip; FormatError or CapacityError if it does."""
    netlist = read_crossbars(path)
    require_legal(netlist, load_target(netlist.target))
    return describe(netlist, sha256_of(path))


def describe(netlist: CrossbarNetlist, sha256: str) -> Outcome:
    """What a netlist is; `sha256` is its file's."""
    chip = load_target(netlist.target)
    core = netlist.core_of_neuron()
    degree = np.diff(netlist.axon_synapses)
    fan_in = np.bincount(netlist.neuron_of_synapse(), minlength=netlist.n_neurons)
    fullest = {
        "core.neurons": np.diff(netlist.core_neurons),
        "core.axons": np.diff(netlist.core_axons),
        "neuron.delay": netlist.wire_delay,
        "chip.cores": np.array([netlist.n_cores]),
    }

    def layer(index: int, name: str) -> LayerSize:
        members = netlist.layer == index
        return LayerSize(
            name=name,
            neurons=int(np.count_nonzero(members)),
            distinct=len(np.unique(netlist.neuron[members])),
            max_fan_in=int(fan_in[members].max(initial=0)),
            cores=len(np.unique(core[members])),
        )

    description = Description(
        target=netlist.target,
        taxels=netlist.taxels,
        classes=netlist.classes,
        clocks=netlist.clocks if netlist.clocks.channels else None,
        bins=netlist.bins if netlist.bins > 1 else None,
        ticks_per_step=netlist.bin_ticks,
        drain_ticks=netlist.drain,
        neurons=netlist.n_neurons,
        axons=netlist.n_axons,
        crossing_points=netlist.n_synapses,
        feeds=len(netlist.feed_channel),
        tick_clocks=len(netlist.clock_core),
        wires=len(netlist.wire_neuron),
        cores=netlist.n_cores,
        layers=tuple(layer(*each) for each in enumerate(netlist.layers)),
        limits=tuple(
            LimitFill(rule, int(used.max(initial=0)), chip.limit(rule)) for rule, used in fullest.items()
        ),
        max_crossing_points_of_an_axon=int(degree.max(initial=0)),
        provenance=netlist.provenance,
        sha256=sha256,
    )
    return Outcome(description, sections)


def sections(found: Description) -> list[Section]:
    """The same for people."""
    ticks = found.ticks_per_step
    head = (
        f"{found.target}: {found.neurons:,} neurons, {found.axons:,} axons, {found.crossing_points:,} crossing points, "
        f"{number(found.cores, 'core')}; {ticks} tick{'s' * (ticks > 1)} a data step, {found.drain_ticks} more to drain"
        + (f"; a step joins {found.bins} bins" if found.bins else "")
        + (
            f"; trained on bins of {origin['bin_s']:g} s"
            if "bin_s" in (origin := origin_of(found.provenance))
            else ""
        )
    )
    layers = [
        [
            layer.name,
            f"{layer.neurons:,}",
            f"{layer.distinct:,}",
            f"{layer.max_fan_in:,}",
            f"{layer.cores:,}",
        ]
        for layer in found.layers
    ]
    limits = [
        [limit.name, f"{limit.used:,}", f"{limit.allowed:,}", f"{100 * limit.used / limit.allowed:.0f} %"]
        for limit in found.limits
    ]
    return [
        Section("Netlist", [Text(head), Table(["layer", "neurons", "distinct", "fan-in", "cores"], layers)]),
        Section("Limits", [Table(["limit", "used", "allowed", "fill"], limits)]),
    ]


@dataclass(frozen=True, slots=True)
class StageSize:
    """A stage; `zeros` is the share of levels that are 0."""

    name: str
    blocks: int
    inputs: int
    clocks: int
    neurons: int
    zeros: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedDescription:
    """A network that was trained for the chip, and how it was made."""

    system: str
    taxels: int
    classes: int
    graph: str
    edges: int
    copies: int
    levels: int
    clocks: int
    towers: int
    layers: tuple[StageSize, ...]
    weights: str
    sets: tuple[str, ...]
    training: Mapping[str, Any]
    sha256: str


def describe_trained(trained: Trained) -> Outcome:
    """What a trained network is."""
    network = trained.network
    description = TrainedDescription(
        system=SYSTEM,
        taxels=network.taxels,
        classes=network.classes,
        graph=trained.graph,
        edges=len(trained.edges),
        copies=network.copies,
        levels=2 * highest_level(network.copies) + 1,
        clocks=network.clocks.channels,
        towers=1,
        layers=tuple(
            StageSize(s.name, s.blocks, s.inputs.shape[1], s.clocks, s.size, float(np.mean(s.level == 0)))
            for s in network.stages
        ),
        weights=trained.weights,
        sets=tuple(trained.sets),
        training=trained.training,
        sha256=trained.sha256,
    )
    return Outcome(description, trained_sections)


def trained_sections(found: TrainedDescription) -> list[Section]:
    """The same for people."""
    rows = [
        [
            s.name,
            f"{s.blocks:,}",
            f"{s.inputs:,}",
            f"{s.clocks:,}",
            f"{s.neurons:,}",
            f"{100 * s.zeros:.0f} %",
        ]
        for s in found.layers
    ]
    lines = [f"  holds the epochs {', '.join(found.sets)}, shown is {found.weights}"]
    training = found.training
    if "command" in training:
        lines.append(f"  made by: {training['command']}")
    for which in ("test", *found.sets):
        measured = training.get(which)
        if isinstance(measured, dict) and "correct" in measured:
            share = f"{100 * measured['accuracy']:.2f} %"
            lines.append(
                f"  {share} of {measured['samples']} test recordings"
                if which == "test"
                else f"  {which}: epoch {measured['epoch']}, {share} of {training['test_samples']} test recordings"
            )
    head = [
        f"{found.system}: {found.taxels} taxels, graph {found.graph}, {found.classes} classes",
        f"{found.copies} copies of an input, weights {', '.join(map(str, BASES[found.copies]))}: "
        f"{found.levels} levels; {found.clocks} clocks",
    ]
    table = Table(["layer", "groups", "inputs", "clocks", "neurons", "level 0"], rows)
    return [Section("Network", [Text("\n".join(head)), table, Text("\n".join(lines))])]
