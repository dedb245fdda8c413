"""The counting network that crossbar cores hold, read back from a netlist: the reverse of :mod:`truenorth.counting`."""

import numpy as np

from spikeloom.compiler.counters import BLOCK, Counters
from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.counting import lower_counters, planned
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, unlike
from spikeloom.compiler.types import BoolArray, IntArray

LAYERS = ("votes", "sums", "counters")


def counters_in(netlist: CrossbarNetlist, chip: Target) -> Counters | None:
    """The counting network that a netlist is, to the last register, if its decisions follow from counts of events.

    Sums send a spike a tick, so each must have sent all that it got by the tick in which it counts. In `n`
    ticks they get what all their counters bring, once and again for each ``BLOCK + 1`` of them, the least from
    one spike of a counter to the next. Votes come later than sums by as many ticks as that is, once: so if
    these are no more than ``BLOCK + 1``, all is sent in time, whatever the input. No register may saturate.
    """
    steps = netlist.clocks.length
    if not set(LAYERS) <= set(netlist.layers) or steps is None:
        return None
    counters = _read(netlist, steps)
    if counters is None:
        return None
    try:
        plan = planned(counters, chip)
        if unlike(netlist, lower_counters(counters, chip)):
            return None
    except (ModelError, CapacityError):
        return None
    late = plan.first["votes"] - plan.first["sums"]
    often = 1 + steps // (BLOCK + 1)
    most = often * int(np.abs(counters.weight).sum(axis=1).max()) + counters.slope * netlist.ticks(steps)
    limit = 1 << chip.limit("neuron.threshold_bits")  # votes saturate one above minus this
    return counters if late <= BLOCK + 1 and counters.slope > 0 and most < limit else None


def _read(netlist: CrossbarNetlist, length: int) -> Counters | None:
    """What a netlist of so many steps would be of; None where that cannot even be asked."""
    layer = {name: netlist.layer == netlist.layers.index(name) for name in LAYERS}
    votes = np.flatnonzero(layer["votes"])
    numbers, first = np.unique(netlist.neuron[layer["counters"]], return_index=True)
    if len(votes) != netlist.classes or not len(numbers) or numbers[-1] != len(numbers) - 1:
        return None
    first = np.flatnonzero(layer["counters"])[first]
    clocks = netlist.clocks
    parts = max(clocks.channels, 1)
    steps = parts * clocks.steps if clocks.channels else length
    source = _sources(netlist, gated=parts > 1)[first]
    part, channel = np.divmod(source, netlist.taxels * netlist.polarities)
    return Counters(
        **{name: getattr(netlist, name) for name in ("taxels", "polarities", "classes", "bins")},
        steps=steps,
        parts=parts,
        ramp=length - steps,
        counter=np.stack([channel, part, netlist.threshold[first]], axis=1),
        weight=_weights(netlist, layer, len(numbers)),
        slope=float(netlist.leak[votes[0]]),
        threshold=netlist.threshold[votes[0]] - 0.5,
    )


def _sources(netlist: CrossbarNetlist, *, gated: bool) -> IntArray:
    """Channel that a neuron receives, or number of the gate, -1 for none; (neurons,)."""
    fed, _, wired = netlist.aims()
    leads = np.full(netlist.n_axons, -1)
    if gated:
        leads[wired] = netlist.neuron[netlist.wire_neuron]
    else:
        leads[fed] = netlist.feed_channel
    source = np.full(netlist.n_neurons, -1)
    source[netlist.neuron_of_synapse()] = leads[netlist.axon_of_synapse()]
    return source


def _weights(netlist: CrossbarNetlist, layer: dict[str, BoolArray], counters: int) -> IntArray:
    """Weights of the counters to the classes, (classes, counters)."""
    target = netlist.neuron_of_synapse()
    axon = netlist.axon_of_synapse()
    _, _, wired = netlist.aims()
    source = np.full(netlist.n_axons, -1)
    source[wired] = np.where(layer["counters"][netlist.wire_neuron], netlist.neuron[netlist.wire_neuron], -1)
    those = np.flatnonzero((source[axon] >= 0) & layer["sums"][target])
    target = target[those]
    axon = axon[those]
    label, below = np.divmod(netlist.neuron[target] % (2 * netlist.classes), 2)
    weight = np.zeros((netlist.classes, counters), np.int64)
    np.add.at(
        weight, (label, source[axon]), (1 - 2 * below) * netlist.weight[target, netlist.axon_type[axon]]
    )
    return weight
