"""Level EN, whether a netlist holds its checkpoint, rounded: every neuron, connection, weight and register.

All is judged at the netlist's own scale, threshold / theta of each neuron, so only the choice of the scale is free:

* a threshold is theta times the scale, exactly;
* decay registers are those nearest to the checkpoint's decays;
* a weight is the nearest whole number of steps of its layer's finest plane, at most as large as the planes reach;
* a bias is the nearest ``mantissa * 2**exponent``;
* layers lag behind the data as their paths are long, neurons vote for their classes, no limit of the chip is broken.

Weights and biases are not so in a layer that was rounded on recordings so that its errors cancel
(:mod:`storage.compensate`), and neurons may be left out because they did not fire in them. What these recordings chose
is held against the digests that the compiler took before it placed the network (:mod:`passes.digest`). Besides, most
weights must be the nearest, and no bias may make up for more than its neuron's weights have lost, beside what
calibration moves it by at most.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from spikeloom.compiler import fixedpoint
from spikeloom.compiler.errors import CapacityError, FormatError
from spikeloom.compiler.ir import INPUT, IntegerNetwork, IntegerProjection, Network, Projection, Sparse, depths
from spikeloom.compiler.passes.calibrate import NUDGES
from spikeloom.compiler.passes.digest import digests
from spikeloom.compiler.passes.prune import never_fires
from spikeloom.compiler.types import BoolArray
from spikeloom.runtime.machines.netlist_check import NetlistCheck

if TYPE_CHECKING:
    from spikeloom.runtime.machines.loihi1.machine import Loihi

SLACK = 1 + 1e-9
"""Factor by which a value may miss a limit that it meets in real numbers."""

BIAS_LIMIT = fixedpoint.BIAS_MANTISSA_MAX << fixedpoint.BIAS_EXPONENT_MAX
"""Largest bias that a register holds, membrane units."""

MOVED = 0.5
"""Share of a layer's weights that compensation may move from the nearest value; another checkpoint's hardly ever are
the nearest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerRounding:
    """What a layer stores, against its checkpoint.

    Of its `weights` (between neurons that the chip holds, not zero on both sides) so many are the `nearest` on the
    layer's grid; the farthest is so many steps of the grid off, clipped weights from their limit. A layer is
    `compensated` if it was rounded so that errors cancel: weights, and biases with them, need not be the nearest.
    `faults` says what is not as rounding the checkpoint gives it.
    """

    weights: int
    nearest: int
    farthest_steps: float
    compensated: bool
    faults: tuple[str, ...]


def check_rounding(machine: Loihi, network: Network, *, fine_tuned: bool = False) -> NetlistCheck:
    """Hold what a netlist stores against the float network that it should have been compiled from; simulates nothing.

    A network that was `fine_tuned` on the chip's integers compensates nothing. Otherwise the netlist remembers which
    layers were compensated, and digests of what came of it: without these every weight has to be the nearest.
    """
    try:
        integer = machine.integer
    except FormatError as error:
        return NetlistCheck(whole=(str(error),), simulates=False)
    provenance = machine.netlist.provenance
    recorded = provenance.get("digests")
    may_compensate = recorded is not None and not fine_tuned
    compensated = provenance.get("compensated", []) if may_compensate else []
    pruned = bool(provenance.get("prune_unused", False))
    zeroed = [_may_be_zero(integer, post, mask, pruned) for post, mask in enumerate(never_fires(network))]
    channels = np.zeros(network.input.size, np.bool_)
    if "lean" in provenance:  # input channels that reach no neuron were pruned on evidence
        channels = ~machine.received
    stored = digests(integer, machine.absent)
    layers = {}
    for post, population in enumerate(network.populations):
        name = population.name
        known = stored[name] if recorded is None else recorded.get(name, {})
        layers[name] = _check_layer(
            network,
            integer,
            post,
            absent=machine.absent,
            zeroed=zeroed,
            channels=channels,
            coarsest=max(machine.target.choices["synapse.exponent"]),
            compensates=name in compensated,
            faults=list(_other_registers(machine, network, post)),
            other=[what for what, digest in stored[name].items() if known.get(what) != digest],
        )
    whole = [*_broken_limits(machine)]
    if recorded is None and provenance.get("calibrated") and any(layer.faults for layer in layers.values()):
        whole.append("it does not record how it was rounded on recordings: compile it again")
    return NetlistCheck(layers=layers, whole=tuple(whole), claim=_claim(layers))


def _broken_limits(machine: Loihi) -> Iterator[str]:
    """Limits of the chip that the netlist breaks, and blank steps that it lacks."""
    try:
        machine.legal()
    except CapacityError as error:
        yield from map(str, error.violations)
    blank = machine.netlist.blank
    if blank != machine.blank_due:
        yield f"it has {blank} blank steps instead of {machine.blank_due}"


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


def _other_registers(machine: Loihi, network: Network, post: int) -> Iterator[str]:
    """What is not the checkpoint's of a layer, beside weights and biases: its numbers, its window, its votes."""
    netlist, chip, wanted = machine.netlist, machine.integer.populations[post], network.populations[post]
    layer, ids = netlist.layers[post], netlist.compartments_of(post)
    registers = (
        f"{u} and {v}" for u, v in ((chip.decay_u, chip.decay_v), fixedpoint.decay_registers(wanted.beta, wanted.alpha))
    )
    theta = wanted.theta * chip.scale
    if (bad := ~machine.absent[post] & (np.abs(chip.threshold - theta) > 1e-6 * np.maximum(theta, 1))).any():
        worst = int(np.argmax(bad))
        yield f"{wanted.name} neuron {worst} has threshold {chip.threshold[worst]} instead of {theta[worst]:g}"
    for what, found, due in (
        ("decay registers", *registers),
        *((name, getattr(layer, name), getattr(wanted, name)) for name in ("beta", "alpha", "theta")),
        ("a window from step", layer.depth, depths(network)[post]),
    ):
        if found != due:
            yield f"{wanted.name} has {what} {found} instead of {due}"
    votes = network.readout.label[netlist.neuron[ids]] if post == network.readout.population else -1
    if wrong := np.count_nonzero(netlist.readout_class[ids] != votes):
        yield f"{wanted.name} has {wrong:,} of {len(ids):,} neurons that vote for another class"


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
    found = sparse.csr_array((stage.populations[post].size, size), dtype=np.float64)
    projections: tuple[Projection | IntegerProjection, ...] = stage.projections
    for projection in projections:
        if (projection.pre, projection.post) == (pre, post):
            weight = projection.effective() if isinstance(projection, IntegerProjection) else projection.weight
            found = found + weight.astype(np.float64)
    return found


def _check_layer(
    network: Network,
    integer: IntegerNetwork,
    post: int,
    *,
    absent: Sequence[BoolArray],
    zeroed: Sequence[BoolArray],
    channels: BoolArray,
    coarsest: int,
    compensates: bool,
    faults: list[str],
    other: Sequence[str],
) -> LayerRounding:
    """What one layer stores; `faults` are known, and so is what is `other` than the compiler chose."""
    wanted, chip, held = network.populations[post], integer.populations[post], ~absent[post]
    planes = [p for p in integer.projections if p.post == post]
    bits, exponents = min(p.bits for p in planes), tuple(sorted({p.exponent for p in planes if p.weight.nnz}))
    exponents = exponents or (coarsest,)  # a layer that stores no weight: all of them rounded to zero at some step
    step = fixedpoint.step_units(bits, exponents)
    most = fixedpoint.reach(bits, exponents) * step
    weights, wrong, farthest, where = 0, 0, 0.0, ""
    lost = np.zeros((2, wanted.size))  # what each neuron's weights lose to, and gain on, the checkpoint's; weight units
    for pre in sorted({p.pre for stage in (network, integer) for p in stage.projections if p.post == post}):
        real, stored = summed(network, pre, post), summed(integer, pre, post)
        real.data = np.clip(real.data * np.repeat(chip.scale, np.diff(real.indptr)), -most, most)
        row, column = (abs(real) + abs(stored)).nonzero()
        if not len(row):
            continue
        off = np.asarray((stored - real)[row, column]).ravel()
        kept = np.asarray(stored[row, column]).ravel()
        sends, silent = (~channels, np.zeros(len(channels), np.bool_)) if pre == INPUT else (~absent[pre], zeroed[pre])
        counts = held[row] & sends[column] & ~((kept == 0) & (zeroed[post][row] | silent[column]))
        row, column, off = row[counts], column[counts], off[counts]
        weights += len(off)
        wrong += int(np.count_nonzero(2 * np.abs(off) > step * SLACK))
        if (most_off := float(np.abs(off).max(initial=0)) / step) > farthest:
            worst, farthest = int(np.argmax(np.abs(off))), most_off
            source = "channel" if pre == INPUT else f"{network.populations[pre].name} neuron"
            where = f"the farthest, from {source} {column[worst]} to neuron {row[worst]}, by {most_off:.3g} steps"
        lost[0] += np.bincount(row, np.maximum(-off, 0), wanted.size)
        lost[1] += np.bincount(row, np.maximum(off, 0), wanted.size)

    moved = compensates and 0 < wrong <= MOVED * weights
    if wrong and not moved:
        faults.append(f"{wanted.name} has {wrong:,} of {weights:,} weights that are not the nearest, {where}")
    unit = chip.scale * (1 << fixedpoint.MEMBRANE_SHIFT)
    bias = np.clip(wanted.bias * unit, -BIAS_LIMIT, BIAS_LIMIT)
    coarse = 0.5 * (1 << np.maximum(fixedpoint.encode_bias(bias)[1], chip.bias_exponent)) * SLACK
    # where no weight was moved, the bias takes up what the nearest ones lose
    slack = compensates and wrong <= MOVED * weights
    nudged = sum(NUDGES) * wanted.theta * unit
    more, less = (lost * (1 << fixedpoint.MEMBRANE_SHIFT) * SLACK + nudged) if slack else np.zeros((2, wanted.size))
    off = chip.bias - bias
    bad = held & ((off > more + coarse) | (-off > less + coarse)) & ~(zeroed[post] & (chip.bias == 0))
    if bad.any():
        share = f"{np.count_nonzero(bad):,} of {np.count_nonzero(held):,}"
        faults.append(f"{wanted.name} has {share} biases that are not, the first of neuron {np.argmax(bad)}")
    for what in () if faults else other:
        told = f"; {where}" if what == "weights" else ""
        faults.append(f"{wanted.name} has other {what} than the compiler chose, by the netlist's own record{told}")
    return LayerRounding(
        weights=weights, nearest=weights - wrong, farthest_steps=farthest, compensated=moved, faults=tuple(faults)
    )
