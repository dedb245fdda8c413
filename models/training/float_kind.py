"""Networks of real numbers, for chips whose compiler rounds them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from spikeloom.compiler import systems
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.models.networks.networks import Architecture
from spikeloom.models.training.plan import Plan, same_graph
from spikeloom.models.training.recipes import RECIPES, Recipe

SYSTEMS: tuple[str, ...] = systems.SYSTEMS

read = read_checkpoint


def recipe_for(name: str, given: Mapping[str, Any]) -> Recipe:
    """The recipe of that name; OptionError if copies of inputs are given."""
    if "--copies" in given:
        raise OptionError(f"--copies {given['--copies']}: is for chips whose inputs have copies; omit it")
    return RECIPES[name]


def architecture(plan: Plan) -> Architecture:
    """Sizes, and decays and clocks of the recipe."""
    plain = Architecture(
        taxels=plan.graph.n_taxels,
        classes=plan.classes,
        system=plan.system,
        features=plan.recipe.features,
        hops=plan.recipe.hops,
        hidden=plan.recipe.hidden,
    )
    return replace(
        plain, dynamics=plan.recipe.dynamics(plan.recipe.layers, plain.beta, -(-plan.steps // plan.bins))
    )


def save(path: Path, kept: Mapping[str, Any], plan: Plan, record: Mapping[str, Any]) -> None:
    """Write a checkpoint."""
    sizes = architecture(plan)
    save_checkpoint(
        path,
        kept,
        taxels=plan.graph.n_taxels,
        graph=plan.graph.name,
        edges=plan.graph.edges,
        beta=sizes.beta,
        theta=sizes.theta,
        training=record,
        system=plan.system,
        grid=plan.grid,
        dynamics=sizes.dynamics,
        bins=plan.bins,
    )


def differing(found: Checkpoint, plan: Plan) -> list[str]:
    """Names of what differs between a checkpoint and a plan."""
    ours, theirs = (None if grid is None else grid.to_json() for grid in (plan.grid, found.grid))
    same = {
        "graph": same_graph(found, plan),
        "system": found.system == plan.system and ours == theirs,
        "bins": found.bins == plan.bins,
    }
    return [name for name, equal in same.items() if not equal]
