"""Chips as data: every number of a target stands once, in its TOML file, with unit and source."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from compiler.errors import OptionError

_NOT_MODELLED = {
    "loihi2": "not modelled; no public per-event energies",
    "truenorth": "not modelled; its additive leak cannot express a multiplicative decay",
}

PRICE_UNIT = "pJ"

LIMITS = (
    *(f"core.{what}" for what in ("compartments", "axons_in", "axons_out", "synapse_words", "threshold_slots")),
    *("core.synapse_formats", "core.compartment_configs", "core.dense_base", "chip.cores"),
    *("synapse.block", "synapse.block_header_bits", "synapse.word_bits"),
    *("mesh.tile_cores", "mesh.width", "mesh.height"),
)
"""What a target must limit."""

CHOICES = ("synapse.weight_bits", "synapse.index_bits", "synapse.exponent")
"""Of what a target must list the permitted values."""

EVENTS = (
    *("synaptic_operation", "synaptic_operation_dense", "synaptic_operation_sparse", "neuron_idle", "neuron_active"),
    *("spike", "packet", "hop_east_west", "hop_north_south"),
)
"""What an energy table may price."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """One number of a target, with its unit and where it was read."""

    value: float
    unit: str
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EnergyTable:
    """Prices per event in joules; an event without an entry is unknown to this table."""

    name: str
    title: str
    prices: Mapping[str, Quantity]

    def joule(self, event: str) -> float:
        """Price of one `event` in joules; KeyError if the table does not know it."""
        return self.prices[event].value * 1e-12  # PRICE_UNIT


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A chip: integer limits, permitted values and named energy tables."""

    name: str
    title: str
    limits: Mapping[str, Quantity]
    choices: Mapping[str, tuple[int, ...]]
    energy: tuple[EnergyTable, ...]

    def limit(self, rule: str) -> int:
        """Largest amount that `rule`, for example ``core.axons_in``, allows."""
        return int(self.limits[rule].value)


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
    faults += [f"{name}: unknown key {key!r}, allowed are {', '.join(keys)}" for key in entry if key not in keys]
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
    path = Path(path)
    try:
        raw = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise OptionError(f"{path}: cannot be read ({error.strerror or error}); give a target file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{path}: is not TOML ({error}); mend it") from error
    faults = _head_faults(raw)
    limits = _rules(raw, "limits", "value", LIMITS, faults)
    choices = _rules(raw, "choices", "values", CHOICES, faults)
    energy = raw.get("energy", {})
    prices = _prices(energy, faults)
    if faults:
        raise OptionError("\n".join(f"{path}: {fault}" for fault in faults))
    return Target(
        name=raw["name"],
        title=raw["title"],
        limits={rule: Quantity(**entry) for rule, entry in limits.items()},
        choices={rule: tuple(entry["values"]) for rule, entry in choices.items()},
        energy=tuple(
            EnergyTable(
                name=key,
                title=energy[key]["title"],
                prices={event: Quantity(**price) for event, price in found.items()},
            )
            for key, found in prices.items()
        ),
    )


def _head_faults(raw: Mapping[str, Any]) -> list[str]:
    known = ("name", "title", "limits", "choices", "energy")
    faults = [f"{key}: is missing" for key in known if key not in raw]
    faults += [f"unknown key {key!r}, allowed are {', '.join(known)}" for key in raw if key not in known]
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


def _prices(energy: Any, faults: list[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Prices by table and event."""
    prices: dict[str, dict[str, dict[str, Any]]] = {}
    for key, table in energy.items() if isinstance(energy, dict) else [("", energy)]:
        if not isinstance(table, dict) or not isinstance(table.get("title"), str):
            faults.append(f"energy.{key}: lacks its title; give title and prices")
            continue
        entries = {event: price for event, price in table.items() if event != "title"}
        prices[key] = _entries(entries, "value", "", faults)
        for event, price in prices[key].items():
            where = f"energy.{key}.{event}"
            _check_entry(where, price, "value", faults)
            if event not in EVENTS:
                faults.append(f"{where}: unknown event, allowed are {', '.join(EVENTS)}")
            if isinstance(price.get("unit"), str) and price["unit"] != PRICE_UNIT:
                faults.append(f"{where}: unit is {price['unit']!r}, allowed is {PRICE_UNIT!r}")
    return prices


def known_targets() -> tuple[str, ...]:
    """Names that :func:`load_target` accepts, sorted."""
    files = resources.files(__name__).iterdir()
    return tuple(sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml")))


@cache
def load_target(name: str) -> Target:
    """Read a target by name.

    Raises
    ------
    OptionError
        If there is no such target.

    Examples
    --------
    >>> load_target("loihi1").limit("core.synapse_words")
    16384
    """
    if name not in known_targets():
        why = _NOT_MODELLED.get(name, "unknown")
        raise OptionError(f"--target {name}: {why}; allowed: {', '.join(known_targets())}")
    with resources.as_file(resources.files(__name__) / f"{name}.toml") as file:
        return read_target(file)
