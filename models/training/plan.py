"""What determines a network before it is trained, and what each kind of network offers.

All kinds are listed in :mod:`models.network_kinds`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from spikeloom.compiler.systems import SYSTEMS, TACTILESGNET, Grid
from spikeloom.compiler.types import FloatArray
from spikeloom.models.graphs import Graph
from spikeloom.models.systems import filters_of, propagation_of
from spikeloom.models.training.recipes import Recipe

if TYPE_CHECKING:
    from spikeloom.models.networks.networks import Sizes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """What determines a network before it is trained."""

    system: str
    graph: Graph
    grid: Grid | None  # Of a grid-based CNN
    recipe: Recipe
    copies: int | None  # Axons of an input, on a chip that may have several
    bins: int  # Bins of the recordings that a step joins
    # classes, steps: Of the training recordings, in their own bins
    classes: int
    steps: int


class Stored(Protocol):
    """A checkpoint of any kind."""

    @property
    def training(self) -> Mapping[str, Any] | None:
        """Its training record."""

    @property
    def sets(self) -> tuple[str, ...]:
        """Epochs that it holds."""


class NetworkKind(Protocol):
    """What the module of a kind of network offers: its sizes, how it is stored and read back."""

    SYSTEMS: tuple[str, ...]

    def recipe_for(self, name: str, given: Mapping[str, Any]) -> Recipe:
        """The recipe of that name; refuses options, by name and value, that the kind does not take."""

    def architecture(self, plan: Plan) -> Sizes:
        """Sizes of the network."""

    def save(self, path: Path, kept: Mapping[str, Any], plan: Plan, record: Mapping[str, Any]) -> None:
        """Write the weights of some epochs, and how they were trained."""

    def read(self, path: Path) -> Stored:
        """Read what `save` wrote."""

    def differing(self, found: Any, plan: Plan) -> list[str]:
        """Names of what differs between a checkpoint and a plan."""


def seen_by(plan: Plan) -> FloatArray:
    """What the first layer sees; systems of a single chip convolve as TactileSGNet does."""
    taxels = plan.graph.n_taxels
    system = plan.system if plan.system in SYSTEMS else TACTILESGNET
    return propagation_of(
        system, plan.graph.edges, taxels, plan.grid, filters_of(system, taxels, plan.recipe.hops)
    )


def same_graph(found: Any, plan: Plan) -> bool:
    """Whether a checkpoint was trained on the graph of the plan, edge for edge."""
    return bool(found.graph == plan.graph.name and np.array_equal(found.edges, plan.graph.edges))
