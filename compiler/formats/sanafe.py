"""Netlists for SANA-FE: network and mapping in its YAML, to be loaded with the ``loihi.yaml`` that it ships.

What the file says and what the chip does differ in a few points:

* SANA-FE knows no windows: biases act from its first step on. The engine runs the same if all layers have depth 0.
* Input channels are neurons: they fire in one step and act in the next. They sit on cores of their own, cost nothing
  but their messages, and are silent until they are given ``spikes``.
* A neuron names one unit for all of its synapses. A neuron that both dense and sparse lists reach names the one with
  more of its synapses (:func:`dense_neurons`).
* A neuron sends one message to a core, however many lists there receive it.
* A current that the step before left is no work to a neuron.
* A current that outlasts its step is a float there, cut to nothing; the chip cuts it to a whole 64th of a weight unit
  in every step. Spikes of such layers may differ, and of no others: :func:`floating_layers` names them.
* Registers have no ends. No register of a compiled netlist reaches its own.

Groups are called ``input`` and by the layers; neuron ``k`` of a group is the channel or the layer's ``k``-th
compartment in the order of neurons (neurons that were left out have none).

References
----------
.. [1] J. Boyle et al., "SANA-FE", IEEE TCAD 44(8), 3165-3178, 2025; format of version 2.2.9.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import plain_names
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.place import chip_tiles, require_one_chip
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import MEMBRANE_SHIFT, kept_shares
from spikeloom.compiler.targets.loihi1.storage.weight_storage import FORGETS
from spikeloom.compiler.types import BoolArray, IntArray

INPUT = "input"
VERSION = "2.2.9"

UNITS = {True: "loihi_dense_synapse", False: "loihi_sparse_synapse"}


def group_names(netlist: Netlist) -> tuple[str, ...]:
    """Names of the layers' groups; dots, which separate names from numbers, and the like become underscores."""
    return plain_names([layer.name for layer in netlist.layers], taken=[INPUT])


def floating_layers(netlist: Netlist) -> tuple[str, ...]:
    """Names of the groups whose currents outlast their step."""
    lasting = np.unique(netlist.layer[netlist.decay_u != FORGETS])
    return tuple(group_names(netlist)[layer] for layer in lasting)


def dense_neurons(netlist: Netlist) -> BoolArray:
    """Which compartments name the unit of dense synapses."""
    in_dense_list = netlist.format_index_bits[netlist.axon_format[netlist.axon_of_synapse()]] == 0
    balance = np.where(in_dense_list, 1.0, -1.0)
    return np.bincount(netlist.synapse_compartment(), balance, netlist.n_compartments) >= 0


def input_tiles(netlist: Netlist, target: Target) -> tuple[int, ...]:
    """Tiles for cores that hold nothing but input channels: those in use that have room, then the others."""
    room = target.limit("mesh.tile_cores")
    tiles = np.arange(chip_tiles(target))
    used = np.bincount(netlist.core_tile, minlength=len(tiles))
    order = tiles[np.argsort(used == 0, kind="stable")]
    free = np.repeat(order, np.maximum(room - used[order], 0))
    wanted = -(-netlist.n_inputs // target.limit("core.compartments"))
    if wanted > len(free):
        raise ModelError(
            f"input channels: {wanted} cores needed, the chip has {len(free)} left; use fewer cores"
        )
    return tuple(int(tile) for tile in free[:wanted])


def cores(netlist: Netlist, target: Target) -> tuple[str, ...]:
    """``tile.core`` of the netlist's cores, then of those that hold the input channels; tiles count by columns."""
    require_one_chip(netlist.core_tile, target, "--to sanafe")
    width = target.limit("mesh.width")
    height = target.limit("mesh.height")
    tiles = [*netlist.core_tile.tolist(), *input_tiles(netlist, target)]
    return tuple(
        f"{tile % width * height + tile // width}.{tiles[:n].count(tile)}" for n, tile in enumerate(tiles)
    )


def export(netlist: Netlist, target: Target) -> Iterator[str]:
    """Lines of the file; OptionError if the netlist takes several chips, ModelError if one has no room for inputs."""
    room = target.limit("core.compartments")
    names = group_names(netlist)
    number = netlist.number_in_layer()
    places = cores(netlist, target)
    yield f"# spikeloom netlist for SANA-FE {VERSION} and its loihi.yaml; give the neurons of group {INPUT} 'spikes'"
    if netlist.clocks.channels:
        length = netlist.clocks.steps
        first = netlist.n_inputs - netlist.clocks.channels
        yield f"# from neuron {first} on they are clocks: each spikes in {length} steps, one after the other"
    if netlist.clocks.length is not None:
        yield f"# every recording is run for {netlist.clocks.length} steps, in silence after its end"
    if netlist.bins > 1:
        yield f"# a step joins {netlist.bins} bins of the recordings"
    if floating := floating_layers(netlist):
        yield f"# currents of {', '.join(floating)} outlast a step: floats here, whole 64ths on the chip"
    yield "network:"
    yield "  name: spikeloom"
    yield "  groups:"
    yield f"    - name: {INPUT}"
    yield "      attributes: {log_spikes: false}"
    yield "      neurons:"
    for channel in range(netlist.n_inputs):
        yield f"        - {channel}: {{soma_hw_name: 'loihi_inputs[{channel % room}]'}}"
    yield from _groups(netlist, names)
    yield "  edges:"
    yield from _edges(netlist, names, number)
    yield "mappings:"
    for core, place in enumerate(places[netlist.n_cores :]):
        last = min((core + 1) * room, netlist.n_inputs) - 1
        yield f"  - {INPUT}.{core * room}..{last}: {{core: '{place}'}}"
    for core, place in enumerate(places[: netlist.n_cores]):
        begin, end = netlist.core_compartments[core : core + 2]
        # a core sweeps its neurons in the order in which they are mapped
        breaks = np.diff(netlist.layer[begin:end]) != 0
        breaks |= np.diff(number[begin:end]) != 1
        runs = [begin, *(begin + 1 + np.flatnonzero(breaks)), end] if end > begin else []
        for first, after in pairwise(runs):
            group = names[netlist.layer[first]]
            yield f"  - {group}.{number[first]}..{number[after - 1]}: {{core: '{place}'}}"


def _groups(netlist: Netlist, names: tuple[str, ...]) -> Iterator[str]:
    """Neurons of each layer; membranes count weight units."""
    dense = dense_neurons(netlist)
    bias = netlist.bias_mantissa * 2.0**netlist.bias_exponent / 2**MEMBRANE_SHIFT
    kept, leak = kept_shares(netlist.decay_u, netlist.decay_v)
    for layer, name in enumerate(names):
        yield f"    - name: '{name}'"  # else 1, null and yes are no words
        yield "      attributes: {soma_hw_name: loihi_lif, reset: 0.0, input_decay: 0.0, log_spikes: true}"
        yield "      neurons:"
        for k, c in enumerate(netlist.compartments_of(layer).tolist()):
            unit = UNITS[bool(dense[c])]
            lasts = f"input_decay: {float(kept[c])!r}, " if kept[c] else ""
            yield (
                f"        - {k}: {{threshold: {netlist.threshold[c]}.0, leak_decay: {float(leak[c])!r}, {lasts}"
                f"bias: {float(bias[c])!r}, synapse_hw_name: {unit}}}"
            )


def _edges(netlist: Netlist, names: tuple[str, ...], number: IntArray) -> Iterator[str]:
    """One edge for each two groups, with all synapses between them, zeros that dense lists store included."""
    inputs = netlist.n_inputs
    axon_pre = np.append(np.full(inputs, -1), netlist.layer)[netlist.axon_source]
    axon_number = np.append(np.arange(inputs), number)[netlist.axon_source]
    axon = netlist.axon_of_synapse()
    pre = axon_pre[axon]
    source = axon_number[axon]
    target = netlist.synapse_compartment()
    post = netlist.layer[target]
    weight = netlist.effective_weight()
    for a, pre_name in enumerate((INPUT, *names), start=-1):
        for b, post_name in enumerate(names):
            between = np.flatnonzero((pre == a) & (post == b))
            if not len(between):
                continue
            pairs = zip(source[between].tolist(), number[target[between]].tolist(), strict=True)
            yield f"    - {pre_name} -> {post_name}:"
            yield "        type: sparse"
            yield f"        source_target_pairs: [{', '.join(f'[{i}, {j}]' for i, j in pairs)}]"
            yield f"        weight: [{', '.join(f'{w}.0' for w in weight[between].tolist())}]"
