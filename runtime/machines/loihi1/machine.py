"""Loihi 1 as a :class:`machines.base.Machine`."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import FormatError, NumericRangeError
from spikeloom.compiler.files import reading
from spikeloom.compiler.interpret import cut
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.netlist import Netlist, read_netlist
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.models.recordings.evtouch import WHOLE
from spikeloom.models.recordings.stored import Stored
from spikeloom.runtime.machines.base import Model, Price, Run, T, differences, one_by_one
from spikeloom.runtime.machines.capabilities import Cumulative, Damageable, Explainable, Memory, Stoppable
from spikeloom.runtime.machines.changes import Changes, Effects, Groups
from spikeloom.runtime.machines.deviations import Deviations
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.stream import Stream
from spikeloom.runtime.machines.loihi1.trace import Trace, aligned, unpack
from spikeloom.runtime.machines.netlist_check import NetlistCheck
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.sections import Block

if TYPE_CHECKING:
    from spikeloom.runtime.machines.core_map import CoreMap
    from spikeloom.runtime.machines.loihi1.changes.chip import Chip
    from spikeloom.runtime.machines.loihi1.costs.pricing import LoihiPricing

# What only some commands need is imported where it is used: a tenth of a second that `run` need not wait.


@dataclass(frozen=True)
class Loihi(Damageable, Explainable, Stoppable):
    """A netlist and its simulator."""

    netlist: Netlist
    file: str = "netlist"  # What messages call it
    details = ("counts", "cycle")

    @cached_property
    def _engine(self) -> engine.Engine:
        return engine.prepare(self.netlist)

    @cached_property
    def _stepwise(self) -> engine.Engine:
        """Shared by all streams."""
        return engine.prepare(self.netlist, stepwise=True)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers."""
        return tuple(layer.name for layer in self.netlist.layers)

    def of_layer(self, array: npt.NDArray[T], index: int) -> npt.NDArray[T]:
        """As the float model counts time."""
        return aligned(self.netlist, array, index)

    @property
    def weight_bits(self) -> int:
        """As the layers store them."""
        return max(layer.weight_bits for layer in self.netlist.layers)

    def legal(self) -> None:
        """Refuse a netlist that uses too much of a limit."""
        require_legal(self.netlist, self.target)

    def check_lowering(self, network: Network) -> NetlistCheck:
        """Whether it is the network, rounded."""
        from spikeloom.runtime.machines.loihi1.rounding import check_rounding

        try:
            integer = self.integer
        except FormatError as error:
            return NetlistCheck(whole=(str(error),), simulates=False)
        return check_rounding(self.netlist, integer, self.target, network)

    def model(self, network: Network) -> Model | None:
        """The torch model that a network was fine-tuned with, on the chip's integers."""
        if network.forms is None:
            return None
        from spikeloom.models.networks.quantised import quantised_spikes  # torch, so only here

        first = {layer.name: layer.depth for layer in self.netlist.layers}
        return Model(first=first, spikes=lambda events: quantised_spikes(network, events))

    def differing(self, run: Run, layer: str, expected: BoolArray, first: int, lengths: IntArray) -> int:
        """Of neurons whose spikes reach a neuron; both count time as the float model does."""
        compared = self.compared()[self.layers.index(layer)]
        return int(
            np.count_nonzero(run.spikes[layer][..., compared] != cut(expected, lengths)[..., compared])
        )

    def simulate(
        self, channels: EventArray, lengths: IntArray | None, *, spikes: bool, membranes: bool
    ) -> Trace:
        """Spikes and membranes by chip step."""
        try:
            return engine.simulate(
                self._engine, channels, lengths=lengths, spikes=spikes, membranes=membranes
            )
        except NumericRangeError as error:
            error.args = (f"{self.file}: {error}",)
            raise

    def spec_and_engine(self, channels: EventArray) -> tuple[Trace, Trace]:
        """Every spike, membrane, update and count."""
        from spikeloom.runtime.machines.loihi1 import spec

        fast = engine.simulate(self._engine, channels[None], spikes=True, membranes=True, updated=True)
        return spec.simulate(self.netlist, channels), fast

    def check(self, events: EventArray, *, lengths: IntArray | None = None) -> int:
        """On a free-running chip also in a row."""
        different = super().check(events, lengths=lengths)
        if self.free_running:
            pause = np.zeros((self.netlist.n_inputs, self.netlist.blank), events.dtype)
            each = one_by_one(events, self.netlist.clocks, lengths)
            row = np.concatenate([part for channels in each for part in (channels, pause)], axis=1)
            different += differences(*self.spec_and_engine(row))
        return different

    @property
    def free_running(self) -> bool:
        """Whether blank steps follow a recording."""
        return bool(self.netlist.blank)

    @property
    def absent(self) -> tuple[BoolArray, ...]:
        """Neurons without a compartment."""
        return self.netlist.absent

    @property
    def unread(self) -> tuple[BoolArray, ...]:
        """As the compiler wrote them down."""
        return tuple(np.isin(np.arange(layer.neurons), layer.unread) for layer in self.netlist.layers)

    @property
    def read_out_lag(self) -> int:
        """The depth of the latest layer that votes, 0 where none does."""
        voting = np.unique(self.netlist.layer[self.netlist.voters])
        return max((int(self.netlist.layers[layer].depth) for layer in voting.tolist()), default=0)

    def in_a_row(self, events: EventArray | Stored, lengths: IntArray | None) -> IntArray | None:
        """Registers are carried over from one to the next."""
        if not self.free_running:
            return None
        state = engine.start(self._stepwise)
        lag = self.netlist.max_depth
        counts = []
        for channels in one_by_one(events, self.netlist.clocks, lengths):
            before = state.spikes.copy()
            steps = channels.shape[1]
            engine.advance(self._stepwise, state, channels, length=steps, steps=steps + lag)
            counts.append(state.spikes - before)
            engine.advance(
                self._stepwise, state, channels[:, :0], length=steps, steps=self.netlist.blank - lag
            )
        return class_counts(self.netlist, np.array(counts))

    def beside(self, engine: str) -> Callable[[EventArray, IntArray | None], int] | None:
        """The integer graph in onnxruntime."""
        if engine != "onnx":
            return super().beside(engine)
        from spikeloom.runtime.machines.loihi1 import onnx_engine

        prepared = onnx_engine.prepare(self.netlist)
        return lambda events, lengths: onnx_engine.differences(
            prepared, self._engine, with_clocks(events, self.netlist.clocks), lengths
        )

    @cached_property
    def integer(self) -> IntegerNetwork:
        """Compartments as populations, axons as projections."""
        from spikeloom.compiler.targets.loihi1.lift import lift

        with reading(self.file, FormatError, "compile it again"):
            return lift(self.netlist)

    def cumulative(self, events: EventArray, lengths: IntArray) -> Cumulative:
        """Sums that the engine adds up itself: no spike is kept."""
        from spikeloom.runtime.machines.loihi1.costs import cumulative

        self.require_windows()
        channels = with_clocks(events, self.netlist.clocks)
        return cumulative.run(self._engine, self.target, channels, lengths, lag=self.read_out_lag)

    @property
    def least_intervals(self) -> IntArray:
        """From the largest sums of each compartment that votes."""
        from spikeloom.runtime.machines.loihi1.costs import cumulative

        return cumulative.least_intervals(self.netlist)

    @property
    def steady(self) -> BoolArray:
        """From the synapse of each compartment that votes onto itself."""
        from spikeloom.runtime.machines.loihi1.costs import cumulative

        return cumulative.steady(self.netlist)

    def on_a_thread(
        self, channels: EventArray, lengths: IntArray, first: int
    ) -> tuple[Iterable[BoolArray], IntArray]:
        """Spikes by layer, as the float model counts time; at a bit each until they are looked at."""
        trace = engine.simulate(self._engine, channels, lengths=lengths, packed=True, threads=1)
        assert trace.packed is not None, "packed spikes were wanted"
        spikes = unpack(trace.packed[:, first:], self.netlist.n_compartments)
        layers = (aligned(self.netlist, spikes, layer) for layer in range(len(self.netlist.layers)))
        return layers, trace.counts.saturations.sum(axis=1)

    def memory(self, network: Network) -> Memory:
        """Registers of compartments, weights of synapses."""
        from spikeloom.runtime.machines.loihi1.changes.memory import LoihiMemory

        return LoihiMemory(netlist=self.netlist, network=network)

    def deviations(self, network: Network, compensated: Collection[str]) -> Deviations:
        """Roundings, and limits of registers."""
        from spikeloom.runtime.machines.loihi1.changes.deviations import LoihiDeviations

        return LoihiDeviations(network=network, integer=self.integer, compensated=compensated)

    @cached_property
    def _chip(self) -> Chip | None:
        """For changed runs; None where a register may overflow."""
        from spikeloom.runtime.machines.loihi1.changes import chip

        self.require_windows()
        return None if chip.overflows(self.netlist) else chip.chip_of(self.netlist)

    def effects(self, channels: EventArray, changes: Changes) -> Effects:
        """Only what a change reaches is simulated again."""
        if self._chip is None:
            return super().effects(channels, changes)
        from spikeloom.runtime.machines.loihi1.changes import kernel

        return kernel.effects(
            self._chip, kernel.known_run(self._chip, channels), self.netlist.classes, changes
        )

    def groups(self, channels: EventArray, steps: int, decision: int, reach: int) -> Groups | None:
        """By interval arithmetic on registers."""
        if self._chip is None:
            return None
        from spikeloom.compiler.layer_kernel import require_below
        from spikeloom.runtime.machines.loihi1.changes import groups, kernel

        require_below("steps", np.array([steps]), channels.shape[1] + 1)
        require_below("class", np.array([decision]), self.netlist.classes)
        shape = self.netlist.taxels * self.netlist.polarities, steps, self.netlist.classes
        known = kernel.known_run(self._chip, channels)
        return groups.groups(self._chip, known, shape, decision, reach)

    def core_map(self, events: EventArray, lengths: IntArray, counts: IntArray) -> CoreMap:
        """Cores on the mesh."""
        from spikeloom.runtime.machines.loihi1.costs import page

        within = np.arange(events.shape[-1]) < lengths[:, None, None]
        inputs = ((with_clocks(events, self.netlist.clocks) != 0) & within).sum(axis=2)
        return page.core_map(
            self.netlist, self.target, np.concatenate([inputs, counts], axis=1).mean(axis=0)
        )

    def figures(self, price: Price) -> list[Block]:
        """Energy by layer and part, time by core."""
        from spikeloom.runtime.machines.loihi1.costs import page

        return page.figures(price.outcome.result)

    def pricing(self, chip: Target, detail: str) -> LoihiPricing:
        """Costs, of the cores' tiles and times too."""
        from spikeloom.runtime.machines.loihi1.costs import estimate
        from spikeloom.runtime.machines.loihi1.costs.pricing import LoihiPricing

        return LoihiPricing(estimator=estimate.prepare(self._engine, chip, detail))

    def stream(self) -> Stream:
        """One grasp, bin after bin."""
        if (window := origin_of(self.netlist.provenance).get("window", WHOLE)) < WHOLE:
            tell(
                f"warning: {self.file}: was trained on the first {window} % of each recording; a stream does not know "
                "where these end, so end each grasp there"
            )
        return Stream(self._stepwise)


def load(path: str | os.PathLike[str]) -> Loihi:
    """Read a netlist file and hold it against every limit of its chip; FormatError or CapacityError."""
    machine = Loihi(read_netlist(path), Path(path).name)
    machine.legal()
    return machine
