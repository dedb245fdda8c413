"""The command ``export`` and the files that it writes, without the programs that read them."""

import argparse
import hashlib
import re
from dataclasses import replace

import pytest
import timing_oracle
from random_netlists import Axon, Neuron, build
from test_timing import LOIHI, six_steps

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist
from spikeloom.runtime.commands.exchange import export
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal

SIX_STEPS = """\
# spikeloom netlist for SANA-FE 2.2.9 and its loihi.yaml; give the neurons of group input 'spikes'
network:
  name: spikeloom
  groups:
    - name: input
      attributes: {log_spikes: false}
      neurons:
        - 0: {soma_hw_name: 'loihi_inputs[0]'}
        - 1: {soma_hw_name: 'loihi_inputs[1]'}
    - name: layer0
      attributes: {soma_hw_name: loihi_lif, reset: 0.0, input_decay: 0.0, log_spikes: true}
      neurons:
        - 0: {threshold: 80.0, leak_decay: 0.199951171875, bias: 0.0, synapse_hw_name: loihi_dense_synapse}
        - 1: {threshold: 80.0, leak_decay: 0.199951171875, bias: 0.0, synapse_hw_name: loihi_dense_synapse}
    - name: layer1
      attributes: {soma_hw_name: loihi_lif, reset: 0.0, input_decay: 0.0, log_spikes: true}
      neurons:
        - 0: {threshold: 80.0, leak_decay: 0.199951171875, bias: 0.0, synapse_hw_name: loihi_dense_synapse}
  edges:
    - input -> layer0:
        type: sparse
        source_target_pairs: [[0, 0], [0, 1], [1, 0], [1, 1]]
        weight: [60.0, -30.0, 50.0, 90.0]
    - layer0 -> layer1:
        type: sparse
        source_target_pairs: [[0, 0], [1, 0]]
        weight: [100.0, 70.0]
mappings:
  - input.0..1: {core: '1.1'}
  - layer0.0..1: {core: '1.0'}
  - layer1.0..0: {core: '5.0'}
"""


def run(*words):
    """What the command reports and prints."""
    parser = argparse.ArgumentParser()
    export.add_arguments(parser)
    found = export.run(parser.parse_args([str(word) for word in words]))
    assert found.code == 0
    return encode(found.result), terminal(found.sections(found.result))


def lines(netlist):
    return list(sanafe.export(netlist, LOIHI))


def test_the_whole_file(tmp_path):
    netlist, _, _ = six_steps()
    write_netlist(netlist, tmp_path / "net.loom")
    path = tmp_path / "net.yaml"
    report, _ = run(tmp_path / "net.loom", "--to", "sanafe", "-o", path)
    assert path.read_text("utf-8") == SIX_STEPS
    assert (report["bytes"], report["sha256"]) == (len(SIX_STEPS), hashlib.sha256(SIX_STEPS.encode()).hexdigest())
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
    axons = [Axon(source=0, targets=((0, -254),), exponent=-1), Axon(source=1, targets=((0, 6),), exponent=7)]
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
    layers = tuple(replace(layer, name=name) for layer, name in zip(netlist.layers, ("a.b c", "input"), strict=True))
    assert sanafe.group_names(replace(netlist, layers=layers)) == ("a_b_c", "input_1")
    layers = tuple(replace(layer, name="fc") for layer in netlist.layers)
    assert sanafe.group_names(replace(netlist, layers=layers)) == ("fc_0", "fc_1")


def test_channels_fill_cores_of_their_own():
    netlist = replace(six_steps()[0], taxels=1030)
    text = "\n".join(lines(netlist))
    assert "- 1029: {soma_hw_name: 'loihi_inputs[5]'}" in text
    assert "- input.0..1023: {core: '1.1'}\n  - input.1024..1029: {core: '1.2'}" in text


def test_a_current_that_lasts_is_a_float_there_and_that_is_said(tmp_path):
    netlist, _, _ = six_steps()
    netlist = replace(netlist, decay_u=read_only([4095, 4095, 2047]))
    write_netlist(netlist, tmp_path / "net.loom")
    report, _ = run(tmp_path / "net.loom", "--to", "sanafe", "-o", tmp_path / "net.yaml")
    assert report["floating_currents"] == ["layer1"]
    written = (tmp_path / "net.yaml").read_text("utf-8")
    assert written.count("input_decay: 0.5, ") == 1
    told = "# currents of layer1 outlast a step: floats here, whole 64ths on the chip\n"
    assert written.replace("input_decay: 0.5, ", "").replace(told, "") == SIX_STEPS


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("sanafe --data x", "--data x: is for netx and ranc"),
        ("onnx --recording 0", "--recording 0: is for ranc"),
        ("ranc --limit 1 --data x", "--limit 1: is for netx"),
        ("netx --limit 2", "--limit 2: says which recording of --data"),
        ("nir --form step", "--form step: is for onnx and onnx-float"),
        ("sanafe --dt 1", "--dt 1.0: is for nir"),
        ("sanafe --strict", "--strict: is for netx"),
        ("onnx --directed", "--directed: is for checkpoints, --to onnx takes a netlist"),
        ("onnx --beta 0.5", "--beta 0.5: is for checkpoints"),
    ],
)
def test_options_that_a_format_would_ignore(tmp_path, words, said):
    with pytest.raises(OptionError) as caught:
        run("x.loom", "-o", tmp_path / "x", "--to", *words.split())
    assert str(caught.value).startswith(said)
