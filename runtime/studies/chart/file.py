"""A chart read back, for the page of a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError, ModelError
from spikeloom.runtime.studies.chart.tasks import FORMAT

Json = dict[str, Any]

KEYS = frozenset({"points", "networks", "recommended", "saving", "expected", "tables", "chosen_by", "data", "measured"})
"""Of a chart, as far as pages show it."""

SIZE_LIMIT = 2**28
"""Bytes that a chart may have."""


def read_chart(words: str, sha256: str, checkpoint: str) -> Json:
    """A chart that a network is part of.

    Parameters
    ----------
    words : str
        Its ``chart.json``, or the folder that holds it.
    sha256, checkpoint : str
        Of the network's checkpoint, and its name for messages.

    Raises
    ------
    DataError
        If there is no chart, or one of another version.
    ModelError
        If it is of other networks.
    """
    path = Path(words) / "chart.json" if Path(words).is_dir() else Path(words)
    if not path.is_file():
        raise DataError(f"--chart {words}: no such file; give the chart.json that spikeloom chart wrote")
    try:
        if path.stat().st_size > SIZE_LIMIT:
            raise ValueError
        found: Json = json.loads(path.read_text("utf-8"))
        known = found["format"] == FORMAT and set(found) >= KEYS
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        known = False
    if not known:
        raise DataError(f"--chart {words}: is no chart, or one of another version; make it anew with spikeloom chart")
    if sha256 not in [network["sha256"] for network in found["networks"]]:
        names = ", ".join(network["name"] for network in found["networks"])
        raise ModelError(f"--chart {words}: is of {names}, not of {checkpoint}; give a chart that this network is in")
    return found
