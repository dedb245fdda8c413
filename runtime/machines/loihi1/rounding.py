"""Level EN, whether a netlist holds its checkpoint, rounded: every neuron, connection, weight and register.

All is judged at the netlist's own scale, threshold / theta of each neuron, so only the choice of the scale
is free:

* a threshold is theta times the scale, exactly;
* decay registers are those nearest to the checkpoint's decays;
* a weight is the nearest whole number of steps of its layer's finest plane, at most as large as the planes reach;
* a bias is the nearest ``mantissa * 2**exponent``;
* layers lag behind the data as their paths are long, neurons vote for their classes, no limit of the chip is broken.

Weights and biases are not so in a layer that was rounded on recordings so that its errors cancel
(:mod:`storage.compensate`), and neurons may be left out because they did not fire in them. What these
recordings chose is held against the digests that the compiler took before it placed the network
(:mod:`loihi1.digest`). Besides, most weights must be the nearest, and no bias may make up for more than its
neuron's weights have lost, beside what calibration moves it by at most.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.ir import INPUT, Network, Projection, Sparse, depths
from spikeloom.compiler.passes.calibrate import NUDGES
from spikeloom.compiler.passes.prune import never_fires
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1 import registers
from spikeloom.compiler.targets.loihi1.digest import digests
from spikeloom.compiler.targets.loihi1.idle import forgotten
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerProjection
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.storage.ties import remainders
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.netlist_check import NetlistCheck

SLACK = 1 + 1e-9
"""Factor by which a value may miss a limit that it meets in real numbers."""

BIAS_LIMIT = registers.BIAS_MANTISSA_MAX << registers.BIAS_EXPONENT_MAX
"""Largest bias that a register holds, membrane units."""

MOVED = 0.5
"""Share of a layer's weights that compensation may move from the nearest value; another checkpoint's hardly
ever are the nearest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerRounding:
    """What a layer stores, against its checkpoint.

    Of its `weights` (between neurons that the chip holds, not zero on both sides) so many are the `nearest`
    on the layer's grid; the farthest is so many steps of the grid off, clipped weights from their limit. A
    layer is `compensated` if it was rounded so that errors cancel: weights, and biases with them, need not
    be the nearest. `faults` says what is not as rounding the checkpoint gives it.
    """

    weights: int
    nearest: int
    farthest_steps: float
    compensated: bool
    faults: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Silence:
    """What stores no weight for a reason: by layer, neurons that the chip lacks and neurons whose weights may be zero.

    Input `channels` that were left out send nothing.
    """

    absent: Sequence[BoolArray]
    zeroed: Sequence[BoolArray]
    channels: BoolArray

    def counts(self, pre: int, post: int, row: IntArray, column: IntArray, stored: FloatArray) -> BoolArray:
        """Which weights, from `column` of one layer to `row` of another, must be there."""
        sends = ~self.channels if pre == INPUT else ~self.absent[pre]
        silent = np.zeros(len(self.channels), np.bool_) if pre == INPUT else self.zeroed[pre]
        may_be_zero = (stored == 0) & (self.zeroed[post][row] | silent[column])
        return np.asarray(~self.absent[post][row] & sends[column] & ~may_be_zero)


@dataclass(slots=True, kw_only=True, eq=False)
class _Weights:
    """Weights into a layer: how many, how many are not the nearest, and the farthest of these.

    `lost` and `gained` are what the weights of each neuron lose to, and gain on, the checkpoint's; weight
    units.
    """

    lost: FloatArray
    gained: FloatArray
    count: int = 0
    wrong: int = 0
    farthest: float = 0.0
    where: str = ""

    @property
    def moved(self) -> bool:
        """Whether compensation may have moved those that are not the nearest."""
        return 0 < self.wrong <= MOVED * self.count

    def add(self, row: IntArray, column: IntArray, error: FloatArray, step: float, source: str) -> None:
        """Count weights from a source that miss the checkpoint's by an error, of which a grid's step is the unit."""
        self.count += len(error)
        self.wrong += int(np.count_nonzero(2 * np.abs(error) > step * SLACK))
        farthest = float(np.abs(error).max(initial=0)) / step
        if farthest > self.farthest:
            self.farthest = farthest
            worst = int(np.argmax(np.abs(error)))
            self.where = f"the farthest, from {source} {column[worst]} to neuron {row[worst]}, by {farthest:.3g} steps"
        self.lost += np.bincount(row, np.maximum(-error, 0), len(self.lost))
        self.gained += np.bincount(row, np.maximum(error, 0), len(self.gained))


def check_rounding(
    netlist: Netlist, integer: IntegerNetwork, target: Target, network: Network
) -> NetlistCheck:
    """Hold what a netlist stores against the float network that it should have been compiled from; simulates nothing.

    `integer` is the netlist, cores forgotten. A network that was fine-tuned on the chip's integers
    compensates nothing. Otherwise the netlist remembers which layers were compensated, and digests of what
    came of it: without these every weight has to be the nearest.
    """
    provenance = netlist.provenance
    absent = netlist.absent
    recorded = provenance.get("digests")
    may_compensate = recorded is not None and network.forms is None
    compensated = provenance.get("compensated", []) if may_compensate else []
    pruned = bool(provenance.get("prune_unused", False))
    silence = _Silence(
        absent=absent,
        zeroed=[_may_be_zero(integer, post, mask, pruned) for post, mask in enumerate(never_fires(network))],
        # input channels that reach no neuron were pruned on evidence
        channels=~np.isin(np.arange(netlist.n_inputs), netlist.axon_source)
        if "lean" in provenance
        else np.zeros(network.input.size, np.bool_),
    )
    coarsest = max(target.choices["synapse.exponent"])
    stored = digests(integer, absent)
    layers = {}
    for post, population in enumerate(network.populations):
        name = population.name
        known = stored[name] if recorded is None else recorded.get(name, {})
        weights = _compare_weights(network, integer, post, silence, coarsest)
        faults = [
            *_other_registers(netlist, integer, network, post),
            *_wrong_numbers(network, integer, post, silence, weights, compensates=name in compensated),
        ]
        other = [what for what, digest in stored[name].items() if known.get(what) != digest]
        for what in () if faults else other:
            where = f"; {weights.where}" if what == "weights" else ""
            faults.append(
                f"{name} has other {what} than the compiler chose, by the netlist's own record{where}"
            )
        layers[name] = LayerRounding(
            weights=weights.count,
            nearest=weights.count - weights.wrong,
            farthest_steps=weights.farthest,
            compensated=name in compensated and weights.moved,
            faults=tuple(faults),
        )
    whole = [*_broken_limits(netlist, target)]
    if netlist.classes != network.classes:
        whole.append(f"it has {netlist.classes} classes, the network {network.classes}")
    if recorded is None and provenance.get("calibrated") and any(layer.faults for layer in layers.values()):
        whole.append("it does not record how it was rounded on recordings: compile it again")
    return NetlistCheck(layers=layers, whole=tuple(whole), claim=_claim(layers))


def _broken_limits(netlist: Netlist, target: Target) -> Iterator[str]:
    """Limits of the chip that the netlist breaks, and blank steps that it lacks."""
    try:
        require_legal(netlist, target)
    except CapacityError as error:
        yield from map(str, error.violations)
    due = forgotten(netlist).steps if netlist.blank else 0
    if netlist.blank != due:
        yield f"it has {netlist.blank} blank steps instead of {due}"


def _claim(layers: Mapping[str, LayerRounding]) -> str:
    """What is true of layers without a fault."""
    moved = [
        f"{name} {100 * (1 - layer.nearest / layer.weights):.1f} %"
        for name, layer in layers.items()
        if layer.nearest < layer.weights
    ]
    claim = "every connection, weight, bias, threshold and decay is the checkpoint's, rounded"
    if not moved:
        return f"{claim} to the nearest"
    return f"{claim}; by compensation, as the netlist records, not to the nearest: {', '.join(moved)}"


def _other_registers(
    netlist: Netlist, integer: IntegerNetwork, network: Network, post: int
) -> Iterator[str]:
    """What is not the checkpoint's of a layer, beside weights and biases: its numbers, its window, its votes."""
    chip = integer.populations[post]
    wanted = network.populations[post]
    layer = netlist.layers[post]
    ids = netlist.compartments_of(post)
    theta = wanted.theta * chip.scale
    wrong_threshold = ~netlist.absent[post] & (np.abs(chip.threshold - theta) > 1e-6 * np.maximum(theta, 1))
    if wrong_threshold.any():
        worst = int(np.argmax(wrong_threshold))
        yield f"{wanted.name} neuron {worst} has threshold {chip.threshold[worst]} instead of {theta[worst]:g}"
    decay_u, decay_v = registers.decay_registers(wanted.beta, wanted.alpha)
    for what, stored, due in (
        ("decay registers", f"{chip.decay_u} and {chip.decay_v}", f"{decay_u} and {decay_v}"),
        *((name, getattr(layer, name), getattr(wanted, name)) for name in ("beta", "alpha", "theta")),
        ("a window from step", layer.depth, depths(network)[post]),
    ):
        if stored != due:
            yield f"{wanted.name} has {what} {stored} instead of {due}"
    votes = network.readout.label[netlist.neuron[ids]] if post == network.readout.population else -1
    elsewhere = np.count_nonzero(netlist.readout_class[ids] != votes)
    if elsewhere:
        yield f"{wanted.name} has {elsewhere:,} of {len(ids):,} neurons that vote for another class"


def _may_be_zero(integer: IntegerNetwork, post: int, silent: BoolArray, pruned: bool) -> BoolArray:
    """Neurons from and to which the compiler zeroed the weights, although the chip holds one of them."""
    if not pruned:
        return silent
    stored = np.zeros(len(silent), np.bool_)
    for projection in integer.projections:
        if projection.post == post:
            stored |= np.diff(projection.weight.indptr) > 0
    return silent | ~stored


def summed(stage: Network | IntegerNetwork, pre: int, post: int) -> Sparse:
    """Weights from one population to another, mantissas of planes added up; float64."""
    size = stage.input.size if pre == INPUT else stage.populations[pre].size
    total = sparse.csr_array((stage.populations[post].size, size), dtype=np.float64)
    projections: tuple[Projection | IntegerProjection, ...] = stage.projections
    for projection in projections:
        if (projection.pre, projection.post) == (pre, post):
            weight = (
                projection.effective() if isinstance(projection, IntegerProjection) else projection.weight
            )
            total = total + weight.astype(np.float64)
    return total


def _compare_weights(
    network: Network, integer: IntegerNetwork, post: int, silence: _Silence, coarsest: int
) -> _Weights:
    """Hold the weights into a layer against the checkpoint's, on the layer's grid of steps."""
    chip = integer.populations[post]
    planes = [projection for projection in integer.projections if projection.post == post]
    bits = min(plane.bits for plane in planes)
    exponents = tuple(sorted({plane.exponent for plane in planes if plane.weight.nnz}))
    exponents = exponents or (
        coarsest,
    )  # a layer that stores no weight: all of them rounded to zero at some step
    step = registers.step_units(bits, exponents)
    most = registers.reach(bits, exponents) * step
    weights = _Weights(lost=np.zeros(chip.size), gained=np.zeros(chip.size))
    for pre in sorted(
        {each.pre for stage in (network, integer) for each in stage.projections if each.post == post}
    ):
        real = summed(network, pre, post)
        stored = summed(integer, pre, post)
        real.data = np.clip(real.data * np.repeat(chip.scale, np.diff(real.indptr)), -most, most)
        row, column = (abs(real) + abs(stored)).nonzero()
        if not len(row):
            continue
        mantissa = np.asarray(stored[row, column]).ravel()
        counts = silence.counts(pre, post, row, column, mantissa)
        error = np.asarray((stored - real)[row, column]).ravel()[counts]
        source = "channel" if pre == INPUT else f"{network.populations[pre].name} neuron"
        weights.add(row[counts], column[counts], error, step, source)
    return weights


def _wrong_numbers(
    network: Network,
    integer: IntegerNetwork,
    post: int,
    silence: _Silence,
    weights: _Weights,
    *,
    compensates: bool,
) -> Iterator[str]:
    """Weights that are not the nearest, and biases that are neither that nor make up for what weights lost."""
    wanted = network.populations[post]
    chip = integer.populations[post]
    if weights.wrong and not (compensates and weights.moved):
        yield (
            f"{wanted.name} has {weights.wrong:,} of {weights.count:,} weights that are not the nearest, "
            f"{weights.where}"
        )
    unit = chip.scale * (1 << registers.MEMBRANE_SHIFT)
    bias = np.clip(wanted.bias * unit, -BIAS_LIMIT, BIAS_LIMIT)
    coarse = 0.5 * (1 << np.maximum(registers.encode_bias(bias)[1], chip.bias_exponent)) * SLACK
    above = below = coarse
    if not wanted.beta and not wanted.alpha:  # the bias makes up for what a membrane keeps all the same
        most, least = remainders(chip, [p for p in integer.projections if p.post == post])
        above = above + least
        below = below + most
    if compensates and weights.wrong <= MOVED * weights.count:
        # where no weight was moved, the bias takes up what the nearest ones lose
        shift = sum(NUDGES) * wanted.theta * unit
        above = weights.lost * (1 << registers.MEMBRANE_SHIFT) * SLACK + shift + above
        below = weights.gained * (1 << registers.MEMBRANE_SHIFT) * SLACK + shift + below
    error = chip.bias - bias
    present = ~silence.absent[post]
    wrong = present & ((error > above) | (-error > below)) & ~(silence.zeroed[post] & (chip.bias == 0))
    if wrong.any():
        share = f"{np.count_nonzero(wrong):,} of {np.count_nonzero(present):,}"
        yield f"{wanted.name} has {share} biases that are not, the first of neuron {np.argmax(wrong)}"
