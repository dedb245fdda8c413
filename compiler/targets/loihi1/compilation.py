"""What the passes fill in, from the float network at the top to the netlist at the bottom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
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
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import inconsistencies
from spikeloom.compiler.targets.loihi1.netlist_text import layout_text, netlist_text
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.storage.quantize import Choice
from spikeloom.compiler.targets.loihi1.storage.spike_exact import Exactness
from spikeloom.compiler.text import text

LATER: Any = None
"""Of a field that a pass fills in."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compilation:
    """Everything that one compilation was given and has made so far; each field is filled in by one pass.

    Parameters
    ----------
    source : Factored, Network or IntegerNetwork
        What is compiled.
    options : Options
        What was asked for.
    target : Target
        Chip.
    network : Network
        Float network, a synapse for each pair of neurons (`expand`).
    calibration : Calibration or None
        What it did on training recordings, where there are any (`calibrate`).
    rates : tuple of (neurons,) float64, or None
        Spikes per step by population, likewise; the placement weighs traffic by them.
    connected : Network
        The same network without the weights of neurons that do nothing (`disconnect`).
    unused : tuple of (neurons,) bool
        Neurons that never fired in training and are to go for it.
    integer : IntegerNetwork
        In the integers of the chip (`quantize`).
    choices : tuple of Choice
        Scale of each layer and why.
    exactness : tuple of Exactness
        What is in the way of equal spikes, where these were asked for; else empty.
    proofs : tuple of RangeProof
        Worst-case register values of each layer (`prove`).
    held : IntegerNetwork
        What the chip holds of it (`remove`).
    identity : tuple of (neurons left,) int64
        Which neurons these are, by population.
    silent, unreceived : tuple of (neurons,) bool
        Neurons that it does not hold: they cannot fire, or their spikes reach no neuron.
    removals : tuple of Removal
        The same in numbers, and why.
    layout, usual : Layout
        Cores and tiles, and those of the layout of fewest cores; often they are one (`place`).
    netlist : Netlist
        The result (`emit`).
    uses : tuple of LimitUse
        Use of every limit by every core (`legalize`).
    """

    source: Factored | Network | IntegerNetwork
    options: Options
    target: Target
    network: Network = LATER
    calibration: Calibration | None = None
    rates: tuple[FloatArray, ...] | None = None
    connected: Network = LATER
    unused: Masks = ()
    integer: IntegerNetwork = LATER
    choices: tuple[Choice, ...] = ()
    exactness: tuple[Exactness, ...] = ()
    proofs: tuple[RangeProof, ...] = ()
    held: IntegerNetwork = LATER
    identity: tuple[IntArray, ...] = ()
    silent: Masks = ()
    unreceived: Masks = ()
    removals: tuple[Removal, ...] = ()
    layout: Layout = LATER
    usual: Layout = LATER
    netlist: Netlist = LATER
    uses: tuple[LimitUse, ...] = ()

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
        """Check every rule of the newest artefact.

        Raises
        ------
        VerifyError
            If a pass broke one.
        """
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
        return text(newest) + ("" if self.layout is LATER else layout_text(self.layout, self.held))
