"""How results and progress reach a terminal."""

from __future__ import annotations

import os
import sys


def progress(label: str) -> None:
    """Say on a terminal what is being done; an empty label wipes the line."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{label} …" if label else "\r\x1b[K")
        sys.stderr.flush()


def show(text: str) -> None:
    """Write a result to standard output; a reader that goes away early (``| head``) is no mistake.

    Letters that the terminal's encoding lacks become question marks.

    Raises
    ------
    OSError
        If the output cannot take the text, for example on a full disk.
    """
    encoding = sys.stdout.encoding or "utf-8"
    try:
        sys.stdout.write(text.encode(encoding, "replace").decode(encoding) + "\n")
        sys.stdout.flush()
    except OSError as error:
        # Python flushes again when it ends, and would complain again: let that go nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise OSError(error.errno, error.strerror, "standard output") from error
