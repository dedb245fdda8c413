"""What the netlists of all chips have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.types import IntArray


class Netlist(Protocol):
    """A placed network, whatever its chip."""

    @property
    def target(self) -> str:
        """Name of the chip."""

    @property
    def taxels(self) -> int:
        """Of the sensor."""

    @property
    def polarities(self) -> int:
        """Input channels of a taxel."""

    @property
    def bins(self) -> int:
        """Bins of the recordings that make a data step."""

    @property
    def classes(self) -> int:
        """What it tells apart."""

    @property
    def readout_class(self) -> IntArray:
        """Class that each neuron of the chip votes for, -1 for none."""

    @property
    def clocks(self) -> Clocks:
        """Channels after those of the sensor."""

    @property
    def provenance(self) -> Mapping[str, Any]:
        """What it was compiled from."""
