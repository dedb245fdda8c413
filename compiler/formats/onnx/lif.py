"""Find the neurons in what a graph computes: ``u <- beta * u * (1 - s) + current``, ``s = u > theta``.

A membrane is affine in what varies. The part that comes from an earlier membrane must be what is left of that after a
reset to zero; the rest must come from the input and from spikes of the same step. How the file writes that, by a
product, a Where, with the reset before or after the decay, makes no difference here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.onnx.affine import INPUT_ATOM, MEMBRANE, PRODUCT, SPIKE, Affine, Table, diagonal
from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import FloatArray

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
    found = []
    for membrane in sorted(spikes):
        try:
            found.append(_read(table, membrane, spikes[membrane], outputs))
        except ModelError as error:
            raise ModelError(f"{table.atoms[membrane].node}: {error}") from error
    return found


def _read(table: Table, membrane: int, spikes: list[int], outputs: Mapping[str, Affine]) -> Neurons:
    atom, spike = table.atoms[membrane], table.atoms[spikes[0]]
    assert atom.definition is not None
    if len(spikes) > 1:
        raise ModelError("is compared in several ways, which is no spike; compare a membrane with one threshold")
    if np.ptp(spike.theta) > 0:
        low, high = spike.theta.min(), spike.theta.max()
        raise ModelError(f"has thresholds from {low:g} to {high:g} in one layer; give all its neurons the same one")
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
    beta, removed = diagonal(terms.pop(previous), EQUAL), diagonal(terms.pop(products[0]), EQUAL)
    if beta is None or removed is None:
        raise ModelError(f"mixes or weighs the neurons of {table.atoms[previous]} differently; {RESET}")
    if abs(beta + removed) > EQUAL * max(abs(beta), abs(removed)):
        raise ModelError(f"keeps {beta:g} of a membrane and {beta + removed:g} of it after a spike; {RESET}")
    if table.atoms[gate].kind == SPIKE:
        _require_same_threshold(table, previous, gate, spike)
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
        atom for atom in terms if table.atoms[atom].kind == INPUT_ATOM and diagonal(terms[atom], EQUAL) is not None
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
    found = {atom: diagonal(own) for atom, own in value.terms.items()}
    if set(found) != set(wanted) or np.any(value.bias) or any(factor is None for factor in found.values()):
        return None
    ratios = [(found[atom] or 0.0) / factor for atom, factor in wanted.items()]
    return ratios[0] if all(abs(r - ratios[0]) <= EQUAL * abs(ratios[0]) for r in ratios) else None


def is_output(outputs: Mapping[str, Affine], wanted: Mapping[int, float]) -> str | None:
    """Name of the output that is exactly this sum of atoms, or None."""
    return next((name for name, value in outputs.items() if _multiple(value, wanted) == 1), None)


def _require_output(outputs: Mapping[str, Affine], wanted: Mapping[int, float], what: str) -> None:
    if is_output(outputs, wanted) is None:
        raise ModelError(f"takes the {what} as a state, and no output gives it back; add it to the outputs")


def _require_same_threshold(table: Table, previous: int, gate: int, spike: int) -> None:
    """A reset by a comparison of the state itself must use the comparison that makes the spikes."""
    old, new = (table.atoms[atom] for atom in (gate, spike))
    if not np.array_equal(old.theta, new.theta) or old.strict != new.strict:
        raise ModelError(f"resets {table.atoms[previous]} by another threshold than it fires by; {RESET}")


def _require_current(table: Table, atom: int, terms: Sparse, previous: int | None, membrane: int) -> None:
    """Whether the rest is a current: from the input or from spikes; says what it is where it is not."""
    found = table.atoms[atom]
    if found.kind == MEMBRANE:
        raise ModelError(f"takes the membrane of {found}, not its spikes, as its input or without a reset; {RESET}")
    if found.kind == PRODUCT:
        raise ModelError(f"holds {found} in a way that is no reset; {RESET}")
    factor = diagonal(terms, EQUAL)
    own = found.kind == SPIKE and found.of == (previous,)
    state = found.kind == INPUT_ATOM and previous is None and found.size == table.atoms[membrane].size
    if factor is not None and factor < 0 and (own or state):
        raise ModelError(f"loses {-factor:g} for a spike of {found}, a reset by subtraction; {RESET}")
