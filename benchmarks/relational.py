"""Up to how many changed events float model and chip are proven to decide alike, whichever events these are.

    python benchmarks/relational.py Ev-Objects.zip Ev-Containers.zip relational.json

The networks are those that ``stability.py`` names first, compiled as there. Files are read from the folder in which it
runs.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from figures import Session
from made import made
from stability import NETWORKS, verdicts

from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import data_digest
from spikeloom.runtime.studies.robustness.results import Certificate, Certificates, FloatModel


def summary(result: Certificates) -> dict[str, Any]:
    """Recordings by how many events are proven to alter nothing, from none up, and a short line for each."""
    found = result.certificates

    def at_least(proven: list[int]) -> list[int]:
        return [sum(events >= count for events in proven) for count in range(result.most + 1)]

    return {
        "recordings": len(found),
        "single_events": sum(each.kinds[kind].tried for each in found for kind in ("removed", "added")),
        "alike": at_least([each.alike for each in found if each.alike is not None]),
        "float": at_least([model_of(each).at_least for each in found]),
        "float_right": at_least([m.at_least for e in found if (m := model_of(e)).decision == e.label]),
        "columns": ["file", "label", "float decides", "proven", "chip decides", "proven"],
        "each": [
            [e.file, e.label, model_of(e).decision, model_of(e).at_least, e.decision, e.at_least]
            for e in found
        ],
    }


def model_of(each: Certificate) -> FloatModel:
    """What is proven of the float model."""
    assert each.model is not None, "--checkpoint was given"
    return each.model


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", choices=NETWORKS)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    hashes = {
        data: data_digest(*(load_data(data, split) for split in ("train", "test")))
        for data in arguments.recordings
    }
    networks = {}
    with tempfile.TemporaryDirectory() as folder:
        session = Session(Path.cwd(), Path(folder))
        for data in arguments.recordings:
            words = next(iter(NETWORKS[data].values()))
            session.run(f"{words} -o net.loom")
            result = verdicts(session, "net", data, f"--checkpoint {words.split()[1]} --shift 0")
            networks[data.removeprefix("Ev-").removesuffix(".zip").lower()] = summary(result)
    found = made() | {"data_sha256": hashes, "commands": session.commands, "networks": networks}
    arguments.output.write_text(json.dumps(found, indent=1) + "\n")
