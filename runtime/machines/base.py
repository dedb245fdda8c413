"""A netlist on its chip: what those who run, price, show and stream netlists ask of every machine."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import Clocks, with_clocks
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.interpret import cut, vote
from spikeloom.compiler.targets.base import Target, load_target, with_tables
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.models.recordings.stored import Stored
from spikeloom.runtime.machines.changes import Changes, Effects, Groups, by_running
from spikeloom.runtime.machines.core_map import CoreMap
from spikeloom.runtime.machines.netlist_check import NetlistCheck
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import Block, Outcome, Section
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.main_job import ENGINES

Done = Callable[[int], object] | None
"""Called with the number of recordings done."""

T = TypeVar("T", bound=np.generic)

PART = 16
"""Recordings whose spikes are held at a time, at most."""

HELD = 1 << 25
"""Entries (recording, step, neuron) of these, unless one recording has more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counts:
    """What happened in a whole run, int64; a chip adds what else it counts. A batch has one more leading axis."""

    spikes: IntArray  # (…, neurons) int64; spikes of each neuron, in the order of the netlist
    votes: IntArray  # (…, neurons) int64; those of them that count where the neuron votes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """Result of a simulation; steps are the chip's own, and a batch has one more leading axis."""

    counts: Counts
    spikes: BoolArray | None  # (…, steps, neurons) bool; None unless wanted
    membranes: npt.NDArray[np.int32] | None  # (…, steps, neurons) int32; None unless wanted


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """Votes (samples, classes) int64 and, by layer, those spikes and membranes (samples, steps, neurons) that are kept.

    `counts` are spikes of each neuron that the chip holds, in the order of the netlist; (samples, neurons).
    `saturated` are membranes that left their register, (samples,), where that is against the chip's model.
    """

    votes: IntArray
    counts: IntArray
    spikes: Mapping[str, BoolArray]
    membranes: Mapping[str, npt.NDArray[np.int32]]
    saturated: IntArray | None = None

    @property
    def decisions(self) -> IntArray:
        """Class of each recording; ties go to the lowest."""
        return vote(self.votes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model:
    """The whole numbers that a network is lowered to, run without a chip.

    first: chip step in which each layer spikes for the first data step.
    spikes: of each layer, (samples, steps, neurons), for events (samples, taxels, polarities, steps).
    """

    first: Mapping[str, int]
    spikes: Callable[[EventArray], Mapping[str, BoolArray]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Price(Shown):
    """What recordings cost, in the terms that all chips share; arrays have an entry for each recording."""

    synaptic_operations: IntArray | FloatArray  # (samples,)
    energy_j: Mapping[str, FloatArray]  # By table, of each recording
    dynamic_j: Mapping[str, FloatArray]  # The same, but for power that flows whatever happens
    # empty where no table says so: seconds of each recording and of the longest data step, by table, and
    # the power that flows whatever happens, of all chips, by source
    time_s: Mapping[str, FloatArray] = field(default_factory=dict)
    step_s: Mapping[str, float] = field(default_factory=dict)
    static_w: Mapping[str, float] = field(default_factory=dict)
    outcome: Outcome  # All that the chip's own price model knows, with its layout

    @property
    def details(self) -> Any:
        """All that the chip's own price model knows: events, energies by part and layer, times."""
        return self.outcome.result

    def sections(self) -> Iterable[Section]:
        """What it says, laid out."""
        return self.outcome.sections(self.outcome.result)

    def to_json(self) -> str:
        """What ``estimate --json`` prints."""
        return json.dumps(encode(self.outcome.result))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """What one chip step brought."""

    index: int  # From 0; while events come in, also the index of the bin
    spikes: tuple[BoolArray, ...]  # Who spiked in it, by layer and neuron; read-only
    counts: IntArray  # (classes,) int64; votes since the grasp began; read-only
    final: bool = False  # Whether the grasp ended with it

    def __str__(self) -> str:
        """What it decides, and whether that may change."""
        so_far = "" if self.final else "; not final, as layers lag and bins may follow: see Stream.decision"
        return f"step {self.index}: class {self.decision}, {self.margin} votes ahead{so_far}"

    @property
    def decision(self) -> int:
        """Class with the most votes so far, the lowest on a tie; 0 before the first vote."""
        return int(vote(self.counts[None])[0])

    @property
    def margin(self) -> int:
        """Votes by which the decision is ahead of the next class; all its votes if there is no other class."""
        if len(self.counts) == 1:
            return int(self.counts[0])
        second, first = np.partition(self.counts, -2)[-2:]
        return int(first - second)


def parts_of(recordings: int, entries: int) -> Iterator[slice]:
    """Recordings of so many entries each, some at a time."""
    size = min(PART, max(1, HELD // entries))
    return (slice(first, min(first + size, recordings)) for first in range(0, recordings, size))


def one_by_one(
    events: EventArray | Stored, clocks: Clocks, lengths: IntArray | None
) -> Iterator[EventArray]:
    """Recordings in turn, (channels, steps), each as long as it is."""
    for index in range(len(events)):
        each = with_clocks(events[index : index + 1], clocks)[0]
        yield each if lengths is None else each[:, : lengths[index]]


def joined(parts: Sequence[Any]) -> Any:
    """One dataclass or mapping of arrays, (samples, …), from those of some recordings each."""
    first = parts[0]
    if first is None:
        return None
    if isinstance(first, Mapping):
        return {name: joined([part[name] for part in parts]) for name in first}
    if is_dataclass(first):
        names = (each.name for each in fields(first))
        return type(first)(**{name: joined([getattr(part, name) for part in parts]) for name in names})  # type: ignore[misc]
    return np.concatenate(parts)


def differences(slow: Any, fast: Any) -> int:
    """Entries of a trace and its counts that differ where `slow` has any; `fast` is a batch of the one recording."""
    count = 0
    for name, one in ((each.name, getattr(slow, each.name)) for each in fields(slow)):
        batch = getattr(fast, name)
        if is_dataclass(one):
            count += differences(one, batch)
        elif one is not None:
            count += int(np.count_nonzero(one != batch[0]))
    return count


def require_channels(netlist: Netlist, channels: int) -> None:
    """Raise DataError unless recordings of so many input channels, clocks among them, fit the network."""
    if channels != netlist.n_inputs:
        clocks = netlist.clocks.channels
        raise DataError(
            f"recordings: {channels - clocks} input channels found, the netlist has {netlist.n_inputs - clocks}; "
            "use recordings of the sensor that the network was compiled for"
        )


class Stream(Protocol):
    """State of one grasp on one sensor."""

    @property
    def index(self) -> int:
        """Chip steps run so far in this grasp."""

    def step(self, events: npt.ArrayLike) -> Step:
        """Run the chip step of one bin: events (taxels, polarities) or (taxels * polarities,), 0 and 1."""

    def finish(self) -> tuple[Step, ...]:
        """End the grasp: the steps by which the slowest layer lags behind the data."""

    @property
    def decision(self) -> int:
        """Class of the grasp, which ends with this."""

    def reset(self) -> None:
        """Begin the next grasp, from rest."""


class Pricing(Protocol):
    """A netlist and the tables of its chip, ready to price recordings, as many at a time as memory holds."""

    def batch(self, steps: int) -> int:
        """How many those are, of so many data steps."""

    def run(self, channels: EventArray, lengths: IntArray | None) -> tuple[Any, Any]:
        """Trace of some, (samples, channels, steps), and what is to be kept of them, which :func:`joined` joins."""

    def price(self, totals: Any, bin_s: float) -> Price:
        """The price of all, from what was kept; `bin_s` are seconds of a step at the pace of the sensor."""


@dataclass(frozen=True)
class Machine(ABC):
    """A netlist on its chip; made by :func:`backends.machine_of` or `machine_for`, prepared when it first runs."""

    netlist: Any
    """The placed network as the chip holds it, a :class:`Netlist`."""

    details: ClassVar[tuple[str, ...]]
    """How deep a price can go, the usual one first."""

    @classmethod
    def required(cls, machine: "Machine", path: str = "netlist", command: str = "this command") -> Self:
        """The same machine, if it offers what this class does; else an OptionError, which names file and command."""
        if not isinstance(machine, cls):
            title = machine.target.title
            raise OptionError(
                f"{path}: is for {title}, which {command} does not take; give one for another chip"
            )
        return machine

    @cached_property
    def target(self) -> Target:
        """The chip."""
        return load_target(self.netlist.target)

    @property
    def layers(self) -> tuple[str, ...]:
        """Their names; by default the netlist has nothing else of them."""
        return tuple(self.netlist.layers)

    @property
    @abstractmethod
    def weight_bits(self) -> int:
        """Bits of the widest weight that a synapse has, or an input of a crossbar on all its axons."""

    @abstractmethod
    def legal(self) -> None:
        """Hold the netlist against every limit of the chip; the SpikeloomError names each that it breaks."""

    @property
    def free_running(self) -> bool:
        """Whether nobody resets the chip: layers have no windows, and blank steps follow a recording."""
        return False

    def require_windows(self) -> None:
        """Refuse a free-running netlist: an OptionError."""
        if self.free_running:
            raise OptionError(
                "netlist: is free-running, which this cannot take; compile it without --free-running"
            )

    def in_a_row(self, events: EventArray | Stored, lengths: IntArray | None) -> IntArray | None:  # noqa: ARG002
        """Votes (samples, classes) of recordings that follow each other on a free-running chip; None on another."""
        return None

    def core_map(self, events: EventArray, lengths: IntArray, counts: IntArray) -> CoreMap | None:  # noqa: ARG002
        """Where the cores lie, and their traffic in recordings that gave these ``counts`` of a :class:`Run`."""
        return None

    def figures(self, price: Price) -> list[Block]:  # noqa: ARG002
        """What a price looks like, for the page of the netlist."""
        return []

    @abstractmethod
    def check_lowering(self, network: Any) -> NetlistCheck:
        """Level EN: hold the netlist against the network that it was lowered from, written out; simulates nothing."""

    def model(self, source: Any) -> Model | None:  # noqa: ARG002
        """Level E1: the whole numbers that a network brings, as `compile` was given it; None if it brings none."""
        return None

    def differing(self, run: Run, layer: str, expected: BoolArray, first: int, lengths: IntArray) -> int:  # noqa: ARG002
        """Spikes of a layer that are not as a model has them, (samples, steps, neurons), its first in step `first`."""
        return int(np.count_nonzero(run.spikes[layer] != cut(expected, lengths)))

    def of_layer(self, array: npt.NDArray[T], index: int) -> npt.NDArray[T]:
        """Cut one layer out of spikes or membranes of a trace, (samples, steps, neurons); by default step by step."""
        return np.asarray(array[:, :, self.netlist.layer == index])

    @abstractmethod
    def simulate(
        self, channels: EventArray, lengths: IntArray | None, *, spikes: bool, membranes: bool
    ) -> Trace:
        """Trace of recordings (samples, channels, steps), clocks among the channels; the rest is as for :meth:`run`."""

    @abstractmethod
    def spec_and_engine(self, channels: EventArray) -> tuple[Trace, Trace]:
        """All that the specification keeps of one recording (channels, steps), and a batch of it by the simulator."""

    @abstractmethod
    def pricing(self, chip: Target, detail: str) -> "Pricing":
        """What prices recordings by the tables of a chip; see :meth:`price`."""

    def _run(self, trace: Trace) -> Run:
        """What a trace comes to."""

        def by_layer(array: npt.NDArray[T] | None) -> dict[str, npt.NDArray[T]]:
            if array is None:
                return {}
            return {name: self.of_layer(array, index) for index, name in enumerate(self.layers)}

        return Run(
            votes=class_counts(self.netlist, trace.counts.votes),
            counts=trace.counts.spikes,
            spikes=by_layer(trace.spikes),
            membranes=by_layer(trace.membranes),
            saturated=self.saturated(trace),
        )

    def saturated(self, trace: Any) -> IntArray | None:  # noqa: ARG002
        """Membranes that left their register, (samples,), where the chip's model has none that do."""
        return None

    def run(
        self,
        events: EventArray,
        *,
        lengths: IntArray | None = None,
        spikes: bool = False,
        membranes: bool = False,
    ) -> Run:
        """Run recordings, each from rest.

        `events` are (samples, taxels, polarities, steps), any value but zero an event; the network's clocks
        tick by themselves. `lengths` (samples,) are the data steps of each; `spikes` and `membranes` say
        what to keep. Raises DataError for another sensor, NumericRangeError where a register overflows.
        """
        channels = with_clocks(events, self.netlist.clocks)
        return self._run(self.simulate(channels, lengths, spikes=spikes, membranes=membranes))

    def parts(self, recordings: int, steps: int) -> Iterator[slice]:
        """Recordings of so many data steps, some at a time: spikes that are held do not grow with their number."""
        return parts_of(recordings, steps * len(self.netlist.readout_class))

    def price(
        self,
        events: EventArray | Stored,
        *,
        bin_s: float,
        lengths: IntArray | None = None,
        detail: str = "counts",
        table: str | None = None,
        progress: Done = None,
        counts: bool = False,
    ) -> tuple[Run, Price]:
        """Run recordings as :meth:`run` does, some at a time, and price them; no spikes are kept.

        `bin_s` are the seconds of a bin at the pace of the sensor, `detail` is one of `details`, `table` the
        name of a table of prices or a TOML file with some; `progress` is called with the number of
        recordings done. The counts of the :class:`Run` are empty unless wanted. Raises OptionError if there
        is no such table or detail.
        """
        if detail not in self.details:
            allowed = ", ".join(self.details)
            raise OptionError(
                f"--detail {detail}: {self.netlist.target} has no such price model; allowed: {allowed}"
            )
        chip = self.target if table is None else with_tables(self.target, table)
        pricing = self.pricing(chip, detail)
        size = pricing.batch(events.shape[-1])
        runs, totals = [], []
        for first in range(0, max(1, len(events)), size):
            rows = slice(first, min(first + size, len(events)))
            channels = with_clocks(events[rows], self.netlist.clocks)
            trace, total = pricing.run(channels, None if lengths is None else lengths[rows])
            ran = self._run(trace)
            runs.append(ran if counts else replace(ran, counts=ran.counts[:0].copy()))
            totals.append(total)
            if progress is not None:
                progress(rows.stop)
        return joined(runs), pricing.price(joined(totals), bin_s * self.netlist.bins)

    def check(self, events: EventArray, *, lengths: IntArray | None = None) -> int:
        """Spikes, membranes and counts in which simulator and specification differ; events and lengths as for `run`."""
        each = one_by_one(events, self.netlist.clocks, lengths)
        return sum(differences(*self.spec_and_engine(channels)) for channels in each)

    def beside(self, engine: str) -> Callable[[EventArray, IntArray | None], int] | None:
        """Make one of ``ENGINES`` ready to run recordings of some lengths; None for our own.

        It gives the spikes and votes in which it and our simulator differ. OptionError or ModelError if
        there is none.
        """
        if engine != ENGINES[0]:
            raise OptionError(f"--engine {engine}: is not for {self.target.title}; omit it")
        return None

    def votes(self, channels: EventArray) -> IntArray:
        """Votes (samples, classes) of recordings (samples, channels, steps), clocks among the channels."""
        return class_counts(
            self.netlist, self.simulate(channels, None, spikes=False, membranes=False).counts.votes
        )

    def effects(self, channels: EventArray, changes: Changes) -> Effects:
        """What changes of a recording (channels, steps) bring about; runs each, unless the chip knows better."""
        return by_running(self.votes, channels, changes)

    def groups(
        self,
        channels: EventArray,  # noqa: ARG002
        steps: int,  # noqa: ARG002
        decision: int,  # noqa: ARG002
        reach: int,  # noqa: ARG002
    ) -> Groups | None:
        """Bounds of what changed events turn against the decision of a recording (channels, steps); None: not known.

        Events may change in the first `steps`. See :class:`Groups`.
        """
        return None

    def stream(self) -> Stream:
        """State of one grasp that runs bin after bin; OptionError if the simulator runs whole recordings only."""
        raise OptionError(
            f"{self.target.title}: runs whole recordings, not bin after bin; give one for another chip"
        )
