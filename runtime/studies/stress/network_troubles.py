"""The part of the battery that happens to a network; :mod:`stress.damages` and :mod:`stress.other_networks` do it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph
from spikeloom.models.systems import propagation_of
from spikeloom.runtime.studies.stress import damages, other_networks
from spikeloom.runtime.studies.stress.damages import Pair
from spikeloom.runtime.studies.stress.perturbation import Damage, Level, Perturbation, Sensor


def _damaged(change: Callable[[Pair, float, np.random.Generator], Pair]) -> Damage:
    return lambda pair, level, _sensor, rng: change(pair, float(level), rng)


def _worn(change: Callable[[Pair, float], Pair]) -> Damage:
    return lambda pair, level, _sensor, _rng: change(pair, float(level))


def _on_edges(change: Callable[[IntArray, int, float, np.random.Generator], IntArray]) -> Damage:
    def damage(pair: Pair, level: Level, sensor: Sensor, rng: np.random.Generator) -> Pair:
        assert sensor.edges is not None, "asked in why_not"
        return _on_graph(pair, sensor, change(sensor.edges, sensor.taxels, float(level), rng))

    return damage


def _other_graph(pair: Pair, level: Level, sensor: Sensor, _rng: np.random.Generator) -> Pair:
    assert sensor.places is not None, "asked in why_not"
    return _on_graph(pair, sensor, build_graph(str(level), sensor.places).edges)


def _on_graph(pair: Pair, sensor: Sensor, edges: IntArray) -> Pair:
    checkpoint = sensor.checkpoint
    assert checkpoint is not None, "asked in why_not"
    seen = propagation_of(checkpoint.system, edges, checkpoint.taxels, checkpoint.grid, len(checkpoint.hops))
    return other_networks.stored_alike(pair, expand(checkpoint, seen))


def _doubled(edges: IntArray, _taxels: int, share: float, rng: np.random.Generator) -> IntArray:
    return other_networks.double(edges, share, rng)


def _ties(pair: Pair, level: float) -> Pair:
    return damages.with_thresholds(pair, pair.netlist.threshold - int(level))


NETWORK: tuple[Perturbation, ...] = (
    Perturbation(
        name="weight_bit_flips",
        what="each stored bit of a weight flips with a probability",
        unit="probability",
        levels=(1e-4, 1e-3, 0.01, 0.05),
        full=(1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2),
        damage=_damaged(damages.flip_bits),
    ),
    Perturbation(
        name="neurons_silent",
        what="random hidden neurons never fire",
        unit="share of hidden neurons",
        levels=(0.05, 0.1, 0.25, 0.5),
        full=(0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.75, 0.9),
        damage=_damaged(lambda pair, level, rng: damages.stick_neurons(pair, level, rng, firing=False)),
    ),
    Perturbation(
        name="neurons_firing",
        what="random hidden neurons fire in every step",
        unit="share of hidden neurons",
        levels=(0.005, 0.02, 0.05, 0.1),
        full=(0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2),
        damage=_damaged(lambda pair, level, rng: damages.stick_neurons(pair, level, rng, firing=True)),
    ),
    Perturbation(
        name="threshold_spread",
        what="each threshold drifts by a factor of its own",
        unit="standard deviation, share",
        levels=(0.05, 0.1, 0.2, 0.4),
        full=(0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5),
        damage=_damaged(damages.spread_thresholds),
    ),
    Perturbation(
        name="threshold_raised",
        what="all thresholds rise: towards a silent network",
        unit="times",
        levels=(1.05, 1.1, 1.25, 1.5, 2),
        full=(1.02, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4, 1.5, 1.75, 2, 3),
        seeded=False,
        least=1,
        most=1000,
        damage=_worn(damages.scale_thresholds),
    ),
    Perturbation(
        name="threshold_lowered",
        what="all thresholds fall: towards a saturated network",
        unit="times",
        levels=(0.95, 0.9, 0.75, 0.5),
        full=(0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.35, 0.25),
        seeded=False,
        damage=_worn(damages.scale_thresholds),
    ),
    Perturbation(
        name="ties_fire",
        what="thresholds fall by register units: at 1, more than every tie fires (>= for >)",
        unit="units",
        levels=(1, 2),
        full=(1, 2, 3, 5),
        seeded=False,
        most=1000,
        whole=True,
        damage=_worn(_ties),
    ),
    Perturbation(
        name="layers_late",
        what="layers after the first open their windows late, off by one and more",
        unit="steps",
        levels=(1, 2, 5, 25),
        full=(1, 2, 3, 5, 10, 25, 50, 100),
        seeded=False,
        most=1000,
        whole=True,
        damage=_worn(lambda pair, level: damages.open_late(pair, int(level))),
    ),
    Perturbation(
        name="other_graph",
        what="another taxel graph than the one of the training",
        unit="graph",
        levels=("knn:1", "knn:4", "mst:0"),
        full=("knn:1", "knn:2", "knn:3", "knn:4", "knn:5", "knn:6", "knn:7", "knn:8", "mst:0", "mst:3", "manual"),
        seeded=False,
        damage=_other_graph,
    ),
    Perturbation(
        name="edges_rewired",
        what="edges of the taxel graph lead elsewhere",
        unit="share of edges",
        levels=(0.05, 0.1, 0.25, 0.5),
        full=(0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1),
        damage=_on_edges(other_networks.rewire),
    ),
    Perturbation(
        name="edges_doubled",
        what="edges of the taxel graph are listed twice",
        unit="share of edges",
        levels=(0.1, 0.25, 0.5, 1),
        full=(0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1),
        damage=_on_edges(_doubled),
    ),
    Perturbation(
        name="fewer_bits",
        what="weights keep fewer bits on the scale that they have",
        unit="bits",
        levels=(6, 5, 4, 3, 2),
        full=(7, 6, 5, 4, 3, 2),
        seeded=False,
        least=2,
        most=8,
        whole=True,
        damage=_worn(lambda pair, level: damages.fewer_bits(pair, int(level))),
    ),
    Perturbation(
        name="outlier_weight",
        what="one weight a layer grows beyond the largest and takes the scale with it",
        unit="times the largest",
        levels=(2, 4, 8, 16),
        full=(2, 4, 8, 16, 32, 64),
        least=1,
        most=64,
        whole=True,
        damage=_damaged(lambda pair, level, rng: other_networks.add_outliers(pair, int(level), rng)),
    ),
    Perturbation(
        name="shorter_decay",
        what="membranes and lasting currents keep a smaller share",
        unit="times the decay",
        levels=(0.75, 0.5, 0.25, 0),
        full=(0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0),
        seeded=False,
        damage=_worn(damages.shorten_decay),
    ),
)
