"""Yardsticks of others, apart from the chip's own: NeuroBench's counts, and arithmetic energy after Horowitz.

Both are computed from spike trains on the network as :func:`expand.expand` writes it down, that is on
the *effective* matrix of the graph convolution. Counted on its factors (K + 1 small maps and K propagations a step)
the convolution of the float model is cheaper than dense; that is said apart, because a processor would use it.

Arithmetic energy is a lower bound for a processor: no memory, no instructions, no clock. It is no energy of the chip
and is not to be set against one table of the chip's events without saying so.

References
----------
.. [1] J. Yik et al., "The NeuroBench framework for benchmarking neuromorphic computing algorithms and systems",
   Nature Communications 16, 1545, 2025; definitions as in the package neurobench 2.3.0.
.. [2] M. Horowitz, "Computing's energy problem (and what we can do about it)", ISSCC 2014, figure 1.1.9 (45 nm, 0.9 V).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.systems import GCN, TACTILESGNET
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.runtime.report.encode import key
from spikeloom.runtime.report.numbers import si
from spikeloom.runtime.report.sections import Section, Table, Text

FLOAT_BYTES = 4
"""Bytes of a float32 parameter."""

ARITHMETIC = "Horowitz, ISSCC 2014, figure 1.1.9 (45 nm, 0.9 V)"
HOROWITZ = {"float32_add": 0.9, "float32_multiply": 3.7, "int8_multiply": 0.2, "int32_add": 0.1}
"""Energy of one operation, pJ."""

MULTIPLY_ACCUMULATE = {"float32": ("float32_multiply", "float32_add"), "int8": ("int8_multiply", "int32_add")}
"""Parts of a multiply-accumulate; products of 8-bit numbers are summed in 32 bits. The last one is the accumulation
alone, all that a spike needs."""

NOT_COUNTED = "memory, instructions, clock and leakage (arithmetic alone; a lower bound for any processor)"


@dataclass(frozen=True, slots=True, kw_only=True)
class SynapticOperations:
    """Non-zero weights that meet a non-zero input, per recording.

    Multiply-accumulates where a step's input is not in {-1, 0, 1}, else accumulations; and the same with all inputs and
    weights set to one.
    """

    effective_macs: float = field(metadata=key("Effective_MACs"))
    effective_acs: float = field(metadata=key("Effective_ACs"))
    dense: float = field(metadata=key("Dense"))


@dataclass(frozen=True, slots=True, kw_only=True)
class NeuroBench:
    """NeuroBench's metrics, means over recordings as its harness gives them for batches of one.

    The footprint is bytes of weights and biases in float32, the convolution's matrix and its zeros included; sparsities
    are shares of weights that are zero (to four digits, as the package does) and of neurons and steps without a spike.
    """

    footprint: int
    connection_sparsity: float
    activation_sparsity: float
    synaptic_operations: SynapticOperations


@dataclass(frozen=True, slots=True, kw_only=True)
class Arithmetic:
    """Operations per recording in one number format, ``float32`` or ``int8``; decays of membranes count as macs."""

    what: str
    numbers: str
    macs: float
    acs: float

    json_properties = ("energy_j",)

    @property
    def energy_j(self) -> float:
        """Energy per recording."""
        parts = [HOROWITZ[part] for part in MULTIPLY_ACCUMULATE[self.numbers]]
        return (self.macs * sum(parts) + self.acs * parts[-1]) * 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class Yardsticks:
    """Both yardsticks of a network on some recordings, and what the energies rest on."""

    samples: int
    neurobench: NeuroBench
    arithmetic: tuple[Arithmetic, ...]
    graph: str | None = None
    prices_pj: Mapping[str, float] = field(default_factory=HOROWITZ.copy)
    source: str = ARITHMETIC
    not_counted: str = NOT_COUNTED


def measure(
    checkpoint: Checkpoint,
    adjacency: FloatArray,
    events: EventArray,
    spikes: Mapping[str, BoolArray],
    *,
    lengths: IntArray | None = None,
) -> Yardsticks:
    """Count a checkpoint's operations on recordings (samples, taxels, channels, steps).

    `adjacency` (taxels, taxels) is the normalised propagation matrix of its graph; `spikes` are trains (samples, steps,
    neurons) of every layer in order, of the float model or of the chip (aligned with the data); what comes after the
    `lengths` (samples,) of the recordings is not counted.
    """
    network = expand(checkpoint, adjacency)
    samples, steps = len(events), events.shape[-1]
    last = np.full(samples, steps) if lengths is None else lengths
    counted = np.arange(steps) < last[:, None]
    trains = [train & counted[:, :, None] for train in spikes.values()]
    inputs = with_clocks(events, checkpoint.dynamics.clocks).transpose(0, 2, 1) * counted[:, :, None]

    bench = _neurobench(network, inputs, trains, last)
    operations = bench.synaptic_operations
    mean_steps = float(last.mean())
    decays = sum(train.shape[2] for train in trains) * mean_steps
    saved = network.populations[0].size * network.input.size - _factored(checkpoint, adjacency)
    forms = (
        ("dense", operations.dense + decays, 0.0),
        ("dense, convolution in factors", operations.dense + decays - saved * mean_steps, 0.0),
        ("effective", operations.effective_macs + decays, operations.effective_acs),
    )
    return Yardsticks(
        samples=samples,
        neurobench=bench,
        arithmetic=tuple(
            Arithmetic(what=what, numbers=numbers, macs=macs, acs=acs)
            for what, macs, acs in forms
            for numbers in MULTIPLY_ACCUMULATE
        ),
    )


def _neurobench(network: Network, inputs: EventArray, trains: Sequence[BoolArray], last: IntArray) -> NeuroBench:
    macs = acs = 0.0
    zeros = weights = parameters = 0
    for projection in network.projections:
        source = inputs if projection.pre == INPUT else trains[projection.pre]
        post, pre = projection.weight.shape
        # towers have no weights from one another; the convolution is its effective matrix, with its zeros
        held = post * pre if projection.pre == INPUT else projection.weight.nnz
        fan_out = np.count_nonzero(projection.weight.toarray(), axis=0)
        # one recording at a time: the product would make float64 of all spikes
        visited = np.stack([(recording != 0) @ fan_out.astype(np.float64) for recording in source])
        binary = np.all(source <= 1, axis=2)
        acs += float(visited[binary].sum())
        macs += float(visited[~binary].sum())
        zeros += held - int(fan_out.sum())
        weights += held
        parameters += held + post
    neurons = sum(train.shape[2] for train in trains)
    # a mean of the recordings' shares, not a share of all: they differ where lengths do
    fired = sum(train.sum(axis=(1, 2)) for train in trains)
    return NeuroBench(
        footprint=parameters * FLOAT_BYTES,
        connection_sparsity=round(float(np.float32(zeros) / np.float32(weights)), 4),
        activation_sparsity=float(np.mean(1 - fired / (neurons * last))),
        synaptic_operations=SynapticOperations(
            effective_macs=macs / len(inputs), effective_acs=acs / len(inputs), dense=weights * float(last.mean())
        ),
    )


def _factored(checkpoint: Checkpoint, adjacency: FloatArray) -> int:
    """Multiply-accumulates of the first layer in one step: its maps, of a graph its hops over the edges, its relays."""
    hops, _, channels = checkpoint.hops.shape
    maps = checkpoint.places * int(checkpoint.hops.size)
    times = {TACTILESGNET: int(hops) - 1, GCN: 1}.get(checkpoint.system, 0)
    return maps + times * int(np.count_nonzero(adjacency)) * int(channels) + checkpoint.dynamics.clocks.channels


def sections(found: Yardsticks) -> list[Section]:
    """Both yardsticks for people."""
    bench = found.neurobench
    operations = bench.synaptic_operations
    counts = [
        ["synaptic operations, dense", f"{operations.dense:,.0f}"],
        ["effective accumulations", f"{operations.effective_acs:,.0f}"],
        ["effective multiply-accumulates", f"{operations.effective_macs:,.0f}"],
        ["activation sparsity", f"{bench.activation_sparsity:.4f}"],
        ["connection sparsity", f"{bench.connection_sparsity:.4f}"],
        ["footprint in float32, bytes", f"{bench.footprint:,}"],
    ]
    energy = [
        [f"{row.what}, {row.numbers}", f"{row.macs:,.0f}", f"{row.acs:,.0f}", si(row.energy_j, "J")]
        for row in found.arithmetic
    ]
    what = f"NeuroBench's metrics per recording, over {found.samples}, on the convolution's effective matrix:"
    return [
        Section("NeuroBench", [Text(what), Table(["", "value"], counts)]),
        Section(
            "Arithmetic energy",
            [
                Text(f"arithmetic energy per recording, prices of {found.source}:"),
                Table(["", "multiply-accumulates", "accumulations", "energy"], energy),
                Text(f"not counted: {found.not_counted}"),
            ],
        ),
    ]
