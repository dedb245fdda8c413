"""The command line: parse, call one library function, print.

Exit codes: 0 fine, 1 a check failed, 2 a user's mistake (one line on stderr, a traceback only with ``--debug``).
Results go to stdout, progress to stderr when it is a terminal.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError, SpikeloomError, UnfinishedError
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.targets.base import load_target, with_tables
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import is_netlist, read_netlist
from spikeloom.compiler.targets.truenorth.netlist_file import is_crossbars
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.models.recordings.windows import first_part, window_asked
from spikeloom.runtime.commands.check import explain, stress
from spikeloom.runtime.commands.check import yardsticks as yardstick_command
from spikeloom.runtime.commands.choose import anytime, bits, chart, lean
from spikeloom.runtime.commands.exchange import export, watch
from spikeloom.runtime.commands.exchange.data import add_data_commands
from spikeloom.runtime.commands.inputs import (
    asked_checkpoint,
    asked_recordings,
    progress,
    require_inspectable,
    require_place,
    version,
)
from spikeloom.runtime.commands.load_network import asked_network
from spikeloom.runtime.commands.main_job import report
from spikeloom.runtime.commands.main_job.compile import compile_netlist
from spikeloom.runtime.commands.options import (
    MIN_AGREEMENT,
    add_compile,
    add_detail,
    add_model,
    add_recordings,
    add_training,
    add_verify,
)
from spikeloom.runtime.commands.training import finetune, join, reproduce
from spikeloom.runtime.commands.training.train import train
from spikeloom.runtime.costs.spent import Account, explained
from spikeloom.runtime.equivalence import verdicts
from spikeloom.runtime.machines.loihi1.trace import BoolArray
from spikeloom.runtime.machines.truenorth import commands as truenorth
from spikeloom.runtime.machines.truenorth import native
from spikeloom.runtime.report import decisions, render
from spikeloom.runtime.report.tables import show

Arguments = argparse.Namespace
Report = dict[str, Any]
Outcome = tuple[Report, Callable[[Report], str], int]
"""JSON values, how to print them for people, and the exit code."""

DEMO = (
    ("compile", "pretrained:grasps", "--calibrate", SYNTHETIC, "-o", "{folder}/grasps.loom"),
    ("verify", "{folder}/grasps.loom", "--checkpoint", "pretrained:grasps", "--data", SYNTHETIC),
    ("estimate", "{folder}/grasps.loom", "--data", SYNTHETIC),
)
"""The main job on what the package ships; ``demo`` runs these commands in a temporary folder."""


def _sha256(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _recordings(arguments: Arguments, netlist: Netlist, *, labels_for: str | None = None) -> Recordings:
    percent = window_asked(arguments.window)
    found = asked_recordings(arguments, netlist, labels_for=labels_for)
    return first_part(found, percent)


def _inspect(arguments: Arguments) -> Outcome:
    require_inspectable(arguments.path)
    if native.is_named(arguments.path):
        return native.inspect(arguments)
    if is_netlist(arguments.path):
        for name in ("beta", "theta", "weights", "run", "system"):
            value = getattr(arguments, name)
            if value is not None and (name, value) != ("run", 0):
                raise OptionError(f"--{name} {value}: is for checkpoints, {arguments.path} is a netlist; leave it away")
        if is_crossbars(arguments.path):
            return truenorth.inspect(arguments.path)
        netlist = read_netlist(arguments.path)
        uses = measure(netlist, load_target(netlist.target))
        return render.netlist_json(netlist, uses, _sha256(arguments.path)), render.netlist_text, 0
    given = tuple(name for name in ("beta", "theta") if getattr(arguments, name) is not None)
    return render.checkpoint_json(asked_checkpoint(arguments.path, arguments), given), render.checkpoint_text, 0


def _run(arguments: Arguments) -> Outcome:
    from spikeloom.runtime.machines.loihi1 import engine
    from spikeloom.runtime.machines.loihi1.trace import aligned
    from spikeloom.runtime.machines.votes import class_counts, predictions

    if arguments.spikes is not None:
        require_place(arguments.spikes, "--spikes", arguments)
    if is_crossbars(arguments.netlist):
        return truenorth.run(arguments)
    netlist = read_netlist(arguments.netlist)
    data = _recordings(arguments, netlist)
    progress("running")
    events = with_clocks(data.events, netlist.clocks)
    account = Account(netlist, data)
    found: Report | None = None
    if arguments.detail == "spikes":
        account.begin("spikes" if arguments.spikes is None else "spikes kept")
        trace = engine.simulate(netlist, events, lengths=data.lengths, spikes=arguments.spikes is not None)
        spikes, kept = trace.counts.spikes, trace.spikes
    else:
        shape = len(data), data.steps + netlist.max_depth, netlist.n_compartments
        kept = None if arguments.spikes is None else np.zeros(shape, np.bool_)
        account.begin(arguments.detail)
        spikes, found = _costs(arguments, netlist, data, kept)
    account.begin("no float")
    if kept is not None:
        layers = {layer.name: aligned(netlist, kept, i) for i, layer in enumerate(netlist.layers)}
        with write_atomically(arguments.spikes) as file:
            np.savez_compressed(file, **layers)  # type: ignore[arg-type]
    decided = predictions(netlist, spikes)
    report = decisions.run_json(data.files, data.labels, class_counts(netlist, spikes), decided)
    report |= {} if found is None else {"costs": found}
    return report | explained(arguments, account), decisions.run_text, 0


def _verify(arguments: Arguments) -> Outcome:
    from spikeloom.runtime.equivalence.levels import levels_of, parse_requirements, unmet
    from spikeloom.runtime.equivalence.verify import verify

    if is_crossbars(arguments.netlist):
        return native.verify(arguments)
    agreement = MIN_AGREEMENT if arguments.min_agreement is None else arguments.min_agreement
    if not 0 <= agreement <= 1:
        raise OptionError(f"--min-agreement {agreement}: not a share; give a number from 0 to 1")
    required = {"E0": 1.0, "E3": agreement}
    if arguments.require is not None:
        if arguments.min_agreement is not None:
            raise OptionError(
                f"--min-agreement {agreement:g}: --require replaces it; write E3={agreement:g} into that instead"
            )
        required = parse_requirements(arguments.require)
    netlist = read_netlist(arguments.netlist)
    asked = asked_network(arguments.checkpoint, arguments, netlist)
    original = None if arguments.original is None else asked_network(arguments.original, arguments)
    data = _recordings(arguments, netlist, labels_for="verify")
    account = Account(netlist, data, checked=arguments.spec_samples)
    verdict = verify(
        netlist,
        asked.model,
        asked.adjacency,
        data.events,
        data.labels,
        data.files,
        original=None if original is None else original.model,
        sha256=asked.sha256,
        spec_samples=arguments.spec_samples,
        engine_name=arguments.engine,
        lengths=data.lengths,
        progress=account.begin,
    )
    told = explained(arguments, account)
    compiled_for = netlist.provenance.get("graph", asked.graph)
    if asked.graph not in (None, compiled_for):
        sys.stderr.write(
            f"spikeloom: warning: the netlist was compiled for graph {compiled_for}, this is {asked.graph}\n"
        )
    levels = levels_of(verdict)
    missed = unmet(levels, required)
    return verdicts.verify_json(verdict, levels, missed) | told, verdicts.verify_text, 1 if missed else 0


def _estimate(arguments: Arguments) -> Outcome:
    from spikeloom.runtime.costs.estimates import estimate_text

    if is_crossbars(arguments.netlist):
        return truenorth.estimate(arguments)
    netlist = read_netlist(arguments.netlist)
    data = _recordings(arguments, netlist)
    account = Account(netlist, data)
    account.begin(arguments.detail)
    _, report = _costs(arguments, netlist, data)
    account.begin("no float")
    return report | explained(arguments, account), estimate_text, 0


def _costs(
    arguments: Arguments, netlist: Netlist, data: Recordings, spikes: BoolArray | None = None
) -> tuple[IntArray, Report]:
    """Spikes of each compartment, and what the recordings cost at the detail that was asked for; fills `spikes`."""
    from spikeloom.runtime.costs.estimate import estimate
    from spikeloom.runtime.costs.estimates import estimate_json

    progress("running")
    target = load_target(netlist.target)
    target = target if arguments.table is None else with_tables(target, arguments.table)
    counts, found = estimate(
        netlist,
        target,
        with_clocks(data.events, netlist.clocks),
        lengths=data.lengths,
        detail=arguments.detail,
        spikes=spikes,
        progress=lambda done: progress(f"running: {done} of {len(data)}"),
    )
    return counts.spikes, estimate_json(netlist, target, found, bin_s=arguments.bin * netlist.bins)


def _demo(_arguments: Arguments) -> Outcome:
    parser = build_parser()
    reports: Report = {}
    sections: list[str] = []
    worst = 0
    with tempfile.TemporaryDirectory(prefix="spikeloom-") as folder:
        for words in DEMO:
            step = parser.parse_args([word.format(folder=folder) for word in words])
            reports[step.command], as_text, code = step.action(step)
            typed = " ".join(words).replace("{folder}/", "")
            sections.append(f"$ spikeloom {typed}\n{as_text(reports[step.command])}")
            worst = max(worst, code)
    return reports, lambda _: "\n\n".join(sections), worst


class _Parser(argparse.ArgumentParser):
    """Reports a wrong command line in one line, as any other mistake is."""

    def error(self, message: str) -> NoReturn:
        raise OptionError(f"{message}; see {self.prog} --help")


def build_parser() -> argparse.ArgumentParser:
    """Describe every command and option."""
    parser = _Parser(
        prog="spikeloom",
        description="Lower a trained spiking graph network for touch to a Loihi netlist, run it bit for bit, "
        "compare it with the float model and price it.",
    )
    parser.add_argument("--version", action="version", version=f"spikeloom {version()}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, action: Callable[[Arguments], Outcome], summary: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=summary, description=summary)
        sub.set_defaults(action=action)
        sub.add_argument("--json", action="store_true", help="print the result as one JSON object")
        sub.add_argument("--debug", action="store_true", help="show a traceback on errors")
        return sub

    sub = command("compile", compile_netlist, "lower a checkpoint to a netlist that obeys every limit of the chip")
    add_compile(sub)

    sub = command("inspect", _inspect, "show a netlist (layers, scales, cores, fill of every limit) or a checkpoint")
    sub.add_argument("path")
    add_model(sub, graph=False)

    sub = command("run", _run, "run a netlist exactly as the chip would")
    sub.add_argument("netlist")
    add_recordings(sub, window=True)
    add_detail(sub, ("spikes", "counts", "cycle"), "spikes")
    sub.add_argument("--spikes", metavar="OUT.npz", help="write the spikes of every layer, aligned with the data")

    sub = command("verify", _verify, "compare chip and float model, spike for spike")
    add_verify(sub)

    sub = command("estimate", _estimate, "synaptic operations, energy and time of an inference")
    sub.add_argument("netlist")
    add_recordings(sub, window=True)
    add_detail(sub, ("counts", "cycle"), "counts")

    sub = command("train", train, "train a network by the released protocol, reported by the paper's and a clean one")
    add_training(sub)
    anytime.add_arguments(command("anytime", anytime.anytime, anytime.SUMMARY))
    bits.add_arguments(command("bits", bits.bits, bits.SUMMARY))
    chart.add_arguments(command("chart", chart.chart, chart.SUMMARY))
    explain.add_arguments(command("explain", explain.explain, explain.SUMMARY))
    export.add_arguments(command("export", export.export, export.SUMMARY))
    finetune.add_arguments(command("finetune", finetune.finetune, finetune.SUMMARY))
    join.add_arguments(command("join", join.join, join.SUMMARY))
    lean.add_arguments(command("lean", lean.lean, lean.SUMMARY))
    report.add_arguments(command("report", report.report, report.SUMMARY))
    reproduce.add_arguments(command("reproduce", reproduce.reproduce, reproduce.SUMMARY))
    stress.add_arguments(command("stress", stress.stress, stress.SUMMARY))
    watch.add_arguments(command("watch", watch.watch, watch.SUMMARY))
    yardstick_command.add_arguments(command("yardsticks", yardstick_command.measure, yardstick_command.SUMMARY))
    add_data_commands(commands)
    command("demo", _demo, "the main job on a shipped checkpoint and synthetic grasps; needs no file and no network")
    return parser


def _mistake(error: Exception) -> str:
    """Lines for a user: one, or one per violated limit."""
    if isinstance(error, OSError) and error.strerror:
        where = error.filename or "a file"
        return f"{where}: {error.strerror}; check space and permissions, nothing was changed"
    if isinstance(error, MemoryError):
        return f"out of memory ({error or 'no size known'}); give fewer recordings with --limit"
    return " ".join([str(error), *(f"({note})" for note in getattr(error, "__notes__", ()))])


def _go_on(words: Sequence[str], more: Sequence[str]) -> str:
    """Command that goes on where one has left off.

    Examples
    --------
    >>> _go_on(["chart", "a b.pt", "--fresh"], ()), _go_on(["reproduce", "--resume"], ["--resume"])
    ("spikeloom chart 'a b.pt'", 'spikeloom reproduce --resume')
    """
    return shlex.join(["spikeloom", *(w for w in words if w != "--fresh"), *(w for w in more if w not in words)])


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code."""
    words = sys.argv[1:] if argv is None else argv
    try:
        arguments = build_parser().parse_args(words)
        report, as_text, code = arguments.action(arguments)
        progress("")
        show(json.dumps(report) if arguments.json else as_text(report))
        return int(code)
    except (SpikeloomError, OSError, MemoryError) as error:
        progress("")
        if "--debug" in words:
            raise
        sys.stderr.writelines(f"spikeloom: {line}\n" for line in _mistake(error).splitlines())
        if isinstance(error, UnfinishedError):
            sys.stderr.write(f"spikeloom: go on with: {_go_on(words, error.resume)}\n")
            return 1
        return 2
    except KeyboardInterrupt as interrupt:
        progress("")
        sys.stderr.write(f"spikeloom: interrupted; {str(interrupt) or 'nothing was written'}\n")
        return 2
