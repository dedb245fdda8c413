"""Write recordings in the released layout: ``SPLIT/sample_N_label_L.npy``, float32 (taxels, 2, steps).

Each is as long as it was. A table beside the splits says which file each of them was. Conditions stay: fields of its
name behind the label, columns of a table in a table.
"""

import csv
import io
import math
import os
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from spikeloom.compiler.archive import ZIP_DATE, npy_bytes
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.files import beside, write_atomically
from spikeloom.models.recordings.classes import class_in_name, numbered, renamed
from spikeloom.models.recordings.conditions import fields_in
from spikeloom.models.recordings.csvtable import TABLES
from spikeloom.models.recordings.events import need_labels
from spikeloom.models.recordings.evtouch import WIDTH, Recordings, require_polarities

SOURCES = "sources.csv"
"""Table of split, new name and old name of every recording."""


def write_released(
    path: str | os.PathLike[str], splits: Sequence[Recordings], bin_s: float | None = None
) -> None:
    """Write splits, of bins of so many seconds, into a new folder, or a zip if the name ends so; all or nothing.

    A zip that exists is replaced, a folder must not exist. Numbers have leading zeros, so that the plain
    order of the files is the order of the recordings.

    OptionError, DataError if there is no place for it, or a recording has no label.
    """
    path = Path(path)
    for recordings in splits:
        need_labels(recordings, "the released layout")
    splits = _alike(splits)
    if not path.absolute().parent.is_dir():
        raise OptionError(f"-o {path}: the folder around it does not exist; make it first")
    if path.suffix.lower() == ".zip":
        with write_atomically(path) as target, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in _members(splits, bin_s):
                info = zipfile.ZipInfo(name, ZIP_DATE)
                info.compress_type = zipfile.ZIP_DEFLATED
                info.external_attr = 0o644 << 16
                archive.writestr(info, content)
        return
    if path.exists():
        raise OptionError(f"-o {path}: exists already; choose another name or remove it")
    part = beside(path)
    try:
        part.mkdir()
        for name, content in _members(splits, bin_s):
            (part / name).parent.mkdir(exist_ok=True)
            (part / name).write_bytes(content)
        part.rename(path)
    except BaseException as error:
        shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def _alike(splits: Sequence[Recordings]) -> Sequence[Recordings]:
    """Splits with one numbering of the classes that any of them names; DataError if another has numbers."""
    if not any(recordings.names for recordings in splits):
        return splits
    known = {name for each in splits for name in each.names or map(str, each.labels.tolist())}
    _, names = numbered((), known, None, splits[0].source)
    return [renamed(recordings, names) for recordings in splits]


def _members(splits: Sequence[Recordings], bin_s: float | None) -> Iterator[tuple[str, bytes]]:
    """Name and content of every file; in the table nothing begins as a formula."""
    for recordings in splits:
        for index, (events, _) in enumerate(recordings):
            yield f"{recordings.split}/{_name(recordings, index)}", npy_bytes(events.astype(np.float32))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    named = any(recordings.names for recordings in splits)
    writer.writerow(["split", "file", "source", *(["class"] if named else [])])
    for recordings in splits:
        for index, file in enumerate(recordings.files):
            row = [recordings.split, _name(recordings, index), _no_formula(file)]
            name = recordings.class_name(int(recordings.labels[index]))
            writer.writerow([*row, *([_no_formula(name)] if named else [])])
    yield SOURCES, text.getvalue().encode()
    groups = [name for name in splits[0].groups if all(name in each.groups for each in splits)]
    if groups:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["file", *groups])
        for recordings in splits:
            for index in range(len(recordings)):
                file = f"{recordings.split}/{_name(recordings, index)}"
                writer.writerow([file, *(_no_formula(recordings.groups[name][index]) for name in groups)])
        yield TABLES[0], text.getvalue().encode()
    if bin_s is not None:
        yield WIDTH, npy_bytes(np.array([bin_s]))


def _no_formula(cell: str) -> str:
    """A cell that no spreadsheet takes for a formula; a number is none."""
    return f"'{cell}" if cell[:1] in "=+-@\t\r" and not _is_number(cell) else cell


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _name(recordings: Recordings, index: int) -> str:
    width = len(str(len(recordings) - 1))
    label = int(recordings.labels[index])
    safe = all(class_in_name(f"_label_{name}.npy") == name for name in recordings.names or ())
    kind = recordings.class_name(label) if safe else label
    fields = fields_in(recordings.files[index])
    return f"{'_'.join([f'sample_{index:0{width}}_label_{kind}', *fields])}.npy"


def write_event_lines(path: str | os.PathLike[str], splits: Sequence[Recordings], bin_s: float) -> None:
    """Write one recording as lines ``time_s,taxel,polarity``, each event at the middle of its bin.

    DataError if there are several recordings.
    """
    count = sum(len(recordings) for recordings in splits)
    if count != 1:
        raise DataError(
            f"-o {path}: {count} recordings, a .csv holds one; give one, or a folder or zip to -o"
        )
    require_polarities(splits[0])
    step, taxel, polarity = np.nonzero(splits[0].events[0].transpose(2, 0, 1))
    times = (step + 0.5) * bin_s
    lines = [
        f"{t:.9g},{n},{p}\n"
        for t, n, p in zip(times.tolist(), taxel.tolist(), polarity.tolist(), strict=True)
    ]
    with write_atomically(path) as file:
        file.write(("time_s,taxel,polarity\n" + "".join(lines)).encode())
