"""Networks of whole numbers, trained as crossbar cores hold them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spikeloom.compiler.dynamics import clocks_over
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.truenorth.native import DEFAULT_COPIES, SYSTEM
from spikeloom.compiler.targets.truenorth.native_file import Trained, read_trained, write_trained
from spikeloom.models.networks.surrogate import FAST_SIGMOID, Surrogate
from spikeloom.models.training.plan import Plan, same_graph
from spikeloom.models.training.recipes import ADAMW, COSINE, CROSS_ENTROPY, Recipe
from spikeloom.models.truenorth import network

SYSTEMS: tuple[str, ...] = (SYSTEM,)

read = read_trained

CROSSBARS = Recipe(
    name="truenorth",
    epochs=30,
    batch=4,
    loss=CROSS_ENTROPY,
    gain=60.0,
    surrogate=Surrogate(shape=FAST_SIGMOID, width=0.5, reset=False),
    optimizer=ADAMW,
    weight_decay=0.01,
    learning_rate=3e-3,
    schedule=COSINE,
    features=16,
    clocks=5,
)
"""How such networks are trained; they have no other recipe."""

REFUSED = {
    "--recipe": "has a recipe of its own",
    "--current-decay": "has no currents that decay",
    "--membrane-decay": "has no membranes that decay",
    "--join": "takes bins as they are; train on what spikeloom data convert --join makes",
    "--hidden": "fills the axons of its cores",
    "--hops": "has the hops of the released networks",
    "--spike-penalty": "is trained without",
}


def recipe_for(name: str, given: Mapping[str, Any]) -> Recipe:  # noqa: ARG001 -- there is one
    """The only recipe; OptionError if an option is given that such networks do not take."""
    for option, reason in REFUSED.items():
        if option in given:
            raise OptionError(f"{option} {given[option]}: a network of system {SYSTEM} {reason}; omit it")
    return CROSSBARS


def architecture(plan: Plan) -> network.NativeArchitecture:
    """Sizes that fill the axons of a core."""
    return network.size_network(
        taxels=plan.graph.n_taxels,
        classes=plan.classes,
        hops=plan.recipe.hops,
        features=plan.recipe.features,
        copies=plan.copies or DEFAULT_COPIES,
        clocks=clocks_over(plan.recipe.clocks, plan.steps),
    )


def save(path: Path, kept: Mapping[str, Any], plan: Plan, record: Mapping[str, Any]) -> None:
    """Write the whole numbers of each epoch."""
    sizes = architecture(plan)
    networks = {which: network.native_network(sizes, arrays) for which, arrays in kept.items()}
    write_trained(path, networks, graph=plan.graph.name, edges=plan.graph.edges, training=record)


def differing(found: Trained, plan: Plan) -> list[str]:
    """Names of what differs between a file and a plan."""
    same = {
        "graph": same_graph(found, plan),
        "copies": found.network.copies == (plan.copies or DEFAULT_COPIES),
    }
    return [name for name, equal in same.items() if not equal]
