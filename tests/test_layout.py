"""Layouts: cores asked for, and networks on several chips."""

import dataclasses

import numpy as np
import pytest
import random_networks as nets
from hypothesis import assume, given
from hypothesis import strategies as st
from made_files import sparse_events
from oracles import refused

from spikeloom.compiler.errors import CapacityError, OptionError
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.layout.choose import lay_out
from spikeloom.compiler.targets.loihi1.layout.partition import core_bound, partition
from spikeloom.compiler.targets.loihi1.layout.place import chip_count, chip_of_core, place_on_chips, share
from spikeloom.compiler.targets.loihi1.legalize import LimitUse, measure, require_legal
from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.runtime.machines.loihi1.costs import page, timing
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
from spikeloom.runtime.machines.loihi1.costs.result import cost_report
from spikeloom.runtime.report.encode import encode


def test_a_layer_gets_more_cores_than_asked_for_if_even_parts_do_not_fit():
    """Nine thresholds in the first half, one in the second: two even halves are one threshold too many."""
    thresholds = [[*range(1, 10), *[1] * 9]]
    network = nets.integer_chain(np.full((18, 1), 2), thresholds=thresholds)
    parts = partition(network, nets.LOIHI, cores_for={0: 2})
    assert [core[0].size for core in parts] == [6, 6, 6]


@given(nets.integer_networks(), nets.tight_targets(), st.data())
def test_every_partition_is_legal_and_holds_every_neuron_once(network, target, data):
    nets.legal_partition(network, target)
    asked = {
        i: data.draw(st.integers(1, population.size))
        for i, population in enumerate(network.populations)
        if data.draw(st.booleans())
    }
    try:
        parts = partition(network, target, cores_for=asked)
    except (CapacityError, OptionError):
        assume(False)
    chunks = [chunk for core in parts for chunk in core]
    neurons = [(chunk.population, neuron) for chunk in chunks for neuron in range(chunk.first, chunk.last)]
    assert sorted(neurons) == [(i, n) for i, p in enumerate(network.populations) for n in range(p.size)]
    assert core_bound(network, target) <= len(parts)
    for population, cores in asked.items():
        mine = [core for core in parts if any(chunk.population == population for chunk in core)]
        assert len(mine) >= cores
        assert all(len(core) == 1 for core in mine)
        sizes = [core[0].size for core in mine]
        assert max(sizes) - min(sizes) <= 1
    require_legal(nets.seated(network, parts, target), target)
    assert partition(network, target, cores_for=asked) == parts
    assert partition(network, target, cores_for={}) == partition(network, target)


SMALL = nets.small_target(core_compartments=4, chip_cores=2, mesh_width=2, mesh_height=1, mesh_tile_cores=1)
"""Two cores of four neurons a chip, one on each tile."""


def net():
    """Three layers of 8, 8 and 4 neurons that need five cores of ``SMALL``."""
    rng = np.random.default_rng(3)
    weights = [2 * rng.integers(-20, 60, shape) for shape in ((8, 6), (8, 8), (4, 8))]
    return nets.integer_chain(*weights, thresholds=[60, 200, 200])


@pytest.fixture(scope="module")
def netlist():
    layout = lay_out(net(), SMALL, chips=3)
    made = emit(net(), layout.cores, layout.placement.tiles, SMALL, {})
    require_legal(made, SMALL)
    return made


@pytest.fixture(scope="module")
def recordings():
    return sparse_events(5, 3, 6, 40, rate=0.5)


def test_a_network_takes_as_few_chips_as_hold_it(netlist, tmp_path):
    assert netlist.n_cores == 5
    chip = chip_of_core(netlist.core_tile, SMALL)
    assert np.bincount(chip).tolist() == [2, 2, 1]
    assert chip_count(netlist.core_tile, SMALL) == 3
    assert len(set(netlist.core_tile.tolist())) == 5
    one = lay_out(net(), nets.LOIHI, chips=9)
    assert chip_count(np.array(one.placement.tiles), nets.LOIHI) == 1
    write_netlist(netlist, tmp_path / "net.loom")
    assert read_netlist(tmp_path / "net.loom").core_tile.tolist() == netlist.core_tile.tolist()


def test_the_fullest_chip_is_measured(netlist):
    assert measure(netlist, SMALL)[-1] == LimitUse(name="chip.cores", used=2, allowed=2, core=None)
    crowded = dataclasses.replace(netlist, core_tile=np.array([0, 1, 0, 2, 3]))
    refused(CapacityError, "chip: 3 used, 2 allowed (loihi1.chip.cores)", require_legal, crowded, SMALL)


@given(st.integers(1, 9), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_every_core_gets_a_chip_that_has_room(cores, room, seed):
    chip = share(np.random.default_rng(seed).random((cores, cores)), room)
    assert np.all(np.bincount(chip)[:-1] == room)
    assert chip.max() + 1 == -(-cores // room)


@given(st.integers(3, 8), st.integers(0, 2**32 - 1))
def test_a_placement_counts_what_stays_and_what_leaves(cores, seed):
    traffic = np.random.default_rng(seed).random((cores, cores))
    placement = place_on_chips(traffic, SMALL)
    chip = np.array(placement.tiles) // 2
    stays = hops = 0.0
    for a in range(cores):
        for b in range(cores):
            if chip[a] == chip[b]:
                stays += traffic[a, b]
                hops += traffic[a, b] * abs(placement.tiles[a] - placement.tiles[b])
    assert placement.between_chips == pytest.approx(traffic.sum() - stays)
    assert placement.spike_hops == pytest.approx(hops)


def test_packets_that_leave_are_counted_and_their_way_is_not(netlist, recordings):
    trace, found = estimate(netlist, SMALL, recordings)
    chip = chip_of_core(netlist.core_tile, SMALL)
    core = netlist.core_of_compartment()
    left = hops = packets = 0
    for axon, source in enumerate(netlist.axon_source):
        if source >= netlist.n_inputs:
            start, end = core[source - netlist.n_inputs], netlist.core_of_axon()[axon]
            spikes = trace.counts.spikes[:, source - netlist.n_inputs].sum()
            packets += spikes
            if chip[start] != chip[end]:
                left += spikes
            else:
                hops += spikes * abs(netlist.core_tile[start] - netlist.core_tile[end])
    assert found.costs.between_chips.sum() == left > 0
    assert found.costs.events["packet"].sum() == packets > left
    assert found.costs.events["hop_east_west"].sum() == hops > 0
    assert found.simple == found.detailed == {}


def test_the_report_says_what_is_not_modelled(netlist, recordings):
    _, found = estimate(netlist, SMALL, recordings)
    report = encode(cost_report(netlist, SMALL, found.totals, bin_s=0.02))
    left = report["per_inference"]["packets_between_chips"]
    assert f"links between the 3 chips: {left:,.0f} of " in report["not_modelled"][0]
    assert report["time"] == []
    assert [(each["chips"], each["full_speed_j"]) for each in report["static"]] == [(3, [])] * 2
    watts = [each["real_time_j"] / (3 * 40 * 0.02) for each in report["static"]]
    assert sorted(watts) == pytest.approx([29e-3, 104.4e-3])


def test_what_is_refused_of_several_chips(netlist, recordings):
    for what, call in {
        "--detail cycle": lambda: estimate(netlist, SMALL, recordings, detail="cycle"),
        "time": lambda: timing.prepare(netlist, SMALL, SMALL.time[0]),
        "--to sanafe": lambda: sanafe.cores(netlist, SMALL),
        "--to sanafe: the netlist": lambda: list(sanafe.export(netlist, SMALL)),
    }.items():
        refused(OptionError, f"{what}|takes 3 chips|links between chips|--detail counts", call)


def test_the_traffic_of_the_page_has_the_axons_that_the_limits_count_and_the_hops_of_the_placement():
    target = nets.small_target(core_compartments=4, mesh_tile_cores=1)
    layout = lay_out(net(), target)
    made = emit(net(), layout.cores, layout.placement.tiles, target, {})
    ways = page._traffic(made, target, np.full(made.n_inputs + made.n_compartments, 2.0))
    used = {(use.name, use.core): use.used for use in measure(made, target)}
    for core in range(5):
        assert sum(way.axons for way in ways if way.to == core) == used["core.axons_in", core]
        assert sum(way.axons for way in ways if way.source == core) == used["core.axons_out", core]
    assert all(way.packets == 2 * way.axons for way in ways)
    # without rates every neuron counts as one spike a step
    assert (
        sum(way.axons * way.hops for way in ways if way.hops is not None) == layout.placement.spike_hops > 0
    )
    assert [(way.source, way.to) for way in ways if way.source is None] == [(None, 0), (None, 1)]
