"""Name the cause of every root: which deviation, if it alone were gone, would give the float model's spike.

A root's neuron remembers the steps since its last common reset, in which it got the same spikes in the float model
and on the chip. It is run again over these steps, from rest, with one deviation taken away at a time. The cause is, in
this order,

1. a tie, where the float model's membrane is at its threshold up to the rounding of float64;
2. of the deviations without which the spike is the float model's, the one that moved the membrane most;
3. what moved the membrane most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.interpret import Activity, run_float, step_late
from spikeloom.compiler.ir import INPUT, IntegerNetwork, Network
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.equivalence.explanation.deviations import (
    LEFT_OUT,
    TIE,
    UNKNOWN,
    WEIGHTS,
    LayerValues,
    layer_values,
    sources_into,
)
from spikeloom.runtime.equivalence.explanation.replay import UNCLIPPED, run_variants, variants_of
from spikeloom.runtime.equivalence.explanation.roots import Root, find_roots, sources_of
from spikeloom.runtime.equivalence.rounding import Rounding
from spikeloom.runtime.machines.base import EventArray
from spikeloom.runtime.machines.integer import IntegerMachine

UNDECIDED = 256 * float(np.finfo(np.float64).eps)
"""Distance to threshold, as a share of all that the neuron adds up, that the order of a sum decides."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observed:
    """What a machine did on one recording, aligned with the data.

    Of each population spikes and, before the reset, membrane registers, (steps, neurons).
    """

    spikes: tuple[BoolArray, ...]
    membranes: tuple[IntArray, ...]


def observe(machine: IntegerMachine, events: EventArray) -> Observed:
    """What the simulator shows of one recording, (1, taxels, polarities, steps)."""
    ran = machine.run(events, spikes=True, membranes=True)
    assert ran.spikes is not None, "spikes were wanted"
    assert ran.membranes is not None, "membranes were wanted"
    return Observed(
        spikes=tuple(spikes[0] for spikes in ran.spikes.values()),
        membranes=tuple(membranes[0] for membranes in ran.membranes.values()),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class RootCause:
    """A root, and why it differs.

    Membranes before the comparison and thresholds are in the float model's units, registers as the chip compares them.
    Each of the `sufficient` causes, if it alone were gone, would give the float model's spike, and so would weights
    that the range does not cut off if `clipped`. `moved` says how far each cause moved the chip's membrane against its
    threshold, largest first. The chip may not even have `held` the neuron.
    """

    root: Root
    cause: str
    held: bool
    clipped: bool
    sufficient: tuple[str, ...]
    moved: tuple[tuple[str, float], ...]
    float_fires: bool
    float_membrane: float
    chip_membrane: float
    theta: float
    chip_theta: float
    chip_register: int
    chip_threshold: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explanation:
    """Why one recording differs.

    Entries of each population that fire in the float64 model, on the chip, in one of them only; and the roots, those
    first that drag most along.
    """

    float_spikes: tuple[int, ...]
    chip_spikes: tuple[int, ...]
    different: tuple[int, ...]
    roots: tuple[RootCause, ...]

    @property
    def diagnosis(self) -> str | None:
        """The cause of most roots; None if nothing differs."""
        names = [root.cause for root in self.roots]
        return max(names, key=lambda name: (names.count(name), -names.index(name))) if names else None


def explain(
    network: Network,
    integer: IntegerNetwork,
    events: BoolArray,
    observed: Observed,
    *,
    rounding: Rounding | None = None,
    absent: Sequence[BoolArray] | None = None,
    unused: Sequence[BoolArray] | None = None,
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
        What the chip did.
    rounding : Rounding, optional
        What is known of the stored weights; by default each is the nearest.
    absent, unused : sequence of (neurons,) bool, optional
        Neurons of each population that the chip does not hold, and those of them whose spikes reach no neuron,
        which are not compared.
    pruned : bool
        Whether neurons were left out on evidence; otherwise only those that their rounded weights cannot fire.
    """
    ideal = run_float(network, events[None], membranes=True)
    truth = tuple(spikes[0] for spikes in ideal.spikes)
    none = [np.zeros(population.size, np.bool_) for population in network.populations]
    absent, unused = absent or none, unused or none
    differs = [(a != b) & ~mute for a, b, mute in zip(truth, observed.spikes, unused, strict=True)]
    resets = [
        a & b if population.decay_u == 4095 else np.zeros_like(a)
        for a, b, population in zip(truth, observed.spikes, integer.populations, strict=True)
    ]
    roots = find_roots(differs, resets, sources_of(network, integer))
    causes: dict[Root, RootCause] = {}
    for post, population in enumerate(network.populations):
        here = sorted((r for r in roots if r.layer == post), key=lambda r: r.begin - r.step)
        if not here:
            continue
        inputs = []
        for pre in sources_into(network, integer, post):
            # what the chip does not hold, it has no weights from: the float model's spikes say what it lacks
            sent = events if pre == INPUT else np.where(absent[pre], truth[pre], observed.spikes[pre])
            inputs.append(step_late(sent[None])[0] if pre == post else sent)
        compensated = rounding is not None and rounding.layers[population.name].compensated
        layer = _Layer(
            network=network,
            integer=integer,
            values=layer_values(network, integer, post, compensated=compensated),
            absent=absent[post],
            pruned=pruned,
            post=post,
        )
        arrived = np.concatenate(inputs, axis=1).astype(np.float64)
        seen = observed.spikes[post], np.asarray(observed.membranes[post], np.int64)
        causes |= zip(here, layer.name_causes(here, arrived, ideal, seen), strict=True)
    return Explanation(
        float_spikes=tuple(int(np.count_nonzero(spikes)) for spikes in truth),
        chip_spikes=tuple(int(np.count_nonzero(spikes)) for spikes in observed.spikes),
        different=tuple(int(np.count_nonzero(d)) for d in differs),
        roots=tuple(causes[root] for root in roots),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layer:
    """One population whose roots are to be explained."""

    network: Network
    integer: IntegerNetwork
    values: LayerValues
    absent: BoolArray
    pruned: bool
    post: int

    def name_causes(
        self, roots: list[Root], arrived: FloatArray, ideal: Activity, seen: tuple[BoolArray, IntArray]
    ) -> list[RootCause]:
        """Causes of roots of this population, which are sorted by the length of what they remember."""
        assert ideal.membranes is not None, "membranes were wanted"
        rows = np.array([root.neuron for root in roots])
        steps = np.array([root.step for root in roots])
        begins = np.array([root.begin for root in roots])
        variants = variants_of(self.values, rows)
        stored, real = self.values.stored.weight[rows], self.values.ideal.weight[rows]
        unclipped = np.where(self.values.clipped[rows], real, stored)
        inflows = np.stack([arrived @ weight.T for weight in (stored, real, unclipped)])
        both = (ideal.spikes[self.post][0] & seen[0])[:, rows]
        margins, early = run_variants(variants, inflows, begins, steps, both)

        unit = self.integer.populations[self.post].scale[rows] * (1 << MEMBRANE_SHIFT)
        threshold = self.values.stored.threshold[rows]
        register = seen[1][steps, rows]
        truth = ideal.spikes[self.post][0, steps, rows]
        membrane = ideal.membranes[self.post][0, steps, rows]

        # what the margin would be without each deviation; the first variant is the netlist itself
        margin = register - threshold
        without = margin + (margins - margins[0])
        moved = np.abs(without - margin) / unit
        mended = ((without > 0) == truth) & ~early & (moved > 0)

        population = self.network.populations[self.post]
        magnitude = population.theta + np.abs(real / unit[:, None]).sum(axis=1) + np.abs(population.bias[rows])
        undecided = np.abs(membrane - population.theta) <= UNDECIDED * magnitude
        found = []
        for i, root in enumerate(roots):
            held = not self.absent[root.neuron]
            order = sorted(range(len(variants)), key=lambda k: -moved[k, i])
            enough = [k for k in order if mended[k, i]]
            first = next(iter(enough), order[0] if moved[order[0], i] > 0 else None)
            cause = TIE if undecided[i] else UNKNOWN if first is None else variants[first].cause
            if not held:
                cause = LEFT_OUT if self.pruned else WEIGHTS
            found.append(
                RootCause(
                    root=root,
                    cause=cause,
                    held=held,
                    clipped=any(variants[k].weights == UNCLIPPED for k in enough),
                    sufficient=tuple(dict.fromkeys(variants[k].cause for k in enough)) if held else (),
                    moved=_largest([(variants[k].cause, float(moved[k, i])) for k in order]) if held else (),
                    float_fires=bool(truth[i]),
                    float_membrane=float(membrane[i]),
                    chip_membrane=float(register[i] / unit[i]),
                    theta=population.theta,
                    chip_theta=float(threshold[i] / unit[i]),
                    chip_register=int(register[i]),
                    chip_threshold=int(threshold[i]),
                )
            )
        return found


def _largest(moved: list[tuple[str, float]]) -> tuple[tuple[str, float], ...]:
    """The largest amount of each cause, largest first, from a sorted list."""
    found: dict[str, float] = {}
    for cause, amount in moved:
        if amount > 0:
            found.setdefault(cause, amount)
    return tuple(found.items())
