"""Fine-tune a network on the integers of the chip, and write it back as it was read."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from spikeloom.compiler.checkpoint import WEIGHTS, layers_of
from spikeloom.compiler.errors import ModelError, OptionError, require_least
from spikeloom.compiler.files import remove_leftovers, sha256_of, write_atomically
from spikeloom.compiler.formats import NIR
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.base import COMPARTMENTS, Target
from spikeloom.compiler.targets.compartments import check_packings, round_to_forms
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import BIN_S, Recordings, data_digest
from spikeloom.models.recordings.grasps import SYNTHETIC
from spikeloom.models.training.robust import require_chance
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import load_graph
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings, require_splits, step_of, warn_of_shared
from spikeloom.runtime.machines.backends import backend_of
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import INLINE, OPTIONAL
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.main_job import CompileRequest
from spikeloom.runtime.requests.training import FinetuneRequest
from spikeloom.runtime.studies.jobs import only_one

if TYPE_CHECKING:
    from spikeloom.models.networks.quantised import QuantisedNet
    from spikeloom.models.training.finetune import Tuned

REPEATED = (*repeat.LAYOUT, "weight_bits", "scale_groups", "robust", "epochs", "seed")
"""Options of its own that decide the result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reached:
    """Test recordings classified correctly."""

    correct: int
    accuracy: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ReachedLast(Reached):
    """The same after the last epoch."""

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
    before: Reached
    last: ReachedLast
    history: Sequence[Sequence[float]]
    train_sha256: str
    bin_s: float | None = field(default=None, metadata=OPTIONAL)
    class_names: Sequence[str] | None = field(default=None, metadata=OPTIONAL)

    def to_json(self) -> JsonObject:
        """JSON values, without a bin width that was not given."""
        return {key: value for key, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Finetuned(Shown):
    """A fine-tuning and the file that holds it; `netlist` beside it if that is NIR."""

    record: FinetuneRecord = field(metadata=INLINE)
    file: str
    sha256: str
    netlist: str | None = field(default=None, metadata=OPTIONAL)


def finetune(request: FinetuneRequest) -> Finetuned:
    """Fine-tune and write the network; the text of a KeyboardInterrupt says what is kept."""
    output = Path(request.output)
    require_place(request.output, "-o", request, ["pt", "nir"])
    require_least(vars(request), epochs=1, seed=0)
    require_chance(request.robust or 0.0)
    with only_one(output):
        state = _state(output, resume=request.resume)
        target = backend_of(request.target, COMPARTMENTS).target
        widths = None if request.weight_bits is None else whole_numbers(request.weight_bits, "--weight-bits")
        loaded = load_network(request.checkpoint, request)
        _require_trainable(request, loaded, output)
        _require_storage(request, widths, len(loaded.network.populations), target)
        splits = _splits(request, loaded)
        tuned = _tune(request, loaded.network, splits, target, widths, state)
        record = _record(request, loaded, splits, widths, tuned)
        write = _write_nir if loaded.checkpoint is None else _write_checkpoint
        netlist = write(request, loaded, tuned.net, record)
        state.unlink(missing_ok=True)
        return Finetuned(record=record, file=output.name, sha256=sha256_of(output), netlist=netlist)


def _state(output: Path, *, resume: bool) -> Path:
    """File of the epochs so far; refused if an old one would be lost, or none is there to resume."""
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


def _splits(request: FinetuneRequest, loaded: LoadedNetwork) -> tuple[Recordings, Recordings]:
    """Training and test recordings, in their own bins."""
    require_splits(request.data)
    network = loaded.network
    training, test = (
        recordings(
            request.data,
            split,
            classes=network.classes,
            taxels=network.input.taxels,
            bin_s=request.bin,
            labels_for="fine-tuning",
            trained=origin_of(loaded.training) | step_of(loaded.read_as, network.input.bins),
        )
        for split in ("train", "test")
    )
    warn_of_shared(training, test)
    return training, test


def _tune(
    request: FinetuneRequest,
    network: Network,
    splits: tuple[Recordings, Recordings],
    target: Target,
    widths: list[int] | None,
    state: Path,
) -> Tuned:
    """Fine-tune on recordings in steps of the network."""
    from spikeloom.models.training.finetune import finetune as tune  # torch, so only here

    sensor = network.input
    training, test = (of_length(joined_bins(each, sensor.bins), sensor.clocks.length) for each in splits)
    progress("compiling")
    try:
        return tune(
            network,
            training,
            test,
            target,
            bits=widths,
            groups=8 if request.scale_groups is None else request.scale_groups,
            epochs=request.epochs,
            seed=request.seed,
            robust=request.robust or 0.0,
            state=state,
            resume=request.resume,
        )
    except KeyboardInterrupt:
        kept = f"the epochs so far are kept in {state}; go on with the same command and --resume"
        raise KeyboardInterrupt(kept if state.exists() else "") from None


def _record(
    request: FinetuneRequest,
    loaded: LoadedNetwork,
    splits: tuple[Recordings, Recordings],
    widths: list[int] | None,
    tuned: Tuned,
) -> FinetuneRecord:
    """How it was made, and what it reached."""
    from spikeloom.models.training.record import CHOSEN_ON

    training, test = splits
    weights = WEIGHTS[0] if loaded.checkpoint is None else loaded.checkpoint.weights
    return FinetuneRecord(
        command=shlex.join(_words(request, SYNTHETIC if request.data == SYNTHETIC else training.source)),
        fine_tuned_from=loaded.sha256,
        fine_tuned_weights=weights,
        weight_bits=widths or [form.bits for form in tuned.net.forms],
        seed=request.seed,
        epochs=request.epochs,
        data=training.source,
        data_sha256=data_digest(training, test),
        train_sha256=training.events_sha256,
        bin_s=training.bin_s,
        class_names=training.names,
        test_samples=len(test),
        before=Reached(correct=tuned.before, accuracy=tuned.before / len(test)),
        last=ReachedLast(
            correct=tuned.after, accuracy=tuned.after / len(test), chosen_on=CHOSEN_ON[weights]
        ),
        history=[[epoch.loss, epoch.correct] for epoch in tuned.history],
    )


def _require_storage(
    request: FinetuneRequest, widths: list[int] | None, layers: int, target: Target
) -> None:
    """Refuse widths that the chip cannot store."""
    if widths is None:
        repeat.refuse(
            request, ("scale_groups",), "is for --weight-bits; held-out recordings choose the storage"
        )
    else:
        check_packings([Packing(bits=width) for width in widths], layers, target)


def _require_trainable(request: FinetuneRequest, loaded: LoadedNetwork, output: Path) -> None:
    """Refuse networks that cannot be trained on, and a place whose name says another format."""
    path = request.checkpoint
    checkpoint = loaded.checkpoint
    if loaded.network.forms is not None:
        raise ModelError(f"{path}: was fine-tuned already; give the network that it was made from")
    if loaded.format == "counting":
        raise ModelError(f"{path}: counts by a linear rule, which no gradient runs through; train it anew")
    if checkpoint is not None and checkpoint.towers > 1:
        raise ModelError(
            f"{path}: has {checkpoint.towers} towers, which fine-tuning takes one by one; fine-tune what it was joined "
            "from, then join that"
        )
    if (output.suffix == NIR) != (checkpoint is None):
        what, ending = ("no checkpoint", NIR) if checkpoint is None else ("a checkpoint", ".pt")
        raise OptionError(f"-o {output}: {path} is {what}, it is written back as {ending}; give OUT{ending}")
    if checkpoint is None:
        require_place(str(output.with_suffix(".loom")), "-o", request)


def _write_checkpoint(
    request: FinetuneRequest, loaded: LoadedNetwork, net: QuantisedNet, record: FinetuneRecord
) -> None:
    from spikeloom.compiler.formats.own_checkpoint import save_again

    output = request.output
    checkpoint = loaded.checkpoint
    convolution = loaded.network.convolution
    assert checkpoint is not None
    assert convolution is not None
    graph = load_graph(request, checkpoint.system)
    edges = graph.edges if checkpoint.edges is None and graph is not None else checkpoint.edges
    changed = replace(
        checkpoint, graph=loaded.graph, edges=edges, forms=net.forms, **layers_of(net.tensors())
    )
    save_again(output, changed, training=origin_of(loaded.training) | record.to_json())
    round_to_forms(
        expand(read_checkpoint(output), convolution.propagation), net.forms
    )  # it compiles, or says why not


def _write_nir(
    request: FinetuneRequest, loaded: LoadedNetwork, net: QuantisedNet, record: FinetuneRecord
) -> str:
    """Write the network, and the netlist that it compiles to; the name of that."""
    from spikeloom.compiler.formats.nir import writer

    integer, _ = round_to_forms(net.expanded(), net.forms)
    dt = loaded.read_as.get("dt", (record.bin_s or BIN_S) * integer.input.bins)
    training = origin_of(loaded.training) | record.to_json()
    content = writer.export(integer, dt, training=json.dumps(training))
    with write_atomically(request.output) as file:
        file.write(content)
    netlist = Path(request.output).with_suffix(".loom")
    made = CompileRequest(
        checkpoint=request.output,
        polarities=integer.input.polarities,
        target=request.target,
        output=str(netlist),
    )
    backend_of(request.target).lower(made, lambda _name, _done: None).write(made.output)
    return netlist.name


def _words(request: FinetuneRequest, source: str) -> list[str]:
    """The words that ask for the same fine-tuning, beside the files."""
    files = {name: getattr(request, name) for name in ("taxels", "edges")}
    options = repeat.given(request, (*repeat.NETWORK, "target", "bin", *REPEATED)) | {"data": source}
    options |= {name: Path(file).name for name, file in files.items() if file}
    name = Path(request.checkpoint).name if isinstance(request.checkpoint, str) else "MODULE"
    return ["spikeloom", "finetune", name, *repeat.words(options)]


def sections(result: Finetuned) -> Iterable[Section]:
    """A finished fine-tuning for people."""
    record = result.record
    total = record.test_samples
    first = record.history[0]
    last = record.history[-1]
    rows = [
        ["rounded", "", "", percent(record.before.correct, total)],
        *([["epoch 1", f"{first[0]:.5f}", f"{first[1]:,}", ""]] if record.epochs > 1 else []),
        [f"epoch {record.epochs}", f"{last[0]:.5f}", f"{last[1]:,}", percent(record.last.correct, total)],
    ]
    head = ["on chip integers", "loss", "training right", "test"]
    written = result.file if result.netlist is None else f"{result.file}, {result.netlist}"
    yield Section("Fine-tuning", [Text(record.command), Table(head, rows), Text(f"  written: {written}")])
