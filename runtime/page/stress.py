"""Where it breaks, on the page of a network: what ``stress`` wrote, read back; its verdicts, reasons and curves."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError
from spikeloom.runtime.report import drawing
from spikeloom.runtime.report.drawing import Curves
from spikeloom.runtime.report.intervals import wilson
from spikeloom.runtime.report.sections import Block, Figure, Section, Table, Text
from spikeloom.runtime.studies.stress.text import CURVE_ROWS, KEY, VERDICT_HEAD, curve_cells, verdict_rows
from spikeloom.runtime.studies.stress.verdicts import SIDES, shown

Json = dict[str, Any]

KEYS = {"recordings", "classes", "seeds", "clean", "perturbations", "not_applicable", "provenance"}


def read_stress(path: str, netlist: str, sha256: str) -> Json:
    """Read what ``stress -o`` wrote about a netlist of this name and hash.

    Raises
    ------
    DataError
        If the file is not there, something else, or about another netlist.
    """
    place = Path(path)
    if not place.is_file():
        raise DataError(f"--stress {path}: no such file; write it with spikeloom stress -o")
    try:
        found = json.loads(place.read_bytes())
    except ValueError:
        found = None
    if not isinstance(found, dict) or not found.keys() >= KEYS:
        raise DataError(f"--stress {path}: is not what spikeloom stress -o writes; give such a file")
    about = found["provenance"]["netlist_sha256"]
    if about != sha256:
        raise DataError(
            f"--stress {path}: is about a netlist of sha256 {about[:12]}…, {netlist} has {sha256[:12]}…; "
            "stress that one, or report the other"
        )
    return found


def sections(found: Json) -> list[Section]:
    """Verdicts, curves, and the numbers behind them."""
    curves, recordings = found["perturbations"], found["recordings"]
    clean = {side: 100 * count / recordings for side, count in found["clean"]["right"].items()}
    numbers = [
        Table(
            ["", *(shown(point["level"]) for point in one["levels"])],
            curve_cells(one["levels"]),
            f"{name}: {one['what']} ({one['unit']}); rows: {', '.join(CURVE_ROWS)}, in per cent",
            most=0,
        )
        for name, one in curves.items()
    ]
    skipped = [f"{name}: not measured, {why}" for name, why in found["not_applicable"].items()]
    title = "Accuracy under each perturbation"
    blocks: list[Block] = [
        Text(
            f"{len(curves)} perturbations on {recordings} recordings, {found['seeds']} seeds of each that is left to "
            f"chance; without any, the float model decides {clean['float']:.1f} % right, the chip {clean['chip']:.1f} %"
        ),
        Table(VERDICT_HEAD, verdict_rows(curves), "Where they break and why", words=True),
        Text(KEY.splitlines()[0]),
        Figure(
            "stress",
            partial(drawing.curves, title, [_panel(found, name) for name in curves]),
            f"{title} over its level, from mild to harsh, with 95 % intervals. Grey: interval of the clean accuracy on "
            "the chip; dotted: chance; vertical lines: where the mean leaves the clean interval.",
            numbers,
        ),
    ]
    return [Section("", [*blocks, *map(Text, skipped)])]


def _panel(found: Json, name: str) -> Curves:
    one = found["perturbations"][name]
    levels = [point["level"] for point in one["levels"]]
    low, high = wilson(found["clean"]["right"]["chip"], found["recordings"])
    leaves = {side: one["breaks"][side]["leaves"] for side in SIDES}
    return Curves(
        title=f"{name}: {one['verdict']}",
        axis=one["unit"],
        levels=[shown(level) for level in levels],
        sides={
            side: [tuple(100 * point[side][end] for end in ("low", "mean", "high")) for point in one["levels"]]
            for side in SIDES
        },
        leaves={side: None if level is None else levels.index(level) for side, level in leaves.items()},
        band=(100 * low, 100 * high),
        chance=100 / found["classes"],
    )
