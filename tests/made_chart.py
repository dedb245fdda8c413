"""A chart with made-up figures, for what only shows one."""

from __future__ import annotations

from typing import Any

from spikeloom.runtime.studies import fronts
from spikeloom.runtime.studies.chart import choices, results
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile

SAMPLES = {"train": 400, "test": 100}
BY = results.ChosenBy(energy="one", time="clock")


def made_figures(right: int, samples: int, energy: float, time: float, *, step: float = 20e-6) -> results.Figures:
    """Figures of a split: recordings right, µJ and ms."""
    accuracy = results.share(right, samples)
    return results.Figures(
        **{name: getattr(accuracy, name) for name in ("correct", "accuracy", "low", "high")},
        samples=samples,
        model=results.share(min(samples, right + samples // 50), samples),
        equal=samples - 3,
        energy_j={"one": energy * 1e-6, "two": 1.5e-6 * energy},
        time_s={"clock": time * 1e-3},
        step_s={"clock": step},
        synaptic_operations=1e4 * energy,
        steps=250.0,
    )


def made_point(number: int, **about: Any) -> results.Point:
    """A point of the usual kind, but for what is said."""
    usual: dict[str, Any] = {
        "network": "grasps",
        "target": "loihi1",
        "graph": "manual",
        "bits": (8,),
        "planes": 1,
        "groups": 1,
        "prune": False,
        "fine_tuned": False,
        "storage": "8b",
        "cores": "cores",
        "window": 100,
        "n_cores": 5,
        "neurons": 2580,
        "synapses": 385_000,
        "netlist": "netlists/c0ffee.loom",
        "netlist_sha256": "c0ffee",
        "train": made_figures(400, 400, 1.0, 1.0),
        "test": made_figures(100, 100, 1.0, 1.0),
        "commands": ("spikeloom compile", "spikeloom run"),
    }
    return results.Point(number=number, **(usual | about))


def made_network(
    name: str = "grasps",
    *,
    validation: float | None = 0.9,
    trained: int = 400,
    expected: float = 0.0,
    graph: str = "manual",
    bins: int = 1,
) -> results.ChartedNetwork:
    """A network of the usual kind, but for what is said; its float model has so many training recordings right."""
    known = {} if validation is None else {"validation": {"correct": 100 * validation, "samples": 100}}
    file = NetworkFile(
        path=f"{name}.pt",
        name=name,
        graph=graph,
        sha256="ab" * 32,
        system="tactilesgnet",
        weights="last",
        bins=bins,
        options=(),
        taxels=39,
        classes=8,
        layers=("conv1", "fc1"),
        training={"command": "spikeloom train"} | known,
    )
    model = {
        50: {split: results.share(n // 2, n) for split, n in SAMPLES.items()},
        100: {"train": results.share(trained, 400), "test": results.share(90, 100)},
    }
    return results.ChartedNetwork(file=file, model=model, expected=expected)


def made_chart(*budgets: str) -> results.Chart:
    """Two networks, three widths, two windows; one configuration does not fit."""
    points: list[results.Point] = []
    for net, graph in (("grasps", "manual"), ("grasps-knn1", "knn:1")):
        for bits in (2, 4, 8):
            for window in (50, 100):
                worse = 4 * (8 - bits) + (20 if window == 50 else 0) + (6 if graph != "manual" else 0)
                file = f"{net}-{bits}b.loom"
                energy = bits * window * (0.2 if graph == "manual" else 0.15)
                compiled = f"spikeloom compile {net}.pt --weight-bits {bits} --calibrate 'a <b>' -o {file}"
                ran = f"spikeloom run {file} --data 'a <b>' --detail counts --window {window}%"
                points.append(
                    made_point(
                        len(points) + 1,
                        network=net,
                        graph=graph,
                        bits=(bits,),
                        storage=f"{bits}b",
                        window=window,
                        train=made_figures(398 - worse, 400, energy, window / 20),
                        test=made_figures(90 - worse // 2, 100, energy, window / 20),
                        commands=(compiled, ran),
                    )
                )
    networks = [made_network(), made_network("grasps-knn1", graph="knn:1", validation=0.88)]
    points, networks, expected = choices.with_expectations(points, networks)
    points = choices.with_fronts(points, BY)
    named = ("network", "target", "graph", "bits", "planes", "groups", "prune", "fine_tuned", "cores")
    refused = {name: getattr(points[0], name) for name in named}
    return results.Chart(
        spikeloom="0.1.0",
        target="loihi1",
        command="spikeloom chart grasps.pt grasps-knn1.pt --data 'a <b>' -o out",
        data=results.Data(path="a <b>", bin_s=0.02, sha256="cd" * 32, steps=250, **SAMPLES),
        tables={"energy": {"one": "prices <one>", "two": "prices two"}, "time": {"clock": "times"}},
        chosen_by=BY,
        grid=Grid(bits=((2,), (4,), (8,)), window=(50, 100)),
        networks=tuple(networks),
        expected=expected,
        points=tuple(points),
        refused=(results.Refused(**refused, storage="8b 3p", why=("core 0 (fc1): 5 used, 4 allowed; fewer planes",)),),
        recommended=choices.recommended(points, networks, BY, bin_s=0.02),
        saving=choices.saving(points, BY),
        budget=choices.pick(points, fronts.parse_budgets(budgets), BY),
    )
