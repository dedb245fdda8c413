"""From the time constants of NIR to what a step keeps, and what a file tells about the step that it was written in.

NIR neurons are differential equations and a file has no time step. In steps of `dt` a membrane with time constant tau
keeps ``beta``, and the rest, ``1 - beta``, comes from ``v_leak + r * I``:

``euler``
    ``beta = 1 - dt / tau``, the forward Euler method, which snnTorch, Norse and SpikingJelly mean;
``exponential``
    ``beta = exp(-dt / tau)``, exact for an input that is constant over the step, which sinabs means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.nir.file import SPIKING, Graph, Node
from spikeloom.compiler.types import FloatArray

TOLERANCE = 1e-6
"""What float32 leaves of equal numbers."""


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
            step = _written_for(node)
            hint = "" if step is None else f" (its r is tau / {step:g}, so it was written in steps of that)"
            raise node.fail(
                f"{key} is {tau.min():g} s, shorter than the step of {self.dt:g} s, which the Euler convention cannot "
                f"have{hint}; give another --dt, or --convention exponential"
            )
        return np.maximum(kept, 0)


def require_step(dt: float) -> None:
    """Refuse a time step that is none."""
    if not 0 < dt < math.inf:
        raise OptionError(f"--dt {dt:g}: is no time step; give seconds above 0")


def stated_step(graph: Graph) -> float | None:
    """Seconds of a step, where the metadata of a file say so."""
    said = graph.metadata.get("dt")
    return float(said.ravel()[0]) if isinstance(said, np.ndarray) and said.size == 1 else None


def written_step(graph: Graph) -> float | None:
    """Step that a file was written in, as far as all of its neurons say the same."""
    found = [_written_for(node) for node in graph.nodes.values() if node.type in SPIKING and node.type != "Threshold"]
    steps = [step for step in found if step is not None]
    same = len(steps) == len(found) and all(math.isclose(step, steps[0], rel_tol=1e-4) for step in steps)
    return steps[0] if steps and same else None


def _written_for(node: Node) -> float | None:
    """The same by a neuron, where its parameters tell: `r` is tau over the step, and not 1.

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
    if values.size == size:
        return values.ravel()
    try:
        return np.array(np.broadcast_to(values.ravel() if values.size == 1 else values, shape)).ravel()
    except ValueError:
        raise node.fail(
            f"{key} has the shape {list(values.shape)}, it gets {list(shape)}; the shapes must be equal, export it "
            "again"
        ) from None


def shared(node: Node, key: str, decay: FloatArray) -> float:
    """The decay that all neurons of a node share; ModelError if they have several."""
    if np.ptp(decay) > TOLERANCE:
        raise node.fail(
            f"{key} is different from neuron to neuron, allowed is one for a layer's currents; use one node for each"
        )
    return float(decay[0]) if decay.size else 0.0
