"""All that the page of a network shows, as its JSON has it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.machines.page_parts import BatchParts, Cores, Sizes
from spikeloom.runtime.page.facts import Decisions, Taxels
from spikeloom.runtime.page.provenance import Provenance
from spikeloom.runtime.page.recording import Recording
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.chart.results import Chart
from spikeloom.runtime.studies.stress.results import Stress


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Report:
    """All that the page shows."""

    verify: Verdict
    decisions: Decisions
    netlist: Sizes
    cores: Cores
    taxels: Taxels
    recording: Recording
    costs: object
    provenance: Provenance
    stress: Stress | None = field(default=None, metadata=OPTIONAL)
    chart: Chart | None = field(default=None, metadata=OPTIONAL)
    explained_cost: Any = field(default=None, metadata=OPTIONAL)
    output: str
    described: Outcome = field(metadata=HIDDEN)
    chip: BatchParts = field(metadata=HIDDEN)
