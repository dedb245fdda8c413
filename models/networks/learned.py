"""What a fine-tuning learns of a layer: each synapse by itself, or filters that its places share."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn

from spikeloom.compiler import ir
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.passes.expand import stack_of
from spikeloom.compiler.systems import in_order
from spikeloom.compiler.targets.compartments import IntegerNetwork, one_sided_sums, registers

SHRINK = 0.98
"""A neuron whose weights would overflow the accumulator has them scaled by this, until they do not."""

WITHIN = 0.49
"""Share of a step that a weight may be away from the integer that it starts at."""

MATRIX_LIMIT = 2**26
"""Weights of a layer, zeros among them, which is one matrix here."""

Array = NDArray[Any]


class Stage:
    """A population and the synapses into it: its sources lie side by side, its own spikes last."""

    def __init__(self, network: ir.Network, post: int, form: ir.Form) -> None:
        into = sorted((p for p in network.projections if p.post == post), key=lambda p: p.pre == post)
        self.post = post
        self.population = network.populations[post]
        self.form = form
        self.sources = [p.pre for p in into]
        self.inputs = sum(p.weight.shape[1] for p in into if p.pre != post)
        weight = sparse.hstack([p.weight for p in into], format="csr")
        weight.sort_indices()
        self.shape = weight.shape
        if np.prod(weight.shape) > MATRIX_LIMIT:
            size = f"{weight.shape[0]:,} x {weight.shape[1]:,} weights, zeros among them"
            raise ModelError(
                f"{self.population.name}: has {size}, fine-tuning holds {MATRIX_LIMIT:,}; use it as it is"
            )
        self.row = np.repeat(np.arange(weight.shape[0]), np.diff(weight.indptr))
        self.column = weight.indices
        self.ends = weight.indptr
        # neurons that relay a clock come last; they learn nothing
        self.learning = self.population.size - self.population.relays
        self.synapses = int(weight.indptr[self.learning])  # that learn, which come first
        self.weight = torch.tensor(weight.data[: self.synapses]).float()
        self.relays = torch.tensor(weight.data[self.synapses :])
        self.step = registers.step_units(form.bits, form.exponents)
        self.scale = form.threshold / self.population.theta

    @property
    def membrane_scale(self) -> Array:
        """Membrane units of the chip per membrane unit of the float model, (neurons,)."""
        return self.scale * (1 << registers.MEMBRANE_SHIFT)

    def one_sided(self, steps: Array) -> tuple[Array, Array]:
        """Largest positive and negative sum of each neuron, each plane by itself, as :func:`bounds.one_sided`."""
        exponents = self.form.exponents
        planes = zip(registers.split_planes(steps, self.form.bits, exponents), exponents, strict=True)
        sides = [
            one_sided_sums(registers.in_units(mantissa, exponent), self.ends)
            for mantissa, exponent in planes
        ]
        positive, negative = np.sum(sides, axis=0)
        return positive, negative


class _Parameters(nn.Module):
    """Parameters of a layer; methods change them in place."""

    def __init__(self, stage: Stage, bias: Tensor) -> None:
        super().__init__()
        self.stage = stage
        self.bias = nn.Parameter(bias)

    def start_at(self, integer: IntegerNetwork) -> None:
        """Move to where it rounds to an integer network of these forms, no farther."""

    def clip(self) -> None:
        """Keep single weights within half a step of what their storage holds, so that none gets lost."""

    def clip_bias(self, bound: Array) -> None:
        """Keep biases within what the register of every neuron holds, `bound` (neurons,)."""
        limit = torch.tensor(bound, dtype=torch.float32) * SHRINK
        self.bias.copy_(torch.clamp(self.bias, -limit, limit))


class Synapses(_Parameters):
    """Each synapse and each bias by itself."""

    def __init__(self, stage: Stage) -> None:
        super().__init__(stage, torch.tensor(stage.population.bias[: stage.learning]).float())
        self.weight = nn.Parameter(stage.weight)
        self.row = stage.row[: stage.synapses]
        self.column = stage.column[: stage.synapses]

    def values(self) -> tuple[Tensor, Tensor]:
        """Weights of all synapses that learn, and biases of the neurons that do, in float64."""
        return self.weight.double(), self.bias.double()

    def start_at(self, integer: IntegerNetwork) -> None:
        """Move weights and biases to where they round to the integers."""
        stage = self.stage
        planes = ir.added_up((p.pre, p.effective()) for p in integer.projections if p.post == stage.post)
        units = sparse.hstack([planes[pre] for pre in stage.sources]).toarray()
        steps = units[self.row, self.column] / stage.step
        step = (stage.step / stage.scale)[self.row]
        near = np.clip(self.weight.detach().numpy() / step, steps - WITHIN, steps + WITHIN) * step
        bias = integer.populations[stage.post].bias / stage.membrane_scale
        self.weight.copy_(torch.tensor(near))
        self.bias.copy_(torch.tensor(bias[: stage.learning]))

    def clip(self) -> None:
        """Keep weights within half a step of what their storage holds."""
        stage = self.stage
        most = (registers.reach(stage.form.bits, stage.form.exponents) + 0.5) * stage.step / stage.scale
        limit = torch.tensor(most[self.row], dtype=torch.float32)
        self.weight.copy_(torch.clamp(self.weight, -limit, limit))

    def clip_bias(self, bound: Array) -> None:
        """Keep biases within what the registers of neurons that learn hold."""
        super().clip_bias(bound[: self.stage.learning])

    def shrink(self, wrong: Array) -> None:
        """Shrink what makes some neurons, (neurons,) bool, overflow: their weights."""
        self.weight[torch.tensor(wrong[self.row])] *= SHRINK
        if self.stage.population.alpha:  # what lasts fills the membrane together with the bias
            self.bias[torch.tensor(wrong[: self.stage.learning])] *= SHRINK

    def tensors(self) -> tuple[Tensor, Tensor]:
        """Matrix (neurons, inputs) and biases, as a checkpoint holds them."""
        return self.weight.view(len(self.bias), -1), self.bias


class Filters(_Parameters):
    """Filters that all places of a first layer share; they start as they are, and no weight is clipped by itself."""

    def __init__(self, stage: Stage, convolution: ir.Convolution) -> None:
        super().__init__(stage, torch.tensor(convolution.bias))
        self.system = convolution.system
        self.stack = stack_of(convolution)
        self.filters = nn.Parameter(torch.tensor(convolution.filters))
        self.places = self.stack.shape[1]
        self.features = len(convolution.bias)

    def values(self) -> tuple[Tensor, Tensor]:
        """Weights of all synapses that learn, written out, and biases of the neurons that do, in float64."""
        stage = self.stage
        dense = torch.einsum("kij,kfc->ifjc", torch.tensor(self.stack), self.filters.double())
        dense = in_order(self.system, dense).reshape(stage.learning, -1)
        bias = in_order(self.system, self.bias.double().repeat(self.places).view(self.places, self.features))
        return dense[stage.row[: stage.synapses], stage.column[: stage.synapses]], bias

    def clip_bias(self, bound: Array) -> None:
        """Keep them within what the registers of all neurons hold."""
        super().clip_bias(bound.min())

    def shrink(self, wrong: Array) -> None:
        """Shrink what makes some neurons, (neurons,) bool, overflow: their filters."""
        feature = in_order(self.system, np.tile(np.arange(self.features), (self.places, 1)))
        self.filters[:, torch.tensor(np.unique(feature[wrong[: self.stage.learning]]))] *= SHRINK
        if self.stage.population.alpha and wrong.any():
            self.bias.mul_(SHRINK)

    def tensors(self) -> tuple[Tensor, Tensor]:
        """Filters and biases, as a checkpoint holds them."""
        return self.filters, self.bias


Learned = Synapses | Filters
"""What is learned of a layer."""
