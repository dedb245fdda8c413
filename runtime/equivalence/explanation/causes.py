"""Name the cause of every root: which deviation, if it alone were gone, would give the float model's spike.

A root's neuron remembers the steps since its last common reset, in which it got the same spikes in the
float model and on the chip. It is run again over these steps, from rest, with one deviation taken away at
a time. There it fires where both did, which resets a membrane but no current; at any other step but the
last it does not, or the replay says that it would. The cause is, in this order,

1. a tie, where the float model's membrane is at its threshold up to the rounding of float64;
2. of the deviations without which the spike is the float model's, the one that moved the membrane most;
3. what moved the membrane most.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.interpret import Activity, run_float, step_late
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.equivalence.explanation import results
from spikeloom.runtime.equivalence.explanation.roots import Root, find_roots
from spikeloom.runtime.equivalence.reference import taxel_and_feature
from spikeloom.runtime.machines.deviations import (
    LEFT_OUT,
    TIE,
    UNKNOWN,
    WEIGHTS,
    Deviations,
    Memories,
    Replays,
)

UNDECIDED = 256 * float(np.finfo(np.float64).eps)
"""Distance to threshold, as a share of all that the neuron adds up, that the order of a sum decides."""

REMEDIES = {
    LEFT_OUT: "compile without --prune-unused",
    TIE: "none: the order of a sum in float64 decides here, either spike is right",
}
"""What removes a cause on every chip."""


def explain(
    network: Network,
    deviations: Deviations,
    events: BoolArray,
    observed: Activity,
    *,
    absent: Sequence[BoolArray],
    unread: Sequence[BoolArray],
    pruned: bool,
) -> results.Explanation:
    """Find the roots of all differences between float64 model and chip on one recording, and their causes.

    `deviations` are those of the netlist from `network`, `events` are (steps, channels) bool, and
    `observed` is what the chip did on this recording. The chip does not hold the `absent` neurons of each
    population, of which the `unread` reach no neuron and are not compared; they were `pruned` on evidence,
    or cannot fire with their rounded weights.
    """
    both = _Sides(
        network=network,
        deviations=deviations,
        events=events,
        model=run_float(network, events[None], membranes=True),
        chip=observed,
        absent=absent,
        pruned=pruned,
    )
    layers = range(len(network.populations))
    differs = [
        (both.truth(post) != both.fired(post)) & ~mute for post, mute in zip(layers, unread, strict=True)
    ]
    resets = [both.together(post) & deviations.forgets(post) for post in layers]
    roots = find_roots(differs, resets, deviations.sources)
    causes: dict[Root, results.RootCause] = {}
    for post in layers:
        here = sorted(
            (root for root in roots if root.layer == post), key=lambda root: root.begin - root.step
        )
        causes |= _causes(both, post, here) if here else {}
    counts = Counter(root.layer for root in roots)
    return results.Explanation(
        layers=tuple(
            results.LayerRoots(
                name=population.name,
                float_spikes=int(np.count_nonzero(both.truth(post))),
                chip_spikes=int(np.count_nonzero(both.fired(post))),
                different=int(np.count_nonzero(differs[post])),
                roots=counts[post],
            )
            for post, population in enumerate(network.populations)
        ),
        found=tuple(causes[root] for root in roots),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sides:
    """What float model and chip did with one recording."""

    network: Network
    deviations: Deviations
    events: BoolArray
    model: Activity
    chip: Activity
    absent: Sequence[BoolArray]
    pruned: bool

    def truth(self, post: int) -> BoolArray:
        """Spikes of the float model, (steps, neurons)."""
        return np.asarray(self.model.spikes[post][0])

    def fired(self, post: int) -> BoolArray:
        """Spikes of the chip."""
        return np.asarray(self.chip.spikes[post][0])

    def together(self, post: int) -> BoolArray:
        """Spikes of both."""
        return self.truth(post) & self.fired(post)

    @property
    def reason_for_loss(self) -> str:
        """Why the chip does not hold some neurons."""
        return LEFT_OUT if self.pruned else WEIGHTS

    def arrived(self, post: int) -> FloatArray:
        """Spikes that reach a population, (steps, sources)."""
        inputs = []
        for pre in self.deviations.sources_into(post):
            # what the chip does not hold, it has no weights from: the float model's spikes say what it lacks
            sent = (
                self.events if pre == INPUT else np.where(self.absent[pre], self.truth(pre), self.fired(pre))
            )
            inputs.append(step_late(sent[None])[0] if pre == post else sent)
        return np.concatenate(inputs, axis=1).astype(np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Evidence:
    """What there is to say about the roots of one population, (roots,), and about each deviation, (variants, roots)."""

    post: int
    replays: Replays
    truth: BoolArray  # Whether the float model fires
    membrane: FloatArray  # Of the float model
    register: IntArray  # Of the chip
    undecided: BoolArray
    moved: FloatArray  # How far each deviation moved the membrane
    enough: BoolArray  # Whether without it the spike is the float model's


def _causes(both: _Sides, post: int, roots: Sequence[Root]) -> dict[Root, results.RootCause]:
    """Causes of roots of one population, which are sorted by the length of what they remember."""
    neurons = np.array([root.neuron for root in roots])
    steps = np.array([root.step for root in roots])
    memories = Memories(
        neurons=neurons,
        begin=np.array([root.begin for root in roots]),
        step=steps,
        arrived=both.arrived(post),
        fired=both.together(post)[:, neurons],
    )
    replays = both.deviations.replays(post, memories)
    population = both.network.populations[post]
    truth = both.truth(post)[steps, neurons]
    membrane = both.model.membranes[post][0, steps, neurons]
    register = np.asarray(both.chip.membranes[post][0], np.int64)[steps, neurons]
    # what the margin would be without each deviation; the first variant is the netlist itself
    margin = register - replays.threshold
    without = margin + (replays.margins - replays.margins[0])
    moved = np.abs(without - margin) / replays.unit
    magnitude = population.theta + replays.reach + np.abs(population.bias[neurons])
    evidence = _Evidence(
        post=post,
        replays=replays,
        truth=truth,
        membrane=membrane,
        register=register,
        undecided=np.abs(membrane - population.theta) <= UNDECIDED * magnitude,
        moved=moved,
        enough=((without > 0) == truth) & ~replays.early & (moved > 0),
    )
    return {root: _cause(both, evidence, place, root) for place, root in enumerate(roots)}


def _cause(both: _Sides, evidence: _Evidence, place: int, root: Root) -> results.RootCause:
    """The cause of one root, what else moved it, and how close both sides were."""
    post = evidence.post
    replays = evidence.replays
    population = both.network.populations[post]
    was_present = not both.absent[post][root.neuron]
    moved = evidence.moved[:, place]
    order = sorted(range(len(moved)), key=lambda variant: -moved[variant])
    enough = [variant for variant in order if evidence.enough[variant, place]]
    cause = _name(evidence, place, next(iter(enough), order[0])) if was_present else both.reason_for_loss
    clipped = any(replays.unclipped[variant] for variant in enough)
    amounts: dict[str, float] = {}  # the largest of each cause
    for variant in order:
        if moved[variant] > 0:
            amounts.setdefault(replays.causes[variant], float(moved[variant]))
    unit = replays.unit[place]
    membrane = float(evidence.membrane[place])
    chip_membrane = float(evidence.register[place] / unit)
    chip_theta = float(replays.threshold[place] / unit)
    taxel, feature = taxel_and_feature(both.network, post, root.neuron)
    remedy = REMEDIES.get(cause) or both.deviations.remedy(cause, post, clipped=clipped, held=was_present)
    return results.RootCause(
        layer=population.name,
        neuron=root.neuron,
        taxel=taxel,
        feature=feature,
        step=root.step,
        remembers_from_step=root.begin,
        float_fires=bool(evidence.truth[place]),
        float_membrane=membrane,
        float_distance=membrane - population.theta,
        theta=population.theta,
        chip_membrane=chip_membrane if was_present else None,
        chip_distance=chip_membrane - chip_theta if was_present else None,
        chip_theta=chip_theta if was_present else None,
        chip_register=int(evidence.register[place]) if was_present else None,
        chip_threshold_register=int(replays.threshold[place]) if was_present else None,
        cause=cause,
        held=was_present,
        clipped_weights=clipped,
        sufficient=tuple(dict.fromkeys(replays.causes[variant] for variant in enough))
        if was_present
        else (),
        moved=amounts if was_present else {},
        change=remedy or "none is known",
        dragged=root.dragged,
        dragged_alone=root.alone,
    )


def _name(evidence: _Evidence, place: int, variant: int) -> str:
    """A tie, or the deviation that is taken away in a variant, if it moved anything."""
    if evidence.undecided[place]:
        return TIE
    return evidence.replays.causes[variant] if evidence.moved[variant, place] > 0 else UNKNOWN
