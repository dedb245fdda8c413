"""Recordings that a user names, held against a network."""

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.targets.netlist_file import Netlist, names_of, origin_of
from spikeloom.models.recordings import events
from spikeloom.models.recordings.classes import listed, renamed, without_gaps
from spikeloom.models.recordings.conditions import with_groups
from spikeloom.models.recordings.counts import number, show_counts
from spikeloom.models.recordings.evtouch import (
    UNLABELLED,
    WHOLE,
    WIDTH,
    Recordings,
    first_part,
    other_taxels,
    parse_window,
)
from spikeloom.models.recordings.grasps import SYNTHETIC, synthetic_split
from spikeloom.models.recordings.single import other_sensor
from spikeloom.runtime.report.console import progress, tell
from spikeloom.runtime.requests.choices import SplitChoice

TEST = "test"
"""Split that is read unless another is asked for."""

COMPARED = 1000
"""Recordings of a split, at most, that are read to tell whether these are the first of what trained a network."""

FEW_STEPS = 10
"""A recording of fewer was hardly meant."""


def recordings(
    path: str | Recordings,
    split: str,
    *,
    limit: int | None = None,
    classes: int | None,
    taxels: int | None,
    bin_s: float | None = None,
    bins: int = 1,
    labels_for: str | None = None,
    trained: Mapping[str, Any] | None = None,
    groups: str | None = None,
    window: int | None = None,
) -> Recordings:
    """Read recordings of any form, or make the package's own synthetic ones; hold both against the network.

    Counts of disorder in event files go to stderr. `bins` of them make a step of the network. `labels_for`
    names what needs the label of every recording. `trained` is what is known of the recordings that the
    network was trained on, see :func:`origin_of`: events come in its bins, others are refused, and what
    looks like other recordings is warned of; of each comes the part that trained it, or the first `window`
    per cent. `groups` are names of conditions, see :mod:`models.recordings.conditions`.

    Raises DataError or OptionError if they cannot be used, or do not suit the network.
    """
    trained = trained or {}
    known = None if classes is None else names_of(trained, classes)
    wanted = None if groups is None else [name.strip() for name in groups.split(",")]
    if isinstance(path, Recordings):
        given = path if known is None else renamed(path, known)
        require_suited(given, classes=classes, taxels=taxels)
        bins_s = trained.get("bin_s")
        _require_width(given, bins_s, f"read them with recordings(…, bin={bins_s})")
        data = with_groups(_first(given, limit), wanted)
    elif path == SYNTHETIC:
        data = _synthetic(split, limit, wanted, bin_s, trained)
        require_suited(data, classes=classes, taxels=taxels)
    else:
        options: dict[str, Any] = {"names": known, "limit": limit, "classes": classes, "groups": wanted}
        data = _read(path, split, bin_s, trained, taxels=taxels, **options)
    if labels_for is not None:
        events.need_labels(data, labels_for)
    if not isinstance(path, Recordings):
        if classes is not None:
            _warn_of_others(data, trained, classes, whole=limit is None)
            if split == "train" and limit is None:
                warn_of_missing(data, range(classes))
        elif labels_for is not None:
            (data,) = without_gaps(data)
    _warn_of_training(data, trained, lambda: _whole_split(path, data, limit, bin_s, trained, taxels))
    data = first_part(data, trained.get("window", WHOLE) if window is None else window)
    warn_of_steps(data.source, data.seconds, trained)
    warn_of_few(data, bins)
    return events.joined_bins(data, bins)


def _synthetic(
    split: str, limit: int | None, groups: list[str] | None, bin_s: float | None, trained: Mapping[str, Any]
) -> Recordings:
    """The package's own recordings."""
    events.require_events(SYNTHETIC, bin_s)
    data = with_groups(synthetic_split(split, limit=limit), groups)
    _require_width(data, trained.get("bin_s"), "give recordings in such bins")
    return data


def _read(
    path: str,
    split: str,
    bin_s: float | None,
    trained: Mapping[str, Any],
    *,
    taxels: int | None,
    **options: Any,
) -> Recordings:
    """Recordings of a path, whose disorder goes to stderr; `options` are those of `load_data`."""
    bins_s = trained.get("bin_s")
    _require_asked(bin_s, bins_s)
    data = events.load_data(path, split, bin_s=bin_s, default_bin_s=bins_s, taxels=taxels, **options)
    remedy = f"write their seconds to {WIDTH} beside them, or give --bin {bins_s}"
    _require_width(data, bins_s, remedy if data.bin_s is None else "give the events that they were made of")
    _require_sensor(data, split, taxels)
    show_counts(data.source, data.split, data.counts)
    return data


def _whole_split(
    path: str | Recordings,
    data: Recordings,
    limit: int | None,
    bin_s: float | None,
    trained: Mapping[str, Any],
    taxels: int | None,
) -> Recordings:
    """All recordings of the split that `data` are the first of; `data` where the others cannot be read, or are many."""
    if isinstance(path, Recordings):
        return path
    if limit is None or len(data) < limit or path == SYNTHETIC:
        return data
    with suppress(DataError):
        options: dict[str, Any] = {"bin_s": bin_s, "default_bin_s": trained.get("bin_s"), "taxels": taxels}
        first = events.load_data(path, data.split, limit=COMPARED, **options)
        return data if len(first) == COMPARED else first
    return data


def _first(data: Recordings, limit: int | None) -> Recordings:
    """So many recordings; OptionError if that is none."""
    if limit is not None and limit < 1:
        raise OptionError(f"--limit {limit}: at least 1 recording is needed; give a positive number")
    return data if limit is None else data.part(slice(limit))


def _require_asked(bin_s: float | None, own: float | None) -> None:
    """Refuse another width than the network's."""
    if own is not None and bin_s is not None and bin_s != own:
        raise OptionError(f"--bin {bin_s:g}: the network was trained on bins of {own:g} s; omit --bin")


def _require_width(data: Recordings, own: float | None, remedy: str) -> None:
    """Refuse recordings whose bins are not those of the network, or are not known to be."""
    if own is None or data.seconds == own:
        return
    assumed = " as nothing says another width" if data.bin_s is None else ""
    raise DataError(
        f"{data.source}: bins of {data.seconds:g} s{assumed}, the network was trained on bins of {own:g} s; {remedy}"
    )


def _require_sensor(data: Recordings, split: str, taxels: int | None) -> None:
    """Refuse training recordings that look like another sensor's, warn of others."""
    if taxels is not None and (why := other_sensor(data)) is not None:
        if split == "train":
            raise DataError(
                f"{why}; give the graph of their sensor (--taxels), or recordings of the network's"
            )
        tell(f"warning: {why}; are they of its sensor?")


def _warn_of_others(data: Recordings, trained: Mapping[str, Any], classes: int, *, whole: bool) -> None:
    """Say on stderr where recordings look like other ones than a network was trained on."""
    if data.names and "class_names" not in trained:
        tell(
            f"warning: {data.source}: the network does not know names of classes: {listed(data.names)} are 0, 1, …"
        )
    name = trained.get("data", data.source)
    known = int(data.labels.max(initial=UNLABELLED))
    fewer = whole and data.split != "train" and len(data) >= classes and UNLABELLED < known < classes - 1
    named = bool(data.names) and "class_names" in trained  # each of them is a class of the network
    # splits of synthetic ones differ in their seed
    same = named or name.partition(", seed")[0] == data.source.partition(", seed")[0]
    origin = "" if same else f"the network was trained on {name}; "
    if fewer:
        tell(f"warning: {data.source}: {origin}their classes are 0..{known}, the network's 0..{classes - 1}")
    elif origin and not (whole and len(data) == 1):  # a file of one recording has its own name
        advice = "calibrate on what it knows" if data.split == "train" else "are their classes the same?"
        tell(f"warning: {data.source}: {origin}{advice}")


def warn_of_steps(source: str, seconds: float, trained: Mapping[str, Any]) -> None:
    """Say on stderr that bins are not the steps that a network was read in, where no training says which it needs."""
    step = trained.get("step_s")
    if step is not None and "bin_s" not in trained and not math.isclose(step, seconds, rel_tol=1e-6):
        tell(
            f"warning: {source}: bins of {seconds:g} s, the network was read in steps of {step:g} s; are "
            "these its steps?"
        )


def _warn_of_training(
    data: Recordings, trained: Mapping[str, Any], whole_split: Callable[[], Recordings]
) -> None:
    """Say on stderr that what stands for new recordings is what trained the network, or the first of it."""
    did = {"train_sha256": "trained the network", "calibrated_sha256": "the network was compiled on"}
    known = {trained[name]: done for name, done in did.items() if name in trained}
    if data.split == "train" or not known:
        return
    every = first_part(whole_split(), trained.get("window", WHOLE))
    if (done := known.get(every.events_sha256)) is not None:
        are = "are" if len(every) == len(data) else f"are {len(data)} of"
        tell(
            f"warning: {data.source}: these {are} the {number(len(every), 'recording')} that {done}; what is reached "
            "on them says nothing of others"
        )


def require_splits(path: str | Recordings) -> None:
    """Refuse recordings without a test split for what trains and tests: a DataError."""
    if isinstance(path, str) and path != SYNTHETIC and not events.data_splits(path):
        raise DataError(
            f"{path}: has no train/ and test/, so that the same recordings would train and test; make these two "
            "folders, with some of each class in either"
        )


def warn_of_shared(training: Recordings, test: Recordings) -> None:
    """Say on stderr how many test recordings are training recordings, too: silent ones may well be alike."""

    def digests(data: Recordings) -> list[bytes]:
        return [hashlib.sha256(events.tobytes()).digest() if events.any() else b"" for events, _ in data]

    seen = set(digests(training)) - {b""}
    if count := sum(each in seen for each in digests(test)):
        tell(
            f"warning: {test.source}: {count} of {len(test)} test recordings are training recordings, too; what is "
            "reached on these says nothing of others"
        )


def warn_of_missing(training: Recordings, wanted: Iterable[int]) -> None:
    """Say on stderr of which classes that are wanted there is no training recording, where all are labelled."""
    seen = set(training.labels.tolist())
    if UNLABELLED not in seen and (missing := sorted(set(wanted) - seen)):
        named = listed([*map(training.class_name, missing)])
        tell(f"warning: {training.source}: no training recordings of class {named}")


def warn_of_few(data: Recordings, bins: int = 1) -> None:
    """Say on stderr that recordings have hardly a step, of so many bins: their times are of another unit, or bins."""
    if (steps := -(-data.steps // bins)) < FEW_STEPS:
        tell(
            f"warning: {data.source}: {number(steps, 'step')} of {bins * data.seconds:g} s in the longest recording; "
            "are its times seconds, and are steps so long?"
        )


def require_suited(data: Recordings, *, classes: int | None, taxels: int | None) -> None:
    """Refuse recordings of another sensor, or of more classes than a network has; DataError naming both."""
    if taxels is not None and data.taxels != taxels:
        raise DataError(f"{data.source}: {other_taxels(data.taxels, taxels)}")
    if classes is not None and data.labels.max(initial=0) >= classes:
        raise DataError(
            f"{data.source}: label {data.labels.max()}, the network has {classes} classes (0..{classes - 1}); "
            "use the network that was trained on these objects"
        )


def require_bins(bins: int) -> None:
    """Refuse a number of bins to join that is none; OptionError if it is below 1, or more than a recording may have."""
    if not 1 <= bins <= events.MAX_STEPS:
        raise OptionError(f"--join {bins}: allowed are 1 to {events.MAX_STEPS}; choose another")


def step_of(read_as: Mapping[str, Any], bins: int) -> dict[str, float]:
    """Seconds of a bin in the steps that a network was read in, where its file has such, as `recordings` takes them."""
    return {"step_s": read_as["dt"] / bins} if "dt" in read_as else {}


def load_recordings(
    source: str | Recordings,
    request: SplitChoice,
    netlist: Netlist,
    *,
    labels_for: str | None = None,
    joined: bool = True,
) -> Recordings:
    """Recordings of a source that a request names, held against a netlist; as `recordings` otherwise.

    In steps of the network if `joined`, as long a part of each as a ``--window`` says, or as the network was
    trained on, as long as the network needs; else in their own bins.
    """
    if isinstance(source, Recordings) and request.split not in (TEST, source.split):
        raise OptionError(
            f"split {request.split}: these are recordings of {source.split}; omit it, or give others"
        )
    said = getattr(request, "window", None)
    progress("reading the recordings")
    data = recordings(
        source,
        request.split,
        limit=request.limit,
        classes=netlist.classes,
        taxels=netlist.taxels,
        bin_s=request.bin,
        labels_for=labels_for,
        trained=origin_of(netlist.provenance) | step_of(netlist.provenance, netlist.bins),
        groups=getattr(request, "groups", None),
        window=None if said is None else parse_window(said),
    )
    warn_of_length(events.joined_bins(data, netlist.bins), netlist.clocks, origin_of(netlist.provenance))
    return in_steps(data, netlist) if joined else data


def in_steps(data: Recordings, netlist: Netlist) -> Recordings:
    """Recordings in steps of a network, as long as it needs."""
    return events.of_length(events.joined_bins(data, netlist.bins), netlist.clocks.length)


def warn_of_length(data: Recordings, clocks: Clocks, origin: Mapping[str, Any]) -> None:
    """Say what of recordings, in steps of a network, goes beyond what it was trained for."""
    length = clocks.length
    steps = origin.get("steps", length)
    if length is not None and (
        late := sum(int(part.events[..., steps:].sum(dtype=np.int64)) for part in data.parts())
    ):
        used = (
            "not used"
            if steps == length
            else f"they may move votes until step {length}, later ones are not used"
        )
        tell(f"warning: {data.source}: {number(late, 'event')} after the network's {steps} steps: {used}")
    ticking = clocks.channels * clocks.steps
    if ticking and length is None and data.steps > ticking:
        tell(
            f"warning: {data.source}: up to {data.steps} steps, the network's clocks stop after {ticking}; are these "
            "recordings as long as its own?"
        )


def name_of(source: str | Recordings) -> str:
    """Name of recordings without their folder."""
    return Path(source if isinstance(source, str) else source.source).name


def find_recording(data: Recordings, wanted: str, option: str) -> int:
    """Index of the recording that an option names, by its file or by its number from 0."""
    if wanted in data.files:
        return data.files.index(wanted)
    if wanted.isascii() and wanted.isdecimal():
        if int(wanted) >= len(data):
            raise OptionError(
                f"{option} {wanted}: there are {len(data)}; give a number from 0 to {len(data) - 1}"
            )
        return int(wanted)
    near = get_close_matches(wanted, data.files, n=3, cutoff=0.5) or data.files[:3]
    raise DataError(
        f"{option} {wanted}: no such recording among {len(data)} of split {data.split}; near are {', '.join(near)}; "
        "'spikeloom run --json' lists the names"
    )
