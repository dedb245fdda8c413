"""The passes of this chip in their order: whole numbers at the top, a netlist that obeys every rule at the end.

Networks that were trained for the chip and counting networks are whole numbers already. A float network is
refused, with every reason that no layout could avoid.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.invariants import require_none
from spikeloom.compiler.ir import Network
from spikeloom.compiler.pipeline import LATER, run, step
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.truenorth.counting import lower_counters
from spikeloom.compiler.targets.truenorth.legalize import needs, require_legal
from spikeloom.compiler.targets.truenorth.native import SYSTEM, NativeNetwork, faults, lower
from spikeloom.compiler.targets.truenorth.netlist import FILE, CrossbarNetlist

WAYS = (
    f"two ways lead to the chip: training for it, spikeloom train --system {SYSTEM}; or counting, --system counters "
    "--weight-bits 5"
)

Source = NativeNetwork | Counters
"""What can be compiled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """JSON values to store with the netlist."""

    provenance: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compilation:
    """What one compilation was given and has made so far."""

    source: Source
    options: Options
    target: Target
    netlist: CrossbarNetlist = LATER  # By `place`

    @property
    def newest(self) -> Source | CrossbarNetlist:
        """What the last pass made that changed anything."""
        return self.source if self.netlist is LATER else self.netlist

    def verify(self) -> None:
        """Check every rule of the newest artefact; VerifyError if one is broken."""
        if self.netlist is not LATER:
            FILE.verify(self.netlist)
        elif isinstance(self.source, NativeNetwork):
            require_none(faults(self.source))


@step(
    "puts neurons on cores, inputs on axons of the types that make their levels, and copies or relays where "
    "a spike has several targets",
    keeps="every spike",
)
def _place(done: Compilation) -> Compilation:
    provenance = done.options.provenance
    if isinstance(done.source, NativeNetwork):
        return replace(done, netlist=lower(done.source, done.target, provenance=provenance))
    return replace(done, netlist=lower_counters(done.source, done.target, provenance=provenance))


@step("holds the netlist against every rule and refuses one that breaks any", keeps="the netlist")
def _legalize(done: Compilation) -> Compilation:
    require_legal(done.netlist, done.target)
    return done


PASSES = (_place, _legalize)


def compile_crossbars(
    source: Source | Network,
    options: Options | None = None,
    *,
    target: Target | None = None,
    after: Callable[[str, Compilation], object] | None = None,
) -> Compilation:
    """Lower a network by all passes; `after` as of :func:`pipeline.run`."""
    chip = load_target("truenorth") if target is None else target
    if not isinstance(source, NativeNetwork | Counters):
        raise _unfit(source, chip)
    work = Compilation(source=source, options=Options() if options is None else options, target=chip)
    work.verify()
    return run(PASSES, work, after)


def _unfit(network: Network, chip: Target) -> CapacityError | ModelError:
    """Why a float network is not for the chip."""
    reasons = CapacityError(needs(network, chip))
    if not reasons.violations:
        return ModelError(f"a float network; {WAYS}")
    reasons.add_note(WAYS)
    return reasons
