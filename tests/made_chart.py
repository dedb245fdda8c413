"""A chart with made-up figures, for what only shows one."""

from __future__ import annotations

from typing import Any

from spikeloom.runtime.studies.chart import points as chart_points
from spikeloom.runtime.studies.chart.budget import parse_budgets, pick
from spikeloom.runtime.studies.chart.points import share

TABLES = {"energy": {"one": "prices <one>", "two": "prices two"}, "time": {"clock": "times"}}
SAMPLES = {"train": 400, "test": 100}


def made_split(right: int, samples: int, energy: float, time: float) -> dict[str, Any]:
    """Figures of a split: recordings right, µJ and ms."""
    return {
        "samples": samples,
        **share(right, samples),
        "float": share(min(samples, right + samples // 50), samples),
        "equal": samples - 3,
        "energy_j": {"one": energy * 1e-6, "two": 1.5e-6 * energy},
        "time_s": {"clock": time * 1e-3},
        "step_s": {"clock": 20e-6},
        "synaptic_operations": 1e4 * energy,
        "steps": 250.0,
    }


def made_chart(*budgets: str) -> dict[str, Any]:
    """Two networks, three widths, two windows; one configuration does not fit."""
    points = []
    for net, graph in (("grasps", "manual"), ("grasps-knn1", "knn:1")):
        for bits in (2, 4, 8):
            for window in (50, 100):
                worse = 4 * (8 - bits) + (20 if window == 50 else 0) + (6 if graph != "manual" else 0)
                name = f"{net}-{bits}b.loom"
                energy = bits * window * (0.2 if graph == "manual" else 0.15)
                points.append(
                    {
                        "number": len(points) + 1,
                        "network": net,
                        "graph": graph,
                        "bits": [bits],
                        "planes": 1,
                        "groups": 1,
                        "prune": False,
                        "fine_tuned": False,
                        "storage": f"{bits}b",
                        "cores": "cores",
                        "window": window,
                        "n_cores": 5,
                        "neurons": 2580,
                        "synapses": 385_000,
                        "netlist": "netlists/c0ffee.loom",
                        "netlist_sha256": "c0ffee",
                        "train": made_split(398 - worse, 400, energy, window / 20),
                        "test": made_split(90 - worse // 2, 100, energy, window / 20),
                        "commands": [
                            f"spikeloom compile {net}.pt --weight-bits {bits} --calibrate 'a <b>' -o {name}",
                            f"spikeloom run {name} --data 'a <b>' --detail counts --window {window}%",
                        ],
                    }
                )
    networks = [
        {
            "name": name,
            "path": f"{name}.pt",
            "sha256": "ab" * 32,
            "system": "tactilesgnet",
            "graph": graph,
            "has_graph": True,
            "weights": "last",
            "fine_tuned": False,
            "trained_by": f"spikeloom train --graph {graph}",
            "validation": validation,
            "bins": 1,
            "float_training": 1.0,
            "float": {"50": {split: share(n // 2, n) for split, n in SAMPLES.items()}}
            | {"100": {split: share(n * 9 // 10, n) for split, n in SAMPLES.items()}},
        }
        for name, graph, validation in (("grasps", "manual", 0.9), ("grasps-knn1", "knn:1", 0.88))
    ]
    report: dict[str, Any] = {
        "format": 1,
        "spikeloom": "0.1.0",
        "target": "loihi1",
        "command": "spikeloom chart grasps.pt grasps-knn1.pt --data 'a <b>' -o out",
        "data": {"path": "a <b>", "bin_s": 0.02, "sha256": "cd" * 32, "steps": 250} | SAMPLES,
        "tables": TABLES,
        "chosen_by": {"energy": "one", "time": "clock"},
        "grid": {"bits": [[2], [4], [8]], "window": [50, 100], "graph": []},
        "networks": networks,
        "expected": chart_points.with_expectations(points, networks),
        "points": points,
        "refused": [points[0] | {"storage": "8b 3p", "why": ["core 0 (fc1): 5 used, 4 allowed; fewer planes"]}],
        "measured": {"recordings_per_s": {str(point["number"]): 1000.0 for point in points}},
        "digest": "ef" * 32,
    }
    chart_points.with_fronts(points, "one", "clock")
    report["recommended"] = chart_points.recommended(points, networks, energy="one", time="clock", bin_s=0.02)
    report["saving"] = chart_points.saving(points, "one")
    report["budget"] = pick(points, parse_budgets(budgets), energy="one", time="clock")
    return report
