"""A compiled network as a torch module, spike for spike the chip, and as a model of the NeuroBench harness.

Weights, thresholds and registers are the netlist's integers, kept in float64, which holds every one of them and every
sum of them exactly. Layers are aligned with the data: what the chip does a step later, layer by layer, is not seen.

References
----------
.. [1] J. Yik et al., "The NeuroBench framework for benchmarking neuromorphic computing algorithms and systems",
   Nature Communications 16, 1545, 2025; the model interface is that of neurobench 2.3.0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from spikeloom.compiler import lift
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.ir import INPUT, IntegerPopulation
from spikeloom.compiler.targets.loihi1.netlist import Netlist


class ChipNeurons(nn.Module):
    """The neurons of one layer: a step's synaptic sums in, its spikes out; the state is kept between steps."""

    def __init__(self, population: IntegerPopulation) -> None:
        super().__init__()
        self._threshold = torch.from_numpy((population.threshold << MEMBRANE_SHIFT).astype(np.float64))
        self._bias = torch.from_numpy(population.bias.astype(np.float64))
        self._keeps = (population.realised_alpha, population.realised_beta)
        self.rest()

    def rest(self) -> None:
        """Forget everything."""
        # state is no parameter and no buffer: NeuroBench counts those as footprint
        self.__dict__["u"] = self.__dict__["v"] = torch.zeros((), dtype=torch.float64)

    def forward(self, sums: Tensor) -> Tensor:
        """Spikes (samples, neurons) of synaptic sums in weight units; float64, and zeros and ones."""
        keep_u, keep_v = self._keeps
        u = torch.trunc(self.__dict__["u"] * keep_u) + sums * (1 << MEMBRANE_SHIFT)
        v = torch.trunc(self.__dict__["v"] * keep_v) + u + self._bias
        v = torch.clamp(v, -MEMBRANE_MAX, MEMBRANE_MAX)
        spikes = (v > self._threshold).to(v.dtype)
        self.__dict__["u"], self.__dict__["v"] = u, v * (1 - spikes)
        return spikes


class ChipModule(nn.Module):
    """A netlist that runs as a torch module.

    Notes
    -----
    ``layers`` holds what NeuroBench looks for: a Linear for each layer that a layer receives from, its weights in
    weight units, and :class:`ChipNeurons`. What a recurrent layer receives from itself is what
    it fired in the step before.
    """

    def __init__(self, netlist: Netlist) -> None:
        super().__init__()
        network = lift(netlist)
        self.classes = network.classes
        self._label = torch.from_numpy(network.readout.label)
        self._voters = network.readout.population
        self._stages: list[list[tuple[int, nn.Linear]]] = []
        self.layers = nn.ModuleList()
        for post, population in enumerate(network.populations):
            into: dict[int, Any] = {}
            for projection in network.projections:
                if projection.post == post:
                    dense = projection.effective().toarray().astype(np.float64)
                    into[projection.pre] = into.get(projection.pre, 0) + dense
            stages = []
            for pre, weight in sorted(into.items()):
                linear = nn.Linear(weight.shape[1], weight.shape[0], bias=False, dtype=torch.float64)
                linear.weight = nn.Parameter(torch.from_numpy(weight), requires_grad=False)
                stages.append((pre, linear))
                self.layers.append(linear)
            self._stages.append(stages)
            self.layers.append(ChipNeurons(population))

    def forward(self, events: Tensor) -> Tensor:
        """Votes of each step, (samples, steps, classes), for events (samples, steps, channels), clocks among them."""
        neurons = [layer for layer in self.layers if isinstance(layer, ChipNeurons)]
        for layer in neurons:
            layer.rest()
        votes = torch.zeros((len(events), events.shape[1], self.classes), dtype=torch.float64)
        spikes: dict[int, Tensor] = {
            post: torch.zeros((len(events), stages[0][1].out_features), dtype=torch.float64)
            for post, stages in enumerate(self._stages)
        }
        for step in range(events.shape[1]):
            spikes[INPUT] = events[:, step].to(torch.float64)
            for post, (stages, layer) in enumerate(zip(self._stages, neurons, strict=True)):
                # in this order the layers before have fired in this step, the layer itself only in the last
                sums = [linear(spikes[pre]) for pre, linear in stages]
                spikes[post] = layer(torch.stack(sums).sum(0))
            votes[:, step].index_add_(1, self._label, spikes[self._voters])
        return votes


def vote(votes: Tensor) -> Tensor:
    """Class of each recording: most votes over all steps, the first on a tie; a post-processor for the harness.

    Examples
    --------
    >>> vote(torch.tensor([[[0.0, 1.0, 1.0], [0.0, 1.0, 1.0]]])).tolist()
    [1]
    """
    counts = votes.sum(dim=1)
    return torch.from_numpy(np.argmax(counts.numpy(), axis=1))


def neurobench_model(netlist: Netlist) -> Any:
    """The netlist as a ``neurobench.models.TorchModel``, to be given to ``neurobench.benchmarks.Benchmark``.

    Raises OptionError if the package neurobench is not installed.
    """
    try:
        from neurobench.models import TorchModel  # type: ignore[import-not-found]
    except ImportError as error:
        raise OptionError("neurobench: is not installed; pip install neurobench") from error
    model = TorchModel(ChipModule(netlist))
    model.add_activation_module(ChipNeurons)
    return model
