"""The core map against independent counts of axons, hops and reach."""

import networkx as nx
import numpy as np
import pytest

from spikeloom.compiler import compile_network
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.layout.core_graph import core_map
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.runtime.inputs.files import shipped

TARGET = load_target("loihi1")


@pytest.fixture(scope="module")
def compilation():
    checkpoint = read_checkpoint(shipped("pretrained:grasps"))
    return compile_network(expand(checkpoint, normalised_adjacency(checkpoint.edges, checkpoint.taxels)))


def test_axons_of_the_map_are_those_that_the_limits_count(compilation):
    netlist = compilation.netlist
    graph = core_map(netlist, TARGET)
    into = {use.core: use.used for use in measure(netlist, TARGET) if use.name == "core.axons_in"}
    out = {use.core: use.used for use in measure(netlist, TARGET) if use.name == "core.axons_out"}
    for core in range(netlist.n_cores):
        assert graph.in_degree(core, weight="axons") == into[core]
        assert graph.out_degree(core, weight="axons") == out[core]
        assert graph.nodes[core]["compartments"] == np.diff(netlist.core_compartments)[core]


def test_spike_hops_of_the_placement_are_axons_times_hops(compilation):
    # without calibration every neuron counts as one spike a step
    graph = core_map(compilation.netlist, TARGET)
    spent = sum(edge["axons"] * edge["hops"] for _, _, edge in graph.edges(data=True) if edge["hops"] is not None)
    assert spent == compilation.placement.spike_hops


def test_every_core_is_reached_from_the_input(compilation):
    graph = core_map(compilation.netlist, TARGET)
    assert nx.descendants(graph, "input") == set(range(compilation.netlist.n_cores))
    assert {name for core in range(compilation.netlist.n_cores) for name in graph.nodes[core]["layers"]} == {
        "conv1",
        "fc1",
        "fc2",
        "fc3",
    }
