"""The command ``export`` and its files; and netlists in SANA-FE itself: the same spikes, energies and times.

SANA-FE is run in an interpreter of its own: the one that SPIKELOOM_SANAFE_PYTHON names, or this one if it has it.
"""

import hashlib
import re
from dataclasses import replace

import timing_oracle
from commands import as_json
from random_netlists import Axon, Neuron, build, six_steps
from random_networks import LOIHI

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.formats.names import plain_names
from spikeloom.compiler.targets.loihi1.netlist import write_netlist


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
