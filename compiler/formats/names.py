"""Names from files and for files: how a message shows them, and what other programs accept."""

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import FileFault


@contextmanager
def named(where: object) -> Iterator[None]:
    """Put the part of a file in front of an error of what is done; what libraries raise becomes a FileFault."""
    try:
        yield
    except (MemoryError, OptionError):
        raise
    except (ModelError, FileFault) as error:
        raise type(error)(f"{where}: {error}") from error
    except Exception as error:
        raise FileFault(f"{where}: cannot be used ({type(error).__name__}: {error})") from error


def printable(name: str) -> str:
    """Name as a message can show it: quoted, escaped and cut where it is long or not printable."""
    return name if name.isprintable() and len(name) < 100 else repr(name[:100])


def plain_names(names: Sequence[str], taken: Collection[str] = ()) -> tuple[str, ...]:
    """Names of letters, digits and underscores; one that is not unique, or taken, gets its place as a suffix.

    >>> plain_names(["a.b", "input", "fc", "fc"], taken=["input"])
    ('a_b', 'input_1', 'fc_2', 'fc_3')
    """
    plain = [re.sub(r"\W", "_", name, flags=re.ASCII) for name in names]
    unique = list[str]()
    for place, name in enumerate(plain):
        free = name if plain.count(name) == 1 and name not in taken else f"{name}_{place}"
        while free in {*taken, *unique, *plain[place + 1 :]}:
            free += "_"
        unique.append(free)
    return tuple(unique)


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names, or ``layer1`` … for those that are empty, long or not unique.

    >>> unique_names(["conv", "", "fc", "fc"])
    ('conv', 'layer2', 'layer3', 'layer4')
    """
    usable = [
        name if names.count(name) == 1 and len(name) < 40 and name.isprintable() else "" for name in names
    ]
    return tuple(name or f"layer{place}" for place, name in enumerate(usable, 1))
