"""Read the numbers of a chip from TOML: limits, permitted values, prices, latencies; every fault is named at once."""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

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
Entry = dict[str, Any]

Rule = Callable[[str], tuple[str, float]]
"""Unit of an entry by its name, "" if any will do, and of what its value must be a multiple, 0 of nothing."""


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


N = TypeVar("N", bound=Numbers)


def read_numbers(path: str | os.PathLike[str], kind: type[N]) -> N:
    """Read and check a target file; OptionError with a line for each fault."""
    raw = _toml(path, "a target file")
    cores, crossbars = raw.get("cores", COMPARTMENTS), raw.get("cores") == CROSSBARS
    known = {"name", "title", "limits", "energy"} | (set() if crossbars else {"choices", "time"})
    faults = [f"{key}: is missing" for key in sorted(known - raw.keys())]
    faults += [f"unknown key {key!r}" for key in raw.keys() - known - {"static", "cores"}]
    for key in ("name", "title"):
        if not _is_text(raw.get(key, key)):
            faults.append(f"{key}: is {raw[key]!r}, a text is needed")
    if cores not in (COMPARTMENTS, CROSSBARS):
        faults.append(f"cores: is {cores!r}, allowed are {COMPARTMENTS}, {CROSSBARS}")
    wanted = CROSSBAR_LIMITS if crossbars else LIMITS
    limits = _section("limits", raw.get("limits", {}), faults, lambda _: ("", 1), required=wanted, allowed=wanted)
    choices: dict[str, Entry] = {}
    if not crossbars:
        given = raw.get("choices", {})
        choices = _section(
            "choices", given, faults, lambda _: ("", 0), leaf="values", required=CHOICES, allowed=CHOICES
        )
    static = _section("static", raw.get("static", {}), faults, lambda _: (POWER_UNIT, 0))
    energy, time = _cost_tables(raw, cores, faults)
    _refuse(path, faults)
    return kind(
        name=raw["name"],
        title=raw["title"],
        cores=cores,
        limits={rule: Quantity(**entry) for rule, entry in limits.items()},
        choices={rule: tuple(entry["values"]) for rule, entry in choices.items()},
        energy=energy,
        time=time,
        static={name: Quantity(**entry) for name, entry in static.items()},
    )


def read_cost_tables(path: str, cores: str) -> tuple[tuple[EnergyTable, ...], tuple[TimeTable, ...]]:
    """Tables of a file that holds nothing but ``[energy.NAME]`` and, for compartments, ``[time.NAME]`` sections."""
    raw = _toml(path, "a file of tables")
    kinds = {"energy"} if cores == CROSSBARS else {"energy", "time"}
    sections = " or ".join(f"[{kind}.NAME]" for kind in sorted(kinds))
    faults = [f"unknown key {key!r}, allowed are {', '.join(sorted(kinds))}" for key in raw.keys() - kinds]
    if not kinds & raw.keys():
        faults.append(f"holds no table; give {sections} with title and entries")
    tables = _cost_tables(raw, cores, faults)
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


def _section(
    where: str,
    table: Any,
    faults: Faults,
    rule: Rule,
    *,
    leaf: str = "value",
    required: tuple[str, ...] = (),
    allowed: tuple[str, ...] | None = None,
) -> dict[str, Entry]:
    """Sound entries of a section by their dotted names; the others are added to the faults."""
    entries = dict(_entries(table, leaf))
    faults += [f"{where}.{name}: is missing" for name in required if name not in entries]
    sound = {}
    for name, entry in entries.items():
        if allowed is not None and _BARRIER.sub(f"{BARRIER}N", name) not in allowed:
            faults.append(f"{where}.{name}: unknown, allowed are {', '.join(allowed)}")
        elif fault := _fault(entry, leaf, *rule(name)):
            faults.append(f"{where}.{name}: {fault}")
        else:
            sound[name] = entry
    return sound


def _entries(table: Any, leaf: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """What is said of each dotted name."""
    if not isinstance(table, dict) or {leaf, "unit", "source"} & table.keys():
        yield prefix, table
        return
    for key, entry in table.items():
        yield from _entries(entry, leaf, f"{prefix}.{key}" if prefix else key)


def _fault(entry: Any, leaf: str, unit: str, step: float) -> str:
    """What is wrong with an entry: it says its amount, its unit and where it was read, and nothing else."""
    keys = {leaf, "unit", "source"}
    if not isinstance(entry, dict) or not keys <= entry.keys() <= keys | {"confidence"}:
        return f"is {entry!r}, not an entry of {leaf}, unit and source"
    if not (_is_text(entry["unit"]) and _is_text(entry["source"])):
        return f"unit and source are {entry['unit']!r} and {entry['source']!r}, texts are needed"
    if entry.get("confidence", CONFIDENCE[0]) not in CONFIDENCE:
        return f"confidence is {entry['confidence']!r}, allowed are {', '.join(CONFIDENCE)}"
    if unit and entry["unit"] != unit:
        return f"unit is {entry['unit']!r}, allowed is {unit!r}"
    return _amount_fault(entry[leaf], leaf, step)


def _amount_fault(amount: Any, leaf: str, step: float) -> str:
    if leaf == "values":
        whole = isinstance(amount, list) and amount and all(type(value) is int for value in amount)
        return "" if whole else f"values are {amount!r}, a list of whole numbers is needed"
    if not (type(amount) in (int, float) and math.isfinite(amount) and amount >= 0):
        return f"value is {amount!r}, a finite number from 0 is needed"
    if step and abs(amount / step - round(amount / step)) > 1e-6:
        return f"value is {amount!r}, {'a whole number' if step == 1 else f'a multiple of {step}'} is needed"
    return ""


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


_BARRIER = re.compile(rf"^{re.escape(BARRIER)}[1-9][0-9]*$")
"""A barrier says from how many tiles on it holds."""


def _cost_tables(
    raw: Mapping[str, Any], cores: str, faults: Faults
) -> tuple[tuple[EnergyTable, ...], tuple[TimeTable, ...]]:
    """Energy tables and time tables, as far as they are sound."""
    events = CROSSBAR_EVENTS if cores == CROSSBARS else EVENTS
    energy, time = [], []
    for key, title, table in _tables(raw, "energy", faults):
        prices = _section(
            f"energy.{key}",
            table,
            faults,
            lambda event: (POWER_UNIT if event == FLOOR else PRICE_UNIT, 0),
            required=events[:1] if cores == CROSSBARS else (),
            allowed=events,
        )
        found = {event: Quantity(**entry) for event, entry in prices.items()}
        energy.append(EnergyTable(name=key, title=title, prices=found))
    required, allowed = (*LATENCIES, LINK_BUFFER, f"{BARRIER}1"), (*LATENCIES, LINK_BUFFER, f"{BARRIER}N")
    for key, title, table in _tables(raw, "time", faults):
        entries = _section(
            f"time.{key}",
            table,
            faults,
            lambda event: ("", 1) if event == LINK_BUFFER else (TIME_UNIT, 1 / PICOSECONDS),
            required=required,
            allowed=allowed,
        )
        if set(required) <= entries.keys():
            found = {event: Quantity(**entry) for event, entry in entries.items()}
            barriers = {int(rule[len(BARRIER) :]): found[rule] for rule in found if rule.startswith(BARRIER)}
            latencies = {event: found[event] for event in LATENCIES}
            time.append(
                TimeTable(name=key, title=title, latencies=latencies, barriers=barriers, link_buffer=found[LINK_BUFFER])
            )
    return tuple(energy), tuple(time)


def _tables(raw: Mapping[str, Any], kind: str, faults: Faults) -> Iterator[tuple[str, str, Entry]]:
    """Key, title and entries of each table of a kind."""
    for key, table in raw.get(kind, {}).items() if isinstance(raw.get(kind, {}), dict) else [("", None)]:
        if not isinstance(table, dict) or not isinstance(table.get("title"), str):
            faults.append(f"{kind}.{key}: lacks its title; give title and entries")
        else:
            yield key, table["title"], {name: entry for name, entry in table.items() if name != "title"}
