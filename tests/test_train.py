"""The training loop: the released protocol, repeatable to the byte."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_files import checkpoint_bytes
from numpy.testing import assert_allclose, assert_array_equal
from oracles import refused

import spikeloom.models.training.train
from spikeloom.compiler.archive import npy_bytes
from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.training.evaluate import evaluate
from spikeloom.models.training.recipes import DECAY_EPOCHS, RELEASED, Recipe
from spikeloom.models.training.record import training_record
from spikeloom.models.training.train import Epoch, state_files, train, train_both, validation_split

GRAPH = build_graph("manual")
ADJACENCY = normalised_adjacency(GRAPH.edges, 39)
SMALL = Architecture(taxels=39, classes=6, hops=2, features=4, hidden=(16, 8))


def grasps(seed: int, per_class: int = 2, steps: int = 30) -> Recordings:
    return synthetic_grasps(per_class=per_class, steps=steps, seed=seed)


def file_bytes(**options: object) -> bytes:
    training, test = grasps(0), grasps(1)
    reported = train_both(training, test, ADJACENCY, SMALL, **{"epochs": 1, "seed": 3} | options)
    record = training_record(reported, training, test, command="spikeloom train", seed=3).to_json()
    trained = reported.trained
    return checkpoint_bytes(
        {"last": trained.last, "best": trained.best, "clean": trained.kept},
        GRAPH,
        beta=SMALL.beta,
        theta=SMALL.theta,
        training=record,
    )


def test_one_epoch_twice_gives_the_same_bytes_whatever_the_threads_and_the_global_random_state():
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        torch.manual_seed(1)
        np.random.seed(1)  # noqa: NPY002 - the global state is what this test moves
        first = file_bytes()
        torch.set_num_threads(2)
        torch.manual_seed(2)
        np.random.seed(2)  # noqa: NPY002
        second = file_bytes()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert first == second
    assert file_bytes(seed=4) != first
    assert float(torch.tensor([1e-40]) * 1.0) > 0, "subnormal numbers are still flushed"


def test_steps_equal_adam_on_the_released_loss():
    training, seed = grasps(0), 5
    trained = train(training, grasps(1), ADJACENCY, SMALL, epochs=2, seed=seed)
    network = SpikingNet(SMALL, ADJACENCY, seed=seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3, amsgrad=True, foreach=False)
    order = np.random.default_rng(seed)
    for epoch in range(2):
        losses = []
        for index in order.permutation(len(training)):
            optimizer.zero_grad()
            output = network(torch.tensor(training.events[index], dtype=torch.float32).permute(2, 0, 1)[:, None])[0]
            label = torch.zeros(SMALL.classes)
            label[training.labels[index]] = 1
            loss = torch.nn.MSELoss()(output, label)
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        assert trained.history[epoch].training_loss == pytest.approx(np.mean(losses), rel=1e-6)
    for name, array in network.export_weights().items():
        assert_allclose(trained.last[name], array, rtol=1e-4, atol=1e-6)


def test_another_decay_is_an_option_that_a_state_remembers(tmp_path):
    one = synthetic_grasps(per_class=1, steps=10, seed=0, classes=("sphere",))
    tiny = Architecture(taxels=39, classes=1, hops=0, features=1, hidden=(1,))
    trained = train(one, one, ADJACENCY, tiny, epochs=7, recipe=replace(RELEASED, decay_epochs=2), state=tmp_path / "s")
    assert RELEASED.decay_epochs == DECAY_EPOCHS == 40
    rates = [epoch.learning_rate for epoch in trained.history]
    assert_allclose(rates, [1e-3] * 3 + [1e-4] * 2 + [1e-5] * 2, rtol=1e-12)
    options = {"epochs": 7, "state": tmp_path / "s", "resume": True}
    refused(OptionError, "belongs to a training with other recipe; ", train, one, one, ADJACENCY, tiny, **options)


def test_best_weights_are_those_of_the_first_epoch_with_the_most_right(monkeypatch):
    right = iter([2, 5, 5, 3])
    kept = []

    def fake(network: SpikingNet, recordings: Recordings, recipe: Recipe) -> tuple[float, int]:
        kept.append(network.export_weights())
        return 0.5, next(right)

    monkeypatch.setattr(spikeloom.models.training.train, "evaluate", fake)
    trained = train(grasps(0), grasps(1), ADJACENCY, SMALL, epochs=4)
    assert trained.best_epoch == 2
    assert [epoch.accuracy for epoch in trained.history] == [2 / 12, 5 / 12, 5 / 12, 3 / 12]
    for name in trained.last:
        assert_array_equal(trained.best[name], kept[1][name])
        assert_array_equal(trained.last[name], kept[3][name])
    assert (trained.best["fc1.weight"] != trained.last["fc1.weight"]).any()


def test_evaluation_counts_the_lowest_of_equal_classes_and_averages_over_recordings():
    silent = SpikingNet(SMALL, ADJACENCY)
    with torch.no_grad():
        for parameter in silent.parameters():
            parameter.zero_()
    loss, correct = evaluate(silent, grasps(0))
    assert correct == 2  # the two of class 0: all rates are equal
    assert loss == pytest.approx(1 / SMALL.classes)


FIVE = synthetic_grasps(coordinates=np.random.default_rng(0).random((5, 2)), per_class=1, steps=10, seed=0)


@pytest.mark.parametrize(
    ("test", "architecture", "options", "error", "words"),
    [
        (grasps(1), SMALL, {"epochs": 0}, OptionError, "--epochs 0: allowed are 1 or more"),
        (grasps(1), SMALL, {"device": "tpu"}, OptionError, "--device tpu: unknown; allowed: cpu, cuda"),
        (FIVE, SMALL, {}, DataError, "split 'synthetic': 5 taxels and 2 polarities, the network has 39 and 2"),
        (grasps(1), replace(SMALL, classes=5), {}, DataError, "label 5, the network has 5 classes (0..4)"),
    ],
)
def test_what_cannot_be_trained(test, architecture, options, error, words):
    refused(error, words, train, grasps(0), test, ADJACENCY, architecture, **options)


class KilledError(Exception):
    """Stands in for a kill between two epochs."""


def killed(done: Epoch) -> None:
    if done.epoch == 3:
        raise KilledError


def same(a: object, b: object) -> bool:
    return all(np.array_equal(a[name], b[name]) for name in a) and set(a) == set(b)


def test_a_killed_training_resumes_to_the_same_weights(tmp_path):
    training, test, state = grasps(0), grasps(1), tmp_path / "x.state"
    whole = train(training, test, ADJACENCY, SMALL, epochs=4, seed=2, keep_epoch=2)
    with pytest.raises(KilledError):
        train(training, test, ADJACENCY, SMALL, epochs=4, seed=2, keep_epoch=2, state=state, after_epoch=killed)
    resumed = train(training, test, ADJACENCY, SMALL, epochs=4, seed=2, keep_epoch=2, state=state, resume=True)
    assert same(resumed.last, whole.last)
    assert same(resumed.best, whole.best)
    assert same(resumed.kept, whole.kept)
    assert resumed.history == whole.history
    assert resumed.best_epoch == whole.best_epoch


def test_a_state_of_another_training_or_a_damaged_one_is_refused(tmp_path):
    state = tmp_path / "x.state"
    train(grasps(0), grasps(1), ADJACENCY, SMALL, epochs=1, state=state)

    def refused_for(words, error, data, epochs):
        options = {"epochs": epochs, "state": state, "resume": True}
        refused(error, f"{state}: {words}; ", train, data, grasps(1), ADJACENCY, SMALL, **options)

    refused_for("belongs to a training with other epochs, training data", OptionError, grasps(2), 2)
    for content in (state.read_bytes()[:-100], b"[", npy_bytes(np.zeros(1))):
        state.write_bytes(content)
        refused_for("is not a training state or is damaged", ModelError, grasps(0), 1)


def test_a_loss_that_is_no_number_stops_and_keeps_the_state(tmp_path, monkeypatch):
    state = tmp_path / "x.state"
    train(grasps(0), grasps(1), ADJACENCY, SMALL, epochs=1, state=state)
    kept = state.read_bytes()
    steps = iter((1.0, float("nan")))
    monkeypatch.setattr("spikeloom.models.training.evaluate.rate_loss", lambda rates, _: rates.sum() * next(steps))
    words = "epoch 1, step 2: the loss is nan|state of the epoch before is kept"
    refused(DataError, words, train, grasps(0), grasps(1), ADJACENCY, SMALL, epochs=1, seed=1, state=state)
    assert state.read_bytes() == kept


def test_the_clean_epoch_is_chosen_without_the_test_split(tmp_path):
    training, state = grasps(0, per_class=5), tmp_path / "x"
    reported = train_both(training, grasps(1), ADJACENCY, SMALL, epochs=3, seed=1, state=state)
    other = train_both(training, grasps(9), ADJACENCY, SMALL, epochs=3, seed=1)
    assert reported.clean_epoch == other.clean_epoch
    assert same(reported.trained.kept, other.trained.kept)
    assert reported.validation.history == other.validation.history
    assert all(file.exists() for file in state_files(state))


def test_the_validation_part_is_a_fifth_of_every_class_and_disjoint():
    training = grasps(0, per_class=10)
    fitted, held = validation_split(training)
    assert np.bincount(held.labels).tolist() == [2] * 6
    assert np.bincount(fitted.labels).tolist() == [8] * 6
    assert not set(fitted.files) & set(held.files)
    refused(DataError, "class 0 has one training recording|needs 2 of each", validation_split, grasps(0, per_class=1))
