"""The command ``train``: one system, any number of seeds, reported at three epochs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.errors import DataError, OptionError, require_least
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.systems import GRAPH_SYSTEMS, GRID_CNN, TACTILESGNET, TITLES, Grid
from spikeloom.compiler.targets.native import DEFAULT_COPIES
from spikeloom.compiler.targets.native import SYSTEM as NATIVE
from spikeloom.models.graphs import CHOICES, Graph
from spikeloom.models.recordings.evtouch import WHOLE, Recordings, first_part, parse_window
from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.models.systems import sensor_grid, taxels_alone
from spikeloom.models.training.plan import Plan
from spikeloom.models.training.recipes import RELEASED, STEPS, Recipe, check_recipe, decays_asked
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import load_graph, sensor_places
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.files import require_picture, require_place, write_picture
from spikeloom.runtime.inputs.recordings import recordings, require_bins, require_splits
from spikeloom.runtime.report.console import progress, tell
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.training import TrainRequest
from spikeloom.runtime.studies.training import (
    Job,
    TrainingReport,
    output_of,
    picture,
    summary,
    train_seeds,
    training_sections,
)

REQUEST = TrainRequest


def run(request: TrainRequest) -> Outcome:
    """Train every seed, write the checkpoints, report."""
    if request.system == COUNTING:
        return _count(request)
    repeat.refuse(request, COUNTERS_ONLY, "is for --system counters")
    if request.seeds < 1:
        raise OptionError(f"--seeds {request.seeds}: at least 1 is needed; give a positive number")
    require_bins(request.join)
    require_place(request.output, "-o", request, ["pt"])
    require_picture(request, ())
    require_least(vars(request), epochs=1, decay_epochs=1, seed=0)
    _recipe(request)  # which refuses, before the recordings are read
    graph, _ = _sensor(request)
    percent = WHOLE if request.window is None else parse_window(request.window)
    training, test = (first_part(each, percent) for each in both_splits(request.data, graph.n_taxels, request.bin))
    if percent < WHOLE:
        tell(f"note: of every recording the first {percent} % train; give --window {percent}% to what runs the network")
    records = train_seeds(plan_jobs(request, training, test), resume=request.resume)
    write_picture(request.picture, lambda: picture(records))
    return Outcome(TrainingReport(runs=records, protocols=summary(records)), training_sections)


SIZES = ("clocks", "features", "hops", "hidden")
OVERRIDES = ("current_decay", "membrane_decay", *SIZES, "batch", "decay_epochs", "spike_penalty", "robust")
"""Options that change single values of a recipe."""

COUNTERS_ONLY = ("thresholds", "parts", "ramp", "levels", "weight_bits")
NOT_COUNTERS = ("padding", "graph", "edges", "directed", "copies", *OVERRIDES, "epochs", "resume", "keep", "picture")


def _count(request: TrainRequest) -> Outcome:
    """Train a counting network: no epochs, no seeds."""
    from spikeloom.models.training.counters import Plan
    from spikeloom.runtime.studies.counting import counters_sections, train_counters

    repeat.refuse(request, NOT_COUNTERS, "counters are trained without")
    if (request.recipe, request.seed, request.seeds) != (RELEASED.name, 0, 1):
        raise OptionError("--system counters: one rule without chance; omit --recipe, --seed and --seeds")
    require_bins(request.join)
    require_place(request.output, "-o", request, ["pt"])
    asked = {name: value for name, value in repeat.given(request, COUNTERS_ONLY).items() if value is not None}
    if request.window is not None:
        asked["window"] = parse_window(request.window)
    typed = repeat.words({"data": Path(request.data).name, "system": COUNTING, "bin": request.bin, **asked})
    if request.join > 1:
        typed += ["--join", str(request.join)]
    if "thresholds" in asked:
        asked["thresholds"] = tuple(whole_numbers(asked["thresholds"], "--thresholds"))
    if "weight_bits" in asked:
        asked["bits"] = asked.pop("weight_bits")
    plan = Plan(bins=request.join, **asked)
    plan.require_possible()
    if plan.window < WHOLE and plan.parts == 1:
        raise OptionError(
            f"--window {plan.window}%: counters see what comes later; give --parts 2 or more, which gates them"
        )
    taxels = None if request.taxels is None else len(sensor_places(request.taxels))
    training, test = both_splits(request.data, taxels, request.bin)
    report = train_counters(plan, training, test, repeat.command("train", *typed), request.output)
    return Outcome(report, counters_sections)


def both_splits(data: str, taxels: int | None, bin_s: float | None) -> tuple[Recordings, Recordings]:
    """Training and test recordings of a sensor, every one with its label."""
    progress("reading the recordings")
    require_splits(data)
    shared: dict[str, Any] = {"bin_s": bin_s, "labels_for": "training", "classes": None}
    training = recordings(data, "train", taxels=taxels, **shared)
    try:
        test = recordings(data, "test", taxels=training.taxels, **shared)
    except DataError as error:
        if taxels is None:
            error.add_note(f"the training recordings have {training.taxels} taxels; if more exist, give --taxels N")
        raise
    progress("")
    known = int(training.labels.max())
    if missing := sorted(set(range(known)) - set(training.labels.tolist())):
        tell(f"warning: {training.source}: no recordings to train class {', '.join(map(str, missing))} on")
    if test.labels.max() > known:
        first = int((test.labels > known).argmax())
        where = f"{test.source}: {test.split}/{test.files[first]}"
        raise DataError(
            f"{where}: label {test.labels[first]}, the training recordings have 0..{known}; add some of it to them, or "
            "omit it from the test split"
        )
    return training, test


def plan_jobs(request: TrainRequest, training: Recordings, test: Recordings) -> list[Job]:
    """One job for each seed that the options ask for, on recordings of their data."""
    graph, grid = _sensor(request)
    system = request.system or TACTILESGNET
    recipe = _recipe(request)
    epochs = recipe.epochs if request.epochs is None else request.epochs
    data = SYNTHETIC if request.data == SYNTHETIC else training.source
    command = " ".join(_words(request, {"data": data}, {"epochs": epochs}))
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
        )
        for position, seed in enumerate(range(request.seed, request.seed + request.seeds))
    ]


def _recipe(request: TrainRequest) -> Recipe:
    """The recipe that was named, with the values that were given beside it."""
    recipe = _named_recipe(request)
    whole = repeat.given(request, ("clocks", "features", "hops", "batch", "decay_epochs", "robust"))
    whole["penalty"] = request.spike_penalty
    if request.hidden is not None:
        whole["hidden"] = tuple(whole_numbers(request.hidden, "--hidden"))
    recipe = replace(recipe, **{name: value for name, value in whole.items() if value is not None})
    if request.decay_epochs is not None and recipe.schedule != STEPS:
        raise OptionError(
            f"--decay-epochs {request.decay_epochs}: the recipe {recipe.name} lowers its learning rate all along; "
            "omit it"
        )
    for decays, option in (("alphas", "current_decay"), ("betas", "membrane_decay")):
        if (words := getattr(request, option)) is not None:
            asked: Any = decays_asked(words, f"--{option.replace('_', '-')}", recipe.layers)
            recipe = replace(recipe, **{decays: asked})
    if request.hops is not None and request.system not in (None, TACTILESGNET):
        raise OptionError(f"--hops {request.hops}: {TITLES[request.system]} has no hops to choose; omit it")
    check_recipe(recipe)
    return recipe


def _named_recipe(request: TrainRequest) -> Recipe:
    """What was named, or the only one of a system that has its own."""
    from spikeloom.models.network_kinds import kind_of

    names = ("recipe", "current_decay", "membrane_decay", "join", "spike_penalty", "copies", "hidden", "hops")
    usual = {"recipe": RELEASED.name, "join": 1}
    given = {name: value for name, value in repeat.given(request, names).items() if value != usual.get(name)}
    options = {f"--{name.replace('_', '-')}": value for name, value in given.items()}
    return kind_of(request.system or TACTILESGNET).recipe_for(request.recipe, options)


def _words(request: TrainRequest, first: dict[str, Any], last: dict[str, Any]) -> list[str]:
    """The words that ask for the same training, without the seed and the output."""
    names = ("bin", "join", "window", "system", "padding", "copies", "graph", "taxels", "edges", "directed", "recipe")
    usual = {"join": 1, "system": TACTILESGNET, "copies": DEFAULT_COPIES, "recipe": RELEASED.name}
    recipe = _named_recipe(request)
    usual |= {name: getattr(recipe, name, None) for name in OVERRIDES}
    options = repeat.given(request, (*names, *OVERRIDES))
    options = {name: None if value == usual.get(name) else value for name, value in options.items()}
    files = {name: Path(options[name]).name for name in ("taxels", "edges") if options[name]}
    return ["spikeloom", "train", *repeat.words(first | options | files | last)]


def _sensor(request: TrainRequest) -> tuple[Graph, Grid | None]:
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
