"""Write a file whole or not at all, read one within limits, say in one line what is wrong about it."""

import hashlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import BinaryIO

from spikeloom.compiler.errors import OptionError, SpikeloomError

SIZE_LIMIT = 2**28
"""Bytes that the file of a trained network may have: 256 MiB, a hundred times the released ones."""

MOST_SAID = 300
"""Maximum length of a message about a file, without the folders before its name."""

MOST_FOLDERS = 1000
"""Letters of the folders in a message that do not count."""

RANDOM = 8
"""Random hex digits in the name of a file that is still being written."""

WRITTEN: dict[str, None] = {}
"""Files that this process has written, in that order."""


@contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a new file beside `path`; rename it onto `path` when the block ends well.

    Whatever stops the block (an error, a full disk, an interrupt) leaves an existing `path` as it was and no
    half-written file behind. A file that is replaced hands its permissions on; of a link the target is
    replaced. OSError if the folder does not exist or cannot be written, or the disk is full; its
    ``filename`` is `path`, unless the block raised it for another file.
    """
    target = Path(path).resolve()
    part = beside(target)
    try:
        with part.open("xb") as file:
            if target.exists():
                part.chmod(stat.S_IMODE(target.stat().st_mode))
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(target)
        WRITTEN[str(path)] = None
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(part)):
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def remove_leftovers(path: str | os.PathLike[str]) -> None:
    """Remove what a killed process left half-written beside `path`, or in a folder; for what nobody else is writing."""
    path = Path(path).resolve()
    folder, name = (path, "*") if path.is_dir() else (path.parent, escape(path.name))
    for file in folder.glob(f".{name}.{'?' * RANDOM}.part"):
        if file.is_dir() and not file.is_symlink():
            shutil.rmtree(file)
        else:
            file.unlink(missing_ok=True)


def beside(path: Path) -> Path:
    """A new name for what is to become `path`; known before the file is, so that a signal can never lose it."""
    return path.parent / f".{path.name}.{secrets.token_hex(RANDOM // 2)}.part"


def sha256_of(path: str | os.PathLike[str]) -> str:
    """Hex sha256 of a file's content."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class FileFault(SpikeloomError):  # noqa: N818 - the file's, no error of the program
    """What is wrong about a file; :func:`reading` adds its name and the remedy."""


@contextmanager
def reading(where: object, error: type[SpikeloomError], remedy: str) -> Iterator[None]:
    """Turn whatever is raised while a file is read into one line of at most `MOST_SAID` letters: name, fault, remedy.

    A :class:`FileFault`, and all that parsing libraries raise, becomes an `error`; other errors of ours keep
    their kind and words, those about options pass.
    """
    try:
        yield
    except (MemoryError, OptionError):
        raise
    except Exception as found:
        kind = error
        said = f"is truncated or damaged, or something else ({type(found).__name__}: {found}); {remedy}"
        if isinstance(found, FileFault):
            said = f"{found}; {remedy}"
        elif isinstance(found, SpikeloomError):
            kind = type(found)
            said = str(found)
        elif isinstance(found, OSError) and found.strerror:
            said = f"cannot be read ({found.strerror}); check its permissions"
        named = re.sub(r"^\S*/", "", str(where))  # with the member of an archive
        raise kind(f"{where}: {_shortened(said, MOST_SAID - 2 - len(named))}") from found


def _shortened(said: str, room: int) -> str:
    """A message in one line, its middle left out where it is long: the end is the remedy."""
    said = plain(" ".join(said.split()))
    return said if len(said) <= room else f"{said[: max(room // 2, 60)]} … {said[-max(room // 2 - 3, 60) :]}"


def one_line(text: str) -> str:
    r"""A message to people, whatever names of files put in it: in one line of `MOST_SAID` letters, folders aside.

    >>> len(one_line("a" * 999)), len(one_line("b" * 9 + "/a")), one_line("a\nspikeloom: warning: b")
    (300, 11, 'a spikeloom: warning: b')
    """
    said = " ".join(plain(text).split())
    folders = sum(map(len, re.findall(r"\S*/", said)))
    room = MOST_SAID + min(folders, MOST_FOLDERS)
    return _shortened(said, room)


def plain(text: str) -> str:
    r"""Text that a terminal only shows: control characters of a name, say, are escaped, line breaks stay.

    >>> print(plain("\x1b[2Jgrasp ä.csv"))
    \x1b[2Jgrasp ä.csv
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def read_whole(path: Path, what: str, limit: int | None = None) -> bytes:
    """Content of a file; FileFault, with `what` it should be, if it is missing, no file or too large."""
    if not path.is_file():
        raise FileFault("is not a file" if path.exists() else "no such file")
    with path.open("rb") as file:
        content = file.read((limit or SIZE_LIMIT) + 1)
    require_size(len(content), what, limit)
    return content


def require_size(size: int, what: str, limit: int | None = None) -> None:
    """Refuse more bytes than a file may have, by default one of a network: FileFault."""
    if size > (limit or SIZE_LIMIT):
        raise FileFault(f"more than {limit or SIZE_LIMIT} bytes, the limit of a {what}")
