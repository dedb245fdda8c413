"""Networks read from ONNX files: every spelling of a neuron, round trips of torch modules, the released network."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from made_modules import NETS, AllSteps, example_of, exported, one_step
from made_onnx import (
    BIAS,
    FIRES,
    SECOND,
    STAGE,
    STATE_IN,
    WEIGHTS,
    fire,
    looped,
    model,
    neuron,
    node,
    scanned,
    two_layers,
)
from oracles import weight_differences

from spikeloom.compiler import Options, Packing, compile_network, lift
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.onnx.reader import read_onnx
from spikeloom.compiler.sensor_layout import sensor_layout
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.networks.module import compile_module, module_network
from spikeloom.runtime import cli

needs_dynamo = pytest.mark.skipif(
    importlib.util.find_spec("onnxscript") is None, reason="torch's newer exporter needs onnxscript"
)


@pytest.fixture
def read(tmp_path):
    def from_bytes(content, **options):
        path = tmp_path / "net.onnx"
        path.write_bytes(content)
        return read_onnx(path, **options)

    return from_bytes


def require_the_two_layers(network, theta=0.5):
    """The network that all hand-written graphs spell."""
    assert [(p.size, p.beta, p.theta) for p in network.populations] == [(3, 0.2, theta), (2, 0.2, theta)]
    first, second = network.projections
    assert np.array_equal(first.weight.toarray(), WEIGHTS.astype(float))
    assert np.array_equal(second.weight.toarray(), SECOND.astype(float))
    assert np.array_equal(network.populations[0].bias, BIAS.astype(float))
    assert not network.populations[1].bias.any()
    assert (network.classes, network.readout.population, network.readout.label.tolist()) == (2, 1, [0, 1])


@pytest.mark.parametrize("spelling", ["product", "difference", "where", "less", "truth", "after"])
def test_every_spelling_of_the_reset(read, spelling):
    found = read(two_layers(spelling))
    require_the_two_layers(found.network)
    assert found.steps == 1


@pytest.mark.parametrize("kind", FIRES)
def test_every_spelling_of_the_spike(read, kind):
    nodes = [*STAGE, *neuron(0, "current")[:-2], *fire(kind, "u0_new", "s0_new")]
    network = read(model(nodes, [("x", [1, 4]), *STATE_IN[:2]], ["s0_new", "u0_new"])).network
    assert [(p.size, p.beta, p.theta) for p in network.populations] == [(3, 0.2, 0.5)]
    assert np.array_equal(network.projections[0].weight.toarray(), WEIGHTS.astype(float))


def test_at_the_threshold_is_the_next_number_below(read):
    nodes = [*STAGE, *neuron(0, "current")[:-2]]
    nodes += [node("GreaterOrEqual", "u0_new theta", "hot"), node("Cast", "hot", "s0_new", to=1)]
    found = read(model(nodes, [("x", [1, 4]), *STATE_IN[:2]], ["s0_new", "u0_new"]))
    (population,) = found.network.populations
    below = float(np.nextafter(np.float32(0.5), np.float32(0)))
    assert population.theta == below
    assert any("fires at u >= 0.5" in fact and "the next number below" in fact for fact in found.facts)
    # in float32, the arithmetic of the file, every membrane is decided as the file decides it
    for membrane in (0.5, below, np.nextafter(np.float32(0.5), np.float32(1))):
        assert (np.float32(membrane) >= np.float32(0.5)) == (np.float32(membrane) > np.float32(population.theta))


@pytest.mark.parametrize("content", [scanned(), looped(), scanned(1 + 2), looped(7)])
def test_loops_are_unrolled(read, content):
    found = read(content)
    require_the_two_layers(found.network)
    assert found.steps > 1


@pytest.mark.parametrize(
    ("last", "inputs", "label"),
    [
        (node("Add", "count s0_new", "classes"), [("count", [1, 3])], [0, 1, 2]),  # a running count
        (node("MatMul", "s0_new votes", "classes"), [], [0, 1, 0]),
    ],
)
def test_how_spikes_are_counted(read, last, inputs, label):
    votes = {"votes": np.array([[1, 0], [0, 1], [1, 0]], np.float32)}
    nodes, outputs = [*STAGE, *neuron(0, "current"), last], ["classes", "u0_new", "s0_new"]
    network = read(model(nodes, [("x", [1, 4]), *STATE_IN[:2], *inputs], outputs, votes)).network
    assert network.readout.label.tolist() == label
    assert network.classes == max(label) + 1


@pytest.mark.parametrize(
    ("name", "opset"), [("tag", 11), ("grid", 13), ("mlp", 17), ("gcn", 17), ("chebyshev", 20), ("averaged", 20)]
)
def test_modules_come_back_with_the_same_integers(read, name, opset):
    """One step, and all steps."""
    net, example = NETS[name](), example_of(name)
    ours = module_network(net, example)
    step = read(one_step(net, example, opset_version=opset))
    several = read(exported(AllSteps(net), (torch.zeros(*example.shape, 5),)))
    assert (step.steps, several.steps) == (1, 5)
    options = Options(packings=(Packing(bits=6),))
    integers = [compile_network(network, options).integer for network in (ours, step.network, several.network)]
    assert not any(weight_differences(integers[0], found) for found in integers[1:])
    # torch's exporter folds a batch norm into the convolution before it, in float32
    error = 1e-7 if name == "grid" else 1e-14
    for a, b in zip(ours.populations, step.network.populations, strict=True):
        assert (a.beta, a.theta) == (b.beta, b.theta)
        assert np.abs(a.bias - b.bias).max() < error
    for a, b in zip(ours.projections, step.network.projections, strict=True):
        assert abs(a.weight - b.weight).max() < error


@needs_dynamo
@pytest.mark.parametrize("name", [*NETS])
def test_the_newer_exporter(read, name):
    net, example = NETS[name](), example_of(name)
    ours = compile_module(net, example).integer
    one = read(one_step(net, example, dynamo=True))
    several = read(exported(AllSteps(net), (torch.zeros(*example.shape, 3),), dynamo=True))
    assert (one.steps, several.steps) == (1, 3)
    for found in (one, several):
        assert not weight_differences(ours, compile_network(found.network).integer)


def test_layers_are_called_as_the_modules_are(read):
    class Named(torch.nn.Module):
        def __init__(self, inner):
            super().__init__()
            self.conv1, self.lif1, _, self.fc1, self.lif2, self.fc2, self.lif3 = inner

        def forward(self, x):
            x = self.lif1(self.conv1(x)).flatten(1)
            return self.lif3(self.fc2(self.lif2(self.fc1(x))))

    found = read(one_step(Named(NETS["tag"]()), example_of("tag"))).network
    assert [population.name for population in found.populations] == ["conv1", "fc1", "fc2"]


def test_open_size_in_front_is_one_recording(read):
    net, example = NETS["mlp"](), example_of("mlp")
    axes = {"input": {0: "batch"}}
    found = read(one_step(net, example, input_names=["input"], dynamic_axes=axes))
    assert "the open size 'batch' is the batch's, read as 1" in found.facts
    assert not weight_differences(compile_module(net, example).integer, compile_network(found.network).integer)


def test_open_time_of_a_loop_is_run_for_three_steps(read):
    count = [node("Cast", "spikes", "whole", to=6), node("ReduceSum", "whole axes", "votes", keepdims=0)]
    found = read(scanned("time", [*count, node("ArgMax", "votes", "class", axis=1)]))
    require_the_two_layers(found.network)
    assert found.steps == 3
    assert found.facts[:2] == (
        "output class: the class of the largest of votes",
        "the open size 'time' is time, read as 3 steps",
    )


@pytest.mark.parametrize(
    ("shape", "options", "expected"),
    [
        ([39, 2], {}, (39, 2, "[taxels, polarities]")),
        ([2, 39], {}, (39, 2, "[polarities, taxels]")),
        ([39, 1], {}, (39, 1, "[taxels, polarities]")),
        ([39, 3], {"polarities": 3}, (39, 3, "[taxels, polarities]")),
        ([2, 2], {"polarities_first": True}, (2, 2, "[polarities, taxels]")),
        ([78], {}, (39, 2, "flat, channel = taxel * polarities + polarity; 2 polarities are assumed")),
        ([1, 39], {"polarities": 1}, (39, 1, "flat, channel = taxel * polarities + polarity")),
        ([78], {"polarities": 2, "polarities_first": True}, (39, 2, "flat, polarity by polarity")),
        ([2, 4, 5], {}, (20, 2, "[polarities, height, width], taxels row by row")),
        ([1, 1, 4, 5], {}, (20, 1, "[polarities, height, width], taxels row by row")),
        ([4, 5, 2], {}, (20, 2, "[height, width, polarities], taxels row by row")),
    ],
)
def test_shapes_of_inputs(shape, options, expected):
    sensor, positions, words = sensor_layout(shape, **options)
    taxels, polarities, spelled = expected
    assert (sensor.taxels, sensor.polarities) == (taxels, polarities)
    assert words == f"{taxels} taxels, {polarities} polarities, as {spelled}"
    turned = "[polarities" in spelled or "polarity by polarity" in spelled
    flat = np.arange(taxels * polarities)
    assert positions.tolist() == (flat.reshape(polarities, taxels).T.ravel() if turned else flat).tolist()


@pytest.mark.parametrize(
    ("shape", "options", "words"),
    [
        ([39, 5], {}, "the input [39, 5]: no axis is the polarities"),
        ([2, 2], {}, "the input [2, 2]: both axes could be the polarities"),
        ([77], {}, "the input [77] is no whole number of taxels with 2 polarities"),
        ([3, 4, 5], {}, "the input [3, 4, 5] has no axis of 2 polarities"),
        ([2, 3, 4, 5], {}, "the input [2, 3, 4, 5] is none of [taxels, polarities]"),
        ([39, 2], {"polarities": 0}, "--polarities 0: allowed are numbers from 1"),
    ],
)
def test_shapes_that_do_not_tell(shape, options, words):
    with pytest.raises(OptionError if options else ModelError) as caught:
        sensor_layout(shape, **options)
    assert words in str(caught.value)


def test_dropout_passes_on_what_it_gets(read):
    nodes = [*STAGE, node("Dropout", "current one", "kept mask"), *neuron(0, "kept")]
    nodes += [node("MatMul", "s0_new w2", "more"), *neuron(1, "more")]
    content = model(nodes, [("x", [1, 4]), *STATE_IN], ["s1_new", "u0_new", "s0_new", "u1_new"])
    require_the_two_layers(read(content).network)


@pytest.mark.recordings
def test_the_released_network_by_torch_geometric(released_checkpoint, tmp_path):
    """Its ONNX files, written by the released code, compile to the integers of its checkpoint, weight by weight."""
    code = os.environ.get("SPIKELOOM_RELEASED_CODE")
    if code is None or importlib.util.find_spec("torch_geometric") is None:
        pytest.skip("needs torch_geometric, and SPIKELOOM_RELEASED_CODE as the folder of the released code")
    script = Path(__file__).parents[1] / "benchmarks" / "released_onnx.py"
    subprocess.run([sys.executable, str(script), code, str(released_checkpoint), str(tmp_path)], check=True)
    words = ["compile", str(released_checkpoint), "--graph", "manual", "-o", str(tmp_path / "t7.loom"), "--json"]
    assert cli.main(words) == 0
    for path in sorted(tmp_path.glob("*.onnx")):
        found = compile_network(read_onnx(path).network).netlist
        assert not weight_differences(lift(read_netlist(tmp_path / "t7.loom")), lift(found)), path.name
