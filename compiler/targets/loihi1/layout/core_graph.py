"""The netlist's cores as a graph: who sends to whom, and over how many hops."""

from __future__ import annotations

import networkx as nx
import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_of_core
from spikeloom.compiler.targets.loihi1.layout.place import hops
from spikeloom.compiler.targets.loihi1.netlist import Netlist


def core_map(netlist: Netlist, target: Target) -> nx.DiGraph:
    """Cores (and ``input``) as nodes, connections between them as edges.

    Node attributes are ``tile`` (None for the input), ``compartments`` and ``layers`` (names); edge attributes
    ``axons`` (input axons of the second core that listen to the first) and ``hops`` (0 on one tile; None from the
    input, which has no place on the mesh, and between chips).
    """
    graph = nx.DiGraph()
    chip = chip_of_core(netlist.core_tile, target)
    graph.add_node("input", tile=None, compartments=0, layers=())
    for core, tile in enumerate(netlist.core_tile.tolist()):
        held = slice(*netlist.core_compartments[core : core + 2].tolist())
        names = tuple(netlist.layers[i].name for i in np.unique(netlist.layer[held]))
        graph.add_node(core, tile=tile, compartments=held.stop - held.start, layers=names)
    inner = netlist.axon_source >= netlist.n_inputs
    source = np.where(inner, netlist.axon_source - netlist.n_inputs, 0)
    sender = np.where(inner, netlist.core_of_compartment()[source], -1)
    pairs, axons = np.unique(np.stack([sender, netlist.core_of_axon()]), axis=1, return_counts=True)
    width = target.limit("mesh.width")
    for (pre, post), count in zip(pairs.T.tolist(), axons.tolist(), strict=True):
        if pre < 0 or chip[pre] != chip[post]:
            graph.add_edge(pre if pre >= 0 else "input", post, axons=count, hops=None)
        else:
            distance = sum(hops(int(netlist.core_tile[pre]), int(netlist.core_tile[post]), width))
            graph.add_edge(pre, post, axons=count, hops=distance)
    return graph
