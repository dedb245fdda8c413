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
from compiler.passes.quantize import RANGES, Recipe
from compiler.pipeline import STAGES, compile_checkpoint
from compiler.serialize import is_netlist, read_netlist, write_netlist
from compiler.targets import load_target
from compiler.text import text
from models.evtouch import Recordings
from models.graphs import CHOICES
from runtime import render, watch
from runtime.data_commands import add_bin_option, add_data_commands
from runtime.inputs import (
    SYNTHETIC,
    asked_graph,
    graph_words,
    propagation,
    recordings,
    require_place,
    shipped,
)
from runtime.options import add_model, add_recordings, add_training
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


def _recordings(arguments: Arguments, netlist: Netlist, *, labels_for: str | None = None) -> Recordings:
    _progress("reading the recordings")
    return recordings(
        arguments.data,
        arguments.split,
        limit=arguments.limit,
        classes=netlist.classes,
        taxels=netlist.taxels,
        bin_s=arguments.bin,
        labels_for=labels_for,
    )


def _numbers(text: str, option: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise OptionError(f"{option} {text}: not a number; give one, or one for each layer as in 8,4,4,8") from None


def _recipes(arguments: Arguments) -> tuple[Recipe, ...]:
    asked = {
        "--weight-bits": _numbers(arguments.weight_bits, "--weight-bits"),
        "--planes": _numbers(arguments.planes, "--planes"),
        "--scale-groups": _numbers(arguments.scale_groups, "--scale-groups"),
    }
    layers = max(len(values) for values in asked.values())
    for option, values in asked.items():
        if len(values) not in (1, layers):
            raise OptionError(f"{option}: {len(values)} numbers, another option gives {layers}; give as many, or one")
    columns = [values if len(values) == layers else values * layers for values in asked.values()]
    return tuple(Recipe(bits=b, planes=p, groups=g) for b, p, g in zip(*columns, strict=True))


def _one_or_list(values: list[int]) -> int | list[int]:
    return values[0] if len(set(values)) == 1 else values


def _compile(arguments: Arguments) -> Outcome:
    require_place(arguments.output, "-o")
    load_target(arguments.target)
    recipes = _recipes(arguments)
    checkpoint = _checkpoint(arguments.checkpoint, arguments)
    name, adjacency = propagation(checkpoint, asked_graph(arguments), arguments.checkpoint)
    training = None
    if arguments.calibrate is not None:
        _progress("reading the recordings")
        training = recordings(
            arguments.calibrate,
            "train",
            classes=checkpoint.classes,
            taxels=checkpoint.taxels,
            bin_s=arguments.bin,
        ).events
    _progress("compiling")

    def dump(stage: str, artefact: Any) -> None:
        if stage in arguments.dump_after:
            sys.stderr.write(text(artefact))

    compilation = compile_checkpoint(
        checkpoint,
        adjacency,
        target=arguments.target,
        recipes=recipes,
        spike_exact=arguments.spike_exact,
        training_events=training,
        ranges=arguments.ranges,
        margin=arguments.margin,
        provenance={
            "spikeloom": version(),
            "checkpoint_sha256": checkpoint.sha256,
            "run": arguments.run,
            "weights": checkpoint.weights,
            "graph": name,
            "weight_bits": _one_or_list([recipe.bits for recipe in recipes]),
            "planes": _one_or_list([recipe.planes for recipe in recipes]),
            "scale_groups": _one_or_list([recipe.groups for recipe in recipes]),
            "spike_exact": arguments.spike_exact,
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
    from runtime.levels import levels_of, parse_requirements, unmet

    if not 0 <= arguments.min_agreement <= 1:
        raise OptionError(f"--min-agreement {arguments.min_agreement}: not a share; give a number from 0 to 1")
    required = {"E0": 1.0, "E3": arguments.min_agreement}
    if arguments.require is not None:
        required = parse_requirements(arguments.require)
    netlist = read_netlist(arguments.netlist)
    checkpoint = _checkpoint(arguments.checkpoint, arguments)
    name, adjacency = propagation(checkpoint, asked_graph(arguments), arguments.checkpoint)
    data = _recordings(arguments, netlist, labels_for="verify")
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
    compiled_for = netlist.provenance.get("graph", name)
    if compiled_for != name:
        sys.stderr.write(f"spikeloom: warning: the netlist was compiled for graph {compiled_for}, this is {name}\n")
    levels = levels_of(verdict)
    missed = unmet(levels, required)
    return render.verify_json(verdict, levels, missed), render.verify_text, 1 if missed else 0


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
    from runtime.training import (
        PICTURES,
        PROTOCOLS,
        Job,
        check_seeds,
        draw_training,
        output_of,
        summary,
        train_seeds,
        training_text,
    )

    check_seeds(arguments.seeds)
    require_place(arguments.output, "-o")
    if arguments.picture is not None:
        require_place(arguments.picture, "--picture")
        if Path(arguments.picture).suffix not in PICTURES:
            raise OptionError(f"--picture {arguments.picture}: allowed are {', '.join(PICTURES)}; name one of these")
    graph = asked_graph(arguments)
    if graph is None:
        raise OptionError(f"train: no graph; name it with --graph: {CHOICES}, or give --edges")
    _progress("reading the recordings")
    shared: dict[str, Any] = {"taxels": graph.n_taxels, "bin_s": arguments.bin, "labels_for": "training"}
    training = recordings(arguments.data, "train", classes=None, **shared)
    test = recordings(arguments.data, "test", classes=int(training.labels.max()) + 1, **shared)
    _progress("")
    data = arguments.data if arguments.data == SYNTHETIC else training.source
    command = f"spikeloom train --data {data} {graph_words(arguments)} --epochs {arguments.epochs}"
    keep = tuple(dict.fromkeys(arguments.keep or PROTOCOLS))
    jobs = [
        Job(
            training=training,
            test=test,
            graph=graph,
            epochs=arguments.epochs,
            seed=seed,
            device=arguments.device,
            resume=arguments.resume,
            output=output_of(arguments.output, seed, arguments.seeds),
            keep=keep,
            command=f"{command} --seed {seed}",
            facts={"spikeloom": version(), "device": arguments.device},
            position=position,
        )
        for position, seed in enumerate(range(arguments.seed, arguments.seed + arguments.seeds))
    ]
    results = train_seeds(jobs)
    records = [record for record, _ in results]
    if arguments.picture is not None:
        draw_training(arguments.picture, records, test.labels, [predicted for _, predicted in results])
    return {"runs": records, "protocols": summary(records)}, training_text, 0


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

    sub = command("compile", _compile, "lower a checkpoint to a netlist that obeys every limit of the chip")
    sub.add_argument("checkpoint")
    add_model(sub)
    sub.add_argument("--target", default="loihi1", help="chip (default: loihi1)")
    sub.add_argument(
        "--weight-bits",
        default="8",
        metavar="N[,N]",
        help="storage width, one or one a layer: 2 to 6 or 8 (default: 8)",
    )
    sub.add_argument("--planes", default="1", metavar="N[,N]", help="times a synapse is stored, 1 to 3 (default: 1)")
    sub.add_argument("--scale-groups", default="1", metavar="N[,N]", help="scales in a layer, 1 to 8 (default: 1)")
    sub.add_argument(
        "--spike-exact",
        action="store_true",
        help="add planes and scales until the training spikes are the float model's",
    )
    sub.add_argument("--calibrate", metavar="PATH", help="recordings whose train split chooses the scales")
    add_bin_option(sub)
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
    add_model(sub, graph=False)

    sub = command("run", _run, "run a netlist exactly as the chip would")
    sub.add_argument("netlist")
    add_recordings(sub)
    sub.add_argument("--spikes", metavar="OUT.npz", help="write the spikes of every layer, aligned with the data")

    sub = command("verify", _verify, "compare chip and float model, spike for spike")
    sub.add_argument("netlist")
    sub.add_argument("--checkpoint", required=True)
    add_model(sub)
    add_recordings(sub)
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
    sub.add_argument(
        "--require",
        metavar="E0,E2=X,E3=X",
        help="levels to pass instead: E0 specification = engine, E2 share of spikes in every layer, E3 of decisions",
    )

    sub = command("estimate", _estimate, "synaptic operations, spikes, neuron updates and energy of an inference")
    sub.add_argument("netlist")
    add_recordings(sub)

    sub = command("train", _train, "train a network by the released protocol, reported by the paper's and a clean one")
    add_training(sub)
    watch.add_arguments(command("watch", watch.watch, watch.SUMMARY))
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
