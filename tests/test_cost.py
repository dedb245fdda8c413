"""Costs, counted a second time spike by spike and synapse by synapse, and priced by hand; NeuroBench's metrics."""

import dataclasses

import numpy as np
import pytest
from made_files import events, recorded, small_checkpoint
from numpy.testing import assert_allclose, assert_array_equal
from oracles import brute_force, check_costs
from random_netlists import Axon, Neuron, build
from random_networks import LOIHI, compiled, integer_chain

from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.targets.base import EnergyTable, Quantity
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
from spikeloom.runtime.machines.loihi1.costs.result import cost_report
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.studies import neurobench


def counted_by_hand():
    """Two inputs, a neuron on core 0, two listeners on core 9 steps east and 2 south: all numbers fit on paper."""
    neurons = [Neuron(layer=0, core=0, threshold=1), Neuron(layer=1, core=1), Neuron(layer=1, core=1)]
    axons = [
        Axon(core=0, source=0, targets=((0, 200),)),
        Axon(core=0, source=1, targets=((0, 0),)),
        Axon(core=1, source=2, targets=((0, 2), (1, 0))),
        Axon(core=1, source=2, targets=((1, 2),)),
    ]
    netlist = build(neurons, axons, n_inputs=2, depths=[0, 1])
    return dataclasses.replace(netlist, core_tile=np.array([0, 19]))  # (3, 2) on a mesh eight wide


def test_counted_by_hand():
    netlist = counted_by_hand()
    recording = np.zeros((1, 2, 5), np.uint8)
    recording[0, 0, [0, 2]] = 1  # the first neuron fires in steps 0 and 2
    recording[0, 1, [1, 2, 3]] = 1  # synapses of weight zero are visited all the same
    costs = check_costs(netlist, recording)
    assert costs.steps == 6
    assert costs.events["spike"].tolist() == [[2, 0]]
    assert costs.events["synaptic_operation_sparse"].tolist() == [[2 + 3, 2 * 3]]
    assert costs.events["synaptic_operation_dense"].tolist() == [[0, 0]]
    assert costs.zeros.tolist() == [[3, 2]]
    assert costs.events["packet"].tolist() == [[2 * 2, 0]]
    assert costs.events["hop_east_west"].tolist() == [[2 * 2 * 3, 0]]
    assert costs.events["hop_north_south"].tolist() == [[2 * 2 * 2, 0]]
    # the first neuron is reached in steps 0 to 3; each listener in steps 1 and 3 of its window 1 to 5, and its membrane
    # of 128, of which a fifth is kept a step, is not zero before any of the others
    assert costs.events["neuron_active"].tolist() == [[4, 2 * 5]]
    assert costs.events["neuron_idle"].tolist() == [[6 - 4, 12 - 10]]
    pico = 1e12 * np.concatenate([costs.energy["davies2018"], costs.energy["sanafe"]])
    expected = [
        [5 * 23.6 + 2 * 52 + 4 * 81 + 4 * 1.7 + 12 * 3.0 + 8 * 4.0, 6 * 23.6 + 2 * 52 + 10 * 81],
        [
            5 * 33.6 + 2 * 51.2 + 4 * 72.8 + 2 * 69.3 + 4 * 111 + 12 * 3.0 + 8 * 4.2,
            6 * 33.6 + 2 * 51.2 + 10 * 72.8,
        ],
    ]
    assert_allclose(pico, expected, rtol=1e-12)
    dense = dataclasses.replace(netlist, format_index_bits=np.zeros_like(netlist.format_index_bits))
    assert check_costs(dense, recording).events["synaptic_operation_dense"].tolist() == [[5, 6]]


def table(name, **prices):
    return EnergyTable(
        name=name,
        title=name,
        prices={
            event: Quantity(value=value, unit="pJ", source="made up") for event, value in prices.items()
        },
    )


FULL = dict.fromkeys(cost.EVENTS, 1.0)


def priced_by(*tables, silent=False):
    netlist = counted_by_hand()
    recording = np.zeros((2, 2, 5), np.uint8)
    if not silent:
        recording[:, 0, 0] = 1
    chip = dataclasses.replace(LOIHI, energy=tables)
    _, found = estimate(netlist, chip, recording)
    return found.costs, cost_report(netlist, chip, found.totals, bin_s=0.02)


@pytest.mark.parametrize(
    "event", [name for name in cost.EVENTS if name not in ("synaptic_operation_dense", "spike")]
)
def test_a_table_without_a_price_is_left_out(event):
    lacking = {name: price for name, price in FULL.items() if name != event}
    costs, report = priced_by(table("lacking", **lacking), table("full", **FULL))
    assert set(costs.energy) == {"full"}
    assert costs.unpriced == {"lacking": (event,)}
    assert report.not_modelled[0] == f"lacking: no price for {event}"
    assert "SANA-FE's own runs" in report.not_modelled[1]
    for part in (report.per_inference, report.min, report.max, *(layer.amounts for layer in report.layers)):
        assert set(part.energy_j) == {"full"}


def test_every_lacking_price_is_named():
    costs, _ = priced_by(table("poor", packet=1.0))
    assert costs.energy == {}
    # nothing was stored dense here, and a spike may be priced with its neuron's update
    assert costs.unpriced == {
        "poor": (
            "synaptic_operation_sparse",
            "neuron_idle",
            "neuron_active",
            "hop_east_west",
            "hop_north_south",
        )
    }


def test_what_did_not_happen_needs_no_price():
    costs, _ = priced_by(table("idle", neuron_idle=50.0), silent=True)
    # 3 compartments in 6 steps
    assert_allclose(costs.energy["idle"].sum(axis=1), [18 * 50e-12] * 2)


def test_one_price_for_both_forms_of_a_list():
    both = {name: price for name, price in FULL.items() if not name.startswith("synaptic")}
    costs, _ = priced_by(table("one", **both, synaptic_operation=7.0), table("two", **FULL))
    extra = (costs.energy["one"] - costs.energy["two"]).sum(axis=1)
    assert_allclose(extra, [6e-12 * (1 + 3)] * 2)


def test_report_has_means_and_extremes_over_recordings(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    netlist = compile_network(expand(checkpoint, adjacency)).netlist
    recordings = events(7, samples=5).reshape(5, netlist.n_inputs, -1)
    report = encode(cost_report(netlist, LOIHI, estimate(netlist, LOIHI, recordings)[1].totals, bin_s=0.02))
    samples = [brute_force(netlist, recording) for recording in recordings]
    operations = [sum(s["synaptic_operation_dense"]) + sum(s["synaptic_operation_sparse"]) for s in samples]
    assert len(set(operations)) > 1
    found = [report[part]["synaptic_operations"] for part in ("min", "per_inference", "max")]
    assert found == [min(operations), pytest.approx(np.mean(operations)), max(operations)]
    layers = [layer["synaptic_operations"] for layer in report["layers"]]
    expected = np.mean(
        [np.add(s["synaptic_operation_dense"], s["synaptic_operation_sparse"]) for s in samples], axis=0
    )
    assert_allclose(layers, expected)
    updates = [sum(s["neuron_active"]) for s in samples]
    assert report["max"]["neuron_updates"] == max(updates)
    accesses = netlist.n_compartments * (recordings.shape[2] + 3)
    assert report["per_inference"]["neuron_accesses"] == accesses
    assert report["min"]["synaptic_operations_on_zeros"] == min(sum(s["zeros"]) for s in samples)
    assert report["samples"] == 5


LENGTHS = np.array([30, 7, 1, 30])


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    checkpoint, adjacency = small_checkpoint(tmp_path_factory.mktemp("small"))
    netlist = compile_network(
        expand(checkpoint, adjacency), Options(storage=Fixed((Packing(planes=2),)))
    ).netlist
    recordings = events(5, samples=4, steps=30)
    return netlist, recordings.reshape(4, netlist.n_inputs, -1)


@pytest.fixture(scope="module")
def found(small):
    netlist, recordings = small
    return {
        detail: estimate(netlist, LOIHI, recordings, lengths=LENGTHS, detail=detail)
        for detail in ("counts", "cycle")
    }


def test_all_details_have_the_same_spikes_and_events(small, found):
    netlist, recordings = small
    plain = engine.simulate(netlist, recordings, lengths=LENGTHS)
    for trace, priced in found.values():
        for field in dataclasses.fields(trace.counts):
            assert_array_equal(getattr(trace.counts, field.name), getattr(plain.counts, field.name))
        for name, energy in found["counts"][1].costs.energy.items():
            assert_array_equal(priced.costs.energy[name], energy)


def test_a_batch_is_its_recordings_one_by_one(small, found):
    netlist, recordings = small
    for index, length in enumerate(LENGTHS):
        _, alone = estimate(netlist, LOIHI, recordings[index : index + 1, :, :length], detail="cycle")
        for model in ("simple", "detailed"):
            whole, part = (getattr(cost, model)["sanafe"] for cost in (found["cycle"][1], alone))
            steps = length + netlist.max_depth
            for name in ("duration_ns", "critical_core", "receiving"):
                assert_array_equal(getattr(whole, name)[index, :steps], getattr(part, name)[0])
            assert not whole.duration_ns[index, steps:].any()
            assert np.all(whole.critical_core[index, steps:] == -1)


def test_the_report_says_power_and_pace(small, found):
    netlist, _ = small
    _, cost = found["cycle"]
    report = encode(cost_report(netlist, LOIHI, cost.totals, bin_s=0.02))
    energy, seconds = (
        cost.costs.energy["sanafe"].sum(axis=1),
        cost.simple["sanafe"].duration_ns.sum(axis=1) * 1e-9,
    )
    (entry,) = [
        e for e in report["pace"]["full_speed"] if (e["energy_table"], e["model"]) == ("sanafe", "simple")
    ]
    assert entry["power_w"] == pytest.approx((energy / seconds).mean())
    assert entry["energy_delay_js"] == pytest.approx((energy * seconds).mean())
    assert report["pace"]["real_time_w"]["sanafe"] == pytest.approx((energy / (LENGTHS * 0.02)).mean())
    assert report["detail"] == "cycle"
    for times in report["time"]:
        assert sum(core["share_of_steps"] for core in times["critical_core"]) == pytest.approx(1)
    assert len(report["cores"]) == netlist.n_cores
    assert sum(core["energy_j"]["sanafe"] for core in report["cores"]) == pytest.approx(energy.mean())


def test_a_host_adds_to_each_step(small, found):
    netlist, _ = small
    _, cost = found["counts"]
    host = cost_report(netlist, LOIHI, cost.totals, bin_s=0.02).host
    steps = (LENGTHS + netlist.max_depth).mean()
    for step, inference, energy in zip(host.step_s, host.inference_s, host.energy_j, strict=True):
        assert inference == pytest.approx(steps * step)
        assert energy == pytest.approx(inference * LOIHI.host["awake"].value * 1e-3)
    assert cost_report(netlist, dataclasses.replace(LOIHI, host={}), cost.totals, bin_s=0.02).host is None


def test_the_range_names_both_ends(small, found):
    netlist, _ = small
    _, cost = found["counts"]
    report = encode(cost_report(netlist, LOIHI, cost.totals, bin_s=0.02))
    means = {name: energy.sum(axis=1).mean() for name, energy in cost.costs.energy.items()}
    ends = report["energy_range_j"]
    for end, choose in (("low", min), ("high", max)):
        assert ends[end]["energy_j"] == pytest.approx(choose(means.values()))
        assert means[ends[end]["table"]] == pytest.approx(choose(means.values()))
    single = dataclasses.replace(LOIHI, energy=LOIHI.energy[:1])
    assert cost_report(netlist, single, cost.totals, bin_s=0.02).energy_range_j is None


def chained():
    """Two input channels, two neurons and one on the chip: of six weights between them one is zero."""
    chain = integer_chain([[2, 4], [6, 2]], [[2, 0]], thresholds=[1, 1], bits=4)
    return machine_of(compiled(chain))


EVENTS = np.array([[[[1, 0, 1]], [[0, 0, 1]]]], np.uint8)
"""One recording of three steps: the first channel, nothing, both."""


def test_neurobench_counted_by_hand():
    # both neurons of the first layer fire in the first step and in the last one, and the second layer with them
    assert encode(neurobench.measure(chained(), recorded(EVENTS))) == {
        "footprint": (5 * 4 + 3 * 16 + 7) // 8,
        "connection_sparsity": 0.1667,
        "activation_sparsity": pytest.approx(1 - 6 / 9),
        # three events on two weights each, and two spikes of the neuron whose weight is not zero
        "synaptic_operations": {"Effective_MACs": 0.0, "Effective_ACs": 3 * 2 + 2, "Dense": 3 * 6},
    }


def test_neurobench_counts_nothing_after_the_end_of_a_recording():
    both = dataclasses.replace(recorded(np.repeat(EVENTS, 2, axis=0)), lengths=np.array([3, 1]))
    found = neurobench.measure(chained(), both)
    assert found.synaptic_operations.effective_acs == (8 + 3) / 2
    assert found.synaptic_operations.dense == (18 + 6) / 2
    assert found.activation_sparsity == pytest.approx((3 / 9 + 0 / 3) / 2)
