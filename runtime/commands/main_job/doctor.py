"""The command ``doctor``: whether this installation works, in what a report of a problem should say."""

import os
import platform
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata, resources
from pathlib import Path

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import SpikeloomError
from spikeloom.models.recordings.fetch import data_folder
from spikeloom.runtime.inputs.files import PRETRAINED
from spikeloom.runtime.report.sections import Outcome, Section, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.fields import Request
from spikeloom.runtime.requests.main_job import InspectRequest

LIBRARIES = (
    *("numpy", "scipy", "numba", "llvmlite", "torch", "networkx", "matplotlib", "onnx", "onnxruntime"),
    *("h5py", "pooch", "joblib", "threadpoolctl", "filelock", "jinja2", "tqdm", "shtab"),
)
OPTIONAL = ("nir", "scikit-learn", "distributed")

SHIPPED = (
    *("containers", "containers-counters", "containers-truenorth", "grasps"),
    *("objects", "objects-200ms", "objects-counters", "objects-truenorth"),
)
"""Trained networks that the package has."""

PAGES = ("page.html", "page.css", "page.js", "blocks.html")

AGAIN = "install spikeloom again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Something that was looked at: what is there, and what to do where that does not work."""

    what: str
    found: str
    fix: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Diagnosis(Shown):
    """All that was looked at."""

    checks: tuple[Check, ...]

    @property
    def wrong(self) -> int:
        """Number of checks that say what to do."""
        return sum(check.fix is not None for check in self.checks)


REQUEST = Request


def run(_request: Request) -> Outcome:
    """Run the command; exit code 1 where something does not work."""
    diagnosis = Diagnosis(checks=(*_machine(), *_libraries(), *_folders(), _kernels(), *_shipped()))
    return Outcome(diagnosis, sections, 1 if diagnosis.wrong else 0)


def sections(found: Diagnosis) -> Iterator[Section]:
    """The same for people."""
    width = max(len(check.what) for check in found.checks)
    lines = []
    for check in found.checks:
        lines.append(f"{check.what:<{width}}  {check.found}")
        if check.fix is not None:
            lines.append(f"{'':<{width}}  WRONG: {check.fix}")
    end = f"{found.wrong} wrong: do what these lines say" if found.wrong else "nothing is wrong"
    yield Section("Installation", [Text("\n".join([*lines, end]))])


def _machine() -> Iterator[Check]:
    yield Check(what="spikeloom", found=f"{__version__} in {resources.files('spikeloom')}")
    yield Check(what="Python", found=f"{platform.python_version()} on {platform.platform()}")
    yield Check(what="cores", found=f"{usable_cores()} of {os.cpu_count()} usable, {platform.machine()}")


def usable_cores() -> int | None:
    """Cores that this process may use, None where the system does not say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _libraries() -> Iterator[Check]:
    missing = []
    versions = []
    for name in (*LIBRARIES, *OPTIONAL):
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing += [name] if name in LIBRARIES else []
    fix = f"pip install {' '.join(missing)}" if missing else None
    yield Check(what="libraries", found=", ".join(versions), fix=fix)


def _folders() -> Iterator[Check]:
    """Where files are kept between commands; a folder that is missing is made when it is needed."""
    from spikeloom.compiler import layer_kernel  # numba, which help need not wait for

    kept = getattr(layer_kernel._list_rows, "stats", None)
    machine_code = getattr(kept, "cache_path", None)
    if machine_code is None:
        fix = "each command compiles anew, for seconds: set NUMBA_CACHE_DIR to a folder that can be written"
        yield Check(what="machine code", found="no folder can be written", fix=fix)
    else:
        yield _writable("machine code", Path(machine_code), "set NUMBA_CACHE_DIR to another")
    yield _writable("recordings", data_folder(), "set SPIKELOOM_DATA to another")
    yield _writable("temporary files", Path(tempfile.gettempdir()), "set TMPDIR to another")


def _writable(what: str, folder: Path, fix: str) -> Check:
    there = next(each for each in (folder, *folder.parents) if each.exists())
    fine = there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    return Check(what=what, found=str(folder), fix=None if fine else f"it cannot be written: {fix}")


def _kernels() -> Check:
    """Run a kernel, which is compiled or loaded for it."""
    import numpy as np

    from spikeloom.compiler import layer_kernel

    spikes = np.eye(3, dtype=bool)[None]
    fix = "install numba and llvmlite again, in versions that go together"
    try:
        raster = layer_kernel.raster_of(spikes)
    except Exception as error:  # numba and LLVM raise whatever they meet
        return Check(what="kernels", found=f"{type(error).__name__}: {error}", fix=fix)
    right = raster.source.tolist() == [0, 1, 2] and raster.bounds.tolist() == [0, 1, 2, 3]
    return Check(
        what="kernels", found="run" if right else "compute something else", fix=None if right else fix
    )


def _shipped() -> Iterator[Check]:
    """Read every file that the package ships; networks have a hash of their content."""
    from spikeloom.compiler.targets.base import load_target
    from spikeloom.runtime.commands.main_job import inspect
    from spikeloom.runtime.machines.backends import BACKENDS

    reads: dict[str, Callable[[], object]] = {
        f"{PRETRAINED}{name}": partial(inspect.run, InspectRequest(path=f"{PRETRAINED}{name}"))
        for name in SHIPPED
    }
    reads |= {f"chip {each.name}": partial(load_target, each.name) for each in BACKENDS}
    reads |= {
        f"page {name}": (resources.files("spikeloom.runtime.report") / name).read_bytes for name in PAGES
    }
    wrong = []
    for name, read in reads.items():
        try:
            read()
        except (SpikeloomError, OSError, ValueError) as error:
            wrong.append(f"{name} ({error})")
    found = f"{len(reads) - len(wrong)} of {len(reads)} are as they were made"
    yield Check(what="shipped files", found=found, fix="; ".join([AGAIN, *wrong]) if wrong else None)
