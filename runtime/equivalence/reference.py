"""The float side of a comparison: whose spikes and membranes the chip is held against."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import Netlist
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.types import BoolArray, FloatArray


def require_match(netlist: Netlist, model: Checkpoint | Network) -> None:
    """Refuse a netlist and a checkpoint or float network whose taxels, channels, timing or layers differ."""
    ours = {"taxels": netlist.taxels, "channels": netlist.polarities}
    ours |= _timing(netlist.clocks, netlist.bins) | {layer.name: layer.neurons for layer in netlist.layers}
    what = "network" if isinstance(model, Network) else "checkpoint"
    if isinstance(model, Network):
        theirs = {"taxels": model.input.taxels, "channels": model.input.polarities}
        theirs |= _timing(model.input.clocks, model.input.bins) | {p.name: p.size for p in model.populations}
    else:
        theirs = {"taxels": model.taxels, "channels": model.hops.shape[2]}
        theirs |= _timing(model.dynamics.clocks, model.bins) | model.neurons
    if ours != theirs:
        sizes = [", ".join(f"{name} {neurons}" for name, neurons in side.items()) for side in (ours, theirs)]
        raise ModelError(
            f"netlist and {what} disagree: the netlist has {sizes[0]}, the {what} {sizes[1]}; "
            f"give the {what} that the netlist was compiled from"
        )


def _timing(clocks: Clocks, bins: int) -> dict[str, int]:
    found = {"clocks": clocks.channels, "steps of a clock": clocks.steps} if clocks.channels else {}
    return found | ({"bins of a step": bins} if bins > 1 else {})


def spikes_of(
    model: Checkpoint | Network, adjacency: FloatArray | None, events: npt.NDArray[np.uint8], dtype: str
) -> list[BoolArray]:
    """Float spikes of each layer: of a checkpoint in its own operator order, of a network as sums over synapses."""
    from spikeloom.models.networks.reference import float_spikes  # torch, so only here

    if isinstance(model, Network):
        inputs = channels_last(events, model.input.clocks)
        return list(run_float(model, inputs, dtype=np.dtype(dtype)).spikes)
    assert adjacency is not None, "a checkpoint has a graph"
    return list(float_spikes(model, adjacency, events, dtype=dtype).values())


def membranes_of(
    model: Checkpoint | Network, adjacency: FloatArray | None, events: npt.NDArray[np.uint8]
) -> list[npt.NDArray[np.floating]]:
    """Membranes of each layer in float32, likewise."""
    from spikeloom.models.networks.reference import float_membranes  # torch, so only here

    if isinstance(model, Network):
        inputs = channels_last(events, model.input.clocks)
        kept = run_float(model, inputs, dtype=np.float32, membranes=True).membranes
        assert kept is not None, "membranes were wanted"
        return list(kept)
    assert adjacency is not None, "a checkpoint has a graph"
    return list(float_membranes(model, adjacency, events).values())


def taxel_and_feature(model: Checkpoint | Network, layer: int, neuron: int) -> tuple[int, int] | tuple[None, None]:
    """Where a neuron of a graph convolution lies; others, and relays of clocks, lie nowhere."""
    if layer or isinstance(model, Network) or model.system not in GRAPH_SYSTEMS:
        return None, None
    taxel, feature = divmod(neuron, model.hops.shape[1])
    return (taxel, feature) if taxel < model.taxels else (None, None)


def float_network(model: Checkpoint | Network, adjacency: FloatArray | None) -> Network:
    """The float stage of a model."""
    if isinstance(model, Network):
        return model
    assert adjacency is not None, "a checkpoint has a graph"
    return expand(model, adjacency)
