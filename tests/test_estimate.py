"""Costs at every detail: the same spikes, sums that agree with each other and with the definitions."""

import dataclasses

import numpy as np
import pytest
import timing_oracle
from made_files import events, small_checkpoint
from random_networks import LOIHI

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.passes.expand import expand
from spikeloom.runtime.machines.loihi1 import engine, timing
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
from spikeloom.runtime.machines.loihi1.costs.result import cost_report
from spikeloom.runtime.machines.loihi1.costs.sections import sections
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal

LENGTHS = np.array([30, 7, 1, 30])


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    checkpoint, adjacency = small_checkpoint(tmp_path_factory.mktemp("small"))
    netlist = compile_network(expand(checkpoint, adjacency), Options(packings=(Packing(planes=2),))).netlist
    recordings = events(5, samples=4, steps=30)
    return netlist, recordings.reshape(4, netlist.n_inputs, -1)


@pytest.fixture(scope="module")
def found(small):
    netlist, recordings = small
    return {
        detail: estimate(netlist, LOIHI, recordings, lengths=LENGTHS, detail=detail) for detail in ("counts", "cycle")
    }


@pytest.mark.parametrize("stepwise", [False, True])
def test_sums_of_the_engine_give_the_simple_times(small, stepwise):
    netlist, recordings = small
    (times,) = LOIHI.time
    latencies = timing.prepare(netlist, LOIHI, times)
    prepared = engine.prepare(netlist, stepwise=stepwise, charges=timing.charges(latencies))
    trace = engine.simulate(prepared, recordings, lengths=LENGTHS, spikes=True, updated=True)
    ran = LENGTHS + netlist.max_depth
    cut = recordings.copy()
    for recording, length in zip(cut, LENGTHS, strict=True):
        recording[:, length:] = 0
    expected = timing_oracle.simple(latencies, trace.spikes, trace.updated, cut, steps=ran)
    quick = timing.simple_times(latencies, trace.charged, ran)
    for field in dataclasses.fields(expected):
        np.testing.assert_array_equal(getattr(quick, field.name), getattr(expected, field.name), err_msg=field.name)
    assert (expected.duration_ns > 0).sum() == ran.sum()


def test_all_details_have_the_same_spikes_and_events(small, found):
    netlist, recordings = small
    plain = engine.simulate(netlist, recordings, lengths=LENGTHS)
    for counts, cost in found.values():
        for field in dataclasses.fields(counts):
            np.testing.assert_array_equal(getattr(counts, field.name), getattr(plain.counts, field.name))
        for name, energy in found["counts"][1].costs.energy.items():
            np.testing.assert_array_equal(cost.costs.energy[name], energy)


def test_parts_and_cores_add_up_to_the_whole(found):
    _, cost = found["cycle"]
    for name, whole in cost.costs.energy.items():
        assert set(cost.parts[name]) == {"synapse", "soma", "network"}
        np.testing.assert_allclose(sum(cost.parts[name].values()), whole, rtol=1e-12)
        np.testing.assert_allclose(cost.cores[name].sum(axis=1), whole.sum(axis=1), rtol=1e-12)


def test_a_batch_is_its_recordings_one_by_one(small, found):
    netlist, recordings = small
    for index, length in enumerate(LENGTHS):
        _, alone = estimate(netlist, LOIHI, recordings[index : index + 1, :, :length], detail="cycle")
        for model in ("simple", "detailed"):
            whole, part = (getattr(cost, model)["sanafe"] for cost in (found["cycle"][1], alone))
            steps = length + netlist.max_depth
            np.testing.assert_array_equal(whole.duration_ns[index, :steps], part.duration_ns[0])
            assert not whole.duration_ns[index, steps:].any()


def test_the_detailed_model_takes_at_least_the_work_of_the_busiest_core(found):
    _, cost = found["cycle"]
    simple, detailed = cost.simple["sanafe"].duration_ns, cost.detailed["sanafe"].duration_ns
    assert (detailed >= simple - 1e-6).all()


def test_the_report_says_power_and_pace(small, found):
    netlist, _ = small
    _, cost = found["cycle"]
    report = encode(priced := cost_report(netlist, LOIHI, cost, bin_s=0.02))
    energy, seconds = cost.costs.energy["sanafe"].sum(axis=1), cost.simple["sanafe"].duration_ns.sum(axis=1) * 1e-9
    (entry,) = [e for e in report["pace"]["full_speed"] if (e["energy_table"], e["model"]) == ("sanafe", "simple")]
    assert entry["power_w"] == pytest.approx((energy / seconds).mean())
    assert entry["energy_delay_js"] == pytest.approx((energy * seconds).mean())
    assert report["pace"]["real_time_w"]["sanafe"] == pytest.approx((energy / (LENGTHS * 0.02)).mean())
    assert report["detail"] == "cycle"
    for times in report["time"]:
        assert sum(core["share_of_steps"] for core in times["critical_core"]) == pytest.approx(1)
    assert len(report["cores"]) == netlist.n_cores
    assert sum(core["energy_j"]["sanafe"] for core in report["cores"]) == pytest.approx(energy.mean())
    text = terminal(sections(priced))
    for words in ("time, sanafe, simple model", "time, sanafe, detailed model", "energy by part", "20 ms a step"):
        assert words in text


def test_the_range_names_both_ends(small, found):
    netlist, _ = small
    _, cost = found["counts"]
    report = encode(priced := cost_report(netlist, LOIHI, cost, bin_s=0.02))
    means = {name: energy.sum(axis=1).mean() for name, energy in cost.costs.energy.items()}
    ends = report["energy_range_j"]
    for end, choose in (("low", min), ("high", max)):
        assert ends[end]["energy_j"] == pytest.approx(choose(means.values()))
        assert means[ends[end]["table"]] == pytest.approx(choose(means.values()))
    assert "sources differ: a mean inference takes" in terminal(sections(priced))
    single = dataclasses.replace(cost, costs=dataclasses.replace(cost.costs, energy={"one": cost.costs.zeros}))
    alone = encode(priced := cost_report(netlist, LOIHI, single, bin_s=0.02))
    assert alone["energy_range_j"] is None


def test_a_chip_without_tables(small):
    netlist, recordings = small
    _, cost = estimate(netlist, dataclasses.replace(LOIHI, energy=(), time=()), recordings, detail="cycle")
    report = encode(priced := cost_report(netlist, LOIHI, cost, bin_s=0.02))
    assert (report["time"], report["energy_by_part_j"], report["pace"]["full_speed"]) == ([], {}, [])
    assert "synaptic operations" in terminal(sections(priced))
