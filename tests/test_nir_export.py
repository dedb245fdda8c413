"""NIR files that are written: opened by the package nir, read back, followed by another program."""

import json
from dataclasses import replace

import h5py
import nir
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from made_nir import simulate
from numpy.testing import assert_allclose, assert_array_equal
from random_networks import chain as network_chain
from random_networks import float_networks
from timed_networks import events_of, written

from spikeloom.compiler import compile_network, lift
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.formats.nir import writer as nir_export
from spikeloom.compiler.formats.nir.reader import read_nir
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.runtime.cli import main
from spikeloom.runtime.machines.loihi1 import engine

FEW = settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@FEW
@given(float_networks(betas=(0.0, 0.2, 0.9)))
def test_the_nir_file_alone_has_the_integers_and_the_decays(tmp_path_factory, network):
    path = tmp_path_factory.mktemp("nir") / "net.nir"
    netlist = compile_network(network).netlist
    path.write_bytes(nir_export.export(netlist, 0.02))
    integer = lift(netlist)
    found = read_nir(path, dt=0.02, polarities=network.input.polarities).network
    names = nir_export.node_names(integer)
    assert [population.name for population in found.populations] == list(names)
    for post, (ours, chip) in enumerate(zip(found.populations, integer.populations, strict=True)):
        units = chip.threshold / ours.theta  # thresholds that differ are one threshold in other units
        assert ours.beta == pytest.approx(chip.realised_beta, abs=1e-6)
        assert_allclose(ours.bias * units * 64, chip.bias, rtol=1e-12)
        for pre in {projection.pre for projection in integer.projections if projection.post == post}:
            chips = sum(p.effective().toarray() for p in integer.projections if (p.pre, p.post) == (pre, post))
            read = [p.weight.toarray() for p in found.projections if (p.pre, p.post) == (pre, post)]
            if chips.any():
                assert_allclose(read[0] * units[:, None], chips, rtol=1e-12)
    assert_array_equal(found.readout.label, integer.readout.label)


@pytest.fixture(scope="module")
def timed(tmp_path_factory):
    """A netlist with currents and clocks, and its files."""
    folder = tmp_path_factory.mktemp("timed")
    written(folder / "net.pt")
    words = [str(folder / "net.pt"), "--graph", "manual", "-o", str(folder / "net.loom")]
    assert main(["compile", *words]) == 0
    netlist = read_netlist(folder / "net.loom")
    (folder / "net.nir").write_bytes(nir_export.export(netlist, 0.02))
    return netlist, folder


def test_currents_and_clocks(timed):
    netlist, folder = timed
    graph = nir.read(folder / "net.nir")
    kinds = {name: type(node).__name__ for name, node in graph.nodes.items()}
    assert [kinds[layer.name] for layer in netlist.layers] == ["LIF", "CubaLIF", "CubaLIF", "LIF"]
    assert graph.nodes["input"].input_type["input"].tolist() == [netlist.n_inputs]
    assert graph.metadata["dt"] == 0.02
    assert nir.serialization.read_version(folder / "net.nir") == nir_export.VERSION
    assert all({a, b} <= kinds.keys() for a, b in graph.edges)


def test_another_program_that_follows_nir_makes_nearly_the_same_spikes(timed):
    netlist, folder = timed
    graph = nir.read(folder / "net.nir")
    events = with_clocks(events_of(5, samples=1, steps=60), netlist.clocks)
    chip = engine.simulate(netlist, events, spikes=True)
    theirs = simulate(graph, events[0].T, 0.02)
    for index, layer in enumerate(netlist.layers):
        ids = netlist.compartments_of(index)
        ours = chip.spikes[0][layer.depth : layer.depth + 60, ids]
        other = theirs[layer.name][:, netlist.neuron[ids]]
        assert ours.sum() > 20
        assert (ours != other).mean() <= 0.02  # a register is cut to a whole number in every step


def test_a_membrane_that_keeps_all_is_an_if(tmp_path):
    netlist = compile_network(network_chain(np.full((2, 2), 0.3), beta=1.0)).netlist
    path = tmp_path / "net.nir"
    path.write_bytes(nir_export.export(netlist, 0.02))
    graph = nir.read(path)
    assert [type(node).__name__ for node in graph.nodes.values()].count("IF") == 1
    assert read_nir(path, dt=0.02).network.populations[0].beta == 1


def test_what_nir_cannot_say(timed):
    netlist, _ = timed
    kept = replace(netlist, decay_v=read_only(np.zeros_like(netlist.decay_v)))
    with pytest.raises(ModelError, match="fc1: keeps its whole membrane and has a current that outlasts its step"):
        nir_export.export(kept, 0.02)
    with pytest.raises(OptionError, match="--dt 0: is no time step; give seconds above 0"):
        nir_export.export(netlist, 0.0)


def run(capsys, *words):
    code = main([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_there_and_back_by_the_commands(timed, tmp_path, capsys):
    _, folder = timed
    net, there, again = folder / "net.loom", tmp_path / "x.nir", tmp_path / "again.nir"
    code, out, _ = run(capsys, "export", net, "--to", "nir", "-o", there)
    assert code == 0
    synapses = read_netlist(net).n_synapses
    assert out.startswith(f"{there}: 138 neurons and {synapses} synapses for nir, {there.stat().st_size} bytes\n")
    code, out, _ = run(capsys, "compile", there, "--polarities", "1", "-o", tmp_path / "x.loom")
    assert code == 0
    assert out.startswith("NIR 1.0.8, read in steps of 0.02 s (euler)\n")
    assert run(capsys, "export", net, "--to", "nir", "-o", again)[0] == 0
    assert again.read_bytes() == there.read_bytes()
    _, out, _ = run(capsys, "export", net, "--to", "nir", "-o", again, "--dt", "1e-4", "--json")
    assert json.loads(out)["dt"] == h5py.File(again)["node/metadata/dt"][()] == 1e-4


def test_the_file_says_the_step_to_compare_in(tmp_path, capsys):
    net = tmp_path / "g.loom"
    assert run(capsys, "compile", "pretrained:grasps", "-o", net)[0] == 0
    assert run(capsys, "export", net, "--to", "nir", "-o", tmp_path / "g.nir")[0] == 0
    words = ["verify", net, "--checkpoint", tmp_path / "g.nir", "--data", "synthetic", "--limit", 6]
    _, out, _ = run(capsys, *words)
    assert "E0  specification = engine" in out
    assert "E3  6 of 6 decisions equal" in out


def test_inputs_of_the_exported_network_are_channels(tmp_path):
    netlist = compile_network(network_chain(np.full((2, 4), 0.4), np.full((2, 2), 0.6), polarities=2)).netlist
    (tmp_path / "net.nir").write_bytes(nir_export.export(netlist, 0.02))
    found = read_nir(tmp_path / "net.nir", dt=0.02).network
    assert (found.input.taxels, found.input.polarities) == (2, 2)
    assert [projection.pre for projection in found.projections] == [INPUT, 0]
