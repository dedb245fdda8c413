"""Chips: what a chip is, what events on it cost and take, and how its numbers are read.

The folder of a chip has ``chip.toml``, every number once with unit and source, and the passes that lower
networks to it. Which chips a user may name is listed in :mod:`runtime.machines.backends`.
"""

import math
import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from spikeloom.compiler import targets
from spikeloom.compiler.errors import OptionError, Violation
from spikeloom.compiler.files import FileFault, read_whole, reading
from spikeloom.compiler.types import JsonObject

REMEDY = "fix it"

COMPARTMENTS = "compartments"
CROSSBARS = "crossbars"
"""What cores are made of: lists of weighted synapses onto compartments (Loihi), or a binary crossbar (TrueNorth)."""

PRICE_UNIT = "pJ"
POWER_UNIT = "mW"
TIME_UNIT = "ns"
PICOSECONDS = 1000
"""Picoseconds in a TIME_UNIT; latencies are rounded to whole ones."""

EVENTS = (
    *(
        "synaptic_operation",
        "synaptic_operation_dense",
        "synaptic_operation_sparse",
        "neuron_idle",
        "neuron_active",
    ),
    *("spike", "packet", "hop_east_west", "hop_north_south"),
)
"""What an energy table may price."""

FLOOR = "floor"
"""Power of a chip that events come on top of; a table without it has it in its prices."""

CROSSBAR_EVENTS = ("synaptic_event", FLOOR)
"""What an energy table of crossbars may price; a synaptic event is a spike that meets a set crossing point."""

HOST = {"step_least": "ms", "step_most": "ms", "awake": "mW"}
"""What a host adds to a step, least and most, and the power of a chip that a host has woken and that does nothing."""

LINK_BUFFER = "link_buffer"

LATENCIES = (
    *("neuron_access", "neuron_update", "spike", "axon_out", "axon_in"),
    *("synaptic_operation_dense", "synaptic_operation_sparse", "hop_east_west", "hop_north_south"),
)
"""What a time table must give, beside ``link_buffer`` and ``barrier.N``, the barrier from N used tiles on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """One number of a target, with its unit, where it was read, and what stands there."""

    value: float
    unit: str
    source: str
    confidence: str = ""
    quote: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EnergyTable:
    """Prices per event in joules; an event without an entry is unknown to this table."""

    name: str
    title: str
    prices: Mapping[str, Quantity]

    def joule(self, event: str) -> float:
        """Price of one `event` in joules; KeyError if the table does not know it."""
        return self.prices[event].value * 1e-12  # PRICE_UNIT

    @property
    def floor_w(self) -> float | None:
        """Watt of a chip beside the events, or None where the prices hold it."""
        return self.prices[FLOOR].value * 1e-3 if FLOOR in self.prices else None  # POWER_UNIT


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeTable:
    """Latencies per event; all are whole picoseconds, so that sums of them are exact."""

    name: str
    title: str
    latencies: Mapping[str, Quantity]  # Of each of ``LATENCIES``
    barriers: Mapping[int, Quantity]  # Length of the barrier that ends a step, from so many used tiles on
    link_buffer: Quantity  # Messages that a link of the mesh holds

    def picoseconds(self, event: str) -> int:
        """Latency of one `event`."""
        return round(self.latencies[event].value * PICOSECONDS)

    def barrier(self, tiles: int) -> int:
        """Picoseconds of the barrier among so many used tiles, at least one."""
        return round(
            self.barriers[max(least for least in self.barriers if least <= tiles)].value * PICOSECONDS
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """The numbers of a chip."""

    name: str
    title: str
    limits: Mapping[str, Quantity]  # Whole numbers by rule
    choices: Mapping[str, tuple[int, ...]]  # Permitted values by rule
    energy: tuple[EnergyTable, ...]
    time: tuple[TimeTable, ...]
    static: Mapping[str, Quantity]  # Power of a chip, whether it computes or not
    host: Mapping[str, Quantity] = field(
        default_factory=dict
    )  # What feeding it adds, of ``HOST``, where known
    injection: Mapping[str, Quantity] = field(
        default_factory=dict
    )  # What handing in events takes of the chip
    measured: str = ""  # How far these prices were from measured chips
    cores: str = COMPARTMENTS  # or ``CROSSBARS``, which have neither choices nor time tables

    def limit(self, rule: str) -> int:
        """Largest amount that `rule`, for example ``core.axons_in``, allows."""
        return int(self.limits[rule].value)

    def exceeded(self, owner: str, rule: str, used: int, remedy: str) -> Violation:
        """Violation of a limit by a network, for an error message."""
        return Violation(
            owner=owner, rule=f"{self.name}.{rule}", used=used, allowed=self.limit(rule), remedy=remedy
        )


def read_target(path: str | os.PathLike[str]) -> Target:
    """Read a target file; OptionError if it cannot be read or an entry is wrong."""
    with reading(path, OptionError, REMEDY):
        raw = tomllib.loads(read_whole(Path(path), "target file").decode())
        if missing := {"name", "title", "limits", "energy"} - raw.keys():
            raise FileFault(f"{', '.join(sorted(missing))}: missing")
        cores = raw.get("cores", COMPARTMENTS)
        energy, time = _cost_tables(raw, cores)
        return Target(
            name=raw["name"],
            title=raw["title"],
            cores=cores,
            limits=_quantities("limits", raw["limits"]),
            choices={rule: tuple(entry["values"]) for rule, entry in _entries(raw.get("choices", {}))},
            energy=energy,
            time=time,
            static=_quantities("static", raw.get("static", {})),
            host=_quantities("host", raw.get("host", {}), HOST),
            injection=_injection(raw.get("injection", {})),
            measured=raw.get("measured", ""),
        )


def with_tables(target: Target, name: str) -> Target:
    """Choose the tables that price and time a run: of the target by `name`, or of a TOML file of that name.

    The file has ``[energy.NAME]`` or ``[time.NAME]`` sections as a target file has; what it lacks stays the
    target's, but for what measured chips say of its prices. OptionError if there is no such table, or the
    file is wrong.
    """
    energy = tuple(table for table in target.energy if table.name == name)
    time = tuple(table for table in target.time if table.name == name)
    if not energy and not time:
        if not name.endswith(".toml"):
            names = sorted({table.name for table in target.energy} | {table.name for table in target.time})
            raise OptionError(
                f"--table {name}: unknown; allowed: {', '.join(names)}, or a file that ends in .toml"
            )
        with reading(name, OptionError, REMEDY):
            raw = tomllib.loads(read_whole(Path(name), "file of tables").decode())
            if not raw or raw.keys() - {"energy", "time"}:
                raise FileFault(
                    f"holds {', '.join(raw) or 'nothing'}, wanted is [energy.NAME] or [time.NAME] alone"
                )
            energy, time = _cost_tables(raw, target.cores)
            target = replace(target, measured="")
    return replace(target, energy=energy or target.energy, time=time or target.time)


@cache
def shipped() -> Mapping[str, Target]:
    """Every target that is described here: a folder beside this file with ``chip.toml``."""
    files = (file for place in targets.__path__ for file in Path(place).glob("*/chip.toml"))
    return {file.parent.name: read_target(file) for file in files}


def load_target(name: str) -> Target:
    """The shipped target of that name; KeyError if there is none."""
    return shipped()[name]


def _entries(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every entry of nested tables with its dotted name."""
    for key, entry in table.items():
        if isinstance(entry, dict) and all(isinstance(value, dict) for value in entry.values()):
            yield from _entries(entry, f"{prefix}{key}.")
        else:
            yield prefix + key, entry


def _quantity(where: str, entry: Any, unit: str = "") -> Quantity:
    """A number with its unit, which must be `unit` if one is given, and its source."""
    try:
        quantity = Quantity(**entry)
    except TypeError:
        raise FileFault(f"{where}: is {entry!r}, not an entry of value, unit and source") from None
    if type(quantity.value) not in (int, float) or not 0 <= quantity.value < math.inf:
        raise FileFault(f"{where}: value is {quantity.value!r}, a finite number from 0 is needed")
    if unit and quantity.unit != unit:
        raise FileFault(f"{where}: unit is {quantity.unit!r}, allowed is {unit!r}")
    return quantity


def _quantities(
    where: str, table: Mapping[str, Any], units: Mapping[str, str] | None = None
) -> dict[str, Quantity]:
    """Numbers of a section by their dotted names; `units` are those that it may have, all by default."""
    quantities = {}
    for name, entry in _entries(table):
        if units is not None and name not in units:
            raise FileFault(f"{where}.{name}: unknown, allowed are {', '.join(units)}")
        quantities[name] = _quantity(f"{where}.{name}", entry, units[name] if units else "")
    return quantities


def _injection(table: Mapping[str, Any]) -> dict[str, Quantity]:
    """Prices of an event, or power for as long as events may come."""
    found = _quantities("injection", table)
    for name, price in found.items():
        if price.unit not in (PRICE_UNIT, POWER_UNIT):
            raise FileFault(f"injection.{name}: unit is {price.unit!r}, allowed are pJ and mW")
    return found


def _cost_tables(
    raw: Mapping[str, Any], cores: str
) -> tuple[tuple[EnergyTable, ...], tuple[TimeTable, ...]]:
    """Energy tables and time tables of a file."""
    events = CROSSBAR_EVENTS if cores == CROSSBARS else EVENTS
    units = {event: POWER_UNIT if event == FLOOR else PRICE_UNIT for event in events}
    energy = [
        EnergyTable(name=name, title=title, prices=_quantities(where, table, units))
        for name, where, title, table in _tables(raw, "energy")
    ]
    time = []
    for name, where, title, table in _tables(raw, "time"):
        barriers = table.pop("barrier", {})
        latencies = _quantities(where, table, dict.fromkeys(LATENCIES, TIME_UNIT) | {LINK_BUFFER: ""})
        missing = [event for event in (*LATENCIES, LINK_BUFFER) if event not in latencies]
        if (
            missing
            or not isinstance(barriers, dict)
            or "1" not in barriers
            or not all(map(str.isdecimal, barriers))
        ):
            wanted = ", ".join(missing) or "barrier.1, and others with a number of tiles"
            raise FileFault(f"{where}: lacks {wanted}, which a time table has")
        least = {
            int(tiles): _quantity(f"{where}.barrier.{tiles}", barriers[tiles], TIME_UNIT)
            for tiles in barriers
        }
        buffer = latencies.pop(LINK_BUFFER)
        time.append(
            TimeTable(name=name, title=title, latencies=latencies, barriers=least, link_buffer=buffer)
        )
    return tuple(energy), tuple(time)


def _tables(raw: Mapping[str, Any], kind: str) -> Iterator[tuple[str, str, str, JsonObject]]:
    """Name, place in the file, title and entries of each table of a kind."""
    sections = raw.get(kind, {})
    for name, table in sections.items() if isinstance(sections, dict) else [("NAME", None)]:
        if not isinstance(table, dict) or not isinstance(table.get("title"), str):
            raise FileFault(f"{kind}.{name}: lacks its title")
        yield name, f"{kind}.{name}", table["title"], {k: v for k, v in table.items() if k != "title"}
