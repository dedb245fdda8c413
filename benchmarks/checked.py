"""The verdict of ``examples/check_certificate.py`` on every certificate of some netlists: hours of CPU time.

    python benchmarks/checked.py checked.json NAME.loom …

Beside each NAME.loom lies NAME.cert, which ``spikeloom certify NAME.loom --data RECORDINGS --certificate NAME.cert``
wrote. Verdicts that the output has already are kept, so it can be ended and begun again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from runpy import run_path
from typing import Any

from made import made

from spikeloom.compiler.files import sha256_of, write_atomically

CHECKER = Path(__file__).parents[1] / "examples" / "check_certificate.py"


def verdicts(netlist: Path, known: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All that are known of a netlist's recordings after each that is checked."""
    checker = run_path(str(CHECKER))
    for file, given in checker["claims"](netlist, netlist.with_suffix(".cert")):
        if file not in known:
            _, unaltered, rule, *_ = given[3]
            begun = time.process_time()
            verdict = {"rule": rule, "unaltered": unaltered}
            try:
                verdict["altering"] = checker["check"](*given)
            except SystemExit as refused:
                verdict["refused"] = str(refused)
            known[file] = verdict | {"cpu_s": round(time.process_time() - begun, 1)}
        yield known


def summary(known: dict[str, Any]) -> dict[str, Any]:
    """How many certificates of a netlist are accepted, how many of these speak of several events, and what it took."""
    accepted = [each for each in known.values() if "refused" not in each]
    return {
        "recordings": len(known),
        "accepted": len(accepted),
        "several_events": sum(each["unaltered"] > 1 for each in accepted),
        "cpu_s": round(sum(each["cpu_s"] for each in known.values()), 1),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("netlists", type=Path, nargs="+")
    arguments = parser.parse_args()
    stored = json.loads(arguments.output.read_text("utf-8")) if arguments.output.exists() else {}
    data = {
        path.name: sha256_of(path) for path in (each.with_suffix(".cert") for each in arguments.netlists)
    }
    found = stored["verdicts"] if stored.get("data_sha256") == data else {}
    for netlist in arguments.netlists:
        for known in verdicts(netlist, found.get(netlist.name, {}).get("files", {})):
            found[netlist.name] = summary(known) | {"files": known}
            sums = {key: sum(each[key] for each in found.values()) for key in ("recordings", "accepted")}
            result = made() | {"data_sha256": data} | sums | {"verdicts": found}
            with write_atomically(arguments.output) as file:
                file.write((json.dumps(result, indent=1) + "\n").encode())
