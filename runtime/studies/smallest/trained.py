"""Networks that are trained by gradients, as candidates: a part left out at a time, decided by the compiled network."""

import io
import tempfile
from collections.abc import Mapping
from contextlib import redirect_stderr
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.compartments import Options, compile_network
from spikeloom.compiler.types import IntArray, JsonObject
from spikeloom.models.graphs import Graph
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import taxels_alone
from spikeloom.models.training.plan import Plan, seen_by
from spikeloom.models.training.recipes import RECIPES
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.requests.choices import NetworkChoice
from spikeloom.runtime.studies.smallest.space import Candidate


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
    """What a candidate is trained as."""
    options = candidate.options
    hidden = tuple(whole_numbers(options["hidden"], "--hidden"))
    return Plan(
        system=candidate.system,
        graph=sensor.graph if candidate.system in GRAPH_SYSTEMS else taxels_alone(sensor.graph.coordinates),
        grid=None,
        recipe=replace(RECIPES[options["recipe"]], features=options["features"], hidden=hidden),
        copies=None,
        bins=options["join"],
        classes=int(training.labels.max()) + 1,
        steps=training.steps,
    )


def without(
    plan: Plan, training: Recordings, held: IntArray, epochs: int, target: Target, storage: int | None
) -> Any:
    """The netlist of a network that some recordings are left out of."""
    from spikeloom.models.network_kinds import kind_of  # torch, so only here
    from spikeloom.models.training.train import train

    kind, steps = kind_of(plan.system), joined_bins(training, plan.bins)
    seen, left = steps.part(~held), steps.part(held)
    with redirect_stderr(io.StringIO()):  # no bars of several processes on one terminal
        made = train(seen, left, seen_by(plan), kind.architecture(plan), epochs=epochs, recipe=plan.recipe)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "network.pt")
        kind.save(file, {"last": made.last}, plan, {})
        loaded = load_network(str(file), NetworkChoice())
        events = np.ascontiguousarray(seen.events)
        options = Options(training_events=events, storage=Fixed((Packing(bits=storage or 8),)))
        return compile_network(loaded.network, options, target=target).netlist
