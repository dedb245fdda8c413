"""Level EN: whether a netlist is what its network is lowered to. Nothing is simulated."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from spikeloom.runtime.report.encode import HIDDEN
from spikeloom.runtime.report.sections import Section, Text
from spikeloom.runtime.report.shown import Shown


class LayerCheck(Protocol):
    """What is known of one layer."""

    @property
    def faults(self) -> tuple[str, ...]:
        """What is not as lowering the network gives it."""

    @property
    def compensated(self) -> bool:
        """Whether it was rounded so that errors cancel, and its numbers need not be the nearest."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NetlistCheck(Shown):
    """What of a netlist is not as lowering its network gives it.

    layers: facts of each layer, where the chip rounds layer by layer.
    whole: faults of the netlist as a whole: limits of the chip that it breaks, or why it is no network.
    claim: what is true where there is no fault, in a sentence.
    simulates: whether it can be run at all.
    """

    layers: Mapping[str, LayerCheck] = field(default_factory=dict)
    whole: tuple[str, ...] = ()
    claim: str = field(default="every number is what the network is lowered to", metadata=HIDDEN)
    simulates: bool = field(default=True, metadata=HIDDEN)

    json_properties = ("holds",)

    @property
    def faults(self) -> tuple[str, ...]:
        """What is not as lowering the network gives it."""
        return (*self.whole, *(fault for layer in self.layers.values() for fault in layer.faults))

    @property
    def holds(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults

    @property
    def text(self) -> str:
        """One line for people."""
        return (
            f"NOT what this network is lowered to: {'; '.join(self.faults)}" if self.faults else self.claim
        )


def sections(check: NetlistCheck) -> list[Section]:
    """The same for people."""
    return [Section("Netlist", [Text(f"EN  {check.text}")])]
