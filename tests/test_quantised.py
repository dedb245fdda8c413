"""The torch model on chip integers, fine-tuning on it, and the checkpoints that come out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_files import ring, small_checkpoint, weights
from oracles import comparable, refused
from test_checkpoint import rebuilt

from spikeloom.compiler import Options, compile_network, lift
from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_integer
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.storage.choose_storage import round_to_forms
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.checkpoint import save_checkpoint
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.quantised import QuantisedNet, quantised_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.finetune import finetune, initial_forms
from spikeloom.runtime.cli import main
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned

LOIHI = load_target("loihi1")
EXPONENTS = LOIHI.choices["synapse.exponent"]


def recordings(checkpoint, seed, *, samples=12, steps=20, split="train"):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, checkpoint.classes, samples)
    rate = 0.05 + 0.3 * (labels[:, None, None, None] / max(1, checkpoint.classes - 1))
    events = (rng.random((samples, checkpoint.taxels, 2, steps)) < rate).astype(np.uint8)
    files = tuple(f"sample_{i}.npy" for i in range(samples))
    return Recordings(source="made", split=split, events=events, labels=labels, files=files)


def tuned_forms(checkpoint, adjacency, events, bits):
    network = expand(checkpoint, adjacency)
    layers = len(network.populations)
    return initial_forms(network, calibrate(network, channels_last(events)), [bits] * layers, 8, EXPONENTS)


@pytest.mark.parametrize(("bits", "seed"), [(2, 0), (3, 1), (4, 2), (8, 0)])
def test_the_model_computes_what_the_compiled_network_computes(tmp_path, bits, seed):
    checkpoint, adjacency = small_checkpoint(tmp_path, last=weights(seed))
    data = recordings(checkpoint, seed)
    forms = tuned_forms(checkpoint, adjacency, data.events, bits)
    model = QuantisedNet(checkpoint, adjacency, forms)
    integer, _ = round_to_forms(expand(checkpoint, adjacency), forms)
    found = model.spikes_of(time_first(data.events))
    expected = run_integer(integer, channels_last(data.events)).spikes
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours.detach().bool().numpy().transpose(1, 0, 2), theirs)
    assert sum(int(spikes.sum()) for spikes in expected) > 0


def test_batches_do_not_mix(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    data = recordings(checkpoint, 0, samples=5)
    model = QuantisedNet(checkpoint, adjacency, tuned_forms(checkpoint, adjacency, data.events, 4))
    together = model(time_first(data.events))
    alone = torch.cat([model(time_first(data.events[i : i + 1])) for i in range(5)])
    assert torch.equal(together, alone)


def test_gradients_are_those_of_the_rounded_float_model(tmp_path):
    """At 8 bits and with scales this fine the straight-through gradient is the float model's, to a few parts in 100."""
    from spikeloom.models.networks.networks import Architecture, SpikingNet

    checkpoint, adjacency = small_checkpoint(tmp_path)
    data = recordings(checkpoint, 1, samples=3)
    model = QuantisedNet(checkpoint, adjacency, tuned_forms(checkpoint, adjacency, data.events, 8))
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
    exact = {"conv1.hops": model.hops, "conv1.bias": model.conv_bias}
    for dense, weight, bias in zip(plain.dense, model.weights, model.biases, strict=True):
        exact |= {f"{dense}.weight": weight, f"{dense}.bias": bias}
    plain.load_weights({name: parameter.detach().numpy() for name, parameter in exact.items()})
    events = torch.tensor(data.events.transpose(3, 0, 1, 2), dtype=torch.float32)
    plain(events).square().sum().backward()
    ours, theirs = model.hops.grad, plain.conv1.hops.grad
    assert theirs.abs().max() > 0
    assert torch.nn.functional.cosine_similarity(ours.flatten(), theirs.flatten(), dim=0) > 0.9
    last, reference = model.weights[-1].grad, getattr(plain, plain.dense[-1]).weight.grad.t()
    assert torch.nn.functional.cosine_similarity(last.flatten(), reference.flatten(), dim=0) > 0.9


def test_weights_that_would_overflow_are_shrunk(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    data = recordings(checkpoint, 0)
    forms = tuned_forms(checkpoint, adjacency, data.events, 8)
    model = QuantisedNet(checkpoint, adjacency, forms)
    with torch.no_grad():
        model.hops *= 40
        model.weights[0] *= 40
        model.biases[0] += 1e9
    model.make_legal()
    for integers in model.integers:
        assert np.maximum(integers.units, 0).sum(axis=0).max() <= ONE_STEP_SUM_MAX
        assert np.maximum(-integers.units, 0).sum(axis=0).max() <= ONE_STEP_SUM_MAX


# --- fine-tuning
@pytest.mark.parametrize("bits", [2, 4])
def test_a_fine_tuned_checkpoint_compiles_to_what_was_trained(tmp_path, bits):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    train, test = recordings(checkpoint, 0, samples=24), recordings(checkpoint, 1, split="test")
    tuned = finetune(checkpoint, adjacency, train, test, LOIHI, bits=[bits], epochs=3)
    assert bits == 2 or tuned.history[-1].loss < tuned.history[0].loss
    path = tmp_path / "tuned.pt"
    graph = ring(checkpoint.taxels)
    save_checkpoint(path, {"last": tuned.weights}, graph, beta=0.2, theta=0.5, training={}, forms=tuned.forms)
    again = read_checkpoint(path)
    for ours, theirs in zip(again.forms, tuned.forms, strict=True):
        assert (ours.bits, ours.exponents) == (theirs.bits, theirs.exponents) == (bits, theirs.exponents)
        np.testing.assert_array_equal(ours.threshold, theirs.threshold)
    netlist = compile_network(expand(again, adjacency), Options(forms=again.forms)).netlist
    trace = engine.simulate(netlist, test.events.reshape(len(test), -1, test.steps), spikes=True)
    model = quantised_spikes(again, adjacency, test.events)
    for index, layer in enumerate(netlist.layers):
        np.testing.assert_array_equal(aligned(netlist, trace.spikes, index), model[layer.name])
    right = int((model[netlist.layers[-1].name].sum(axis=1).argmax(axis=1) == test.labels).sum())
    assert right == tuned.after
    assert {projection.bits for projection in lift(netlist).projections} == {bits}


def test_an_interrupted_fine_tuning_goes_on_to_the_same_bytes(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    train, test = recordings(checkpoint, 0), recordings(checkpoint, 1)
    whole = finetune(checkpoint, adjacency, train, test, LOIHI, bits=[2], epochs=4, seed=3)

    class StoppedError(Exception):
        pass

    def stop(epoch):
        if epoch.epoch == 2:
            raise StoppedError

    state = tmp_path / "x.state"
    options = {"bits": [2], "epochs": 4, "seed": 3, "state": state}
    with pytest.raises(StoppedError):
        finetune(checkpoint, adjacency, train, test, LOIHI, after_epoch=stop, **options)
    rest = finetune(checkpoint, adjacency, train, test, LOIHI, resume=True, **options)
    assert rest.history == whole.history
    for name, array in whole.weights.items():
        np.testing.assert_array_equal(rest.weights[name], array)
    moved = replace(checkpoint, conv_bias=checkpoint.conv_bias + 1)  # as other epochs of the same file are
    for other, what in ((moved, "network"), (replace(checkpoint, beta=0.6), "beta")):
        words = f"belongs to a training with other {what}"
        refused(OptionError, words, finetune, other, adjacency, train, test, LOIHI, resume=True, **options)


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
    data = recordings(checkpoint, 0)
    monkeypatch.setattr("spikeloom.models.training.finetune.rate_loss", loss)
    words = f"epoch 1, step 1: the {name} is {found}|state of the epoch before is kept"
    refused(DataError, words, finetune, checkpoint, adjacency, data, data, LOIHI, bits=[4], epochs=2)


# --- files
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
    checkpoint, adjacency = small_checkpoint(tmp_path)
    data = recordings(checkpoint, 0)
    forms = tuned_forms(checkpoint, adjacency, data.events, 4)
    path = tmp_path / "tuned.pt"
    graph = ring(checkpoint.taxels)
    save_checkpoint(path, {"last": weights()}, graph, beta=0.2, theta=0.5, training={}, forms=forms)
    path.write_bytes(rebuilt(path.read_bytes(), lambda manifest, _: change(manifest["forms"])))
    refused(ModelError, f"{path}: the manifest has no usable forms", read_checkpoint, path)


# --- the command
@pytest.mark.slow
@pytest.mark.recordings
def test_the_model_is_the_chip_on_every_recording(tmp_path, objects_zip, containers_zip):
    adjacency = normalised_adjacency(build_graph("manual").edges, 39)
    for name, place in (("objects", objects_zip), ("containers", containers_zip)):
        output = tmp_path / f"{name}.pt"
        words = ["finetune", f"pretrained:{name}", "--data", str(place), "--weight-bits", "4", "--epochs", "2"]
        assert main([*words, "-o", str(output)]) == 0
        checkpoint = read_checkpoint(output)
        netlist = compile_network(expand(checkpoint, adjacency), Options(forms=checkpoint.forms)).netlist
        for split in ("train", "test"):
            data = load_data(place, split)
            model = quantised_spikes(checkpoint, adjacency, data.events)
            trace = engine.simulate(netlist, data.events.reshape(len(data), -1, data.steps), spikes=True)
            for index, layer in enumerate(netlist.layers):
                kept = comparable(netlist, index)  # the chip leaves out what nobody hears
                ours = aligned(netlist, trace.spikes, index)[..., kept]
                np.testing.assert_array_equal(ours, model[layer.name][..., kept])
