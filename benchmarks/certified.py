"""Certified accuracy: right decisions that no k events alter, of networks and ways to store them.

    python benchmarks/certified.py FOLDER certified.json --picture certified.png

FOLDER holds ``Ev-Objects.zip``, ``Ev-Containers.zip``, ``ntp-textures.zip`` and ``objects_manual.t7``. What
``stability-objects.json`` and ``stability-containers.json`` hold is read there, the float model in
``relational.json``; the other networks are made and certified. The small TactileSGNet is of the size and recipe of
``nested.py``; one condition of the textures is the test split, as there. What OUT.json holds is not made again.
"""

import argparse
import json
import tempfile
from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from figures import CONTAINERS, MANUAL, OBJECTS, Session
from made import made
from PIL import Image
from stability import summary, verdicts
from unseen import write_events, write_taxels

RESULTS = Path(__file__).parent / "results"
MOST = 4
TEXTURES = "textures"
LEFT_OUT = "speed=3600"
SENSOR = "--graph knn:4 --taxels taxels.csv"
SMALL = (
    "train --recipe rates --features 32 --hidden 128 --spike-penalty 0.3 --epochs 72 --keep last -o net.pt"
)

MADE = {  # Commands that make a network, the last of them its netlist
    OBJECTS: {
        "8 bits, planes": [f"compile {MANUAL} --graph manual --calibrate {OBJECTS} --planes 2"],
        "4 bits, fine-tuned": [
            f"finetune {MANUAL} --graph manual --weight-bits 4 --epochs 10 --data {OBJECTS} -o net.pt",
            "compile net.pt",
        ],
        "small TactileSGNet": [
            f"{SMALL} --graph manual --join 5 --data {OBJECTS}",
            f"compile net.pt --calibrate {OBJECTS}",
        ],
    },
    CONTAINERS: {
        "small TactileSGNet": [
            f"{SMALL} --graph manual --join 5 --data {CONTAINERS}",
            f"compile net.pt --calibrate {CONTAINERS}",
        ],
    },
    TEXTURES: {
        "small TactileSGNet": [
            f"{SMALL} {SENSOR} --data {TEXTURES}",
            f"compile net.pt --calibrate {TEXTURES}",
        ],
        "counters": [
            f"train --system counters --parts 6 --taxels taxels.csv --data {TEXTURES} -o net.pt",
            "compile net.pt",
        ],
    },
}
KNOWN = {
    OBJECTS: ("stability-objects.json", {"released": "8 bits", "counters": "counters"}),
    CONTAINERS: ("stability-containers.json", {"shipped": "8 bits", "counters": "counters"}),
}
"""Networks of other results, and their names in the picture."""


def proven(rows: list[list[Any]]) -> list[int]:
    """Right decisions that up to 0, 1 … MOST events do not alter, of rows of ``stability-*.json``."""
    right = [row[4] for row in rows if row[1] == row[2]]
    return [sum(at_least >= events for at_least in right) for events in range(MOST + 1)]


def proven_float(data: str) -> list[int]:
    """The same of the float model beside the first of these networks."""
    networks = json.loads((RESULTS / "relational.json").read_text())["networks"]
    right: list[int] = networks[data.removeprefix("Ev-").removesuffix(".zip").lower()]["float_right"]
    return right[: MOST + 1]


def known(data: str) -> dict[str, Any]:
    """What other results hold."""
    file, names = KNOWN.get(data, ("", {}))
    networks = json.loads((RESULTS / file).read_text())["networks"] if names else {}
    found = {names[name]: {"right": proven(network["each"])} for name, network in networks.items()}
    return {"float": {"right": proven_float(data)}} | found if names else found


def certified(session: Session, data: str, commands: list[str]) -> dict[str, Any]:
    """A network that is made and certified."""
    before = len(session.commands)
    for words in commands[:-1]:
        session.run(words)
    session.run(f"{commands[-1]} -o net.loom")
    each = summary(verdicts(session, "net", data, f"--most {MOST} --shift 0"))["each"]
    return {"commands": session.commands[before:], "recordings": len(each), "right": proven(each)}


def draw(found: dict[str, Any], file: Path) -> None:
    """Share of all recordings over the number of events."""
    figure, panels = plt.subplots(1, len(found), figsize=(10, 2.9), sharey=True, layout="constrained")
    colours = {
        name: f"C{index}" for index, name in enumerate(dict.fromkeys(chain.from_iterable(found.values())))
    }
    for panel, (data, networks) in zip(panels, found.items(), strict=True):
        recordings = max(network.get("recordings", 0) for network in networks.values())
        for name, network in networks.items():
            shares = [100 * count / recordings for count in network["right"]]
            panel.plot(range(len(shares)), shares, "o-", ms=4, lw=1.4, color=colours[name], label=name)
        title = data.removeprefix("Ev-").removesuffix(".zip").capitalize()
        panel.set(title=title, xlabel="events added or removed, at most", xticks=range(MOST + 1))
        panel.grid(color="#ddd", lw=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(frameon=False, fontsize=7)
    panels[0].set(ylabel="right and proven to stay so, %", ylim=(0, 100))
    figure.savefig(file, dpi=80)
    Image.open(file).quantize(32).save(file, optimize=True)


def main() -> None:
    """Make what is missing, write after each network, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    output = arguments.output
    before = json.loads(output.read_text())["sets"] if output.exists() else {}
    found: dict[str, Any] = {data: known(data) for data in MADE}
    with tempfile.TemporaryDirectory() as folder:
        session = Session(arguments.folder, Path(folder))
        write_events(arguments.folder / "ntp-textures.zip", session.folder / TEXTURES, LEFT_OUT)
        write_taxels(session.folder / "taxels.csv")
        for data, networks in MADE.items():
            for name, commands in networks.items():
                known_already = before.get(data, {}).get(name)
                found[data][name] = known_already or certified(session, data, commands)
                output.write_text(json.dumps(made() | {"sets": found}, indent=1) + "\n")
    if arguments.picture:
        draw(found, arguments.picture)


if __name__ == "__main__":
    main()
