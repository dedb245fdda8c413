"""Lower any torch module made of affine stages and :class:`lif.LIF` layers.

A stage is read in float64, so the compiler need not know its layers: torch's derivative gives its weights,
random combinations tell whether it is affine at all. New layer types need nothing but a ``forward``.
"""

import copy

import numpy as np
import torch
from scipy import sparse
from torch import Tensor, nn

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.assemble import Layer, assemble, class_of_each
from spikeloom.compiler.formats.names import unique_names
from spikeloom.compiler.formats.sensor_layout import sensor_layout
from spikeloom.compiler.ir import INPUT, Network, Sparse
from spikeloom.compiler.types import FloatArray
from spikeloom.models.networks.lif import LIF, reset

AFFINE_TOLERANCE = 1e-9
"""Largest deviation from affinity, relative to the stage's largest response, that rounding in float64 explains."""

FLOAT32 = 1e-5
"""Largest one that rounding in float32 explains."""

ROWS = 256
"""Neurons whose weights are read together."""

NOTHING = 2.0**-50
"""Share of a neuron's largest weight that is rounding: what a differently ordered sum leaves of nothing."""


class _Stages:
    """A network whose spikes are given from outside, so that only its stages are left."""

    def __init__(self, net: nn.Module, example: Tensor) -> None:
        reset(net)
        computed = {  # as pruning leaves, which no copy takes
            id(value): value.detach().to(torch.float64, copy=True)
            for part in net.modules()
            for value in (*vars(part).values(), *part.buffers(recurse=False))
            if isinstance(value, Tensor) and not value.is_leaf
        }
        try:
            self.net = copy.deepcopy(net, computed).double().eval().requires_grad_(False)
        except RuntimeError as error:
            raise ModelError(
                f"module: cannot be copied ({error}); let it keep parameters and buffers, no computed tensors"
            ) from None
        names = {id(module): name for name, module in self.net.named_modules() if isinstance(module, LIF)}
        self.order: list[LIF] = []
        self.currents: list[Tensor] = []
        self.forced: list[Tensor] = []
        for module in self.net.modules():
            if isinstance(module, LIF):
                if type(module).forward is not LIF.forward:
                    raise ModelError(
                        f"module {names[id(module)] or type(module).__name__}: has a forward of its own, so its "
                        "neurons may be others than the chip's; use spikeloom.LIF as it is"
                    )
                module.register_forward_hook(self._record)
        first = example.detach().double()
        self.batched = first.dim() > 1 and self._is_batch(first)
        try:
            responses = self.respond([first[:1] if self.batched else first])
        except (IndexError, RuntimeError) as error:
            shape = tuple(first.shape)
            remedy = "give one step's input"
            if "dtype" in str(error) or "ouble" in str(error):
                remedy = "it is read in float64, so let its forward take types from its input (x.dtype) and make none"
            raise ModelError(f"module: fails on the example of shape {shape} ({error}); {remedy}") from None
        self.names = tuple(names[id(layer)] or type(layer).__name__ for layer in self.order)
        for layer, name in zip(self.order, self.names, strict=True):
            if (calls := sum(each is layer for each in self.order)) > 1:
                raise ModelError(
                    f"module {name}: is called {calls} times in a step, each LIF layer holds the neurons of one place; "
                    "use one for each"
                )
        if not self.order:
            raise ModelError(
                "module: has no LIF layer, so nothing spikes; put spikeloom.LIF between its stages"
            )
        self.shapes = [
            tuple((first[:1] if self.batched else first).shape),
            *(tuple(r.shape) for r in responses[:-1]),
        ]

    def _record(self, layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        assert isinstance(layer, LIF)
        self.order.append(layer)
        self.currents.append(inputs[0])
        return self.forced[len(self.order) - 1] if self.forced else output

    def _is_batch(self, example: Tensor) -> bool:
        """Whether the first axis numbers recordings: one of them goes through all layers."""
        try:
            responses = self.respond([example[:1]])
        except (IndexError, RuntimeError):
            return False
        return all(response.shape[:1] == (1,) for response in responses)

    def respond(self, sources: list[Tensor], *, at_rest: bool = True) -> list[Tensor]:
        """Currents of each layer and then the output, for the input and, if they are given, spikes of each layer.

        Neurons are `at_rest` before it, or as the step before left them.
        """
        self.order = []
        self.currents = []
        self.forced = sources[1:]
        if at_rest:
            reset(self.net)
        output = self.net(sources[0])
        if not isinstance(output, Tensor):
            raise ModelError(
                f"module: returns a {type(output).__name__}, wanted one tensor, the spikes of its classes"
            )
        return [*self.currents, output]


def _weights(stages: _Stages) -> tuple[list[list[Sparse]], list[FloatArray]]:
    """Weights from each source into each layer and the output, ``[target][source]``, and the biases."""
    sources = [torch.zeros(shape, dtype=torch.float64, requires_grad=True) for shape in stages.shapes]
    nothing = sum(source.sum() * 0 for source in sources)  # so that every response depends on every source
    weights = []
    biases = []
    for response in stages.respond(sources):
        flat = response.reshape(-1) + nothing
        rows: list[list[Sparse]] = [[] for _ in sources]
        for start in range(0, len(flat), ROWS):
            units = torch.from_numpy(np.eye(min(ROWS, len(flat) - start), len(flat), start))
            gradients = torch.autograd.grad(flat, sources, units, retain_graph=True, is_grads_batched=True)
            for part, gradient in zip(rows, gradients, strict=True):
                block = gradient.reshape(len(units), -1).numpy()
                least = NOTHING * np.abs(block).max(axis=1, keepdims=True, initial=0)
                part.append(sparse.csr_array(np.where(np.abs(block) > least, block, 0)))
        weights.append([sparse.vstack(part, format="csr") for part in rows])
        biases.append(flat.detach().numpy())
    return weights, biases


def _require_affine(stages: _Stages, weights: list[list[Sparse]], biases: list[FloatArray]) -> None:
    """Random combinations of all sources, small and large, must give the same combinations of the weights.

    They are one step after the other, so a stage that looks at an earlier step is found, too.
    """
    rng = np.random.default_rng(0)
    named = [f"the stage before {name}" for name in stages.names] + ["the output"]
    for size in 10.0 ** np.arange(-2, 6):
        given = [rng.normal(size=shape) * size for shape in stages.shapes]
        responses = stages.respond([torch.from_numpy(values) for values in given], at_rest=False)
        for what, response, parts, bias in zip(named, responses, weights, biases, strict=True):
            expected = sum(
                (part @ values.ravel() for part, values in zip(parts, given, strict=True)), start=bias
            )
            off = np.abs(response.detach().numpy().ravel() - expected).max(initial=0) / max(
                np.abs(expected).max(initial=0), 1e-300
            )
            if not off <= AFFINE_TOLERANCE:
                hint = ", as of float32 made inside it" if off < FLOAT32 else ""
                raise ModelError(
                    f"module: {what} is not affine (a random combination of inputs is off by {off:.2g} of the "
                    f"response{hint}, {AFFINE_TOLERANCE:g} allowed); only stages that are affine in what comes in this "
                    "step become synapses"
                )


def module_network(
    net: nn.Module, example: Tensor, *, polarities: int | None = None, polarities_first: bool | None = None
) -> Network:
    """Lower a module to a network of populations and synapses, in float64.

    The ``forward`` of `net` takes the input of one step and calls :class:`lif.LIF` layers; it returns the
    spikes of the last one, or a sum of them for each class. It is copied and brought to rest. The `example`
    is an input of one step; its first axis may number recordings. For `polarities` and `polarities_first`
    see :func:`sensor_layout.sensor_layout`.

    ModelError if a stage is not affine, or the chip cannot have the network.

    >>> net = nn.Sequential(nn.Linear(4, 3), LIF(), nn.Linear(3, 2), LIF(beta=0.9))
    >>> [(population.name, population.size) for population in module_network(net, torch.zeros(1, 4)).populations]
    [('1', 3), ('3', 2)]
    """
    stages = _Stages(net, example)
    weights, bias = _weights(stages)
    _require_affine(stages, weights, bias)
    shape = stages.shapes[0][stages.batched :]
    sensor, positions, _ = sensor_layout(shape, polarities=polarities, polarities_first=polarities_first)
    layers = []
    names = unique_names(stages.names)
    for index, (layer, name) in enumerate(zip(stages.order, names, strict=True)):
        sources = {source - 1: part for source, part in enumerate(weights[index]) if part.nnz}
        if INPUT in sources:
            sources[INPUT] = sources[INPUT][:, positions]
        layers.append(
            Layer(
                name=name,
                beta=float(layer.beta),
                theta=float(layer.theta),
                bias=bias[index],
                sources=sources,
            )
        )
    given = [source for source, part in enumerate(weights[-1]) if part.nnz]
    label = class_of_each(weights[-1][given[0]]) if len(given) == 1 and given[0] > 0 else None
    if label is None or np.ptp(bias[-1]) > 0 or any(given[0] - 1 in layer.sources for layer in layers):
        raise ModelError(
            "module: its output is no count of the spikes of its last LIF layer; return these spikes, or their sum "
            "over a group of neurons for each class"
        )
    return assemble(layers, sensor, given[0] - 1, label, len(bias[-1]))
