"""The command ``export`` and its files; and netlists in SANA-FE itself: the same spikes, energies and times.

SANA-FE is run in an interpreter of its own: the one that SPIKELOOM_SANAFE_PYTHON names, or this one if it has it.
"""

import hashlib
import importlib.util
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import timing_oracle
from commands import as_json
from random_netlists import Axon, Neuron, build, large_netlist, ungated
from test_timing import DETAILED, ENERGY_PJ, LOIHI, PICO, SANAFE, SIMPLE, six_steps

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.formats.names import plain_names
from spikeloom.compiler.targets.loihi1.netlist import Netlist, write_netlist
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost

PROGRAM = Path(__file__).parents[1] / "benchmarks" / "sanafe_file.py"


@pytest.fixture(scope="session")
def interpreter() -> str:
    """Python that can import sanafe."""
    named = os.environ.get("SPIKELOOM_SANAFE_PYTHON")
    if named is None and importlib.util.find_spec("sanafe") is None:
        pytest.skip("sanafe is not installed here (name a Python that has it with SPIKELOOM_SANAFE_PYTHON)")
    return named or sys.executable


def compare(python: str, netlist: Netlist, events: np.ndarray, folder: Path) -> list[SimpleNamespace]:
    """Spikes, times (ns a step) and energies (J a part) of recordings (recordings, n_inputs, T) in SANA-FE and here.

    Its channels fire one step before they act, and every layer integrates in each of T + depth + 1 steps.
    """
    steps = events.shape[2] + netlist.max_depth + 1
    (folder / "net.yaml").write_text("\n".join(sanafe.export(netlist, LOIHI)) + "\n", "utf-8")
    np.savez(folder / "given.npz", events=events, steps=steps, models=["simple", "detailed"])
    words = [python, PROGRAM, *(str(folder / name) for name in ("net.yaml", "given.npz", "runs.json"))]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    theirs = json.loads((folder / "runs.json").read_text("utf-8"))

    shifted = np.zeros((*events.shape[:2], steps), np.uint8)
    shifted[:, :, 1 : events.shape[2] + 1] = events
    trace = engine.simulate(ungated(netlist), shifted, spikes=True, membranes=True)
    updated = timing_oracle.updates(netlist, shifted, trace.spikes, trace.membranes)
    tiles, dense = sanafe.input_tiles(netlist, LOIHI), timing_oracle.dense_synapses(netlist)
    chip = timing_oracle.Chip(netlist, LOIHI, SANAFE, tiles, dense)
    times = [chip.run(*each) for each in zip(trace.spikes, updated, shifted, strict=True)]
    worked = updated.sum(axis=(1, 2))
    parts = timing_oracle.parts_of_energy(netlist, LOIHI, trace.counts, worked, steps, tiles, dense)

    names, number = sanafe.group_names(netlist), netlist.number_in_layer()
    compartment = {(names[netlist.layer[c]], int(number[c])): c for c in range(netlist.n_compartments)}
    runs = []
    for i, (first, second) in enumerate(zip(theirs[::2], theirs[1::2], strict=True)):
        assert first["spikes"] == second["spikes"]
        fired = np.zeros_like(trace.spikes[i])
        for step, group, k in first["spikes"]:
            fired[step, compartment[group, k]] = True
        runs.append(
            SimpleNamespace(
                spikes=fired,
                expected_spikes=trace.spikes[i],
                simple=1e9 * np.array(first["trace"]["sim_time"]),
                detailed=1e9 * np.array(second["trace"]["sim_time"]),
                energy={part: first["energy"][part] for part in cost.PARTS},
                steps_energy={part: np.array(first["trace"][f"{part}_energy"]) for part in cost.PARTS},
                ours_simple=np.array([step.simple for step in times[i]]) / PICO,
                ours_detailed=np.array([step.detailed for step in times[i]]) / PICO,
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


def lines(netlist):
    return list(sanafe.export(netlist, LOIHI))


def test_the_whole_file(tmp_path, golden):
    netlist, _, _ = six_steps()
    write_netlist(netlist, tmp_path / "net.loom")
    path = tmp_path / "net.yaml"
    report = as_json("export", tmp_path / "net.loom", "--to", "sanafe", "-o", path)
    golden("six_steps.yaml", path.read_text("utf-8"))
    assert (report["bytes"], report["sha256"]) == (
        path.stat().st_size,
        hashlib.sha256(path.read_bytes()).hexdigest(),
    )
    assert (report["neurons"], report["synapses"], report["groups"]) == (3, 6, ["input", "layer0", "layer1"])


def test_neurons_are_mapped_in_the_order_of_their_compartments():
    neurons = [Neuron(layer=layer) for layer in (0, 1, 0, 0)] + [Neuron(core=1)]
    netlist = build(neurons, [Axon(source=0, targets=((0, 2),))], n_inputs=1, depths=[0, 1])
    netlist = replace(netlist, neuron=read_only([5, 0, 9, 7, 8]), core_tile=read_only([31, 31]))
    assert netlist.number_in_layer().tolist() == [0, 0, 3, 1, 2]
    mapped = lines(netlist)[lines(netlist).index("mappings:") + 1 :]
    assert mapped == [
        "  - input.0..0: {core: '31.2'}",
        "  - layer0.0..0: {core: '31.0'}",
        "  - layer1.0..0: {core: '31.0'}",
        "  - layer0.3..3: {core: '31.0'}",
        "  - layer0.1..1: {core: '31.0'}",
        "  - layer0.2..2: {core: '31.1'}",
    ]


def test_parameters_and_weights_are_exact():
    neuron = Neuron(threshold=131071, decay_v=0, bias=-4095, bias_exponent=7)
    axons = [
        Axon(source=0, targets=((0, -254),), exponent=-1),
        Axon(source=1, targets=((0, 6),), exponent=7),
    ]
    text = "\n".join(lines(build([neuron, Neuron(bias=1)], axons, n_inputs=2, depths=[0])))
    assert "- 0: {threshold: 131071.0, leak_decay: 1.0, bias: -8190.0, " in text
    assert f"bias: {1 / 64}, " in text
    assert "weight: [-127.0, 768.0]" in text


def test_a_neuron_names_the_unit_of_most_of_its_synapses():
    axons = [Axon(source=i, targets=((0, 2), (1, 2)), exponent=i) for i in range(3)]
    netlist = build([Neuron(), Neuron()], axons, n_inputs=3, depths=[0])
    netlist = replace(netlist, format_index_bits=read_only([0, 10, 10]))
    assert len(re.findall("loihi_sparse_synapse", "\n".join(lines(netlist)))) == 2
    assert not timing_oracle.dense_synapses(netlist).any()
    netlist = replace(netlist, format_index_bits=read_only([0, 0, 10]))
    assert len(re.findall("loihi_dense_synapse", "\n".join(lines(netlist)))) == 2
    assert timing_oracle.dense_synapses(netlist).all()


def test_names_are_such_that_the_format_can_hold_them():
    netlist, _, _ = six_steps()
    layers = tuple(
        replace(layer, name=name) for layer, name in zip(netlist.layers, ("a.b c", "input"), strict=True)
    )
    assert sanafe.group_names(replace(netlist, layers=layers)) == ("a_b_c", "input_1")
    layers = tuple(replace(layer, name="fc") for layer in netlist.layers)
    assert sanafe.group_names(replace(netlist, layers=layers)) == ("fc_0", "fc_1")
    assert plain_names(["a_1", "a.b", "a_b", "a_b_1"]) == ("a_1", "a_b_1_", "a_b_2", "a_b_1")
    layers = [replace(layer, name=name) for layer, name in zip(netlist.layers, ("1", "null"), strict=False)]
    named = [line.strip() for line in lines(replace(netlist, layers=tuple(layers))) if "- name: '" in line]
    assert named == ["- name: '1'", "- name: 'null'"], "quoted, or they are no words"


def test_channels_fill_cores_of_their_own():
    netlist = replace(six_steps()[0], taxels=1030)
    text = "\n".join(lines(netlist))
    assert "- 1029: {soma_hw_name: 'loihi_inputs[5]'}" in text
    assert "- input.0..1023: {core: '1.1'}\n  - input.1024..1029: {core: '1.2'}" in text


def test_a_current_that_lasts_is_a_float_there_and_that_is_said(tmp_path, golden):
    netlist, _, _ = six_steps()
    netlist = replace(netlist, decay_u=read_only([4095, 4095, 2047]))
    write_netlist(netlist, tmp_path / "net.loom")
    report = as_json("export", tmp_path / "net.loom", "--to", "sanafe", "-o", tmp_path / "net.yaml")
    assert report["floating_currents"] == ["layer1"]
    written = (tmp_path / "net.yaml").read_text("utf-8")
    assert written.count("input_decay: 0.5, ") == 1
    told = "# currents of layer1 outlast a step: floats here, whole 64ths on the chip\n"
    golden("six_steps.yaml", written.replace("input_decay: 0.5, ", "").replace(told, ""))
