"""Chips as data: every number of a target stands once, in its TOML file, with unit and source."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from spikeloom.compiler import targets
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.pipeline import Passes, run
from spikeloom.compiler.targets.price_tables import (
    BARRIER,
    CROSSBAR_EVENTS,
    EVENTS,
    FLOOR,
    LATENCIES,
    LINK_BUFFER,
    PICOSECONDS,
    POWER_UNIT,
    PRICE_UNIT,
    TIME_UNIT,
    EnergyTable,
    Quantity,
    TimeTable,
)

__all__ = [
    "BARRIER",
    "CHOICES",
    "COMPARTMENTS",
    "CROSSBARS",
    "CROSSBAR_EVENTS",
    "CROSSBAR_LIMITS",
    "EVENTS",
    "LATENCIES",
    "LIMITS",
    "LINK_BUFFER",
    "PICOSECONDS",
    "POWER_UNIT",
    "PRICE_UNIT",
    "TIME_UNIT",
    "EnergyTable",
    "Quantity",
    "Target",
    "TimeTable",
    "known_targets",
    "load_target",
    "read_target",
    "with_tables",
]

_NOT_MODELLED = {"loihi2": "not modelled; no public per-event energies"}

COMPARTMENTS, CROSSBARS = "compartments", "crossbars"
"""What cores are made of: lists of weighted synapses onto compartments (Loihi), or a binary crossbar (TrueNorth)."""

CONFIDENCE = ("agreed", "read", "secondary", "derived", "unverified")
"""How sure a number is, where its entry says so: sources agree, one primary source, notes on one, arithmetic, none."""

LIMITS = (
    *(f"core.{what}" for what in ("compartments", "axons_in", "axons_out", "synapse_words", "threshold_slots")),
    *("core.synapse_formats", "core.compartment_configs", "core.dense_base", "chip.cores"),
    *("synapse.block", "synapse.block_header_bits", "synapse.word_bits"),
    *("mesh.tile_cores", "mesh.width", "mesh.height"),
)
"""What a target of compartments must limit."""

CROSSBAR_LIMITS = (
    *("core.axons", "core.neurons", "core.axon_types", "chip.cores", "mesh.width", "mesh.height", "mesh.reach"),
    *(f"neuron.{what}_bits" for what in ("weight", "leak", "threshold", "mask", "reset", "membrane")),
    *("neuron.targets", "neuron.delay", "tick.length"),
)
"""What a target of crossbars must limit."""

CHOICES = ("synapse.weight_bits", "synapse.index_bits", "synapse.exponent")
"""Of what a target must list the permitted values."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A chip: integer limits, permitted values, named energy and time tables, static power by source (of a chip).

    `cores` is ``COMPARTMENTS`` or ``CROSSBARS``; only the first have choices and time tables.
    """

    name: str
    title: str
    limits: Mapping[str, Quantity]
    choices: Mapping[str, tuple[int, ...]]
    energy: tuple[EnergyTable, ...]
    time: tuple[TimeTable, ...]
    static: Mapping[str, Quantity]
    cores: str = COMPARTMENTS

    def limit(self, rule: str) -> int:
        """Largest amount that `rule`, for example ``core.axons_in``, allows."""
        return int(self.limits[rule].value)

    @property
    def module(self) -> Any:
        """Module ``passes`` in the folder of the chip: ``PASSES``, ``Options`` and ``start``."""
        return import_module(f"{targets.__name__}.{self.name}.passes")

    @property
    def passes(self) -> Passes:
        """From what is trained to a netlist."""
        passes: Passes = self.module.PASSES
        return passes

    @property
    def options(self) -> type[Any]:
        """Class of the options that :meth:`compile` takes."""
        options: type[Any] = self.module.Options
        return options

    def compile(self, source: Any, options: Any = None, *, after: Callable[[str, Any], object] | None = None) -> Any:
        """Lower what is trained; `after` is called with the name of each pass and all that was made so far.

        Returns
        -------
        Compilation of the chip
            With the result as ``netlist``.

        Raises
        ------
        SpikeloomError
            As the passes say.
        """
        module = self.module
        work, passes = module.start(source, module.Options() if options is None else options, self)
        return run(passes, work, after)


def _entries(table: Any, leaf: str, prefix: str, faults: list[str]) -> dict[str, dict[str, Any]]:
    """Entries by their dotted names; an entry is a table that holds `leaf`, and what holds none is a fault."""
    if not isinstance(table, dict):
        faults.append(f"{prefix}: is {table!r}, not an entry with {leaf}, unit and source")
        return {}
    if leaf in table or {"unit", "source"} & table.keys():
        return {prefix: table}
    flat: dict[str, dict[str, Any]] = {}
    for key, entry in table.items():
        flat |= _entries(entry, leaf, f"{prefix}.{key}" if prefix else key, faults)
    return flat


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and value >= 0


def _check_entry(name: str, entry: Mapping[str, Any], leaf: str, faults: list[str]) -> None:
    """Every entry says its amount, its unit and where it was read, and nothing else."""
    keys = (leaf, "unit", "source")
    missing = [key for key in keys if key not in entry]
    if missing:
        faults.append(f"{name}: lacks {' and '.join(missing)}; give {', '.join(keys)}")
    odd = [key for key in entry if key not in (*keys, "confidence")]
    faults += [f"{name}: unknown key {key!r}, allowed are {', '.join(keys)}" for key in odd]
    if entry.get("confidence", CONFIDENCE[0]) not in CONFIDENCE:
        faults.append(f"{name}: confidence is {entry['confidence']!r}, allowed are {', '.join(CONFIDENCE)}")
    for key in ("unit", "source"):
        if key in entry and not (isinstance(entry[key], str) and entry[key].strip()):
            faults.append(f"{name}: {key} is {entry[key]!r}, a text is needed")
    if leaf == "value" and "value" in entry and not _is_number(entry["value"]):
        faults.append(f"{name}: value is {entry['value']!r}, a finite number from 0 is needed")
    if leaf == "values" and "values" in entry:
        values = entry["values"]
        if not (isinstance(values, list) and values and all(type(value) is int for value in values)):
            faults.append(f"{name}: values are {values!r}, a list of whole numbers is needed")


def read_target(path: str | os.PathLike[str]) -> Target:
    """Read and check a target file.

    Raises
    ------
    OptionError
        If it cannot be read, or entries are wrong: one line for each.
    """
    raw = _read(path, "a target file")
    faults = _head_faults(raw)
    crossbars = raw.get("cores") == CROSSBARS
    limits = _rules(raw, "limits", "value", CROSSBAR_LIMITS if crossbars else LIMITS, faults)
    choices = {} if crossbars else _rules(raw, "choices", "values", CHOICES, faults)
    energy, time = _cost_tables(raw, faults, CROSSBAR_EVENTS if crossbars else EVENTS)
    static = _entries(raw.get("static", {}), "value", "", faults)
    for name, entry in static.items():
        _check_entry(f"static.{name}", entry, "value", faults)
        _check_unit(f"static.{name}", entry, POWER_UNIT, faults)
    if faults:
        raise OptionError("\n".join(f"{path}: {fault}" for fault in faults))
    return Target(
        name=raw["name"],
        title=raw["title"],
        limits={rule: Quantity(**entry) for rule, entry in limits.items()},
        choices={rule: tuple(entry["values"]) for rule, entry in choices.items()},
        energy=energy,
        time=time,
        static={name: Quantity(**entry) for name, entry in static.items()},
        cores=raw.get("cores", COMPARTMENTS),
    )


def with_tables(target: Target, name: str) -> Target:
    """Choose the tables that price and time a run: one of the target's by name, or those of a file.

    Parameters
    ----------
    target : Target
        Chip.
    name : str
        Of a table, or of a TOML file with ``[energy.NAME]`` or ``[time.NAME]`` sections as a target file has them.
        What a file lacks of the two kinds stays that of the target.

    Raises
    ------
    OptionError
        If there is no such table, or the file is wrong: one line for each fault.
    """
    energy = tuple(table for table in target.energy if table.name == name)
    time = tuple(table for table in target.time if table.name == name)
    if not energy and not time:
        names = sorted({table.name for table in target.energy} | {table.name for table in target.time})
        if not name.endswith(".toml"):
            raise OptionError(f"--table {name}: unknown; allowed: {', '.join(names)}, or a file that ends in .toml")
        raw = _read(name, "a file of tables")
        crossbars = target.cores == CROSSBARS
        kinds = ("energy",) if crossbars else ("energy", "time")
        faults = [f"unknown key {key!r}, allowed are {', '.join(kinds)}" for key in raw if key not in kinds]
        if not set(kinds) & raw.keys():
            sections = " or ".join(f"[{kind}.NAME]" for kind in kinds)
            faults.append(f"holds no table; give {sections} with title and entries")
        energy, time = _cost_tables(raw, faults, CROSSBAR_EVENTS if crossbars else EVENTS)
        if faults:
            raise OptionError("\n".join(f"{name}: {fault}" for fault in faults))
    return replace(target, energy=energy or target.energy, time=time or target.time)


def _read(path: str | os.PathLike[str], what: str) -> dict[str, Any]:
    try:
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise OptionError(f"{path}: cannot be read ({error.strerror or error}); give {what}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{path}: is not TOML ({error}); mend it") from error


def _cost_tables(
    raw: Mapping[str, Any], faults: list[str], events: tuple[str, ...]
) -> tuple[tuple[EnergyTable, ...], tuple[TimeTable, ...]]:
    """Energy tables of these events and time tables; none of a kind that has a fault."""
    energy, time = raw.get("energy", {}), raw.get("time", {})
    before = len(faults)
    prices, latencies = _prices(energy, events, faults), _latencies(time, faults)
    if len(faults) > before:
        return (), ()
    return tuple(
        EnergyTable(
            name=key,
            title=energy[key]["title"],
            prices={event: Quantity(**price) for event, price in found.items()},
        )
        for key, found in prices.items()
    ), tuple(
        TimeTable(
            name=key,
            title=time[key]["title"],
            latencies={event: Quantity(**found[event]) for event in LATENCIES},
            barriers={int(rule[len(BARRIER) :]): Quantity(**found[rule]) for rule in found if _is_barrier(rule)},
            link_buffer=Quantity(**found[LINK_BUFFER]),
        )
        for key, found in latencies.items()
    )


def _head_faults(raw: Mapping[str, Any]) -> list[str]:
    known: tuple[str, ...] = ("name", "title", "limits", "energy")
    if raw.get("cores") != CROSSBARS:
        known = ("name", "title", "limits", "choices", "energy", "time")
    faults = [f"{key}: is missing" for key in known if key not in raw]
    if raw.get("cores", COMPARTMENTS) not in (COMPARTMENTS, CROSSBARS):
        faults.append(f"cores: is {raw['cores']!r}, allowed are {COMPARTMENTS}, {CROSSBARS}")
    allowed = (*known, "static", *(["cores"] if "cores" in raw else []))
    faults += [f"unknown key {key!r}, allowed are {', '.join(allowed)}" for key in raw if key not in allowed]
    texts = [key for key in ("name", "title") if not isinstance(raw.get(key, ""), str)]
    return faults + [f"{key}: is {raw[key]!r}, a text is needed" for key in texts]


def _rules(
    raw: Mapping[str, Any], kind: str, leaf: str, wanted: tuple[str, ...], faults: list[str]
) -> dict[str, dict[str, Any]]:
    """Limits or choices by their names, all of those that are wanted and no others."""
    found = _entries(raw.get(kind, {}), leaf, "", faults)
    faults += [f"{kind}.{name}: is missing" for name in wanted if kind in raw and name not in found]
    faults += [f"{kind}.{name}: unknown, allowed are {', '.join(wanted)}" for name in found if name not in wanted]
    for name, entry in found.items():
        _check_entry(f"{kind}.{name}", entry, leaf, faults)
        value: Any = entry.get("value")
        if leaf == "value" and _is_number(value) and value != int(value):
            faults.append(f"{kind}.{name}: value is {value!r}, a whole number is needed")
    return found


def _tables(raw: Any, kind: str, contents: str, faults: list[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Entries by table and name; every table has a title."""
    tables: dict[str, dict[str, dict[str, Any]]] = {}
    for key, table in raw.items() if isinstance(raw, dict) else [("", raw)]:
        if not isinstance(table, dict) or not isinstance(table.get("title"), str):
            faults.append(f"{kind}.{key}: lacks its title; give title and {contents}")
            continue
        entries = {name: entry for name, entry in table.items() if name != "title"}
        own: list[str] = []
        tables[key] = _entries(entries, "value", "", own)
        faults += [f"{kind}.{key}.{fault}" for fault in own]
    return tables


def _prices(energy: Any, events: tuple[str, ...], faults: list[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Prices by table and event."""
    prices = _tables(energy, "energy", "prices", faults)
    for key, found in prices.items():
        if events is CROSSBAR_EVENTS and events[0] not in found:
            faults.append(f"energy.{key}: has no price of {events[0]}; give it")
        for event, price in found.items():
            where = f"energy.{key}.{event}"
            _check_entry(where, price, "value", faults)
            if event not in events:
                faults.append(f"{where}: unknown event, allowed are {', '.join(events)}")
            _check_unit(where, price, POWER_UNIT if event == FLOOR else PRICE_UNIT, faults)
    return prices


def _is_barrier(rule: str) -> bool:
    """Whether `rule` is a barrier and says from how many tiles on it holds."""
    tiles = rule.removeprefix(BARRIER)
    return rule.startswith(BARRIER) and tiles.isdecimal() and tiles.isascii() and not tiles.startswith("0")


def _latencies(time: Any, faults: list[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Latencies, barriers and link buffers by table; nothing may be missing, for no latency is zero unless it says."""
    latencies = _tables(time, "time", "latencies", faults)
    wanted = (*LATENCIES, LINK_BUFFER, f"{BARRIER}1")
    allowed = ", ".join((*LATENCIES, LINK_BUFFER, f"{BARRIER}N with a number of tiles N"))
    for key, found in latencies.items():
        faults += [f"time.{key}.{rule}: is missing" for rule in wanted if rule not in found]
        for rule, entry in found.items():
            where = f"time.{key}.{rule}"
            _check_entry(where, entry, "value", faults)
            if rule not in wanted and not _is_barrier(rule):
                faults.append(f"{where}: unknown, allowed are {allowed}")
            value: Any = entry.get("value")
            if rule == LINK_BUFFER:
                if _is_number(value) and value != int(value):
                    faults.append(f"{where}: value is {value!r}, a whole number is needed")
                continue
            _check_unit(where, entry, TIME_UNIT, faults)
            if _is_number(value) and abs(value * PICOSECONDS - round(value * PICOSECONDS)) > 1e-6:
                faults.append(f"{where}: value is {value!r}, a multiple of {1 / PICOSECONDS} is needed")
    return latencies


def _check_unit(where: str, entry: Mapping[str, Any], unit: str, faults: list[str]) -> None:
    if isinstance(entry.get("unit"), str) and entry["unit"] != unit:
        faults.append(f"{where}: unit is {entry['unit']!r}, allowed is {unit!r}")


@cache
def shipped() -> Mapping[str, Target]:
    """Every target there is: a folder beside this file with ``chip.toml`` and a module ``passes``."""
    files = (file for place in targets.__path__ for file in Path(place).glob("*/chip.toml"))
    return {file.parent.name: read_target(file) for file in files}


def known_targets(cores: str | None = None) -> tuple[str, ...]:
    """Names that :func:`load_target` accepts, sorted; all, or those of one kind of cores."""
    return tuple(sorted(name for name, target in shipped().items() if cores in (None, target.cores)))


def load_target(name: str, cores: str | None = None) -> Target:
    """Read a target by name; its cores must be of the kind that the caller can handle, if that is given.

    Raises
    ------
    OptionError
        If there is no such target, or its cores are of the other kind.

    Examples
    --------
    >>> load_target("loihi1").limit("core.synapse_words"), load_target("truenorth").limit("core.axons")
    (16384, 256)
    """
    found = shipped().get(name)
    if found is None or cores not in (None, found.cores):
        why = _NOT_MODELLED.get(name, "unknown")
        why = why if found is None else f"its cores are {found.cores}, this is for {cores}"
        raise OptionError(f"--target {name}: {why}; allowed: {', '.join(known_targets(cores))}")
    return found
