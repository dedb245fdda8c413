"""The command ``export``: a netlist in the format of another program."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.files import write_atomically
from spikeloom.runtime.inputs.files import require_netlist, require_place
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.machines.backends import export_formats
from spikeloom.runtime.report.encode import HIDDEN, INLINE
from spikeloom.runtime.report.sections import Outcome, Section, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.exchange import ExportRequest

FORMATS = {each.name: each for each in export_formats()}
"""By the value of ``--to``."""

OF_RECORDINGS = ("split", "bin", "recording")


REQUEST = ExportRequest

OPTIONS = {"to": {name: each.title for name, each in FORMATS.items()}}
"""Choices that only the chips know."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Written(Shown):
    """A file that was written, and what its format says about it."""

    path: str
    format: str
    bytes: int
    sha256: str
    facts: Any = field(metadata=INLINE)
    form: str | None = field(metadata=HIDDEN)
    lines: tuple[str, ...] = field(metadata=HIDDEN)


def _require_fit(request: ExportRequest) -> None:
    """Refuse options that the format would ignore."""
    for name in {option: None for each in FORMATS.values() for option in each.options}:
        if name not in FORMATS[request.to].options:
            formats = " and ".join(to for to, each in FORMATS.items() if name in each.options)
            refuse(request, (name,), f"is for {formats}, --to says {request.to}")
        elif name in OF_RECORDINGS and request.data is None:
            refuse(request, (name,), "says which recording of --data, which is not given")


def run(request: ExportRequest) -> Outcome:
    """Write the file."""
    _require_fit(request)
    require_place(request.output, "-o", request, [FORMATS[request.to].ending or request.to])
    require_netlist(request.source)

    export = FORMATS[request.to].write(request)
    digest = hashlib.sha256()
    size = 0
    with write_atomically(request.output) as file:
        for chunk in export.content:
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
    written = Written(
        path=request.output,
        format=request.to,
        bytes=size,
        sha256=digest.hexdigest(),
        facts=export.facts,
        form=export.form,
        lines=tuple(export.lines),
    )
    return Outcome(written, sections)


def sections(written: Written) -> Iterator[Section]:
    """What the file holds."""
    where = "" if FORMATS[written.format].whole else " on the chip"
    size = (
        f"{written.facts.neurons} neurons{where} and {written.facts.synapses} synapses for {written.format}"
    )
    form = "" if written.form is None else f", form {written.form}"
    lines = [f"{written.path}: {size}, {written.bytes} bytes{form}", *written.lines]
    yield Section("", [Text(line) for line in lines])
