"""Fetch the released recordings, once, and find them again by name."""

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.files import sha256_of

_REPOSITORY = "https://raw.githubusercontent.com/clear-nus/TactileSGNet/master"

TIMEOUT_S = 30.0
RETRIES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSet:
    """A released file: its name, where its authors keep it, bytes, and SHA-256 of its content."""

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
    """Where a released data set is, whether it was transferred now, and what to give to ``--data``."""

    name: str
    path: Path
    new: bool
    bytes: int
    sha256: str
    data: str


def data_folder() -> Path:
    """Folder of fetched data: SPIKELOOM_DATA, or ``spikeloom`` in the user's cache (XDG_CACHE_HOME, ~/.cache)."""
    chosen = os.environ.get("SPIKELOOM_DATA")
    if chosen:
        return Path(chosen)
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (cache if cache.is_absolute() else Path.home() / ".cache") / "spikeloom"


def find_data(name: str) -> Path:
    """Path of a data set that was fetched; DataError if it was not, or is not the released file any more."""
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


def fetch_data(name: str, *, url: str | None = None) -> Fetched:
    """Download one of `DATA_SETS` unless it is there; its name appears when the hash is that of the released file.

    `url` is another address of the same file; the `data_folder` is made if needed.

    OptionError, DataError if there is no such data set, or the address does not serve the released file,
    after `RETRIES` more attempts.
    """
    data = _known(name)
    url = url or data.url
    if not re.match(r"https?://[^/]", url):
        raise OptionError(f"--url {url}: not a web address; give one that starts with http:// or https://")
    path = data_folder() / data.file
    facts: dict[str, Any] = {
        "name": name,
        "path": path,
        "sha256": data.sha256,
        "bytes": data.size,
        "data": name,
    }
    if path.exists():
        if not _is_released(path, data):
            raise DataError(f"{path}: exists and is not the released file; move it away")
        return Fetched(**facts, new=False)
    import pooch  # a tenth of a second that other commands need not wait
    import requests

    pooch.get_logger().setLevel("WARNING")
    store = pooch.create(
        path.parent, "", registry={data.file: data.sha256}, urls={data.file: url}, retry_if_failed=RETRIES
    )
    download = pooch.HTTPDownloader(progressbar=sys.stderr.isatty(), timeout=TIMEOUT_S)
    try:
        store.fetch(data.file, downloader=download)
    except requests.RequestException as error:
        why = type(error).__name__ if error.response is None else error.response.status_code
        raise DataError(
            f"{url}: cannot be fetched ({why}); try later, or give another address with --url"
        ) from error
    except ValueError as error:
        raise DataError(
            f"{url}: serves another file, the released one has sha256 {data.sha256}; give its address with --url"
        ) from error
    return Fetched(**facts, new=True)


def _known(name: str) -> DataSet:
    if name not in DATA_SETS:
        raise OptionError(f"{name}: no such data set; allowed: {', '.join(DATA_SETS)}")
    return DATA_SETS[name]


def _is_released(path: Path, data: DataSet) -> bool:
    """Compare size first: a stranger may be large."""
    return path.is_file() and path.stat().st_size == data.size and sha256_of(path) == data.sha256
