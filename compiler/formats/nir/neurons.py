"""Spiking nodes of NIR as neurons in steps, and what the reader of a file would want to check about them.

An IF neuron keeps its whole membrane and gets ``dt * r * I``. A neuron that resets to `v_reset` is one that resets to
0, with its threshold, leak and start shifted by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import decay_registers, kept_shares
from spikeloom.compiler.formats.affine import shifted
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.nir.file import Graph, Node
from spikeloom.compiler.formats.nir.stages import TOLERANCE, Steps, Value, filtered, shared, spread, written_step
from spikeloom.compiler.ir import Input
from spikeloom.compiler.types import FloatArray, IntArray

SOFT = ("subtract", "soft")
"""Words by which exporters tell a reset that leaves what exceeds the threshold."""

MOST_DECAYS = 16
"""Membrane decays within a node; each becomes a layer of its own. A core holds 32."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neurons:
    """A spiking node in steps, reset to 0; all arrays (neurons,) float64.

    ``u <- beta * u * (1 - s) + value``, ``s = u > theta``.
    """

    node: Node  # As the file has it
    value: Value  # What it gets, scaled to its membrane, with its leak
    beta: FloatArray
    gain: FloatArray  # By which its input was scaled
    theta: FloatArray
    reset: FloatArray
    groups: list[IntArray]  # Its neurons by their decays


def neurons_of(node: Node, value: Value, steps: Steps) -> Neurons:
    """Neurons of a node of a type in ``SPIKING`` that gets a value; ModelError if the chip has no such neurons."""
    size, shape = value.size, value.shape
    if not size:
        raise node.fail("has no neurons; export it again")
    _require_reset(node)

    def each(key: str) -> FloatArray:
        return spread(node, key, size, shape)

    nothing, alpha = np.zeros(size), 0.0
    beta, gain, drive = nothing, np.ones(size), nothing
    reset = each("v_reset") if node.has("v_reset") else nothing
    theta = each("threshold" if node.type == "Threshold" else "v_threshold") - reset
    if node.type == "IF":
        beta, gain = gain, each("r") * steps.dt
    elif node.type in ("LIF", "CubaLIF"):
        beta = steps.keeps(node, "tau" if node.type == "LIF" else "tau_mem", size, shape)
        drive = (1 - beta) * (each("v_leak") - reset)
        gain = each("r") * (1 - beta)
        if node.type == "CubaLIF":
            alpha = shared(node, "tau_syn", steps.keeps(node, "tau_syn", size, shape))
            gain = gain * (each("w_in") if node.has("w_in") else np.ones(size)) * (1 - alpha)
        # r = tau / dt, stored in float32, makes a gain of 1 that is not quite one
        gain = np.where(np.abs(gain - 1) < TOLERANCE, 1.0, gain)
    if np.any(theta <= 0):
        raise node.fail(f"fires {theta.min():g} above its reset, allowed are thresholds above it; train it again")
    with node.named():
        own = shifted(filtered(value, alpha, gain, nothing), drive)  # a leak acts past the current
    decays = np.round(beta / TOLERANCE).astype(np.int64)
    different = np.unique(decays)
    if len(different) > MOST_DECAYS:
        raise node.fail(
            f"has {len(different)} different membrane time constants, {MOST_DECAYS} are allowed in a node; train with "
            "fewer"
        )
    groups = [np.flatnonzero(decays == decay) for decay in different]
    return Neurons(node=node, value=own, beta=beta, gain=gain, theta=theta, reset=reset, groups=groups)


def _require_reset(node: Node) -> None:
    for key, value in (node.metadata | {k: v for k, v in node.values.items() if "reset" in k}).items():
        if "reset" in key.lower() and isinstance(value, str) and any(word in value.lower() for word in SOFT):
            raise node.fail(
                f"resets by subtraction ({key} = {value!r}), which a neuron of this chip cannot; train with a reset "
                "to a value"
            )


def facts_of(graph: Graph, steps: Steps, spiking: Sequence[Neurons], sensor: str, clocked: Input) -> list[str]:
    """How a file was read, its layers, what its input (`sensor`, in words) was taken for, and what files may lose."""
    version = printable(graph.version) or "of no version"
    facts = [f"NIR {version}, read in steps of {steps.dt:g} s ({steps.convention})", sensor]
    for one in spiking:
        decays = " or ".join(_decay_words(float(one.beta[rows[0]])) for rows in one.groups[:4])
        fact = f"layer {printable(one.node.name)} ({one.node.type}): {len(one.beta)} neurons, {decays}"
        fact += f", current {one.value.alpha:.6g}" if one.value.alpha else ""
        fact += f", fires at v > {_span(one.theta + one.reset)}, then v = {_span(one.reset)}"
        if np.any(np.abs(one.gain - 1) > 1e-4):
            fact += f"; a step adds {_span(one.gain)} of its input"
        facts.append(fact)
    facts.append(
        "v goes to its reset as NIR says; a framework that subtracts the threshold instead means another network"
    )
    if any(one.node.type == "CubaLIF" for one in spiking):
        facts.append(
            "a reset leaves currents as they are, as NIR says; snnTorch's Synaptic with reset 'zero' clears them"
        )
    if looped := [printable(one.node.name) for place, one in enumerate(spiking) if place in one.value.terms]:
        facts.append(
            f"{', '.join(looped)}: is recurrent, fed by its own spikes of the step before; snnTorch's RLeaky with "
            "reset 'zero' means this with reset_delay=False, else it loses the input of the step after each spike"
        )
    written = written_step(graph)
    if written is not None and not math.isclose(written, steps.dt, rel_tol=1e-4):
        facts.append(
            f"drift: r is tau / {written:g} in every neuron, as of a file written in steps of {written:g} s; in steps "
            f"of {steps.dt:g} s its decays and gains are others than there"
        )
    if clocked.clocks.channels:
        facts.append("biases that go through a synaptic current come from a channel that always has an event")
    return facts


def _decay_words(beta: float) -> str:
    """A membrane decay, and what the chip makes of it where that differs."""
    _, realised = kept_shares(*decay_registers(beta))
    same = math.isclose(beta, realised, abs_tol=TOLERANCE)
    return f"decay {beta:.6g}" + ("" if same else f" ({realised:.6g} on the chip)")


def _span(values: FloatArray) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.6g}" if math.isclose(low, high, rel_tol=1e-6, abs_tol=1e-12) else f"{low:.6g} … {high:.6g}"
