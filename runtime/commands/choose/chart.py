"""The command ``chart``: accuracy against energy, time and size, for every configuration of a grid."""

from pathlib import Path

from spikeloom.compiler.errors import OptionError, require_least
from spikeloom.compiler.targets import DEFAULT_TARGET
from spikeloom.compiler.targets.base import load_target
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.choose import ChartRequest
from spikeloom.runtime.studies.chart.grid import Grid, parse_grid
from spikeloom.runtime.studies.chart.networks import read_networks, require_grid, require_suited
from spikeloom.runtime.studies.cluster import on_cluster
from spikeloom.runtime.studies.search.budgets import parse_budgets
from spikeloom.runtime.studies.search.results import chosen_by, data_of

NOTES = """\
Axes of the grid: bits (of a weight, 2-6, 8, or one a layer as in 8+4+4+8), planes (synapses that hold a weight, 1-3),
groups (scales in a layer, 1-8), prune (1 leaves out neurons that did not fire on training recordings, 0 does not),
cores (cores, the fewest, or at least so many for a layer, as in fc1:6+conv1:4), window (first part of each recording,
25-100% is every quarter, 25-100%:5 every twentieth). The choice, the cheapest point that is at most a point less
accurate than the best, is made on the training split, the test split is reported. A chart that was interrupted goes on
with the same command; netlists and figures are kept in FOLDER: delete it to measure anew. The exit code is 1 if no
point fits a budget.
"""


REQUEST = ChartRequest


@on_cluster
def run(request: ChartRequest) -> Outcome:
    """Run the command; exit code 1 if no point fits a budget."""
    from spikeloom.runtime.studies.chart.sections import printed, write_chart
    from spikeloom.runtime.studies.chart.study import STORE, chart
    from spikeloom.runtime.studies.chart.work import groups_in, read_splits

    target = load_target(DEFAULT_TARGET)
    grid = Grid() if request.grid is None else parse_grid(request.grid, target)
    budgets = parse_budgets(request.budget)
    folder = Path(request.output)
    if folder.is_file():
        raise OptionError(f"-o {folder}: is not a folder; name another")
    require_least(vars(request), jobs=1)
    require_place(str(folder / STORE if folder.exists() else folder), "-o", request)
    networks = read_networks(request)
    tables = [table.name for table in target.energy]
    if request.table not in (None, *tables):
        raise OptionError(
            f"--table {request.table}: {target.title} has no such energy table; give {' or '.join(tables)}"
        )
    progress("reading the recordings")
    splits = read_splits(request.data, request.bin, networks[0], request.groups)
    data = data_of(request.data, splits["test"].seconds, splits["train"], splits["test"])
    require_suited(networks, splits, data.sha256)
    require_grid(networks, grid, target)
    folder.mkdir(exist_ok=True)
    options = repeat.words(
        repeat.given(request, ("data", *repeat.NETWORK, "grid", "table", "bin", "groups"))
    )
    options += [word for budget in request.budget for word in ("--budget", budget)]
    command = repeat.command("chart", *request.checkpoints, *options, "-o", request.output)
    charted = chart(
        networks,
        target,
        data,
        grid,
        budgets,
        folder,
        by=chosen_by(target, request.table),
        command=command,
        jobs=request.jobs,
        groups=groups_in(splits, request.groups),
    )
    write_chart(folder, charted)
    return Outcome(charted, printed, 0 if charted.budget.fits else 1)
