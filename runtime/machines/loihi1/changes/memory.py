"""What Loihi 1 stores of a network, damaged together with the float network beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.arrays import frozen, read_only
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.targets.loihi1 import registers
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.capabilities import Memory


@dataclass(frozen=True, kw_only=True, eq=False)
class LoihiMemory(Memory):
    """Neurons are compartments; weights are mantissas in the steps of their width."""

    netlist: Netlist
    network: Network

    @property
    def widths(self) -> IntArray:
        """Of the format of each synapse's axon."""
        return self.netlist.format_weight_bits[self._format]

    @property
    def _format(self) -> IntArray:
        return self.netlist.axon_format[self.netlist.axon_of_synapse()]

    @property
    def codes(self) -> IntArray:
        """Mantissas without the bits that their width does not have."""
        return self.netlist.synapse_weight.astype(np.int64) // weight_steps(self.widths)

    @property
    def planes(self) -> int:
        """Exponents of a layer, at most."""
        exponent = self.netlist.format_exponent[self._format]
        layer = self.netlist.layer[self.netlist.synapse_compartment()]
        pairs = np.unique(np.stack([layer, exponent], axis=1), axis=0)
        return int(np.bincount(pairs[:, 0]).max(initial=0))

    @property
    def thresholds(self) -> IntArray:
        """Threshold mantissas."""
        return self.netlist.threshold

    @property
    def hidden(self) -> IntArray:
        """Compartments without a class that are no relays."""
        return np.flatnonzero((self.netlist.readout_class < 0) & ~self._relays)

    @property
    def _relays(self) -> BoolArray:
        """Compartments that relay a clock; (compartments,)."""
        first = np.array([population.size - population.relays for population in self.network.populations])
        return np.asarray(first[self.netlist.layer] <= self.netlist.neuron)

    @property
    def windows(self) -> bool:
        """A free-running chip has none."""
        return not self.netlist.blank

    def with_codes(self, codes: IntArray) -> LoihiMemory:
        """Change mantissas, and float weights by as many weight units."""
        weight = (codes * weight_steps(self.widths)).astype(self.netlist.synapse_weight.dtype)
        netlist = replace(self.netlist, synapse_weight=frozen(weight))
        changed = np.flatnonzero(weight != self.netlist.synapse_weight)
        units = netlist.effective_weight()[changed] - self.netlist.effective_weight()[changed]
        return LoihiMemory(netlist=netlist, network=self._with_weight_units(changed, units))

    def _with_weight_units(self, synapses: IntArray, units: IntArray) -> Network:
        """The float network with the weights of some synapses changed by so many weight units."""
        netlist = self.netlist
        target = netlist.synapse_compartment()[synapses]
        source = netlist.axon_source[netlist.axon_of_synapse()[synapses]]
        inner = source >= netlist.n_inputs
        sender = np.where(inner, source - netlist.n_inputs, 0)
        pre = np.where(inner, netlist.layer[sender], INPUT)
        column = np.where(inner, netlist.neuron[sender], source)
        post = netlist.layer[target]
        row = netlist.neuron[target]
        step = units / netlist.scale[target]
        projections = []
        for projection in self.network.projections:
            here = (post == projection.post) & (pre == projection.pre)
            more = sparse.csr_array((step[here], (row[here], column[here])), shape=projection.weight.shape)
            weight = projection.weight + more if here.any() else projection.weight
            projections.append(replace(projection, weight=weight))
        return replace(self.network, projections=tuple(projections), convolution=None)

    def with_stuck(self, neurons: IntArray, *, firing: bool) -> LoihiMemory:
        """Take their weights away, and give them a bias, or none."""
        netlist = self.netlist
        stuck = np.zeros(netlist.n_compartments, np.bool_)
        stuck[neurons] = True
        weight = np.where(stuck[netlist.synapse_compartment()], 0, netlist.synapse_weight)
        damaged = replace(
            netlist,
            synapse_weight=frozen(weight.astype(netlist.synapse_weight.dtype)),
            bias_mantissa=read_only(np.where(stuck, int(firing), netlist.bias_mantissa)),
            bias_exponent=read_only(np.where(stuck, 0, netlist.bias_exponent)),
            threshold=read_only(np.where(stuck & firing, 0, netlist.threshold)),
        )
        network = self._scaled_inputs(np.where(stuck, 0.0, 1.0), np.where(stuck, 2.0 * firing, 0.0))
        return LoihiMemory(netlist=damaged, network=network)

    def with_thresholds(self, thresholds: IntArray) -> LoihiMemory:
        """Change mantissas; in the float network thresholds change by the same factor.

        A neuron with another threshold fires as one with the old one whose weights and bias are divided by
        the factor.
        """
        before = self.netlist.threshold
        most = registers.THRESHOLD_MANTISSA_MAX
        after = np.where(self._relays, before, np.clip(thresholds, 1, most))
        factor = np.maximum(before, 1) / np.maximum(after, 1)
        netlist = replace(self.netlist, threshold=read_only(after))
        return LoihiMemory(netlist=netlist, network=self._scaled_inputs(factor, np.zeros(len(factor))))

    def _scaled_inputs(self, factor: FloatArray, more: FloatArray) -> Network:
        """The float network with each neuron's weights and bias times a factor, and `more` thresholds of bias."""
        netlist = self.netlist
        populations = []
        factors = []
        for number, population in enumerate(self.network.populations):
            ids = netlist.compartments_of(number)
            neurons = netlist.neuron[ids]
            scale = np.ones(population.size)
            scale[neurons] = factor[ids]
            bias = population.bias.copy()
            bias[neurons] = bias[neurons] * factor[ids] + population.theta * more[ids]
            factors.append(scale)
            populations.append(replace(population, bias=bias))
        projections = []
        for projection in self.network.projections:
            weight = projection.weight.copy()
            weight.data *= np.repeat(factors[projection.post], np.diff(weight.indptr))
            projections.append(replace(projection, weight=weight))
        changed = replace(self.network, populations=tuple(populations), projections=tuple(projections))
        return replace(changed, convolution=None)

    def with_late_layers(self, steps: int) -> LoihiMemory:
        """Move windows of the netlist, from which the float network takes its depths."""
        layers = [
            replace(layer, depth=layer.depth + steps) if layer.depth else layer
            for layer in self.netlist.layers
        ]
        return replace(self, netlist=replace(self.netlist, layers=tuple(layers)))

    def with_decays(self, factor: float) -> LoihiMemory:
        """Change decay registers; the float network has what they realise."""
        decays = np.array(
            [
                registers.decay_registers(layer.beta * factor, layer.alpha * factor)
                for layer in self.netlist.layers
            ]
        )
        decay_u, decay_v = decays[self.netlist.layer].T
        netlist = replace(self.netlist, decay_u=read_only(decay_u), decay_v=read_only(decay_v))
        one = 1 << registers.DECAY_BITS
        populations = tuple(
            replace(population, beta=(one - v) / one, alpha=(one - 1 - u) / one)
            for population, (u, v) in zip(self.network.populations, decays.tolist(), strict=True)
        )
        return LoihiMemory(netlist=netlist, network=replace(self.network, populations=populations))


def weight_steps(bits: IntArray) -> IntArray:
    """Distance of neighbouring mantissas of each width; as :func:`registers.weight_step`."""
    return np.array([0, 0, *(registers.weight_step(width) for width in range(2, 9))])[bits]
