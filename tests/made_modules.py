"""Torch networks of LIF layers and of layer types of their own; small, with fixed weights."""

import io
import warnings

import numpy as np
import torch
from torch import nn

from spikeloom.models.networks.lif import LIF, reset

TAXELS, CLASSES = 6, 3
RING = np.array(
    [[i, (i + 1) % TAXELS] for i in range(TAXELS)] + [[(i + 1) % TAXELS, i] for i in range(TAXELS)]
)
"""Edges of a ring of taxels, (source, target), both ways."""


def normalised(dtype=torch.float64):
    """Propagation matrix of the ring with one chord, rows gather."""
    adjacency = torch.zeros(TAXELS, TAXELS, dtype=dtype)
    for source, target in [*RING.tolist(), [0, 3], [3, 0]]:
        adjacency[target, source] = 1
    root = adjacency.sum(1) ** -0.5
    return root[:, None] * adjacency * root


class Tag(nn.Module):
    """``sum_k A^k x g_k + b``, with the matrix as a buffer."""

    def __init__(self, channels, features, hops=3):
        super().__init__()
        self.filters = nn.ModuleList(nn.Linear(channels, features, bias=False) for _ in range(hops + 1))
        self.bias = nn.Parameter(torch.randn(features) * 0.1)
        self.register_buffer("adjacency", normalised(torch.float32))

    def forward(self, x):
        out = self.filters[0](x)
        for linear in self.filters[1:]:
            x = self.adjacency @ x
            out = out + linear(x)
        return out + self.bias


class Messages(nn.Module):
    """Attention-free message passing: gather, weigh by the degrees, scatter."""

    def __init__(self, channels, features):
        super().__init__()
        self.linear = nn.Linear(channels, features)
        self.register_buffer("edges", torch.tensor(RING.T.copy()))

    def weigh(self):
        source, target = self.edges[0], self.edges[1]
        ones = torch.ones(source.shape[0], dtype=self.linear.weight.dtype)
        degree = torch.zeros(TAXELS, dtype=ones.dtype).scatter_add_(0, target, ones) + 1
        root = degree.pow(-0.5)
        root = root.masked_fill(root == float("inf"), 0.0)
        return root[source] * root[target]

    def forward(self, x):
        messages = self.weigh().view(-1, 1) * x.index_select(-2, self.edges[0])
        place = self.edges[1].view(-1, 1).expand_as(messages)
        return self.linear(torch.zeros_like(x).scatter_add_(-2, place, messages) + x)


class Mean(nn.Module):
    """A layer that no library has: each taxel beside the mean of all."""

    def forward(self, x):
        return torch.cat([x, x.mean(-2, keepdim=True).expand_as(x)], dim=-1)


def seeded(make):
    """A module with fixed weights, those of its stages large enough to make spikes."""
    torch.manual_seed(0)
    net = make()
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            if name.endswith("weight"):
                parameter.mul_(2)
        for module in net.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.running_mean.normal_(0, 0.3)
                module.running_var.uniform_(0.5, 2)
    return net.eval()


def graph_net(layer):
    """One graph layer on (batch, taxels, 2), then dense ones."""
    return nn.Sequential(
        layer, LIF(), nn.Flatten(1), nn.Linear(TAXELS * 8, 10), LIF(0.5, 0.4), nn.Linear(10, CLASSES), LIF()
    )


def mlp():
    return seeded(
        lambda: nn.Sequential(
            nn.Linear(2 * TAXELS, 16), LIF(0.9, 1.0), nn.Linear(16, CLASSES), LIF(0.3, 0.25)
        )
    )


def tag():
    return seeded(lambda: graph_net(Tag(2, 8)))


def gcn():
    return seeded(lambda: graph_net(Messages(2, 8)))


def averaged():
    return seeded(lambda: graph_net(nn.Sequential(Mean(), nn.Linear(4, 8))))


def grid():
    return seeded(
        lambda: nn.Sequential(
            nn.Conv2d(2, 4, 3, padding=1, stride=1),
            nn.BatchNorm2d(4),
            LIF(),
            nn.AvgPool2d(2),
            nn.Conv2d(4, 4, 2, groups=2, bias=False),
            LIF(),
            nn.Dropout(),
            nn.Flatten(1),
            nn.Linear(4, CLASSES),
            LIF(),
        )
    )


EXAMPLES = {"mlp": (1, 2 * TAXELS), "grid": (1, 2, 4, 4)}
NETS = {"tag": tag, "grid": grid, "mlp": mlp, "gcn": gcn, "averaged": averaged}


def example_of(name):
    """Input of one step of a batch of one."""
    return torch.zeros(EXAMPLES.get(name, (1, TAXELS, 2)))


def exported(module, inputs, *, dynamo=False, **options):
    """Bytes of an ONNX file, by one of torch's two exporters."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        if dynamo:
            torch.onnx.export(module, inputs, dynamo=True, verbose=False, **options).save(buffer)
        else:
            torch.onnx.export(module, inputs, buffer, dynamo=False, **options)
    return buffer.getvalue()


def lif_layers(net):
    return [module for module in net.modules() if isinstance(module, LIF)]


class OneStep(nn.Module):
    """One step of a network as a function: ``(x, state …) -> (output, state …)``; the example is for shapes."""

    def __init__(self, net: nn.Module, example: torch.Tensor) -> None:
        super().__init__()
        self.net = net
        reset(net)
        with torch.no_grad():
            net(example)
        self.rest = tuple(torch.zeros_like(tensor) for tensor in self._state())
        reset(net)

    def forward(self, x: torch.Tensor, *state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        for index, layer in enumerate(lif_layers(self.net)):
            layer.membrane, layer.spikes = state[2 * index], state[2 * index + 1]
        output: torch.Tensor = self.net(x)
        after = self._state()
        reset(self.net)
        return output, *after

    def _state(self) -> tuple[torch.Tensor, ...]:
        both = ((layer.membrane, layer.spikes) for layer in lif_layers(self.net))
        return tuple(tensor for pair in both for tensor in pair if tensor is not None)


def one_step(net, example, **options):
    """The file of one step with its state as inputs and outputs."""
    step = OneStep(net, example)
    return exported(step, (example, *step.rest), **options)


class AllSteps(nn.Module):
    """All steps of a recording, from rest: the mean of a network's output, for an input whose last axis is time."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        reset(self.net)
        total = self.net(x[..., 0])
        for step in range(1, x.shape[-1]):
            total = total + self.net(x[..., step])
        reset(self.net)
        return total / x.shape[-1]
