"""The training loop: the released protocol, repeatable to the byte; fine-tuning on the integers of the chip."""

import json
import os
import platform
import subprocess
import sys
from dataclasses import replace

import made_files
import numpy as np
import pytest
import torch
from made_files import (
    TAXELS,
    checkpoint_bytes,
    csv_folder,
    rebuilt,
    recorded,
    recordings_folder,
    ring,
    small_checkpoint,
    sparse_events,
    weights,
)
from numpy.testing import assert_allclose, assert_array_equal
from oracles import load_weights, refused
from zoo import tuned

import spikeloom.models.training.train
from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.loihi1.registers import ONE_STEP_SUM_MAX
from spikeloom.compiler.targets.loihi1.storage.choose_storage import round_to_forms
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.networks.quantised import QuantisedNet
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.training.evaluate import evaluate
from spikeloom.models.training.finetune import finetune
from spikeloom.models.training.recipes import DECAY_EPOCHS, RELEASED, Recipe
from spikeloom.models.training.record import training_record
from spikeloom.models.training.robust import disturb
from spikeloom.models.training.train import Epoch, state_files, train, train_both, validation_split
from spikeloom.runtime.cli import main
from spikeloom.runtime.studies.training.plan import both_splits

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
            output = network(
                torch.tensor(training.events[index], dtype=torch.float32).permute(2, 0, 1)[:, None]
            )[0]
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
    trained = train(
        one, one, ADJACENCY, tiny, epochs=7, recipe=replace(RELEASED, decay_epochs=2), state=tmp_path / "s"
    )
    assert RELEASED.decay_epochs == DECAY_EPOCHS == 40
    rates = [epoch.learning_rate for epoch in trained.history]
    assert_allclose(rates, [1e-3] * 3 + [1e-4] * 2 + [1e-5] * 2, rtol=1e-12)
    options = {"epochs": 7, "state": tmp_path / "s", "resume": True}
    refused(
        OptionError, "belongs to a training with other recipe; ", train, one, one, ADJACENCY, tiny, **options
    )


def test_a_recipe_is_equal_to_what_its_file_says():
    recipe = replace(RELEASED, hidden=(16,), betas=(("fc1", 0.5),), penalty=0.1)
    assert json.loads(json.dumps(recipe.to_json())) == recipe.to_json()
    assert "hidden" not in RELEASED.to_json()


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
        (
            FIVE,
            SMALL,
            {},
            DataError,
            "split 'synthetic': 5 taxels and 2 polarities, the network has 39 and 2",
        ),
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


LOSS = """
import numpy as np
from spikeloom.models.training.evaluate import loss_of
from spikeloom.models.training.recipes import RECIPES
import torch
rates = torch.rand(256, 36, generator=torch.Generator().manual_seed(0), requires_grad=True)
loss_of(RECIPES["rates"], rates, np.arange(256) % 36).backward()
print(rates.grad.numpy().tobytes().hex())
"""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="has no AVX2")
def test_gradients_are_the_same_on_processors_of_two_widths():
    known = {name: value for name, value in os.environ.items() if name != "ATEN_CPU_CAPABILITY"}
    found = {
        subprocess.run(
            [sys.executable, "-c", LOSS], env=known | wide, capture_output=True, check=True
        ).stdout
        for wide in ({}, {"ATEN_CPU_CAPABILITY": "avx2"})
    }
    assert len(found) == 1


@pytest.mark.parametrize("robust", [0.0, 0.2])
def test_a_killed_training_resumes_to_the_same_weights(tmp_path, robust):
    training, test, state = grasps(0), grasps(1), tmp_path / "x.state"
    options = {"epochs": 4, "seed": 2, "keep_epoch": 2, "recipe": replace(RELEASED, robust=robust)}
    whole = train(training, test, ADJACENCY, SMALL, **options)
    refused(
        KilledError, "", train, training, test, ADJACENCY, SMALL, **options, state=state, after_epoch=killed
    )
    resumed = train(training, test, ADJACENCY, SMALL, **options, state=state, resume=True)
    plain = train(training, test, ADJACENCY, SMALL, epochs=4, seed=2, keep_epoch=2)
    assert same(plain.last, whole.last) == (robust == 0)
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
    content = state.read_bytes()
    for damaged in (b"[", content[:-1], content[:99] + b"x" + content[100:]):
        state.write_bytes(damaged)
        refused_for("is no training state, or was altered", ModelError, grasps(0), 1)


def test_a_loss_that_is_no_number_stops_and_keeps_the_state(tmp_path, monkeypatch):
    state = tmp_path / "x.state"
    train(grasps(0), grasps(1), ADJACENCY, SMALL, epochs=1, state=state)
    kept = state.read_bytes()
    steps = iter((1.0, float("nan")))
    monkeypatch.setattr(
        "spikeloom.models.training.evaluate.rate_loss", lambda rates, _: rates.sum() * next(steps)
    )
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
    refused(
        DataError,
        "each class has one training recording|needs 2 of some",
        validation_split,
        grasps(0, per_class=1),
    )


LOIHI = load_target("loihi1")


def drawn(checkpoint, seed, *, samples=12, steps=20):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, checkpoint.classes, samples)
    rate = 0.05 + 0.3 * (labels[:, None, None, None] / max(1, checkpoint.classes - 1))
    events = sparse_events(rng, samples, checkpoint.taxels, 2, steps, rate=rate)
    return recorded(events, labels)


def tuned_forms(checkpoint, adjacency, events, bits):
    asked = Options(storage=Fixed((Packing(bits=bits, groups=8),)), keep_all=True, training_events=events)
    return compile_network(expand(checkpoint, adjacency), asked).integer.forms


@pytest.mark.parametrize(("bits", "seed"), [(2, 0), (3, 1), (4, 2), (8, 0)])
def test_the_model_computes_what_the_compiled_network_computes(tmp_path, bits, seed):
    checkpoint, adjacency = small_checkpoint(tmp_path, last=weights(seed))
    data = drawn(checkpoint, seed)
    forms = tuned_forms(checkpoint, adjacency, data.events, bits)
    model = QuantisedNet(expand(checkpoint, adjacency), forms)
    integer, _ = round_to_forms(expand(checkpoint, adjacency), forms)
    found = model.spikes_of(time_first(data.events))
    expected = run_integer(integer, channels_last(data.events)).spikes
    for ours, theirs in zip(found, expected, strict=True):
        assert_array_equal(ours.detach().bool().numpy().transpose(1, 0, 2), theirs)
    assert sum(int(spikes.sum()) for spikes in expected) > 0


def test_gradients_are_those_of_the_rounded_float_model(tmp_path):
    """At 8 bits and with scales this fine the straight-through gradient is the float model's, to a few parts in 100."""
    checkpoint, adjacency = small_checkpoint(tmp_path)
    data = drawn(checkpoint, 1, samples=3)
    model = QuantisedNet(expand(checkpoint, adjacency), tuned_forms(checkpoint, adjacency, data.events, 8))
    model(time_first(data.events)).square().sum().backward()
    sizes = [len(dense.bias) for dense in checkpoint.dense]
    architecture = Architecture(
        taxels=checkpoint.taxels,
        classes=sizes[-1],
        hops=len(checkpoint.hops) - 1,
        features=checkpoint.hops.shape[1],
        hidden=tuple(sizes[:-1]),
        beta=819 / 4096,
    )
    plain = SpikingNet(architecture, adjacency)
    load_weights(plain, model.tensors())
    events = torch.tensor(data.events.transpose(3, 0, 1, 2), dtype=torch.float32)
    plain(events).square().sum().backward()
    ours, theirs = model.layers[0].filters.grad, plain.conv1.hops.grad
    assert theirs.abs().max() > 0
    assert torch.nn.functional.cosine_similarity(ours.flatten(), theirs.flatten(), dim=0) > 0.9
    last, reference = model.layers[-1].weight.grad, getattr(plain, plain.dense[-1]).weight.grad.t()
    assert torch.nn.functional.cosine_similarity(last.flatten(), reference.flatten(), dim=0) > 0.9


def test_weights_that_would_overflow_are_shrunk(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    data = drawn(checkpoint, 0)
    forms = tuned_forms(checkpoint, adjacency, data.events, 8)
    model = QuantisedNet(expand(checkpoint, adjacency), forms)
    with torch.no_grad():
        model.layers[0].filters *= 40
        model.layers[1].weight *= 40
        model.layers[1].bias += 1e9
    model.make_legal()
    for integers in model.integers:
        assert integers.full.max() <= ONE_STEP_SUM_MAX
        assert np.maximum(integers.units, 0).sum(axis=0).max() <= ONE_STEP_SUM_MAX
        assert np.maximum(-integers.units, 0).sum(axis=0).max() <= ONE_STEP_SUM_MAX


def test_what_is_lost_and_comes_has_its_chance():
    rng = np.random.default_rng(0)
    events = sparse_events(rng, 200, 20, 2, 50, rate=rng.uniform(0.05, 0.4, (200, 1, 1, 1)))
    found = disturb(events, 0.2, np.random.default_rng(1))
    alive = found.any(axis=(2, 3))
    assert alive.mean() == pytest.approx(0.8, abs=0.02)
    was, now = (each[alive] == 1 for each in (events, found))
    come = np.repeat(0.2 * events.mean(axis=(1, 2, 3))[:, None], 20, axis=1)[alive]
    assert (was & ~now).sum() / was.sum() == pytest.approx(0.2 * (1 - come.mean()), abs=0.01)
    assert (now & ~was).sum() == pytest.approx((come[:, None, None] * ~was).sum(), rel=0.03)
    assert (disturb(events, 0.0, rng) is events, found.dtype) == (True, events.dtype)


def test_an_interrupted_fine_tuning_goes_on_to_the_same_bytes(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    network, train, test = expand(checkpoint, adjacency), drawn(checkpoint, 0), drawn(checkpoint, 1)
    whole = finetune(network, train, test, LOIHI, bits=[2], epochs=4, seed=3)

    state = tmp_path / "x.state"
    for robust, same in ((0.0, True), (0.2, False)):
        other = finetune(network, train, test, LOIHI, bits=[2], epochs=4, seed=3, robust=robust)
        assert (other.history == whole.history) is same
    options = {"bits": [2], "epochs": 4, "seed": 3, "state": state}
    refused(OptionError, "--robust -0.1: ", finetune, network, train, test, LOIHI, robust=-0.1, **options)
    refused(KilledError, "", finetune, network, train, test, LOIHI, after_epoch=killed, **options)
    rest = finetune(network, train, test, LOIHI, resume=True, **options)
    assert rest.history == whole.history
    for name, array in whole.net.tensors().items():
        assert_array_equal(rest.net.tensors()[name], array)
    moved = replace(checkpoint, conv_bias=checkpoint.conv_bias + 1)  # as other epochs of the same file are
    for other, what in ((moved, "network"), (replace(checkpoint, beta=0.6), "beta")):
        words = f"belongs to a training with other {what}"
        refused(
            OptionError,
            words,
            finetune,
            expand(other, adjacency),
            train,
            test,
            LOIHI,
            resume=True,
            **options,
        )


@pytest.mark.parametrize(
    ("loss", "name", "found"),
    [
        (lambda rates, _labels: rates.sum() * float("nan"), "loss", "nan"),
        (lambda rates, _labels: rates.sum() + float("inf"), "loss", "inf"),
        (lambda rates, _labels: torch.sqrt(0 * rates.sum()), "gradient", "nan"),
    ],
    ids=["nan", "infinite", "gradient"],
)
def test_a_loss_that_is_no_number(tmp_path, monkeypatch, loss, name, found):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    data = drawn(checkpoint, 0)
    monkeypatch.setattr("spikeloom.models.training.finetune.rate_loss", loss)
    words = f"epoch 1, step 1: the {name} is {found}|state of the epoch before is kept"
    refused(DataError, words, finetune, expand(checkpoint, adjacency), data, data, LOIHI, bits=[4], epochs=2)


@pytest.mark.parametrize(
    "change",
    [
        lambda forms: forms.pop(),
        lambda forms: forms[0].update(layer="fc9"),
        lambda forms: forms[0].update(bits=9),
        lambda forms: forms[0].update(exponents=[0, 8]),
        lambda forms: forms[1]["threshold"].pop(),
        lambda forms: forms[1]["threshold"].__setitem__(0, 0),
        lambda forms: forms[1]["threshold"].__setitem__(0, 2**17),
        lambda forms: forms[0].update(bits=True),
        lambda forms: forms.__setitem__(0, "conv1"),
    ],
)
def test_forms_that_cannot_be_used(tmp_path, change):
    checkpoint, _ = small_checkpoint(tmp_path)
    forms = tuned(checkpoint).forms
    path = tmp_path / "tuned.pt"
    graph = ring(checkpoint.taxels)
    constants = {"beta": 0.2, "theta": 0.5, "training": {}}
    save_checkpoint(path, {"last": weights()}, **made_files.graph_facts(graph), **constants, forms=forms)
    path.write_bytes(rebuilt(path.read_bytes(), lambda manifest, _: change(manifest["forms"])))
    refused(ModelError, f"{path}: the manifest has no usable forms", read_checkpoint, path)


def test_a_class_without_training_recordings_is_said(tmp_path, capsys):
    folder = recordings_folder(tmp_path / "gap")
    for file in (folder / "train").glob("*_label_1.npy"):
        file.unlink()
    both_splits(str(folder), None, None)
    assert capsys.readouterr().err.endswith("warning: gap: no training recordings of class 1\n")


@pytest.mark.parametrize("command", ["train --system counters -o OUT.pt", "smallest -o OUT.loom"])
@pytest.mark.parametrize("more", [1, 900])
def test_taxels_that_only_the_test_split_has_are_refused(tmp_path, capsys, command, more):
    csv_folder(tmp_path / "taps" / "train")
    csv_folder(tmp_path / "taps" / "test", taxels=TAXELS + more)
    words = command.replace("OUT", str(tmp_path / "out")).split()
    assert main([*words, "--data", str(tmp_path / "taps")]) == 2
    message = capsys.readouterr().err
    assert f"allowed are whole numbers 0..{TAXELS - 1}" in message
    assert f"the training recordings have {TAXELS} taxels; if more exist, give --taxels" in message


def test_counts_of_events_are_said_once(tmp_path, capsys):
    for split in ("train", "test"):
        csv_folder(tmp_path / "taps" / split)
    both_splits(str(tmp_path / "taps"), None, None)
    both_splits(str(tmp_path / "taps"), None, None)
    assert capsys.readouterr().err.count("events read") == 2
