"""Read a network from ``.net`` files of lava-dl and SLAYER as what it is: integers, registers and all.

``layer/0`` … each have ``type`` and ``shape``; ``dense`` and ``conv`` have ``weight`` (to, from) or
(filters, channels, height, width), maybe ``bias``, and ``neuron`` with ``iDecay``, ``vDecay``, ``vThMant``,
``refDelay``. A layer fed by its own spikes of the step before is ``dense_rec`` with ``weight_rec`` in lava-dl,
``recurrent`` with ``recWeight`` in SLAYER's files, both (to, from). Shapes of images are (channels, height,
width), as torch has them, and kernels are not turned round. Numbers are the chip's registers, but for three:
``iDecay`` is one more than the register of the current's decay, biases count whole weight steps, and weights
of both signs are even.

References
----------
.. [1] lava-dl 0.6.0, ``netx/README.md``, ``netx/hdf5.py`` and ``slayer/block/base.py``.
.. [2] SLAYER for Loihi: slayerPytorch 01beeeb, ``src/slayerLoihi.py`` and ``src/cuda/spikeLoihiKernels.h``; what puts
   its files on the chip: intel-nrc-ecosystem/models 3dc53bf, ``slayer_rec/src/s2lWrapper.py`` and ``slayer2loihi.py``.
"""

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse

from spikeloom.compiler import ir
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import reading
from spikeloom.compiler.formats.affine import convolution
from spikeloom.compiler.formats.assemble import ReadNetwork
from spikeloom.compiler.formats.hdf5 import AGAIN, Part, Tree, entry_of, read_hdf5
from spikeloom.compiler.formats.names import named, printable
from spikeloom.compiler.formats.sensor_layout import sensor_layout
from spikeloom.compiler.targets.loihi1.integers import (
    MANTISSA,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
)
from spikeloom.compiler.targets.loihi1.registers import (
    BIAS_MANTISSA_MAX,
    THRESHOLD_MANTISSA_MAX,
    kept_shares,
)
from spikeloom.compiler.types import IntArray

BIAS_EXPONENT = 6
"""Biases are in whole weight steps."""

DEFAULT_INPUT_WEIGHT = 64

NEURONS = ("CUBA", "LOIHI")

REGISTERS = {
    "iDecay": (1, 4096),
    "vDecay": (0, 4095),
    "vThMant": (0, THRESHOLD_MANTISSA_MAX),
    "refDelay": (1, 1),
    "wgtExp": (0, 0),
}
"""Least and largest value of an entry of a neuron; it may lack the last two."""

RECURRENT = {"dense_rec": "weight_rec", "recurrent": "recWeight"}
"""Types of layers that their own spikes feed, and the entry of those weights."""

DENSE = ("dense", *RECURRENT)

ALLOWED = "input, flatten, dense, dense_rec, recurrent and conv"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block(Part):
    """One layer of a file, with its entries."""

    number: int
    type: str

    def __str__(self) -> str:
        return f"layer {self.number} ({printable(self.type) or 'no type'})"

    def sizes(self) -> tuple[int, ...]:
        """Its ``shape``."""
        values = tuple(self.integers("shape").ravel().tolist())
        if not 1 <= len(values) <= 3 or min(values) < 1 or max(values) > 2**20:
            raise self.fail(f"has the shape {list(values[:4])}, which is none; {AGAIN}")
        return values


def blocks_of(tree: Tree) -> list[Block]:
    """Layers in the content of a file; ModelError if it is none."""
    layers = entry_of(tree, "layer", dict)
    if not layers:
        raise ModelError(f"has no layers, so it is no netx file; {AGAIN}")
    blocks = []
    for number in range(len(layers)):
        entries = layers.get(str(number))
        if not isinstance(entries, dict):
            raise ModelError(f"has no layer {number}, but {len(layers)} layers; {AGAIN}")
        kind = entries.get("type")
        while isinstance(kind, list) and kind:
            kind = kind[0]
        blocks.append(Block(number=number, type=kind[:20] if isinstance(kind, str) else "", values=entries))
    return blocks


def read_netx(
    path: str | os.PathLike[str], *, polarities: int | None = None, polarities_first: bool | None = None
) -> ReadNetwork[IntegerNetwork]:
    """Read a network; polarities are as of :func:`sensor_layout.sensor_layout`.

    Raises ModelError if the file cannot be read, or holds what the chip's neurons here do not do, naming the
    layer; OptionError if there are no such polarities.
    """
    with reading(path, ModelError, AGAIN):
        tree, sha256 = read_hdf5(Path(path), "netx file")
        network, facts = integers_of(tree, polarities, polarities_first)
    return ReadNetwork(network=network, facts=tuple(facts), sha256=sha256)


def integers_of(
    tree: Tree, polarities: int | None = None, polarities_first: bool | None = None
) -> tuple[IntegerNetwork, list[str]]:
    """Integer network of the content of a file, and facts; raises as :func:`read_netx`."""
    blocks = blocks_of(tree)
    shape = _input_shape(blocks[0])
    sensor, positions, words = sensor_layout(shape, polarities=polarities, polarities_first=polarities_first)
    facts = [f"netx, {len(blocks)} layers, read as they stand", f"input: {words}"]
    populations: list[IntegerPopulation] = []
    projections: list[IntegerProjection] = []
    for block in blocks:
        if block.type == "flatten":
            shape = (math.prod(shape),)
            continue
        if block.type == "input" and not entry_of(block.values, "neuron", dict):
            continue
        weight, shape = _synapses(block, shape)
        post = len(populations)
        populations.append(_population(block, math.prod(shape), shape))
        sources = {post - 1 if post else ir.INPUT: weight if post else weight[:, positions]}
        if block.type in RECURRENT:
            neurons = populations[-1].size
            sources[post] = sparse.csr_array(_matrix(block, RECURRENT[block.type], neurons, neurons))
        stored = {pre: _planes(block, part) for pre, part in sources.items()}
        projections += [
            IntegerProjection(pre=pre, post=post, weight=plane, exponent=exponent, bits=8)
            for pre, planes in stored.items()
            for plane, exponent in planes
        ]
        facts.append(_fact(block, populations[-1], max(len(planes) for planes in stored.values())))
    if not populations:
        raise ModelError(f"has no layer of neurons; {AGAIN}")
    voters = populations[-1].size
    facts.append(f"classes: the spikes of {populations[-1].name}, a neuron each")
    network = IntegerNetwork(
        input=sensor,
        populations=tuple(populations),
        projections=tuple(projections),
        readout=ir.Readout(population=len(populations) - 1, label=np.arange(voters)),
        classes=voters,
    )
    return network, facts


def _input_shape(first: Block) -> tuple[int, ...]:
    if first.type == "input":
        return first.sizes()
    if first.type in DENSE:
        weight = first.integers("weight")
        if weight.ndim == 2 and weight.size:
            return (weight.shape[1],)
        return (first.few("inFeatures")[0],)
    raise first.fail("the shape of its input is nowhere, wanted is a layer of type input before it; add one")


def _synapses(block: Block, shape: tuple[int, ...]) -> tuple[ir.Sparse, tuple[int, ...]]:
    """Weights of a layer, csr_array (neurons, what it receives) int64, and the shape of its neurons."""
    delay = block.values.get("delay")
    if isinstance(delay, np.ndarray) and np.any(block.integers("delay")):
        raise block.fail("has synaptic delays, allowed are none here; train without")
    if block.type == "input":
        if block.number:
            raise block.fail("is not the first; export one network")
        gain = block.few("weight")[0] if "weight" in block.values else DEFAULT_INPUT_WEIGHT
        return sparse.csr_array(
            sparse.identity(math.prod(shape), dtype=np.int64, format="csr") * gain
        ), shape
    if isinstance(block.values.get("weight"), dict):
        raise block.fail("has complex weights, allowed are real ones; use CUBA neurons")
    if block.type in DENSE:
        neurons = math.prod(block.sizes())
        return sparse.csr_array(_matrix(block, "weight", neurons, math.prod(shape))), (neurons,)
    if block.type == "conv":
        return _conv(block, shape)
    raise block.fail(f"is of a type that has no place here, allowed are {ALLOWED}; train without")


def _matrix(block: Block, key: str, neurons: int, received: int) -> IntArray:
    weight = block.integers(key)
    weight = (
        weight.reshape(neurons, -1) if weight.ndim == 1 and weight.size == neurons * received else weight
    )
    if weight.shape != (neurons, received):
        raise block.fail(
            f"{key} has the shape {list(weight.shape)}, wanted {[neurons, received]}; the shapes disagree, {AGAIN}"
        )
    return weight


def _conv(block: Block, shape: tuple[int, ...]) -> tuple[ir.Sparse, tuple[int, ...]]:
    weight = block.integers("weight")
    if weight.ndim == 5 and weight.shape[4] == 1:
        weight = weight[..., 0]
    if weight.ndim != 4 or not weight.size or len(shape) != 3:
        raise block.fail(
            f"weight has the shape {list(weight.shape)} and its input {list(shape)}, wanted are (filters, channels, "
            f"height, width) and (channels, height, width); {AGAIN}"
        )
    stride = block.few("stride", 2)
    dilation = block.few("dilation", 2)
    groups = block.few("groups")[0]
    padding = [(zeros, zeros) for zeros in block.few("padding", 2)]
    with named(block):
        matrix, out = convolution(
            shape,
            weight.astype(np.float64),
            stride=stride,
            padding=padding,
            dilation=dilation,
            groups=groups,
        )
    declared = block.sizes()
    if declared != out:
        raise block.fail(f"gives {list(out)}, the file says {list(declared)}; {AGAIN}")
    return matrix.astype(np.int64), out


def _planes(block: Block, weight: ir.Sparse) -> list[tuple[ir.Sparse, int]]:
    """Mantissas and exponents that make up whole weights; mantissas of 8 bits are even."""
    weight.eliminate_zeros()
    weight.sort_indices()
    data = weight.data
    if data.size and (data.min() < -256 or data.max() > 255):
        raise block.fail(
            f"has weights from {data.min()} to {data.max()}, allowed are -256 to 255; netx clips them"
        )
    if not np.any(data % 2):
        return [(ir.with_data(weight, data.astype(MANTISSA)), 0)]
    if np.abs(data).max() <= 127:
        return [(ir.with_data(weight, (2 * data).astype(MANTISSA)), -1)]
    odd = data % 2  # one half step, stored twice as large at half the value
    units = ir.with_data(weight, (2 * odd).astype(MANTISSA)).copy()
    units.eliminate_zeros()
    return [(ir.with_data(weight, (data - odd).astype(MANTISSA)), 0), (units, -1)]


def _population(block: Block, size: int, shape: tuple[int, ...]) -> IntegerPopulation:
    entries: Tree = entry_of(block.values, "neuron", dict)
    if not entries:
        raise block.fail(
            "has no neuron, so its membranes are the result, and a chip counts spikes; remove it"
        )
    neuron = replace(block, values=entries)
    kind = entries.get("type")
    if kind not in NEURONS:
        raise block.fail(
            f"has neurons of type {str(kind)[:20]!r}, allowed are {' and '.join(NEURONS)}; use them"
        )
    graded = entries.get("gradedSpike"), entries.get("messageBits")
    if any(isinstance(value, np.ndarray) and np.any(value) for value in graded):
        raise block.fail("sends graded spikes, which Loihi 1 does not have; train without")
    for key, (least, most) in REGISTERS.items():
        if (key in entries or key not in ("refDelay", "wgtExp")) and not least <= neuron.few(key)[0] <= most:
            allowed = f"allowed are {least} to {most}" if least < most else f"allowed is {least}"
            raise block.fail(f"{key} is {neuron.few(key)[0]}, {allowed}; train it so")
    decay_u = neuron.few("iDecay")[0] - 1
    decay_v = neuron.few("vDecay")[0]
    threshold = neuron.few("vThMant")[0]
    bias = _bias(block, size, shape)
    alpha, beta = kept_shares(decay_u, decay_v)
    return IntegerPopulation(
        name=f"{block.type}{block.number}",
        beta=beta,
        theta=float(max(threshold, 1)),
        alpha=alpha,
        scale=np.ones(size),
        decay_u=decay_u,
        decay_v=decay_v,
        threshold=np.full(size, threshold),
        bias_mantissa=bias,
        bias_exponent=np.where(bias != 0, BIAS_EXPONENT, 0),
    )


def _bias(block: Block, size: int, shape: tuple[int, ...]) -> IntArray:
    """Bias of each neuron, in weight steps: one for all, one for a channel, or one each."""
    if "bias" not in block.values:
        return np.zeros(size, np.int64)
    values = block.integers("bias").ravel()
    if values.size not in (1, shape[0], size):
        raise block.fail(f"bias has {values.size} values for {size} neurons; the shapes disagree, {AGAIN}")
    if np.any(np.abs(values) > BIAS_MANTISSA_MAX):
        raise block.fail(
            f"has biases up to {np.abs(values).max()}, allowed are {BIAS_MANTISSA_MAX} steps; train again"
        )
    return np.asarray(np.repeat(values, size // values.size))


def _fact(block: Block, population: IntegerPopulation, planes: int) -> str:
    fact = (
        f"{population.name}: {population.size} neurons, decay_u {population.decay_u}, decay_v {population.decay_v}, "
        f"fires at v > 64 * {population.threshold[0]}"
    )
    if block.type == "input":
        fact += "; it turns events into currents"
    if block.type in RECURRENT:
        fact += "; it is recurrent, fed by its own spikes of the step before"
    return fact + ("; odd weights are stored twice" if planes > 1 else "")
