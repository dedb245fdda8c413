"""What each change of a training recipe is worth: accuracy and operations of its networks, side by side.

    python benchmarks/variants.py DATA OUT.json 'timed=t-s*.pt' 'no clocks=n-s*.pt' … [--picture OUT.png]

Each network is compiled at 8 bits, with scales chosen on training recordings, at its last epoch (nothing chosen) and
its clean epoch (chosen on validation); at its best one, which was chosen on test, beside them. Else test recordings are
only reported. `--spike-exact` adds planes and scales of 8 bits until no training spike moves.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from glob import glob
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from joined import measured
from made import made

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.report.drawing import COLOURS, MARKERS
from spikeloom.runtime.report.numbers import of_mean

Json = dict[str, Any]

WEIGHTS = ("last", "clean", "best")


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("variants", nargs="+", metavar="NAME=FILES")
    parser.add_argument("--spike-exact", action="store_true")
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    training, test = (load_data(arguments.recordings, split) for split in ("train", "test"))
    found: Json = made(training, test) | {"data": Path(arguments.recordings).name}
    found |= {"test_samples": len(test), "variants": {}}
    for variant in arguments.variants:
        name, _, files = variant.rpartition("=")
        paths = sorted(glob(files))  # noqa: PTH207, the pattern may be absolute
        if not paths:
            parser.error(f"{variant}: no such files")
        found["variants"][name] = {"commands": [read_checkpoint(path).training["command"] for path in paths]} | {
            weights: _summary(
                [
                    measured(read_checkpoint(path, weights=weights), training, test, spike_exact=arguments.spike_exact)
                    for path in paths
                ]
            )
            for weights in WEIGHTS
        }
        print(name, json.dumps(found["variants"][name]["last"]["mean"]), file=sys.stderr)
        arguments.output.write_text(json.dumps(found, indent=1) + "\n")
    print(_table(found))
    if arguments.picture is not None:
        _draw(found, arguments.picture)


def _summary(networks: list[Json]) -> Json:
    """All networks, and mean, deviation and Student's 95 % interval of each figure; one network has a mean only."""
    mean: Json = {}
    for key in ("float", "chip", "synaptic_operations"):
        values = [network[key] for network in networks]
        mean[key] = {
            "mean": statistics.mean(values),
            "std": statistics.stdev(values) if len(values) > 1 else None,
            "interval": list(of_mean(values)) if len(values) > 1 else None,
        }
    return {"networks": networks, "mean": mean}


def _table(found: Json) -> str:
    """Markdown: a row a variant."""
    percent = 100 / found["test_samples"]
    lines = ["| variant | seeds | float, last | float, clean | chip, last | chip, clean | operations |"]
    lines.append("|---|---|---|---|---|---|---|")
    for name, variant in found["variants"].items():
        cells = []
        for weights, key in (("last", "float"), ("clean", "float"), ("last", "chip"), ("clean", "chip")):
            mean = variant[weights]["mean"][key]
            words = f"{mean['mean'] * percent:.2f}"
            if mean["interval"] is not None:
                low, high = (end * percent for end in mean["interval"])
                words += f", {mean['std'] * percent:.2f} ({low:.2f} … {high:.2f})"
            cells.append(words)
        operations = variant["last"]["mean"]["synaptic_operations"]["mean"] / 1e6
        lines.append(f"| {name} | {len(variant['commands'])} | {' | '.join(cells)} | {operations:.2f} M |")
    return "\n".join(lines)


def _draw(found: Json, path: Path) -> None:
    """Each network at its last epoch, and the means."""
    figure, axes = plt.subplots(figsize=(5.2, 3.8), layout="constrained")
    percent = 100 / found["test_samples"]
    for index, (name, variant) in enumerate(found["variants"].items()):
        networks = variant["last"]["networks"]
        operations = [network["synaptic_operations"] / 1e6 for network in networks]
        right = [network["chip"] * percent for network in networks]
        look = {"marker": MARKERS[index], "color": COLOURS[index], "ls": ""}
        axes.plot(operations, right, ms=4, alpha=0.5, **look)
        axes.plot(statistics.mean(operations), statistics.mean(right), ms=10, mec="black", label=name, **look)
    axes.set(xlabel="synaptic operations a recording, millions", ylabel="test accuracy on the chip, %")
    axes.set_title("last epochs: networks (small) and means", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150, metadata={"Software": None})


if __name__ == "__main__":
    main()
