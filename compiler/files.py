"""Write a file whole or not at all, read one of a network within limits, and know it again by its hash."""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import BinaryIO

from spikeloom.compiler.errors import ModelError

SIZE_LIMIT = 2**28
"""Bytes that the file of a trained network may have: 256 MiB, a hundred times the released ones."""

RANDOM = 8
"""Letters that are drawn for a name."""


@contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a new file beside `path`; rename it onto `path` when the block ends well.

    Whatever stops the block (an error, a full disk, an interrupt) leaves an existing `path` as it was and no
    half-written file behind. A file that is replaced hands its permissions on; of a link the target is replaced.
    OSError if the folder does not exist or cannot be written, or the disk is full; its ``filename`` is `path`, unless
    the block raised it for another file.
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
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(part)):
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def remove_leftovers(path: str | os.PathLike[str]) -> None:
    """Remove what a killed process left half-written beside `path`; for a `path` that nobody else is writing."""
    path = Path(path).resolve()
    for file in path.parent.glob(f".{escape(path.name)}.{'?' * RANDOM}.part"):
        file.unlink(missing_ok=True)


def beside(path: Path) -> Path:
    """A new name for what is to become `path`; known before the file is, so that a signal can never lose it."""
    return path.parent / f".{path.name}.{secrets.token_hex(RANDOM // 2)}.part"


def sha256_of(path: str | os.PathLike[str]) -> str:
    """Hex sha256 of a file's content."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_whole(path: Path, what: str, remedy: str) -> bytes:
    """Content of the file of a network; ModelError, without the path, if it is missing, unreadable or too large.

    Messages say `what` it should be, and the `remedy`.
    """
    if not path.is_file():
        raise ModelError(f"{'is not a file' if path.exists() else 'no such file'}; {remedy}")
    try:
        with path.open("rb") as file:
            content = file.read(SIZE_LIMIT + 1)
    except OSError as error:
        raise ModelError(f"cannot be read ({error.strerror or error}); check its permissions") from error
    require_size(len(content), what, remedy)
    return content


def require_size(size: int, what: str, remedy: str) -> None:
    """Refuse more bytes than the file of a network may have: ModelError, without the path."""
    if size > SIZE_LIMIT:
        raise ModelError(f"more than {SIZE_LIMIT} bytes, the limit of a {what}; {remedy}")
