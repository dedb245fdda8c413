"""A network of crossbar cores as memory files of RANC's hardware description, and a recording as packets.

Row n of ``csram_PLACE.mem`` is neuron n of the core at ``x + width * y``: crossing points, membrane, reset,
weights, leak, both thresholds, reset mode, and where its spikes go. ``tc_PLACE.mem`` holds the types of the
axons. All sizes are parameters of the description.
"""

from collections.abc import Iterator

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.ranc import Terms, aims_of, crossbar, mesh_of, packets_of
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import EventArray

WIDTHS = {"OFFSET_BITS": 9, "MEMBRANE_BITS": 22, "WEIGHT_BITS": 11, "LEAK_BITS": 11, "THRESHOLD_BITS": 22}
"""Widths of registers: those of the chip, twice as much for neurons that are doubled, and counted from elsewhere."""


def sizes(terms: Terms, chip: Target) -> dict[str, int]:
    """All parameters of the description, by name; its cores have as many neurons as the fullest.

    ModelError for more classes than its output bus has numbers.
    """
    netlist = terms.netlist
    mesh = mesh_of(terms.netlist)
    axons = chip.limit("core.axons")
    if netlist.classes >= axons:
        raise ModelError(
            f"{netlist.classes} classes, {axons - 1} allowed on RANC's output bus; give a smaller network"
        )
    return WIDTHS | {
        "WIDTH": mesh.width,
        "HEIGHT": mesh.height,
        "BUS_X": mesh.bus[0],
        "BUS_Y": mesh.bus[1],
        "OUTPUTS": axons,
        "NEURONS": max(int(np.diff(netlist.core_neurons).max()), 2),
        "AXONS": axons,
        "WEIGHTS": chip.limit("core.axon_types"),
        "DELAYS": chip.limit("neuron.delay") + 1,
    }


def memories(terms: Terms, found: dict[str, int]) -> Iterator[tuple[str, str]]:
    """Name and content of each memory file; neurons leave on the output of their class, all others on the next."""
    netlist = terms.netlist
    mesh = mesh_of(terms.netlist)
    axons = found["AXONS"]
    places = (mesh.x + mesh.width * mesh.y).tolist()
    outputs = np.where(netlist.readout_class < 0, netlist.classes, netlist.readout_class)
    limits = (netlist.threshold, -netlist.negative_threshold, netlist.reset_mode)
    columns = (
        netlist.initial,
        netlist.reset,
        netlist.weight,
        netlist.leak,
        *limits,
        aims_of(netlist, mesh, outputs),
    )
    registers = np.column_stack(columns).tolist()
    membrane, weight, leak, threshold = (
        found[f"{name}_BITS"] for name in ("MEMBRANE", "WEIGHT", "LEAK", "THRESHOLD")
    )
    kind_bits, *way = _bits_of(found, "WEIGHTS", "AXONS", "DELAYS")
    widths = [membrane] * 2 + [weight] * found["WEIGHTS"] + [leak, threshold, threshold, 1]
    widths += [found["OFFSET_BITS"]] * 2 + way
    silent = "0" * axons + _joined([*[0] * 7, 1, *[0] * 6], widths)  # a threshold of 1
    for place in range(mesh.width * mesh.height):
        kinds = np.zeros(0, np.int64)
        rows = list[str]()
        if place in places:
            core = places.index(place)
            kinds, points = crossbar(netlist, core)
            for point, row in zip(
                points[:, ::-1].tolist(), registers[netlist.core_neurons[core] :], strict=False
            ):
                rows.append("".join(map(str, point)).zfill(axons) + _joined(row, widths))
        rows += [silent] * (found["NEURONS"] - len(rows))
        yield f"csram_{place:03d}.mem", "\n".join(rows) + "\n"
        types = np.pad(kinds, (0, axons - len(kinds))).tolist()
        yield f"tc_{place:03d}.mem", "".join(f"{kind:0{kind_bits}b}\n" for kind in types)


def _bits_of(found: dict[str, int], *names: str) -> list[int]:
    """Bits of a number below each size."""
    return [(found[name] - 1).bit_length() for name in names]


def _joined(values: list[int], widths: list[int]) -> str:
    """Numbers of so many bits each, side by side; those below zero as two's complement."""
    return "".join(
        f"{value & ((1 << width) - 1):0{width}b}" for value, width in zip(values, widths, strict=True)
    )


def packet_lines(terms: Terms, found: dict[str, int], events: EventArray) -> Iterator[str]:
    """Ticks of a recording (n_inputs, T); then, for each and one more, how many packets are due, and these in hex."""
    axon_bits, delay_bits = _bits_of(found, "AXONS", "DELAYS")
    ticks = packets_of(terms.netlist, events, mesh_of(terms.netlist))
    yield str(len(ticks))
    for tick in [*ticks, []]:
        yield str(len(tick))
        for x, y, line in tick:
            yield f"{((x << found['OFFSET_BITS'] | y) << axon_bits | line) << delay_bits:x}"
