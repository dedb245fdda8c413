"""onnxruntime on the integer graph: every spike and membrane of the specification."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from made_files import own_file, recordings_folder
from random_netlists import Axon, Neuron, build, large_netlist, netlists, recordings
from test_timing import six_steps

from spikeloom.compiler.errors import DataError, NumericRangeError, OptionError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.formats.onnx import builder, writer_layers
from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.runtime import cli
from spikeloom.runtime.machines.loihi1 import engine, onnx_engine, spec

FORMS = onnx_writer.FORMS
SETTINGS = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def by_onnx(netlist, events, form, **options):
    return onnx_engine.simulate(onnx_engine.prepare(netlist, form=form), events, **options)


def left(trace):
    """Membranes after the reset."""
    return np.where(trace.spikes, 0, trace.membranes)


def assert_as_specified(netlist, events):
    """Both forms do what the specification does on one recording, or stop where it stops."""
    try:
        expected = spec.simulate(netlist, events)
    except NumericRangeError:
        for form in FORMS:
            with pytest.raises(NumericRangeError, match="a register overflows"):
                by_onnx(netlist, events[None], form)
        return
    steps = by_onnx(netlist, events[None], "step", membranes=True)
    np.testing.assert_array_equal(steps.spikes[0], expected.spikes)
    np.testing.assert_array_equal(steps.membranes[0], left(expected))
    scan = by_onnx(netlist, events[None], "scan")
    np.testing.assert_array_equal(scan.spikes[0], expected.spikes)
    votes = [expected.counts.spikes[netlist.readout_class == label].sum() for label in range(netlist.classes)]
    assert scan.votes[0].tolist() == steps.votes[0].tolist() == votes


@SETTINGS
@given(st.data())
def test_random_networks_are_the_specification(data):
    netlist = data.draw(netlists())
    labels = data.draw(st.lists(st.integers(-1, 2), min_size=netlist.n_compartments, max_size=netlist.n_compartments))
    netlist = replace(netlist, classes=3, readout_class=read_only(labels))
    assert_as_specified(netlist, data.draw(recordings(netlist)))


@st.composite
def pipelines(draw):
    """Networks in which each layer hears the one before it only, on two cores, with registers in range."""
    sizes = draw(st.lists(st.integers(1, 6), min_size=1, max_size=3))
    n_inputs = draw(st.integers(1, 4))
    weight = st.integers(-127, 127).map(lambda half: 2 * half)
    neurons, axons, before = [], [], range(n_inputs)
    for layer, size in enumerate(sizes):
        core = layer % 2
        first = sum(neuron.core == core for neuron in neurons)
        neuron = st.builds(
            Neuron,
            layer=st.just(layer),
            core=st.just(core),
            decay_u=st.sampled_from([4095, 4095, 2048]),
            decay_v=st.sampled_from([3277, 3277, 100, 4095]),
            threshold=st.sampled_from([0, 1, 60, 254, 2000]),
            bias=st.sampled_from([0, -300, 64, 4095]),
            bias_exponent=st.sampled_from([0, 0, 7]),
        )
        neurons += draw(st.lists(neuron, min_size=size, max_size=size))
        for source in before:
            targets = tuple((first + i, draw(weight)) for i in range(size))
            axons.append(Axon(source=source, core=core, targets=targets, exponent=draw(st.sampled_from([-1, 0, 3]))))
        axons.append(Axon(source=before[0], core=core, targets=((first, 2),)))
        before = [(layer, i) for i in range(size)]
    # compartments are numbered core after core
    order = [i for core in (0, 1) for i, neuron in enumerate(neurons) if neuron.core == core]
    ids = {}
    for place, i in enumerate(order):
        layer = neurons[i].layer
        ids[layer, sum(neuron.layer == layer for neuron in neurons[:i])] = n_inputs + place
    axons = [replace(axon, source=ids.get(axon.source, axon.source)) for axon in axons]
    return build(neurons, axons, n_inputs=n_inputs, depths=list(range(len(sizes))))


@SETTINGS
@given(st.data())
def test_random_pipelines_are_the_specification(data):
    netlist = data.draw(pipelines())
    layers = writer_layers.plan(netlist)
    assert not any(layer.checked for layer in layers)
    assume(writer_layers.is_pipeline(netlist, layers))  # weights may cancel in the one synapse of a layer
    assert b"chip/" not in onnx_writer.export(netlist, "scan")
    wide = data.draw(st.sampled_from([1, onnx_writer.WIDE]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_writer, "WIDE", wide)
        assert_as_specified(netlist, data.draw(recordings(netlist)))


@pytest.mark.parametrize("proved", [True, False])
def test_a_large_network_is_the_engine(proved):
    netlist = large_netlist(3, proved=proved)
    events = (np.random.default_rng(4).random((5, netlist.n_inputs, 30)) < 0.05).astype(np.uint8)
    lengths = np.array([30, 12, 30, 0, 12])
    try:
        expected = engine.simulate(netlist, events, lengths=lengths, spikes=True)
    except NumericRangeError:
        assert not proved
        with pytest.raises(NumericRangeError):
            by_onnx(netlist, events, "scan", lengths=lengths)
        return
    for form in FORMS:
        done = []
        found = by_onnx(netlist, events, form, lengths=lengths, batch=2, progress=done.append)
        np.testing.assert_array_equal(found.spikes, expected.spikes)
        assert done == [2, 4]


def three_neurons():
    """A netlist by hand: two neurons that hear both inputs, one that hears these and votes for class 1."""
    netlist, _, _ = six_steps()
    return replace(netlist, bias_mantissa=read_only([0, -7, 0]), classes=2, readout_class=read_only([-1, -1, 1]))


def test_a_run_by_hand():
    # neuron 0: 60 + 50 = 110 > 80 spikes, then 60, 60 * 819/4096 + 50 = 61; neuron 1: 60, then -30 ..., 90 spikes
    events = np.array([[[1, 1, 0], [1, 0, 1]]], np.uint8)
    for form in FORMS:
        found = by_onnx(three_neurons(), events, form, membranes=form == "step")
        assert found.spikes[0].astype(int).tolist() == [[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0]]
        assert found.votes.tolist() == [[0, 1]]
        if found.membranes is not None:
            assert found.membranes[0, :2, :2].tolist() == [[0, 3833], [3840, -1161]]
            assert found.membranes[0, 3].tolist() == [0, 0, 4480]


def test_votes_of_several_layers_add_up():
    netlist = three_neurons()
    netlist = replace(netlist, readout_class=read_only([1, 0, 1]))
    events = np.array([[[1, 0, 1, 0], [1, 1, 1, 1]]], np.uint8)
    expected = engine.simulate(netlist, events).counts.spikes[0]
    assert expected.min() > 0
    for form in FORMS:
        assert by_onnx(netlist, events, form).votes.tolist() == [[expected[1], expected[0] + expected[2]]]


def test_recordings_of_another_sensor():
    with pytest.raises(DataError, match="3 input channels found, the netlist has 2"):
        onnx_engine.simulate(onnx_engine.prepare(three_neurons()), np.zeros((1, 3, 4), np.uint8))


@pytest.mark.parametrize(("form", "where"), [("step", "recording 1, chip step 2"), ("scan", "recording 1")])
def test_a_register_that_overflows(form, where):
    axons = [Axon(source=0, targets=((0, 254),), exponent=7), Axon(source=1, targets=((0, 254),), exponent=7)]
    netlist = build([Neuron()], axons, n_inputs=2, depths=[0])
    events = np.zeros((2, 2, 4), np.uint8)
    events[:, 0, 1] = 1
    assert by_onnx(netlist, events, form).spikes[:, :, 0].tolist() == [[False, True, False, False]] * 2
    events[1, :, 2] = 1
    with pytest.raises(NumericRangeError) as caught:
        by_onnx(netlist, events, form)
    assert f"{where}: a register overflows" in str(caught.value)


def test_without_onnx_itself(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(OptionError, match="onnx: the package is not installed; install it with pip install onnx"):
        onnx_engine.prepare(three_neurons())


# -- verify ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def verified(tmp_path, monkeypatch):
    """Words of a verify command on a small network."""
    own_file(tmp_path / "net.pt")
    recordings_folder(tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["compile", "net.pt", "-o", "net.loom"]) == 0
    return ["verify", "net.loom", "--checkpoint", "net.pt", "--data", "data", "--min-agreement", "0"]


def test_verify_tells_which_engine(verified, capsys):
    found = {}
    for name in ("spikeloom", "onnx"):
        capsys.readouterr()
        assert cli.main([*verified, "--engine", name, "--json"]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    assert [(report["engine"], report["engine_different"]) for report in found.values()] == [
        ("spikeloom", None),
        ("onnx", 0),
    ]
    assert found["onnx"]["spec_equals_engine"]
    said = found["onnx"]["levels"][0]["text"]
    assert said == (
        found["spikeloom"]["levels"][0]["text"]
        + f"; onnx beside it, 0 differing spikes on {found['onnx']['samples']} recordings"
    )
    for report in found.values():
        for key in ("engine", "engine_different", "levels"):
            del report[key]
    assert found["onnx"] == found["spikeloom"]


@pytest.mark.parametrize("form", FORMS)
def test_verify_finds_an_engine_that_strays(verified, form, monkeypatch, capsys):
    plain = onnx_engine.simulate

    def stray(prepared, *words, **options):
        trace = plain(prepared, *words, **options)
        if prepared.form == form:
            trace.spikes[0, 5, 0] ^= True
        return trace

    monkeypatch.setattr(onnx_engine, "simulate", stray)
    capsys.readouterr()
    assert cli.main([*verified, "--engine", "onnx", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert not report["spec_equals_engine"]
    assert report["engine_different"] == (form == "scan")


def test_verify_where_it_cannot_be(verified, monkeypatch, capsys):
    for patch, words in (
        (lambda: monkeypatch.setattr(builder, "SIZE_LIMIT", 100), "onnx: the weights need "),
        (lambda: monkeypatch.setitem(sys.modules, "onnxruntime", None), "onnxruntime: the package is not installed"),
    ):
        patch()
        capsys.readouterr()
        assert cli.main([*verified, "--engine", "onnx"]) == 2
        out, err = capsys.readouterr()
        assert not out
        assert err.startswith(f"spikeloom: {words}")


def test_the_benchmark_compares_what_it_times(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    benchmark = importlib.import_module("onnx_engine")
    monkeypatch.setattr(benchmark, "FEW", 2)
    events = np.random.default_rng(1).integers(0, 2, (3, 2, 20), np.uint8)
    runs, ready = benchmark.contenders(three_neurons())
    assert list(runs) == list(ready) == ["ours", "scan", "step"]
    runs["scan"] = lambda given: ~benchmark.contenders(three_neurons())[0]["ours"](given)
    found = benchmark.measure(runs, [events[:1], events[1:]], rounds=2)
    assert [figures["differing_spikes"] for figures in found.values()] == [0, 2 * 3 * 21 * 3, 0]
    assert found["ours"]["times_ours"] == 1
