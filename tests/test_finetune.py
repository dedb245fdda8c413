"""Fine-tuning of networks that are no checkpoints: gradients, what is written, and that it is the chip."""

import made_nir
import nir
import numpy as np
import pytest
import torch
from commands import as_json, refusal, run
from made_files import CLASSES, recordings_folder, sparse_events
from made_modules import TAXELS
from oracles import refused
from scipy import sparse
from test_dynamics import surrogate_spike
from zoo import Specimen, specimen

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import INPUT, Form, Input, Network, Population, Projection, Readout
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.quantised import QuantisedNet
from spikeloom.models.training.recipes import RELEASED, TIMED


def biased_currents(folder):
    """A NIR file whose layers have currents and biases that go through them: channel and relay that always fire."""
    rng = np.random.default_rng(0)
    nodes = [made_nir.affine(rng, 8, 2 * TAXELS, 1.5), made_nir.cuba(8, r=2.0, weight=2.0)]
    nodes += [made_nir.affine(rng, CLASSES, 8, 2.0), made_nir.cuba(CLASSES, r=2.0, weight=2.0)]
    nir.write(folder / "net.nir", made_nir.chain(*nodes))
    train, test = (sparse_events(rng, count, TAXELS, 2, 15, rate=0.2) for count in (8, 4))
    recordings_folder(folder / "data", train=train, test=test, classes=CLASSES)
    return Specimen(folder, folder / "net.nir", ("--dt", "0.02"), ())


@pytest.mark.parametrize("storage", [(), ("--weight-bits", "4")], ids=["chosen", "4 bits"])
@pytest.mark.parametrize("name", ["recurrent", "onnx", "timed", "biased currents"])
def test_what_is_written_compiles_to_the_chip_that_was_trained(tmp_path, name, storage):
    made = biased_currents(tmp_path) if name == "biased currents" else specimen(name)
    file, data = tmp_path / ("x.pt" if name == "timed" else "x.nir"), made.data
    found = as_json(
        "finetune", made.network, *made.reading, "--data", data, *storage, "--epochs", "2", "-o", file
    )
    assert found["history"][1][0] != found["history"][0][0]
    as_json("compile", file, "-o", tmp_path / "again.loom")
    if name != "timed":
        assert (tmp_path / found["netlist"]).read_bytes() == (tmp_path / "again.loom").read_bytes()
        assert nir.read(file).metadata["training"]
    verdict = as_json("verify", tmp_path / "again.loom", "--checkpoint", file, "--data", data, codes=(0, 1))
    assert not any(missed.startswith(("EN", "E0", "E1")) for missed in verdict["missed"])
    assert not any(each["different"] for each in verdict["model"].values())
    assert all(each["spikes"] for each in verdict["model"].values())
    assert round(verdict["accuracy"]["chip"] * verdict["samples"]) == found["last"]["correct"]
    assert "fine-tuned already" in refusal(
        "finetune", file, "--data", data, "-o", tmp_path / f"y{file.suffix}"
    )


@pytest.mark.parametrize("surrogate", [RELEASED.surrogate, TIMED.surrogate])
def test_gradients_run_through_own_spikes_and_currents(surrogate):
    """With scales this fine, and equal spikes, they are those of the same equations in torch."""
    rng, alpha, beta, size = np.random.default_rng(0), 0.5, 3277 / 4096, 6
    weights = [rng.normal(0.1, 0.3, (size, 4)), rng.normal(0, 0.15, (size, size))]
    neurons = Population(name="a", beta=beta, theta=0.5, bias=np.full(size, 0.02), alpha=alpha)
    into = tuple(
        Projection(pre=INPUT + i, post=0, weight=sparse.csr_array(w)) for i, w in enumerate(weights)
    )
    shape = {"input": Input(taxels=2, polarities=2), "readout": Readout(population=0, label=np.arange(size))}
    network = Network(populations=(neurons,), projections=into, classes=size, **shape)
    model = QuantisedNet(network, [Form(bits=8, exponents=(0, 7), threshold=np.full(size, 4000))], surrogate)
    events = time_first(sparse_events(rng, 3, 2, 2, 25, rate=0.4))
    wanted = torch.tensor(rng.normal(size=(3, size)), dtype=torch.float32)
    (model(events) * wanted).sum().backward()
    given, own, bias = (torch.tensor(each).float().requires_grad_() for each in (*weights, neurons.bias))
    current = membrane = spikes = torch.zeros(3, size)
    fired = []
    for step in events.flatten(2):
        current = alpha * current + step @ given.t() + spikes @ own.t()
        membrane = beta * membrane * (1 - (spikes if surrogate.reset else spikes.detach())) + current + bias
        spikes = surrogate_spike(surrogate)(membrane, 0.5)
        fired.append(spikes)
    (torch.stack(fired).mean(0) * wanted).sum().backward()
    theirs = torch.cat([torch.cat([given.grad, own.grad], dim=1).flatten(), bias.grad])
    ours = torch.cat([model.layers[0].weight.grad, model.layers[0].bias.grad])
    assert 0.1 < torch.stack(fired).mean() < 0.9
    assert torch.equal(torch.stack(fired), model.spikes_of(events)[0])
    torch.testing.assert_close(ours, theirs, rtol=0.01, atol=0.005)


@pytest.mark.parametrize("change", [{"bits": 9}, {"bits": 1}, {"exponents": [0, 9]}, {"exponents": [1, 0]}])
def test_storage_that_no_chip_has_is_refused(change):
    graph = made_nir.chain(made_nir.affine(np.random.default_rng(0), 4, 4), made_nir.lif(4, threshold=60.0))
    graph.nodes["n1"].metadata = {"bits": np.array(8), "exponents": np.array([0])}
    assert made_nir.lowered(graph).network.forms[0].threshold.tolist() == [60] * 4
    graph.nodes["n1"].metadata |= {key: np.array(value) for key, value in change.items()}
    refused(ModelError, "node n1 (LIF): has no usable storage", made_nir.lowered, graph)


def test_classes_without_recordings_are_warned_of(tmp_path):
    made = specimen("recurrent")
    few = np.zeros((CLASSES, TAXELS, 2, 15), np.uint8)
    recordings_folder(tmp_path / "few", train=few, test=few, classes=2)
    words = ("finetune", made.network, *made.reading, "--data", tmp_path / "few", "--weight-bits", "4")
    _, _, told = run(*words, "--epochs", "1", "-o", tmp_path / "x.nir")
    assert f"few: their classes are 0..1, the network's 0..{CLASSES - 1}" in told
