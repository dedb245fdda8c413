"""A network of crossbar cores, and a recording, for the simulator of RANC (github.com/UA-RCL/RANC, 08ae4bd).

The file serves as input and as configuration: ``ranc_sim NET.json OUT.txt NET.json TICKS``. Where RANC
differs:

- Its ``destination_tick`` is one less than ours: a packet of ``d`` is due ``d + 1`` ticks after it was sent. Packets
  listed for tick ``i`` with ``d = 0`` are those that we inject in tick ``i``.
- Row ``k`` of its output holds what the neurons on the output bus did in our tick ``k - 1``; row 0 is empty. So a
  recording takes one tick more. Voters go out on the bus in the order of their ids; neurons without a target
  share the output after the last, for RANC has no neuron without one.
- Its schema asks for ``destination_core_offset``; the examples in its repository are older and have another name.
- The negative threshold is compared by ``<`` only in reset type 0, and is written with its sign.
- Its membranes have no width, and below the negative threshold they are reset: to the negative of the reset value, or
  by the threshold. Other neurons are written in these terms, see :func:`expressed`.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_NONE, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import EventArray, IntArray

Place = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Terms:
    """A network as RANC has it: every spike is the same, and a membrane is ``scale`` times ours, plus ``shift``.

    scale, shift: (neurons,) int64. ticks: from the initial membranes on until which that is proven, as far
    as no register of ours saturates; None for
        ever.
    """

    netlist: CrossbarNetlist
    scale: IntArray
    shift: IntArray
    ticks: int | None


def expressed(netlist: CrossbarNetlist, ticks: int | None = None) -> Terms:
    """A network that breaks no rule of its chip in RANC's terms; ModelError if RANC has not what it uses.

    - A membrane that a spike sets to ``r`` and that is held at ``-f`` is, counted from ``(r - f) / 2`` on, one that is
      set to ``(r + f) / 2`` above and to the negative of that below, which is RANC's rule; all numbers of
      the neuron are doubled where ``r + f`` is odd.
    - A spike that leaves the membrane takes a threshold of zero from it, if the membrane is counted from the threshold.
    - Of these, and of those that a spike reduces by their threshold, none may reach a floor that holds them, for RANC
      has none: not within `ticks`, from the least that leak and weights above crossing points can come to in
      a tick.
    """
    reset_to = netlist.reset_mode == RESET_TO
    saturating = netlist.negative_saturates > 0
    if reversing := np.count_nonzero((netlist.leak_reversal > 0) & (netlist.leak != 0)):
        raise ModelError(f"RANC has no leak with reversal ({reversing} neurons); leave them out")

    centred = reset_to & saturating
    floor = netlist.negative_threshold
    span = netlist.reset + floor
    scale = np.where(centred & (span % 2 == 1), 2, 1)
    shift = np.where(centred, scale * (floor - netlist.reset) // 2, 0)
    shift[netlist.reset_mode == RESET_NONE] = -netlist.threshold[netlist.reset_mode == RESET_NONE]

    endless = (netlist.reset_mode == RESET_NONE) | ((netlist.reset_mode == RESET_LINEAR) & saturating)
    neuron = netlist.neuron_of_synapse()
    least = np.zeros(netlist.n_neurons, np.int64)
    np.add.at(
        least, neuron, np.minimum(netlist.weight[neuron, netlist.axon_type[netlist.axon_of_synapse()]], 0)
    )
    fall = np.minimum(least + netlist.leak, 0)
    room = floor + np.minimum(netlist.initial, 0)
    falling = endless & ((fall < 0) | (room < 0))
    longest = int((np.maximum(room, 0) // np.maximum(-fall, 1))[falling].min()) if falling.any() else None
    if longest is not None and (longest == 0 or (ticks or 0) > longest):
        count = np.count_nonzero(falling & (room + fall * (ticks or 1) < 0))
        raise ModelError(
            f"RANC has no negative threshold that holds a membrane which its spikes do not reset; {count} "
            f"neurons might reach theirs after {longest} ticks; give shorter recordings, or lower negative thresholds"
        )
    return Terms(
        netlist=replace(
            netlist,
            weight=netlist.weight * scale[:, None],
            leak=netlist.leak * scale,
            threshold=netlist.threshold * scale + shift,
            reset=np.where(centred, scale * span // 2, netlist.reset),
            reset_mode=np.where(reset_to, RESET_TO, RESET_LINEAR),
            negative_threshold=floor * scale - shift,
            negative_saturates=np.zeros_like(floor),
            initial=netlist.initial * scale + shift,
        ),
        scale=scale,
        shift=shift,
        ticks=longest,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """Where the cores and the output bus of a network are; x, y: (cores,) int64."""

    x: IntArray
    y: IntArray
    width: int
    height: int
    bus: Place


def mesh_of(netlist: CrossbarNetlist) -> Mesh:
    """The smallest rectangle of all cores; the bus is at the first place that is free, or in a row above."""
    x = netlist.core_x - netlist.core_x.min()
    y = netlist.core_y - netlist.core_y.min()
    width = int(x.max()) + 1
    taken = set((x + (int(x.max()) + 1) * y).tolist())
    row, column = divmod(next(place for place in range(len(taken) + 1) if place not in taken), width)
    return Mesh(x=x, y=y, width=width, height=max(int(y.max()), row) + 1, bus=(column, row))


def packets_of(netlist: CrossbarNetlist, events: EventArray, mesh: Mesh) -> list[list[tuple[int, int, int]]]:
    """Place and axon of the packets of each tick of a recording (n_inputs, T), clocks included; one for each axon."""
    ticks = netlist.ticks(events.shape[1])
    due: list[set[tuple[int, int, int]]] = [set() for _ in range(ticks)]
    x = mesh.x.tolist()
    y = mesh.y.tolist()
    feeds = (netlist.feed_channel, netlist.feed_core, netlist.feed_line, netlist.feed_tick)
    for channel, core, line, offset in zip(*(column.tolist() for column in feeds), strict=True):
        for step in np.flatnonzero(events[channel]).tolist():
            if step * netlist.bin_ticks + offset < ticks:
                due[step * netlist.bin_ticks + offset].add((x[core], y[core], line))
    clocks = (netlist.clock_core, netlist.clock_line, netlist.clock_period, netlist.clock_phase)
    for core, line, period, phase in zip(*(column.tolist() for column in clocks), strict=True):
        for tick in range(phase, ticks, period):
            due[tick].add((x[core], y[core], line))
    return [sorted(axons) for axons in due]


def aims_of(netlist: CrossbarNetlist, mesh: Mesh, outputs: IntArray) -> list[tuple[int, int, int, int]]:
    """Offset, axon and destination tick of each neuron; without a wire, it is their output (neurons,) of the bus."""
    core = netlist.core_of_neuron()
    aim = np.stack(
        [mesh.bus[0] - mesh.x[core], mesh.bus[1] - mesh.y[core], outputs, np.zeros(len(core))], axis=1
    )
    source = netlist.wire_neuron
    aim[source, 0] = netlist.wire_x - netlist.core_x[core[source]]
    aim[source, 1] = netlist.wire_y - netlist.core_y[core[source]]
    aim[source, 2], aim[source, 3] = netlist.wire_line, netlist.wire_delay - 1
    return [(dx, dy, axon, tick) for dx, dy, axon, tick in aim.astype(np.int64).tolist()]


def crossbar(netlist: CrossbarNetlist, core: int) -> tuple[IntArray, IntArray]:
    """Types of a core's lines up to the last that is used, (lines,), and crossing points, (neurons, lines) 0 and 1."""
    axons = slice(*netlist.core_axons[core : core + 2].tolist())
    lines = netlist.axon_line[axons]
    kinds = np.zeros(int(lines.max(initial=-1)) + 1, np.int64)
    kinds[lines] = netlist.axon_type[axons]
    points = np.zeros((int(np.diff(netlist.core_neurons)[core]), len(kinds)), np.int64)
    for axon in range(axons.start, axons.stop):
        synapses = slice(*netlist.axon_synapses[axon : axon + 2].tolist())
        points[netlist.synapse_neuron[synapses], netlist.axon_line[axon]] = 1
    return kinds, points


def export(given: CrossbarNetlist, events: EventArray | None = None) -> Iterator[str]:
    """Lines of the JSON file of a network that breaks no rule of its chip; ModelError if it uses what RANC has not.

    Events (n_inputs, T) of a recording become packets, with the clocks; without it there are none.
    ``exact_ticks`` is for how many ticks the spikes are proven to be ours, null for ever; RANC does not read
    it.
    """
    terms = expressed(given, None if events is None else given.ticks(events.shape[1]))
    netlist = terms.netlist
    mesh = mesh_of(given)
    chip = load_target(given.target)
    voters = netlist.voters
    config = {
        "exact_ticks": terms.ticks,
        "num_neurons": chip.limit("core.neurons"),
        "num_axons": chip.limit("core.axons"),
        "num_weights": chip.limit("core.axon_types"),
        "num_cores_x": mesh.width,
        "num_cores_y": mesh.height,
        "max_tick_offset": chip.limit("neuron.delay") + 1,
        "neuron_block_trace_verbosity": 0,
        "core_controller_trace_verbosity": 0,
        "scheduler_trace_verbosity": 0,
        "neuron_reset_type": 0,
    }
    yield "{"
    for name, value in config.items():
        yield f'"{name}": {json.dumps(value)},'
    yield f'"output_bus": {json.dumps({"coordinates": list(mesh.bus), "num_outputs": len(voters) + 1})},'
    yield '"packets": ['
    ticks = [[]] if events is None else packets_of(netlist, events, mesh)
    yield ",\n".join(
        json.dumps(
            [
                {"destination_core": [x, y], "destination_axon": line, "destination_tick": 0}
                for x, y, line in tick
            ],
            separators=(",", ":"),
        )
        for tick in ticks
    )
    yield "],"
    yield '"cores": ['
    outputs = np.full(netlist.n_neurons, len(voters))
    outputs[voters] = np.arange(len(voters))
    aims = aims_of(netlist, mesh, outputs)
    for core in range(netlist.n_cores):
        end = "," if core + 1 < netlist.n_cores else ""
        yield json.dumps(_core(netlist, core, mesh, aims), separators=(",", ":")) + end
    yield "]}"


def _core(
    netlist: CrossbarNetlist, core: int, mesh: Mesh, aims: list[tuple[int, int, int, int]]
) -> dict[str, object]:
    kinds, points = crossbar(netlist, core)
    return {
        "axons": kinds.tolist(),
        "connections": points.tolist(),
        "coordinates": [int(mesh.x[core]), int(mesh.y[core])],
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
            for n in range(*netlist.core_neurons[core : core + 2].tolist())
        ],
    }
