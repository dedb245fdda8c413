"""Say in advance how long a step of a layout takes and what it costs, from spikes of the float model.

Nothing is changed. Time is that of the simple model: a step lasts as long as the core that takes longest to sweep its
neurons and send, or to receive, then the barrier (SANA-FE [1]_). Here every compartment is taken to have work in every
step, as those with a bias have; neurons fire as the float model's do on calibration recordings, step by step, since
the longest of several fluctuating times is longer than the longest of their means.

References
----------
.. [1] J. Boyle et al., "SANA-FE", IEEE TCAD 44(8), 3165-3178, 2025.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from spikeloom.compiler.ir import INPUT, IntegerNetwork, depths
from spikeloom.compiler.passes.calibrate import Calibration, fewer
from spikeloom.compiler.targets.base import PICOSECONDS, EnergyTable, Target, TimeTable
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, Needs, choose_dense
from spikeloom.compiler.targets.loihi1.layout.partition import Partition
from spikeloom.compiler.targets.loihi1.layout.place import hops
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

SAMPLES = 1000
"""Chip steps that are looked at, evenly spaced over the calibration recordings."""

Core = tuple[Chunk, ...]

Activity = tuple[sparse.csc_array, ...]
"""Spikes of each population in some chip steps, (steps, neurons) of 0 and 1; last, at ``INPUT``, the input events."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What a layout is expected to take on the calibration recordings, on average over their chip steps."""

    step_ns: float  # Length of a step, barrier included
    critical_core: int  # Core that takes longest in most steps
    critical_share: float  # In what share of them
    receiving: bool  # Whether receiving takes it longer than sweeping and sending, on average
    # packets, hops: Packets of a step, and the links between tiles that they cross
    packets: float
    hops: float
    step_j: float  # Energy of a step in joules: neurons, synapses, packets and hops
    route_j: float  # Of this, packets and hops
    # time_table, energy_table: Names of the tables
    time_table: str
    energy_table: str


def sample(network: IntegerNetwork, calibration: Calibration, identity: tuple[IntArray, ...]) -> Activity:
    """Spikes of the chip steps that calibration recordings take, each layer as late as it is on the chip.

    `identity` says for each population which of the calibration's neurons the `network` holds.
    """
    calibration = fewer(calibration)
    late = depths(network)
    samples, length = calibration.events.shape[:2]
    every = samples * (length + max(late))
    chosen = np.linspace(0, every - 1, min(every, SAMPLES)).round().astype(np.int64)
    recording, step = np.divmod(chosen, length + max(late))

    def seen(values: BoolArray, depth: int) -> sparse.csc_array:
        at = step - depth
        runs = (0 <= at) & (at < length)
        return sparse.csc_array((values[recording, np.where(runs, at, 0)] & runs[:, None]).astype(np.float64))

    layers = zip(calibration.spikes, identity, late, strict=True)
    return (*(seen(spikes[:, :, ids], depth) for spikes, ids, depth in layers), seen(calibration.events, 0))


def tables(target: Target) -> tuple[TimeTable, EnergyTable] | None:
    """First time table of a chip, and the energy table of the same source, else the first that prices every event."""
    wanted = {"neuron_active", "packet", "hop_east_west", "hop_north_south"}
    either = ({"synaptic_operation"}, {"synaptic_operation_dense", "synaptic_operation_sparse"})
    for time in target.time:
        whole = [
            e for e in target.energy if wanted <= e.prices.keys() and any(ops <= e.prices.keys() for ops in either)
        ]
        for energy in sorted(whole, key=lambda table: table.name != time.name):
            return time, energy
    return None


class Forecast:
    """Times and energies of cores that hold given chunks; what was found for one is kept for others that hold it."""

    def __init__(self, needs: Needs, activity: Activity, time: TimeTable, energy: EnergyTable) -> None:
        self.needs = needs
        self.activity = activity
        self.time = time
        self.energy = energy
        self.steps = int(activity[INPUT].shape[0])
        # spikes a step of each population; last, at INPUT, events a step
        self.rates = tuple(np.asarray(spikes.sum(axis=0)).reshape(-1) / self.steps for spikes in activity)
        self._receiving: dict[tuple[Chunk, int, bool], tuple[FloatArray, float]] = {}

    def joule(self, event: str) -> float:
        """Price of an event; 0 if the table has it in another (Davies: the spike is in the active neuron's)."""
        if event not in self.energy.prices and event.startswith("synaptic_operation"):
            event = "synaptic_operation"
        return self.energy.joule(event) if event in self.energy.prices else 0.0

    def listening(self, chunk: Chunk, base: int, *, lean: bool) -> tuple[FloatArray, float]:
        """Picoseconds in which a chunk at `base` receives, shape (steps,); mean joules of its synapses a step."""
        key = (chunk, base, lean)
        if key not in self._receiving:
            taken, spent = np.zeros(self.steps), 0.0
            ps = np.array([self.time.picoseconds(f"synaptic_operation_{form}") for form in ("sparse", "dense")])
            joule = np.array([self.joule(f"synaptic_operation_{form}") for form in ("sparse", "dense")])
            for lists in self.needs.lists(chunk):
                projection = self.needs.network.projections[lists.projection]
                dense, _ = choose_dense(lists, projection, base, chunk.size, lean=lean, target=self.needs.target)
                entries = np.where(dense, lists.last - lists.first + 1, lists.nonzero)
                source = self.activity[projection.pre]
                if len(lists.source) < source.shape[1]:
                    source = source[:, lists.source]
                taken += source @ (self.time.picoseconds("axon_in") + entries * ps[dense]).astype(np.float64)
                spent += float(self.rates[projection.pre][lists.source] @ (entries * joule[dense]))
            self._receiving[key] = taken, spent
        return self._receiving[key]

    def sweeping(self, chunk: Chunk) -> FloatArray:
        """Picoseconds in which a chunk is swept and sends, shape (steps,); the output axons are those charged."""
        axons = self.needs.out_axons[chunk.population][chunk.first : chunk.last]
        neuron = self.time.picoseconds("neuron_access") + self.time.picoseconds("neuron_update")
        fires = (self.time.picoseconds("spike") + axons * self.time.picoseconds("axon_out")).astype(np.float64)
        spikes = self.activity[chunk.population]
        bounds = spikes.indptr[chunk.first : chunk.last + 1]
        step = spikes.indices[bounds[0] : bounds[-1]]
        sent = np.bincount(step, np.repeat(fires, np.diff(bounds)), self.steps)
        return np.asarray(sent, np.float64) + chunk.size * neuron

    def core(self, chunks: Core) -> tuple[FloatArray, FloatArray, float]:
        """Sweeping and receiving of a core, each (steps,) picoseconds, and its synapses' joules a step."""
        lean = self.needs.lean(chunks)
        sweeps, receives = np.zeros((2, self.steps))
        spent, base = 0.0, 0
        for chunk in chunks:
            sweeps += self.sweeping(chunk)
            taken, joule = self.listening(chunk, base, lean=lean)
            receives += taken
            spent += joule
            base += chunk.size
        return sweeps, receives, spent

    def charge(self, cores: tuple[Core, ...]) -> None:
        """Charge the sources of a layout with their output axons, as the other methods take them to be."""
        self.needs.forget()
        self.needs.charge(self.needs.source_axons(chunk for core in cores for chunk in core))

    def expect(self, parts: Partition, tiles: tuple[int, ...], traffic: FloatArray) -> Expectation:
        """Time and energy of a placed layout; `traffic` is packets per step, (cores, cores), at ``self.rates``."""
        self.charge(parts.cores)
        loads = [self.core(core) for core in parts.cores]
        sweeps, receives = (np.array([load[i] for load in loads]) for i in (0, 1))
        longest = np.argmax(np.maximum(sweeps, receives), axis=0)
        often = np.bincount(longest, minlength=len(loads))
        critical = int(np.argmax(often))
        width = self.needs.target.limit("mesh.width")
        at = np.array(tiles)
        crossed = np.einsum("ab,abk->k", traffic, np.stack(hops(at[:, None], at, width), axis=-1))
        packets = float(traffic.sum())
        route = (
            packets * self.joule("packet")
            + crossed[0] * self.joule("hop_east_west")
            + crossed[1] * self.joule("hop_north_south")
        )
        neurons = sum(chunk.size for core in parts.cores for chunk in core)
        fired = sum(float(rates.sum()) for rates in self.rates[:INPUT])
        spent = neurons * self.joule("neuron_active") + fired * self.joule("spike") + sum(load[2] for load in loads)
        duration = np.maximum(sweeps, receives).max(axis=0).mean() + self.time.barrier(len(set(tiles)))
        return Expectation(
            step_ns=float(duration) / PICOSECONDS,
            critical_core=critical,
            critical_share=float(often[critical] / self.steps),
            receiving=bool(receives[critical].mean() > sweeps[critical].mean()),
            packets=packets,
            hops=float(crossed.sum()),
            step_j=float(spent + route),
            route_j=float(route),
            time_table=self.time.name,
            energy_table=self.energy.name,
        )
