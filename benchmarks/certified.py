"""Certified accuracy: right decisions that no k events alter, of networks and ways to store them; from stored results.

    python benchmarks/certified.py certified.json --picture certified.png

``stability-objects.json`` and ``stability-containers.json`` hold what is proven of several events,
``stability-methods.json`` what single events alter; of the float model these were not all run.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from made import made
from PIL import Image

RESULTS = Path(__file__).parent / "results"
MOST = 4

LINES = {"released": "8 bits", "shipped": "8 bits"}
"""Names in the picture of networks that are not called by how they are stored."""


def proven(rows: list[list[Any]]) -> list[int]:
    """Right decisions that up to 0, 1 … MOST events do not alter, of rows of ``stability-*.json``."""
    right = [row[4] for row in rows if row[1] == row[2]]
    return [sum(at_least >= events for at_least in right) for events in range(MOST + 1)]


def tried(rows: dict[str, Any]) -> list[int]:
    """The same for single events that were all run, of a method of ``stability-methods.json``."""
    right = [row for row in rows.values() if row["label"] == row["decided"]]
    if not all("event" in row for row in right):
        return [len(right)]
    return [len(right), sum(not any(row["event"]["phases"]) for row in right)]


def certified() -> dict[str, Any]:
    """By recordings: how many there are, and the counts of each network."""
    found: dict[str, Any] = {}
    for data in ("objects", "containers"):
        networks = json.loads((RESULTS / f"stability-{data}.json").read_text())["networks"]
        found[data] = {
            "recordings": len(next(iter(networks.values()))["each"]),
            "right": {LINES.get(name, name): proven(network["each"]) for name, network in networks.items()},
        }
    methods = json.loads((RESULTS / "stability-methods.json").read_text())["each"]
    for name, rows in methods.items():
        found["objects"]["right"].setdefault(name, tried(rows))
    return found


def draw(found: dict[str, Any], file: Path) -> None:
    """Share of all recordings over the number of events."""
    figure, panels = plt.subplots(1, len(found), figsize=(8, 2.8), layout="constrained")
    for panel, (data, shown) in zip(panels, found.items(), strict=True):
        for name, counts in shown["right"].items():
            shares = [100 * count / shown["recordings"] for count in counts]
            panel.plot(range(len(counts)), shares, "o-", ms=4, lw=1.4, label=name)
        panel.set(title=data.capitalize(), xlabel="events added or removed, at most", xticks=range(MOST + 1))
        panel.grid(color="#ddd", lw=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(frameon=False, fontsize=8)
    panels[0].set_ylabel("right and proven to stay so, %")
    figure.savefig(file, dpi=80)
    Image.open(file).quantize(32).save(file, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    found = certified()
    arguments.output.write_text(json.dumps(made() | found, indent=1) + "\n")
    if arguments.picture:
        draw(found, arguments.picture)
