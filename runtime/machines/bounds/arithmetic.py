"""What :mod:`bounds.boxes` and :mod:`bounds.groups` ask of an arithmetic: a chip's integers, or floats.

Each is asked from machine code, and answered by the implementation for the kind of its first argument. That holds what
:class:`Layout` names; the known run beside it what :class:`KnownRun` does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

from numba.extending import overload

from spikeloom.compiler.layer_kernel import Synapses
from spikeloom.compiler.types import AnyArray, IntArray

LANES = 64
"""Places of a block; each layer begins one."""

FAR = 1 << 30
"""Beyond every membrane, and every number of votes."""


class Layout(Protocol):
    """A network: places of neurons by layer, in blocks; none is at some."""

    @property
    def synapses(self) -> Synapses:
        """Of the input channels, then of each place."""

    @property
    def layer(self) -> IntArray:
        """Of each block, (blocks,) int64."""

    @property
    def depth(self) -> IntArray:
        """Steps that it lags behind, (blocks,) int64."""

    @property
    def outer(self) -> AnyArray:
        """Blocks whose spikes come from channels alone, (blocks,) bool."""

    @property
    def ordered(self) -> bool:
        """Whether every spike reaches a later layer."""

    @property
    def bias(self) -> AnyArray:
        """Added in every step, (places,), in the numbers of the arithmetic."""

    @property
    def label(self) -> AnyArray:
        """Class that a spike votes for, -1 for none, (places,) int32."""


class KnownRun(Protocol):
    """A run, of `steps` chip steps."""

    @property
    def events(self) -> AnyArray:
        """Of the recording, (channels, T) uint8, 0 or 1."""

    @property
    def current(self) -> AnyArray:
        """Registers before each step, and after the last, (steps + 1, places); zero where differences are held."""

    @property
    def membrane(self) -> AnyArray:
        """Likewise."""

    @property
    def fired(self) -> AnyArray:
        """Spikes, (steps, places) uint8."""


class Safe(NamedTuple):
    """Membranes before each step, (steps + 1, places), from which every later spike is the known one."""

    low: AnyArray
    high: AnyArray


F = TypeVar("F", bound=Callable[..., Any])


def implements(question: Callable[..., Any], kind: type) -> Callable[[F], F]:
    """Have a function answer where the first argument of a question is of a kind, a NamedTuple."""

    def register(answer: F) -> F:
        def choose(chip: Any, *_: Any) -> F | None:
            return answer if chip.instance_class is kind else None

        overload(question, strict=False, jit_options={"nogil": True})(choose)
        return answer

    return register


def surely(chip: Any, work: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    """Add weights of a source that spikes otherwise for sure to the least and largest sums, from place `first` on."""
    raise NotImplementedError


def step_block(chip: Any, known: Any, work: Any, t: Any, block: Any, n: Any) -> Any:
    """One step of a block; lists what spikes otherwise, or may, after `n` others."""
    raise NotImplementedError


def unknown(chip: Any, known: Any, start: Any, work: Any) -> Any:
    """Bounds of registers before a step, whatever was before; lists those that may have fired otherwise than known."""
    raise NotImplementedError


def unsafe(chip: Any, known: Any, bounds: Any, box: Any, t: Any, block: Any) -> Any:
    """Whether a block may spike otherwise than the known run from step `t` on.

    `box` are the least and largest current and membrane of each place before that step.
    """
    raise NotImplementedError
