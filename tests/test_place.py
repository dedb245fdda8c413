import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_networks import LOIHI, integer_networks, seated, small_target

from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.layout.place import core_traffic, place, place_within


def cost(traffic, tiles, width):
    """Spikes times hops of a layout, or of each of several (…, cores)."""
    x, y = np.asarray(tiles) % width, np.asarray(tiles) // width
    ways = abs(x[..., :, None] - x[..., None, :]) + abs(y[..., :, None] - y[..., None, :])
    return (traffic * ways).sum(axis=(-1, -2))


def brute_force(traffic, width, height, tile_cores):
    """Least cost of all layouts."""
    layouts = np.array(list(itertools.product(range(width * height), repeat=len(traffic))))
    held = (layouts[:, :, None] == np.arange(width * height)).sum(axis=1)
    return cost(traffic, layouts[held.max(axis=1) <= tile_cores], width).min()


def layered(rng, cores):
    """Three groups of cores that talk from one to the next, as the layers of a network do."""
    group = np.sort(rng.integers(0, 3, cores))
    return np.where(group[:, None] + 1 == group, rng.random((cores, cores)), 0.0)


KINDS = {
    "random": lambda rng, cores: rng.random((cores, cores)),
    "whole": lambda rng, cores: rng.integers(0, 3, (cores, cores)).astype(float),
    "layered": layered,
    "equal": lambda _, cores: np.ones((cores, cores)),
    "star": lambda _, cores: np.outer(np.arange(cores) == 0, np.ones(cores)),
}


@settings(deadline=None, max_examples=15)
@given(
    st.integers(1, 5),
    st.sampled_from([(3, 2, 1), (3, 3, 2), (2, 2, 2), (5, 1, 1), (1, 5, 2)]),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["random", "whole", "layered"]),
)
def test_the_optimum_of_small_cases(cores, mesh, seed, kind):
    width, height, tile_cores = mesh
    cores = min(cores, width * height * tile_cores)
    traffic = KINDS[kind](np.random.default_rng(seed), cores)
    target = small_target(mesh_width=width, mesh_height=height, mesh_tile_cores=tile_cores)
    placement = place(traffic, target)
    assert placement.spike_hops == pytest.approx(brute_force(traffic, width, height, tile_cores), rel=1e-9, abs=1e-12)
    assert placement.spike_hops == pytest.approx(cost(traffic, placement.tiles, width), abs=1e-12)
    assert max(placement.tiles.count(tile) for tile in placement.tiles) <= tile_cores
    assert set(placement.tiles) <= set(range(width * height))


def test_of_equal_layouts_the_one_with_more_east_west_hops_is_taken():
    """Two cores on tiles for one: side by side, not one above the other."""
    placement = place(np.array([[0.0, 1.0], [0.0, 0.0]]), small_target(mesh_tile_cores=1))
    assert abs(placement.tiles[0] - placement.tiles[1]) == 1


def test_a_slightly_better_layout_is_not_given_up_for_cheaper_hops():
    """On a mesh of two rows the heavier pair sits side by side even if that costs more vertical hops."""
    traffic = np.zeros((3, 3))
    traffic[0, 1], traffic[0, 2], traffic[1, 2] = 1.0, 1.0 + 1e-6, 1.0 + 2e-6
    placement = place(traffic, small_target(mesh_tile_cores=1, mesh_width=2, mesh_height=2))
    # one pair is two hops apart: the lightest
    assert placement.spike_hops == pytest.approx(3 + 3e-6 + 1.0, rel=1e-12)


@pytest.mark.parametrize(("kind", "cores"), [("random", 12), ("star", 12), ("layered", 64)])
def test_many_cores_are_placed_well(cores, kind):
    rng = np.random.default_rng(1)
    traffic = KINDS[kind](rng, cores)
    placement = place(traffic, LOIHI)
    assert cores > 12 or place(traffic.copy(), LOIHI) == placement
    assert max(placement.tiles.count(tile) for tile in placement.tiles) <= 4
    assert placement.spike_hops == pytest.approx(cost(traffic, placement.tiles, 8))
    shuffled = [cost(traffic, rng.permutation(128)[:cores] // 4, 8) for _ in range(50)]
    assert placement.spike_hops <= min(shuffled)
    assert placement.spike_hops <= cost(traffic, np.arange(cores) // 4, 8) * (1 + 1e-9)


@pytest.mark.parametrize(("tiles", "cores"), [(1, 4), (2, 5), (3, 9), (3, 12), (12, 28)])
def test_a_placement_within_few_tiles(tiles, cores):
    """A ring of cores that would rather spread: each talks to the next but one."""
    traffic = np.roll(np.eye(cores), 2, axis=1) + 0.1 * np.random.default_rng(0).random((cores, cores))
    placement = place_within(traffic, LOIHI, tiles)
    assert len(set(placement.tiles)) <= tiles
    assert max(placement.tiles.count(tile) for tile in placement.tiles) <= 4
    assert placement.spike_hops == pytest.approx(cost(traffic, placement.tiles, 8))


def test_a_placement_keeps_to_few_tiles():
    """Three pairs on tiles for four cores, or for three, where two tiles tear one pair apart."""
    traffic = np.kron(np.eye(3), np.ones((2, 2)))
    assert place_within(traffic, LOIHI, 2).spike_hops == 0
    squeezed = place_within(traffic, small_target(mesh_tile_cores=3), 2)
    assert (len(set(squeezed.tiles)), squeezed.spike_hops) == (2, 2)


@settings(deadline=None, max_examples=20)
@given(integer_networks(), st.integers(1, 8), st.integers(0, 2**32 - 1))
def test_traffic_is_a_packet_per_listening_axon(network, compartments, seed):
    rng = np.random.default_rng(seed)
    rates = tuple(rng.random(population.size) for population in network.populations)
    target = small_target(core_compartments=compartments)
    parts = partition(network, target, rates)
    netlist = seated(network, parts, target)
    expected = np.zeros((netlist.n_cores,) * 2)
    core_of_axon, core_of_compartment = netlist.core_of_axon(), netlist.core_of_compartment()
    for axon, source in enumerate(netlist.axon_source.tolist()):
        if source >= netlist.n_inputs:
            compartment = source - netlist.n_inputs
            rate = rates[netlist.layer[compartment]][netlist.neuron[compartment]]
            expected[core_of_compartment[compartment], core_of_axon[axon]] += rate
    np.testing.assert_allclose(core_traffic(network, parts, rates), expected, rtol=1e-12)
