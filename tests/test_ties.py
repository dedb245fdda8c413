"""Sums that are exactly the threshold: the chip decides them as the float model does, or ``compile`` says so."""

import numpy as np
import pytest
import random_networks as nets
from numpy.testing import assert_array_equal

from spikeloom.compiler.formats.nir.reader import read_nir
from spikeloom.compiler.formats.nir.writer import export
from spikeloom.compiler.interpret import run_float
from spikeloom.compiler.storage import Fixed, Given, Packing
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.loihi1 import compiled
from spikeloom.runtime.report.sections import terminal

WEIGHTS = (
    [[1.0, 1.0, 1.0, 1.0], [2.0, 1.0, -1.0, 0.0]],
    [[0.5, 0.25, -0.25, 0.5], [0.25, 0.25, 0.25, 0.25]],
    [[1.0, 1.0, -5.0, -7.0], [3.0, 2.0, -1.0, -1.0]],
)


def events(steps=80):
    return np.random.default_rng(0).random((60, steps, 4)) < 0.5


@pytest.mark.parametrize("calibrated", [False, True], ids=["weights alone", "calibrated"])
@pytest.mark.parametrize("theta", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("weight", WEIGHTS, ids=str)
def test_a_layer_without_memory_fires_as_the_float_model_on_every_tie(weight, theta, calibrated):
    network = nets.chain(weight, beta=0.0, theta=theta)
    given = events()
    sums = given.astype(float) @ np.array(weight).T
    training = {"training_events": given.transpose(0, 2, 1)[:, :, None]} if calibrated else {}
    done = compile_network(network, Options(storage=Fixed((Packing(),)), **training))
    assert np.any(sums == theta) or theta != 1.0
    assert not done.choices[0].ties
    assert_array_equal(run_integer(lift(done.netlist), given).spikes[0], sums > theta)


def test_real_weights_without_memory_fire_by_the_rounded_sums_alone():
    rng = np.random.default_rng(1)
    network = nets.chain(rng.normal(size=(6, 4)), beta=0.0, theta=0.8, biases=[rng.normal(size=6) * 0.1])
    integer = lift(compile_network(network).netlist)
    chip = integer.populations[0]
    given = events()
    sums = (given.astype(np.int64) @ integer.projections[0].effective().toarray().T) * 64 + chip.bias
    fired = run_integer(integer, given).spikes[0]
    assert_array_equal(fired, sums > chip.threshold * 64)
    assert fired.any()


def test_ties_that_a_storage_decides_otherwise_are_said():
    network = nets.chain([[1.0, 2.0, -1.0]], beta=0.0, theta=2.0)
    done = compile_network(network, Options(storage=Fixed((Packing(planes=3),))))
    given = events()[..., :3]
    assert not np.array_equal(
        run_integer(lift(done.netlist), given).spikes[0], run_float(network, given).spikes[0]
    )
    outcome = compiled.outcome(done, "0" * 64)
    said = " ".join(terminal(outcome.sections(outcome.result)).split())
    assert "fc1: 1 neuron can get sums of exactly the threshold and, rounded, may decide" in said


def test_ties_of_a_first_step_are_counted_where_they_are_moved_whatever_the_membrane_keeps():
    weight = np.array([[1.0, 2.0, 4.0], [2.0, 4.0, 1.0], [3.0, 3.0, 3.0]])
    given = events(1)[..., :3]
    counted = []
    for beta in (0.0, 0.5, 0.2):
        network = nets.chain(weight * [[1], [2 / 3], [2 / 3]], beta=beta, theta=2.0)
        done = compile_network(network, Options(storage=Fixed((Packing(),))))
        fired = run_integer(lift(done.netlist), given).spikes[0]
        moved = np.any(fired != (given @ weight.T > [2, 3, 3]), axis=(0, 1))
        counted.append((np.count_nonzero(moved), done.choices[0].ties))
    assert all(moved <= ties for moved, ties in counted)
    assert counted[1][1] > 0
    real = nets.chain(np.random.default_rng(0).normal(size=(4, 3)), beta=0.5, theta=2.0)
    assert not compile_network(real).choices[0].ties


def test_what_makes_up_for_the_memory_comes_back_from_an_export(tmp_path):
    integer = lift(compile_network(nets.chain([[1.0, 1.0, 1.0, 1.0]], beta=0.0, theta=2.0)).netlist)
    assert integer.populations[0].bias < 0
    (tmp_path / "own.nir").write_bytes(export(integer, 0.02))
    found = read_nir(tmp_path / "own.nir", polarities=1).network
    back = lift(compile_network(found, Options(storage=Given(found.forms), keep_all=True)).netlist)
    assert_array_equal(back.populations[0].bias, integer.populations[0].bias)
    given = events()
    assert_array_equal(run_integer(back, given).spikes[0], run_integer(integer, given).spikes[0])


def test_ties_of_neurons_beside_one_without_whole_weights_are_counted():
    weight = [[1.0, 2.0, -1.0], [np.pi, np.e, -1.0]]
    done = compile_network(
        nets.chain(weight, beta=0.0, theta=2.0), Options(storage=Fixed((Packing(planes=3),)))
    )
    assert done.choices[0].ties == 1


def test_ties_of_weights_that_are_thirds_are_counted_where_they_are_moved():
    weight = np.array([[1.0, 2.0, 4.0], [2.0, 4.0, 1.0], [3.0, 3.0, 3.0]])
    given = events()[..., :3]
    network = nets.chain(weight * [[1], [2 / 3], [2 / 3]], beta=0.0, theta=2.0)
    done = compile_network(network, Options(storage=Fixed((Packing(),))))
    fired = run_integer(lift(done.netlist), given).spikes[0]
    moved = np.any(fired != (given @ weight.T > [2, 3, 3]), axis=(0, 1))
    assert moved.any()
    assert done.choices[0].ties >= np.count_nonzero(moved)


def test_a_threshold_just_below_a_multiple_of_the_weights_is_that_multiple():
    theta = 0.7 + 0.7 + 0.7  # 2.0999999999999996
    network = nets.chain([[0.7, 0.7, 0.7, 0.7]], beta=1.0, theta=theta)
    done = compile_network(network, Options(storage=Fixed((Packing(),))))
    integer = lift(done.netlist)
    stored = integer.projections[0].effective().data
    assert np.all(3 * stored == integer.populations[0].threshold)


def test_a_bias_that_makes_up_for_the_memory_is_the_checkpoints():
    network = nets.chain([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, -1.0, 0.0]], beta=0.0, theta=1.0)
    done = compile_network(network, Options(storage=Fixed((Packing(),))))
    assert np.any(lift(done.netlist).populations[0].bias != 0)
    assert machine_of(done.netlist).check_lowering(network).holds


def test_ties_that_a_bias_adds_up_to_are_counted_where_they_are_moved():
    network = nets.chain([[1.0, 2.0, -1.0]], beta=1.0, theta=2.0, biases=[np.array([1.0])])
    given = events()[..., :3]
    coarse = compile_network(network, Options(storage=Fixed((Packing(bits=2),))))
    moved = run_integer(lift(coarse.netlist), given).spikes[0] != run_float(network, given).spikes[0]
    assert np.any(moved)
    assert coarse.choices[0].ties == 1
    plain = compile_network(network, Options(storage=Fixed((Packing(),))))
    assert_array_equal(
        run_integer(lift(plain.netlist), given).spikes[0], run_float(network, given).spikes[0]
    )
    assert not plain.choices[0].ties
