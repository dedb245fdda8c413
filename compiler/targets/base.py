"""Chips: what a chip is, and the registry that finds each by its folder.

A target is a folder with ``chip.toml``, every number once with unit and source, and a module ``passes`` with ``PASSES``
(from what is trained to a netlist), ``Options`` and ``start(source, options, target)``, which gives what the passes
begin with and those that are due. Nothing else knows which chips there are.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from spikeloom.compiler import targets
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.pipeline import Passes, run
from spikeloom.compiler.targets.chip_file import COMPARTMENTS, CROSSBARS, Numbers, read_cost_tables, read_numbers
from spikeloom.compiler.targets.price_tables import PICOSECONDS, EnergyTable, Quantity, TimeTable

__all__ = [
    "COMPARTMENTS",
    "CROSSBARS",
    "PICOSECONDS",
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Target(Numbers):
    """A chip: its numbers, and how a network is compiled for it."""

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
        """Lower what is trained to a compilation of the chip, with the result as ``netlist``.

        `after` is called with the name of each pass and all that was made so far. SpikeloomError as the passes say.
        """
        module = self.module
        work, passes = module.start(source, module.Options() if options is None else options, self)
        return run(passes, work, after)


def read_target(path: str | os.PathLike[str]) -> Target:
    """Read and check a target file; OptionError if it cannot be read or entries are wrong, with a line for each."""
    return read_numbers(path, Target)


def with_tables(target: Target, name: str) -> Target:
    """Choose the tables that price and time a run: of the target by `name`, or of a TOML file of that name.

    The file has ``[energy.NAME]`` or ``[time.NAME]`` sections as a target file has; what it lacks stays the target's.
    OptionError if there is no such table, or with a line for each fault of the file.
    """
    energy = tuple(table for table in target.energy if table.name == name)
    time = tuple(table for table in target.time if table.name == name)
    if not energy and not time:
        if not name.endswith(".toml"):
            names = sorted({table.name for table in target.energy} | {table.name for table in target.time})
            raise OptionError(f"--table {name}: unknown; allowed: {', '.join(names)}, or a file that ends in .toml")
        energy, time = read_cost_tables(name, target.cores)
    return replace(target, energy=energy or target.energy, time=time or target.time)


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
