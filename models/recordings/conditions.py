"""Conditions under which recordings were made: columns of a table, or fields of file names, such as speed and force."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings

MOST = 8
"""Conditions of a group that are left out one by one; more are left out together, in `PARTS`."""

PARTS = 5


def field_of(name: str, field: str) -> str | None:
    """Value of a field in a file name: what follows its name, up to the next underscore or hyphen.

    >>> field_of("texture00_speed3600_force0.5.npz", "force"), field_of("grasp_3.csv", "speed")
    ('0.5', None)
    """
    match = re.search(rf"(?:^|[_-]){re.escape(field)}=?([^_-]+)", PurePath(name).stem)
    return None if match is None else match[1]


def fields_in(name: str) -> list[str]:
    """Fields of a file name, as a name that keeps them has them.

    >>> fields_in("texture00_speed3600_force=0.5_label_3.npz"), fields_in("grasp_3_label_1.csv")
    (['texture00', 'speed3600', 'force=0.5'], [])
    """
    parts = re.split("[_-]", PurePath(name).stem)
    return [part for part in parts if re.fullmatch(r"[A-Za-z]+(=[A-Za-z0-9.]+|[0-9][0-9.]*)", part)]


def groups_of(
    source: str, files: Sequence[str], rows: Sequence[dict[str, str]], wanted: Sequence[str] | None
) -> dict[str, tuple[str, ...]]:
    """Value of each recording in each group, from its row of a table or from its name.

    Without `wanted` groups, all columns that every row has. DataError names the first recording without a value.
    """
    if wanted is None:
        filled = [{name for name, value in row.items() if value} for row in rows]
        shared = set.intersection(*filled) if filled else set()
        wanted = [name for name in (rows[0] if rows else ()) if name in shared]
    groups = {}
    for group in wanted:
        values = [row.get(group) or field_of(file, group) for file, row in zip(files, rows, strict=True)]
        if None in values:
            file = files[values.index(None)]
            raise DataError(
                f"{source}: {file}: has no {group}; --groups names columns of recordings.csv, or fields of file "
                f"names as in {group}3_label_7.csv"
            )
        groups[group] = tuple(map(str, values))
    return groups


def group_notes(source: str, rows: Sequence[dict[str, str]]) -> list[str]:
    """Columns of a table in which only some of its rows have a value."""
    notes = []
    listed = [row for row in rows if row]
    for name in listed[0] if listed else ():
        without = sum(not row.get(name) for row in listed)
        if 0 < without < len(listed):
            notes.append(f"{source}: {without} of {len(listed)} recordings have no {name}: no condition")
    return notes


def conditions(data: Recordings) -> dict[str, dict[str, BoolArray]]:
    """For each group with several values: recordings (samples,) by condition, such as ``speed=3600``.

    Many values are dealt into `PARTS` conditions.
    """
    known = {}
    for group, values in data.groups.items():
        names = sorted(set(values), key=_numbers_first)
        if len(names) < 2:
            continue
        place: IntArray = np.array([names.index(value) for value in values])
        if len(names) > MOST:
            place %= PARTS
            names = [f"part {part + 1} of {PARTS}" for part in range(PARTS)]
        known[group] = {f"{group}={name}": place == index for index, name in enumerate(names)}
    return known


def by_condition(data: Recordings) -> dict[str, BoolArray]:
    """Recordings (samples,) of every condition of every group, by its name."""
    return {name: held for parts in conditions(data).values() for name, held in parts.items()}


def with_groups(data: Recordings, wanted: Sequence[str] | None) -> Recordings:
    """Recordings with the `wanted` groups alone; all that they have, where None. DataError as of :func:`groups_of`."""
    if wanted is None:
        return data
    rows = [{name: values[index] for name, values in data.groups.items()} for index in range(len(data))]
    return replace(data, groups=groups_of(data.source, data.files, rows, wanted))


def _numbers_first(value: str) -> tuple[bool, float, str]:
    try:
        return False, float(value), value
    except ValueError:
        return True, 0.0, value
