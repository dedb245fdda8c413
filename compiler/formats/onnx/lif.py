"""Find the neurons in what a graph computes, ``u <- beta * u * (1 - s) + current``, ``s = u > theta``; group them.

A membrane is affine in what varies. The part that comes from an earlier membrane must be what is left of
that after a reset to zero; the rest must come from the input and from spikes of the same step. How the file
writes that, by a product, a Where, with the reset before or after the decay, makes no difference here.

Neurons of one step are layers as they are, those of several steps by what carries on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.affine import Affine, diagonal
from spikeloom.compiler.formats.assemble import class_of_each
from spikeloom.compiler.formats.names import named, printable
from spikeloom.compiler.formats.onnx.atoms import INPUT_ATOM, MEMBRANE, PRODUCT, SPIKE, Table
from spikeloom.compiler.ir import INPUT, Sparse
from spikeloom.compiler.types import FloatArray, IntArray

EQUAL = 1e-12
"""Relative difference that reordered arithmetic on two constants explains."""

RESET = (
    "only u <- beta * u * (1 - s) + current, a reset to zero by the spike of the step before, can be lowered to the "
    "chip's neuron"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neurons:
    """A layer in one step; what are called atoms are places in the table."""

    membrane: int  # atom
    node: str  # operator that makes the membrane
    previous: int | None  # atom of the membrane, or of the state input, that it comes from
    gate: int | None  # state input that holds the spikes of the step before, where there is one
    spike: int  # atom
    beta: float | None  # none in a first step that starts at zero
    theta: float
    strict: bool  # fires above the threshold; else at it, too
    current: Mapping[int, Sparse]  # what else the membrane is made of, by atom
    bias: FloatArray


def neurons_of(table: Table, outputs: Mapping[str, Affine]) -> list[Neurons]:
    """Every layer in every step, in the order in which a graph that was run computes them.

    Raises ModelError naming the operator of the first membrane that is none of such neurons, and why.
    """
    spikes: dict[int, list[int]] = {}
    for index, atom in enumerate(table.atoms):
        if atom.kind == SPIKE and table.atoms[atom.of[0]].kind == MEMBRANE:
            spikes.setdefault(atom.of[0], []).append(index)
    neurons = []
    for membrane in sorted(spikes):
        with named(table.atoms[membrane].node):
            neurons.append(_read(table, membrane, spikes[membrane], outputs))
    return neurons


def _read(table: Table, membrane: int, spikes: list[int], outputs: Mapping[str, Affine]) -> Neurons:
    atom = table.atoms[membrane]
    spike = table.atoms[spikes[0]]
    assert atom.definition is not None
    if len(spikes) > 1:
        raise ModelError(
            "is compared in several ways, which is no spike; compare a membrane with one threshold"
        )
    if np.ptp(spike.theta) > 0:
        low = spike.theta.min()
        high = spike.theta.max()
        raise ModelError(
            f"has thresholds from {low:g} to {high:g} in one layer; give all its neurons the same one"
        )
    terms = dict(atom.definition.terms)
    previous, gate, beta = _carried(table, membrane, spikes[0], terms, outputs)
    for other, weight in terms.items():
        _require_current(table, other, weight, previous, membrane)
    return Neurons(
        membrane=membrane,
        node=atom.node,
        previous=previous,
        gate=gate,
        spike=spikes[0],
        beta=beta,
        theta=float(spike.theta[0]) if atom.size else 0.0,
        strict=spike.strict,
        current=terms,
        bias=atom.definition.bias,
    )


def _carried(
    table: Table, membrane: int, spike: int, terms: dict[int, Sparse], outputs: Mapping[str, Affine]
) -> tuple[int | None, int | None, float | None]:
    """Take what is kept of an earlier membrane out of the terms: from which, gated by what, and which share."""
    products = [atom for atom in terms if table.atoms[atom].kind == PRODUCT]
    if len(products) > 1:
        raise ModelError(f"multiplies {len(products)} pairs of values; {RESET}")
    if not products:
        return _already_reset(table, membrane, spike, terms, outputs)
    pair = table.atoms[products[0]].of
    linear = [atom for atom in pair if atom in terms and table.atoms[atom].kind in (INPUT_ATOM, MEMBRANE)]
    kept = [atom for atom in linear if diagonal(terms[atom], EQUAL) is not None] or linear
    if len(kept) != 1:
        raise ModelError(f"holds {table.atoms[products[0]]} in a way that is no reset; {RESET}")
    previous = kept[0]
    gate = pair[0] if pair[1] == previous else pair[1]
    beta = diagonal(terms.pop(previous), EQUAL)
    removed = diagonal(terms.pop(products[0]), EQUAL)
    if beta is None or removed is None:
        raise ModelError(f"mixes or weighs the neurons of {table.atoms[previous]} differently; {RESET}")
    if abs(beta + removed) > EQUAL * max(abs(beta), abs(removed)):
        raise ModelError(f"keeps {beta:g} of a membrane and {beta + removed:g} of it after a spike; {RESET}")
    # Steps of one file are compared with each other when they are grouped.
    if table.atoms[gate].kind == SPIKE and table.atoms[previous].kind == INPUT_ATOM:
        old = table.atoms[gate]
        new = table.atoms[spike]
        if not np.array_equal(old.theta, new.theta):
            raise ModelError(
                f"resets {table.atoms[previous]} by another threshold than it fires by; {RESET}"
            )
        if old.strict != new.strict:
            signs = [">" if atom.strict else ">=" for atom in (old, new)]
            raise ModelError(
                f"resets {table.atoms[previous]} at u {signs[0]} {old.theta[0]:g} and fires at u {signs[1]} "
                f"{new.theta[0]:g}; compare both alike, {RESET}"
            )
    if table.atoms[previous].kind == INPUT_ATOM:
        _require_output(outputs, {membrane: 1.0}, f"membrane of {table.atoms[previous]}")
        if table.atoms[gate].kind == INPUT_ATOM:
            _require_output(outputs, {spike: 1.0}, f"spikes of {table.atoms[gate]}")
    return previous, gate if table.atoms[gate].kind == INPUT_ATOM else None, beta


def _already_reset(
    table: Table, membrane: int, spike: int, terms: dict[int, Sparse], outputs: Mapping[str, Affine]
) -> tuple[int | None, None, float | None]:
    """A state input that holds the membrane after its reset, so that nothing is reset at its use."""
    pair = table.known.get((PRODUCT, min(membrane, spike), max(membrane, spike)))
    states = [
        a for a in terms if table.atoms[a].kind == INPUT_ATOM and diagonal(terms[a], EQUAL) is not None
    ]
    reset = {} if pair is None else {membrane: 1.0, pair: -1.0}
    ratios = [_multiple(output, reset) for output in outputs.values() if reset]
    factors = [ratio for ratio in ratios if ratio is not None]
    if not factors or not states:
        return None, None, None
    if len(states) > 1:
        shown = " and ".join(str(table.atoms[atom]) for atom in states)
        raise ModelError(f"could carry either of {shown}; {RESET}, say which with a product that resets it")
    beta = diagonal(terms.pop(states[0]), EQUAL)
    assert beta is not None
    return states[0], None, beta * factors[0]


def _multiple(value: Affine, wanted: Mapping[int, float]) -> float | None:
    """By what the value is a multiple of a sum of atoms, if it is."""
    factors = {atom: diagonal(own) for atom, own in value.terms.items()}
    if (
        set(factors) != set(wanted)
        or np.any(value.bias)
        or any(factor is None for factor in factors.values())
    ):
        return None
    ratios = [(factors[atom] or 0.0) / factor for atom, factor in wanted.items()]
    return ratios[0] if all(abs(r - ratios[0]) <= EQUAL * abs(ratios[0]) for r in ratios) else None


def is_output(outputs: Mapping[str, Affine], wanted: Mapping[int, float]) -> str | None:
    """Name of the output that is exactly this sum of atoms, or None."""
    return next((name for name, value in outputs.items() if _multiple(value, wanted) == 1), None)


def _require_output(outputs: Mapping[str, Affine], wanted: Mapping[int, float], what: str) -> None:
    if is_output(outputs, wanted) is None:
        raise ModelError(f"takes the {what} as a state, and no output gives it back; add it to the outputs")


def _require_current(table: Table, atom: int, terms: Sparse, previous: int | None, membrane: int) -> None:
    """Whether the rest is a current: from the input or from spikes; says what it is where it is not."""
    source = table.atoms[atom]
    if source.kind == MEMBRANE:
        raise ModelError(
            f"takes the membrane of {source}, not its spikes, as its input or without a reset; {RESET}"
        )
    if source.kind == PRODUCT:
        raise ModelError(f"holds {source} in a way that is no reset; {RESET}")
    factor = diagonal(terms, EQUAL)
    recurrent = source.kind == SPIKE and source.of == (previous,)
    state = source.kind == INPUT_ATOM and previous is None and source.size == table.atoms[membrane].size
    if factor is not None and factor < 0 and (recurrent or state):
        raise ModelError(f"loses {-factor:g} for a spike of {source}, a reset by subtraction; {RESET}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Unrolled:
    """Layers, each with its neurons in every step."""

    layers: list[list[Neurons]]  # by layer, then step; one step where state goes in and out of the graph
    data: int  # atom of the input that brings the events
    shape: tuple[int, ...]  # of that input in one step
    # stages into each layer by the place of the source or INPUT; columns of the input are flat positions in
    # it
    sources: list[dict[int, Sparse]]


def group(table: Table, neurons: Sequence[Neurons], shapes: Mapping[int, tuple[int, ...]]) -> Unrolled:
    """Bring steps together; `shapes` are those of each input of the graph by its atom.

    Raises ModelError if there are no neurons, steps are unlike each other, or it is not clear which input
    brings the events.
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
    after = {
        n.previous: n for n in neurons if n.previous is not None and table.atoms[n.previous].kind == MEMBRANE
    }
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
    kept = [
        (received[atom], atom)
        for atom in data
        if received[atom].previous is None
        and table.atoms[atom].size == len(received[atom].bias)
        and diagonal(received[atom].current[atom], EQUAL) is not None
    ]
    if len(data) > 1 and kept:
        n, atom = kept[-1]
        raise ModelError(
            f"{n.node}: keeps {table.atoms[atom]}, which its spikes do not reset to zero (but by subtraction, to "
            f"another value or where it is small); {RESET}"
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
    table: Table,
    n: Neurons,
    step: int,
    step_of: Mapping[int, tuple[int, int]],
    inputs: Mapping[int, IntArray],
) -> dict[int, Sparse]:
    """Weights from each source; of an input from its positions in this step."""
    sources = {}
    for atom, weight in n.current.items():
        if atom in inputs:
            sources[INPUT] = weight[:, inputs[atom]]
        elif atom in step_of and step_of[atom][1] == step:
            sources[step_of[atom][0]] = weight
        else:
            raise ModelError(
                f"{n.node}: takes {table.atoms[atom]}, which is no spike of a layer in this step; {RESET}"
            )
    for weight in sources.values():
        weight.sort_indices()
    return sources


def _require_like(layer: list[Neurons], step: int, every: list[dict[int, Sparse]]) -> None:
    """Whether a step is the first one again; a threshold and a bias that both moved are the same neuron."""
    first = layer[0]
    this = layer[step]
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
        first.shape == second.shape and not (abs(first - second) > EQUAL * abs(first)).nnz
    )


def readout(table: Table, found: Unrolled, outputs: Mapping[str, Affine]) -> tuple[int, IntArray, str]:
    """Layer that votes, the class of each of its neurons, and the output that counts them.

    Raises ModelError if no output is a count of the spikes of the last layer, or several count them
    differently.
    """
    received = {source for sources in found.sources for source in sources}
    ends = [index for index in range(len(found.layers)) if index not in received]
    states = {found.data} | {atom for layer in found.layers for n in layer for atom in (n.previous, n.gate)}
    votes: list[tuple[int, IntArray, str]] = []
    for index in ends:
        spikes = [n.spike for n in found.layers[index]]
        for name, value in outputs.items():
            others = [atom for atom in value.terms if atom not in spikes]
            # A running count goes in and out as a state: of classes, or of the neurons that they group.
            like_spikes = [value.terms[spike] for spike in spikes if spike in value.terms]
            counters = [
                table.atoms[atom].kind == INPUT_ATOM
                and atom not in states
                and (
                    diagonal(value.terms[atom]) == 1
                    or any(_equal(value.terms[atom], own) for own in like_spikes)
                )
                for atom in others
            ]
            if (
                not all(counters[:1])
                or counters[1:]
                or any(spike not in value.terms for spike in spikes)
                or np.ptp(value.bias) > 0
            ):
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
