"""The command line: parse, call one library function, print.

Exit codes: 0 fine, 1 a check failed, 2 a user's mistake (one line on stderr, a traceback only with ``--debug``).
Results go to stdout, progress to stderr when it is a terminal.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from compiler.atomic import write_atomically
from compiler.errors import OptionError, SpikeloomError
from compiler.frontends.checkpoint import Checkpoint, read_checkpoint
from compiler.netlist import Netlist
from compiler.passes.legalize import measure
from compiler.passes.quantize import RANGES
from compiler.pipeline import STAGES, compile_checkpoint
from compiler.serialize import is_netlist, read_netlist, write_netlist
from compiler.targets import load_target
from compiler.text import text
from models.evtouch import Recordings
from models.graphs import CHOICES, build_graph, normalised_adjacency
from runtime import render
from runtime.inputs import SYNTHETIC, propagation, recordings, require_place, shipped
from runtime.tables import show

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


def version() -> str:
    """Version of the installed package."""
    return metadata.version("spikeloom")


def _progress(label: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{label} …" if label else "\r\x1b[K")
        sys.stderr.flush()


def _sha256(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _checkpoint(path: str, arguments: Arguments) -> Checkpoint:
    _progress("reading the checkpoint")
    return read_checkpoint(
        shipped(path), run=arguments.run, weights=arguments.weights, beta=arguments.beta, theta=arguments.theta
    )


def _recordings(arguments: Arguments, netlist: Netlist) -> Recordings:
    _progress("reading the recordings")
    return recordings(
        arguments.data,
        arguments.split,
        limit=arguments.limit,
        classes=netlist.classes,
        taxels=netlist.taxels,
    )


def _compile(arguments: Arguments) -> Outcome:
    require_place(arguments.output, "-o")
    load_target(arguments.target)
    checkpoint = _checkpoint(arguments.checkpoint, arguments)
    name, adjacency = propagation(checkpoint, arguments.graph, arguments.checkpoint)
    training = None
    if arguments.calibrate is not None:
        _progress("reading the recordings")
        training = recordings(arguments.calibrate, "train", classes=checkpoint.classes, taxels=checkpoint.taxels).events
    _progress("compiling")

    def dump(stage: str, artefact: Any) -> None:
        if stage in arguments.dump_after:
            sys.stderr.write(text(artefact))

    compilation = compile_checkpoint(
        checkpoint,
        adjacency,
        target=arguments.target,
        weight_bits=arguments.weight_bits,
        training_events=training,
        ranges=arguments.ranges,
        margin=arguments.margin,
        provenance={
            "spikeloom": version(),
            "checkpoint_sha256": checkpoint.sha256,
            "run": arguments.run,
            "weights": arguments.weights,
            "graph": name,
            "weight_bits": arguments.weight_bits,
            "ranges": arguments.ranges,
            "margin": arguments.margin,
            "calibrated": training is not None,
        },
        after=dump,
    )
    report = render.compilation_json(compilation, write_netlist(compilation.netlist, arguments.output))
    return report, render.compilation_text, 0


def _inspect(arguments: Arguments) -> Outcome:
    if is_netlist(arguments.path):
        netlist = read_netlist(arguments.path)
        uses = measure(netlist, load_target(netlist.target))
        return render.netlist_json(netlist, uses, _sha256(arguments.path)), render.netlist_text, 0
    given = tuple(name for name in ("beta", "theta") if getattr(arguments, name) is not None)
    return render.checkpoint_json(_checkpoint(arguments.path, arguments), given), render.checkpoint_text, 0


def _run(arguments: Arguments) -> Outcome:
    from runtime import engine
    from runtime.trace import aligned
    from runtime.votes import class_counts, predictions

    if arguments.spikes is not None:
        require_place(arguments.spikes, "--spikes")
    netlist = read_netlist(arguments.netlist)
    data = _recordings(arguments, netlist)
    _progress("running")
    events = data.events.reshape(len(data), -1, data.steps)
    trace = engine.simulate(netlist, events, spikes=arguments.spikes is not None)
    if trace.spikes is not None:
        layers = {layer.name: aligned(netlist, trace.spikes, i) for i, layer in enumerate(netlist.layers)}
        with write_atomically(arguments.spikes) as file:
            np.savez_compressed(file, **layers)  # type: ignore[arg-type]
    counts = class_counts(netlist, trace.counts.spikes)
    report = render.run_json(data.files, data.labels, counts, predictions(netlist, trace.counts.spikes))
    return report, render.run_text, 0


def _verify(arguments: Arguments) -> Outcome:
    from runtime.equivalence import verify

    if not 0 <= arguments.min_agreement <= 1:
        raise OptionError(f"--min-agreement {arguments.min_agreement}: not a share; give a number from 0 to 1")
    netlist = read_netlist(arguments.netlist)
    checkpoint = _checkpoint(arguments.checkpoint, arguments)
    _, adjacency = propagation(checkpoint, arguments.graph, arguments.checkpoint)
    data = _recordings(arguments, netlist)
    verdict = verify(
        netlist,
        checkpoint,
        adjacency,
        data.events,
        data.labels,
        data.files,
        spec_samples=arguments.spec_samples,
        progress=_progress,
    )
    good = verdict.spec_equals_engine and verdict.decision_agreement >= arguments.min_agreement
    return render.verify_json(verdict), render.verify_text, 0 if good else 1


def _estimate(arguments: Arguments) -> Outcome:
    from runtime import cost, engine

    netlist = read_netlist(arguments.netlist)
    data = _recordings(arguments, netlist)
    _progress("running")
    events = data.events.reshape(len(data), -1, data.steps)
    trace = engine.simulate(netlist, events)
    costs = cost.estimate(netlist, load_target(netlist.target), trace.counts, data.steps)
    return render.estimate_json(netlist, costs), render.estimate_text, 0


def _train(arguments: Arguments) -> Outcome:
    from models.checkpoint import save_checkpoint, training_record
    from models.networks import Architecture
    from models.train import train

    require_place(arguments.output, "-o")
    graph = build_graph(arguments.graph)
    _progress("reading the recordings")
    training = recordings(arguments.data, "train", classes=None, taxels=graph.n_taxels)
    test = recordings(arguments.data, "test", classes=int(training.labels.max()) + 1, taxels=graph.n_taxels)
    _progress("")
    architecture = Architecture(taxels=graph.n_taxels, classes=int(training.labels.max()) + 1)
    trained = train(
        training,
        test,
        normalised_adjacency(graph.edges, graph.n_taxels),
        architecture,
        epochs=arguments.epochs,
        seed=arguments.seed,
    )
    data = arguments.data if arguments.data == SYNTHETIC else training.source
    command = f"spikeloom train --data {data} --graph {graph.name} --epochs {arguments.epochs}"
    record = training_record(trained, training, test, command=f"{command} --seed {arguments.seed}", seed=arguments.seed)
    save_checkpoint(
        arguments.output,
        {"last": trained.last, "best": trained.best},
        graph,
        beta=architecture.beta,
        theta=architecture.theta,
        training=record | {"spikeloom": version()},
    )
    return record | {"sha256": _sha256(arguments.output)}, render.training_text, 0


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


def _inputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data", required=True, metavar="PATH", help="folder or zip in the released layout, or 'synthetic'"
    )
    parser.add_argument("--split", default="test", help="split to read (default: test)")
    parser.add_argument("--limit", type=int, metavar="N", help="first N recordings only")


def _inputs_of_training(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", required=True, metavar="PATH", help="folder, zip, or 'synthetic'")
    parser.add_argument("--graph", required=True, help=f"taxel graph: {CHOICES}")
    parser.add_argument("--epochs", type=int, default=100, metavar="N", help="default: 100, as released")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of weights and order (default: 0)")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.pt")


def _model(parser: argparse.ArgumentParser, *, graph: bool = True) -> None:
    if graph:
        parser.add_argument("--graph", help=f"taxel graph that it was trained on: {CHOICES}")
    parser.add_argument("--run", type=int, default=0, metavar="N", help="which run of a released file (default: 0)")
    parser.add_argument(
        "--weights",
        choices=("last", "best"),
        default="last",
        help="epoch, where a checkpoint holds both (default: last)",
    )
    parser.add_argument("--beta", type=float, help="membrane decay, where the file does not say (default: 0.2)")
    parser.add_argument("--theta", type=float, help="threshold, where the file does not say (default: 0.5)")


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

    sub = command("compile", _compile, "lower a checkpoint to a netlist that obeys every limit of the chip")
    sub.add_argument("checkpoint")
    _model(sub)
    sub.add_argument("--target", default="loihi1", help="chip (default: loihi1)")
    sub.add_argument(
        "--weight-bits", type=int, default=8, help="storage width of the weights: 2 to 6 or 8 (default: 8)"
    )
    sub.add_argument("--calibrate", metavar="PATH", help="recordings whose train split chooses the scales")
    sub.add_argument(
        "--ranges", default="proven", help=f"how overflow is excluded: {' or '.join(RANGES)} (default: proven)"
    )
    sub.add_argument("--margin", type=float, default=0.1, help="share added to observed ranges (default: 0.1)")
    sub.add_argument(
        "--dump-after", action="append", default=[], choices=STAGES, help="print the network after a stage, on stderr"
    )
    sub.add_argument("-o", "--output", required=True, metavar="NET.loom")

    sub = command("inspect", _inspect, "show a netlist (layers, scales, cores, fill of every limit) or a checkpoint")
    sub.add_argument("path")
    _model(sub, graph=False)

    sub = command("run", _run, "run a netlist exactly as the chip would")
    sub.add_argument("netlist")
    _inputs(sub)
    sub.add_argument("--spikes", metavar="OUT.npz", help="write the spikes of every layer, aligned with the data")

    sub = command("verify", _verify, "compare chip and float model, spike for spike")
    sub.add_argument("netlist")
    sub.add_argument("--checkpoint", required=True)
    _model(sub)
    _inputs(sub)
    sub.add_argument(
        "--spec-samples", type=int, default=3, metavar="N", help="recordings for spec = engine (default: 3)"
    )
    sub.add_argument(
        "--min-agreement",
        type=float,
        default=0.95,
        metavar="X",
        help="share of equal decisions to pass (default: 0.95)",
    )

    sub = command("estimate", _estimate, "synaptic operations, spikes, neuron updates and energy of an inference")
    sub.add_argument("netlist")
    _inputs(sub)

    sub = command("train", _train, "train a network by the released protocol; keeps the last and the best epoch")
    _inputs_of_training(sub)
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


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code."""
    words = sys.argv[1:] if argv is None else argv
    try:
        arguments = build_parser().parse_args(words)
        report, as_text, code = arguments.action(arguments)
        _progress("")
        show(json.dumps(report) if arguments.json else as_text(report))
        return int(code)
    except (SpikeloomError, OSError, MemoryError) as error:
        _progress("")
        if "--debug" in words:
            raise
        sys.stderr.writelines(f"spikeloom: {line}\n" for line in _mistake(error).splitlines())
        return 2
    except KeyboardInterrupt:
        _progress("")
        sys.stderr.write("spikeloom: interrupted; nothing was written\n")
        return 2
