"""Statistics of the paper's tables: means over seeds, beside the published ones, and chip figures.

Accuracies are in percent; intervals are Student's, of the mean, at 95 %.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cells import PUBLISHED, RUNS, Cell, Row
from scipy.stats import f_oneway, kendalltau, spearmanr
from scipy.stats import t as student

from spikeloom.compiler.systems import GCN, GRAPH_SYSTEMS, GRID_CNN, MLP, TACTILESGNET
from spikeloom.runtime.report.numbers import of_mean

PROTOCOLS = {
    "best": "best epoch on test",
    "last": "last epoch",
    "clean": "clean epoch, chosen on validation",
}
READINGS = {**PROTOCOLS, "chip": "on the chip, last epoch"}
MARGIN = 2.0
"""Combined standard errors beyond which the paper's mean and ours are said to differ; within, neither is shown."""

EQUAL = 2.0
"""Points that two means may differ by and be called equal; both one-sided tests, at 5 % each, must say so."""

NAMES = {TACTILESGNET: "TactileSGNet", GRID_CNN: "grid-based CNN", MLP: "MLP", GCN: "GCN"}


@dataclass(frozen=True, slots=True)
class Spread:
    """Accuracies of some seeds; no deviation of one, no interval where all are equal."""

    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Of the seeds."""
        return statistics.fmean(self.values)

    @property
    def std(self) -> float | None:
        """Standard deviation."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Of the mean; it ends where accuracies do, at 0 and 100."""
        if len(set(self.values)) < 2:
            return None
        low, high = of_mean(self.values)
        return max(low, 0.0), min(high, 100.0)

    def words(self) -> str:
        """Mean, standard deviation and interval: ``89.12 (0.50), 87.9 … 90.4``."""
        text = f"{self.mean:.2f}" + (" (one seed)" if self.std is None else f" ({self.std:.2f})")
        return text if self.interval is None else f"{text}, {self.interval[0]:.1f} … {self.interval[1]:.1f}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Our mean less the paper's, the combined standard error, and its degrees of freedom."""

    difference: float
    error: float
    freedom: float

    @property
    def within(self) -> bool:
        """Whether no difference is shown."""
        return abs(self.difference) <= MARGIN * self.error

    @property
    def equal(self) -> bool:
        """Whether the means are shown to be within ``EQUAL`` points."""
        return abs(self.difference) + float(student.ppf(0.95, self.freedom)) * self.error < EQUAL


@dataclass(frozen=True, slots=True)
class Line:
    """A row of a table with its cells, by seed; `table` says what the row is called."""

    table: str
    row: Row
    cells: tuple[Cell, ...]

    @property
    def name(self) -> str:
        """What tables call it."""
        form, system = self.row.form, self.row.system
        if self.table == "graphs":
            return form
        return NAMES[system] + (f", {form} graph" if system in GRAPH_SYSTEMS else "")

    @property
    def paper(self) -> tuple[float, float] | None:
        """Published mean and standard deviation."""
        return PUBLISHED.get((self.row.data, self.row.system, self.row.form))

    @property
    def samples(self) -> int:
        """Test recordings."""
        return self.cells[0]["test_samples"]

    @property
    def chips(self) -> list[Mapping[str, Any]]:
        """Figures of the last epoch of the networks that the chip takes."""
        return [cell["chip"]["last"] for cell in self.cells if "refused" not in cell["chip"]]

    def accuracy(self, reading: str) -> Spread:
        """By one of ``READINGS``, or ``chip_clean``."""
        if reading in PROTOCOLS:
            return Spread(tuple(100 * cell[reading]["accuracy"] for cell in self.cells))
        which = "clean" if reading == "chip_clean" else "last"
        chips = [cell["chip"][which] for cell in self.cells if "refused" not in cell["chip"]]
        return Spread(tuple(100 * chip["correct"] / self.samples for chip in chips))

    def equal(self, which: str) -> float:
        """Percent of decisions that are those of the float model."""
        return statistics.fmean(100 * cell["chip"][which]["equal"] / self.samples for cell in self.cells)

    def mean(self, *keys: str) -> float:
        """Mean over seeds of a figure of the chip: ``mean("without_quiet", "energy_j", "sanafe")``."""
        values = []
        for chip in self.chips:
            found: Any = chip
            for key in keys:
                found = found[key]
            values.append(found)
        return statistics.fmean(values)

    def cores(self, *keys: str) -> tuple[int, int]:
        """Fewest and most."""
        counts = [(chip[keys[0]] if keys else chip)["cores"] for chip in self.chips]
        return min(counts), max(counts)

    @property
    def changed(self) -> int:
        """Decisions that change without the quiet neurons, over all seeds."""
        return sum(self.samples - chip["without_quiet"]["equal_to_chip"] for chip in self.chips)

    def comparison(self, reading: str) -> Comparison | None:
        """Our mean less the paper's; None where that is not known."""
        ours = self.accuracy(reading)
        if self.paper is None or ours.std is None:
            return None
        parts = [(ours.std**2 / len(ours.values), len(ours.values)), (self.paper[1] ** 2 / RUNS, RUNS)]
        total = sum(part for part, _ in parts)
        # Welch's degrees of freedom
        freedom = total**2 / sum(part**2 / (runs - 1) for part, runs in parts)
        return Comparison(ours.mean - self.paper[0], math.sqrt(total), freedom)


def lines_of(table: str, rows: Mapping[Row, int], cells: Mapping[str, Cell]) -> list[Line]:
    """The rows that there are cells of."""
    found = []
    for row, seeds in rows.items():
        there = tuple(cells[row.cell(seed)] for seed in range(seeds) if row.cell(seed) in cells)
        found += [Line(table, row, there)] if there else []
    return found


@dataclass(frozen=True, slots=True)
class Variance:
    """One-way analysis of variance: whether rows differ by more than their seeds do.

    `between` is the standard deviation of the means, `expected` that of rows that do not differ at all.
    """

    rows: int
    between: float
    expected: float
    f: float
    p: float


def variance(groups: Sequence[Sequence[float]]) -> Variance | None:
    """Of groups of two values or more; None with fewer than two of them, or where nothing varies inside."""
    groups = [group for group in groups if len(group) > 1]
    if len(groups) < 2 or all(len(set(group)) == 1 for group in groups):
        return None
    inside = sum(statistics.variance(group) * (len(group) - 1) for group in groups) / sum(
        len(group) - 1 for group in groups
    )
    found = f_oneway(*groups)
    return Variance(
        rows=len(groups),
        between=statistics.stdev([statistics.fmean(group) for group in groups]),
        expected=math.sqrt(inside * statistics.fmean(1 / len(group) for group in groups)),
        f=float(found.statistic),
        p=float(found.pvalue),
    )


def rank_correlation(
    values: Sequence[float], others: Sequence[float], *, kendall: bool = False
) -> tuple[float, float] | None:
    """Spearman's rho or Kendall's tau, and its p; None where one does not vary or there are fewer than four pairs."""
    # means of equal sums are the same rank, although 300 / 3 and 200 / 2 may differ in their last digit
    values, others = ([round(value, 9) for value in each] for each in (values, others))
    if len(values) < 4 or len(set(values)) == 1 or len(set(others)) == 1:
        return None
    rho, p = (kendalltau if kendall else spearmanr)(values, others)
    return float(rho), float(p)
