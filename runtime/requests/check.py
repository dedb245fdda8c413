"""Requests about where a network breaks and why: explain, stress, certify."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from spikeloom.runtime.requests.choices import (
    NETWORK_FILES,
    ClusterChoice,
    ComparisonChoice,
    NetlistChoice,
    NetworkChoice,
    RecordingsChoice,
    ShownConditionChoice,
)
from spikeloom.runtime.requests.fields import option

if TYPE_CHECKING:
    from spikeloom.compiler.ir import Network


@dataclass(frozen=True, kw_only=True)
class ExplainRequest(ComparisonChoice, RecordingsChoice):
    """Why chip and float model differ on one recording: roots, their causes, and what removes them."""

    sample: str | None = option(
        "recording to explain, by name or by number from 0 (default: the first that differs)",
        metavar="NAME|N",
        flags=("--sample", "--recording"),
    )
    top: int = option("roots to show", default=10, metavar="N")


@dataclass(frozen=True, kw_only=True)
class StressRequest(ClusterChoice, ComparisonChoice, ShownConditionChoice, RecordingsChoice):
    """Where float network and chip break: a seeded battery of perturbations, with verdicts and reasons."""

    only: str | None = option("perturbations to measure (default: all)", metavar="NAME[,…]")
    seeds: int = option("random draws of each perturbation", default=5, metavar="N")
    require: tuple[str, ...] = option(
        "accuracy that the chip must keep, as in taxels_dead:3>=0.85; else exit code 1; may be repeated",
        default=(),
        metavar="NAME:LEVEL>=SHARE",
    )
    jobs: int | None = option("measurements at a time (default: one a core)", metavar="N")
    picture: str | None = option("draw the curves", metavar="OUT.png|svg|pdf")
    output: str | None = option(
        "write what --json prints; report --stress shows it", metavar="OUT.json", flags=("-o", "--output")
    )


@dataclass(frozen=True, kw_only=True)
class CertifyRequest(ClusterChoice, NetlistChoice, NetworkChoice, RecordingsChoice):
    """Which decisions no small change of a recording alters: proven, not sampled."""

    checkpoint: str | Network | None = option(
        "float model of the netlist: how many changed events are proven to alter no decision of either",
        metavar=NETWORK_FILES,
        group="network",
    )
    shift: int = option("largest shift to try", default=25, metavar="BINS")
    most: int = option("largest number of changed events that a proof is tried for", default=16, metavar="N")
    jobs: int | None = option("recordings at a time (default: one a core)", metavar="N")
    certificate: str | None = option("write what examples/check_certificate.py checks", metavar="OUT")
    picture: str | None = option("draw how many decisions depend on each taxel", metavar="OUT.png|svg|pdf")
    output: str | None = option("write what --json prints", metavar="OUT.json", flags=("-o", "--output"))
