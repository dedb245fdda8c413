"""While this folder is on Python's path, every process imports this file; it notes what the process opens to read."""

import os
import sys

LOG = os.open(os.environ["SPIKELOOM_TRACE"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
SEEN: set[str] = set()
WRITES = os.O_WRONLY | os.O_RDWR


def note(event: str, arguments: tuple[object, ...]) -> None:
    """An audit hook of the interpreter."""
    if event != "open":
        return
    path, _, flags = arguments
    if not isinstance(path, (str, os.PathLike)) or (isinstance(flags, int) and flags & WRITES):
        return
    name = os.path.abspath(os.fspath(path))  # noqa: PTH100 (pathlib is not imported in every process)
    if name not in SEEN:
        SEEN.add(name)
        os.write(LOG, os.fsencode(name) + b"\n")


sys.addaudithook(note)
