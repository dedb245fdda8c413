"""A network of crossbar cores, and a recording, for the simulator of RANC (github.com/UA-RCL/RANC, 08ae4bd).

The file serves as input and as configuration: ``ranc_sim NET.json OUT.txt NET.json TICKS``. Where RANC differs:

- Its ``destination_tick`` is one less than ours: a packet of ``d`` is due ``d + 1`` ticks after it was sent. Packets
  listed for tick ``i`` with ``d = 0`` are those that we inject in tick ``i``.
- Row ``k`` of its output holds what the neurons on the output bus did in our tick ``k - 1``; row 0 is empty. So a
  recording takes one tick more. Voters go out on the bus in the order of their ids; neurons without a target share
  the output after the last, for RANC has no neuron without one.
- Its schema asks for ``destination_core_offset``; the examples in its repository are older and have another name.
- The negative threshold is compared by ``<`` only in reset type 0, and is written with its sign.
- Its membranes have no width, and it has neither leak reversal, a reset that does nothing nor a negative threshold that
  saturates: networks that need them are refused. A linear reset below adds the threshold.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.netlist import RESET_NONE, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray

EventArray = npt.NDArray[np.uint8] | npt.NDArray[np.bool_]


def _require_supported(netlist: CrossbarNetlist) -> None:
    """Refuse what RANC has not, with the number of neurons that use it.

    A neuron that saturates at zero, is reset to zero and has no other use of its negative threshold is expressed as a
    reset; all others that saturate are not.
    """
    resets = (netlist.reset_mode == RESET_TO) & (netlist.reset == netlist.negative_threshold)
    used = {
        "a leak with reversal": (netlist.leak_reversal > 0) & (netlist.leak != 0),
        "a reset that does nothing": netlist.reset_mode == RESET_NONE,
        "a negative threshold that saturates": (netlist.negative_saturates > 0) & ~resets,
    }
    if missing := [f"{name} ({np.count_nonzero(which)} neurons)" for name, which in used.items() if which.any()]:
        raise ModelError(f"--to ranc: RANC has no {', no '.join(missing)}; leave them out of the network")


def export(netlist: CrossbarNetlist, events: EventArray | None = None) -> Iterator[str]:
    """Lines of the JSON file of a network that breaks no rule of its chip; ModelError if it uses what RANC has not.

    Events (n_inputs, T) of a recording become packets, with the clocks; without it there are none.
    """
    _require_supported(netlist)
    x, y = netlist.core_x - netlist.core_x.min(), netlist.core_y - netlist.core_y.min()
    voters = np.flatnonzero(netlist.readout_class >= 0)
    bus = (0, int(y.max()) + 1)  # a row of its own above all cores
    chip = load_target(netlist.target)
    config = {
        "num_neurons": chip.limit("core.neurons"),
        "num_axons": chip.limit("core.axons"),
        "num_weights": chip.limit("core.axon_types"),
        "num_cores_x": int(x.max()) + 1,
        "num_cores_y": bus[1] + 1,
        "max_tick_offset": chip.limit("neuron.delay") + 1,
        "neuron_block_trace_verbosity": 0,
        "core_controller_trace_verbosity": 0,
        "scheduler_trace_verbosity": 0,
        "neuron_reset_type": 0,
    }
    yield "{"
    for name, value in config.items():
        yield f'"{name}": {value},'
    yield f'"output_bus": {json.dumps({"coordinates": list(bus), "num_outputs": len(voters) + 1})},'
    yield '"packets": ['
    yield ",\n".join(json.dumps(tick, separators=(",", ":")) for tick in _packets(netlist, events, x, y))
    yield "],"
    yield '"cores": ['
    aims = _aims(netlist, bus, voters, x, y)
    for core in range(netlist.n_cores):
        end = "," if core + 1 < netlist.n_cores else ""
        yield json.dumps(_core(netlist, core, int(x[core]), int(y[core]), aims), separators=(",", ":")) + end
    yield "]}"


def _packets(
    netlist: CrossbarNetlist, events: EventArray | None, x: IntArray, y: IntArray
) -> list[list[dict[str, object]]]:
    """Packets of each tick; an axon that is reached twice gets one."""
    if events is None:
        return [[]]
    ticks = netlist.ticks(events.shape[1])
    due: list[set[tuple[int, int]]] = [set() for _ in range(ticks)]
    feeds = (netlist.feed_channel, netlist.feed_core, netlist.feed_line, netlist.feed_tick)
    for channel, core, line, offset in zip(*(column.tolist() for column in feeds), strict=True):
        for step in np.flatnonzero(events[channel]).tolist():
            if step * netlist.bin_ticks + offset < ticks:
                due[step * netlist.bin_ticks + offset].add((core, line))
    clocks = (netlist.clock_core, netlist.clock_line, netlist.clock_period, netlist.clock_phase)
    for core, line, period, phase in zip(*(column.tolist() for column in clocks), strict=True):
        for tick in range(phase, ticks, period):
            due[tick].add((core, line))
    return [
        [
            {"destination_core": [int(x[core]), int(y[core])], "destination_axon": line, "destination_tick": 0}
            for core, line in sorted(axons)
        ]
        for axons in due
    ]


def _aims(
    netlist: CrossbarNetlist, bus: tuple[int, int], voters: IntArray, x: IntArray, y: IntArray
) -> list[tuple[int, int, int, int]]:
    """Offset, axon and destination tick of each neuron; the place of the `bus` and of cores are those in the file."""
    core = netlist.core_of_neuron()
    aim = np.stack([bus[0] - x[core], bus[1] - y[core], np.full(len(core), len(voters)), np.zeros(len(core))], axis=1)
    aim[voters, 2] = np.arange(len(voters))
    source = netlist.wire_neuron
    aim[source, 0] = netlist.wire_x - netlist.core_x[core[source]]
    aim[source, 1] = netlist.wire_y - netlist.core_y[core[source]]
    aim[source, 2], aim[source, 3] = netlist.wire_line, netlist.wire_delay - 1
    return [(dx, dy, axon, tick) for dx, dy, axon, tick in aim.astype(np.int64).tolist()]


def _core(
    netlist: CrossbarNetlist, core: int, x: int, y: int, aims: list[tuple[int, int, int, int]]
) -> dict[str, object]:
    first, last = netlist.core_neurons[core : core + 2].tolist()
    axons = slice(*netlist.core_axons[core : core + 2].tolist())
    lines = netlist.axon_line[axons]
    kinds = np.zeros(int(lines.max(initial=-1)) + 1, np.int64)
    kinds[lines] = netlist.axon_type[axons]
    points = np.zeros((last - first, len(kinds)), np.int64)
    for axon in range(axons.start, axons.stop):
        held = slice(*netlist.axon_synapses[axon : axon + 2].tolist())
        points[netlist.synapse_neuron[held], netlist.axon_line[axon]] = 1
    return {
        "axons": kinds.tolist(),
        "connections": points.tolist(),
        "coordinates": [x, y],
        "neurons": [
            {
                "weights": netlist.weight[n].tolist(),
                "leak": int(netlist.leak[n]),
                "positive_threshold": int(netlist.threshold[n]),
                "negative_threshold": -int(netlist.negative_threshold[n]),
                "reset_potential": int(netlist.reset[n]),
                "reset_mode": int(netlist.reset_mode[n]),
                "current_potential": int(netlist.initial[n]),
                "destination_core_offset": list(aims[n][:2]),
                "destination_axon": aims[n][2],
                "destination_tick": aims[n][3],
            }
            for n in range(first, last)
        ],
    }
