"""How results and progress reach a terminal."""

import errno
import os
import sys
import time

from spikeloom.compiler.files import one_line, plain
from spikeloom.models.progress import lines_wanted, say


def progress(label: str) -> None:
    """Say what is being done, on a terminal or to a program; an empty label wipes the line."""
    if lines_wanted():
        if label:
            say(label)
    elif sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{plain(label)} …" if label else "\r\x1b[K")
        sys.stderr.flush()


def tell(text: str) -> None:
    """Say something to people, in one line on standard error."""
    sys.stderr.write(f"spikeloom: {one_line(text)}\n")


class Progress:
    """Says how many of `total` parts of some work are done, and how long the others will take."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._begun = time.perf_counter()

    def __call__(self, done: int, label: str = "running") -> None:
        """So many are done; the `label` is of the next."""
        spent = time.perf_counter() - self._begun
        left = round(spent * (self._total - done) / done) if done else 0
        if lines_wanted():
            say(label, done=done, total=self._total, left_s=left if done else None)
            return
        ahead = f", {left // 60}:{left % 60:02} left" if left else ""
        progress(f"{label}: {done} of {self._total}{ahead}" if self._total > 1 else label)


def show(text: str) -> None:
    """Write a result to standard output; a reader that goes away early (``| head``) is no mistake.

    Control characters are escaped, letters that the terminal's encoding lacks become question marks.
    Raises OSError if the output cannot take the text, for example on a full disk.
    """
    if sys.stdout is None:  # closed before we began
        raise OSError(errno.EBADF, "is closed", "standard output")
    encoding = sys.stdout.encoding or "utf-8"
    try:
        sys.stdout.write(plain(text).encode(encoding, "replace").decode(encoding) + "\n")
        sys.stdout.flush()
    except OSError as error:
        # Python flushes again when it ends, and would complain again: let that go nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise OSError(error.errno, error.strerror, "standard output") from error
