"""What a chart is drawn over: energy, time, operations, cores, and the simulator's own speed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from spikeloom.runtime.machines.truenorth.machine import TICK
from spikeloom.runtime.report.tables import si
from spikeloom.runtime.studies.chart.points import by_chip, own_value

Json = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """One horizontal axis.

    Parameters
    ----------
    title : str
        In a few words.
    axis : str
        Under the axis.
    value : callable
        Of a point.
    said : callable
        A value in words.
    """

    title: str
    axis: str
    value: Callable[[Json], float]
    said: Callable[[float], str]


def costs_of(report: Json, *, measured: bool = False) -> dict[str, Cost]:
    """Axes of a chart by name; with `measured` also the one whose values depend on the machine that made the chart."""
    energy, time = report["chosen_by"]["energy"], report["chosen_by"]["time"]
    rates = report["measured"]["recordings_per_s"]
    _, beside = by_chip(report["points"], report["target"])

    def others(figure: str, table: str) -> str:
        """Tables by which the points of other chips are drawn."""
        drawn = dict.fromkeys(f"; {p['target']}: {next(iter(p['test'][figure]))}" for p in beside)
        return "".join(words for words in drawn if not words.endswith(f": {table}"))

    found = {
        "energy": Cost(
            title="energy",
            axis=f"energy of a mean inference ({energy}{others('energy_j', energy)})",
            value=lambda point: own_value(point["test"]["energy_j"], energy),
            said=lambda value: si(value, "J"),
        )
    }
    if time is not None:
        found["latency"] = Cost(
            title="time on the chip",
            axis=f"time of a mean inference on the chip, {_model(time)}{others('time_s', time)})",
            value=lambda point: own_value(point["test"]["time_s"], time),
            said=lambda value: si(value, "s"),
        )
    found["operations"] = Cost(
        title="synaptic operations",
        axis="synaptic operations of a mean inference",
        value=lambda point: float(point["test"]["synaptic_operations"]),
        said=counted,
    )
    found["cores"] = Cost(
        title="cores", axis="cores in use", value=lambda point: float(point["n_cores"]), said=lambda value: f"{value:g}"
    )
    if measured:
        found["speed"] = Cost(
            title="speed of the simulator",
            axis="recordings a second on one thread, decisions only, measured where the chart was made",
            value=lambda point: float(rates[str(point["number"])]),
            said=counted,
        )
    return found


def _model(time: str) -> str:
    """How a table's times are added up, to an opened bracket.

    Examples
    --------
    >>> _model("sanafe"), _model("tick")
    ('simple model (sanafe', 'real time (tick')
    """
    return f"{'real time' if time == TICK else 'simple model'} ({time}"


def counted(value: float) -> str:
    """A large number in few letters.

    Examples
    --------
    >>> counted(950.0), counted(2000.0), counted(1.75e6)
    ('950', '2k', '1.75M')
    """
    for factor, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.3g}{letter}"
    return f"{value:.3g}"
