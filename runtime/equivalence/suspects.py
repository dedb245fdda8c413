"""What can make chip and float model differ; and faults of a machine, where it does not follow its netlist.

A neuron's step is judged by itself: from the membrane that was observed one step earlier and the spikes
that were observed at its inputs, the chip's rule says what this step must bring. Where it brings something else, the
rule is varied, and the variant under which the whole trace of the layer holds is the fault.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.fixedpoint import DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT, FloatArray, IntArray
from spikeloom.compiler.interpret import BoolArray
from spikeloom.compiler.ir import IntegerPopulation

WEIGHTS, BIAS, THRESHOLD = "weight rounding", "bias rounding", "threshold rounding"
BETA, TRUNCATION, SATURATION = "realised beta", "round toward zero", "saturation or overflow"
TIE, SKEW, STATE = "tie (> or >=)", "pipeline skew", "state left from the sample before"
GRAPH, TRANSPOSED = "wrong graph or duplicate edges", "transposed weights"
LEFT_OUT, UNKNOWN = "neuron left out", "not known"

CAUSES = (WEIGHTS, BIAS, THRESHOLD, BETA, TRUNCATION, SATURATION, TIE, SKEW, STATE, GRAPH, TRANSPOSED)
"""What can make a chip that holds every neuron differ from the float model."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Suspect:
    """A fault of one layer.

    Parameters
    ----------
    cause : str
        One of ``CAUSES``, or ``UNKNOWN``.
    layer : int
        Population.
    part : str
        ``machine``, or what of the netlist is wrong: ``weight``, ``bias``, ``threshold`` or ``decay``.
    found : str
        What was found.
    change : str
        What removes it.
    """

    cause: str
    layer: int
    part: str
    found: str
    change: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One compartment step; the defaults are the chip's.

    Parameters
    ----------
    cause, found, change : str
        What to say if this rule turns out to be the machine's.
    rounds : callable
        Rounding of the decayed registers.
    at_least : bool
        Compare with ``>=``.
    delay : int
        Steps by which inputs come late; negative if early.
    sum_limit, membrane_limit : callable
        What the accumulator and the membrane register make of a value.
    head_start : int
        Empty steps that integrate the bias before the first.
    any_start : bool
        Whether the membrane may hold anything before the first step.
    """

    cause: str = UNKNOWN
    found: str = ""
    change: str = ""
    rounds: Callable[[FloatArray], FloatArray] = np.trunc
    at_least: bool = False
    delay: int = 0
    sum_limit: Callable[[FloatArray], FloatArray] | None = None
    membrane_limit: Callable[[FloatArray], FloatArray] = lambda v: np.clip(v, -MEMBRANE_MAX, MEMBRANE_MAX)
    head_start: int = 0
    any_start: bool = False


def _clip(bits: int) -> Callable[[FloatArray], FloatArray]:
    return lambda v: np.clip(v, -(2.0**bits) + 1, 2.0**bits - 1)


def _wrap(bits: int) -> Callable[[FloatArray], FloatArray]:
    return lambda v: np.mod(v + 2.0**bits, 2.0 ** (bits + 1)) - 2.0**bits


def _rules(depth: int) -> list[Rule]:
    """Variants of the chip's rule, those first that leave least to chance."""
    strict = Rule(cause=TIE, at_least=True, found="fires at the threshold (>=)", change="compare strictly, with >")
    rules = [strict]
    toward_zero = "decay the magnitude and drop the fraction (Python's // and >> do not, below zero)"
    for name, rounds in (
        ("down", np.floor),
        ("to the nearest", np.rint),
        ("to the nearest, halves up", lambda v: np.floor(v + 0.5)),
        ("to the nearest, halves away from zero", lambda v: np.copysign(np.floor(np.abs(v) + 0.5), v)),
        ("away from zero", lambda v: np.copysign(np.ceil(np.abs(v)), v)),
        ("up", np.ceil),
    ):
        rules.append(Rule(cause=TRUNCATION, found=f"decay rounds {name}", change=toward_zero, rounds=rounds))
    for steps in (1, -1, 2, -2):
        when = f"{abs(steps)} step{'s' if abs(steps) > 1 else ''} {'late' if steps > 0 else 'early'}"
        change = "count a layer's window from its own depth: a spike of step t acts in step t + 1, not sooner or later"
        rules.append(Rule(cause=SKEW, found=f"inputs arrive {when}", change=change, delay=steps))
    for steps in range(1, depth + 1):
        found = f"the bias acts in {steps} empty step{'s' if steps > 1 else ''} before the data"
        change = "hold a layer at zero until its window begins"
        rules.append(Rule(cause=SKEW, found=found, change=change, head_start=steps))
    change = "keep to the registers' widths: 21 bits and sign for a sum, 23 and sign for a membrane"
    rules.append(Rule(cause=SATURATION, found="the membrane has no limit", change=change, membrane_limit=lambda v: v))
    for bits in range(23, 5, -1):
        for word, limit in (("saturates", _clip(bits)), ("wraps", _wrap(bits))):
            at = f"{word} at {bits} bits and sign"
            rules.append(Rule(cause=SATURATION, found=f"the membrane {at}", change=change, membrane_limit=limit))
            rules.append(Rule(cause=SATURATION, found=f"the synaptic sum {at}", change=change, sum_limit=limit))
    found = "the membrane is not zero before the first step"
    rules.append(Rule(cause=STATE, found=found, change="reset every layer between two recordings", any_start=True))
    return rules


def breaches(
    population: IntegerPopulation, sums: FloatArray, spikes: BoolArray, membranes: IntArray, rule: Rule
) -> BoolArray:
    """Steps in which neurons do not do what a rule says.

    Parameters
    ----------
    population : IntegerPopulation
        Registers of the neurons.
    sums : (steps, neurons) float64
        Synaptic sums that the observed spikes bring, weight units.
    spikes, membranes : (steps, neurons)
        Observed; membranes before the reset, register values.
    rule : Rule
        What to hold them against.

    Returns
    -------
    (steps, neurons) bool
    """
    inflow = np.zeros_like(sums)
    late = max(rule.delay, 0), max(-rule.delay, 0)
    inflow[late[0] : len(sums) - late[1]] = sums[late[1] : len(sums) - late[0]] * (1 << MEMBRANE_SHIFT)
    if rule.sum_limit is not None:
        inflow = rule.sum_limit(inflow)
    keep_u, keep_v = kept_shares(population)
    if keep_u:
        for step in range(1, len(inflow)):
            inflow[step] += rule.rounds(keep_u * inflow[step - 1])
    bias = population.bias.astype(np.float64)
    before = np.zeros_like(inflow)
    before[1:] = np.where(spikes[:-1], 0, membranes[:-1])
    for _ in range(rule.head_start):
        before[0] = rule.rounds(keep_v * before[0]) + bias
    membrane = rule.membrane_limit(rule.rounds(keep_v * before) + inflow + bias)
    threshold = population.threshold << MEMBRANE_SHIFT
    if rule.any_start:
        membrane[0] = membranes[0]
    fired = membranes >= threshold if rule.at_least else membranes > threshold
    wrong: BoolArray = (membrane != membranes) | (fired != spikes)
    return wrong


def kept_shares(population: IntegerPopulation) -> tuple[float, float]:
    """Shares of current and membrane that a step keeps."""
    one = 1 << DECAY_BITS
    return (one - population.decay_u - 1) / one, (one - population.decay_v) / one


def suspect_machine(
    population: IntegerPopulation,
    sums: FloatArray,
    spikes: BoolArray,
    membranes: IntArray,
    *,
    layer: int,
    depth: int,
) -> tuple[BoolArray, Suspect | None]:
    """Say where a layer does not follow its netlist, and which fault explains that.

    Parameters
    ----------
    population, sums, spikes, membranes
        As for :func:`breaches`.
    layer, depth : int
        Which population this is, and how many steps it lags.

    Returns
    -------
    (steps, neurons) bool
        Steps in which the chip's rule is broken.
    Suspect or None
        None if it never is.
    """
    broken = breaches(population, sums, spikes, membranes, Rule())
    if not broken.any():
        return broken, None
    held = broken.any(axis=0)
    some = replace(
        population,
        scale=population.scale[held],
        threshold=population.threshold[held],
        bias_mantissa=population.bias_mantissa[held],
        bias_exponent=population.bias_exponent[held],
    )
    seen = sums[:, held], spikes[:, held], membranes[:, held]
    total = int(broken.sum())
    left, best = min(
        ((int(breaches(some, *seen, rule).sum()), rule) for rule in _rules(depth)), key=lambda tried: tried[0]
    )
    if 2 * left > total:
        found = f"follows no rule that is known here; {total:,} steps break the chip's"
        change = "compare the simulator with the specification (verify, level E0)"
        return broken, Suspect(cause=UNKNOWN, layer=layer, part="machine", found=found, change=change)
    found = f"{best.found}: this explains {total - left:,} of {total:,} steps that break the chip's rule"
    return broken, Suspect(cause=best.cause, layer=layer, part="machine", found=found, change=best.change)
