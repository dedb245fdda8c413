"""Name the cause of every root: which deviation, if it alone were gone, would give the float model's spike.

A root's neuron remembers the steps since its last common reset, in which it got the same spikes in the float model
and on the chip. It is run again over these steps, from rest, with one deviation taken away at a time: a fault of the
machine or of the netlist, or what an intact netlist is entitled to (the rounding of weights, biases and membranes,
the decay that its register realises, the limit of its membrane). The cause is, in this order,

1. a fault without which the spike is the float model's;
2. a tie, where the float model's membrane is at its threshold up to the rounding of float64;
3. a deviation without which the spike is the float model's;
4. what moved the membrane most.

Among several it is the one that moved the membrane most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT, FloatArray, IntArray
from spikeloom.compiler.interpret import Activity, BoolArray, run_float, step_late
from spikeloom.compiler.ir import INPUT, IntegerNetwork, Network, depths
from spikeloom.runtime.equivalence.netlist_faults import Convolution, LayerCheck, check_layer, sources_into
from spikeloom.runtime.equivalence.replay import run_variants, variants_of
from spikeloom.runtime.equivalence.roots import Root, find_roots, sources_of
from spikeloom.runtime.equivalence.suspects import LEFT_OUT, TIE, UNKNOWN, WEIGHTS, Suspect, suspect_machine

UNDECIDED = 256 * float(np.finfo(np.float64).eps)
"""Distance to threshold, as a share of all that the neuron adds up, that the order of a sum decides."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observed:
    """What a machine did on one recording, aligned with the data.

    Parameters
    ----------
    spikes : tuple of (steps, neurons) bool
        One array per population.
    membranes : tuple of (steps, neurons) int
        Membrane registers before the reset.
    """

    spikes: tuple[BoolArray, ...]
    membranes: tuple[IntArray, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RootCause:
    """A root, and why it differs.

    Parameters
    ----------
    root : Root
        Where it is.
    cause : str
        One of ``CAUSES``; or ``LEFT_OUT``, or ``UNKNOWN``.
    suspect : Suspect or None
        The fault; None if an intact chip deviates like this.
    held : bool
        Whether the chip holds the neuron at all.
    clipped : bool
        Whether the float model's spike would be there if no weight were cut off by the range.
    sufficient : tuple of str
        Causes each of which, if it alone were gone, would give the float model's spike.
    gap : tuple of (str, float)
        How far each cause moved the chip's membrane against its threshold; the float model's units, largest first.
    float_fires : bool
        Whether it is the float model that fires, and not the chip.
    float_membrane, chip_membrane : float
        Membranes before the comparison, in the float model's units.
    theta, chip_theta : float
        Thresholds in the float model's units.
    chip_register, chip_threshold : int
        Membrane and threshold as the chip compares them.
    """

    root: Root
    cause: str
    suspect: Suspect | None
    held: bool
    clipped: bool
    sufficient: tuple[str, ...]
    gap: tuple[tuple[str, float], ...]
    float_fires: bool
    float_membrane: float
    chip_membrane: float
    theta: float
    chip_theta: float
    chip_register: int
    chip_threshold: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explanation:
    """Everything that was found on one recording.

    Parameters
    ----------
    float_spikes, chip_spikes, different : tuple of int
        Entries of each population that fire in the float64 model, on the chip, in one of them only.
    suspects : tuple of Suspect
        Faults of machine and netlist, whether or not a root of this recording comes from them.
    roots : tuple of RootCause
        Those that drag most along first.
    """

    float_spikes: tuple[int, ...]
    chip_spikes: tuple[int, ...]
    different: tuple[int, ...]
    suspects: tuple[Suspect, ...]
    roots: tuple[RootCause, ...]

    @property
    def diagnosis(self) -> str | None:
        """The cause of most roots, faults before all else; None if nothing differs and nothing is wrong."""
        faulty = [root.cause for root in self.roots if root.suspect is not None]
        names = faulty or [s.cause for s in self.suspects] or [root.cause for root in self.roots]
        return max(names, key=lambda name: (names.count(name), -names.index(name))) if names else None


def explain(
    network: Network,
    integer: IntegerNetwork,
    events: BoolArray,
    observed: Observed,
    *,
    convolution: Convolution | None = None,
    may_compensate: bool = False,
    absent: Sequence[BoolArray] | None = None,
    unheard: Sequence[BoolArray] | None = None,
    pruned: bool = False,
) -> Explanation:
    """Find the roots of all differences between float64 model and chip on one recording, and their causes.

    Parameters
    ----------
    network : Network
        Float stage.
    integer : IntegerNetwork
        What the netlist holds; its populations are those of the float stage.
    events : (steps, channels) bool
        Input events.
    observed : Observed
        What the chip, or a simulator of it, did.
    convolution : Convolution, optional
        Propagation matrix and hop filters of the first population, where it is a graph convolution.
    may_compensate : bool
        Whether the compiler had recordings to round on, so that weights need not be the nearest of the grid.
    absent, unheard : sequence of (neurons,) bool, optional
        Neurons of each population that the chip does not hold; those of them that nobody hears are not compared.
    pruned : bool
        Whether neurons were left out on evidence; otherwise only those that their rounded weights cannot fire.
    """
    ideal = run_float(network, events[None], membranes=True)
    truth = tuple(spikes[0] for spikes in ideal.spikes)
    nobody = [np.zeros(population.size, np.bool_) for population in network.populations]
    absent, unheard = absent or nobody, unheard or nobody
    differs = [(a != b) & ~mute for a, b, mute in zip(truth, observed.spikes, unheard, strict=True)]
    resets = [
        a & b if population.decay_u == 4095 else np.zeros_like(a)
        for a, b, population in zip(truth, observed.spikes, integer.populations, strict=True)
    ]
    roots = find_roots(differs, resets, sources_of(network, integer))

    suspects: list[Suspect] = []
    causes: dict[Root, RootCause] = {}
    depth = depths(integer)
    for post in range(len(network.populations)):
        check = check_layer(
            network,
            integer,
            post,
            absent=absent,
            convolution=None if post else convolution,
            may_compensate=may_compensate,
        )
        inputs = []
        for pre in sources_into(network, integer, post):
            # what the chip does not hold, it has no weights from: the float model's spikes tell what it lacks
            sent = events if pre == INPUT else np.where(absent[pre], truth[pre], observed.spikes[pre])
            inputs.append(step_late(sent[None])[0] if pre == post else sent)
        arrived = np.concatenate(inputs, axis=1).astype(np.float64)
        seen = observed.spikes[post], np.asarray(observed.membranes[post], np.int64)
        sums = arrived @ check.stored.weight.T / (1 << MEMBRANE_SHIFT)
        broken, machine = suspect_machine(integer.populations[post], sums, *seen, layer=post, depth=depth[post])
        found = (*((machine,) if machine else ()), *check.suspects)
        suspects += found
        here = sorted((r for r in roots if r.layer == post), key=lambda r: r.begin - r.step)
        if here:
            layer = _Layer(
                network=network,
                integer=integer,
                check=check,
                suspects=found,
                absent=absent[post],
                pruned=pruned,
                post=post,
            )
            causes |= zip(here, layer.name_causes(here, arrived, ideal, seen, broken), strict=True)
    return Explanation(
        float_spikes=tuple(int(np.count_nonzero(spikes)) for spikes in truth),
        chip_spikes=tuple(int(np.count_nonzero(spikes)) for spikes in observed.spikes),
        different=tuple(int(np.count_nonzero(d)) for d in differs),
        suspects=tuple(suspects),
        roots=tuple(causes[root] for root in roots),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layer:
    """One population whose roots are to be explained."""

    network: Network
    integer: IntegerNetwork
    check: LayerCheck
    suspects: tuple[Suspect, ...]
    absent: BoolArray
    pruned: bool
    post: int

    def name_causes(
        self,
        roots: list[Root],
        arrived: FloatArray,
        ideal: Activity,
        seen: tuple[BoolArray, IntArray],
        broken: BoolArray,
    ) -> list[RootCause]:
        """Causes of roots of this population, which are sorted by the length of what they remember."""
        assert ideal.membranes is not None, "membranes were asked for"
        rows = np.array([root.neuron for root in roots])
        steps = np.array([root.step for root in roots])
        begins = np.array([root.begin for root in roots])
        variants = variants_of(self.check, rows)
        stored, rounded, real = (r.weight[rows] for r in (self.check.stored, self.check.rounded, self.check.ideal))
        whole = np.where(self.check.clipped[rows], stored + real - rounded, stored)
        inflows = np.stack([arrived @ w.T for w in (stored, rounded, stored + real - rounded, whole)])
        both = (ideal.spikes[self.post][0] & seen[0])[:, rows]
        margins, early = run_variants(variants, inflows, begins, steps, both)

        unit = self.integer.populations[self.post].scale[rows] * (1 << MEMBRANE_SHIFT)
        threshold = self.check.stored.threshold[rows]
        register = seen[1][steps, rows]
        margin = register - threshold
        truth = ideal.spikes[self.post][0, steps, rows]
        membrane = ideal.membranes[self.post][0, steps, rows]

        # what the margin would be without each deviation; the first variant is what the netlist itself asks for
        without = margin + (margins - margins[0])
        without[0] = margins[0]
        moved = np.abs(without - margin) / unit
        mended = (without > 0) == truth
        mended &= ~early
        judged_wrong = broken[steps, rows] & ((margin > 0) != seen[0][steps, rows])
        moved[0, judged_wrong], mended[0, judged_wrong] = np.inf, True

        weights = self.check.ideal.weight[rows] / unit[:, None]
        theta = self.network.populations[self.post].theta
        magnitude = theta + np.abs(weights).sum(axis=1) + np.abs(self.network.populations[self.post].bias[rows])
        undecided = np.abs(membrane - theta) <= UNDECIDED * magnitude
        faults = [next((s for s in self.suspects if s.part == v.part), None) for v in variants]
        names = [fault.cause if fault else v.cause for fault, v in zip(faults, variants, strict=True)]
        found = []
        for i, root in enumerate(roots):
            order = sorted(range(len(variants)), key=lambda k: -moved[k, i])
            enough = [k for k in order if mended[k, i] and moved[k, i] > 0]
            first = next((k for k in enough if faults[k]), None)
            if first is None and not undecided[i]:
                first = next(iter(enough), order[0] if moved[order[0], i] > 0 else None)
            cause = names[first] if first is not None else TIE if undecided[i] else UNKNOWN
            if self.absent[root.neuron]:
                first, cause = None, LEFT_OUT if self.pruned else WEIGHTS
            found.append(
                RootCause(
                    root=root,
                    cause=cause,
                    suspect=None if first is None else faults[first],
                    held=not self.absent[root.neuron],
                    clipped=any(variants[k].part == "clipped" for k in enough),
                    sufficient=tuple(dict.fromkeys(names[k] for k in enough if not self.absent[root.neuron])),
                    gap=_largest([(names[k], float(moved[k, i])) for k in order if not self.absent[root.neuron]]),
                    float_fires=bool(truth[i]),
                    float_membrane=float(membrane[i]),
                    chip_membrane=float(register[i] / unit[i]),
                    theta=theta,
                    chip_theta=float(threshold[i] / unit[i]),
                    chip_register=int(register[i]),
                    chip_threshold=int(threshold[i]),
                )
            )
        return found


def _largest(moved: list[tuple[str, float]]) -> tuple[tuple[str, float], ...]:
    """The largest finite amount of each cause, largest first, from a sorted list."""
    found: dict[str, float] = {}
    for cause, amount in moved:
        if 0 < amount < np.inf:
            found.setdefault(cause, amount)
    return tuple(found.items())
