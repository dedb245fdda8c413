"""Up to how many changed events float model and chip are proven to decide alike, whichever events these are.

    python benchmarks/relational.py Ev-Objects.zip Ev-Containers.zip relational.json

The networks are the first ones of ``stability.py``, whose results say what is proven of the chip. Files are read from
the folder in which it runs.
"""

import argparse
import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from figures import Session
from made import made
from stability import NETWORKS

from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import data_digest
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.requests.check import CertifyRequest
from spikeloom.runtime.studies.robustness.float_proof import prepared, verdict
from spikeloom.runtime.studies.robustness.threads import in_threads

RESULTS = Path(__file__).parent / "results"
MOST = 8


def name_of(data: str) -> str:
    """A set of recordings, in short."""
    return data.removeprefix("Ev-").removesuffix(".zip").lower()


def both(session: Session, data: str) -> dict[str, Any]:
    """Recordings by how many events, from none up, are proven to alter nothing; and a short line for each."""
    name, words = next(iter(NETWORKS[data].items()))
    session.run(f"{words} -o net.loom")
    netlist = machine_for(session.folder / "net.loom").netlist
    checkpoint = words.split()[1]
    request = CertifyRequest(netlist="net.loom", checkpoint=checkpoint, data=data)
    test = load_data(data, "test")
    network = prepared(load_network(checkpoint, request, netlist).network, netlist, test)
    lengths = test.step_counts.tolist()
    recordings = [events[..., :length] for events, length in zip(test.events, lengths, strict=True)]
    floats = in_threads(partial(verdict, network, netlist, MOST), recordings, data, None)
    known = json.loads((RESULTS / f"stability-{name_of(data)}.json").read_text())["networks"][name]["each"]
    rows = [
        [file, label, model.decision, model.at_least, decision, min(at_least, MOST)]
        for (file, label, decision, _, at_least, *_), model in zip(known, floats, strict=True)
    ]
    assert [row[0] for row in rows] == list(test.files), "of the same recordings"

    def at_least(proven: list[int]) -> list[int]:
        return [sum(events >= count for events in proven) for count in range(MOST + 1)]

    return {
        "recordings": len(rows),
        "alike": at_least([min(row[3], row[5]) for row in rows if row[2] == row[4]]),
        "float": at_least([row[3] for row in rows]),
        "float_right": at_least([row[3] for row in rows if row[1] == row[2]]),
        "columns": ["file", "label", "float decides", "proven", "chip decides", "proven"],
        "each": rows,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", choices=NETWORKS)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    hashes = {
        data: data_digest(*(load_data(data, split) for split in ("train", "test")))
        for data in arguments.recordings
    }
    with tempfile.TemporaryDirectory() as folder:
        session = Session(Path.cwd(), Path(folder))
        networks = {name_of(data): both(session, data) for data in arguments.recordings}
    content = made() | {"data_sha256": hashes, "commands": session.commands, "networks": networks}
    arguments.output.write_text(json.dumps(content, indent=1) + "\n")
