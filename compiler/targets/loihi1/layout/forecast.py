"""Say in advance how long a step of a layout takes, from spikes of the float model.

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
from spikeloom.compiler.targets.base import PICOSECONDS, TimeTable
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, Needs, choose_dense
from spikeloom.compiler.targets.loihi1.layout.partition import Partition
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
    time_table: str  # Name of the table


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


class Forecast:
    """Times of cores that hold given chunks; what was found for one is kept for others that hold it."""

    def __init__(self, needs: Needs, activity: Activity, time: TimeTable) -> None:
        self.needs = needs
        self.activity = activity
        self.time = time
        self.steps = int(activity[INPUT].shape[0])
        self._receiving: dict[tuple[Chunk, int, bool], FloatArray] = {}

    def receiving(self, chunk: Chunk, base: int, *, lean: bool) -> FloatArray:
        """Picoseconds in which a chunk at `base` receives, shape (steps,)."""
        key = (chunk, base, lean)
        if key not in self._receiving:
            taken = np.zeros(self.steps)
            ps = np.array([self.time.picoseconds(f"synaptic_operation_{form}") for form in ("sparse", "dense")])
            for lists in self.needs.lists(chunk):
                projection = self.needs.network.projections[lists.projection]
                dense, _ = choose_dense(lists, projection, base, chunk.size, lean=lean, target=self.needs.target)
                entries = np.where(dense, lists.last - lists.first + 1, lists.nonzero)
                source = self.activity[projection.pre]
                if len(lists.source) < source.shape[1]:
                    source = source[:, lists.source]
                taken += source @ (self.time.picoseconds("axon_in") + entries * ps[dense]).astype(np.float64)
            self._receiving[key] = taken
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

    def core(self, chunks: Core) -> tuple[FloatArray, FloatArray]:
        """Sweeping and receiving of a core, each (steps,) picoseconds."""
        lean = self.needs.lean(chunks)
        sweeps, receives = np.zeros((2, self.steps))
        base = 0
        for chunk in chunks:
            sweeps += self.sweeping(chunk)
            receives += self.receiving(chunk, base, lean=lean)
            base += chunk.size
        return sweeps, receives

    def charge(self, cores: tuple[Core, ...]) -> None:
        """Charge the sources of a layout with their output axons, as the other methods take them to be."""
        self.needs.forget()
        self.needs.charge(self.needs.source_axons(chunk for core in cores for chunk in core))

    def expect(self, parts: Partition, tiles: int) -> Expectation:
        """Time of a step of a layout on so many tiles."""
        self.charge(parts.cores)
        sweeps, receives = map(np.array, zip(*(self.core(core) for core in parts.cores), strict=True))
        busy = np.maximum(sweeps, receives)
        often = np.bincount(np.argmax(busy, axis=0))
        critical = int(np.argmax(often))
        return Expectation(
            step_ns=float(busy.max(axis=0).mean() + self.time.barrier(tiles)) / PICOSECONDS,
            critical_core=critical,
            critical_share=float(often[critical] / self.steps),
            receiving=bool(receives[critical].mean() > sweeps[critical].mean()),
            time_table=self.time.name,
        )
