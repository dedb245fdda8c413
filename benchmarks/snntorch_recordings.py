"""Train a network in snnTorch on recordings, export it as NIR, and keep what snnTorch itself makes of the test split.

::

    python benchmarks/snntorch_recordings.py objects_train.npz objects_test.npz FOLDER [--recurrent]

The recordings are ``events`` (samples, channels, steps) uint8 and ``labels``, as benchmarks/recordings_npz.py writes
them, so that this script needs snnTorch and its dependencies and nothing of this package. FOLDER gets
``snntorch.nir`` and ``snntorch_spikes.npz``: the spikes of both layers on the test split. With --recurrent the first
layer hears itself (RLeaky), else ``snntorch.onnx`` has one step of the same network. Everything is seeded.
"""

import argparse
import time
from pathlib import Path

import nir
import numpy as np
import snntorch as snn
import torch
from snntorch import surrogate
from snntorch.export_nir import export_to_nir
from torch import nn

HIDDEN, EPOCHS, BATCH, STEP = 128, 30, 64, 2e-3


def network(inputs: int, classes: int, recurrent: bool) -> nn.Sequential:
    """Two layers of Leaky neurons that reset to zero; the first may hear itself."""

    def leaky(size: int, beta: float) -> nn.Module:
        return snn.Leaky(
            beta=torch.full((size,), beta),
            threshold=torch.full((size,), 0.5),
            spike_grad=surrogate.fast_sigmoid(slope=5),
            init_hidden=True,
            reset_mechanism="zero",
        )

    hidden = leaky(HIDDEN, 0.7)
    if recurrent:
        hidden = snn.RLeaky(
            beta=torch.full((HIDDEN,), 0.7),
            threshold=torch.full((HIDDEN,), 0.5),
            linear_features=HIDDEN,
            spike_grad=surrogate.fast_sigmoid(slope=5),
            init_hidden=True,
            reset_mechanism="zero",
            reset_delay=False,  # else the input of the step after a spike is lost, which NIR cannot say
        )
    return nn.Sequential(nn.Linear(inputs, HIDDEN), hidden, nn.Linear(HIDDEN, classes), leaky(classes, 0.9))


def run(net: nn.Sequential, events: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Spikes of both layers, (samples, steps, neurons)."""
    for layer in (net[1], net[3]):
        layer.mem = layer.spk = torch.zeros(len(events), len(layer.beta))
    hidden, out = [], []
    for step in range(events.shape[2]):
        hidden.append(net[1](net[0](events[:, :, step])))
        out.append(net[3](net[2](hidden[-1])))
    return torch.stack(hidden, 1), torch.stack(out, 1)


class Step(nn.Module):
    """One step of the feed-forward network, its membranes as inputs and outputs."""

    def __init__(self, net: nn.Sequential) -> None:
        super().__init__()
        self.stages, self.neurons = nn.ModuleList([net[0], net[2]]), [net[1], net[3]]

    def forward(self, spikes: torch.Tensor, *membranes: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Spikes of the classes, and the membranes."""
        kept = []
        for stage, one, before in zip(self.stages, self.neurons, membranes, strict=True):
            beta, theta = float(one.beta[0]), float(one.threshold[0])
            kept.append(beta * before * (before <= theta).float() + stage(spikes))
            spikes = (kept[-1] > theta).float()
        return spikes, *kept


def main() -> None:
    """Train, export, run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("train", type=Path)
    parser.add_argument("test", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recurrent", action="store_true", help="the first layer hears itself")
    arguments = parser.parse_args()
    torch.manual_seed(1)
    train, test = (np.load(path) for path in (arguments.train, arguments.test))
    events, labels = torch.from_numpy(train["events"]).float(), torch.from_numpy(train["labels"])
    net = network(events.shape[1], int(labels.max()) + 1, arguments.recurrent)
    optimiser = torch.optim.Adam(net.parameters(), STEP)
    begun = time.monotonic()
    for epoch in range(EPOCHS):
        right = 0
        for part in torch.randperm(len(events)).split(BATCH):
            rates = run(net, events[part])[1].mean(1)
            loss = nn.functional.cross_entropy(20 * rates, labels[part])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            right += int((rates.argmax(1) == labels[part]).sum())
        if epoch % 5 == 4:
            print(
                f"epoch {epoch + 1}: {100 * right / len(events):.1f} % in training, {time.monotonic() - begun:.0f} s"
            )
    with torch.no_grad():
        given = torch.from_numpy(test["events"]).float()
        hidden, out = run(net, given)
        accuracy = float((out.sum(1).argmax(1).numpy() == test["labels"]).mean())
    print(f"test split: {100 * accuracy:.2f} %")
    for layer in (net[1], net[3]):
        layer.reset_mem()
    nir.write(arguments.folder / "snntorch.nir", export_to_nir(net, given[:1, :, 0], ignore_dims=[0]))
    if not arguments.recurrent:
        rest = (given[:1, :, 0], *(torch.zeros(1, len(layer.beta)) for layer in (net[1], net[3])))
        torch.onnx.export(Step(net).eval(), rest, arguments.folder / "snntorch.onnx", dynamo=False)
    spikes = {"1": np.packbits(hidden.numpy() > 0), "3": np.packbits(out.numpy() > 0)}
    np.savez_compressed(arguments.folder / "snntorch_spikes.npz", shape=np.array(hidden.shape), **spikes)


if __name__ == "__main__":
    main()
