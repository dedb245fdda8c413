"""What the page of a network shows of this chip: costs with figures, and cores on the mesh."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.place import chip_of_core, chip_tiles, hops
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import FloatArray
from spikeloom.runtime.machines.core_map import Core, CoreMap, Fill, Mesh, Way
from spikeloom.runtime.machines.loihi1.costs.result import CostReport
from spikeloom.runtime.report.drawing import bars
from spikeloom.runtime.report.numbers import si
from spikeloom.runtime.report.sections import Block, Figure, Table, Text

FILLS = ("core.compartments", "core.synapse_words", "core.axons_in", "core.axons_out")
"""Limits of which the fullest says how full a core is: those that a larger network uses up."""

AT_INPUT = -1
"""In place of a core: the input, which has no place on the mesh."""


def core_map(netlist: Netlist, target: Target, fired: FloatArray) -> CoreMap:
    """Where the cores lie, how full each is of everything, and packets if each source id fires so often."""
    width = target.limit("mesh.width")
    chip = chip_of_core(netlist.core_tile, target)
    fill: dict[int, dict[str, Fill]] = {core: {} for core in range(netlist.n_cores)}
    for use in measure(netlist, target):
        if use.core is not None and use.allowed:
            fill[use.core][use.name] = Fill(used=use.used, allowed=use.allowed, share=use.used / use.allowed)
    placed = []
    for core, tile in enumerate(netlist.core_tile.tolist()):
        y, x = divmod(tile % chip_tiles(target), width)
        members = netlist.layer[slice(*netlist.core_compartments[core : core + 2])]
        placed.append(
            Core(
                core=core,
                chip=int(chip[core]),
                tile=tile,
                x=x,
                y=y,
                layers=tuple(netlist.layers[i].name for i in np.unique(members)),
                compartments=len(members),
                fullest=max(FILLS, key=lambda name: fill[core][name].share),
                fill=fill[core],
            )
        )
    return CoreMap(
        mesh=Mesh(
            width=width, height=target.limit("mesh.height"), tile_cores=target.limit("mesh.tile_cores")
        ),
        cores=tuple(placed),
        traffic=_traffic(netlist, target, fired),
    )


def _traffic(netlist: Netlist, target: Target, fired: FloatArray) -> tuple[Way, ...]:
    """Axons and packets from the input and from each core to each core, if each source id fires so often."""
    home = np.append(np.full(netlist.n_inputs, AT_INPUT), netlist.core_of_compartment())
    ends = np.stack([home[netlist.axon_source], netlist.core_of_axon()])
    pairs, which, axons = np.unique(ends, axis=1, return_inverse=True, return_counts=True)
    packets = np.bincount(which.ravel(), fired[netlist.axon_source])
    tile = netlist.core_tile.tolist()
    chip = chip_of_core(netlist.core_tile, target)
    ways = []
    for (pre, post), sent, count in zip(pairs.T.tolist(), packets.tolist(), axons.tolist(), strict=True):
        near = pre != AT_INPUT and chip[pre] == chip[post]
        distance = sum(hops(tile[pre], tile[post], target.limit("mesh.width"))) if near else None
        ways.append(
            Way(source=None if pre == AT_INPUT else pre, to=post, packets=sent, axons=count, hops=distance)
        )
    return tuple(ways)


def figures(found: CostReport) -> list[Block]:
    """Energy by layer and part, time by core."""
    tables = list(found.per_inference.energy_j)
    blocks: list[Block] = (
        [Text(f"How far this is from silicon: {found.measured}.")] if found.measured else []
    )
    if tables:
        layers = {layer.name: list(layer.amounts.energy_j.values()) for layer in found.layers}
        title = "Dynamic energy of a mean inference by layer"
        caption = "Synapses belong to the layer that receives."
        blocks.append(_bars("energy-layers", title, layers, tables, "J", caption))
        parts = next(iter(found.energy_by_part_j.values()))
        shares = {part: [found.energy_by_part_j[name][part] for name in tables] for part in parts}
        title = "Dynamic energy of a mean inference by part of the chip"
        caption = "Synapse: visited entries; soma: neuron updates and spikes; network: packets and hops."
        blocks.append(_bars("energy-parts", title, shares, tables, "J", caption))
    if found.time:
        first = found.time[0].table
        cores = {f"core {core.core}": [core.sweep_s[first], core.receive_s[first]] for core in found.cores}
        title = "Time of a mean inference by core"
        caption = "Both go on at once; a step lasts as long as the slowest core."
        blocks.append(_bars("time-cores", title, cores, ["sweep and send", "receive"], "s", caption))
    return blocks


def _bars(
    name: str,
    title: str,
    rows: Mapping[str, Sequence[float]],
    series: Sequence[str],
    unit: str,
    caption: str,
) -> Figure:
    """Bars, with their numbers as a table."""
    cells = [[label, *(si(value, unit) for value in values)] for label, values in rows.items()]
    numbers = [Table(["", *series], cells, title, most=0)]
    return Figure(name, partial(bars, title, rows, series, unit), f"{title}. {caption}", numbers)
