"""The ``finetune`` command: train a network on, on the integers of the chip."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from spikeloom.compiler import DEFAULT_TARGET, round_to_forms
from spikeloom.compiler.checkpoint import layers_of
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import remove_leftovers, sha256_of
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import COMPARTMENTS, load_target
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import data_digest
from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.runtime.commands.options import add_checkpoint, add_data
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import origin_of, recordings, require_splits
from spikeloom.runtime.report.encode import INLINE
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text
from spikeloom.runtime.studies.jobs import only_one

REPEATED = ("weight_bits", "scale_groups", "robust", "epochs", "seed")
"""Options of its own that decide the result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Before:
    """Test recordings that are right with the weights rounded, before any training."""

    correct: int
    accuracy: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Tuned(Before):
    """Test recordings that are right after the last epoch."""

    chosen_on: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneRecord:
    """Everything needed to repeat a fine-tuning, and what it reached; the fields are the keys in the checkpoint.

    `history` has the loss and the correct training recordings of each epoch.
    """

    command: str
    fine_tuned_from: str
    fine_tuned_weights: str
    weight_bits: Sequence[int]
    seed: int
    epochs: int
    data: str
    data_sha256: str
    test_samples: int
    before: Before
    last: Tuned
    history: Sequence[Sequence[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Finetuned:
    """A fine-tuning and the checkpoint that holds it."""

    record: FinetuneRecord = field(metadata=INLINE)
    file: str
    sha256: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_checkpoint(parser)
    add_data(parser)
    parser.add_argument("--target", default=DEFAULT_TARGET, help=f"chip (default: {DEFAULT_TARGET})")
    parser.add_argument(
        "--weight-bits", required=True, metavar="N[,N]", help="storage width, one or one a layer: 2 to 6 or 8"
    )
    parser.add_argument("--scale-groups", type=int, default=8, metavar="N", help="scales in a layer (default: 8)")
    parser.add_argument("--epochs", type=int, default=40, metavar="N", help="default: 40")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the order of recordings (default: 0)")
    parser.add_argument("--robust", type=float, metavar="X", help="chance of an event, and of a taxel, to be lost: 0.1")
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted one of the same options")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.pt")


def _state(output: Path, *, resume: bool) -> Path:
    """File of the epochs so far, of which neither an old one may be lost nor a missing one begun anew in silence."""
    state = output.with_name(f"{output.name}.state")
    if state.exists() and not resume:
        raise OptionError(
            f"{state}: an interrupted fine-tuning is kept there; go on with --resume, or delete the file to start anew"
        )
    if resume and not state.exists():
        raise OptionError(f"--resume: {state} does not exist, so nothing was interrupted; omit --resume")
    for file in (output, state):
        remove_leftovers(file)
    return state


def run(arguments: argparse.Namespace) -> Outcome:
    """Fine-tune, write the checkpoint, report; the text of a KeyboardInterrupt says what is kept."""
    require_place(arguments.output, "-o", arguments)
    with only_one(Path(arguments.output)):
        return Outcome(_finetuned(arguments, Path(arguments.output)), finetune_sections)


def _finetuned(arguments: argparse.Namespace, output: Path) -> Finetuned:
    """Fine-tune and write the checkpoint; return the report."""
    state = _state(output, resume=arguments.resume)
    target = load_target(arguments.target, COMPARTMENTS)
    widths = whole_numbers(arguments.weight_bits, "--weight-bits")
    path = arguments.checkpoint
    checkpoint = load_checkpoint(path, arguments)
    if checkpoint.forms is not None:
        raise ModelError(f"{path}: was fine-tuned already; give the network that it was made from")
    if not checkpoint.dynamics.is_plain:
        raise ModelError(
            f"{path}: has clocks, or decays of single layers, which fine-tuning does not know; compile it as it is"
        )
    if checkpoint.towers > 1:
        raise ModelError(
            f"{path}: has {checkpoint.towers} towers, which fine-tuning takes one by one; fine-tune what it was joined "
            "from, then join that"
        )
    asked = load_graph(arguments, checkpoint.system)
    name, adjacency = propagation(checkpoint, asked, arguments.checkpoint)
    require_splits(arguments.data)
    found = [
        recordings(
            arguments.data,
            split,
            classes=checkpoint.classes,
            taxels=checkpoint.taxels,
            bin_s=arguments.bin,
            labels_for="fine-tuning",
            trained=origin_of(checkpoint.training),
        )
        for split in ("train", "test")
    ]
    training, test = (joined_bins(each, checkpoint.bins) for each in found)
    from spikeloom.models.networks.checkpoint import save_again
    from spikeloom.models.training.finetune import finetune as tune
    from spikeloom.models.training.record import CHOSEN_ON

    try:
        tuned = tune(
            checkpoint,
            adjacency,
            training,
            test,
            target,
            bits=widths,
            groups=arguments.scale_groups,
            epochs=arguments.epochs,
            seed=arguments.seed,
            robust=arguments.robust or 0.0,
            state=state,
            resume=arguments.resume,
        )
    except KeyboardInterrupt:
        kept = f"the epochs so far are kept in {state}; go on with the same command and --resume"
        raise KeyboardInterrupt(kept if state.exists() else "") from None
    record = FinetuneRecord(
        command=" ".join(_words(arguments, SYNTHETIC if arguments.data == SYNTHETIC else training.source)),
        fine_tuned_from=checkpoint.sha256,
        fine_tuned_weights=checkpoint.weights,
        weight_bits=widths,
        seed=arguments.seed,
        epochs=arguments.epochs,
        data=training.source,
        data_sha256=data_digest(*found),
        test_samples=len(test),
        before=Before(correct=tuned.before, accuracy=tuned.before / len(test)),
        last=Tuned(correct=tuned.after, accuracy=tuned.after / len(test), chosen_on=CHOSEN_ON[checkpoint.weights]),
        history=[[epoch.loss, epoch.correct] for epoch in tuned.history],
    )
    edges = asked.edges if checkpoint.edges is None and asked is not None else checkpoint.edges
    changed = replace(checkpoint, graph=name, edges=edges, forms=tuned.forms, **layers_of(tuned.weights))
    save_again(output, changed, training=asdict(record))
    round_to_forms(expand(read_checkpoint(output), adjacency), tuned.forms)  # it compiles, or says why not
    state.unlink(missing_ok=True)
    return Finetuned(record=record, file=output.name, sha256=sha256_of(output))


def _words(arguments: argparse.Namespace, source: str) -> list[str]:
    """The words that ask for the same fine-tuning, beside the files."""
    files = {name: getattr(arguments, name) for name in ("taxels", "edges")}
    options = repeat.given(arguments, (*repeat.NETWORK, "target", "bin", *REPEATED)) | {"data": source}
    options |= {name: Path(file).name for name, file in files.items() if file}
    return ["spikeloom", "finetune", Path(arguments.checkpoint).name, *repeat.words(options)]


def finetune_sections(result: Finetuned) -> Iterable[Section]:
    """A finished fine-tuning for people."""
    record = result.record
    total, first, last = record.test_samples, record.history[0], record.history[-1]
    rows = [
        ["rounded", "", "", percent(record.before.correct, total)],
        ["epoch 1", f"{first[0]:.5f}", f"{first[1]:,}", ""],
        [f"epoch {record.epochs}", f"{last[0]:.5f}", f"{last[1]:,}", percent(record.last.correct, total)],
    ]
    head = ["on chip integers", "loss", "training right", "test"]
    yield Section("Fine-tuning", [Text(record.command), Table(head, rows), Text(f"  written: {result.file}")])
