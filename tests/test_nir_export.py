"""NIR files that are written: opened by the package nir, read back, and netlists restored from their side-cars."""

import hashlib
import json
from dataclasses import replace

import h5py
import nir
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_nir import simulate
from numpy.testing import assert_allclose, assert_array_equal
from random_networks import float_networks
from timed_networks import events_of, written

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import FormatError, ModelError, OptionError
from spikeloom.compiler.formats.nir import writer as nir_export
from spikeloom.compiler.formats.nir.neurons import CONVENTIONS
from spikeloom.compiler.formats.nir.reader import read_nir
from spikeloom.compiler.formats.nir.sidecar import restore, sidecar_bytes, sidecar_of
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.targets.loihi1.compilation import compile_network
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import read_only
from spikeloom.compiler.targets.loihi1.netlist_file import netlist_bytes, read_netlist, write_netlist
from spikeloom.runtime.cli import main
from spikeloom.runtime.machines.loihi1 import engine

FEW = settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
SETTINGS = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def store(netlist, path, dt=0.02):
    """Both files, without the command."""
    content = nir_export.export(netlist, dt)
    path.write_bytes(content)
    sidecar_of(path).write_bytes(sidecar_bytes(netlist, content, dt=dt, convention="euler"))


@SETTINGS
@given(float_networks(), st.sampled_from([1e-4, 0.02, 1.0]))
def test_any_netlist_comes_back_to_the_last_byte(tmp_path_factory, network, dt):
    path = tmp_path_factory.mktemp("nir") / "net.nir"
    netlist = compile_network(network).netlist
    store(netlist, path, dt)
    assert netlist_bytes(restore(path, CONVENTIONS)) == netlist_bytes(netlist)


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
    store(netlist, folder / "net.nir")
    return netlist, folder


def test_currents_and_clocks(timed):
    netlist, folder = timed
    graph = nir.read(folder / "net.nir")
    kinds = {name: type(node).__name__ for name, node in graph.nodes.items()}
    assert [kinds[layer.name] for layer in netlist.layers] == ["LIF", "CubaLIF", "CubaLIF", "LIF"]
    assert graph.nodes["input"].input_type["input"].tolist() == [netlist.n_inputs]
    assert netlist_bytes(restore(folder / "net.nir", CONVENTIONS)) == netlist_bytes(netlist)


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


def test_what_the_package_nir_reads(timed):
    _, folder = timed
    graph = nir.read(folder / "net.nir")
    assert graph.metadata["dt"] == 0.02
    assert nir.serialization.read_version(folder / "net.nir") == nir_export.VERSION
    names = set(graph.nodes)
    assert all({a, b} <= names for a, b in graph.edges)


def test_a_membrane_that_keeps_all_is_an_if(tmp_path):
    from random_networks import chain as network_chain

    netlist = compile_network(network_chain(np.full((2, 2), 0.3), beta=1.0)).netlist
    path = tmp_path / "net.nir"
    path.write_bytes(nir_export.export(netlist, 0.02))
    graph = nir.read(path)
    assert [type(node).__name__ for node in graph.nodes.values()].count("IF") == 1
    assert read_nir(path, dt=0.02).network.populations[0].beta == 1


def test_what_nir_cannot_say(timed):
    netlist, _ = timed
    kept = replace(netlist, decay_v=read_only(np.zeros_like(netlist.decay_v)))
    with pytest.raises(ModelError) as caught:
        nir_export.export(kept, 0.02)
    assert str(caught.value) == (
        "fc1: keeps its whole membrane and has a current that outlasts its step, NIR's CubaLIF always leaks; train "
        "with a decay below 1"
    )
    with pytest.raises(OptionError) as caught:
        nir_export.export(netlist, 0.0)
    assert str(caught.value) == "--dt 0: is no time step; give seconds above 0"


def run(capsys, *words):
    code = main([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_there_and_back_by_the_commands(timed, tmp_path, capsys):
    _, folder = timed
    code, out, _ = run(capsys, "export", folder / "net.loom", "--to", "nir", "-o", tmp_path / "x.nir")
    assert code == 0
    size = (tmp_path / "x.nir").stat().st_size
    assert out == (
        f"{tmp_path}/x.nir: 138 neurons and {read_netlist(folder / 'net.loom').n_synapses} synapses for nir, {size} "
        f"bytes\nin steps of 0.02 s (euler); all of the netlist: {tmp_path}/x.nir.json\n"
    )
    code, out, _ = run(capsys, "compile", tmp_path / "x.nir", "-o", tmp_path / "x.loom")
    assert code == 0
    assert out.startswith(f"restored from {tmp_path}/x.nir.json: the netlist as it was\n")
    assert (tmp_path / "x.loom").read_bytes() == (folder / "net.loom").read_bytes()
    again = tmp_path / "again.nir"
    assert run(capsys, "export", folder / "net.loom", "--to", "nir", "-o", again)[0] == 0
    assert again.read_bytes() == (tmp_path / "x.nir").read_bytes()
    assert sidecar_of(again).read_bytes() == sidecar_of(tmp_path / "x.nir").read_bytes()
    code, out, _ = run(capsys, "export", folder / "net.loom", "--to", "nir", "-o", again, "--dt", "1e-4", "--json")
    assert json.loads(out)["dt"] == 1e-4
    assert h5py.File(again)["node/metadata/dt"][()] == 1e-4


def test_options_that_a_restored_netlist_has_no_use_for(timed, tmp_path, capsys):
    _, folder = timed
    place = folder / "net.nir"
    for words, name in ((["--weight-bits", "4"], "weight-bits"), (["--cores-for", "fc1=2"], "cores-for")):
        code, _, said = run(capsys, "compile", place, *words, "-o", tmp_path / "x.loom")
        assert (code, said) == (
            2,
            f"spikeloom: --{name}: {place}.json restores the netlist as it was; leave it away, or add --dt SECONDS to "
            "compile the network anew\n",
        )
    code, out, _ = run(capsys, "compile", place, "--dt", "0.02", "--polarities", "1", "-o", tmp_path / "x.loom")
    assert code == 0
    assert out.startswith("NIR 1.0.8, read in steps of 0.02 s (euler)\n")


def test_the_side_car_tells_the_step_to_compare_in(tmp_path, capsys):
    net = tmp_path / "g.loom"
    assert run(capsys, "compile", "pretrained:grasps", "-o", net)[0] == 0
    assert run(capsys, "export", net, "--to", "nir", "-o", tmp_path / "g.nir")[0] == 0
    words = ["verify", net, "--checkpoint", tmp_path / "g.nir", "--data", "synthetic", "--limit", 6]
    code, out, _ = run(capsys, *words, "--require", "E0,E3=0.8")
    assert code == 0
    assert "E0  specification = engine" in out


def broken(timed, tmp_path, change, *, text=None):
    """The message about a side-car after a change."""
    _, folder = timed
    place = tmp_path / "x.nir"
    place.write_bytes((folder / "net.nir").read_bytes())
    values = json.loads(sidecar_of(folder / "net.nir").read_bytes())
    change(values)
    sidecar_of(place).write_text(json.dumps(values) if text is None else text)
    with pytest.raises(FormatError) as caught:
        restore(place, CONVENTIONS)
    return str(caught.value).removeprefix(f"{place}.json: ")


REMEDY = "remove it to read the NIR file alone, or export it again"


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda v: v.update(format="x"), f"is no side-car of a NIR file; {REMEDY}"),
        (lambda v: v.update(version=2), "has version 2, this program reads 1; update spikeloom"),
        (lambda v: v.update(dt=0), f"has no usable time step, convention or hash; {REMEDY}"),
        (lambda v: v.update(convention="heun"), f"has no usable time step, convention or hash; {REMEDY}"),
        (
            lambda v: v.update(nir_sha256="0" * 64),
            f"belongs to another x.nir (its hash differs, so it was changed); {REMEDY}",
        ),
        (lambda v: v["arrays"].pop("scale"), f"has missing or unknown arrays; {REMEDY}"),
        (lambda v: v["arrays"].update(threshold=[1.5]), f"threshold is no list of numbers; {REMEDY}"),
        (lambda v: v["arrays"].update(threshold=[[1]]), f"threshold is no list of numbers; {REMEDY}"),
        (
            lambda v: v["arrays"].update(threshold=[10**30]),
            f"threshold has numbers that no register holds; {REMEDY}",
        ),
        (
            lambda v: v["arrays"]["threshold"].pop(),
            "threshold has 137 entries for 138 compartments; compile it again",
        ),
        (lambda v: v.update(manifest=None), "is not a netlist; write one with spikeloom compile"),
        (
            lambda v: v["arrays"]["synapse_weight"].__setitem__(0, 2),
            f"its content does not match its hash, so it was altered; {REMEDY}",
        ),
        (lambda v: v.update(loom_sha256=hashlib.sha256(b"").hexdigest()), None),
    ],
)
def test_side_cars_that_cannot_be_used(timed, tmp_path, change, line):
    line = line or f"its content does not match its hash, so it was altered; {REMEDY}"
    assert broken(timed, tmp_path, change) == line


@pytest.mark.parametrize("text", ["", "{", "[1,", "[" * 100_000, "nan", '"text"', "7"])
def test_side_cars_that_are_no_json(timed, tmp_path, text):
    line = "is no side-car of a NIR file" if text in ('"text"', "7") else "is truncated or no JSON"
    assert broken(timed, tmp_path, lambda _: None, text=text) == f"{line}; {REMEDY}"


def test_inputs_of_the_exported_network_are_channels(tmp_path):
    from random_networks import chain as network_chain

    netlist = compile_network(network_chain(np.full((2, 4), 0.4), np.full((2, 2), 0.6), polarities=2)).netlist
    path = tmp_path / "net.nir"
    write_netlist(netlist, tmp_path / "net.loom")
    path.write_bytes(nir_export.export(netlist, 0.02))
    found = read_nir(path, dt=0.02).network
    assert (found.input.taxels, found.input.polarities) == (2, 2)
    assert [projection.pre for projection in found.projections] == [INPUT, 0]
