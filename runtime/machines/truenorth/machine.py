"""TrueNorth as a :class:`machines.base.Machine`."""

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, read_crossbars, unlike
from spikeloom.compiler.targets.truenorth.passes import Source, compile_crossbars
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.runtime.machines.base import Model, Run
from spikeloom.runtime.machines.counting import Counting
from spikeloom.runtime.machines.netlist_check import NetlistCheck
from spikeloom.runtime.machines.truenorth import cost, engine, spec
from spikeloom.runtime.machines.truenorth.counters import counters_in
from spikeloom.runtime.machines.truenorth.model import model_of
from spikeloom.runtime.machines.truenorth.spec import Trace


@dataclass(frozen=True)
class TrueNorth(Counting):
    """A netlist that breaks no rule of its chip, and its simulator."""

    netlist: CrossbarNetlist
    details = ("counts",)

    @cached_property
    def _engine(self) -> engine.Engine:
        return engine.prepare(self.netlist)

    @cached_property
    def counters(self) -> Counters | None:
        """Read back from the cores and lowered again."""
        return counters_in(self.netlist, self.target)

    @property
    def weight_bits(self) -> int:
        """Axons of all types add up."""
        return 1 + int(np.abs(self.netlist.weight).sum(axis=1).max()).bit_length()

    def legal(self) -> None:
        """Refuse a netlist that breaks a rule."""
        require_legal(self.netlist, self.target)

    def check_lowering(self, network: Source) -> NetlistCheck:
        """Lowered again, it is the same."""
        again = compile_crossbars(network, target=self.target).netlist
        what = "every neuron, axon, crossing point, wire and register"
        return NetlistCheck(
            whole=tuple(unlike(self.netlist, again)),
            claim=f"{what} is what the network of the file is lowered to",
        )

    def model(self, source: Source) -> Model:
        """The network itself."""
        return model_of(source, self.target)

    def differing(self, run: Run, layer: str, expected: BoolArray, first: int, lengths: IntArray) -> int:
        """Of every copy of every neuron, in every tick from the layer's first on."""
        copies = self.netlist.neuron[self.netlist.layer == self.layers.index(layer)]
        ticks = self.netlist.bin_ticks
        different = 0
        for on_chip, model, steps in zip(run.spikes[layer], expected, lengths.tolist(), strict=True):
            window = on_chip[first : first + steps * ticks]
            due = np.zeros_like(window)
            due[::ticks] = model[:steps, copies]
            different += int(np.count_nonzero(window != due))
        return different

    def saturated(self, trace: Trace) -> IntArray:
        """The model's never do."""
        return np.asarray(trace.counts.overflows.sum(axis=1))

    def simulate(
        self, channels: EventArray, lengths: IntArray | None = None, *, spikes: bool, membranes: bool = False
    ) -> Trace:
        """Spikes and membranes by tick."""
        return engine.simulate(self._engine, channels, lengths=lengths, spikes=spikes, membranes=membranes)

    def spec_and_engine(self, channels: EventArray) -> tuple[Trace, Trace]:
        """Every spike, membrane, vote and spike on an axon."""
        fast = engine.simulate(self._engine, channels[None], spikes=True, membranes=True)
        return spec.simulate(self.netlist, channels), fast

    def pricing(self, chip: Target, detail: str) -> cost.Pricing:
        """By synaptic events and ticks."""
        return cost.Pricing(self._engine, chip)


def load(path: str | os.PathLike[str]) -> TrueNorth:
    """Read a netlist file and hold it against every rule of its chip; FormatError or CapacityError."""
    machine = TrueNorth(read_crossbars(path))
    machine.legal()
    return machine
