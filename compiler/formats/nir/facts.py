"""What the reader of a NIR file would want to check: what was read, what assumed, what such files are known to lose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.nir.file import Graph, Node
from spikeloom.compiler.formats.nir.neurons import SPIKING, Neurons, Steps, decay_words, written_for
from spikeloom.compiler.formats.nir.stages import Value
from spikeloom.compiler.ir import Input
from spikeloom.compiler.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpikingNode:
    """A spiking node in steps."""

    node: Node  # As the file has it
    value: Value  # What it gets, scaled to its membrane
    neurons: Neurons  # Its numbers
    groups: list[IntArray]  # Its neurons by their decays
    recurrent: bool  # Whether it is in a loop


def stated_step(graph: Graph) -> float | None:
    """Seconds of a step, where the metadata of a file say so."""
    said = graph.metadata.get("dt")
    return float(said.ravel()[0]) if isinstance(said, np.ndarray) and said.size == 1 else None


def hint(graph: Graph) -> str:
    """What the neurons of a file imply about the step that it was written in, to go on a sentence."""
    written = _written(graph)
    return "" if written is None else f", but its r is tau / {written:g}, as of steps of {written:g} s"


def _written(graph: Graph) -> float | None:
    """Step that the file was written in, as far as all of its neurons say the same."""
    found = [written_for(node) for node in graph.nodes.values() if node.type in SPIKING and node.type != "Threshold"]
    if not found or found[0] is None or any(step is None for step in found):
        return None
    return found[0] if all(math.isclose(step, found[0], rel_tol=1e-4) for step in found if step) else None


def facts_of(graph: Graph, steps: Steps, spiking: Sequence[SpikingNode], sensor: str, clocked: Input) -> list[str]:
    """Lines for people: how a file was read, its layers, and what its input (`sensor`, in words) was taken for."""
    version = printable(graph.version) or "of no version"
    facts = [f"NIR {version}, read in steps of {steps.dt:g} s ({steps.convention})", sensor]
    for one in spiking:
        n = one.neurons
        decays = " or ".join(decay_words(float(n.beta[rows[0]])) for rows in one.groups[:4])
        fact = f"layer {printable(one.node.name)} ({one.node.type}): {len(n.beta)} neurons, {decays}"
        fact += f", current {one.value.alpha:.6g}" if one.value.alpha else ""
        fact += f", fires at v > {_span(n.theta + n.reset)}, then v = {_span(n.reset)}"
        if np.any(np.abs(n.gain - 1) > 1e-4):
            fact += f"; a step adds {_span(n.gain)} of its input"
        facts.append(fact)
    return facts + _drifts(graph, steps, spiking, clocked)


def _drifts(graph: Graph, steps: Steps, spiking: Sequence[SpikingNode], sensor: Input) -> list[str]:
    """What files are known to lose or to change."""
    facts = ["v goes to its reset as NIR says; a framework that subtracts the threshold instead means another network"]
    if any(node.type == "CubaLIF" for node in graph.nodes.values()):
        facts.append(
            "a reset leaves currents as they are, as NIR says; snnTorch's Synaptic with reset 'zero' clears them"
        )
    if looped := [printable(one.node.name) for one in spiking if one.recurrent]:
        facts.append(
            f"{', '.join(looped)}: is recurrent, fed by its own spikes of the step before; snnTorch's RLeaky with "
            "reset 'zero' means this with reset_delay=False, else it loses the input of the step after each spike"
        )
    written = _written(graph)
    if written is not None and not math.isclose(written, steps.dt, rel_tol=1e-4):
        facts.append(
            f"drift: r is tau / {written:g} in every neuron, as of a file written in steps of {written:g} s; in steps "
            f"of {steps.dt:g} s its decays and gains are others than there"
        )
    if sensor.clocks.channels:
        facts.append("biases that go through a synaptic current come from a channel that always has an event")
    return facts


def _span(values: FloatArray) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.6g}" if math.isclose(low, high, rel_tol=1e-6, abs_tol=1e-12) else f"{low:.6g} … {high:.6g}"
