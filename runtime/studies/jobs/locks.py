"""Keep a second process away from a file that one is working on."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from spikeloom.compiler.errors import OptionError


def lock(file: IO[Any], refusal: str) -> None:
    """Take the lock of an open file; it goes with the process, however that ends.

    Where the system or the file system has no locks, nobody is kept away.

    Raises
    ------
    OptionError
        With the text `refusal`, if another process has it.
    """
    try:
        import fcntl
    except ImportError:  # not on Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OptionError(refusal) from None
    except OSError:  # a network's file system without locks
        return


@contextmanager
def only_one(output: Path) -> Iterator[None]:
    """Be the only process that works on `output`; ``NAME.lock`` beside it says so, and is removed in the end.

    Raises
    ------
    OptionError
        If another one works on it.
    OSError
        If the folder cannot be written.
    """
    path = output.with_name(f"{output.name}.lock")
    refusal = f"{output}: another process is working on it; wait for that one, or give another -o"
    while True:
        with path.open("ab") as file:
            lock(file, refusal)
            if not _is_at(path, file):  # whoever had it removed the file meanwhile
                continue
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _is_at(path: Path, file: IO[Any]) -> bool:
    with suppress(FileNotFoundError):
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    return False
