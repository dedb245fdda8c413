"""Small networks with currents that outlast their step and with clocks, for the tests of all that handles them."""

from dataclasses import replace

import torch
from made_files import graph_facts, sparse_events

from spikeloom.compiler.dynamics import Clocks, Dynamics
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.models.graphs import NEUTOUCH, build_graph
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.systems import filters_of, propagation_of, sensor_grid

GRAPH = build_graph("manual")

TIMING = Dynamics(
    betas=(0.2, 0.3, 0.0, 0.4), alphas=(0.0, 0.95, 0.5, 0.0), clocks=Clocks(channels=3, steps=4)
)

SMALL = Architecture(taxels=39, classes=4, hops=2, features=3, hidden=(8, 6), dynamics=TIMING)


def louder(network, factor=3.0):
    """Multiply all weights and biases, so that every layer spikes."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(factor)
    return network


def written(path, system="tactilesgnet", dynamics=TIMING, seed=1, **sizes):
    """Write the checkpoint of a network with random weights; return the network and what its first layer sees."""
    architecture = replace(SMALL, system=system, dynamics=dynamics, **sizes)
    grid = sensor_grid(NEUTOUCH, "none") if system == "grid-cnn" else None
    seen = propagation_of(system, GRAPH.edges, 39, grid, filters_of(system, 39, architecture.hops))
    network = louder(SpikingNet(architecture, seen, seed=seed))
    constants = {
        "beta": architecture.beta,
        "theta": architecture.theta,
        "training": {},
        "system": system,
        "grid": grid,
    }
    sets = {"last": network.export_weights()}
    save_checkpoint(path, sets, **graph_facts(GRAPH), dynamics=dynamics, **constants)
    return network, seen


def events_of(seed, samples=4, steps=15, rate=0.15):
    """Recordings (samples, taxels, polarities, steps)."""
    return sparse_events(seed, samples, 39, 2, steps, rate=rate)
