"""Train what a request asks for: networks by gradients, or a counting network by a linear rule."""

from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import OptionError, require_least
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.models.recordings.evtouch import WHOLE, first_part, parse_window
from spikeloom.models.training.counters import Plan
from spikeloom.models.training.recipes import RELEASED
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import given_places, sensor_places
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.files import require_place, write_picture
from spikeloom.runtime.inputs.recordings import require_bins, warn_of_few
from spikeloom.runtime.report.drawing import PICTURES
from spikeloom.runtime.requests.training import TrainRequest
from spikeloom.runtime.studies.counting import CountersReport, train_counters
from spikeloom.runtime.studies.left_out import announce, condition_folds, networks_left_out
from spikeloom.runtime.studies.training.plan import RECIPE, both_splits, plan_jobs, recipe_of, sensor_of
from spikeloom.runtime.studies.training.results import TrainingReport, picture, summary
from spikeloom.runtime.studies.training.seeds import train_seeds

COUNTERS_ONLY = ("thresholds", "parts", "ramp", "levels", "weight_bits")
"""Options of counting networks alone."""

NOT_COUNTERS = (
    "padding",
    "graph",
    "edges",
    "directed",
    "copies",
    *RECIPE,
    "epochs",
    "resume",
    "keep",
    "picture",
)
"""Options that counting networks do not take."""


def train_networks(request: TrainRequest) -> TrainingReport:
    """Train every seed and write the checkpoints."""
    repeat.refuse(request, COUNTERS_ONLY, "is for --system counters")
    require_least(vars(request), seeds=1, epochs=1, decay_epochs=1, seed=0)
    require_bins(request.join)
    require_place(request.output, "-o", request, ["pt"])
    require_place(request.picture, "--picture", request, PICTURES)
    recipe_of(request)  # which refuses, before the recordings are read
    graph, _ = sensor_of(request)
    percent = WHOLE if request.window is None else parse_window(request.window)
    training, test = (
        first_part(each, percent)
        for each in both_splits(request.data, graph.n_taxels, request.bin, request.groups)
    )
    if request.join > 1:
        warn_of_few(training, request.join)
    folds = []
    if request.groups is not None:
        folds = condition_folds(training, request.groups)
        announce(request.groups, folds)
    jobs = plan_jobs(request, training, test)
    runs = train_seeds(jobs, resume=request.resume)
    write_picture(request.picture, lambda: picture(runs))
    left_out = None
    if folds:
        first = jobs[0]
        store = Path(f"{request.output}.folds.sqlite")
        left_out = networks_left_out(
            first.plan, training, folds, epochs=first.epochs, seed=first.seed, store=store
        )
    return TrainingReport(runs=runs, protocols=summary(runs), left_out=left_out)


def train_counting(request: TrainRequest) -> CountersReport:
    """Train a counting network and write it: no epochs, no seeds."""
    repeat.refuse(request, NOT_COUNTERS, "counters are trained without")
    if (request.recipe, request.seed, request.seeds) != (RELEASED.name, 0, 1):
        raise OptionError("--system counters: one rule without chance; omit --recipe, --seed and --seeds")
    require_bins(request.join)
    require_place(request.output, "-o", request, ["pt"])
    options = {
        name: value for name, value in repeat.given(request, COUNTERS_ONLY).items() if value is not None
    }
    if request.window is not None:
        options["window"] = parse_window(request.window)
    data = {"data": Path(request.data).name, "system": COUNTING, "bin": request.bin}
    typed = repeat.words({**data, "taxels": request.taxels, **options})
    if request.join > 1:
        typed += ["--join", str(request.join)]
    plan = _counting_plan(request.join, options)
    taxels = None if request.taxels is None else len(sensor_places(request.taxels))
    training, test = both_splits(request.data, taxels, request.bin, request.groups)
    if request.join > 1:
        warn_of_few(training, request.join)
    folds = []
    if request.groups is not None:
        folds = condition_folds(training, request.groups)
        announce(request.groups, folds, parts=0)
    command = repeat.command("train", *typed)
    places = given_places(request.taxels)
    return train_counters(plan, training, test, command, request.output, folds, places)


def _counting_plan(bins: int, options: dict[str, Any]) -> Plan:
    """What the network is to be, from the options that were given."""
    values = dict(options)
    if "thresholds" in values:
        values["thresholds"] = tuple(whole_numbers(values["thresholds"], "--thresholds"))
    if "weight_bits" in values:
        values["bits"] = values.pop("weight_bits")
    plan = Plan(bins=bins, **values)
    plan.require_possible()
    if plan.window < WHOLE and plan.parts == 1:
        raise OptionError(
            f"--window {plan.window}%: counters see what comes later; give --parts 2 or more, which gates them"
        )
    return plan
