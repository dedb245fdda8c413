"""Event lines ``time_s,taxel,polarity`` from a file, a pipe or a terminal, one by one as they arrive.

The form is that of :mod:`eventfiles`, so that any such CSV file can be watched: a header may name the
columns in another order, a fourth column ``label`` is passed over, and what follows a ``#`` does not count.
Here an empty line means something, though: the end of a grasp, after which a header may come again.
"""

import enum
import io
import select
import time
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation

from spikeloom.compiler.errors import DataError

MAX_TIME_S = 10**12
MAX_LINE_BYTES = 1000
COLUMNS = ["time_s", "taxel", "polarity"]
LABEL = "label"
GIVE = "give one event 'time_s,taxel,polarity' a line"


class Mark(enum.Enum):
    """What can come that is no event."""

    END_OF_GRASP = enum.auto()
    END_OF_STREAM = enum.auto()


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One line: seconds, and the input channel."""

    time_s: Decimal
    channel: int


class EventLines:
    """Lines of an unbuffered file of that `name`, a pipe or a terminal, parsed one by one as they arrive."""

    def __init__(self, file: io.FileIO, name: str, taxels: int) -> None:
        self._file = file
        self._name = name
        self._taxels = taxels
        self._buffer = bytearray()
        self._ended = False
        self._number = 0
        self._header_allowed = True
        self._order = [0, 1, 2]  # where the columns stand
        self._widths = [3, 4]  # numbers of columns that a line may have
        self._low: int | None = None  # the code of the falling polarity, once there was one

    def read(self, deadline: float | None = None) -> Event | Mark | None:
        """What comes next, or None if nothing came until `deadline` on the monotonic clock.

        DataError if a line is nothing that may stand in one.
        """
        while self._arrived(deadline):
            if not self._buffer:
                return Mark.END_OF_STREAM
            line = self._line()
            if line in ("", "reset"):
                self._header_allowed = True
                return Mark.END_OF_GRASP
            header = self._header_allowed and self._is_header(line)
            content, _, _ = line.partition("#")
            self._header_allowed &= not (header or content)
            if content and not header:
                return self._event(content)
        return None

    def _arrived(self, deadline: float | None) -> bool:
        """Wait for a line, or the end; return whether there is one."""
        while not self._ended and b"\n" not in self._buffer:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not select.select([self._file], [], [], left)[0]:
                return False
            if len(self._buffer) > MAX_LINE_BYTES:
                self._number += 1
                raise self.complain(f"longer than {MAX_LINE_BYTES} bytes", GIVE)
            more = self._file.read(MAX_LINE_BYTES)
            self._ended = not more
            self._buffer += more
        return True

    def _line(self) -> str:
        """Take a line from what has arrived."""
        end = self._buffer.find(b"\n")
        raw = bytes(self._buffer[:end] if end >= 0 else self._buffer)
        del self._buffer[: len(raw) + 1]
        self._number += 1
        return raw.decode("utf-8", "replace").removeprefix("\ufeff").strip()

    def complain(self, found: str, remedy: str) -> DataError:
        """Error of the line that was read last."""
        return DataError(f"{self._name}, line {self._number}: {found}; {remedy}")

    def _is_header(self, line: str) -> bool:
        """Whether a line, perhaps a comment, names the columns; if so, note where they stand."""
        names = [name.strip().lower() for name in line.lstrip("# \t").split(",")]
        if sorted(name for name in names if name != LABEL) != sorted(COLUMNS) or names.count(LABEL) > 1:
            return False
        self._order = [names.index(name) for name in COLUMNS]
        self._widths = [len(names)]
        return True

    def _event(self, content: str) -> Event:
        """Read an event."""
        fields = [field.strip() for field in content.split(",")]
        try:
            if len(fields) not in self._widths:
                raise ValueError
            fields = [fields[column] for column in self._order]
            time_s, taxel, polarity = (Decimal(field) for field in fields)
        except (ValueError, InvalidOperation):
            raise self.complain(f"{content[:60]!r} found", f"{GIVE}, three numbers, or reset") from None
        if not time_s.is_finite() or not 0 <= time_s <= MAX_TIME_S:
            raise self.complain(f"time {fields[0]} found, allowed are 0 to {MAX_TIME_S:.0e}", "give seconds")
        if not taxel.is_finite() or not 0 <= taxel < self._taxels or taxel % 1:
            raise self.complain(
                f"taxel {fields[1]} found, allowed are 0 to {self._taxels - 1}",
                "use events of the sensor that the network was compiled for",
            )
        if not polarity.is_finite() or polarity not in (-1, 0, 1):
            raise self.complain(f"polarity {fields[2]} found", "write 0 and 1, or -1 and 1")
        if polarity != 1:
            if self._low is not None and self._low != polarity:
                raise self.complain(
                    f"polarity {fields[2]} found after polarity {self._low}",
                    "write 0 and 1, or -1 and 1, not both",
                )
            self._low = int(polarity)
        return Event(time_s=time_s, channel=2 * int(taxel) + (polarity == 1))
