"""Accuracy against energy of what ``smallest`` chose and of released recipes: the figure that README leads with.

    python benchmarks/systems.py [FOLDER]

Draws ``results/systems.png`` from stored results alone, and chooses nothing: each ``smallest-*.json`` (its choice, on
the recordings that its digest names), the choices of ``unseen.json``, one with each condition left out, the shipped
networks of TactileSGNet at 8 bits, the joined ones at their last epoch (five of them, mean), and as lines the linear
and the radial support vector machine that are best by cross-validation on the training split, or a ridge on the same
conditions. The picture holds the digest of what was drawn; the tests draw it again and compare.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean  # on every Python the same digits, unlike `sum`
from typing import Any

import matplotlib.pyplot as plt

from spikeloom.runtime.report.numbers import wilson

RESULTS = Path(__file__).parent / "results"
TABLES = ("davies2018", "sanafe")
SHIPPED = {
    "Objects": {"objects": "20 ms", "objects-200ms": "200 ms"},
    "Containers": {"containers": "20 ms"},
    "Textures, a condition left out": {},
}
"""Rows of the shipped networks, with their bins."""

OBJECTS, CONTAINERS, TEXTURES = SHIPPED
JOINED = "100 ms, five joined"
NAMES = {"tactilesgnet": "TactileSGNet", "counters": "counters"}
STYLES = {"TactileSGNet": ("o", "#1b6ca8"), "counters": ("s", "#c1440e")}
"""Marker and colour of a system; others get ``OTHER``."""

OTHER = ("D", "#5b7f3b")
SVM = {"linear": ("linear SVM, no chip", "--"), "rbf": ("RBF SVM, no chip", ":")}
WORKPLACE = r" --(?:data|bin|store|html|time|jobs) \S+| -o \S+| --json"
"""Options of ``smallest`` that say where, not what."""


def stored(name: str) -> Any:
    return json.loads((RESULTS / name).read_text("utf-8"))


def point(
    system: str, label: str, share: float, interval: tuple[float, float], energies_j: list[float]
) -> dict[str, Any]:
    """A network: share of test recordings with its interval, and energies, Davies' first."""
    energies = [1e6 * each for each in energies_j]
    name = NAMES.get(system, system)
    return {"system": name, "label": label, "share": share, "interval": interval, "energies": energies}


def chosen(data: str) -> Iterator[dict[str, Any]]:
    """What ``smallest`` took, of these recordings."""
    digests = {"Ev-Objects.zip": OBJECTS, "Ev-Containers.zip": CONTAINERS}
    of = {digest: digests[name] for name, digest in stored("shipped.json")["data_sha256"].items()}
    for file in sorted(RESULTS.glob("smallest-*.json")):
        found = stored(file.name)
        if of.get(found["data"]["sha256"]) == data:
            number = found["choice"]["cheapest"][TABLES[0]]
            system = next(each["system"] for each in found["tried"] if each["number"] == number)
            checked, right = found["checked"], found["checked"]["right"]
            label = re.sub(WORKPLACE, "", found["command"].removeprefix("spikeloom "))
            energies = [checked["costs"]["energy_j"][table] for table in TABLES]
            yield point(system, label, right["accuracy"], (right["low"], right["high"]), energies)
    if data == TEXTURES:
        for row in stored("unseen.json")["rows"]:
            took = row["chosen"]
            interval = wilson(took["right"], row["test"])
            share = took["right"] / row["test"]
            yield point(took["name"].split()[0], row["left_out"], share, interval, [took["energy_j"]])


def points(data: str) -> list[dict[str, Any]]:
    """Of one set of recordings."""
    found = []
    figures = stored("shipped.json")["figures"]
    for name, label in SHIPPED[data].items():
        one = figures[name]
        samples = one["test_samples"]
        energies = [one["energy_j"][table] for table in TABLES]
        found.append(
            point("tactilesgnet", label, one["chip"] / samples, wilson(one["chip"], samples), energies)
        )
    if data == CONTAINERS:
        joined = stored("joined-containers-100ms.json")["last"]["5"]
        chip, networks = joined["mean"]["chip"], joined["networks"]
        energies = [fmean(each["energy_j"][table] for each in networks) for table in TABLES]
        low, high = (end / 60 for end in chip["interval"])
        found.append(point("tactilesgnet", JOINED, chip["mean"] / 60, (low, high), energies))
    return [*found, *chosen(data)]


def machines(data: str) -> dict[str, float]:
    """Share of test recordings of machines that are on no chip."""
    if data == TEXTURES:
        rows = stored("unseen.json")["rows"]
        return {"ridge": sum(row["ridge"]["right"] for row in rows) / sum(row["test"] for row in rows)}
    found = stored(f"features-{data.lower()}.json")
    best = {
        kernel: max(
            (each for each in found["machines"] if each["kernel"] == kernel),
            key=lambda each: each["cross_validation"],
        )
        for kernel in SVM
    }
    return {kernel: one["correct"] / found["test_samples"] for kernel, one in best.items()}


def drawn() -> dict[str, Any]:
    """All that the picture shows."""
    return {data: {"points": points(data), "machines": machines(data)} for data in SHIPPED}


def sources() -> str:
    """Digest of what the picture shows."""
    return hashlib.sha256(json.dumps(drawn()).encode()).hexdigest()


def lines(axes: Any, shares: dict[str, float]) -> None:
    """Machines that are on no chip."""
    for kernel, share in shares.items():
        words, line = SVM.get(kernel, ("ridge, no chip", "--"))
        axes.axhline(100 * share, color="0.45", ls=line, lw=1)
        above = share == max(shares.values())
        aside = {"xytext": (-2, 2 if above else -2), "va": "bottom" if above else "top", "ha": "right"}
        axes.annotate(
            words,
            (1, 100 * share),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8,
            color="0.35",
            **aside,
        )


def crowded(one: dict[str, Any], others: list[dict[str, Any]]) -> bool:
    """Whether a label to the right of a mark would run into another."""
    return any(
        1 < each["energies"][0] / one["energies"][0] < 4 and abs(each["share"] - one["share"]) < 0.025
        for each in others
    )


def draw(folder: Path) -> list[Path]:
    """One panel for each set of recordings, small labels beside each mark."""
    figure, panels = plt.subplots(len(SHIPPED), figsize=(5.2, 8.4), layout="constrained", sharex=True)
    used: dict[str, tuple[str, str]] = {}
    least = min(each["energies"][0] for found in drawn().values() for each in found["points"])
    for axes, (data, found) in zip(panels, drawn().items(), strict=True):
        lines(axes, found["machines"])
        for each in found["points"]:
            marker, colour = used[each["system"]] = STYLES.get(each["system"], OTHER)
            energies, share = each["energies"], 100 * each["share"]
            low, high = (100 * bound for bound in each["interval"])
            span = [[share - low], [high - share]]
            axes.errorbar(energies[0], share, span, color=colour, marker=marker, ms=5, lw=0.8)
            axes.plot(energies, [share] * len(energies), color=colour, lw=2.5, alpha=0.35)
            left = crowded(each, found["points"])
            beside = {"xytext": (-4 if left else 4, -11), "ha": "right" if left else "left"}
            label = re.sub(r", ?| (?=--)", "\n", each["label"]).replace("--budget ", "--budget\n")
            at = (energies[0], share)
            axes.annotate(
                label, at, va="top", textcoords="offset points", fontsize=7, color=colour, **beside
            )
        axes.set_xscale("log")
        axes.set(title=data, xlim=(min(1.0, least / 2), 900), xticks=(1, 3, 10, 30, 100, 300))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.tick_params(labelbottom=True)
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    panels[-1].set_xlabel("dynamic energy a decision (µJ): Davies; bar to SANA-FE")
    figure.supylabel("test accuracy (%), chip", fontsize=10)
    handles = [plt.Line2D([], [], color=c, marker=m, ls="", label=name) for name, (m, c) in used.items()]
    panels[0].legend(handles=handles, fontsize=8, loc="lower left")
    picture = folder / "systems.png"
    figure.savefig(picture, dpi=130, metadata={"Description": f"drawn from {sources()}"})
    plt.close(figure)
    return [picture]


if __name__ == "__main__":
    print(*draw(Path(sys.argv[1]) if sys.argv[1:] else RESULTS), sep="\n")
