"""What made a result: command, version, hash of the recordings; the first entries of its file.

The code that it depends on is in ``results/runs``, where ``python -m benchmarks --again NAME --write`` notes it.
"""

import shlex
import sys
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.models.recordings.evtouch import Recordings, data_digest


def made(*splits: Recordings) -> dict[str, Any]:
    """Of a script that ran on a training and a test split, or on nothing but what it draws."""
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    found = {"command": shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])}
    found["spikeloom"] = __version__
    return found | ({"data_sha256": data_digest(*splits)} if splits else {})
