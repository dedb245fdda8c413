"""onnxruntime on the integer graph: every spike and membrane of the specification; and what is in the files."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
from commands import as_json
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from made_files import sparse_events
from numpy.testing import assert_array_equal
from onnx.reference import ReferenceEvaluator
from oracles import assert_as_specified, by_scan, by_steps, refused
from random_netlists import Axon, Neuron, build, large_netlist, netlists, recordings, six_steps
from zoo import specimen

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.compiler.formats.onnx.reader import read_onnx
from spikeloom.compiler.formats.onnx.writer import digits, plan
from spikeloom.compiler.targets.loihi1.bounds import reach
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.compiler.targets.loihi1.registers import ACCUMULATOR_MAX, CURRENT_MAX
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime import cli
from spikeloom.runtime.machines.loihi1 import engine, onnx_engine


@given(st.data())
def test_random_networks_are_the_specification(data):
    netlist = data.draw(netlists(weight_exponents=(-1, 0, 1, 3)))
    bounds = reach(netlist)
    assume(bounds.sums.max() <= ACCUMULATOR_MAX and bounds.current.max() <= CURRENT_MAX)
    labels = data.draw(
        st.lists(st.integers(-1, 2), min_size=netlist.n_compartments, max_size=netlist.n_compartments)
    )
    netlist = replace(netlist, classes=3, readout_class=read_only(labels))
    assert_as_specified(netlist, data.draw(recordings(netlist)))


def test_a_large_network_is_the_engine():
    netlist = large_netlist(3, proved=True)
    events = sparse_events(4, 5, netlist.n_inputs, 30, rate=0.05)
    lengths = np.array([30, 12, 30, 0, 12])
    expected = engine.simulate(netlist, events, lengths=lengths, spikes=True)
    assert_array_equal(by_scan(netlist, events, lengths=lengths)[0], expected.spikes)


def three_neurons():
    """A netlist by hand: two neurons that receive both inputs, one that receives these and votes for class 1."""
    netlist, _, _ = six_steps()
    return replace(
        netlist, bias_mantissa=read_only([0, -7, 0]), classes=2, readout_class=read_only([-1, -1, 1])
    )


def test_verify_finds_an_engine_that_strays(monkeypatch):
    plain = onnx_engine.simulate

    def stray(prepared, *words, **options):
        spikes, votes = plain(prepared, *words, **options)
        spikes[0, 5, 0] ^= True
        votes[0, 0] += 1
        return spikes, votes

    monkeypatch.setattr(onnx_engine, "simulate", stray)
    made = specimen("mlp")
    words = ["verify", made.netlist, "--checkpoint", made.network, "--data", made.data, "--min-agreement=0"]
    report = as_json(*words, "--engine", "onnx", codes=(1,))
    assert not report["spec_equals_engine"]
    assert report["engine_different"] == 2


PART = 48
SETS = {"objects_zip": ("objects", (576, 144)), "containers_zip": ("containers", (240, 60))}


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize("bits", [8, 4])
@pytest.mark.parametrize("fixture", SETS)
def test_all_recordings(fixture, bits, request, tmp_path):
    name, sizes = SETS[fixture]
    archive = request.getfixturevalue(fixture)
    for split, size in zip(("train", "test"), sizes, strict=True):
        events = load_data(archive, split).events
        assert len(events) == size
        words = ["compile", f"pretrained:{name}", "--calibrate", archive, "--weight-bits", bits]
        assert cli.main([*map(str, words), "-o", str(tmp_path / "n.loom")]) == 0
        netlist = read_netlist(tmp_path / "n.loom")
        total = 0
        for start in range(0, size, PART):
            part = events[start : start + PART].reshape(-1, netlist.n_inputs, events.shape[3])
            expected = engine.simulate(netlist, part, spikes=True).spikes
            total += int(np.count_nonzero(expected))
            for run in (by_steps, by_scan):
                assert np.array_equal(run(netlist, part)[0], expected), run
        assert total > 1_000_000


@given(
    arrays.arrays(
        np.int64, st.tuples(st.integers(1, 4), st.integers(1, 4)), elements=st.integers(-(2**22), 2**22)
    ),
    st.integers(0, 6),
)
def test_digits_add_up_to_the_weights(weight, shift):
    found = digits(weight << shift)
    assert all(digit.dtype == np.int8 for digit, _ in found)
    assert_array_equal(sum(digit.astype(np.int64) * factor for digit, factor in found), weight << shift)


@pytest.mark.parametrize(
    ("weights", "count"),
    [
        ([0], 1),
        ([254, -254], 1),
        ([254 * 128, -2 * 128], 1),
        ([127, -128], 1),
        ([128, 1], 2),
        ([32639, 1], 2),
        ([32640, 1], 3),
    ],
)
def test_weights_of_one_exponent_are_one_digit(weights, count):
    assert len(digits(np.array([weights]).T)) == count


def one_layer(**neuron):
    return plan(build([Neuron(**neuron)], [Axon(source=0, targets=((0, -254),))], n_inputs=1, depths=[0]))[0]


def test_registers_are_int32_where_no_product_can_be_wider():
    assert one_layer().kind is np.int32
    # 64 * 32767 * 1024 is below 2**31, 64 * 32769 * 1024 is above
    assert one_layer(threshold=32767, decay_v=3072).kind is np.int32
    assert one_layer(threshold=32769, decay_v=3072).kind is np.int64
    # -254 * 64 adds up to -254 * 64 * 4096 / 100, times 3996 that is 2.7e9; 160 in place of 100: 1.7e9
    assert one_layer(decay_v=100).kind is np.int64
    assert one_layer(decay_v=160).kind is np.int32
    assert one_layer(decay_v=0).kind is np.int64


def test_registers_that_may_overflow_are_refused():
    assert not one_layer().saturates
    assert one_layer(decay_v=0).saturates
    assert one_layer(decay_u=100).remembers
    axons = [Axon(source=0, targets=((0, 254),), exponent=7)] * 2
    assert len(plan(build([Neuron()], axons[:1], n_inputs=1, depths=[0]))) == 1
    for overflowing in (
        lambda: one_layer(decay_u=1),
        lambda: plan(build([Neuron()], axons, n_inputs=1, depths=[0])),
    ):
        refused(ModelError, "onnx: some input may overflow a register of layer0", overflowing)


def test_the_reference_of_the_format_computes_the_same(tmp_path):
    netlist = three_neurons()
    given = np.random.default_rng(2).integers(0, 2, (2, 2, 12), np.uint8)
    expected = engine.simulate(netlist, given, spikes=True).spikes
    content = onnx.load_from_string(onnx_writer.export(netlist, "scan")[0])
    onnx.checker.check_model(content, full_check=True)
    (tmp_path / "x.onnx").write_bytes(content.SerializeToString())
    refused(
        ModelError,
        "x.onnx: was written by spikeloom export; use the netlist",
        read_onnx,
        tmp_path / "x.onnx",
    )
    model = ReferenceEvaluator(content)
    found = dict(zip(model.output_names, model.run(None, {"events": given.transpose(2, 0, 1)}), strict=True))
    assert_array_equal(found["layer0.spikes"].transpose(1, 0, 2), expected[:, :12, :2])
    assert_array_equal(found["layer1.spikes"].transpose(1, 0, 2), expected[:, 1:13, 2:])
    assert found["votes"].tolist() == [[0, int(sample[:, 2].sum())] for sample in expected]
    assert found["class"].tolist() == [int(sample[:, 2].any()) for sample in expected]
