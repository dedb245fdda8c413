"""Whether the rows of one of the paper's tables differ by more than their seeds do, and with what they cost."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

from spikeloom.runtime.studies.paper.table import PROTOCOLS

Json = dict[str, Any]

READINGS = (*PROTOCOLS, "chip")
"""Accuracies that are looked at; on the chip at the last epoch."""

FEWEST = 4
"""Rows that a rank correlation needs; with three of them any order is by chance once in six."""

COUNTED = 8
"""Rows up to which every order is counted, 40,320 of them; p comes from Student's distribution above."""


def differences(rows: Sequence[Json]) -> list[Json]:
    """Between and within the rows of each data set, by each reading.

    Parameters
    ----------
    rows : sequence of dict
        See :func:`table.rows`.

    Returns
    -------
    list of dict
        ``data``, ``reading``; ``between``: of rows with two seeds or more, see :func:`analysis`; ``with_operations``:
        see :func:`rank_correlation`, over all rows of the table of graphs, of mean accuracy with first-layer
        operations. None where there are too few.
    """
    found = []
    for data in dict.fromkeys(row["data"] for row in rows):
        for reading in READINGS:
            seen = [(row, spread) for row in rows if row["data"] == data and (spread := _accuracy(row, reading))]
            on_chip = [(row, spread) for row, spread in seen if row["table"] == "graphs" and _fits(row)]
            found.append(
                {
                    "data": data,
                    "reading": reading,
                    "between": analysis([spread["values"] for _, spread in seen if spread["n"] > 1]),
                    "with_operations": rank_correlation(
                        [spread["mean"] for _, spread in on_chip],
                        [row["chip"]["first_layer_operations"] for row, _ in on_chip],
                    ),
                }
            )
    return found


def _accuracy(row: Json, reading: str) -> Json | None:
    if reading == "chip":
        return row["chip"]["last"] if _fits(row) else None
    spread: Json | None = row[reading]
    return spread


def _fits(row: Json) -> bool:
    """Whether the chip takes every seed of a row; the mean of those that it takes is of other networks."""
    return row["chip"] is not None and row["refused"] is None


def analysis(groups: Sequence[Sequence[float]]) -> Json | None:
    """One-way analysis of variance: whether the means of some groups differ by more than what is inside them says.

    Returns
    -------
    dict or None
        ``rows``; ``between``, ``within``: standard deviation of the means, and pooled over the groups; ``expected``:
        that of the means of groups that do not differ at all; ``f`` and ``p``. None with fewer than two groups, or
        where nothing varies inside.

    References
    ----------
    .. [1] R. A. Fisher, "Statistical methods for research workers", Oliver and Boyd, 1925, chapter 7.

    Examples
    --------
    >>> found = analysis([[6, 8, 4, 5, 3, 4], [8, 12, 9, 11, 6, 8], [13, 9, 11, 8, 7, 12]])
    >>> found["rows"], round(found["f"], 2), round(found["p"], 4)
    (3, 9.26, 0.0024)
    """
    from scipy.special import fdtrc  # a tenth of a second that other commands need not wait

    if len(groups) < 2 or all(len(set(group)) == 1 for group in groups):
        return None
    means = [statistics.fmean(group) for group in groups]
    total = sum(map(len, groups))
    whole = sum(map(sum, groups)) / total
    inside = sum((value - mean) ** 2 for group, mean in zip(groups, means, strict=True) for value in group)
    inside /= total - len(groups)
    outside = sum(len(group) * (mean - whole) ** 2 for group, mean in zip(groups, means, strict=True))
    outside /= len(groups) - 1
    return {
        "rows": len(groups),
        "between": statistics.stdev(means),
        "within": math.sqrt(inside),
        "expected": math.sqrt(inside * statistics.fmean(1 / len(group) for group in groups)),
        "f": outside / inside,
        "p": float(fdtrc(len(groups) - 1, total - len(groups), outside / inside)),
    }


def rank_correlation(values: Sequence[float], others: Sequence[float]) -> Json | None:
    """Spearman's rank correlation; None with fewer than four pairs, or where one of them does not vary.

    `p` is two-sided: twice the share of all orders of `values` that agree as well or better with `others`, at most 1.

    References
    ----------
    .. [1] C. Spearman, "The proof and measurement of association between two things", American Journal of Psychology
       15, 1904.

    Examples
    --------
    >>> found = rank_correlation([1, 2, 3, 4, 5], [5, 6, 7, 8, 7])
    >>> found["rows"], round(found["rho"], 2), round(found["p"], 3)
    (5, 0.82, 0.133)
    """
    # means of equal sums are the same rank, although 300/3 and 200/2 of other counts may differ in their last digit
    values, others = ([round(value, 9) for value in each] for each in (values, others))
    if len(values) < FEWEST or len(set(values)) == 1 or len(set(others)) == 1:
        return None
    from scipy.stats import permutation_test, rankdata, spearmanr  # half a second that other commands need not wait

    rho, p = spearmanr(values, others)
    if len(values) <= COUNTED:
        ranks, wanted = rankdata(values), rankdata(others)
        p = permutation_test(
            (ranks,),
            lambda order, axis: (order * wanted).sum(axis=axis),  # rho rises with it
            permutation_type="pairings",
            vectorized=True,
            n_resamples=math.inf,
        ).pvalue
    return {"rows": len(values), "rho": float(rho), "p": float(p)}
