"""What a netlist is: sizes, layers, use of every limit; and how ``inspect`` shows it."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.idle import Forgotten, forgotten
from spikeloom.compiler.targets.loihi1.layout.place import chip_count
from spikeloom.compiler.targets.loihi1.legalize import LimitUse, require_legal, words_of_axons
from spikeloom.compiler.targets.loihi1.netlist import Netlist, read_netlist
from spikeloom.compiler.targets.loihi1.registers import kept_shares
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text
from spikeloom.runtime.report.shown import Shown

SHARED = 0.9
"""Shared lists are spoken of when memory is at most this share of what the unrolled network would take."""

OneOrMany = float | Sequence[float]
"""One value where all neurons of a layer share it, else the different ones, ascending."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerFacts:
    """A layer: what it was and what the chip holds of it; `realised` is what registers make of a parameter."""

    name: str
    neurons: int
    compartments: int
    synapses: int
    max_fan_in: int
    weight_bits: int
    scale: OneOrMany
    exponents: Sequence[int]
    threshold: OneOrMany
    theta: float
    theta_realised: OneOrMany
    beta: float
    beta_realised: OneOrMany
    alpha: float | None = field(default=None, metadata=OPTIONAL)
    alpha_realised: OneOrMany | None = field(default=None, metadata=OPTIONAL)
    depth: int
    synapses_stored: int
    synapses_from_itself: int | None = field(default=None, metadata=OPTIONAL)
    cores: Sequence[int]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NetlistFacts(Shown):
    """A netlist; synapses are counted in the network, as stored on cores, and as stored and not zero.

    Words of synaptic memory are those of all cores; unrolled are those that it would take if no axons shared
    a list.
    """

    target: str
    taxels: int
    clocks: Clocks | None = field(default=None, metadata=OPTIONAL)
    bins: int | None = field(default=None, metadata=OPTIONAL)
    free_running: Forgotten | None = field(default=None, metadata=OPTIONAL)
    classes: int
    neurons: int
    compartments: int
    synapses: int
    synapses_stored: int
    synapses_nonzero: int
    synapse_words: int
    synapse_words_unrolled: int
    cores: int
    chips: int
    tiles: Sequence[int]
    layers: Sequence[LayerFacts]
    limits: Sequence[LimitUse]
    provenance: Mapping[str, Any]
    sha256: str


def inspect(path: str | os.PathLike[str]) -> Outcome:
    """What a netlist file holds, with its layout; raises as :func:`machine.load` does."""
    netlist = read_netlist(path)
    return Outcome(
        describe(netlist, require_legal(netlist, load_target(netlist.target)), sha256_of(path)), sections
    )


def describe(netlist: Netlist, uses: Sequence[LimitUse], sha256: str) -> NetlistFacts:
    """Facts of a netlist whose file has a hash; `uses` as :func:`legalize.measure` counts them."""
    target = load_target(netlist.target)
    return NetlistFacts(
        target=netlist.target,
        taxels=netlist.taxels,
        clocks=None if netlist.clocks == NO_CLOCKS else netlist.clocks,
        bins=netlist.bins if netlist.bins > 1 else None,
        free_running=forgotten(netlist) if netlist.blank else None,
        classes=netlist.classes,
        neurons=sum(layer.neurons for layer in netlist.layers),
        compartments=netlist.n_compartments,
        synapses=sum(layer.synapses for layer in netlist.layers),
        synapses_stored=netlist.n_synapses,
        synapses_nonzero=int(np.count_nonzero(netlist.synapse_weight)),
        synapse_words=sum(use.used for use in uses if use.name == "core.synapse_words"),
        synapse_words_unrolled=int(words_of_axons(netlist, target).sum()),
        cores=netlist.n_cores,
        chips=chip_count(netlist.core_tile, target),
        tiles=netlist.core_tile.tolist(),
        layers=[_layer(netlist, index) for index in range(len(netlist.layers))],
        limits=uses,
        provenance=netlist.provenance,
        sha256=sha256,
    )


def _layer(netlist: Netlist, index: int) -> LayerFacts:
    layer = netlist.layers[index]
    ids = netlist.compartments_of(index)
    axon = netlist.axon_of_synapse()[netlist.layer[netlist.synapse_compartment()] == index]
    source = netlist.axon_source[axon] - netlist.n_inputs
    from_itself = int(np.count_nonzero(netlist.layer[source[source >= 0]] == index))
    alpha, beta = kept_shares(netlist.decay_u[ids], netlist.decay_v[ids])
    return LayerFacts(
        name=layer.name,
        neurons=layer.neurons,
        compartments=len(ids),
        synapses=layer.synapses,
        max_fan_in=layer.max_fan_in,
        weight_bits=layer.weight_bits,
        scale=_one_or_many(netlist.scale[ids]),
        exponents=np.unique(netlist.format_exponent[netlist.axon_format[axon]]).tolist(),
        threshold=_one_or_many(netlist.threshold[ids]),
        theta=layer.theta,
        theta_realised=_one_or_many(netlist.threshold[ids] / netlist.scale[ids]),
        beta=layer.beta,
        beta_realised=_one_or_many(beta),
        alpha=layer.alpha if alpha.any() else None,
        alpha_realised=_one_or_many(alpha) if alpha.any() else None,
        depth=layer.depth,
        synapses_stored=len(axon),
        synapses_from_itself=from_itself or None,
        cores=np.unique(netlist.core_of_compartment()[ids]).tolist(),
    )


def _one_or_many(values: IntArray | FloatArray) -> OneOrMany:
    distinct: list[float] = np.unique(values).tolist()
    return distinct[0] if len(distinct) == 1 else distinct


def sections(facts: NetlistFacts) -> Iterator[Section]:
    """Layers, cores and the fullest core of every limit."""
    tiles = f"{'tile' if facts.cores == 1 else 'tiles'} {', '.join(map(str, facts.tiles))}"
    cores = f"{number(facts.cores, 'core')} on {tiles if facts.chips == 1 else number(facts.chips, 'chip')}"
    left = "" if facts.compartments == facts.neurons else f" ({facts.compartments:,} on the chip)"
    lines = [
        f"{facts.target}: {facts.neurons:,} neurons{left}, {facts.synapses:,} synapses "
        f"({facts.synapses_stored:,} stored, {facts.synapses_nonzero:,} non-zero), {cores}"
    ]
    if facts.clocks is not None and facts.clocks.channels:
        channels = facts.clocks.channels
        steps = facts.clocks.steps
        lines.append(
            f"  {number(channels, 'clock')} of {steps} steps each, {channels * steps} in all, beside the sensor"
        )
    if facts.clocks is not None and facts.clocks.length is not None:
        lines.append(f"  a recording is run for {facts.clocks.length} steps, whatever its own length")
    if facts.synapse_words < SHARED * facts.synapse_words_unrolled:
        words = f"{facts.synapse_words:,} words, {facts.synapse_words_unrolled:,} unrolled"
        lines.append(f"  synapse lists that repeat are stored once a core: {words}")
    if facts.bins is not None:
        lines.append(f"  a step joins {facts.bins} bins of the recordings")
    if "bin_s" in (origin := origin_of(facts.provenance)):
        lines.append(f"  trained on bins of {origin['bin_s']:g} s")
    if facts.free_running is not None:
        lines.append(f"  free-running: {facts.free_running.text}")
    yield Section("", [*map(Text, lines), _layer_table(facts.layers)])
    fullest: dict[str, LimitUse] = {}
    for use in facts.limits:
        if use.name not in fullest or use.used > fullest[use.name].used:
            fullest[use.name] = use
    rows = [
        [
            use.name,
            f"{use.used:,}",
            f"{use.allowed:,}",
            f"{100 * use.used / use.allowed:.0f} %",
            "chip" if use.core is None else str(use.core),
        ]
        for use in fullest.values()
    ]
    yield Section("", [Table(["limit", "used", "allowed", "fill", "fullest core"], rows)])


def _layer_table(layers: Sequence[LayerFacts]) -> Table:
    columns = {
        "layer": [layer.name for layer in layers],
        "neurons": [f"{layer.neurons:,}" for layer in layers],
        "on chip": [f"{layer.compartments:,}" for layer in layers],
        "synapses": [f"{layer.synapses:,}" for layer in layers],
        "stored": [f"{layer.synapses_stored:,}" for layer in layers],
        "from itself": [f"{layer.synapses_from_itself or 0:,}" for layer in layers],
        "fan-in": [str(layer.max_fan_in) for layer in layers],
        "bits": [
            f"{len(x.exponents)}×{x.weight_bits}" if len(x.exponents) > 1 else str(x.weight_bits)
            for x in layers
        ],
        "scale": [_span(layer.scale) for layer in layers],
        "threshold": [_span(layer.threshold) for layer in layers],
        "θ": [_span(layer.theta_realised) for layer in layers],
        "β": [_span(layer.beta_realised) for layer in layers],
        "α": [_span(layer.alpha_realised or 0) for layer in layers],
        "cores": [" ".join(map(str, layer.cores)) for layer in layers],
    }
    if not any(layer.synapses_from_itself for layer in layers):
        del columns["from itself"]
    if all(layer.alpha_realised is None for layer in layers):
        del columns["α"]
    return Table(list(columns), [list(row) for row in zip(*columns.values(), strict=True)])


def _span(values: OneOrMany) -> str:
    if not isinstance(values, Sequence):
        return f"{values:.6g}"
    ends = f"{min(values):.6g}", f"{max(values):.6g}"
    return "…".join(ends) if ends[0] != ends[1] else ends[0]
