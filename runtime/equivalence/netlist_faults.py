"""Faults of a netlist: where it is not what rounding its checkpoint gives.

What the checkpoint gives at the netlist's own scales is compared with what is stored. Where weights are not the
nearest that the grid has, they are held against the checkpoint's weights in another order, and against its filters on
another graph. What is left is a fault, unless the compiler may have rounded with compensation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.fixedpoint import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    DECAY_BITS,
    MEMBRANE_SHIFT,
    FloatArray,
    encode_bias,
)
from spikeloom.compiler.interpret import BoolArray
from spikeloom.compiler.ir import INPUT, IntegerNetwork, IntegerProjection, Network, Projection
from spikeloom.compiler.passes.expand import expand_graph_convolution
from spikeloom.compiler.targets.loihi1.storage.weight_storage import decay_registers, reach, step_units
from spikeloom.runtime.equivalence.suspects import (
    BETA,
    BIAS,
    GRAPH,
    THRESHOLD,
    TRANSPOSED,
    WEIGHTS,
    Suspect,
    kept_shares,
)

Convolution = tuple[FloatArray, FloatArray]
"""A graph convolution: propagation matrix (taxels, taxels) and hop filters (K + 1, features, channels)."""

SLACK = 1 + 1e-9
"""Factor by which a value may miss a limit that it meets in real numbers."""

BIAS_LIMIT = BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX
"""Largest bias that a register holds, membrane units."""

MOVED = 0.5
"""Share of the weights that rounding with compensation may move away from the nearest value; another checkpoint's are
hardly ever the nearest."""

LEFT = 0.2
"""Share of the weights that are wrong as they are, and may still be so in another order: some may be compensated."""

FITTED = 0.9
"""Share of the wrong pairs of taxels that the hop filters must explain with other strengths."""

FIT_STEPS = 1.5
"""Steps of the grid by which a fit to rounded weights may miss them."""


@dataclass(frozen=True, slots=True, eq=False)
class Registers:
    """Parameters of one layer in membrane units (1/64 of a weight unit), as real numbers.

    Parameters
    ----------
    weight : (neurons, sources) float64
        Dense; sources are those of :func:`sources_into`, side by side.
    bias, threshold : (neurons,) float64
    keep_u, keep_v : float
        Shares of current and membrane that a step keeps.
    """

    weight: FloatArray
    bias: FloatArray
    threshold: FloatArray
    keep_u: float
    keep_v: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LayerCheck:
    """One layer as it is stored, as rounding the checkpoint gives it, and as the checkpoint says.

    Parameters
    ----------
    stored, rounded, ideal : Registers
        ``stored`` and ``rounded`` are the same wherever what is stored is a rounding of the checkpoint's.
    clipped : (neurons, sources) bool
        Weights that the range cuts off.
    compensated : bool
        Whether weights, and biases with them, were rounded so that their errors cancel.
    suspects : tuple of Suspect
        What is wrong.
    """

    stored: Registers
    rounded: Registers
    ideal: Registers
    clipped: BoolArray
    compensated: bool
    suspects: tuple[Suspect, ...]


def sources_into(network: Network, integer: IntegerNetwork, post: int) -> tuple[int, ...]:
    """Populations that a population listens to on either side, the input first."""
    return tuple(sorted({p.pre for stage in (network, integer) for p in stage.projections if p.post == post}))


def _dense(stage: Network | IntegerNetwork, post: int, pres: tuple[int, ...]) -> FloatArray:
    """Weights into a population; mantissas of planes added up."""
    blocks: list[FloatArray] = []
    for pre in pres:
        columns = stage.input.size if pre == INPUT else stage.populations[pre].size
        block = np.zeros((stage.populations[post].size, columns))
        projections: tuple[Projection | IntegerProjection, ...] = stage.projections
        for projection in projections:
            if (projection.pre, projection.post) == (pre, post):
                weight = projection.effective() if isinstance(projection, IntegerProjection) else projection.weight
                block += weight.toarray()
        blocks.append(block)
    return np.concatenate(blocks, axis=1)


def check_layer(
    network: Network,
    integer: IntegerNetwork,
    post: int,
    *,
    absent: Sequence[BoolArray],
    convolution: Convolution | None = None,
    may_compensate: bool = False,
) -> LayerCheck:
    """Compare one layer of a netlist with its checkpoint.

    Parameters
    ----------
    network, integer : Network, IntegerNetwork
        Float and integer stage of the same populations.
    post : int
        Population.
    absent : sequence of (neurons,) bool
        Neurons of each population that the chip does not hold; nothing is asked of them.
    convolution : Convolution, optional
        Where the layer is a graph convolution.
    may_compensate : bool
        Whether the compiler had recordings to round on, so that weights need not be the nearest of the grid.
    """
    pres = sources_into(network, integer, post)
    wanted, chip = network.populations[post], integer.populations[post]
    scale, unit, one = chip.scale, float(1 << MEMBRANE_SHIFT), 1 << DECAY_BITS
    real, units = _dense(network, post, pres) * scale[:, None], _dense(integer, post, pres)
    threshold = chip.threshold.astype(np.float64) * unit
    stored = Registers(units * unit, chip.bias.astype(np.float64), threshold, *kept_shares(chip))
    theta: FloatArray = wanted.theta * scale * unit
    ideal = Registers(real * unit, wanted.bias * scale * unit, theta, wanted.alpha, wanted.beta)
    suspects = []

    def suspect(cause: str, part: str, found: str, change: str) -> None:
        suspects.append(Suspect(cause=cause, layer=post, part=part, found=found, change=change))

    planes = {(p.bits, p.exponent) for p in integer.projections if p.post == post}
    grid = _Grid(bits=min(b for b, _ in planes), exponents=tuple(sorted({e for _, e in planes})))
    held = ~absent[post]
    heard = np.concatenate([np.ones(network.input.size, np.bool_) if pre == INPUT else ~absent[pre] for pre in pres])
    asked = held[:, None] & heard
    wrong = grid.missed(units, real) & asked
    weight, compensated = units, False
    if wrong.any():
        inside = slice(len(real) - wanted.relays), slice(real.shape[1] - wanted.relays)  # relays are no convolution
        cause, words = _misread(network, real, units, asked, scale, grid, convolution, inside)
        compensated = cause == WEIGHTS and may_compensate and bool(np.mean(wrong) <= MOVED)
        if not compensated:
            weight = np.where(wrong, np.clip(np.rint(real / grid.step), -grid.limit, grid.limit) * grid.step, units)
            change = "compile it again, with this very checkpoint and the graph that it was trained on"
            suspect(cause, "weight", f"the weights of {wanted.name} are {words}", change)

    mantissa, exponent = encode_bias(np.clip(ideal.bias, -BIAS_LIMIT, BIAS_LIMIT))
    gap = np.abs(stored.bias - ideal.bias)
    off = (2 * gap > (1 << exponent) * SLACK) & (np.abs(ideal.bias) <= BIAS_LIMIT) & held & (not compensated)
    if off.any():
        suspect(
            BIAS,
            "bias",
            f"{np.count_nonzero(off)} of {len(off)} biases of {wanted.name} are not the nearest to the checkpoint's: "
            f"off by up to {gap[off].max() / unit:.3g} weight units",
            "round a bias to 64ths of a weight unit, as mantissa times 2**exponent: compile it again",
        )
    bias = np.where(off, mantissa << exponent, stored.bias).astype(np.float64)

    gap = np.abs(stored.threshold - ideal.threshold)
    off = held & (gap > 1e-6 * np.maximum(ideal.threshold, unit))
    if off.any():
        worst = int(np.argmax(np.where(off, gap, 0)))
        suspect(
            THRESHOLD,
            "threshold",
            f"{np.count_nonzero(off)} of {len(off)} thresholds of {wanted.name} are not theta times scale: neuron "
            f"{worst} has {chip.threshold[worst]}, wanted is {ideal.threshold[worst] / unit:.6g}",
            "choose the scale as threshold / theta, so that a threshold is exact: compile it again",
        )
    right = np.where(off, np.rint(ideal.threshold / unit) * unit, stored.threshold)

    u, v = decay_registers(wanted.beta, wanted.alpha)
    if (chip.decay_u, chip.decay_v) != (u, v):
        suspect(
            BETA,
            "decay",
            f"decay registers of {wanted.name} are {chip.decay_u} and {chip.decay_v}, "
            f"{f'alpha {wanted.alpha:g} and ' if wanted.alpha else ''}beta {wanted.beta:g} "
            f"{'ask' if wanted.alpha else 'asks'} for {u} and {v}",
            f"set decay_u to {u} and decay_v to {v}: compile it again",
        )
    return LayerCheck(
        stored=stored,
        rounded=Registers(weight * unit, bias, right, (one - u - 1) / one, (one - v) / one),
        ideal=ideal,
        clipped=np.abs(real) > grid.limit * grid.step * SLACK,
        compensated=compensated,
        suspects=tuple(suspects),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Grid:
    """Values that the weights of a layer can take."""

    bits: int
    exponents: tuple[int, ...]

    @property
    def step(self) -> float:
        """Distance of neighbours, weight units."""
        return step_units(self.bits, self.exponents)

    @property
    def limit(self) -> int:
        """Largest magnitude, in steps."""
        return reach(self.bits, self.exponents)

    def missed(self, units: FloatArray, real: FloatArray) -> BoolArray:
        """Whether stored weights are not the nearest to real ones, all in weight units."""
        held = np.clip(real, -self.limit * self.step, self.limit * self.step)
        off: BoolArray = 2 * np.abs(units - held) > self.step * SLACK
        return off


def _misread(
    network: Network,
    real: FloatArray,
    units: FloatArray,
    asked: BoolArray,
    scale: FloatArray,
    grid: _Grid,
    convolution: Convolution | None,
    inside: tuple[slice, slice],
) -> tuple[str, str]:
    """Say what stored weights are that are not the nearest to the checkpoint's: cause, and in words.

    Parameters
    ----------
    real, units : (neurons, sources) float64
        The checkpoint's weights and the stored ones, weight units.
    asked : (neurons, sources) bool
        Weights between neurons that the chip holds.
    scale : (neurons,) float64
        Weight units per membrane unit.
    inside : pair of slice
        Neurons and sources that the checkpoint has weights for.
    """
    every = units - real, grid.missed(units, real) & asked
    real, units, asked, scale = real[inside], units[inside], asked[inside], scale[inside[0]]
    missed = grid.missed(units, real) & asked
    for words, other in _orders(network, real / scale[:, None], convolution):
        if np.mean(grid.missed(units, other * scale[:, None]) & asked) <= LEFT * np.mean(missed):
            return TRANSPOSED, f"the checkpoint's {words}"
    if convolution is not None:
        adjacency, hops = convolution
        n_hops, features, channels = hops.shape
        sizes = len(adjacency), features, channels
        basis = hops.reshape(n_hops, features * channels).T
        stored, model = (_pairs(w / scale[:, None], *sizes) for w in (units, real))
        tolerance = _pairs(np.broadcast_to((FIT_STEPS * grid.step / scale)[:, None], units.shape), *sizes)
        known = _pairs(asked & (np.abs(units) < grid.limit * grid.step), *sizes)
        bad = np.flatnonzero(((np.abs(model - stored) > tolerance) & known).any(axis=0))
        fitted = [_fits(basis, stored[:, pair], tolerance[:, pair], known[:, pair]) for pair in bad]
        if fitted and np.mean(fitted) >= FITTED:
            wired = [_pairs((w != 0) & asked, *sizes).any(axis=0) for w in (units, real)]
            more, less = np.count_nonzero(wired[0] & ~wired[1]), np.count_nonzero(wired[1] & ~wired[0])
            how = (
                f"it connects {more} pairs of taxels that the graph does not, and leaves {less} out"
                if more or less
                else "it connects the same taxels otherwise, as if edges were listed twice or repeats collapsed"
            )
            return GRAPH, f"the checkpoint's filters on another graph: {how}"
    gap, missed = every
    worst = float(np.max(np.abs(gap)[missed]) / grid.step)
    return WEIGHTS, (
        f"not the nearest to the checkpoint's: {np.count_nonzero(missed):,} of {missed.size:,} are off, "
        f"by up to {worst:.3g} steps of the grid"
    )


def _fits(basis: FloatArray, stored: FloatArray, tolerance: FloatArray, known: BoolArray) -> bool:
    """Whether the known weights of one pair of taxels are a sum of hop filters, with strengths of their own."""
    if np.count_nonzero(known) <= basis.shape[1]:
        return False  # as many strengths as weights always fit
    strength, *_ = np.linalg.lstsq(basis[known], stored[known], rcond=None)
    return bool(np.all(np.abs(basis[known] @ strength - stored[known]) <= tolerance[known]))


def _pairs(weight: npt.NDArray[Any], taxels: int, features: int, channels: int) -> npt.NDArray[Any]:
    """Weights of a graph convolution, one column for each pair of taxels."""
    blocks = weight.reshape(taxels, features, taxels, channels).transpose(1, 3, 0, 2)
    return blocks.reshape(features * channels, taxels * taxels)


def _orders(
    network: Network, real: FloatArray, convolution: tuple[FloatArray, FloatArray] | None
) -> list[tuple[str, FloatArray]]:
    """The same weights in the orders in which they are likely to be misread."""
    outputs, inputs = real.shape
    flat = [("read column by column", real.T.reshape(outputs, inputs))]
    flat.append(("stored column by column", real.reshape(inputs, outputs).T))
    if outputs == inputs:
        flat.insert(0, ("transposed", real.T))
    if convolution is None:
        taxels = network.input.taxels
        if inputs % taxels == 0:
            by_taxel = real.reshape(outputs, taxels, inputs // taxels)
            by_feature = real.reshape(outputs, inputs // taxels, taxels)
            flat.append(("with inputs feature-major", by_taxel.transpose(0, 2, 1).reshape(outputs, inputs)))
            flat.append(("with inputs read feature-major", by_feature.transpose(0, 2, 1).reshape(outputs, inputs)))
        return flat
    adjacency, hops = convolution
    n_hops, features, channels = hops.shape
    taxels = len(adjacency)
    block = real.reshape(taxels, features, taxels, channels)

    def expanded(filters: FloatArray, graph: FloatArray = adjacency) -> FloatArray:
        weight: FloatArray = expand_graph_convolution(graph, filters).toarray()
        return weight

    return [
        *flat,
        ("with channels exchanged", block[..., ::-1].reshape(outputs, inputs)),
        ("with neurons feature-major", block.transpose(1, 0, 2, 3).reshape(outputs, inputs)),
        ("with inputs channel-major", block.transpose(0, 1, 3, 2).reshape(outputs, inputs)),
        ("on the graph with its edges reversed", expanded(hops, adjacency.T)),
        ("with hop filters transposed", expanded(hops.transpose(0, 2, 1).reshape(hops.shape))),
        ("with hop filters stored transposed", expanded(hops.reshape(n_hops, channels, features).transpose(0, 2, 1))),
        ("with hops in reverse", expanded(hops[::-1])),
    ]
