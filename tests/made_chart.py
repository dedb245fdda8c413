"""A chart with made-up figures, for what only shows one."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import product
from typing import Any

from spikeloom.runtime.studies.chart import results, study
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile, Storage
from spikeloom.runtime.studies.search.budgets import parse_budgets
from spikeloom.runtime.studies.search.results import ChosenBy, Costs, Data, share

SAMPLES = {"train": 400, "test": 100}
BY = ChosenBy(energy="one", time="clock")


def stored(bits: int) -> Storage:
    """So many bits a weight, otherwise as usual."""
    return Storage(bits=(bits,), planes=1, groups=1, prune=False)


def made_figures(right: int, samples: int, energy: float, time: float) -> results.Figures:
    """Figures of a split: recordings right, µJ and ms."""
    return results.Figures(
        **asdict(share(right, samples)),
        samples=samples,
        model=share(min(samples, right + samples // 50), samples),
        equal=samples - 3,
        costs=Costs(
            operations=1e4 * energy,
            energy_j={"one": energy * 1e-6, "two": 1.5e-6 * energy},
            time_s={"clock": time * 1e-3},
        ),
        steps=250.0,
    )


def made_point(number: int, **about: Any) -> results.Point:
    """A point of the usual kind, but for what is said."""
    usual: dict[str, Any] = {
        "network": "grasps",
        "stored": stored(8),
        "cores": "cores",
        "window": 100,
        "n_cores": 5,
        "neurons": 2580,
        "synapses": 385_000,
        "netlist": "netlists/c0ffee.loom",
        "netlist_sha256": "c0ffee",
        "commands": ("spikeloom compile", "spikeloom run"),
    }
    return results.Point(number=number, **(usual | about))


def made_network(name: str = "grasps", validation: float | None = 0.9) -> NetworkFile:
    """A network of the usual kind."""
    known = {} if validation is None else {"validation": {"correct": 100 * validation, "samples": 100}}
    return NetworkFile(
        path=f"{name}.pt",
        name=name,
        graph="manual",
        sha256="ab" * 32,
        system="tactilesgnet",
        weights="last",
        options=(),
        taxels=39,
        classes=8,
        layers=("conv1", "fc1"),
        training=known,
    )


def made_chart(*budgets: str) -> results.Chart:
    """Two networks, three widths, two windows; one configuration does not fit."""
    points: list[results.Point] = []
    for net, bits, window in product(("grasps", "grasps-knn1"), (2, 4, 8), (50, 100)):
        worse = 4 * (8 - bits) + (20 if window == 50 else 0) + (0 if net == "grasps" else 6)
        file = f"{net}-{bits}b.loom"
        energy = bits * window * (0.2 if net == "grasps" else 0.15)
        compiled = f"spikeloom compile {net}.pt --weight-bits {bits} --calibrate 'a <b>' -o {file}"
        ran = f"spikeloom run {file} --data 'a <b>' --window {window}%"
        points.append(
            made_point(
                len(points) + 1,
                network=net,
                stored=stored(bits),
                window=window,
                train=made_figures(398 - worse, 400, energy, window / 20),
                test=made_figures(90 - worse // 2, 100, energy, window / 20),
                commands=(compiled, ran),
            )
        )
    networks = (made_network(), made_network("grasps-knn1", validation=0.88))
    points = study.with_fronts(study.with_expectations(points, networks), BY)
    three = replace(stored(2), planes=3)
    why = ("core 0 (fc1): 5 used, 4 allowed; fewer planes",)
    return results.Chart(
        spikeloom="0.1.0",
        target="loihi1",
        command="spikeloom chart grasps.pt grasps-knn1.pt --data 'a <b>' -o out",
        data=Data(path="a <b>", bin_s=0.02, sha256="cd" * 32, steps=250, **SAMPLES),
        tables={"energy": {"one": "prices <one>", "two": "prices two"}, "time": {"clock": "times"}},
        chosen_by=BY,
        grid=Grid(bits=((2,), (4,), (8,)), window=(50, 100)),
        networks=networks,
        points=tuple(points),
        refused=(results.Refused(network="grasps", cores="cores", stored=three, why=why),),
        budget=study.pick(points, parse_budgets(budgets), BY),
        folder="out",
    )
