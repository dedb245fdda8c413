"""A chip: how it lowers networks, reads and runs netlists; all are listed in :mod:`machines.backends`."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.runtime.machines.base import Machine, Model
from spikeloom.runtime.machines.exports import Format
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.choices import ComparisonChoice
from spikeloom.runtime.requests.main_job import CompileRequest, InspectRequest

if TYPE_CHECKING:
    from spikeloom.runtime.inputs.network import LoadedNetwork


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lowered:
    """A network as a chip holds it.

    netlist: the placed network.
    model: its whole numbers, run without the chip.
    write: write the netlist to a file and give its sha256.
    report: what was chosen, proved and removed, of the netlist in a file with that sha256.
    """

    netlist: Any
    model: Model
    write: Callable[[str], str]
    report: Callable[[str], Outcome]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """What a netlist is held against.

    network: what `compile` was given.
    loaded: the float network beside the chip, and where it is from; None where there is none.
    whole: whether the network is whole numbers, so that the chip must have their every spike.
    difference: how the file is not what the netlist was compiled from.
    """

    network: Any
    loaded: LoadedNetwork | None
    whole: bool = False
    difference: str | None = None

    @property
    def floats(self) -> Network | None:
        """The float model that decides and spikes beside the chip."""
        return None if self.loaded is None else self.loaded.network


class Backend(ABC):
    """What a chip offers; its methods import what is heavy, so that naming a chip loads no simulator."""

    name: ClassVar[str]
    """Value of ``--target``."""

    @property
    def counting_bits(self) -> int:
        """Widest weights of a counting network; OptionError where the chip takes none."""
        raise OptionError(f"--target {self.name}: takes no counting networks; give another chip")

    @property
    def target(self) -> Target:
        """Its numbers."""
        return load_target(self.name)

    @property
    def formats(self) -> tuple[Format, ...]:
        """Formats of other programs that its netlists can be written in."""
        return ()

    @property
    @abstractmethod
    def passes(self) -> tuple[str, ...]:
        """Names of the passes that lower a network, in order."""

    @abstractmethod
    def lower(self, request: CompileRequest, after: Callable[[str, Any], object]) -> Lowered:
        """Read the network that `compile` was given and lower it; `after` as of :func:`pipeline.run`."""

    def lower_counters(self, counters: Counters) -> Netlist:
        """Lower a counting network."""
        raise NotImplementedError(f"{self.name} takes no counting networks")

    @abstractmethod
    def machine(self, netlist: Any) -> Machine:
        """The machine of a netlist in memory."""

    @abstractmethod
    def load(self, path: str | os.PathLike[str]) -> Machine:
        """Read a netlist file; SpikeloomError if it is none."""

    @abstractmethod
    def describe(self, path: str | os.PathLike[str]) -> Outcome:
        """Layers and cores of a netlist file, and how full each limit is; loads no simulator."""

    def is_trained_for(self, path: str) -> bool:  # noqa: ARG002 -- no network is, unless the chip says so
        """Whether a file holds a network that was trained for the chip alone."""
        return False

    def inspect(self, request: InspectRequest) -> Outcome:
        """Describe such a network."""
        raise NotImplementedError(f"no network is trained for {self.name} alone")

    def reference(self, request: ComparisonChoice, netlist: Any) -> Reference:
        """Read the network that `verify` was given beside a netlist; by default a network of floats."""
        from spikeloom.runtime.inputs.network import load_network

        loaded = load_network(request.checkpoint, request, netlist)
        return Reference(
            network=loaded.network,
            loaded=loaded,
            difference=loaded.differs_from(netlist, request.run),
        )
