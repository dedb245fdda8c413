"""``compile --target truenorth`` of a network that does not fit: every reason, and the two ways that there are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.codebook import COPIES
from spikeloom.compiler.targets.truenorth.native import SYSTEM
from spikeloom.compiler.targets.truenorth.needs import Need, needs
from spikeloom.runtime.report.sections import Code, Outcome, Section, Table, Text


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """Why a network does not fit."""

    network: str
    target: str
    title: str
    violations: tuple[Need, ...]


def refuse(path: str, network: Network, chip: Target) -> Outcome:
    """Say why a network does not fit; exit code 2.

    Raises
    ------
    ModelError
        If no reason is known before lowering.
    """
    found = needs(network, chip)
    if not found:
        raise ModelError(
            f"{path}: a float network; give --in-time N, with N in {COPIES}, or train one for the chip: "
            f"spikeloom train --system {SYSTEM}"
        )
    refusal = Refusal(network=Path(path).name, target=chip.name, title=chip.title, violations=found)
    return Outcome(refusal, sections, 2)


def sections(found: Refusal) -> list[Section]:
    """The same for people."""
    number = len(found.violations)
    head = f"{found.network} does not fit {found.title}: {number} violations, nothing was written"
    rows = [[need.where, need.found, need.allowed, need.rule, need.remedy] for need in found.violations]
    table = Table(["violation", "found", "allowed", "limit", "what would mend it"], rows, words=True)
    ways = [
        "two ways lead there:",
        f"  --in-time N lowers a network that forgets within a step (--beta 0), N of {COPIES} axons an input; its "
        "weights are rounded",
        "  training for the chip, of which shipped networks are examples:",
    ]
    train = Code([f"spikeloom train --system {SYSTEM} --data DATA -o NET.pt"])
    return [Section("Violations", [Text(head), table]), Section("Ways", [Text("\n".join(ways)), train])]
