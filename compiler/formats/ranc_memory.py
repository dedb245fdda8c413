"""A network of crossbar cores as memory files of RANC's hardware description, and a recording as packets.

Row n of ``csram_PLACE.mem`` is neuron n of the core at ``x + width * y``: crossing points, membrane, reset, weights,
leak, both thresholds, reset mode, and where its spikes go. ``tc_PLACE.mem`` holds the types of the axons. All sizes are
parameters of the description.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from spikeloom.compiler.formats.ranc import EventArray, Mesh, Terms, aims_of, crossbar, mesh_of, packets_of
from spikeloom.compiler.targets.base import Target

WIDTHS = {"OFFSET_BITS": 9, "MEMBRANE_BITS": 22, "WEIGHT_BITS": 11, "LEAK_BITS": 11, "THRESHOLD_BITS": 22}
"""Widths of registers: those of the chip, twice as much for neurons that are doubled, and counted from elsewhere."""


def sizes(terms: Terms, chip: Target) -> dict[str, int]:
    """All parameters of the description; its cores have as many neurons as the fullest."""
    netlist, mesh = terms.netlist, mesh_of(terms.netlist)
    return WIDTHS | {
        "WIDTH": mesh.width,
        "HEIGHT": mesh.height,
        "BUS_X": mesh.bus[0],
        "BUS_Y": mesh.bus[1],
        "OUTPUTS": netlist.classes + 1,
        "NEURONS": max(int(np.diff(netlist.core_neurons).max()), 2),
        "AXONS": chip.limit("core.axons"),
        "WEIGHTS": chip.limit("core.axon_types"),
        "DELAYS": chip.limit("neuron.delay") + 1,
    }


def memories(terms: Terms, found: dict[str, int]) -> Iterator[tuple[str, str]]:
    """Name and content of each memory file; neurons leave on the output of their class, all others on the last."""
    netlist, mesh = terms.netlist, mesh_of(terms.netlist)
    outputs = np.where(netlist.readout_class < 0, netlist.classes, netlist.readout_class)
    aims = aims_of(netlist, mesh, outputs)
    core_at = {(int(x), int(y)): core for core, (x, y) in enumerate(zip(mesh.x, mesh.y, strict=True))}
    axons, kind_bits, axon_bits, delay_bits = (
        found["AXONS"],
        *((found[name] - 1).bit_length() for name in ("WEIGHTS", "AXONS", "DELAYS")),
    )
    membrane, weight, leak, threshold = (WIDTHS[f"{name}_BITS"] for name in ("MEMBRANE", "WEIGHT", "LEAK", "THRESHOLD"))
    silent = _bits((0, axons + 2 * membrane + found["WEIGHTS"] * weight + leak), (1, threshold), (0, threshold), (0, 1))
    silent += _bits((0, 2 * WIDTHS["OFFSET_BITS"] + axon_bits + delay_bits))
    for place in range(mesh.width * mesh.height):
        if (core := core_at.get(divmod(place, mesh.width)[::-1])) is None:
            kinds, rows = np.zeros(0, np.int64), []
        else:
            kinds, points = crossbar(netlist, core)
            first = int(netlist.core_neurons[core])
            rows = [
                "".join(map(str, row[::-1].tolist())).zfill(axons)
                + _bits(
                    (int(netlist.initial[n]), membrane),
                    (int(netlist.reset[n]), membrane),
                    *((each, weight) for each in netlist.weight[n].tolist()),
                    (int(netlist.leak[n]), leak),
                    (int(netlist.threshold[n]), threshold),
                    (-int(netlist.negative_threshold[n]), threshold),
                    (int(netlist.reset_mode[n]), 1),
                    *zip(aims[n], (WIDTHS["OFFSET_BITS"], WIDTHS["OFFSET_BITS"], axon_bits, delay_bits), strict=True),
                )
                for n, row in enumerate(points, first)
            ]
        rows += [silent] * (found["NEURONS"] - len(rows))
        yield f"csram_{place:03d}.mem", "\n".join(rows) + "\n"
        types = np.pad(kinds, (0, axons - len(kinds))).tolist()
        yield f"tc_{place:03d}.mem", "".join(_bits((kind, kind_bits)) + "\n" for kind in types)


def _bits(*fields: tuple[int, int]) -> str:
    """Numbers of so many bits each, side by side; those below zero as two's complement."""
    return "".join(f"{value & ((1 << width) - 1):0{width}b}" for value, width in fields)


def packet_lines(terms: Terms, found: dict[str, int], events: EventArray) -> Iterator[str]:
    """Ticks of a recording (n_inputs, T); then, for each and one more, how many packets are due, and these in hex."""
    mesh: Mesh = mesh_of(terms.netlist)
    axon_bits, delay_bits = ((found[name] - 1).bit_length() for name in ("AXONS", "DELAYS"))
    ticks = packets_of(terms.netlist, events, mesh)
    yield str(len(ticks))
    for tick in [*ticks, []]:
        yield str(len(tick))
        for x, y, line in tick:
            yield f"{((x << WIDTHS['OFFSET_BITS'] | y) << axon_bits | line) << delay_bits:x}"
