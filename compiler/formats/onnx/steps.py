"""Group the neurons of a graph into layers: of one step as they are, of several steps by what carries on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.assemble import class_of_each
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.onnx.affine import INPUT_ATOM, MEMBRANE, Affine, Table
from spikeloom.compiler.formats.onnx.lif import EQUAL, RESET, Neurons
from spikeloom.compiler.ir import INPUT, Sparse
from spikeloom.compiler.types import IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Unrolled:
    """Layers, each with its neurons in every step."""

    layers: list[list[Neurons]]  # by layer, then step; one step where state goes in and out of the graph
    data: int  # atom of the input that brings the events
    shape: tuple[int, ...]  # of that input in one step
    # stages into each layer by the place of the source or INPUT; columns of the input are flat positions in it
    sources: list[dict[int, Sparse]]


def group(table: Table, neurons: Sequence[Neurons], shapes: Mapping[int, tuple[int, ...]]) -> Unrolled:
    """Bring steps together; `shapes` are those of each input of the graph by its atom.

    Raises ModelError if there are no neurons, steps are unlike each other, or it is not clear which input brings the
    events.
    """
    if not neurons:
        raise ModelError(f"holds no spiking layer: no membrane is compared with a threshold; {RESET}")
    layers = _chains(table, neurons)
    data = _data(table, neurons)
    step_of = {n.spike: (index, step) for index, layer in enumerate(layers) for step, n in enumerate(layer)}
    shape, positions = _time(table, layers, data, shapes[data])
    sources: list[dict[int, Sparse]] = []
    for layer in layers:
        every = [_sources(table, n, step, step_of, {data: positions[step]}) for step, n in enumerate(layer)]
        for step in range(1, len(layer)):
            _require_like(layer, step, every)
        sources.append(every[0])
        if layer[-1].beta is None:
            raise ModelError(
                f"{layer[0].node}: keeps no membrane from step to step, so its decay is unknown; export one "
                "step with its state as inputs and outputs, or at least two steps"
            )
    return Unrolled(layers=layers, data=data, shape=shape, sources=sources)


def _chains(table: Table, neurons: Sequence[Neurons]) -> list[list[Neurons]]:
    """Neurons that carry on from each other, in order of steps."""
    after = {n.previous: n for n in neurons if n.previous is not None and table.atoms[n.previous].kind == MEMBRANE}
    chains = [[n] for n in neurons if n.previous is None or table.atoms[n.previous].kind == INPUT_ATOM]
    for chain in chains:
        while (following := after.get(chain[-1].membrane)) is not None:
            chain.append(following)
        if chain[0].previous is not None and len(chain) > 1:
            raise ModelError(
                f"{chain[0].node}: several steps of a network whose state goes in and out; export one step alone, or "
                "let the state start at zero"
            )
    lengths = [len(chain) for chain in chains]
    if sum(lengths) != len(neurons) or len(set(lengths)) > 1:
        raise ModelError(
            f"{chains[-1][0].node}: layers run {min(lengths)} to {max(lengths)} steps, or share a membrane; all layers "
            "run together, and each membrane belongs to one"
        )
    return chains


def _data(table: Table, neurons: Sequence[Neurons]) -> int:
    """The one input that is no state."""
    states = {atom for n in neurons for atom in (n.previous, n.gate)}
    received = {atom: n for n in reversed(neurons) for atom in n.current}
    data = sorted(atom for atom in received if table.atoms[atom].kind == INPUT_ATOM)
    mixed = [atom for atom in data if atom in states]
    if mixed:
        label = str(table.atoms[mixed[0]])
        raise ModelError(
            f"{received[mixed[0]].node}: takes the state {label} of a layer as its input, a recurrent connection, "
            "which is not read from ONNX; export the network as NIR"
        )
    if len(data) != 1:
        named = ", ".join(f"{table.atoms[atom]} ({table.atoms[atom].size})" for atom in data)
        where = f"{received[data[-1]].node}: " if data else ""
        raise ModelError(
            f"{where}{len(data)} inputs are no state of a neuron{f': {named}' if named else ''}; one must bring the "
            "events, and every other be a membrane or its spikes"
        )
    return data[0]


def _time(
    table: Table, layers: list[list[Neurons]], data: int, shape: tuple[int, ...]
) -> tuple[tuple[int, ...], list[IntArray]]:
    """Shape of one step of the input, and the flat positions of each step."""
    steps = len(layers[0])
    every = np.arange(table.atoms[data].size).reshape(shape)
    if steps == 1:
        return shape, [every.ravel()]
    for axis in range(len(shape)):
        if shape[axis] != steps:
            continue
        by_step = np.moveaxis(every, axis, 0).reshape(steps, -1)
        fits = all(
            np.isin(layer[step].current[data].indices, by_step[step]).all()
            for layer in layers
            for step in range(steps)
            if data in layer[step].current
        )
        if fits:
            return shape[:axis] + shape[axis + 1 :], list(by_step)
    shown = f"[{', '.join(map(str, shape))}]"
    raise ModelError(
        f"input {table.atoms[data]} {shown}: no axis of it is the time of the {steps} steps; let each "
        "step read its own events, in order"
    )


def _sources(
    table: Table, n: Neurons, step: int, step_of: Mapping[int, tuple[int, int]], inputs: Mapping[int, IntArray]
) -> dict[int, Sparse]:
    """Weights from each source; of an input from its positions in this step."""
    found = {}
    for atom, weight in n.current.items():
        if atom in inputs:
            found[INPUT] = weight[:, inputs[atom]]
        elif atom not in step_of:
            raise ModelError(f"{n.node}: takes {table.atoms[atom]}, which is no spike of a layer; {RESET}")
        else:
            layer, when = step_of[atom]
            if when != step:
                raise ModelError(
                    f"{n.node}: receives {table.atoms[atom]} of another step; only spikes of the "
                    "same step can be lowered"
                )
            found[layer] = weight
    for weight in found.values():
        weight.sort_indices()
    return found


def _require_like(layer: list[Neurons], step: int, every: list[dict[int, Sparse]]) -> None:
    """Whether a step is the first one again; a threshold and a bias that both moved are the same neuron."""
    first, this = layer[0], layer[step]
    shift = first.theta - this.theta if step + 1 == len(layer) else 0.0
    same = (
        set(every[0]) == set(every[step])
        and this.strict == first.strict
        and abs(this.theta + shift - first.theta) <= EQUAL
        and this.beta == layer[1].beta
        and np.allclose(this.bias + shift, first.bias, rtol=EQUAL, atol=EQUAL)
        and all(_equal(every[0][source], every[step][source]) for source in every[0])
    )
    if not same:
        raise ModelError(
            f"{this.node}: step {step} differs from step 0 in weights, bias, decay or threshold; all steps must be the "
            "same, from a state of zero"
        )


def _equal(first: Sparse, second: Sparse) -> bool:
    return first is second or (
        first.shape == second.shape
        and np.array_equal(first.indptr, second.indptr)
        and np.array_equal(first.indices, second.indices)
        and np.allclose(first.data, second.data, rtol=EQUAL, atol=0)
    )


def readout(table: Table, found: Unrolled, outputs: Mapping[str, Affine]) -> tuple[int, IntArray, str]:
    """Layer that votes, the class of each of its neurons, and the output that counts them.

    Raises ModelError if no output is a count of the spikes of the last layer, or several count them differently.
    """
    received = {source for sources in found.sources for source in sources}
    ends = [index for index in range(len(found.layers)) if index not in received]
    votes: list[tuple[int, IntArray, str]] = []
    for index in ends:
        spikes = [n.spike for n in found.layers[index]]
        for name, value in outputs.items():
            others = [atom for atom in value.terms if atom not in spikes]
            # A running count goes in and out as a state.
            counter = all(table.atoms[atom].kind == INPUT_ATOM for atom in others) and len(others) <= 1
            if not counter or any(spike not in value.terms for spike in spikes) or np.ptp(value.bias) > 0:
                continue
            first = value.terms[spikes[0]]
            label = class_of_each(first)
            if label is not None and all(_equal(first, value.terms[spike]) for spike in spikes):
                votes.append((index, label, name))
    summed = [vote for vote in votes if not np.array_equal(vote[1], np.arange(len(vote[1])))]
    chosen = summed or votes
    if not chosen:
        shown = ", ".join(printable(name) for name in outputs)
        raise ModelError(
            f"outputs {shown}: none counts the spikes of the last layer; give its spikes, or their sum over time, one "
            "neuron or one group of neurons a class"
        )
    if any(vote[0] != chosen[0][0] or not np.array_equal(vote[1], chosen[0][1]) for vote in chosen):
        shown = ", ".join(printable(vote[2]) for vote in chosen)
        raise ModelError(f"outputs {shown} count spikes differently; leave one of them, the classes")
    return chosen[0]
