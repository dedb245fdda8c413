"""Fetch the released recordings, once, and find them again by name.

What arrives grows in a ``.part`` file, from which a later attempt goes on. The final name appears by renaming, after
size and SHA-256 were found to be those of the released file; whatever a server does, nothing else gets that name.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from spikeloom.compiler.errors import DataError, OptionError

_REPOSITORY = "https://raw.githubusercontent.com/clear-nus/TactileSGNet/master"

STALL_S = 30.0
"""A connection that brings less than `STALL_BYTES` in this time is given up; seconds."""

STALL_BYTES = 1024

MAX_ATTEMPTS = 5

_CHUNK = 1 << 16


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSet:
    """A released file.

    Parameters
    ----------
    file : str
        Its name.
    url : str
        Where its authors keep it.
    size : int
        Bytes.
    sha256 : str
        Of its content.
    """

    file: str
    url: str
    size: int
    sha256: str


DATA_SETS = {
    "objects": DataSet(
        file="Ev-Objects.zip",
        url=f"{_REPOSITORY}/Ev-Objects.zip",
        size=1_718_418,
        sha256="bd8e828064a85c4fc6567789283198ff0b92384ef58aeb2366fa36a963ded867",
    ),
    "containers": DataSet(
        file="Ev-Containers.zip",
        url=f"{_REPOSITORY}/Ev-Containers.zip",
        size=679_819,
        sha256="dc965e9425ca0060e0628ce8efe717c92a0b2e8f11163f4239569fc5434ab8e2",
    ),
}
"""The released recordings by name; a name is taken wherever a path to recordings is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fetched:
    """A data set on this machine.

    Parameters
    ----------
    path : Path
        The file.
    new : bool
        Whether it was transferred now; otherwise it was there.
    """

    path: Path
    new: bool


class _BrokenOffError(Exception):
    """The transfer stopped early; what arrived is kept."""


def data_folder() -> Path:
    """Folder of fetched data: SPIKELOOM_DATA, or ``spikeloom`` in the user's cache (XDG_CACHE_HOME, ~/.cache)."""
    chosen = os.environ.get("SPIKELOOM_DATA")
    if chosen:
        return Path(chosen)
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (cache if cache.is_absolute() else Path.home() / ".cache") / "spikeloom"


def find_data(name: str) -> Path:
    """Path of a data set that was fetched.

    Raises
    ------
    DataError
        If it was not, or is not the released file any more.
    OptionError
        If there is no data set of that name.
    """
    data = _known(name)
    path = data_folder() / data.file
    if not path.is_file():
        raise DataError(
            f"{name}: not on this machine (no {path}); run 'spikeloom data fetch {name}', "
            f"or write ./{name} for a folder of that name"
        )
    if not _is_released(path, data):
        raise DataError(f"{path}: not the released file; remove it and run 'spikeloom data fetch {name}'")
    return path


def fetch_data(
    name: str,
    *,
    url: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    stall_s: float = STALL_S,
    progress: Callable[[int, int], None] | None = None,
) -> Fetched:
    """Download a data set unless it is there.

    Parameters
    ----------
    name : str
        One of `DATA_SETS`.
    url : str, optional
        Another address of the same file, http or https.
    folder : path, optional
        Where to put it, made if needed; `data_folder` if left out.
    stall_s : float
        Patience with a silent connection, seconds.
    progress : callable, optional
        Called with (bytes so far, bytes in all).

    Raises
    ------
    DataError
        If the address does not serve the released file, or the transfer broke off `MAX_ATTEMPTS` times or without
        progress; the ``.part`` file then holds what arrived.
    OptionError
        If there is no such data set or the address is no web address.
    OSError
        If the folder cannot be written.
    """
    data = _known(name)
    url = url or data.url
    if not re.match(r"https?://[^/]", url):
        raise OptionError(f"--url {url}: not a web address; give one that starts with http:// or https://")
    folder = data_folder() if folder is None else Path(folder)
    path = folder / data.file
    if path.exists():
        if not _is_released(path, data):
            raise DataError(f"{path}: exists and is not the released file; move it away, or give another --dir")
        return Fetched(path=path, new=False)
    folder.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    for attempt in range(1, MAX_ATTEMPTS + 1):
        before = _size(part)
        try:
            _transfer(url, part, data.size, stall_s, progress)
        except _BrokenOffError as broken:
            arrived = _size(part)
            if arrived > before and attempt < MAX_ATTEMPTS:
                continue
            raise DataError(
                f"{url}: {broken} after {arrived} of {data.size} bytes; run the command again to go on from there"
            ) from broken
        if _is_released(part, data):
            part.replace(path)
            return Fetched(path=path, new=True)
        found = _sha256(part)
        part.unlink()
        if not before:
            break
        # The beginning came from an earlier run, perhaps from elsewhere: once more, from nothing.
    raise DataError(
        f"{url}: serves another file (sha256 {found}), the released one has {data.sha256}; give its address with --url"
    )


def _transfer(url: str, part: Path, size: int, stall_s: float, progress: Callable[[int, int], None] | None) -> None:
    """Complete `part` to `size` bytes."""
    if _size(part) > size:
        part.unlink()
    have = _size(part)
    if have == size:
        return
    response = _open(url, have, stall_s)
    if response is None:  # what we have is no beginning of what is served now
        part.unlink(missing_ok=True)
        have = 0
        response = _open(url, have, stall_s)
        if response is None:
            raise DataError(f"{url}: sends a part of the file unasked; give another address with --url")
    with response:
        if response.status != http.HTTPStatus.PARTIAL_CONTENT:
            have = 0  # the server sends it all again
        announced = response.headers.get("Content-Length", str(size - have))
        if announced != str(size - have):
            raise DataError(
                f"{url}: announces {_plain(announced)} bytes, {size - have} are expected; "
                "give the address of the released file"
            )
        with part.open("ab" if have else "wb") as file:
            for chunk in _chunks(response, size - have, stall_s):
                file.write(chunk)
                have += len(chunk)
                if progress is not None:
                    progress(have, size)
            file.flush()
            os.fsync(file.fileno())


def _open(url: str, have: int, stall_s: float) -> http.client.HTTPResponse | None:
    """Ask for what is missing; None if the answer does not begin there."""
    headers = {"User-Agent": "spikeloom", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
    try:
        request = urllib.request.Request(url, headers=headers)  # noqa: S310 -- fetch_data checked the scheme
        response: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=stall_s)  # noqa: S310
    except urllib.error.HTTPError as error:
        error.close()
        if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and have:
            return None
        raise DataError(
            f"{url}: the server answers {error.code} {_plain(error.reason)}; "
            "try later, or give another address with --url"
        ) from error
    except (OSError, http.client.HTTPException) as error:
        raise _BrokenOffError(_reason(error)) from error
    part_of_it = response.status == http.HTTPStatus.PARTIAL_CONTENT
    if part_of_it and not response.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
        response.close()
        return None
    return response


def _chunks(response: http.client.HTTPResponse, expected: int, stall_s: float) -> Iterator[bytes]:
    """Exactly the expected number of bytes, as they come."""
    patience, recent = time.monotonic() + stall_s, 0
    while expected:
        try:
            chunk = response.read1(min(_CHUNK, expected))
        except (OSError, http.client.HTTPException) as error:
            raise _BrokenOffError(_reason(error)) from error
        if not chunk:
            raise _BrokenOffError("the connection ended")
        expected, recent = expected - len(chunk), recent + len(chunk)
        yield chunk
        if time.monotonic() > patience:
            if recent < STALL_BYTES and expected:
                raise _BrokenOffError("the connection stalled")
            patience, recent = time.monotonic() + stall_s, 0


def _reason(error: Exception) -> str:
    """What broke a connection, in words."""
    cause = error.reason if isinstance(error, urllib.error.URLError) else error
    if isinstance(cause, TimeoutError):
        return "the connection stalled"
    return f"the connection failed ({_plain(getattr(cause, 'strerror', None) or str(cause) or type(cause).__name__)})"


def _plain(words: str) -> str:
    """What a server says, fit to print: one short line, no terminal codes."""
    return "".join(letter if letter.isprintable() else " " for letter in words[:80]).strip()


def _known(name: str) -> DataSet:
    if name not in DATA_SETS:
        raise OptionError(f"{name}: no such data set; allowed: {', '.join(DATA_SETS)}")
    return DATA_SETS[name]


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _is_released(path: Path, data: DataSet) -> bool:
    """Compare size first: a stranger may be large."""
    return path.is_file() and path.stat().st_size == data.size and _sha256(path) == data.sha256


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
