"""The main job in Python: what ``import spikeloom`` offers. Every option of a command is a keyword of its function."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import weakref
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import JsonObject
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.report.sections import Outcome, Section, terminal

if TYPE_CHECKING:
    from torch import Tensor, nn

    from spikeloom.compiler.ir import Network
    from spikeloom.models.recordings.evtouch import Recordings


BRIEF = 8
"""Lines of a result that Python shows by itself."""


@dataclass(frozen=True, slots=True, repr=False)
class Result:
    """What a command found, in `value`: a dataclass whose fields are the keys of ``--json``."""

    value: Any
    sections: tuple[Section, ...]

    def __str__(self) -> str:
        """All of it, as on a terminal."""
        return terminal(self.sections)

    def __repr__(self) -> str:
        """The first lines; ``print`` shows all."""
        first = str(self).split("\n\n", 1)[0].splitlines()
        return "\n".join(first[:BRIEF] + ["…"] * (len(first) > BRIEF))

    def _repr_html_(self) -> str:
        """What notebooks show."""
        from spikeloom.runtime.report.html import fragment

        return "".join(map(fragment, self.sections))


@dataclass(frozen=True)
class Data:
    """Recordings of a source by split, read when they are first needed; made by :func:`recordings`."""

    source: str
    bin: float | None

    @cached_property
    def train(self) -> Recordings:
        """Those that may choose."""
        return self.split("train")

    @cached_property
    def test(self) -> Recordings:
        """Those that report."""
        return self.split("test")

    def split(self, name: str) -> Recordings:
        """Recordings of a split: ``events`` (samples, taxels, 2, steps) uint8, ``labels``, ``files``.

        Raises DataError if there are none, or they cannot be read.
        """
        from spikeloom.runtime.inputs.recordings import recordings as read

        return read(self.source, name, classes=None, taxels=None, bin_s=self.bin)


def recordings(source: str, *, bin: float | None = None) -> Data:
    """Name recordings: a zip, folder or file of them, ``synthetic``, ``objects`` or ``containers``.

    Parameters
    ----------
    source : str
        As of ``--data``.
    bin : float, optional
        Seconds of a time bin, for files of single events; 0.02 where it is not given.

    Raises DataError if there are none.
    """
    from spikeloom.models.recordings.events import data_splits
    from spikeloom.models.recordings.grasps import SYNTHETIC

    if source != SYNTHETIC:
        data_splits(source)
    return Data(source, bin)


@dataclass(frozen=True, eq=False)
class Compiled:
    """A netlist, with the network that it was compiled from; made by :func:`compile` or :func:`load`."""

    path: Path
    network: str | Network | None
    options: JsonObject
    result: Result

    def verify(self, data: Data | Recordings | str | None = None, **options: Any) -> Result:
        """Compare chip and float model, without recordings only what they store; options as of ``spikeloom verify``."""
        return _command("main_job.verify", netlist=str(self.path), data=data, **self._origin("verify"), **options)

    def estimate(self, data: Data | Recordings | str, **options: Any) -> Result:
        """Operations, energy and time of recordings; options as of ``spikeloom estimate``."""
        return _command("main_job.estimate", netlist=str(self.path), data=data, **options)

    def run(self, data: Data | Recordings | str, **options: Any) -> Result:
        """Decisions of recordings, the chip's; options as of ``spikeloom run``."""
        return _command("main_job.run", netlist=str(self.path), data=data, **options)

    def report(self, output: str, data: Data | Recordings | str, **options: Any) -> Result:
        """Write a page with all of it; options as of ``spikeloom report``."""
        given = self._origin("report") | options
        return _command("main_job.report", netlist=str(self.path), output=output, data=data, **given)

    def save(self, path: str) -> None:
        """Write the netlist, a ``.loom`` file."""
        require_place(path, "save", kinds=["loom"])
        shutil.copyfile(self.path, path)

    def stream(self) -> Any:
        """Open a live stream: ``step(events)`` takes one bin (taxels, 2), and gives the votes so far."""
        from spikeloom.runtime.machines.backends import machine_for

        return machine_for(self.path).stream()

    def _origin(self, what: str) -> JsonObject:
        if self.network is None:
            raise OptionError(f"{what}: of a loaded netlist needs its network; give load(…, network=…)")
        return {"checkpoint": self.network, **self.options}

    def __repr__(self) -> str:
        return repr(self.result)

    def _repr_html_(self) -> str:
        return self.result._repr_html_()


def compile(
    network: str | nn.Module,
    *,
    calibrate: Data | Recordings | str | None = None,
    example: Tensor | None = None,
    **options: Any,
) -> Compiled:
    """Lower a network to a netlist that obeys every limit of its chip.

    Parameters
    ----------
    network : str or Module
        Checkpoint, ONNX, NIR or netx file, ``pretrained:NAME``, or a torch module of affine stages and
        :class:`spikeloom.LIF` layers.
    calibrate : Data, Recordings or str, optional
        Training recordings that choose the scales.
    example : Tensor, optional
        Input of one step, for a module.
    options
        As of ``spikeloom compile``: ``graph="manual"``, ``weight_bits=4``, ``target=…``.

    Raises
    ------
    SpikeloomError
        If something cannot be used, or the network does not fit; the message says what to do.
    """
    source = _source("compile", network, example)
    folder = tempfile.mkdtemp(prefix="spikeloom-")
    path = Path(folder) / "netlist.loom"
    words = {"checkpoint": source, "calibrate": calibrate, "output": str(path), **options}
    result = _command("main_job.compile", **words)
    kept = {name: value for name, value in options.items() if name in _options("main_job.verify")}
    made = Compiled(path, source, kept, result)
    weakref.finalize(made, shutil.rmtree, folder, ignore_errors=True)
    return made


def finetune(
    network: str | nn.Module, data: Data | str, output: str, *, example: Tensor | None = None, **options: Any
) -> Compiled:
    """Train a network further on the integers of its chip, and give the netlist of what came of it.

    Parameters
    ----------
    network, example
        As of :func:`compile`, in floats.
    data : Data or str
        Recordings, of which the training split trains and the test split reports.
    output : str
        File to write: of a checkpoint another one, ``.pt``; of any other network NIR, ``.nir``, its netlist beside it.
    options
        As of ``spikeloom finetune``: ``weight_bits=4``, ``epochs=10``.

    Raises
    ------
    SpikeloomError
        As of :func:`compile`, and if the recordings are not the network's.
    """
    words: JsonObject = {"data": data} if isinstance(data, str) else {"data": data.source, "bin": data.bin}
    words |= {"checkpoint": _source("finetune", network, example), "output": output}
    result = _command("training.finetune", **words, **options)
    kept = {name: value for name, value in options.items() if name in ("graph", "taxels", "edges", "polarities")}
    if result.value.netlist is None:
        return compile(output, **kept)
    return Compiled(Path(output).with_name(result.value.netlist), output, kept, result)


def _source(what: str, network: str | nn.Module, example: Tensor | None) -> str | Network:
    """File of a network, or what a module means."""
    if isinstance(network, str | os.PathLike):
        return os.fspath(network)
    from torch import Tensor

    from spikeloom.models.networks.module import module_network

    if not isinstance(example, Tensor):
        raise OptionError(f"{what}: a module needs the input of one step; give example=torch.zeros(1, CHANNELS)")
    return module_network(network, example)


def load(path: str, *, network: str | None = None, **options: Any) -> Compiled:
    """Read a netlist; `network` is what it was compiled from, for `verify` and `report`, with options that name it."""
    return Compiled(Path(path), network, options, _command("main_job.inspect", path=path))


def _options(command: str) -> dict[str, argparse.Action]:
    """Every option of a command."""
    parser = argparse.ArgumentParser()
    module = import_module(f"spikeloom.runtime.commands.{command}")
    module.add_arguments(parser)
    return {action.dest: action for action in parser._actions if action.dest != "help"}


def _value(option: argparse.Action, given: Any) -> Any:
    """What a command takes for a value of Python: what its word would mean, or recordings and networks as they are."""
    from spikeloom.compiler.ir import Network
    from spikeloom.models.recordings.evtouch import Recordings

    if isinstance(given, Data):
        return given.train if option.dest == "calibrate" else given.test
    if given is None or option.nargs == 0 or isinstance(given, Network | Recordings):
        return given
    if isinstance(option.default, list):
        return [given] if isinstance(given, str) else given
    words = given if isinstance(given, list | tuple) else [given]
    if not all(isinstance(word, str | int | float | os.PathLike) for word in words):
        found = type(given).__name__
        raise OptionError(
            f"{option.dest}: {found} found; give words as on the command line, or what recordings() gives"
        )
    kind: Any = option.type or str
    try:
        return kind(",".join(map(str, words)))
    except ValueError:
        raise OptionError(f"{option.dest} {given}: not a number of type {kind.__name__}; give one") from None


def _command(name: str, **options: Any) -> Result:
    """Run a command on values in place of words."""
    known = _options(name)
    if unknown := sorted(set(options) - set(known)):
        raise OptionError(f"{unknown[0]}: unknown option; allowed: {', '.join(sorted(known))}")
    values = {dest: option.default for dest, option in known.items()} | {"json": False, "debug": False}
    arguments = argparse.Namespace(**values | {dest: _value(known[dest], given) for dest, given in options.items()})
    found: Outcome = import_module(f"spikeloom.runtime.commands.{name}").run(arguments)
    value = getattr(found.result, "result", found.result)  # without how it was simulated
    return Result(value, tuple(found.sections(found.result)))
