"""The ONNX files: what is in them, that they are the same every time, and the command that writes them."""

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from made_files import events, small_checkpoint
from onnx.reference import ReferenceEvaluator
from random_netlists import Axon, Neuron, build
from test_onnx_engine import three_neurons

from spikeloom.compiler.formats.onnx import writer as onnx_writer
from spikeloom.compiler.formats.onnx import writer_float as onnx_float
from spikeloom.compiler.formats.onnx.writer_layers import digits, plan
from spikeloom.models.networks.reference import float_spikes
from spikeloom.runtime.machines.loihi1 import engine, onnx_engine

FORMS = onnx_writer.FORMS


def model_of(content):
    model = onnx.load_from_string(content)
    onnx.checker.check_model(model, full_check=True)
    return model


# -- digits and widths -------------------------------------------------------------------------------------------------
@given(
    arrays.arrays(np.int64, st.tuples(st.integers(1, 4), st.integers(1, 4)), elements=st.integers(-(2**22), 2**22)),
    st.integers(0, 6),
)
def test_digits_add_up_to_the_weights(weight, shift):
    found = digits(weight << shift)
    assert all(digit.dtype == np.int8 for digit, _ in found)
    np.testing.assert_array_equal(sum(digit.astype(np.int64) * factor for digit, factor in found), weight << shift)


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


def test_ranges_that_are_proven_are_not_checked():
    assert not one_layer().checked
    assert not one_layer().saturates
    assert one_layer(decay_v=0).saturates
    assert not one_layer(decay_u=100).checked
    assert one_layer(decay_u=1).checked
    axons = [Axon(source=0, targets=((0, 254),), exponent=7), Axon(source=0, targets=((0, 256 - 2),), exponent=7)]
    assert plan(build([Neuron()], axons, n_inputs=1, depths=[0]))[0].checked
    assert not plan(build([Neuron()], axons[:1], n_inputs=1, depths=[0]))[0].checked


# -- files -------------------------------------------------------------------------------------------------------------
def test_the_reference_of_the_format_computes_the_same():
    netlist = three_neurons()
    given = np.random.default_rng(2).integers(0, 2, (2, 2, 12), np.uint8)
    expected = engine.simulate(netlist, given, spikes=True).spikes
    model = ReferenceEvaluator(model_of(onnx_writer.export(netlist, "scan")))
    found = dict(zip(model.output_names, model.run(None, {"events": given.transpose(2, 0, 1)}), strict=True))
    np.testing.assert_array_equal(found["layer0.spikes"].transpose(1, 0, 2), expected[:, :12, :2])
    np.testing.assert_array_equal(found["layer1.spikes"].transpose(1, 0, 2), expected[:, 1:13, 2:])
    assert found["votes"].tolist() == [[0, int(sample[:, 2].sum())] for sample in expected]
    assert found["class"].tolist() == [int(sample[:, 2].any()) for sample in expected]


# -- the float network -------------------------------------------------------------------------------------------------
def by_name(session, given):
    names = [port.name for port in session.get_outputs()]
    return dict(zip(names, session.run(names, given), strict=True))


def test_the_float_graph_is_the_float_model(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    recorded = events(4)
    expected = float_spikes(checkpoint, adjacency, recorded)
    given = np.ascontiguousarray(recorded.reshape(len(recorded), -1, recorded.shape[3]).transpose(2, 0, 1))
    scan, step = (
        onnx_engine.open_session(onnx_float.export_float(checkpoint, adjacency, form, graph_name="ring"))
        for form in ("scan", "step")
    )
    found = by_name(scan, {"events": given})
    kinds = {"tensor(uint8)": np.uint8, "tensor(int32)": np.int32, "tensor(float)": np.float32}
    feed = {port.name: np.zeros((len(recorded), port.shape[1]), kinds[port.type]) for port in step.get_inputs()}
    for t, now in enumerate(given):
        left = by_name(step, feed | {"events": now})
        feed |= {name.removesuffix("_next"): array for name, array in left.items() if name.endswith("_next")}
        for name, spikes in expected.items():
            np.testing.assert_array_equal(left[f"{name}.spikes"], spikes[:, t])
    for name, spikes in expected.items():
        assert spikes.any()
        np.testing.assert_array_equal(found[f"{name}.spikes"].transpose(1, 0, 2), spikes)
        np.testing.assert_array_equal(found[f"{name}.counts"], spikes.sum(axis=1))
    np.testing.assert_array_equal(found["votes"], expected["fc3"].sum(axis=1))
    np.testing.assert_array_equal(feed["votes"], found["votes"])
    np.testing.assert_array_equal(found["class"], found["votes"].argmax(axis=1))
