"""Classes of recordings, as people write them: numbers from 0, or names; by one rule in tables, files and file names.

Where all recordings have numbers, these are their labels. Names are numbered in plain alphabetical order. What trains
a network numbers its classes without gaps, and the network remembers what they were called.
"""

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings

MAX_DIGITS = 6

_OTHER = re.compile(r"[+-]?([0-9.]+(e[+-]?[0-9]+)?|nan|inf(inity)?)", re.IGNORECASE)
"""Numbers that no class has."""

_IN_NAME = re.compile(r"_label_([0-9]{1,6}(?![0-9])|[A-Za-z][A-Za-z0-9+-]*)")


def class_in_name(name: str) -> str | None:
    """Class in a file name, if there is one.

    >>> class_in_name("sample_12_label_03.npy"), class_in_name("run_label_cork_left.csv"), class_in_name("grasp.csv")
    ('3', 'cork', None)
    """
    match = _IN_NAME.search(name)
    return None if match is None else class_of(match[1])


def class_of(text: str) -> str | None:
    """A class as it was written: a number without leading zeros, or a name; None where it is another number, or empty.

    >>> class_of("07"), class_of("cork 2"), class_of("-1"), class_of("1.5"), class_of("")
    ('7', 'cork 2', None, None, None)
    """
    text = " ".join(text.split())  # a line break would tear what names it
    if is_number(text):
        return str(int(text))
    return None if not text or _OTHER.fullmatch(text) else text


def is_number(text: str) -> bool:
    """Whether a class is a number."""
    return text.isascii() and text.isdigit() and len(text) <= MAX_DIGITS


def numbered(
    classes: Sequence[str | None], others: Iterable[str], names: Sequence[str] | None, source: str
) -> tuple[IntArray, tuple[str, ...] | None]:
    """Labels of recordings of these classes, (samples,), and the names that they stand for, if any.

    `others` are classes that are known beside them; `names` are those of a network, which are then all there are.
    DataError where numbers and names are mixed, or a class is not among the names.
    """
    found = {*classes, *others} - {None}
    if names is None:
        numbers = {name for name in found if name is not None and is_number(name)}
        if numbers and numbers != found:
            raise DataError(
                f"{source}: classes {min(numbers)!r} and {min(found - numbers, key=str)!r}; give numbers from 0, or "
                "names, to all recordings"
            )
        names = None if numbers or not found else sorted(filter(None, found))
    elif unknown := [each for each in classes if each is not None and each not in names]:
        raise DataError(f"{source}: class {unknown[0]!r}, the network knows {listed(names)}")
    if names is None:
        labels = [UNLABELLED if each is None else int(each) for each in classes]
    else:
        place = {name: index for index, name in enumerate(names)}
        labels = [UNLABELLED if each is None else place[each] for each in classes]
    return np.array(labels, np.int64), None if names is None else tuple(names)


def listed(names: Collection[str]) -> str:
    """Some names for a message."""
    few = list(names)[:12]
    return ", ".join(few) + (f" and {len(names) - len(few)} more" if len(names) > len(few) else "")


def renamed(data: Recordings, names: Sequence[str] | None) -> Recordings:
    """The same recordings with classes numbered as in `names`, or by their own numbers where None."""
    classes = [None if label == UNLABELLED else data.class_name(label) for label in data.labels.tolist()]
    labels, names = numbered(classes, (), names, data.source)
    return replace(data, labels=labels, names=names)


def without_gaps(*splits: Recordings) -> list[Recordings]:
    """Splits whose classes, those that any of them has, are numbered from 0 on; others than such numbers are names."""
    known = {
        data.class_name(label) for data in splits for label in data.labels.tolist() if label != UNLABELLED
    }
    numbers = sorted(filter(is_number, known), key=int)
    if numbers and len(numbers) < len(known):
        mixed = min(known.difference(numbers))
        raise DataError(
            f"{splits[0].source}: classes {numbers[0]!r} and {mixed!r}; give numbers, or names, to all"
        )
    names = numbers or sorted(known)
    plain = names == [str(index) for index in range(len(names))]
    return [renamed(data, None if plain else names) for data in splits]
