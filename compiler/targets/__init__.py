"""Chips as data: every number of a target stands once, in its TOML file, with unit and source."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

from compiler.errors import OptionError

_NOT_MODELLED = {
    "loihi2": "not modelled; no public per-event energies",
    "truenorth": "not modelled; its additive leak cannot express a multiplicative decay",
}


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
        return self.prices[event].value * 1e-12


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


def _flatten(table: Mapping[str, Any], leaf: str, prefix: str = "") -> dict[str, dict[str, Any]]:
    flat: dict[str, dict[str, Any]] = {}
    for key, entry in table.items():
        if leaf in entry:
            flat[prefix + key] = entry
        else:
            flat |= _flatten(entry, leaf, f"{prefix}{key}.")
    return flat


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
    raw = tomllib.loads((resources.files(__name__) / f"{name}.toml").read_text("utf-8"))
    tables = tuple(
        EnergyTable(
            name=key,
            title=table["title"],
            prices={event: Quantity(**price) for event, price in table.items() if event != "title"},
        )
        for key, table in raw["energy"].items()
    )
    return Target(
        name=raw["name"],
        title=raw["title"],
        limits={rule: Quantity(**entry) for rule, entry in _flatten(raw["limits"], "value").items()},
        choices={rule: tuple(entry["values"]) for rule, entry in _flatten(raw["choices"], "values").items()},
        energy=tables,
    )
