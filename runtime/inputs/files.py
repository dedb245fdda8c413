"""Files that a user names: shipped checkpoints, places to write, what can be inspected."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path

from spikeloom.compiler.archive import stated
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import beside, remove_leftovers, write_atomically
from spikeloom.compiler.formats import NETWORKS, NETX, NIR, ONNX
from spikeloom.models.recordings.classes import class_in_name
from spikeloom.runtime.report.drawing import Drawing
from spikeloom.runtime.requests.fields import Request

_RECORDINGS = "recordings are shown by spikeloom data describe"


PRETRAINED = "pretrained:"


def shipped(path: str) -> str:
    """Resolve ``pretrained:NAME`` to the file that the package ships; OptionError if there is no such checkpoint."""
    if not path.startswith(PRETRAINED):
        return path
    folder = Path(str(resources.files("spikeloom.models") / "pretrained"))
    known = {file.stem: file for file in sorted(folder.glob("*.pt"), key=lambda file: file.stem)}
    name = path.removeprefix(PRETRAINED)
    if name not in known:
        raise OptionError(
            f"{path}: no such shipped checkpoint; allowed: {', '.join(PRETRAINED + n for n in known)}"
        )
    return str(known[name])


INPUTS = (
    "checkpoint",
    "checkpoints",
    "original",
    "netlist",
    "data",
    "calibrate",
    "source",
    "taxels",
    "edges",
    "stress",
)
"""Arguments that may name a file to read."""

OUTPUTS = {
    "output": "-o",
    "certificate": "--certificate",
    "network": "--network",
    "html": "--html",
    "spikes": "--spikes",
    "picture": "--picture",
}
"""Arguments that may name a file to write, and their options."""


def require_place(
    path: str | None, option: str, request: Request | None = None, kinds: Iterable[str] = ()
) -> None:
    """Refuse, before any work is done, a place where a result could not be written; nothing to do without one.

    Raises OptionError if there is no such folder, or none that takes a file, the path is a folder or a
    device, has another suffix than one of the `kinds`, is another of the `OUTPUTS` of `request`, or one of
    its `INPUTS`, which must not be overwritten.
    """
    if path is None:
        return
    place = Path(path)
    if not (folder := place.absolute().parent).is_dir():
        why = (
            f"{folder.name} is a file; name"
            if folder.exists()
            else "the folder does not exist; make it, or name"
        )
        raise OptionError(f"{option} {path}: {why} another")
    if place.exists() and not place.is_file():
        raise OptionError(f"{option} {path}: is not a regular file; give the name of a file to write")
    remove_leftovers(place)
    part = beside(place.resolve())
    try:
        part.open("xb").close()
        part.unlink()
    except OSError as error:
        raise OptionError(f"{option} {path}: cannot be written ({error.strerror}); name another") from error
    _require_apart(place, request)
    for name in INPUTS if place.exists() else ():
        given = getattr(request, name, None)
        for each in given if isinstance(given, tuple) else [given]:
            if isinstance(each, str) and Path(shipped(each)).exists() and place.samefile(shipped(each)):
                raise OptionError(
                    f"{option} {path}: is an input of this command ({each}); give another name"
                )
    if kinds and place.suffix not in (allowed := [f".{kind}" for kind in kinds]):
        raise OptionError(f"{option} {path}: has to end in {' or '.join(allowed)}; give another name")


def _require_apart(place: Path, request: object) -> None:
    """Refuse a place that several options name."""
    given = {option: getattr(request, name, None) for name, option in OUTPUTS.items()}
    same = [
        option
        for option, path in given.items()
        if isinstance(path, str) and Path(path).resolve() == place.resolve()
    ]
    if len(same) > 1:
        raise OptionError(f"{same[-1]} {place}: is also the {same[0]} file; give another name")


def write_picture(path: str | None, draw: Callable[[], Drawing]) -> None:
    """Write what ``--picture`` asks for, PNG, SVG or PDF by the name's ending; nothing without a path."""
    if path is not None:
        content = draw().file(Path(path).suffix[1:])
        with write_atomically(path) as file:
            file.write(content)


def _members(path: str) -> list[str] | None:
    """Names in a zip; None where it is none."""
    try:
        if not Path(path).is_file():  # a pipe would wait for ever
            return None
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except Exception:  # zipfile raises whatever it meets
        return None


def is_recordings(path: str) -> bool:
    """Whether a file holds recordings, by its name and by those of its members."""
    names = _members(path)
    if names is None:
        names = [path] if path.endswith(".csv") and Path(path).is_file() else []
    return any(
        name.endswith(".csv") or name == "time_s.npy" or class_in_name(name) is not None for name in names
    )


def require_netlist(path: str) -> None:
    """Refuse what is to be a netlist and is a trained network, or recordings; OptionError."""
    if path.startswith(PRETRAINED) or (path.endswith(NETWORKS) and stated(Path(path), "target") is None):
        raise OptionError(
            f"{path}: is a trained network; compile it first: spikeloom compile {path} -o NET.loom"
        )
    if is_recordings(path):
        raise OptionError(f"{path}: holds recordings; give the netlist here, and these as --data")


def require_inspectable(path: str) -> None:
    """Refuse what is neither a netlist nor a checkpoint, by what it is instead.

    Raises OptionError if it is a folder, or a zip or npz of something else.
    """
    if path.endswith((ONNX, NIR, NETX)):
        require_netlist(path)
    if Path(path).is_dir():
        raise OptionError(f"{path}: is a folder, not a netlist or a checkpoint; {_RECORDINGS}")
    if (members := _members(path)) is None:
        return  # a released checkpoint is no zip; what else there is, its reader says
    names = {Path(name) for name in members}
    ours = {"manifest.json", "manifest.npy"} & {name.name for name in names}
    torch = any(name.suffix == ".pkl" for name in names)
    if ours or torch or path.endswith(".loom"):
        return
    shown = ", ".join(sorted(name.as_posix() for name in names)[:3]) or "nothing"
    raise OptionError(f"{path}: holds {shown}, not a netlist or a checkpoint; {_RECORDINGS}")
