"""Exported netlists in SANA-FE itself: the same spikes, energies and times.

SANA-FE is run in an interpreter of its own: the one that SPIKELOOM_SANAFE_PYTHON names, or this one if it has it.
"""

import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import timing_oracle
from random_netlists import large_netlist, ungated
from test_timing import DETAILED, ENERGY_PJ, LOIHI, SANAFE, SIMPLE, six_steps

from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1 import engine, timing
from spikeloom.runtime.machines.loihi1.costs import cost

PROGRAM = """
import json, sys
import numpy as np
import sanafe

network, given, output = sys.argv[1:]
given = np.load(given)
chip = sanafe.SpikingChip(sanafe.load_loihi())
chip.load(sanafe.load_net(network, sanafe.load_loihi()))
runs = []
for events in given["events"]:
    for model in given["models"]:
        if runs:
            chip.reset()
        for neuron, train in zip(chip.mapped_neuron_groups["input"], events):
            neuron.set_attributes(model_attributes={"spikes": [bool(bit) for bit in train]})
        run = chip.sim(int(given["steps"]), timing_model=str(model), processing_threads=1, spike_trace=True,
                       perf_trace=True)
        runs.append({
            "spikes": [[step, spike.group_name, spike.neuron_offset]
                       for step, row in enumerate(run["spike_trace"]) for spike in row],
            "energy": run["energy"],
            "trace": {name: list(values) for name, values in run["perf_trace"].items()},
        })
with open(output, "w") as file:
    json.dump(runs, file)
"""


@pytest.fixture(scope="session")
def interpreter() -> str:
    """Python that can import sanafe."""
    named = os.environ.get("SPIKELOOM_SANAFE_PYTHON")
    if named is None and importlib.util.find_spec("sanafe") is None:
        pytest.skip("sanafe is not installed here (name a Python that has it with SPIKELOOM_SANAFE_PYTHON)")
    return named or sys.executable


@dataclass(frozen=True, kw_only=True)
class Run:
    """One recording in both programs; times in ns per step, energies in joules per part."""

    spikes: np.ndarray
    expected_spikes: np.ndarray
    simple: np.ndarray
    detailed: np.ndarray
    energy: dict[str, float]
    steps_energy: dict[str, np.ndarray]
    ours_simple: np.ndarray
    ours_detailed: np.ndarray
    ours_energy: dict[str, float]


def compare(python: str, netlist: Netlist, events: np.ndarray, folder: Path) -> list[Run]:
    """Run recordings, (recordings, n_inputs, T), in SANA-FE and here, under its conventions.

    Its channels fire one step before they act, and every layer integrates in each of T + depth + 1 steps.
    """
    steps = events.shape[2] + netlist.max_depth + 1
    (folder / "net.yaml").write_text("\n".join(sanafe.export(netlist, LOIHI)) + "\n", "utf-8")
    np.savez(folder / "given.npz", events=events, steps=steps, models=["simple", "detailed"])
    words = [python, "-c", PROGRAM, *(str(folder / name) for name in ("net.yaml", "given.npz", "runs.json"))]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    theirs = json.loads((folder / "runs.json").read_text("utf-8"))

    shifted = np.zeros((*events.shape[:2], steps), np.uint8)
    shifted[:, :, 1 : events.shape[2] + 1] = events
    trace = engine.simulate(ungated(netlist), shifted, spikes=True, membranes=True)
    updated = timing_oracle.updates(netlist, shifted, trace.spikes, trace.membranes)
    as_priced = {"input_tiles": sanafe.input_tiles(netlist, LOIHI), "dense": timing_oracle.dense_synapses(netlist)}
    latencies = timing.prepare(netlist, LOIHI, SANAFE, **as_priced)
    batch = trace.spikes, updated, shifted
    simple, detailed = timing_oracle.simple(latencies, *batch), timing.detailed(latencies, *batch)
    counts = replace(trace.counts, updates=cost.updates_by_core(netlist, updated))
    meter = cost.prepare(netlist, LOIHI, "core", **as_priced)
    parts = cost.by_part(LOIHI, cost.count(meter, counts, steps))["sanafe"]

    names, number = sanafe.group_names(netlist), netlist.number_in_layer()
    compartment = {(names[netlist.layer[c]], int(number[c])): c for c in range(netlist.n_compartments)}
    runs = []
    for i, (first, second) in enumerate(zip(theirs[::2], theirs[1::2], strict=True)):
        assert first["spikes"] == second["spikes"]
        fired = np.zeros_like(trace.spikes[i])
        for step, group, k in first["spikes"]:
            fired[step, compartment[group, k]] = True
        runs.append(
            Run(
                spikes=fired,
                expected_spikes=trace.spikes[i],
                simple=1e9 * np.array(first["trace"]["sim_time"]),
                detailed=1e9 * np.array(second["trace"]["sim_time"]),
                energy={part: first["energy"][part] for part in cost.PARTS},
                steps_energy={part: np.array(first["trace"][f"{part}_energy"]) for part in cost.PARTS},
                ours_simple=simple.duration_ns[i],
                ours_detailed=detailed.duration_ns[i],
                ours_energy={part: float(joules[i].sum()) for part, joules in parts.items()},
            )
        )
    return runs


def test_the_published_run(interpreter, tmp_path):
    netlist, events, _ = six_steps()
    # its channels were on tile 0, an exported netlist has them beside h0 and h1: no hop north
    (run,) = compare(interpreter, netlist, events[None, :, 1:], tmp_path)
    np.testing.assert_array_equal(run.spikes, run.expected_spikes)
    np.testing.assert_allclose(run.ours_simple, run.simple, rtol=1e-12)
    np.testing.assert_allclose(run.ours_detailed, run.detailed, rtol=1e-12)
    assert run.ours_energy == pytest.approx(run.energy, rel=1e-12)
    assert 1e12 * run.steps_energy["soma"][:6] == pytest.approx(ENERGY_PJ["soma"], abs=0.05)
    assert run.simple[:6] == pytest.approx(SIMPLE, abs=0.05)
    assert run.detailed[2] == pytest.approx(DETAILED[2], abs=0.05)


def test_a_network_of_any_wiring(interpreter, tmp_path):
    netlist = large_netlist(7, proved=True)
    # it keeps currents as floats, and its neurons have no windows
    netlist = replace(netlist, decay_u=read_only(np.full(netlist.n_compartments, 4095)))
    form = np.arange(len(netlist.format_index_bits)) % 2 * 10
    once = np.unique(netlist.axon_source * netlist.n_cores + netlist.core_of_axon(), return_index=True)[1]
    netlist = replace(netlist, format_index_bits=read_only(form), core_tile=read_only([0, 0, 3, 17, 30]))
    netlist = without_second_lists(netlist, once)
    events = (np.random.default_rng(8).random((2, netlist.n_inputs, 40)) < 0.3).astype(np.uint8)
    for run in compare(interpreter, netlist, events, tmp_path):
        np.testing.assert_array_equal(run.spikes, run.expected_spikes)
        assert run.spikes.any()
        np.testing.assert_allclose(run.ours_simple, run.simple, rtol=1e-9)
        assert run.ours_detailed.sum() == pytest.approx(run.detailed.sum(), rel=0.02)
        assert run.ours_energy == pytest.approx(run.energy, rel=1e-9)


def without_second_lists(netlist: Netlist, kept: np.ndarray) -> Netlist:
    """Only these axons: SANA-FE sends one message from a neuron to a core."""
    axons = np.zeros(netlist.n_axons, np.bool_)
    axons[kept] = True
    synapses = axons[netlist.axon_of_synapse()]
    return replace(
        netlist,
        core_axons=read_only(np.append(0, np.cumsum(axons))[netlist.core_axons]),
        axon_source=read_only(netlist.axon_source[axons]),
        axon_format=read_only(netlist.axon_format[axons]),
        axon_synapses=read_only(np.append(0, np.cumsum(np.diff(netlist.axon_synapses)[axons]))),
        synapse_target=read_only(netlist.synapse_target[synapses]),
        synapse_weight=read_only(netlist.synapse_weight[synapses]),
    )
