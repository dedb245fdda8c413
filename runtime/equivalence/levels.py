"""Four levels of equivalence, and gates that ask for them.

*E0*: specification, engine and the netlist as read from disk agree in every spike, membrane and count. *E1*: a
quantisation-aware model equals the chip; it applies to fine-tuned checkpoints only. *E2*: spikes against the float
model, per layer, as ``1 - different / (float + chip)``. *E3*: decisions against the float model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.equivalence.verdict import LayerSpikes, Level, Verdict

LEVELS = ("E0", "E1", "E2", "E3")

SHARES = ("E2", "E3")
"""Levels whose gate needs a share."""


def spike_agreement(spikes: LayerSpikes) -> float:
    """Share of the spikes of a layer that float model and chip have in common, 1 for two silent layers.

    Examples
    --------
    >>> spike_agreement(LayerSpikes(float=60, chip=40, different=20, ill_posed=0))
    0.8
    """
    total = spikes.float + spikes.chip
    return 1 - spikes.different / total if total else 1.0


def mcnemar(labels: IntArray, first: IntArray, second: IntArray) -> tuple[int, int, float]:
    """Exact paired comparison of two classifiers [1]_: recordings that only one gets right, and a two-sided p-value.

    That is the probability of a split at least as uneven if both were equally good (binomial, 1/2).

    References
    ----------
    .. [1] Q. McNemar, "Note on the sampling error of the difference between correlated proportions or percentages",
       Psychometrika 12, 1947.

    Examples
    --------
    >>> import numpy as np
    >>> labels = np.zeros(6, int)
    >>> mcnemar(labels, np.array([0, 0, 0, 0, 0, 1]), np.array([1, 1, 1, 1, 1, 1]))
    (5, 0, 0.0625)
    """
    only_first = int(((first == labels) & (second != labels)).sum())
    only_second = int(((first != labels) & (second == labels)).sum())
    n, k = only_first + only_second, min(only_first, only_second)
    tail = sum(math.comb(n, i) for i in range(k + 1)) / 2**n
    return only_first, only_second, min(1.0, 2 * tail)


def levels_of(verdict: Verdict) -> tuple[Level, ...]:
    """Summarise a verdict on the four levels."""
    agreement = {name: spike_agreement(spikes) for name, spikes in verdict.spikes.items()}
    worst = min(agreement, key=lambda name: agreement[name])
    equal = round(verdict.decision_agreement * len(verdict.files))
    only_float, only_chip, p = mcnemar(verdict.labels, verdict.float_predictions, verdict.chip_predictions)
    moved = int(abs(verdict.float_counts - verdict.chip_counts).sum())
    return (
        Level(
            name="E0",
            share=float(verdict.spec_equals_engine),
            text=f"specification = engine {'in' if verdict.spec_equals_engine else 'NOT in'} every spike, membrane and "
            f"count of {verdict.spec_samples} recordings{_further(verdict)}",
        ),
        _quantised_level(verdict),
        Level(
            name="E2",
            share=agreement[worst],
            text="spikes in common with the float model: "
            + ", ".join(f"{name} {100 * share:.2f} %" for name, share in agreement.items()),
        ),
        Level(
            name="E3",
            share=verdict.decision_agreement,
            text=f"{equal} of {len(verdict.files)} decisions equal; right on float only {only_float}, on chip only "
            f"{only_chip} (exact McNemar p = {p:.3g}); class votes moved: {moved:,} of {verdict.float_counts.sum():,}",
        ),
    )


def _further(verdict: Verdict) -> str:
    if verdict.engine_different is None:
        return ""
    where = f"{verdict.engine_different:,} differing spikes on {len(verdict.files)} recordings"
    return f"; {verdict.engine} beside it, {where}"


def _quantised_level(verdict: Verdict) -> Level:
    different = verdict.quantised_different
    if different is None:
        text = "not applicable: the checkpoint was not fine-tuned on the chip's integers"
        return Level(name="E1", share=None, text=text)
    spikes = sum(layer.chip for layer in verdict.spikes.values())
    return Level(
        name="E1",
        share=float(different == 0),
        text=f"fine-tuned model = chip: {different:,} differing spikes of {spikes:,} "
        f"on {len(verdict.files)} recordings",
    )


def parse_requirements(words: str) -> dict[str, float]:
    """Read a gate such as ``E0,E2=0.99,E3=0.98``; OptionError if a part is no level, comes twice, or has a wrong share.

    Examples
    --------
    >>> parse_requirements("E0,E3=0.98")
    {'E0': 1.0, 'E3': 0.98}
    """
    required: dict[str, float] = {}
    for part in words.split(","):
        name, given, number = part.strip().partition("=")
        where = f"--require {words}: {part.strip()!r}"
        if name not in LEVELS or name in required:
            raise OptionError(f"{where}: give each of E0, E1, E2=SHARE, E3=SHARE once at most, with commas between")
        if bool(given) != (name in SHARES):
            raise OptionError(f"{where}: {'needs a share, as in ' + name + '=0.98' if not given else 'takes no share'}")
        try:
            share = float(number) if given else 1.0
        except ValueError:
            share = math.nan
        if not 0 <= share <= 1:
            raise OptionError(f"{where}: not a share; give a number from 0 to 1")
        required[name] = share
    return required


def judged(verdict: Verdict, required: Mapping[str, float]) -> Verdict:
    """A verdict with its levels and those of the required shares, by level, that it misses.

    Weights that are not the checkpoint's are always a miss.
    """
    levels = levels_of(verdict)
    missed = unmet(levels, required) + ([] if verdict.weights.holds else [f"weights: {verdict.weights.text}"])
    return replace(verdict, levels=levels, missed=tuple(missed))


def unmet(levels: tuple[Level, ...], required: Mapping[str, float]) -> list[str]:
    """Say which required levels are not reached."""
    missed = []
    for level in levels:
        wanted = required.get(level.name)
        if wanted is not None and level.share is None:
            missed.append(f"{level.name}: {level.text}")
        elif wanted is not None and level.share is not None and level.share < wanted:
            missed.append(f"{level.name}: {level.share:.4f} reached, {wanted:g} required")
    return missed
