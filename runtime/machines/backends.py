"""The chips that can be compiled for and run: all of them, here and nowhere else."""

import os
from pathlib import Path

from spikeloom.compiler.archive import TRAINED, stated
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.runtime.inputs.files import require_netlist, shipped
from spikeloom.runtime.machines.backend import Backend
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.exports import Format
from spikeloom.runtime.machines.loihi1.backend import Loihi1
from spikeloom.runtime.machines.truenorth.backend import TrueNorth
from spikeloom.runtime.report.sections import Outcome

BACKENDS: tuple[Backend, ...] = (Loihi1(), TrueNorth())
"""The first one's reader says what is wrong with a file that names no chip."""

NOT_MODELLED = {"loihi2": "not modelled; no public per-event energies"}


def backend_of(name: str, cores: str | None = None) -> Backend:
    """The chip of that name, whose cores must be of one kind if that is given; OptionError if there is none."""
    known = {each.name: each for each in BACKENDS}
    fitting = {chip: each for chip, each in known.items() if cores in (None, each.target.cores)}
    if name in fitting:
        return fitting[name]
    why = NOT_MODELLED.get(name, "unknown")
    if name in known:
        why = f"its cores are {known[name].target.cores}, this is for {cores}"
    raise OptionError(f"--target {name}: {why}; allowed: {', '.join(fitting)}")


def backend_for(path: str | os.PathLike[str]) -> Backend:
    """The chip that a netlist file names."""
    name = stated(Path(path), "target")
    return next((backend for backend in BACKENDS if backend.name == name), BACKENDS[0])


def trained_for(path: object) -> Backend | None:
    """The chip that a file's network was trained for; None for networks that any chip may take."""
    if not isinstance(path, str) or stated(Path(shipped(path)), "format") != TRAINED:
        return None
    return next((backend for backend in BACKENDS if backend.is_trained_for(path)), None)


def machine_of(netlist: Netlist) -> Machine:
    """The machine of a netlist in memory."""
    return backend_of(netlist.target).machine(netlist)


def machine_for(path: str | os.PathLike[str]) -> Machine:
    """Read a netlist file, whatever chip it is for; SpikeloomError if it is none."""
    require_netlist(os.fspath(path))
    return backend_for(path).load(path)


def describe(path: str | os.PathLike[str]) -> Outcome:
    """Layers and cores of a netlist file, and how full each limit is; SpikeloomError if it is none."""
    return backend_for(path).describe(path)


def export_formats() -> tuple[Format, ...]:
    """Formats of other programs that netlists can be written in."""
    return tuple(each for backend in BACKENDS for each in backend.formats)
