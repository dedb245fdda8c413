"""A network that is trained by gradients, as a candidate: some recordings left out, compiled."""

import io
import tempfile
from collections.abc import Mapping
from contextlib import redirect_stderr
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.systems import GRAPH_SYSTEMS, GRID_CNN
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.compartments import Options, compile_network
from spikeloom.compiler.types import BoolArray, JsonObject
from spikeloom.models.graphs import Graph
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import sensor_grid, taxels_alone
from spikeloom.models.training.plan import Plan, seen_by
from spikeloom.models.training.recipes import PLATEAU, RECIPES
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.requests.choices import NetworkChoice
from spikeloom.runtime.studies.smallest.space import Candidate
from spikeloom.runtime.studies.training.plan import hidden_sizes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensor:
    """Taxels and their graph, which may have no edges, and the options that name them."""

    graph: Graph
    options: Mapping[str, Any] = field(default_factory=dict)

    def options_of(self, system: str) -> JsonObject:
        """Those that a system takes."""
        names = ("graph", "taxels", "edges", "directed") if system in GRAPH_SYSTEMS else ("taxels",)
        return {name: self.options.get(name) for name in names}


def plan_of(candidate: Candidate, sensor: Sensor, training: Recordings) -> Plan:
    """What a candidate is trained as; DataError if the sensor has no grid for it."""
    options = candidate.options
    recipe = RECIPES[options["recipe"]]
    sizes = {name: options[name] for name in ("features", "hops") if name in options}
    penalty = options.get("spike_penalty", 0.0)
    recipe = replace(recipe, **sizes, hidden=hidden_sizes(options["hidden"]), penalty=penalty)
    layers = recipe.layers
    recipe = replace(
        recipe,
        betas=tuple(each for each in recipe.betas if each[0] in layers),
        alphas=tuple(each for each in recipe.alphas if each[0] in layers),
    )
    graph = sensor.graph
    return Plan(
        system=candidate.system,
        graph=graph if candidate.system in GRAPH_SYSTEMS else taxels_alone(graph.coordinates),
        grid=sensor_grid(graph.coordinates, "none") if candidate.system == GRID_CNN else None,
        recipe=recipe,
        copies=None,
        bins=options["join"],
        classes=int(training.labels.max()) + 1,
        steps=training.steps,
    )


def without(
    plan: Plan,
    training: Recordings,
    held: BoolArray,
    epochs: int,
    target: Target,
    trunk: Path | None = None,
    seed: int = 0,
) -> Any:
    """The netlist of a network that some recordings are left out of.

    With a `trunk` it goes on from what was trained for fewer epochs, see :func:`train.train`.
    """
    from spikeloom.models.network_kinds import kind_of  # torch, so only here
    from spikeloom.models.training.train import train

    kind = kind_of(plan.system)
    steps = joined_bins(training, plan.bins)
    seen = steps.part(~held)
    with redirect_stderr(io.StringIO()):  # no bars of several processes on one terminal
        made = train(
            seen,
            steps.part(np.flatnonzero(held)[:1]),  # to be looked at after each epoch, which takes time
            seen_by(plan),
            kind.architecture(plan),
            epochs=epochs,
            seed=seed,
            recipe=plan.recipe,
            trunk=trunk if plan.recipe.schedule == PLATEAU else None,
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "network.pt")
        kind.save(file, {"last": made.last}, plan, {})
        loaded = load_network(str(file), NetworkChoice())
        events = np.ascontiguousarray(seen.events)
        options = Options(training_events=events, storage=Fixed((Packing(bits=8),)))
        return compile_network(loaded.network, options, target=target).netlist
