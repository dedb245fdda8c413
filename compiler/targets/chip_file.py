"""Read the numbers of a chip from TOML: limits, permitted values, prices, latencies; every fault is named at once."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import OptionError
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
from spikeloom.compiler.types import JsonObject

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
"""Of what a target of compartments must list the permitted values."""

Faults = list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers:
    """What a file says about a chip: integer limits, permitted values, named energy and time tables, static power.

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


def read_numbers(path: str | os.PathLike[str]) -> Numbers:
    """Read and check a target file.

    Raises
    ------
    OptionError
        If it cannot be read, or entries are wrong: one line for each.
    """
    raw = _toml(path, "a target file")
    crossbars = raw.get("cores") == CROSSBARS
    known = {"name", "title", "limits", "energy"} | (set() if crossbars else {"choices", "time"})
    faults = [f"{key}: is missing" for key in sorted(known - raw.keys())]
    faults += [f"unknown key {key!r}" for key in raw.keys() - known - {"static", "cores"}]
    faults += [
        f"{key}: is {raw[key]!r}, a text is needed" for key in ("name", "title") if not _is_text(raw.get(key, key))
    ]
    if raw.get("cores", COMPARTMENTS) not in (COMPARTMENTS, CROSSBARS):
        faults.append(f"cores: is {raw['cores']!r}, allowed are {COMPARTMENTS}, {CROSSBARS}")
    limits = _section(raw, "limits", "value", faults, wanted=CROSSBAR_LIMITS if crossbars else LIMITS)
    for name, entry in limits.items():
        _require_whole(f"limits.{name}", entry, faults)
    choices = {} if crossbars else _section(raw, "choices", "values", faults, wanted=CHOICES)
    static = _section(raw, "static", "value", faults)
    _require_unit("static", static, lambda _: POWER_UNIT, faults)
    energy, time = _cost_tables(raw, CROSSBAR_EVENTS if crossbars else EVENTS, faults)
    _refuse(path, faults)
    return Numbers(
        name=raw["name"],
        title=raw["title"],
        cores=raw.get("cores", COMPARTMENTS),
        limits={rule: Quantity(**entry) for rule, entry in limits.items()},
        choices={rule: tuple(entry["values"]) for rule, entry in choices.items()},
        energy=energy,
        time=time,
        static={name: Quantity(**entry) for name, entry in static.items()},
    )


def read_cost_tables(path: str, cores: str) -> tuple[tuple[EnergyTable, ...], tuple[TimeTable, ...]]:
    """Tables of a file that holds nothing but ``[energy.NAME]`` and, for compartments, ``[time.NAME]`` sections.

    Raises
    ------
    OptionError
        If it cannot be read, or entries are wrong: one line for each.
    """
    raw = _toml(path, "a file of tables")
    kinds = {"energy"} if cores == CROSSBARS else {"energy", "time"}
    sections = " or ".join(f"[{kind}.NAME]" for kind in sorted(kinds))
    faults = [f"unknown key {key!r}, allowed are {', '.join(sorted(kinds))}" for key in raw.keys() - kinds]
    if not kinds & raw.keys():
        faults.append(f"holds no table; give {sections} with title and entries")
    tables = _cost_tables(raw, CROSSBAR_EVENTS if cores == CROSSBARS else EVENTS, faults)
    _refuse(path, faults)
    return tables


def _toml(path: str | os.PathLike[str], what: str) -> JsonObject:
    try:
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise OptionError(f"{path}: cannot be read ({error.strerror or error}); give {what}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{path}: is not TOML ({error}); mend it") from error


def _refuse(path: str | os.PathLike[str], faults: Faults) -> None:
    if faults:
        raise OptionError("\n".join(f"{path}: {fault}" for fault in faults))


# -- entries -----------------------------------------------------------------------------------------------------------


def _section(
    raw: Mapping[str, Any], kind: str, leaf: str, faults: Faults, wanted: tuple[str, ...] | None = None
) -> dict[str, dict[str, Any]]:
    """Sound entries of a section by their dotted names; if some are wanted, all of these and no others."""
    entries = dict(_entries(raw.get(kind, {}), leaf))
    if wanted is not None:
        faults += [f"{kind}.{name}: is missing" for name in wanted if name not in entries]
        faults += [f"{kind}.{name}: unknown, allowed are {', '.join(wanted)}" for name in entries if name not in wanted]
    return _sound(kind, entries, leaf, faults)


def _entries(table: Any, leaf: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """What is said of each dotted name."""
    if not isinstance(table, dict) or {leaf, "unit", "source"} & table.keys():
        yield prefix, table
        return
    for key, entry in table.items():
        yield from _entries(entry, leaf, f"{prefix}.{key}" if prefix else key)


def _sound(where: str, entries: Mapping[str, Any], leaf: str, faults: Faults) -> dict[str, dict[str, Any]]:
    wrong = {name: _fault(entry, leaf) for name, entry in entries.items()}
    faults += [f"{where}.{name}: {fault}" for name, fault in wrong.items() if fault]
    return {name: entry for name, entry in entries.items() if not wrong[name]}


def _fault(entry: Any, leaf: str) -> str:
    """What is wrong with an entry: it says its amount, its unit and where it was read, and nothing else."""
    keys = {leaf, "unit", "source"}
    if not isinstance(entry, dict) or not keys <= entry.keys() <= keys | {"confidence"}:
        return f"is {entry!r}, not an entry of {leaf}, unit and source"
    if not (_is_text(entry["unit"]) and _is_text(entry["source"])):
        return f"unit and source are {entry['unit']!r} and {entry['source']!r}, texts are needed"
    if entry.get("confidence", CONFIDENCE[0]) not in CONFIDENCE:
        return f"confidence is {entry['confidence']!r}, allowed are {', '.join(CONFIDENCE)}"
    amount = entry[leaf]
    if leaf == "value" and not (type(amount) in (int, float) and math.isfinite(amount) and amount >= 0):
        return f"value is {amount!r}, a finite number from 0 is needed"
    if leaf == "values" and not (isinstance(amount, list) and amount and all(type(value) is int for value in amount)):
        return f"values are {amount!r}, a list of whole numbers is needed"
    return ""


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _require_whole(where: str, entry: Mapping[str, Any], faults: Faults) -> None:
    if entry["value"] != int(entry["value"]):
        faults.append(f"{where}: value is {entry['value']!r}, a whole number is needed")


def _require_unit(
    where: str, entries: Mapping[str, Mapping[str, Any]], unit: Callable[[str], str], faults: Faults
) -> None:
    faults += [
        f"{where}.{name}: unit is {entry['unit']!r}, allowed is {unit(name)!r}"
        for name, entry in entries.items()
        if entry["unit"] != unit(name)
    ]


# -- tables ------------------------------------------------------------------------------------------------------------


def _cost_tables(
    raw: Mapping[str, Any], events: tuple[str, ...], faults: Faults
) -> tuple[tuple[EnergyTable, ...], tuple[TimeTable, ...]]:
    """Energy tables of these events and time tables, as far as they are sound."""
    energy, time = [], []
    for key, title, entries in _tables(raw, "energy", faults):
        where = f"energy.{key}"
        faults += [
            f"{where}.{event}: unknown event, allowed are {', '.join(events)}" for event in entries.keys() - events
        ]
        if events is CROSSBAR_EVENTS and events[0] not in entries:
            faults.append(f"{where}: has no price of {events[0]}; give it")
        _require_unit(where, entries, lambda event: POWER_UNIT if event == FLOOR else PRICE_UNIT, faults)
        prices = {event: Quantity(**entry) for event, entry in entries.items()}
        energy.append(EnergyTable(name=key, title=title, prices=prices))
    for key, title, entries in _tables(raw, "time", faults):
        missing = _latency_faults(f"time.{key}", entries, faults)
        if not missing:
            found = {rule: Quantity(**entry) for rule, entry in entries.items()}
            barriers = {int(rule[len(BARRIER) :]): found[rule] for rule in found if _is_barrier(rule)}
            latencies = {event: found[event] for event in LATENCIES}
            time.append(
                TimeTable(name=key, title=title, latencies=latencies, barriers=barriers, link_buffer=found[LINK_BUFFER])
            )
    return tuple(energy), tuple(time)


def _tables(raw: Mapping[str, Any], kind: str, faults: Faults) -> Iterator[tuple[str, str, dict[str, dict[str, Any]]]]:
    """Key, title and sound entries of each table of a kind."""
    for key, table in raw.get(kind, {}).items() if isinstance(raw.get(kind, {}), dict) else [("", None)]:
        if not isinstance(table, dict) or not isinstance(table.get("title"), str):
            faults.append(f"{kind}.{key}: lacks its title; give title and entries")
            continue
        entries = {name: entry for name, entry in table.items() if name != "title"}
        yield key, table["title"], _sound(f"{kind}.{key}", dict(_entries(entries, "value")), "value", faults)


def _is_barrier(rule: str) -> bool:
    """Whether `rule` is a barrier and says from how many tiles on it holds."""
    tiles = rule.removeprefix(BARRIER)
    return rule.startswith(BARRIER) and tiles.isdecimal() and tiles.isascii() and not tiles.startswith("0")


def _latency_faults(where: str, entries: Mapping[str, Mapping[str, Any]], faults: Faults) -> list[str]:
    """Refuse unknown, coarse or missing latencies, of which none is zero unless it says; return those missing."""
    wanted = (*LATENCIES, LINK_BUFFER, f"{BARRIER}1")
    missing = [rule for rule in wanted if rule not in entries]
    faults += [f"{where}.{rule}: is missing" for rule in missing]
    allowed = ", ".join((*LATENCIES, LINK_BUFFER, f"{BARRIER}N with a number of tiles N"))
    unknown = [rule for rule in entries if rule not in wanted and not _is_barrier(rule)]
    faults += [f"{where}.{rule}: unknown, allowed are {allowed}" for rule in unknown]
    if LINK_BUFFER in entries:
        _require_whole(f"{where}.{LINK_BUFFER}", entries[LINK_BUFFER], faults)
    times = {rule: entry for rule, entry in entries.items() if rule != LINK_BUFFER}
    _require_unit(where, times, lambda _: TIME_UNIT, faults)
    faults += [
        f"{where}.{rule}: value is {entry['value']!r}, a multiple of {1 / PICOSECONDS} is needed"
        for rule, entry in times.items()
        if abs(entry["value"] * PICOSECONDS - round(entry["value"] * PICOSECONDS)) > 1e-6
    ]
    return missing
