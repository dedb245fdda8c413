"""Name the cause of every root: which deviation, if it alone were gone, would give the float model's spike.

A root's neuron remembers the steps since its last common reset, in which it got the same spikes in the float model
and on the chip. It is run again over these steps, from rest, with one deviation taken away at a time. There it fires
where both did, which resets a membrane but no current; at any other step but the last it does not, or the replay says
that it would. The cause is, in this order,

1. a tie, where the float model's membrane is at its threshold up to the rounding of float64;
2. of the deviations without which the spike is the float model's, the one that moved the membrane most;
3. what moved the membrane most.

A netlist is entitled to round weights, biases, decays and membranes, and to the limits of its registers; whether what
it stores is the rounding of its checkpoint at all is for :mod:`loihi1.rounding` to say.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.interpret import Activity, run_float, step_late
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.targets.compartments import (
    DECAY_BITS,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    IntegerNetwork,
    reach,
    step_units,
)
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.equivalence.explanation import results
from spikeloom.runtime.equivalence.explanation.roots import Root, find_roots, sources_of
from spikeloom.runtime.equivalence.reference import taxel_and_feature
from spikeloom.runtime.machines.loihi1.rounding import SLACK, summed

UNDECIDED = 256 * float(np.finfo(np.float64).eps)
"""Distance to threshold, as a share of all that the neuron adds up, that the order of a sum decides."""

STORED, UNROUNDED, UNCLIPPED = range(3)
"""Weights of a replay: as stored, as the checkpoint has them, as stored but for those that the range cuts off."""


def explain(
    network: Network,
    integer: IntegerNetwork,
    events: BoolArray,
    observed: Activity,
    *,
    compensated: Collection[str] = (),
    absent: Sequence[BoolArray] | None = None,
    unread: Sequence[BoolArray] | None = None,
    pruned: bool = False,
) -> results.Explanation:
    """Find the roots of all differences between float64 model and chip on one recording, and their causes.

    `integer` is what the netlist holds of `network`, `events` are (steps, channels) bool, and
    `observed` what the chip did on this recording. Layers that were `compensated` store weights that need not be the
    nearest. The chip does not hold the `absent` neurons of each population, of which the `unread` reach no neuron and
    are not compared; they were `pruned` on evidence, or cannot fire with their rounded weights.
    """
    ideal = run_float(network, events[None], membranes=True)
    truth, chip = ([spikes[0] for spikes in side.spikes] for side in (ideal, observed))
    none = [np.zeros(population.size, np.bool_) for population in network.populations]
    absent = absent or none
    unread = unread or none
    differs = [(a != b) & ~mute for a, b, mute in zip(truth, chip, unread, strict=True)]
    resets = [
        a & b if population.decay_u == 4095 else np.zeros_like(a)
        for a, b, population in zip(truth, chip, integer.populations, strict=True)
    ]
    roots = find_roots(differs, resets, sources_of(network, integer))
    causes: dict[Root, results.RootCause] = {}
    for post, population in enumerate(network.populations):
        here = sorted((r for r in roots if r.layer == post), key=lambda r: r.begin - r.step)
        if not here:
            continue
        inputs = []
        for pre in sources_into(network, integer, post):
            # what the chip does not hold, it has no weights from: the float model's spikes say what it lacks
            sent = events if pre == INPUT else np.where(absent[pre], truth[pre], chip[pre])
            inputs.append(step_late(sent[None])[0] if pre == post else sent)
        named = _name_causes(
            network,
            integer,
            post,
            here,
            np.concatenate(inputs, axis=1).astype(np.float64),
            ideal,
            observed,
            absent=absent[post],
            pruned=pruned,
            compensated=population.name in compensated,
        )
        causes |= zip(here, named, strict=True)
    counts = Counter(root.layer for root in roots)
    return results.Explanation(
        layers=tuple(
            results.LayerRoots(
                name=population.name,
                float_spikes=int(np.count_nonzero(truth[post])),
                chip_spikes=int(np.count_nonzero(chip[post])),
                different=int(np.count_nonzero(differs[post])),
                roots=counts[post],
            )
            for post, population in enumerate(integer.populations)
        ),
        found=tuple(causes[root] for root in roots),
    )


def _name_causes(
    network: Network,
    integer: IntegerNetwork,
    post: int,
    roots: list[Root],
    arrived: FloatArray,
    ideal: Activity,
    observed: Activity,
    *,
    absent: BoolArray,
    pruned: bool,
    compensated: bool,
) -> list[results.RootCause]:
    """Causes of roots of one population, which are sorted by the length of what they remember."""
    population = network.populations[post]
    chip = integer.populations[post]
    rows = np.array([root.neuron for root in roots])
    steps = np.array([root.step for root in roots])
    begins = np.array([root.begin for root in roots])
    variants = variants_of(network, integer, post, rows, compensated=compensated)
    weights = weights_into(network, integer, post, rows)
    inflows = np.stack([arrived @ weight.T for weight in weights])
    fires = ideal.spikes[post][0]
    fired = observed.spikes[post][0]
    threshold = chip.threshold[rows].astype(np.float64) * (1 << MEMBRANE_SHIFT)
    margins, early = run_variants(variants, threshold, inflows, begins, steps, (fires & fired)[:, rows])

    unit = chip.scale[rows] * (1 << MEMBRANE_SHIFT)
    register = np.asarray(observed.membranes[post][0], np.int64)[steps, rows]
    truth = fires[steps, rows]
    membrane = ideal.membranes[post][0, steps, rows]

    # what the margin would be without each deviation; the first variant is the netlist itself
    margin = register - threshold
    without = margin + (margins - margins[0])
    moved = np.abs(without - margin) / unit
    mended = ((without > 0) == truth) & ~early & (moved > 0)

    sums = np.abs(weights[UNROUNDED] / unit[:, None]).sum(axis=1)
    magnitude = population.theta + sums + np.abs(population.bias[rows])
    undecided = np.abs(membrane - population.theta) <= UNDECIDED * magnitude
    stored = [p for p in integer.projections if p.post == post]
    bits = max(p.bits for p in stored)
    planes = len({p.exponent for p in stored})
    found = []
    for i, root in enumerate(roots):
        held = not absent[root.neuron]
        order = sorted(range(len(variants)), key=lambda k: -moved[k, i])
        enough = [k for k in order if mended[k, i]]
        first = next(iter(enough), order[0] if moved[order[0], i] > 0 else None)
        cause = results.TIE if undecided[i] else results.UNKNOWN if first is None else variants[first].cause
        if not held:
            cause = results.LEFT_OUT if pruned else results.WEIGHTS
        amounts: dict[str, float] = {}  # the largest of each cause
        for k in order:
            if moved[k, i] > 0:
                amounts.setdefault(variants[k].cause, float(moved[k, i]))
        clipped = any(variants[k].weights == UNCLIPPED for k in enough)
        taxel, feature = taxel_and_feature(network, post, root.neuron)
        found.append(
            results.RootCause(
                layer=population.name,
                neuron=root.neuron,
                taxel=taxel,
                feature=feature,
                step=root.step,
                remembers_from_step=root.begin,
                float_fires=bool(truth[i]),
                float_membrane=float(membrane[i]),
                float_distance=float(membrane[i]) - population.theta,
                theta=population.theta,
                chip_membrane=float(register[i] / unit[i]) if held else None,
                chip_distance=float(register[i] / unit[i]) - float(threshold[i] / unit[i]) if held else None,
                chip_theta=float(threshold[i] / unit[i]) if held else None,
                chip_register=int(register[i]) if held else None,
                chip_threshold_register=int(threshold[i]) if held else None,
                cause=cause,
                held=held,
                clipped_weights=clipped,
                sufficient=tuple(dict.fromkeys(variants[k].cause for k in enough)) if held else (),
                moved=amounts if held else {},
                change=results.remedy(cause, population.name, bits=bits, planes=planes, clipped=clipped, held=held),
                dragged=root.dragged,
                dragged_alone=root.alone,
            )
        )
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Variant:
    """A replay: the stored neurons without the deviation `cause`.

    Weights are STORED, UNROUNDED or UNCLIPPED; bias (neurons,) and the membrane's limit are in membrane units; `keep_u`
    and `keep_v` are what a step keeps of current and membrane, rounded toward zero if `rounds`.
    """

    cause: str
    weights: int
    bias: FloatArray
    keep_u: float
    keep_v: float
    limit: float = float(MEMBRANE_MAX)
    rounds: bool = True


def sources_into(network: Network, integer: IntegerNetwork, post: int) -> tuple[int, ...]:
    """Presynaptic populations of a population on either side, the input first."""
    return tuple(sorted({p.pre for stage in (network, integer) for p in stage.projections if p.post == post}))


def weights_into(network: Network, integer: IntegerNetwork, post: int, rows: IntArray) -> FloatArray:
    """Weights in membrane units into neurons of a population, (3, neurons, sources), by ``Variant.weights``."""
    pres = sources_into(network, integer, post)
    scale = integer.populations[post].scale[rows]
    real, stored = (
        np.concatenate([summed(stage, pre, post)[rows].toarray() for pre in pres], axis=1)
        for stage in (network, integer)
    )
    real *= scale[:, None]
    planes = {(p.bits, p.exponent) for p in integer.projections if p.post == post}
    bits = min(b for b, _ in planes)
    exponents = tuple(sorted({e for _, e in planes}))
    clipped = np.abs(real) > reach(bits, exponents) * step_units(bits, exponents) * SLACK
    return np.stack([stored, real, np.where(clipped, real, stored)]) * (1 << MEMBRANE_SHIFT)


def variants_of(
    network: Network, integer: IntegerNetwork, post: int, rows: IntArray, *, compensated: bool
) -> list[Variant]:
    """What to run for neurons of a population: the netlist as it is, then without each deviation."""
    wanted = network.populations[post]
    chip = integer.populations[post]
    one = 1 << DECAY_BITS
    exact = wanted.bias[rows] * chip.scale[rows] * (1 << MEMBRANE_SHIFT)
    netlist = Variant(
        cause=results.UNKNOWN,
        weights=STORED,
        bias=chip.bias[rows].astype(np.float64),
        keep_u=(one - chip.decay_u - 1) / one,
        keep_v=(one - chip.decay_v) / one,
    )
    # where a rounding compensates, biases make up for weights: both go together
    with_weights, alone = (exact, netlist.bias) if compensated else (netlist.bias, exact)
    return [
        netlist,
        replace(netlist, cause=results.WEIGHTS, weights=UNCLIPPED),
        replace(netlist, cause=results.WEIGHTS, weights=UNROUNDED, bias=with_weights),
        replace(netlist, cause=results.BIAS, bias=alone),
        replace(netlist, cause=results.BETA, keep_u=wanted.alpha, keep_v=wanted.beta),
        replace(netlist, cause=results.SATURATION, limit=np.inf),
        replace(netlist, cause=results.TRUNCATION, rounds=False),  # last, see run_variants
    ]


def run_variants(
    variants: list[Variant],
    threshold: FloatArray,
    inflows: FloatArray,
    begins: IntArray,
    steps: IntArray,
    fired: BoolArray,
) -> tuple[FloatArray, BoolArray]:
    """Run neurons from rest over what they remember, from step `begins` to `steps`; the longest come first.

    Of the variants the last one, and only it, does not round. `inflows` (3, steps, neurons) are shifted synaptic sums
    by ``Variant.weights``; float model and chip both `fired` (steps, neurons). Gives (variants, neurons): membrane
    minus threshold in the last step, and whether the neuron fired before it, where it should not.
    """

    def column(values: list[float]) -> FloatArray:
        return np.array(values, np.float64)[:, None]

    bias = np.stack([v.bias for v in variants])
    keep_u = column([v.keep_u for v in variants])
    keep_v = column([v.keep_v for v in variants])
    limit = column([v.limit for v in variants])
    which = [v.weights for v in variants]
    length = steps - begins + 1
    place = np.arange(len(length))
    u = np.zeros(bias.shape)
    v = np.zeros(bias.shape)
    margins = np.zeros(bias.shape)
    early = np.zeros(bias.shape, np.bool_)
    running = len(length)
    for k in range(int(length[0])):
        u = keep_u * u[:, :running]
        v = keep_v * v[:, :running]
        for state in (u, v):
            np.trunc(state[:-1], out=state[:-1])
        u += inflows[:, begins[:running] + k, place[:running]][which]
        v += u
        v += bias[:, :running]
        np.clip(v, -limit, limit, out=v)
        left = int(np.count_nonzero(length > k + 1))
        margins[:, left:running] = v[:, left:] - threshold[left:running]
        both = fired[begins[:left] + k, place[:left]]
        early[:, :left] |= (v[:, :left] > threshold[:left]) & ~both
        v[:, :left] *= ~both
        running = left
    return margins, early
