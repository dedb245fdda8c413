"""Loss and accuracy of the four systems, epoch by epoch, as one figure of the paper shows them.

    python benchmarks/curves.py DATA OUT.json [--epochs 60] [--seed 0] [--picture OUT.png]

A system that OUT.json holds for the same epochs and seed is not trained again.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from made import made

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.systems import GCN, GRAPH_SYSTEMS, GRID_CNN, MLP, TACTILESGNET
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.network_kinds import kind_of
from spikeloom.models.recordings.evtouch import BIN_S
from spikeloom.models.training.kinds import seen_by
from spikeloom.models.training.train import train
from spikeloom.runtime.cli import build_parser
from spikeloom.runtime.commands.training.train import both_splits, plan_jobs
from spikeloom.runtime.report.drawing import COLOURS, DASHES, Drawing, sheet, styled

SYSTEMS = {TACTILESGNET: "TactileSGNet", GRID_CNN: "grid-based CNN", MLP: "MLP", GCN: "GCN"}
PANELS = {"training_loss": "training loss", "test_loss": "test loss", "test_accuracy": "test accuracy, %"}


@styled()
def draw(found: dict[str, Any]) -> Drawing:
    """A panel for each figure of an epoch, a line for each system."""
    drawing = sheet("Loss and accuracy of four systems, epoch by epoch", 2.8)
    for axes, (key, name) in zip(drawing.figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
        for index, system in enumerate(found["systems"]):
            each = found["systems"][system][key]
            style = {"color": COLOURS[index], "ls": DASHES[index], "lw": 1.2, "label": SYSTEMS[system]}
            axes.plot(range(1, len(each) + 1), each, **style)
        axes.set(xlabel="epoch", title=name, xlim=(1, found["epochs"]))
        axes.grid(visible=True)
    drawing.figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return drawing


def main() -> None:
    """Train, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    training, test = both_splits(asked.recordings, len(NEUTOUCH), BIN_S)
    kept = json.loads(asked.output.read_text()) if asked.output.exists() else {}
    same = (kept.get("epochs"), kept.get("seed")) == (asked.epochs, asked.seed)
    systems = kept["systems"] if same else {}
    found = made(training, test) | {"epochs": asked.epochs, "seed": asked.seed, "systems": systems}
    for system in SYSTEMS:
        if system in systems:
            continue
        words = ["train", "--data", asked.recordings, "--system", system, "--epochs", str(asked.epochs)]
        words += ["--graph", "manual"] if system in GRAPH_SYSTEMS else []
        (job,) = plan_jobs(build_parser().parse_args([*words, "-o", "none.pt"]), training, test)
        sizes = kind_of(job.plan.system).architecture(job.plan)
        options = {"epochs": job.epochs, "seed": asked.seed, "recipe": job.plan.recipe, "label": system}
        epochs = train(training, test, seen_by(job.plan), sizes, **options).history
        systems[system] = {
            "training_loss": [round(epoch.training_loss, 6) for epoch in epochs],
            "test_loss": [round(epoch.test_loss, 6) for epoch in epochs],
            "test_accuracy": [round(100 * epoch.accuracy, 4) for epoch in epochs],
        }
        with write_atomically(asked.output) as file:
            file.write((json.dumps(found, indent=1) + "\n").encode())
    if asked.picture is not None:
        asked.picture.write_bytes(draw(found).file("png"))


if __name__ == "__main__":
    main()
