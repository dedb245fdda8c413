"""Neurons of NIR in steps: from time constants to what a step keeps, and what the numbers tell about their origin.

NIR neurons are differential equations and a file has no time step. In steps of `dt` a membrane with time constant tau
keeps ``beta``, and the rest, ``1 - beta``, comes from ``v_leak + r * I``:

``euler``
    ``beta = 1 - dt / tau``, the forward Euler method, which snnTorch, Norse and SpikingJelly mean;
``exponential``
    ``beta = exp(-dt / tau)``, exact for an input that is constant over the step, which sinabs means.

An IF neuron keeps everything and gets ``dt * r * I``. A neuron that resets to `v_reset` is one that resets to 0, with
its threshold, leak and start shifted by it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import decay_registers, kept_shares
from spikeloom.compiler.formats.nir.file import Node
from spikeloom.compiler.types import FloatArray

CONVENTIONS = ("euler", "exponential")

SOFT = ("subtract", "soft")
"""Words by which exporters tell a reset that leaves what exceeds the threshold."""

SPIKING = ("CubaLIF", "IF", "LIF", "Threshold")


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """How time constants become decays."""

    dt: float  # Seconds of a step
    convention: str  # {"euler", "exponential"}; see the module

    def keeps(self, node: Node, key: str, size: int, shape: tuple[int, ...]) -> FloatArray:
        """Share that a step keeps, of a time constant, (size,); ModelError if there is none in this convention."""
        tau = spread(node, key, size, shape)
        if np.any(tau <= 0):
            raise node.fail(f"{key} is {tau.min():g}, allowed are numbers above 0; train it again")
        if self.convention == "exponential":
            return np.asarray(np.exp(-self.dt / tau))
        kept = 1 - self.dt / tau
        if np.any(kept < -TOLERANCE):
            written = written_for(node)
            hint = "" if written is None else f" (its r is tau / {written:g}, so it was written in steps of that)"
            raise node.fail(
                f"{key} is {tau.min():g} s, shorter than the step of {self.dt:g} s, which the Euler convention cannot "
                f"have{hint}; give another --dt, or --convention exponential"
            )
        return np.maximum(kept, 0)


TOLERANCE = 1e-6
"""What float32 leaves of equal numbers."""


def written_for(node: Node) -> float | None:
    """Step that a file was written in, where the parameters of a neuron tell: `r` is tau over it, and not 1.

    Then a step adds its input as it is; snnTorch and SpikingJelly write so.
    """
    if not node.has("r"):
        return None
    key = {"LIF": "tau", "LI": "tau", "CubaLIF": "tau_mem"}.get(node.type)
    r = node.numbers("r").ravel()
    tau = node.numbers(key).ravel() if key and node.has(key) else np.ones(1)
    if 0 in (tau.size, r.size) or (tau.size != r.size and 1 not in (tau.size, r.size)) or np.all(r == 1):
        return None
    with np.errstate(all="ignore"):
        step = tau / r
    same = step[0] > 0 and np.ptp(step) <= TOLERANCE * step[0]
    return float(f"{step[0]:.6g}") if same else None


def spread(node: Node, key: str, size: int, shape: tuple[int, ...]) -> FloatArray:
    """A parameter for each neuron, (size,): one for all, one each, or one that broadcasts against `shape`."""
    values = node.numbers(key)
    if values.size == 1:
        return np.full(size, float(values.ravel()[0]))
    if values.size == size:
        return values.ravel()
    try:
        return np.array(np.broadcast_to(values, shape)).ravel()
    except ValueError:
        raise node.fail(
            f"{key} has the shape {list(values.shape)}, it gets {list(shape)}; the shapes must be equal, export it "
            "again"
        ) from None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neurons:
    """A spiking node in steps, reset to 0; all arrays (neurons,) float64.

    ``i <- alpha * i + gain * (input)``, ``u <- beta * u * (1 - s) + i + drive``, ``s = u > theta``.
    """

    beta: FloatArray
    alpha: float
    gain: FloatArray
    drive: FloatArray
    theta: FloatArray
    reset: FloatArray


def neurons_of(node: Node, size: int, shape: tuple[int, ...], steps: Steps) -> Neurons:
    """Neurons of a node of a type in ``SPIKING``; ModelError if the chip has no such neurons."""
    _require_reset(node)
    none = np.zeros(size)
    if node.type == "Threshold":
        theta = spread(node, "threshold", size, shape)
        found = Neurons(beta=none, alpha=0.0, gain=np.ones(size), drive=none, theta=theta, reset=none)
    else:
        found = _leaky(node, size, shape, steps)
    if np.any(found.theta <= 0):
        raise node.fail(f"fires {found.theta.min():g} above its reset, allowed are thresholds above it; train it again")
    return found


def _leaky(node: Node, size: int, shape: tuple[int, ...], steps: Steps) -> Neurons:
    none = np.zeros(size)
    r = spread(node, "r", size, shape)
    reset = spread(node, "v_reset", size, shape) if node.has("v_reset") else none
    theta = spread(node, "v_threshold", size, shape) - reset
    if node.type == "IF":
        return Neurons(beta=np.ones(size), alpha=0.0, gain=r * steps.dt, drive=none, theta=theta, reset=reset)
    beta = steps.keeps(node, "tau" if node.type == "LIF" else "tau_mem", size, shape)
    drive = (1 - beta) * (spread(node, "v_leak", size, shape) - reset)
    gain, alpha = r * (1 - beta), 0.0
    if node.type == "CubaLIF":
        alpha = one(node, "tau_syn", steps.keeps(node, "tau_syn", size, shape))
        weight = spread(node, "w_in", size, shape) if node.has("w_in") else np.ones(size)
        gain = gain * weight * (1 - alpha)
    # r = tau / dt, stored in float32, makes a gain of 1 that is not quite one
    gain = np.where(np.abs(gain - 1) < TOLERANCE, 1.0, gain)
    return Neurons(beta=beta, alpha=alpha, gain=gain, drive=drive, theta=theta, reset=reset)


def one(node: Node, key: str, decay: FloatArray) -> float:
    """The decay that all neurons of a node share; ModelError if they have several."""
    if np.ptp(decay) > TOLERANCE:
        raise node.fail(
            f"{key} is different from neuron to neuron, allowed is one for a layer's currents; use one node for each"
        )
    return float(decay[0]) if decay.size else 0.0


def _require_reset(node: Node) -> None:
    for key, value in (node.metadata | {k: v for k, v in node.values.items() if "reset" in k}).items():
        if "reset" in key.lower() and isinstance(value, str) and any(word in value.lower() for word in SOFT):
            raise node.fail(
                f"resets by subtraction ({key} = {value!r}), which a neuron of this chip cannot; train with a reset "
                "to a value"
            )


def require_steps(dt: float) -> None:
    """Refuse a time step that is none."""
    if not 0 < dt < math.inf:
        raise OptionError(f"--dt {dt:g}: is no time step; give seconds above 0")


def decay_words(beta: float) -> str:
    """A membrane decay, and what the chip makes of it where that differs.

    Examples
    --------
    >>> decay_words(0.2), decay_words(0.5)
    ('decay 0.2 (0.199951 on the chip)', 'decay 0.5')
    """
    _, realised = kept_shares(*decay_registers(beta))
    same = math.isclose(beta, realised, abs_tol=TOLERANCE)
    return f"decay {beta:.6g}" + ("" if same else f" ({realised:.6g} on the chip)")
