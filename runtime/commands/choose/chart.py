"""The command ``chart``: accuracy against energy, time and size, for every configuration of a grid."""

import argparse
from functools import partial
from pathlib import Path

from spikeloom.compiler import DEFAULT_TARGET
from spikeloom.compiler.errors import OptionError, require_least
from spikeloom.compiler.targets.base import load_target
from spikeloom.runtime.commands.options import add_data, add_model
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.chart.grid import Grid, parse_grid
from spikeloom.runtime.studies.chart.networks import read_networks, require_grid, require_suited
from spikeloom.runtime.studies.chart.results import data_of
from spikeloom.runtime.studies.fronts import parse_budgets

NOTES = """\
Axes of the grid: bits (2-6, 8, or one a layer as in 8+4+4+8), planes (1-3), groups (1-8), prune (0, 1), cores (cores,
or LAYER:N as in fc1:6+conv1:4), window (per cent of each recording, 25-100% is every quarter,
25-100%:5 every twentieth). The choice, the cheapest point that is at most a point less accurate than the best, is made
on the training split, the test split is reported. A chart that was interrupted goes on with the same command; netlists
and figures are kept in FOLDER: delete it to measure anew. The exit code is 1 if no point fits a budget.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("checkpoints", nargs="+", metavar="CKPT", help="trained networks of one data set")
    add_model(parser)
    add_data(parser)
    what = "configurations, as in bits=2-6,8,planes=1-2,window=25-100%% (default: bits=2-6,8,window=25-100%%)"
    parser.add_argument("--grid", metavar="AXIS=V,V,…", help=what)
    what = "of the point to deploy: energy=0.1mJ, latency=5ms or accuracy=88; may be repeated, all of them hold"
    parser.add_argument("--budget", action="append", default=[], metavar="WHAT=LIMIT", help=what)
    parser.add_argument("--table", metavar="NAME", help="energy table to choose and draw by (default: the first)")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at a time (default: one a core)")
    parser.add_argument("-o", "--output", required=True, metavar="FOLDER")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; exit code 1 if no point fits a budget."""
    from spikeloom.runtime.studies.chart.sections import printed, write_chart
    from spikeloom.runtime.studies.chart.study import STORE, chart
    from spikeloom.runtime.studies.chart.work import read_splits

    target = load_target(DEFAULT_TARGET)
    grid = Grid() if arguments.grid is None else parse_grid(arguments.grid, target)
    budgets = parse_budgets(arguments.budget)
    folder = Path(arguments.output)
    if folder.is_file():
        raise OptionError(f"-o {folder}: is not a folder; name another")
    require_least(vars(arguments), jobs=1)
    require_place(str(folder / STORE if folder.exists() else folder), "-o", arguments)
    networks = read_networks(arguments)
    tables = [table.name for table in target.energy]
    energy = tables[0] if arguments.table is None else arguments.table
    if energy not in tables:
        raise OptionError(f"--table {energy}: {target.title} has no such energy table; give {' or '.join(tables)}")
    progress("reading the recordings")
    splits = read_splits(arguments.data, arguments.bin, networks[0])
    data = data_of(arguments.data, splits["test"].seconds, splits["train"], splits["test"])
    require_suited(networks, splits, data.sha256)
    require_grid(networks, grid, target)
    folder.mkdir(exist_ok=True)
    options = repeat.words(repeat.given(arguments, ("data", *repeat.NETWORK, "grid", "table", "bin")))
    options += [word for budget in arguments.budget for word in ("--budget", budget)]
    command = repeat.command("chart", *arguments.checkpoints, *options, "-o", arguments.output)
    charted = chart(networks, target, data, grid, budgets, folder, energy=energy, command=command, jobs=arguments.jobs)
    write_chart(folder, charted)
    return Outcome(charted, partial(printed, folder=str(folder)), 0 if charted.budget.fits else 1)
