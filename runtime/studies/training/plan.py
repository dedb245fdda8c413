"""What a request to train asks for: the recipe, the sensor, the recordings, and a job for each seed."""

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.systems import GRAPH_SYSTEMS, GRID_CNN, TACTILESGNET, TITLES, Grid
from spikeloom.compiler.targets.native import DEFAULT_COPIES
from spikeloom.compiler.targets.native import SYSTEM as NATIVE
from spikeloom.compiler.types import JsonObject
from spikeloom.models.graphs import CHOICES, Graph
from spikeloom.models.recordings.classes import without_gaps
from spikeloom.models.recordings.evtouch import Recordings, parse_window
from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.models.systems import sensor_grid, taxels_alone
from spikeloom.models.training.plan import Plan
from spikeloom.models.training.recipes import RELEASED, STEPS, Recipe, check_recipe, parse_decays
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import given_places, load_graph, sensor_places
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.recordings import recordings, require_splits, warn_of_missing, warn_of_shared
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.requests.training import TrainRequest
from spikeloom.runtime.studies.training.seeds import Job, output_of

SIZES = ("clocks", "features", "hops", "hidden")
RECIPE = ("current_decay", "membrane_decay", *SIZES, "batch", "decay_epochs", "spike_penalty", "robust")
"""Options that change single values of a recipe."""


def both_splits(
    data: str, taxels: int | None, bin_s: float | None, groups: str | None = None
) -> tuple[Recordings, Recordings]:
    """Training and test recordings of a sensor, all of them labelled."""
    progress("reading the recordings")
    require_splits(data)
    shared: dict[str, Any] = {"bin_s": bin_s, "labels_for": "training", "classes": None, "groups": groups}
    training = recordings(data, "train", taxels=taxels, **shared)
    try:
        test = recordings(data, "test", taxels=training.taxels, **shared)
    except DataError as error:
        if taxels is None:
            error.add_note(
                f"the training recordings have {training.taxels} taxels; if more exist, give --taxels N"
            )
        raise
    progress("")
    training, test = without_gaps(training, test)
    _require_classes(training, test)
    warn_of_shared(training, test)
    return training, test


def _require_classes(training: Recordings, test: Recordings) -> None:
    """Refuse test recordings of classes beyond those of training; warn of others that training has not seen."""
    highest = int(training.labels.max())
    warn_of_missing(training, (label for label in test.labels.tolist() if label <= highest))
    if test.labels.max() > highest:
        first = int((test.labels > highest).argmax())
        where = f"{test.source}: {test.split}/{test.files[first]}"
        last = f"0..{highest}" if test.names is None else f"{highest + 1} others"
        raise DataError(
            f"{where}: label {test.class_name(int(test.labels[first]))}, the training recordings have {last}; "
            "add some of it to them, or omit it from the test split"
        )


def plan_jobs(request: TrainRequest, training: Recordings, test: Recordings) -> list[Job]:
    """One job for each seed that the options ask for, on recordings of their data."""
    graph, grid = sensor_of(request)
    system = request.system or TACTILESGNET
    recipe = recipe_of(request)
    epochs = recipe.epochs if request.epochs is None else request.epochs
    data = SYNTHETIC if request.data == SYNTHETIC else training.source
    command = shlex.join(_words(request, {"data": data}, {"epochs": epochs}))
    plan = Plan(
        system=system,
        graph=graph,
        grid=grid,
        recipe=recipe,
        copies=request.copies,
        bins=request.join,
        classes=int(training.labels.max()) + 1,
        steps=training.steps,
    )
    return [
        Job(
            plan=plan,
            training=training,
            test=test,
            epochs=epochs,
            seed=seed,
            resume=request.resume,
            output=output_of(request.output, seed, request.seeds),
            keep=tuple(dict.fromkeys(request.keep or WEIGHTS)),
            command=f"{command} --seed {seed}",
            position=position,
            window=None if request.window is None else parse_window(request.window),
            positions_mm=given_places(request.taxels),
        )
        for position, seed in enumerate(range(request.seed, request.seed + request.seeds))
    ]


def recipe_of(request: TrainRequest) -> Recipe:
    """The recipe that is named, with the values that are given beside it."""
    recipe = _named_recipe(request)
    values = repeat.given(request, ("clocks", "features", "hops", "batch", "decay_epochs", "robust"))
    values["penalty"] = request.spike_penalty
    if request.hidden is not None:
        values["hidden"] = hidden_sizes(request.hidden)
    recipe = replace(recipe, **{name: value for name, value in values.items() if value is not None})
    if request.decay_epochs is not None and recipe.schedule != STEPS:
        raise OptionError(
            f"--decay-epochs {request.decay_epochs}: the recipe {recipe.name} lowers its learning rate all along; "
            "omit it"
        )
    if request.current_decay is not None:
        alphas = parse_decays(request.current_decay, "--current-decay", recipe.layers)
        recipe = replace(recipe, alphas=alphas)
    if request.membrane_decay is not None:
        betas = parse_decays(request.membrane_decay, "--membrane-decay", recipe.layers)
        recipe = replace(recipe, betas=betas)
    if request.hops is not None and request.system not in (None, TACTILESGNET):
        raise OptionError(f"--hops {request.hops}: {TITLES[request.system]} has no hops to choose; omit it")
    check_recipe(recipe)
    return recipe


def hidden_sizes(words: str) -> tuple[int, ...]:
    """Neurons of each dense layer but the last, from the words of ``--hidden``; ``none`` is no such layer."""
    return () if words == "none" else tuple(whole_numbers(words, "--hidden"))


def _named_recipe(request: TrainRequest) -> Recipe:
    """The recipe of that name, or the only one of a system that has its own."""
    from spikeloom.models.network_kinds import kind_of  # torch, so only here

    names = (
        "recipe",
        "current_decay",
        "membrane_decay",
        "join",
        "spike_penalty",
        "copies",
        "hidden",
        "hops",
    )
    options = _changed(repeat.given(request, names), {"recipe": RELEASED.name, "join": 1})
    typed = {f"--{name.replace('_', '-')}": value for name, value in options.items()}
    return kind_of(request.system or TACTILESGNET).recipe_for(request.recipe, typed)


def _words(request: TrainRequest, first: dict[str, Any], last: dict[str, Any]) -> list[str]:
    """The words that ask for the same training, without the seed and the output."""
    names = (
        "bin",
        "join",
        "window",
        "system",
        "padding",
        "copies",
        "graph",
        "taxels",
        "edges",
        "directed",
        "recipe",
    )
    defaults = {"join": 1, "system": TACTILESGNET, "copies": DEFAULT_COPIES, "recipe": RELEASED.name}
    recipe = _named_recipe(request)
    defaults |= {name: getattr(recipe, name, None) for name in RECIPE}
    options = _changed(repeat.given(request, (*names, *RECIPE)), defaults)
    options |= {name: Path(options[name]).name for name in ("taxels", "edges") if options.get(name)}
    return ["spikeloom", "train", *repeat.words(first | options | last)]


def _changed(options: Mapping[str, Any], defaults: Mapping[str, Any]) -> JsonObject:
    """Options that differ from their defaults."""
    return {name: value for name, value in options.items() if value != defaults.get(name)}


def sensor_of(request: TrainRequest) -> tuple[Graph, Grid | None]:
    """Taxels, their graph, and the grid over them, as far as the system has these."""
    system = request.system or TACTILESGNET
    if system == NATIVE:
        system = TACTILESGNET  # and the same graphs
    if request.padding is not None and system != GRID_CNN:
        raise OptionError(f"--padding: is for grid-cnn, {TITLES[system]} has no window; omit it")
    graph = load_graph(request, system)
    if system not in GRAPH_SYSTEMS:
        places = sensor_places(request.taxels)
        grid = sensor_grid(places, request.padding or "none") if system == GRID_CNN else None
        return taxels_alone(places), grid
    if graph is None:
        raise OptionError(f"train: no graph; name it with --graph: {CHOICES}, or give --edges")
    return graph, None
