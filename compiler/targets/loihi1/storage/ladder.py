"""The order in which storages are tried, and the choice of one: each is compiled to the end and measured."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.legalize import LimitUse
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.storage.held_out import HeldOut


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A storage that was tried: what it keeps, and what it costs."""

    planes: int  # Times that a synapse may be stored
    groups: int  # Scales in a layer, at most
    equal: int = 0  # Decisions of quarters of held-out recordings that are the float model's
    decisions: int = 0  # All of them
    operations: float = (
        0.0  # Synaptic operations of a training recording, where spikes are the float model's
    )
    synapse_words: int = 0  # Memory of all cores
    cores: int = 0
    refused: str | None = field(default=None, metadata={"optional": True})  # Why the chip does not hold it


class Attempt(Protocol):
    """A network that was compiled to the end."""

    @property
    def integer(self) -> IntegerNetwork:
        """The network in chip integers."""

    @property
    def netlist(self) -> Netlist:
        """The same on cores."""

    @property
    def uses(self) -> Sequence[LimitUse]:
        """Use of every limit by every core."""


A = TypeVar("A", bound=Attempt)


def cheapest_first(target: Target) -> Iterator[Packing]:
    """What is tried for decisions: more scales cost cores, more planes operations and memory."""
    slots = target.limit("core.threshold_slots")
    return (Packing(planes=planes, groups=groups) for planes in (1, 2) for groups in (1, slots))


def coarsest_first(target: Target, bits: int) -> Iterator[Packing]:
    """What is tried for equal spikes of a layer."""
    slots = target.limit("core.threshold_slots")
    steps = (1, 1), (2, 1), (2, slots), (3, slots)
    return (Packing(bits=bits, planes=planes, groups=groups) for planes, groups in steps)


def choose_cheapest(
    target: Target,
    keep: float,
    judge: HeldOut,
    compiled: Callable[[Packing], A],
    operations: Callable[[IntegerNetwork], float],
) -> tuple[A, tuple[Trial, ...]]:
    """The cheapest storage that keeps this share of decisions, or the one that keeps most; and all that were tried.

    CapacityError or ModelError if the chip does not hold even the first.
    """
    best: A | None = None
    most = -1
    trials = list[Trial]()
    for packing in cheapest_first(target):
        trial = Trial(planes=packing.planes, groups=packing.groups)
        try:
            attempt = compiled(packing)
        except (CapacityError, ModelError) as error:
            if best is None:
                raise  # nor does what is larger fit
            trials.append(replace(trial, refused=str(error)))
            continue
        equal = judge.equal(attempt.integer)
        trials.append(
            replace(
                trial,
                equal=equal,
                decisions=len(judge),
                operations=operations(attempt.integer),
                synapse_words=sum(use.used for use in attempt.uses if use.name == "core.synapse_words"),
                cores=attempt.netlist.n_cores,
            )
        )
        if best is None or equal > most:
            best = attempt
            most = equal
        if most >= keep * len(judge):
            break
    assert best is not None, "the ladder has rungs"
    return best, tuple(trials)
