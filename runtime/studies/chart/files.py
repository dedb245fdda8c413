"""Files of a chart: data, a line for every point, pictures, and a page."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

from spikeloom.compiler.files import write_atomically
from spikeloom.runtime.report import html
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.studies.chart.results import Chart
from spikeloom.runtime.studies.chart.sections import picture, sections


def write_chart(folder: Path, chart: Chart) -> None:
    """Write ``chart.json``, ``.csv``, ``.html``, ``.svg`` and ``.png``; the same bytes for the same chart."""
    drawn = picture(chart)
    files = {
        "chart.json": (json.dumps(encode(chart), indent=1, allow_nan=False) + "\n").encode(),
        "chart.csv": csv_text(chart).encode(),
        "chart.html": page(chart).encode(),
        "chart.svg": drawn.file("svg"),
        "chart.png": drawn.file("png"),
    }
    for name, content in files.items():
        with write_atomically(folder / name) as file:
            file.write(content)


def page(chart: Chart) -> str:
    """A chart as one HTML file."""
    name = chart.data.path.rstrip("/").rsplit("/", 1)[-1]
    about = "Point at a mark to read its figures and the commands that make it."
    return html.page(f"{len(chart.points)} configurations on {name}", about, sections(chart))


def csv_text(chart: Chart) -> str:
    """Every point as a line; what is measured on this machine comes last."""
    columns = ["number", "network", "graph", "bits", "planes", "groups", "prune", "fine_tuned", "cores", "window"]
    columns += ["n_cores", "neurons", "synapses", "expected"]
    per_split = ["correct", "accuracy", "low", "high", "equal", "synaptic_operations"]
    rows = []
    for point in chart.points:
        row = {name: getattr(point, name) for name in columns} | {"bits": "+".join(map(str, point.bits))}
        for split, figures in (("test", point.test), ("train", point.train)):
            row |= {f"{split}_{name}": getattr(figures, name) for name in per_split}
            row[f"{split}_float_accuracy"] = figures.model.accuracy
            row |= {f"{split}_energy_j_{name}": figures.energy_j.get(name, "") for name in chart.tables.energy}
            row |= {f"{split}_time_s_{name}": figures.time_s.get(name, "") for name in chart.tables.time}
        row |= {f"front_{name}": point.front.get(name, "") for name in ("energy", "latency")}
        row |= dict(zip(("compile", "run"), point.commands, strict=True))
        rows.append(row | {"measured_recordings_per_s": f"{chart.measured.recordings_per_s[str(point.number)]:.0f}"})
    file = io.StringIO()
    out = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
    out.writeheader()
    out.writerows(rows)
    return file.getvalue()
