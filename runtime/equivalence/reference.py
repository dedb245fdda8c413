"""The float side of a comparison: the reference, and networks on the way to the chip, a deviation more on each rung.

=================  ===================================================================
``float64``        sums in float64 instead of float32
``beta``           the decays that the registers realise
``weights``        rounded weights
``bias_threshold`` rounded biases and thresholds
``rounding``       integer registers, whose decay drops fractions, but without limits
``saturation``     the limits of the registers: the chip; ``free_running`` where its layers have no windows
=================  ===================================================================
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.interpret import Simulation, channels_last, cut, float_simulation, run_float
from spikeloom.compiler.ir import Network, Projection, Sparse
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.compartments import (
    MEMBRANE_SHIFT,
    IntegerNetwork,
    Netlist,
    integer_simulation,
    prove_ranges,
)
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.base import parts_of
from spikeloom.runtime.machines.votes import votes_by_step
from spikeloom.runtime.report.console import Progress


def require_match(netlist: Netlist, network: Network) -> None:
    """Refuse a netlist and a float network whose taxels, channels, timing or layers differ."""
    ours = {"taxels": netlist.taxels, "channels": netlist.polarities}
    ours |= _timing(netlist.clocks, netlist.bins) | {layer.name: layer.neurons for layer in netlist.layers}
    theirs = {"taxels": network.input.taxels, "channels": network.input.polarities}
    theirs |= _timing(network.input.clocks, network.input.bins) | {
        p.name: p.size for p in network.populations
    }
    if list(ours.items()) != list(theirs.items()):  # layers are compared by number
        what = "network" if network.convolution is None else "checkpoint"
        sizes = [", ".join(f"{name} {neurons}" for name, neurons in side.items()) for side in (ours, theirs)]
        raise ModelError(
            f"netlist and {what} disagree: the netlist has {sizes[0]}, the {what} {sizes[1]}; "
            f"give the {what} that the netlist was compiled from"
        )


def _timing(clocks: Clocks, bins: int) -> dict[str, int]:
    clocked = {"clocks": clocks.channels, "steps of a clock": clocks.steps} if clocks.channels else {}
    return clocked | ({"bins of a step": bins} if bins > 1 else {})


def reference_of(network: Network) -> Callable[[EventArray], list[BoolArray]]:
    """What gives the spikes of each layer in float32, in the order of sums of training where that is known."""
    if network.convolution is None:
        clocks = network.input.clocks
        ready = float_simulation(network, np.float32)
        return lambda events: list(ready.run(channels_last(events, clocks)).spikes)
    from spikeloom.models.networks.reference import float_spikes

    return lambda events: list(float_spikes(network, events).values())


def votes_so_far(network: Network, data: Recordings) -> IntArray:
    """Votes of the float32 model after each step, (samples, steps, classes); a recording's stay from its end on."""
    lengths = data.step_counts
    votes = []
    reference = reference_of(network)
    progress = Progress(len(data))
    readout = network.readout
    neurons = sum(population.size for population in network.populations)
    for part in parts_of(len(data), data.steps * neurons):
        progress(part.start, "float model")
        spikes = reference(data.part(part).events)[readout.population]
        votes.append(votes_by_step(readout, network.classes, cut(spikes, lengths[part])))
    return np.concatenate(votes)


def membranes_of(network: Network, events: EventArray) -> list[npt.NDArray[np.floating]]:
    """Membranes of each layer in float32, likewise."""
    if network.convolution is None:
        inputs = channels_last(events, network.input.clocks)
        return list(run_float(network, inputs, dtype=np.float32, membranes=True).membranes)
    from spikeloom.models.networks.reference import float_membranes

    return list(float_membranes(network, events).values())


def taxel_and_feature(network: Network, layer: int, neuron: int) -> tuple[int, int] | tuple[None, None]:
    """Where a neuron of a graph convolution lies; others, and relays of clocks, lie nowhere."""
    convolution = network.convolution
    if layer or convolution is None or convolution.system not in GRAPH_SYSTEMS:
        return None, None
    taxel, feature = divmod(neuron, convolution.filters.shape[1])
    return (taxel, feature) if taxel < network.input.taxels else (None, None)


LADDER = ("float64", "beta", "weights", "bias_threshold", "rounding", "saturation")
"""Deviations in the order in which they are added; the last one is the chip."""


def realised(network: Network, integer: IntegerNetwork) -> tuple[Network, Network, Network]:
    """Float networks that carry the chip's decays; these and its weights; all of these, its biases and thresholds.

    They are in the float model's units, to be run in float64.
    """
    beta = replace(
        network,
        populations=tuple(
            replace(population, beta=chip.realised_beta, alpha=chip.realised_alpha)
            for population, chip in zip(network.populations, integer.populations, strict=True)
        ),
    )
    weights = replace(
        beta,
        projections=tuple(
            Projection(
                pre=projection.pre,
                post=projection.post,
                weight=_rows_scaled(projection.effective(), 1 / integer.populations[projection.post].scale),
            )
            for projection in integer.projections
        ),
        convolution=None,
    )
    # A neuron with another threshold fires as one with the model's threshold whose weights and bias are
    # scaled to it.
    stretch = [
        population.theta / np.maximum(population.realised_theta, 1e-300)
        for population in integer.populations
    ]
    bias_threshold = replace(
        weights,
        populations=tuple(
            replace(population, bias=chip.bias / (chip.scale * (1 << MEMBRANE_SHIFT)) * factor)
            for population, chip, factor in zip(beta.populations, integer.populations, stretch, strict=True)
        ),
        projections=tuple(
            replace(projection, weight=_rows_scaled(projection.weight, stretch[projection.post]))
            for projection in weights.projections
        ),
    )
    return beta, weights, bias_threshold


def _rows_scaled(weight: Sparse, factor: FloatArray) -> Sparse:
    """Multiply each row of a csr_array by a factor of its own; float64."""
    scaled = weight.astype(np.float64)
    scaled.data *= np.repeat(factor, np.diff(weight.indptr))
    return scaled


def rungs(network: Network, integer: IntegerNetwork, *, windows: bool) -> dict[str, Simulation | None]:
    """The rungs below the chip, ready to run; None for one that is proven to be the chip itself, one with windows."""
    proven = windows and all(proof.holds for proof in prove_ranges(integer))
    stages = map(float_simulation, (network, *realised(network, integer)))
    # where no register leaves its range on any input, the chip is the same without limits
    unlimited = None if proven else integer_simulation(integer, saturates=False)
    return dict(zip(LADDER[:-1], (*stages, unlimited), strict=True))
