"""NeuroBench's metrics of a network as the chip holds it, and as it runs recordings.

References
----------
.. [1] J. Yik et al., "The NeuroBench framework for benchmarking neuromorphic computing algorithms and systems",
   Nature Communications 16, 1545, 2025; definitions as in the package neurobench 2.3.0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from spikeloom.compiler.interpret import channels_last, cut
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.report.encode import key
from spikeloom.runtime.report.sections import Section, Table, Text

if TYPE_CHECKING:
    from spikeloom.compiler.targets.compartments import IntegerNetwork

BIAS_BITS = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class SynapticOperations:
    """Non-zero weights that meet a spike, per recording, and the same if all neurons spiked and no weight were zero.

    Spikes are ones, so that no operation multiplies.
    """

    effective_macs: float = field(metadata=key("Effective_MACs"))
    effective_acs: float = field(metadata=key("Effective_ACs"))
    dense: float = field(metadata=key("Dense"))


@dataclass(frozen=True, slots=True, kw_only=True)
class NeuroBench:
    """Metrics of the neurons that the chip holds, means over recordings as the harness gives them for batches of one.

    The footprint is bytes of weights and biases as stored; sparsities are shares of weights that are zero
    between connected layers (to four digits, as the package does), and of neurons and steps without a
    spike.
    """

    footprint: int
    connection_sparsity: float
    activation_sparsity: float
    synaptic_operations: SynapticOperations


def measure(machine: Comparable, data: Recordings) -> NeuroBench:
    """Count weights of a netlist, and what they do on recordings in its steps."""
    network = machine.integer
    counts = _spike_counts(machine, data)
    sources = {pre: spikes.shape[1] for pre, spikes in counts.items()}
    neurons = [int(np.count_nonzero(~absent)) for absent in machine.absent]
    fan_outs = _fan_outs(network)
    weights = sum(neurons[post] * (sources[pre] if pre == INPUT else neurons[pre]) for pre, post in fan_outs)
    operations = sum(counts[pre] @ fan_out for (pre, _), fan_out in fan_outs.items())
    nonzero = sum(int(fan_out.sum()) for fan_out in fan_outs.values())
    # a mean of the recordings' shares, not a share of all: they differ where lengths do
    fired = sum(spikes.sum(axis=1) for pre, spikes in counts.items() if pre != INPUT)
    bits = sum(projection.weight.nnz * projection.bits for projection in network.projections)
    return NeuroBench(
        footprint=-(-(bits + BIAS_BITS * sum(neurons)) // 8),
        connection_sparsity=round(1 - nonzero / weights, 4),
        activation_sparsity=float(np.mean(1 - fired / (sum(neurons) * data.step_counts))),
        synaptic_operations=SynapticOperations(
            effective_macs=0.0,
            effective_acs=float(np.mean(operations)),
            dense=weights * float(data.step_counts.mean()),
        ),
    )


def _spike_counts(machine: Comparable, data: Recordings) -> dict[int, IntArray]:
    """Spikes of each source, (recordings, sources), by population, and of the input channels."""
    counts: dict[int, list[IntArray]] = {}
    for part in machine.parts(len(data), data.steps):
        some = data.part(part)
        lengths = some.step_counts
        ran = machine.run(some.events, lengths=lengths, spikes=True)
        trains: list[BoolArray] = [
            channels_last(some.events, machine.netlist.clocks),
            *ran.spikes.values(),
        ]
        for population, spikes in enumerate(trains, INPUT):
            counts.setdefault(population, []).append(cut(spikes, lengths).sum(axis=1))
    return {population: np.concatenate(parts) for population, parts in counts.items()}


def _fan_outs(network: IntegerNetwork) -> dict[tuple[int, int], IntArray]:
    """Non-zero weights of each source, (sources,), by its population and the one that it reaches."""
    connected: dict[tuple[int, int], BoolArray] = {}
    for projection in network.projections:
        ends = projection.pre, projection.post
        present = (projection.weight != 0).toarray()
        connected[ends] = connected[ends] | present if ends in connected else present
    return {ends: present.sum(axis=0) for ends, present in connected.items()}


def sections(metrics: NeuroBench) -> list[Section]:
    """The metrics for people."""
    operations = metrics.synaptic_operations
    rows = [
        ["synaptic operations, dense", f"{operations.dense:,.0f}"],
        ["effective accumulations", f"{operations.effective_acs:,.0f}"],
        ["activation sparsity", f"{metrics.activation_sparsity:.4f}"],
        ["connection sparsity", f"{metrics.connection_sparsity:.4f}"],
        ["footprint, bytes", f"{metrics.footprint:,}"],
    ]
    what = "NeuroBench's metrics per recording, of the network as the chip holds it:"
    return [Section("NeuroBench", [Text(what), Table(["", "value"], rows)])]
