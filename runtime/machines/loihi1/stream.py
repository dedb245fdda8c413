"""Live use: one bin of events in, the spikes of one chip step and the votes so far out.

    stream = machine_for("net.loom").stream()
    for events in bins:                     # each (taxels, polarities), values 0 and 1
        step = stream.step(events)
        print(step.decision, step.margin)   # so far
    print(stream.decision)                  # ends the grasp: what `spikeloom run` decides
    stream.reset()                          # the next grasp

The bins are steps of the network: where these join several bins of the recordings, an event in any of them
counts.

*Lag.* A layer of depth ``d`` integrates data step ``t`` in chip step ``t + d``. So the votes after the bin ``t`` rest
on the bins up to ``t - d`` of the layer that is read out; :meth:`Stream.finish` runs the steps that are missing. Step
by step, all spikes and counts equal those of :func:`engine.simulate` on the whole recording, bit for bit.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import DataError, NumericRangeError
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.base import Step
from spikeloom.runtime.machines.loihi1.engine import NO_END, Engine, advance, start
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.report.console import tell


class Stream:
    """State of one grasp on one sensor, of an engine that was prepared `stepwise`.

    Streams of one engine share nothing that changes: several may take turns, or run in a thread each.
    """

    __slots__ = ("_bounds", "_column", "_ended", "_engine", "_last", "_place", "_state", "_told")

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        netlist = engine.netlist
        ends = np.cumsum([layer.neurons for layer in netlist.layers]).tolist()
        # a chip may hold fewer compartments than a layer has neurons
        self._place = np.array([0, *ends[:-1]])[netlist.layer] + netlist.neuron
        self._bounds = tuple(zip([0, *ends[:-1]], ends, strict=True))
        self._column = np.zeros((engine.netlist.n_inputs, 1), np.uint8)
        self._state = start(engine)
        self._ended = False
        self._last: Step | None = None
        self._told = False  # That events came after the end
        # loads or compiles the kernel now, not within the first bin
        advance(engine, self._state, self._column, length=NO_END, steps=0)

    @property
    def index(self) -> int:
        """Chip steps run so far in this grasp."""
        return int(self._state.counter[0])

    def step(self, events: npt.ArrayLike) -> Step:
        """Run the chip step of one bin.

        `events` (taxels, polarities), or flat with channel ``taxel * polarities + polarity``, are 1 where a
        taxel sent an event of that polarity within the bin, else 0, of any number type or bool; the
        network's clocks tick by themselves. Where a network says how long a recording is run, later events are
        not used, as in a run. Raises DataError for another shape or other values, or after the end,
        NumericRangeError if a register would overflow; that ends the stream.
        """
        if self._ended:
            raise DataError(
                "stream: a step after the end found, finish() or an overflow ends a stream; "
                "call reset() to begin the next grasp"
            )
        netlist = self._engine.netlist
        bin_ = _one_bin(netlist, events)
        if self.index == netlist.clocks.length and self._last is not None:
            if bin_.any() and not self._told:
                tell(f"warning: stream: events after the network's {self.index} steps: not used")
                self._told = True
            return self._last
        self._column[: len(bin_), 0] = bin_
        self._column[len(bin_) :] = netlist.clocks.events(1, first=self.index)
        return self._advance(NO_END)

    def finish(self) -> tuple[Step, ...]:
        """End the grasp: run the chip steps by which the slowest layer lags; the last one has the final counts.

        None for a network without lag, whose last step was final. Where a network says how long a recording
        is run, as counters do, the steps that are missing come first, in silence. Raises as :meth:`step`
        does.
        """
        if self._ended:
            raise DataError(
                "stream: a second end found, a grasp has one; call reset() to begin the next grasp"
            )
        netlist = self._engine.netlist
        silence = np.zeros((netlist.taxels, netlist.polarities), np.uint8)
        rest = [self.step(silence) for _ in range(self.index, netlist.clocks.length or 0)]
        self._ended = True
        self._column[:] = 0
        length = self.index
        steps = (*rest, *(self._advance(length) for _ in range(netlist.max_depth)))
        if self._last is not None:
            self._last = replace(self._last, final=True)
        return (*steps[:-1], self._last) if steps and self._last is not None else steps

    @property
    def decision(self) -> int:
        """Class of the grasp, which ends with this if it has not: what a run of the same bins decides."""
        if not self._ended and self.index:
            self.finish()
        if self._last is None:
            raise DataError("stream: no decision found, as no bin came or a register overflowed; give bins")
        return self._last.decision

    def reset(self) -> None:
        """Begin the next grasp, from rest; whatever was left of the last one is dropped."""
        self._state = start(self._engine)
        self._ended = False
        self._last = None

    def _advance(self, length: int) -> Step:
        """Run one chip step on the events in the column."""
        netlist = self._engine.netlist
        state = self._state
        index = self.index
        try:
            advance(self._engine, state, self._column, length=length)
        except NumericRangeError:
            self._ended = True
            self._last = None
            raise
        spikes = np.zeros(self._bounds[-1][1], np.bool_)
        spikes[self._place[state.fired[: state.counter[1]]]] = True
        counts = class_counts(netlist, state.spikes[None])[0]
        spikes.flags.writeable = counts.flags.writeable = False
        self._last = Step(
            index=index, spikes=tuple([spikes[begin:end] for begin, end in self._bounds]), counts=counts
        )
        return self._last


def _one_bin(netlist: Netlist, events: npt.ArrayLike) -> npt.NDArray[np.generic]:
    """Check the events of one bin; return them by channel."""
    try:
        array = np.asarray(events)
    except ValueError as error:
        raise DataError("stream: a bin with rows of unequal length found; give one row per taxel") from error
    sensor = netlist.taxels, netlist.polarities
    n_inputs = netlist.taxels * netlist.polarities  # the stream itself lets the clocks tick
    if array.shape not in ((n_inputs,), sensor):
        raise DataError(
            f"stream: a bin of shape {array.shape} found, allowed are {sensor} (taxels, polarities) and ({n_inputs},); "
            "give the events of one bin of this network's sensor"
        )
    if array.dtype.kind not in "biuf":
        raise DataError(
            f"stream: a bin of type {array.dtype} found, allowed are numbers and bool; give 0 and 1"
        )
    outside = (array != 0) & (array != 1)
    if outside.any():
        raise DataError(
            f"stream: a bin with the value {array[outside][0]} found, allowed are 0 and 1; "
            "give 1 for any number of events of a channel"
        )
    return array.reshape(-1)
