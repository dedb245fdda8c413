"""The command ``train``: one system, any number of seeds, reported at three epochs."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.errors import DataError, OptionError, require_least
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.systems import GRAPH_SYSTEMS, GRID_CNN, SYSTEMS, TACTILESGNET, TITLES, Grid
from spikeloom.compiler.targets.native import BASES, USUAL_COPIES
from spikeloom.compiler.targets.native import SYSTEM as NATIVE
from spikeloom.models.graphs import CHOICES, Graph
from spikeloom.models.recordings.evtouch import WHOLE, Recordings, first_part, parse_window
from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.models.systems import PADDINGS, sensor_grid, taxels_alone
from spikeloom.models.training.kinds import Plan
from spikeloom.models.training.recipes import DECAY_EPOCHS, RECIPES, RELEASED, STEPS, Recipe, check_recipe, decays_asked
from spikeloom.runtime.commands.options import add_data, add_graph_options, add_picture, group
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.files import require_picture, require_place, write_picture
from spikeloom.runtime.inputs.network import load_graph, sensor_places
from spikeloom.runtime.inputs.recordings import recordings, require_bins, require_splits
from spikeloom.runtime.report.console import progress, tell
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.training import (
    Job,
    TrainingReport,
    output_of,
    picture,
    summary,
    train_seeds,
    training_sections,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_data(parser)
    what = "a step joins N bins, an event where one has any (default: 1)"
    parser.add_argument("--join", type=int, default=1, metavar="N", help=what)
    needing = ", ".join((*GRAPH_SYSTEMS, NATIVE))
    what = f"{', '.join((*SYSTEMS, NATIVE, COUNTING))} (default: {TACTILESGNET}; {needing} need a graph)"
    group(parser, "network").add_argument("--system", choices=(*SYSTEMS, NATIVE, COUNTING), help=what)
    what = "of a grid-cnn's window: none, moving by 2 (default), or same, of which no core holds all neurons"
    parser.add_argument("--padding", choices=PADDINGS, help=what)
    add_graph_options(parser, "to train on")
    defaults = ", ".join(f"{recipe.epochs} ({name})" for name, recipe in RECIPES.items())
    what = "how: as the released code does, or with lasting currents and clocks (default: released)"
    parser.add_argument("--recipe", choices=tuple(RECIPES), default=RELEASED.name, help=what)
    what = "share of the synaptic current that a step keeps: fc1=0.95"
    parser.add_argument("--current-decay", metavar="LAYER=X[,…]", help=what)
    what = "share of the membrane, where it is not 0.2: fc1=0.5"
    parser.add_argument("--membrane-decay", metavar="LAYER=X[,…]", help=what)
    parser.add_argument("--clocks", type=int, metavar="K", help="inputs that tell which K-th of the recording it is")
    parser.add_argument("--features", type=int, metavar="N", help="of the first layer, per place")
    parser.add_argument("--hops", type=int, metavar="K", help="of a tactilesgnet's graph convolution (default: 3)")
    parser.add_argument("--hidden", metavar="N[,N]", help="neurons of each dense layer but the last (default: 128,256)")
    what = f"axons of an input of {NATIVE} (default: {USUAL_COPIES})"
    parser.add_argument("--copies", type=int, choices=tuple(BASES), help=what)
    counting = group(parser, "counters")
    counting.add_argument("--thresholds", metavar="K[,K]", help="events at which counters spike (default: 1,4,16,64)")
    counting.add_argument("--parts", type=int, metavar="N", help="parts of a recording, counted apart (default: 1)")
    counting.add_argument("--ramp", type=int, metavar="N", help="silent steps of the read-out (default: 32)")
    what = "so many classes in a row are levels of one thing (default: 1)"
    counting.add_argument("--levels", type=int, metavar="N", help=what)
    what = "of a weight, 2 to 8 (default: 8; truenorth holds up to 5)"
    counting.add_argument("--weight-bits", type=int, metavar="N", help=what)
    parser.add_argument("--window", metavar="PERCENT", help="train on the first so many per cent of each recording")
    parser.add_argument("--batch", type=int, metavar="N", help="recordings to a step of the optimizer")
    what = "loss of a spike on every synapse in every step: fewer spikes"
    parser.add_argument("--spike-penalty", type=float, metavar="X", help=what)
    what = "chance of an event, and of a taxel, to be lost while training: 0.1"
    parser.add_argument("--robust", type=float, metavar="X", help=what)
    parser.add_argument("--epochs", type=int, metavar="N", help=f"default: {defaults}")
    what = f"the learning rate falls to a tenth every N epochs, after epoch N + 1 first (default: {DECAY_EPOCHS})"
    parser.add_argument("--decay-epochs", type=int, metavar="N", help=what)
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of weights and order (default: 0)")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train N seeds side by side (default: 1)")
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted training of the same options")
    what = "epoch to store: last, best (on test) or clean (on validation); may be repeated (default: all three)"
    parser.add_argument("--keep", action="append", choices=WEIGHTS, help=what)
    add_picture(parser, "learning curves")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.pt")


def run(arguments: argparse.Namespace) -> Outcome:
    """Train every seed, write the checkpoints, report."""
    if arguments.system == COUNTING:
        return _count(arguments)
    repeat.refuse(arguments, COUNTERS_ONLY, "is for --system counters")
    if arguments.seeds < 1:
        raise OptionError(f"--seeds {arguments.seeds}: at least 1 is needed; give a positive number")
    require_bins(arguments.join)
    require_place(arguments.output, "-o", arguments, ["pt"])
    require_picture(arguments, ())
    require_least(vars(arguments), epochs=1, decay_epochs=1, seed=0)
    _recipe(arguments)  # which refuses, before the recordings are read
    graph, _ = _sensor(arguments)
    percent = WHOLE if arguments.window is None else parse_window(arguments.window)
    training, test = (first_part(each, percent) for each in both_splits(arguments.data, graph.n_taxels, arguments.bin))
    if percent < WHOLE:
        tell(f"note: of every recording the first {percent} % train; give --window {percent}% to what runs the network")
    records = train_seeds(plan_jobs(arguments, training, test), resume=arguments.resume)
    write_picture(arguments.picture, lambda: picture(records))
    return Outcome(TrainingReport(runs=records, protocols=summary(records)), training_sections)


SIZES = ("clocks", "features", "hops", "hidden")
OVERRIDES = ("current_decay", "membrane_decay", *SIZES, "batch", "decay_epochs", "spike_penalty", "robust")
"""Options that change single values of a recipe."""

COUNTERS_ONLY = ("thresholds", "parts", "ramp", "levels", "weight_bits")
NOT_COUNTERS = ("padding", "graph", "edges", "directed", "copies", *OVERRIDES, "epochs", "resume", "keep", "picture")


def _count(arguments: argparse.Namespace) -> Outcome:
    """Train a counting network: no epochs, no seeds."""
    from spikeloom.models.training.counters import Plan
    from spikeloom.runtime.studies.counting import counters_sections, train_counters

    repeat.refuse(arguments, NOT_COUNTERS, "counters are trained without")
    if (arguments.recipe, arguments.seed, arguments.seeds) != (RELEASED.name, 0, 1):
        raise OptionError("--system counters: one rule without chance; omit --recipe, --seed and --seeds")
    require_bins(arguments.join)
    require_place(arguments.output, "-o", arguments, ["pt"])
    asked = {name: value for name, value in repeat.given(arguments, COUNTERS_ONLY).items() if value is not None}
    if arguments.window is not None:
        asked["window"] = parse_window(arguments.window)
    typed = repeat.words({"data": Path(arguments.data).name, "system": COUNTING, "bin": arguments.bin, **asked})
    if arguments.join > 1:
        typed += ["--join", str(arguments.join)]
    if "thresholds" in asked:
        asked["thresholds"] = tuple(whole_numbers(asked["thresholds"], "--thresholds"))
    if "weight_bits" in asked:
        asked["bits"] = asked.pop("weight_bits")
    plan = Plan(bins=arguments.join, **asked)
    plan.require_possible()
    if plan.window < WHOLE and plan.parts == 1:
        raise OptionError(
            f"--window {plan.window}%: counters see what comes later; give --parts 2 or more, which gates them"
        )
    taxels = None if arguments.taxels is None else len(sensor_places(arguments.taxels))
    training, test = both_splits(arguments.data, taxels, arguments.bin)
    report = train_counters(plan, training, test, repeat.command("train", *typed), arguments.output)
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


def plan_jobs(arguments: argparse.Namespace, training: Recordings, test: Recordings) -> list[Job]:
    """One job for each seed that the options ask for, on recordings of their data."""
    graph, grid = _sensor(arguments)
    system = arguments.system or TACTILESGNET
    recipe = _recipe(arguments)
    epochs = recipe.epochs if arguments.epochs is None else arguments.epochs
    data = SYNTHETIC if arguments.data == SYNTHETIC else training.source
    command = " ".join(_words(arguments, {"data": data}, {"epochs": epochs}))
    plan = Plan(
        system=system,
        graph=graph,
        grid=grid,
        recipe=recipe,
        copies=arguments.copies,
        bins=arguments.join,
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
            resume=arguments.resume,
            output=output_of(arguments.output, seed, arguments.seeds),
            keep=tuple(dict.fromkeys(arguments.keep or WEIGHTS)),
            command=f"{command} --seed {seed}",
            position=position,
        )
        for position, seed in enumerate(range(arguments.seed, arguments.seed + arguments.seeds))
    ]


def _recipe(arguments: argparse.Namespace) -> Recipe:
    """The recipe that was named, with the values that were given beside it."""
    recipe = _named_recipe(arguments)
    whole = repeat.given(arguments, ("clocks", "features", "hops", "batch", "decay_epochs", "robust"))
    whole["penalty"] = arguments.spike_penalty
    if arguments.hidden is not None:
        whole["hidden"] = tuple(whole_numbers(arguments.hidden, "--hidden"))
    recipe = replace(recipe, **{name: value for name, value in whole.items() if value is not None})
    if arguments.decay_epochs is not None and recipe.schedule != STEPS:
        raise OptionError(
            f"--decay-epochs {arguments.decay_epochs}: the recipe {recipe.name} lowers its learning rate all along; "
            "omit it"
        )
    for decays, option in (("alphas", "current_decay"), ("betas", "membrane_decay")):
        if (words := getattr(arguments, option)) is not None:
            asked: Any = decays_asked(words, f"--{option.replace('_', '-')}", recipe.layers)
            recipe = replace(recipe, **{decays: asked})
    if arguments.hops is not None and arguments.system not in (None, TACTILESGNET):
        raise OptionError(f"--hops {arguments.hops}: {TITLES[arguments.system]} has no hops to choose; omit it")
    check_recipe(recipe)
    return recipe


def _named_recipe(arguments: argparse.Namespace) -> Recipe:
    """What was named, or the only one of a system that has its own."""
    from spikeloom.models.training.kinds import kind_of

    names = ("recipe", "current_decay", "membrane_decay", "join", "spike_penalty", "copies", "hidden", "hops")
    usual = {"recipe": RELEASED.name, "join": 1}
    given = {name: value for name, value in repeat.given(arguments, names).items() if value != usual.get(name)}
    options = {f"--{name.replace('_', '-')}": value for name, value in given.items()}
    return kind_of(arguments.system or TACTILESGNET).recipe_for(arguments.recipe, options)


def _words(arguments: argparse.Namespace, first: dict[str, Any], last: dict[str, Any]) -> list[str]:
    """The words that ask for the same training, without the seed and the output."""
    names = ("bin", "join", "window", "system", "padding", "copies", "graph", "taxels", "edges", "directed", "recipe")
    usual = {"join": 1, "system": TACTILESGNET, "copies": USUAL_COPIES, "recipe": RELEASED.name}
    recipe = _named_recipe(arguments)
    usual |= {name: getattr(recipe, name, None) for name in OVERRIDES}
    options = repeat.given(arguments, (*names, *OVERRIDES))
    options = {name: None if value == usual.get(name) else value for name, value in options.items()}
    files = {name: Path(options[name]).name for name in ("taxels", "edges") if options[name]}
    return ["spikeloom", "train", *repeat.words(first | options | files | last)]


def _sensor(arguments: argparse.Namespace) -> tuple[Graph, Grid | None]:
    """Taxels, their graph, and the grid over them, as far as the system has these."""
    system = arguments.system or TACTILESGNET
    if system == NATIVE:
        system = TACTILESGNET  # and the same graphs
    if arguments.padding is not None and system != GRID_CNN:
        raise OptionError(f"--padding: is for grid-cnn, {TITLES[system]} has no window; omit it")
    graph = load_graph(arguments, system)
    if system not in GRAPH_SYSTEMS:
        places = sensor_places(arguments.taxels)
        grid = sensor_grid(places, arguments.padding or "none") if system == GRID_CNN else None
        return taxels_alone(places), grid
    if graph is None:
        raise OptionError(f"train: no graph; name it with --graph: {CHOICES}, or give --edges")
    return graph, None
