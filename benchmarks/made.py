"""What made a result: command, state of the code, hash of the recordings; the first entries of its file."""

import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.models.recordings.evtouch import Recordings, data_digest


def made(*splits: Recordings) -> dict[str, Any]:
    """Of a script that ran on a training and a test split, or on nothing but what it draws."""
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    run = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    code = subprocess.run(run, stdout=subprocess.PIPE, text=True, check=False).stdout.strip()
    found = {"command": shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])}
    found["spikeloom"] = f"{__version__} ({code or 'no repository'})"
    return found | ({"data_sha256": data_digest(*splits)} if splits else {})
