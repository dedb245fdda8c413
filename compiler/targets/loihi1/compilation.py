"""What the passes fill in, from the float network at the top to the netlist at the bottom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import IntegerNetwork, Network
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.passes.expand import Factored
from spikeloom.compiler.passes.prune import Masks, Removal
from spikeloom.compiler.range_proof import RangeProof
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.choose import Layout
from spikeloom.compiler.targets.loihi1.layout.place import Placement
from spikeloom.compiler.targets.loihi1.legalize import LimitUse
from spikeloom.compiler.targets.loihi1.netlist import Netlist, netlist_text
from spikeloom.compiler.targets.loihi1.netlist_file import inconsistencies
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.storage.choose_storage import Choice
from spikeloom.compiler.targets.loihi1.storage.spike_exact import Exactness
from spikeloom.compiler.text import text
from spikeloom.compiler.types import FloatArray, IntArray

LATER: Any = None
"""Of a field that a pass fills in."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compilation:
    """Everything that one compilation was given and has made so far; the pass in brackets fills a field in."""

    source: Factored | Network | IntegerNetwork  # What is compiled
    options: Options  # What was asked for
    target: Target  # Chip
    network: Network = LATER  # Float network, a synapse for each pair of neurons (`expand`)
    calibration: Calibration | None = None  # What it did on training recordings, where there are any (`calibrate`)
    # Spikes per step by population, likewise; the placement weighs traffic by them
    rates: tuple[FloatArray, ...] | None = None
    connected: Network = LATER  # The same network without the weights of neurons that do nothing (`disconnect`)
    quiet: Masks = ()  # Neurons that never fired in training and are to go for it, although some input makes them fire
    integer: IntegerNetwork = LATER  # In the integers of the chip (`quantize`)
    choices: tuple[Choice, ...] = ()  # Scale of each layer and why
    exactness: tuple[Exactness, ...] = ()  # What is in the way of equal spikes, where these were asked for; else empty
    proofs: tuple[RangeProof, ...] = ()  # Worst-case register values of each layer (`prove`)
    held: IntegerNetwork = LATER  # What the chip holds of it (`remove`)
    identity: tuple[IntArray, ...] = ()  # Which neurons these are, by population
    # silent, unread: Neurons that it does not hold: they cannot fire, or their spikes reach no neuron
    silent: Masks = ()
    unread: Masks = ()
    removals: tuple[Removal, ...] = ()  # The same in numbers, and why
    # layout, usual: Cores and tiles, and those of the layout of fewest cores; often they are one (`place`)
    layout: Layout = LATER
    usual: Layout = LATER
    netlist: Netlist = LATER  # The result (`emit`)
    uses: tuple[LimitUse, ...] = ()  # Use of every limit by every core (`legalize`)

    @property
    def placement(self) -> Placement:
        """Tiles and what they cost."""
        return self.layout.placement

    @property
    def core_bound(self) -> int:
        """No legal partition uses fewer cores."""
        return self.layout.parts.bound

    @property
    def newest(self) -> Network | IntegerNetwork | Netlist:
        """The network as the last pass left it."""
        stages = (self.netlist, self.held, self.integer, self.connected, self.network)
        return next(stage for stage in stages if stage is not LATER)

    def verify(self) -> None:
        """Check every rule of the newest artefact; VerifyError if a pass broke one."""
        newest = self.newest
        if not isinstance(newest, Netlist):
            verify(newest)
        elif faults := inconsistencies(newest):
            raise VerifyError("; ".join(faults))

    def text(self) -> str:
        """The newest artefact in print."""
        newest = self.newest
        if isinstance(newest, Netlist):
            return netlist_text(newest)
        lines = [text(newest)]
        for core, chunks in enumerate(() if self.layout is LATER else self.layout.parts.cores):
            named = ((self.held.populations[chunk.population].name, chunk) for chunk in chunks)
            names = ", ".join(f"{name} {chunk.first}…{chunk.last - 1}" for name, chunk in named)
            lines.append(f"(core {core} (tile {self.placement.tiles[core]}) (neurons {names}))\n")
        return "".join(lines)
