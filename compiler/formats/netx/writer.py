"""A netlist as a lava-dl ``.net`` file, whose limits are narrower than the chip's, and what they change.

The format keeps one threshold for a layer, weights of 8 bits without an exponent, and biases in whole weight steps,
where the chip counts 64ths of them. Layers follow each other and may be recurrent; convolutions are written out as
dense layers. A layer whose weights are stored with an exponent is rescaled by a power of two, its threshold with it.

It says nothing of the sensor, of clocks, which are inputs as others, and of classes for which several neurons vote.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.fixedpoint import BIAS_MANTISSA_MAX, MEMBRANE_SHIFT, THRESHOLD_MANTISSA_MAX
from spikeloom.compiler.formats.hdf5 import Tree, hdf5_bytes, tree_of
from spikeloom.compiler.formats.netx.reader import integers_of
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.ir import INPUT, IntegerNetwork, IntegerPopulation
from spikeloom.compiler.types import BoolArray, IntArray

MOST_SHIFT = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Rounding:
    """What the format changes in a layer; empty as words if nothing."""

    name: str  # Layer of the netlist
    biases: int
    biases_rounded: int
    furthest_steps: float  # Largest change of a bias, in weight steps of the netlist
    threshold_rounded: bool
    rescaled_by: float  # Power of two that everything was multiplied by

    def __str__(self) -> str:
        words = []
        if self.biases_rounded:
            words.append(
                f"{self.biases_rounded} of {self.biases} biases rounded, by {self.furthest_steps:.3g} steps at most"
            )
        words += ["threshold rounded"] if self.threshold_rounded else []
        words += [f"rescaled by {self.rescaled_by:g}"] if self.rescaled_by != 1 else []
        return f"{self.name}: {', '.join(words)}" if words else ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DenseLayer:
    """One dense layer of the file, ``dense_rec`` if it is recurrent; weights and biases in whole weight steps."""

    weight: IntArray  # (neurons, inputs) int64
    own: IntArray | None  # (neurons, neurons) int64; from itself
    bias: IntArray  # (neurons,) int64, rounded
    threshold: int
    decay_u: int
    decay_v: int
    rounding: Rounding

    @property
    def synapses(self) -> int:
        """Weights that are not zero."""
        return int(np.count_nonzero(self.weight)) + (0 if self.own is None else int(np.count_nonzero(self.own)))


def blocks_for(network: IntegerNetwork) -> tuple[DenseLayer, ...]:
    """Layers of the file; ModelError if the format cannot hold the network."""
    found = []
    for post, population in enumerate(network.populations):
        into = [projection for projection in network.projections if projection.post == post]
        before = post - 1 if post else INPUT
        last = len(network.populations) - 1
        if any(projection.pre not in (before, post) for projection in into) or network.readout.population != last:
            raise ModelError(f"{population.name}: receives more than the layer before it; netx has layers in a row")
        # side by side from the layer before and, where it is recurrent, from its own neurons
        sources = {before: network.input.size if before == INPUT else network.populations[before].size}
        sources |= {post: population.size} if any(projection.pre == post for projection in into) else {}
        parts = {pre: np.zeros((population.size, size), np.int64) for pre, size in sources.items()}
        for projection in into:
            parts[projection.pre] += projection.effective().toarray()
        weight = np.concatenate(list(parts.values()), axis=1)
        # Neurons that the chip leaves out have no synapses and no bias, and fire at no threshold.
        received = np.any(weight, axis=1) | (population.bias != 0)
        thresholds = np.unique(population.threshold[received])
        if len(thresholds) > 1:
            raise ModelError(
                f"{population.name}: has {len(thresholds)} thresholds, netx has one for a layer; compile with "
                "--scale-groups 1"
            )
        threshold = int(thresholds[0]) if len(thresholds) else int(population.threshold[0])
        found.append(_block(population, weight, sources[before], threshold))
    return tuple(found)


def _block(population: IntegerPopulation, weight: IntArray, inputs: int, threshold: int) -> DenseLayer:
    """A layer with these weights, those of its `inputs` first, then its own."""
    name = population.name
    shift = _shift(name, weight, threshold)
    shifted = np.ldexp(weight.astype(np.float64), shift).astype(np.int64)
    steps = np.ldexp(population.bias.astype(np.float64), shift - MEMBRANE_SHIFT)
    whole = np.rint(steps).astype(np.int64)
    scaled = np.ldexp(float(threshold), shift)
    if np.abs(whole).max(initial=0) > BIAS_MANTISSA_MAX:
        raise ModelError(
            f"{name}: has a bias of {np.abs(whole).max()} weight steps, netx holds {BIAS_MANTISSA_MAX}; train with "
            "smaller biases"
        )
    return DenseLayer(
        weight=shifted[:, :inputs],
        own=shifted[:, inputs:] if weight.shape[1] > inputs else None,
        bias=whole,
        threshold=max(1, int(np.rint(scaled))),
        decay_u=population.decay_u,
        decay_v=population.decay_v,
        rounding=Rounding(
            name=name,
            biases=len(whole),
            biases_rounded=int(np.count_nonzero(whole != steps)),
            furthest_steps=float(np.ldexp(np.abs(whole - steps).max(initial=0), -shift)),
            threshold_rounded=bool(scaled != np.rint(scaled)),
            rescaled_by=2.0**shift,
        ),
    )


def _shift(name: str, weight: IntArray, threshold: int) -> int:
    """The smallest power of two by which weights become even and fit 8 bits."""
    for size in range(MOST_SHIFT + 1):
        for shift in {size, -size}:
            scaled = np.ldexp(weight.astype(np.float64), shift)
            fits = -256 <= scaled.min(initial=0) and scaled.max(initial=0) <= 254
            if fits and not np.any(scaled % 2) and np.ldexp(float(threshold), shift) <= THRESHOLD_MANTISSA_MAX:
                return shift
    raise ModelError(
        f"{name}: has weights from {weight.min()} to {weight.max()}, netx holds 8 bits without an exponent; compile "
        "with --planes 1 --weight-bits 8"
    )


def file_bytes(network: IntegerNetwork, blocks: Sequence[DenseLayer]) -> bytes:
    """Content of the file, HDF5 as lava-dl writes it; equal networks give equal bytes.

    Neurons name their type by a single text of ten letters, layers by a list of one.
    """
    layers: Tree = {"0": {"type": np.array(["input"], "S10"), "shape": np.array([network.input.size])}}
    for number, block in enumerate(blocks, 1):
        neurons, inputs = block.weight.shape
        layers[str(number)] = {
            "type": np.array(["dense" if block.own is None else "dense_rec"], "S10"),
            "shape": np.array([neurons]),
            "inFeatures": np.array(inputs),
            "outFeatures": np.array(neurons),
            "weight": block.weight.astype(np.int16),
            **({} if block.own is None else {"weight_rec": block.own.astype(np.int16)}),
            "bias": block.bias,
            "neuron": {
                "type": np.array("CUBA", "S10"),
                "iDecay": np.array(block.decay_u + 1),
                "vDecay": np.array(block.decay_v),
                "vThMant": np.array(block.threshold),
                "refDelay": np.array(1),
                "gradedSpike": np.array(False),
            },
        }
    return hdf5_bytes({"layer": layers})


def moved_spikes(
    network: IntegerNetwork, blocks: Sequence[DenseLayer], events: BoolArray
) -> dict[str, tuple[int, int]]:
    """Spikes of each layer that the rounding moves, and how many the netlist has; events (samples, steps, channels)."""
    written, _ = integers_of(tree_of(file_bytes(network, blocks)), polarities=1)
    before, after = (run_integer(one, events).spikes for one in (network, written))
    return {
        block.rounding.name: (int(np.count_nonzero(a != b)), int(np.count_nonzero(a)))
        for block, a, b in zip(blocks, before, after, strict=True)
    }
