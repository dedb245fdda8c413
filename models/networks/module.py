"""Compile any torch module made of affine stages and :class:`lif.LIF` layers.

A stage is read by probing it in float64, so the compiler need not know its layers: unit vectors give its weights,
random combinations tell whether it is affine at all. New layer types need nothing but a ``forward``.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import sparse
from torch import Tensor, nn

from spikeloom.compiler import DEFAULT_TARGET, Compilation, Options, compile_network
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.assemble import Layer, assemble, class_of_each
from spikeloom.compiler.formats.names import unique_names
from spikeloom.compiler.ir import INPUT, Network, Sparse
from spikeloom.compiler.sensor_layout import sensor_layout
from spikeloom.compiler.types import FloatArray
from spikeloom.models.networks.lif import LIF, reset

AFFINE_TOLERANCE = 1e-9
"""Largest deviation from affinity, relative to the stage's largest response, that rounding in float64 explains."""

PROBES = 512
"""Unit vectors that run together."""

AMPLITUDE = 2.0**20
"""Of a unit vector: so large that the bias costs no digits of a weight, and a power of two."""

NOTHING = 2.0**-50
"""Share of a stage's largest response that is rounding."""


class _Probe:
    """A network whose spikes are given from outside, so that only its stages are left."""

    def __init__(self, net: nn.Module, example: Tensor) -> None:
        reset(net)
        self.net = copy.deepcopy(net).double().eval()
        self.names = {id(module): name for name, module in self.net.named_modules() if isinstance(module, LIF)}
        self.order: list[LIF] = []
        self.currents: list[Tensor] = []
        self.forced: list[Tensor] | None = None
        for module in self.net.modules():
            if isinstance(module, LIF):
                module.register_forward_hook(self._record)
        self.example = example.detach().double()
        first, _ = self._forward(self.example, None)
        calls = [id(layer) for layer in self.order]
        for layer in self.order:
            if calls.count(id(layer)) > 1:
                raise ModelError(
                    f"module {self._name(layer)}: is called {calls.count(id(layer))} times in a step, each LIF layer "
                    "holds the neurons of one place; use one for each"
                )
        if not first:
            raise ModelError("module: has no LIF layer, so nothing spikes; put spikeloom.LIF between its stages")
        self.shapes = [tuple(current.shape) for current in first]
        self.batched = self._is_batched()

    def _name(self, layer: LIF) -> str:
        return self.names[id(layer)] or type(layer).__name__

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the LIF layers, in the order of their calls."""
        return tuple(self._name(layer) for layer in self.order)

    @property
    def step_shape(self) -> tuple[int, ...]:
        """Shape of the input of one recording in one step."""
        return tuple(self.example.shape[1:] if self.batched else self.example.shape)

    def sizes(self) -> list[int]:
        """Elements of the input, then of each layer, for one recording."""
        shapes = [self.example.shape, *self.shapes]
        return [int(np.prod(shape[1:] if self.batched else shape)) for shape in shapes]

    def _record(self, layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        assert isinstance(layer, LIF)
        place = len(self.currents)
        self.currents.append(inputs[0])
        if self.forced is None:
            self.order.append(layer)
            return output
        return self.forced[place]

    def _forward(self, x: Tensor, forced: list[Tensor] | None) -> tuple[list[Tensor], Tensor]:
        self.currents, self.forced = [], forced
        reset(self.net)
        with torch.no_grad():
            output = self.net(x)
        if not isinstance(output, Tensor):
            raise ModelError(f"module: returns a {type(output).__name__}, wanted one tensor, the spikes of its classes")
        return self.currents, output

    def _is_batched(self) -> bool:
        """Whether two inputs stacked along the first axis give two responses stacked."""
        if self.example.dim() < 2:
            return False
        generator = torch.Generator().manual_seed(0)
        one, other = (
            [torch.randn((1, *shape[1:]), generator=generator, dtype=torch.float64) for shape in
             (self.example.shape, *self.shapes)] for _ in range(2)
        )  # fmt: skip
        try:
            single = [self._forward(side[0], side[1:]) for side in (one, other)]
            both = self._forward(
                torch.cat([one[0], other[0]]), [torch.cat(p) for p in zip(one[1:], other[1:], strict=True)]
            )
        except (IndexError, RuntimeError):
            return False  # a layer that knows how many rows there are takes no second recording
        expected = [[*currents, output] for currents, output in single]
        return all(
            a.shape[0] == 1 and c.shape == (2, *a.shape[1:]) and torch.allclose(c, torch.cat([a, b]))
            for a, b, c in zip(*expected, [*both[0], both[1]], strict=True)
        )

    def respond(self, sources: Sequence[FloatArray]) -> list[FloatArray]:
        """Currents of each layer and then the output, (probes, size), for the input and spikes of each layer."""
        tensors = [torch.from_numpy(np.ascontiguousarray(values)) for values in sources]
        shapes = [tuple(self.example.shape), *self.shapes]
        if self.batched:
            shaped = [tensor.reshape(-1, *shape[1:]) for tensor, shape in zip(tensors, shapes, strict=True)]
            currents, output = self._forward(shaped[0], shaped[1:])
            return [current.reshape(len(sources[0]), -1).numpy() for current in [*currents, output]]
        rows = []
        for row in range(len(sources[0])):
            shaped = [tensor[row].reshape(shape) for tensor, shape in zip(tensors, shapes, strict=True)]
            currents, output = self._forward(shaped[0], shaped[1:])
            rows.append([current.reshape(-1).numpy() for current in [*currents, output]])
        return [np.stack(parts) for parts in zip(*rows, strict=True)]


def _weights(probe: _Probe) -> tuple[list[list[Sparse]], list[FloatArray]]:
    """Weights from each source into each layer and the output, ``[target][source]``, and the biases."""
    sizes = probe.sizes()
    silent = [np.zeros((1, size)) for size in sizes]
    bias = [response[0] for response in probe.respond(silent)]
    weights: list[list[Sparse]] = [[] for _ in bias]
    for source, size in enumerate(sizes):
        parts: list[list[Sparse]] = [[] for _ in bias]
        for start in range(0, size, PROBES):
            units = np.eye(min(PROBES, size - start), size, start) * AMPLITUDE
            given = [units if place == source else np.zeros((len(units), other)) for place, other in enumerate(sizes)]
            for target, response in enumerate(probe.respond(given)):
                change = response - bias[target]
                # What a differently ordered sum leaves of nothing is no synapse.
                change[np.abs(change) <= NOTHING * max(np.abs(response).max(initial=0), AMPLITUDE * NOTHING)] = 0
                parts[target].append(sparse.csr_array((change / AMPLITUDE).T))
        for target, columns in enumerate(parts):
            weights[target].append(sparse.hstack(columns, format="csr"))
    return weights, bias


def _require_affine(probe: _Probe, weights: list[list[Sparse]], bias: list[FloatArray]) -> None:
    """Random combinations of all sources, small and large, must give the same combinations of the weights."""
    rng = np.random.default_rng(0)
    given = [rng.normal(size=(8, size)) * 10.0 ** np.arange(-2, 6)[:, None] for size in probe.sizes()]
    named = [f"the stage before {name}" for name in probe.layers] + ["the output"]
    for what, found, parts, shift in zip(named, probe.respond(given), weights, bias, strict=True):
        expected = sum((values @ part.T for values, part in zip(given, parts, strict=True)), start=shift)
        worst = np.abs(found - expected).max(axis=1, initial=0) / np.maximum(
            np.abs(expected).max(axis=1, initial=0), 1e-300
        )
        if not np.all(worst <= AFFINE_TOLERANCE):
            raise ModelError(
                f"module: {what} is not affine (a random combination of inputs is off by {worst.max():.2g} of the "
                f"response, {AFFINE_TOLERANCE:g} allowed); only affine stages between LIF layers can become synapses"
            )


def module_network(
    net: nn.Module, example: Tensor, *, polarities: int | None = None, polarities_first: bool | None = None
) -> Network:
    """Lower a module to a network of populations and synapses, in float64.

    The ``forward`` of `net` takes the input of one step and calls :class:`lif.LIF` layers; it returns the spikes of the
    last one, or a sum of them for each class. It is copied and brought to rest. The `example` is an input of one step;
    its first axis may be a batch, else the module is probed one input at a time. For `polarities` and
    `polarities_first` see :func:`sensor_layout.sensor_layout`.

    ModelError if a stage is not affine, or the chip cannot have the network.

    Examples
    --------
    >>> net = nn.Sequential(nn.Linear(4, 3), LIF(), nn.Linear(3, 2), LIF(beta=0.9))
    >>> [(population.name, population.size) for population in module_network(net, torch.zeros(1, 4)).populations]
    [('1', 3), ('3', 2)]
    """
    probe = _Probe(net, example)
    weights, bias = _weights(probe)
    _require_affine(probe, weights, bias)
    sensor, positions, _ = sensor_layout(probe.step_shape, polarities=polarities, polarities_first=polarities_first)
    layers = []
    names = unique_names(probe.layers)
    for index, (layer, name) in enumerate(zip(probe.order, names, strict=True)):
        sources = {source - 1: part for source, part in enumerate(weights[index]) if part.nnz}
        if INPUT in sources:
            sources[INPUT] = sources[INPUT][:, positions]
        layers.append(
            Layer(name=name, beta=float(layer.beta), theta=float(layer.theta), bias=bias[index], sources=sources)
        )
    given = [source for source, part in enumerate(weights[-1]) if part.nnz]
    label = class_of_each(weights[-1][given[0]]) if len(given) == 1 and given[0] > 0 else None
    if label is None or np.ptp(bias[-1]) > 0 or any(given[0] - 1 in layer.sources for layer in layers):
        raise ModelError(
            "module: its output is no count of the spikes of its last LIF layer; return these spikes, or their sum "
            "over a group of neurons for each class"
        )
    return assemble(layers, sensor, given[0] - 1, label)


def compile_module(
    net: nn.Module,
    example: Tensor,
    *,
    polarities: int | None = None,
    polarities_first: bool | None = None,
    target: str = DEFAULT_TARGET,
    options: Options | None = None,
) -> Compilation:
    """Compile a module: :func:`module_network`, then :func:`compiler.compile_network`."""
    network = module_network(net, example, polarities=polarities, polarities_first=polarities_first)
    options = options or Options()
    provenance = {"module": type(net).__name__, **options.provenance}
    return compile_network(network, replace(options, provenance=provenance), target=target)
