"""The command ``run``: decisions and spikes, bit for bit the chip's."""

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings, called
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Machine, Run
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.main_job import RunRequest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Decisions(Shown):
    """Class (samples,) and votes (samples, classes) of each recording, int64; its label, or ``UNLABELLED``."""

    files: tuple[str, ...]
    labels: IntArray
    predictions: IntArray
    counts: IntArray
    class_names: tuple[str, ...] | None = field(default=None, metadata=OPTIONAL)

    json_properties: ClassVar[tuple[str, ...]] = ("samples", "labelled", "accuracy")

    @property
    def samples(self) -> int:
        """Number of recordings."""
        return len(self.files)

    @property
    def labelled(self) -> int:
        """Those with a label."""
        return int(np.count_nonzero(self.labels != UNLABELLED))

    @property
    def accuracy(self) -> float | None:
        """Share of those that are decided as labelled, if there are any."""
        known = self.labels != UNLABELLED
        return float(np.mean(self.labels[known] == self.predictions[known])) if known.any() else None


REQUEST = RunRequest


def run(request: RunRequest) -> Outcome:
    """Run the command."""
    require_place(request.spikes, "--spikes", request, ["npz"])
    machine = machine_for(request.netlist)
    data = load_recordings(request.data, request, machine.netlist)
    votes = np.concatenate([done.votes for done in _runs("running", machine, data)])
    if request.spikes is not None:
        _write_spikes(request.spikes, machine, data)
    decisions = Decisions(
        files=data.files,
        labels=data.labels,
        predictions=vote(votes),
        counts=votes,
        class_names=data.names,
    )
    return Outcome(decisions, sections)


def _runs(what: str, machine: Machine, data: Recordings, *, spikes: bool = False) -> Iterator[Run]:
    """Some recordings after others."""
    count = Progress(len(data))
    for rows in machine.parts(len(data), data.steps):
        count(rows.start, what)
        part = data.part(rows)
        yield machine.run(part.events, lengths=part.lengths, spikes=spikes)


def _write_spikes(path: str, machine: Machine, data: Recordings) -> None:
    """Write the spikes of every layer; all run again for each, so that no more is held than some recordings."""
    with write_atomically(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in machine.layers:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                shape: tuple[int, ...] = ()
                for done in _runs(f"writing {name}", machine, data, spikes=True):
                    spikes = np.ascontiguousarray(done.spikes[name])
                    if not shape:
                        shape = len(data), *spikes.shape[1:]
                        form = {"descr": "|b1", "fortran_order": False, "shape": shape}
                        np.lib.format.write_array_header_1_0(member, form)
                    member.write(spikes.data)


def sections(found: Decisions) -> Iterator[Section]:
    """Accuracy, recordings that went wrong; decisions where no label is known."""
    names = found.class_names

    def named(label: int) -> str:
        return called(label, names)

    rows = list(
        zip(
            found.files,
            found.labels.tolist(),
            found.predictions.tolist(),
            found.counts.tolist(),
            strict=True,
        )
    )
    unknown = [row for row in rows if row[1] == UNLABELLED]
    wrong = [row for row in rows if row[1] not in (UNLABELLED, row[2])]
    known = found.labelled
    blocks: list[Text | Table] = []
    if known:
        without = f", {len(unknown)} more without a label" if unknown else ""
        blocks.append(Text(f"chip accuracy: {percent(known - len(wrong), known)}{without}"))
    if wrong:
        cells = [
            [file, named(label), named(made), str(votes[label]), str(votes[made])]
            for file, label, made, votes in wrong
        ]
        blocks.append(
            Table(["decided wrongly", "label", "decision", "votes for label", "for decision"], cells)
        )
    if unknown:
        cells = [[file, named(chosen), str(votes[chosen])] for file, _, chosen, votes in unknown]
        blocks.append(Table(["without a label" if known else "recording", "decision", "votes"], cells))
    yield Section("Decisions", blocks)
