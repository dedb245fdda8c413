"""A dozen tiny networks of every kind, each made once a run: a file, recordings, and the netlist of the command."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import made_files
import made_modules
import made_netx
import made_nir
import nir
import numpy as np
import pytest
from made_files import CLASSES, recordings_folder, sparse_events
from made_modules import TAXELS
from random_crossbars import random_network as native_network
from timed_networks import GRAPH, TIMING, written

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.counters import Counters
from spikeloom.compiler.dynamics import PLAIN, with_clocks
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.counters import write_counters
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.compiler.formats.tensors import arrays_of, join
from spikeloom.compiler.ir import Form
from spikeloom.compiler.targets.truenorth.native_file import write_trained
from spikeloom.models.recordings.events import joined_bins, load_data, of_length
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.cli import main
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.loihi1 import spec
from spikeloom.runtime.machines.loihi1.trace import Trace

STEPS = 14
STORAGE = ((8, (0,)), (4, (-1,)), (8, (0, 4)), (6, (1,)))
"""Width and exponents of each layer of a fine-tuned network."""

Made = tuple[str, int, str, str]
"""File, taxels of its sensor, options that say how it is read, options of ``compile``."""


@dataclass(frozen=True)
class Specimen:
    """A network, made and compiled."""

    folder: Path
    network: Path
    reading: tuple[str, ...]
    compiling: tuple[str, ...]

    @property
    def netlist(self) -> Path:
        return self.folder / "net.loom"

    @property
    def data(self) -> Path:
        """Recordings of both splits."""
        return self.folder / "data"

    @property
    def compilation(self) -> list[str]:
        """The command that made the netlist, without its output."""
        return ["compile", str(self.network), *self.reading, *self.compiling]

    @cached_property
    def machine(self) -> Machine:
        return machine_for(self.netlist)

    @cached_property
    def recordings(self) -> Recordings:
        """The test split, of bins that the network takes."""

        netlist = self.machine.netlist
        return of_length(joined_bins(load_data(self.data, "test"), netlist.bins), netlist.clocks.length)

    @property
    def events(self) -> np.ndarray:
        return self.recordings.events


def stored(path: Path, checkpoint: Checkpoint, **changes: int) -> Checkpoint:
    """Write a checkpoint as the commands do, and read it back."""
    names = ("beta", "theta", "forms", "system", "grid", "dynamics", "towers", "bins")
    facts = {name: getattr(checkpoint, name) for name in names} | {"training": {}} | changes
    save_checkpoint(
        path,
        {"last": arrays_of(checkpoint)},
        **made_files.graph_facts(GRAPH),
        **facts | {"forms": checkpoint.forms or None},
    )
    return read_checkpoint(path)


def tuned(checkpoint: Checkpoint, seed: int = 0) -> Checkpoint:
    """A network with storage of its own, as fine-tuning leaves it: a threshold for each neuron."""
    rng = np.random.default_rng(seed)
    forms = tuple(
        Form(bits=bits, exponents=exponents, threshold=rng.integers(20, 60, size=neurons))
        for (bits, exponents), neurons in zip(STORAGE, checkpoint.neurons.values(), strict=True)
    )
    return replace(checkpoint, forms=forms)


def of_system(system: str, dynamics=PLAIN, *compiling: str) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        written(folder / "net.pt", system, dynamics)
        return "net.pt", 39, "", " ".join(compiling)

    return make


def joined(dynamics, make_member=lambda checkpoint, _seed: checkpoint) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        members = []
        for seed in (1, 2, 3):
            written(folder / f"{seed}.pt", dynamics=dynamics, seed=seed)
            members.append(make_member(read_checkpoint(folder / f"{seed}.pt"), seed))
        stored(folder / "net.pt", join(members, ["1.pt", "2.pt", "3.pt"]))
        return "net.pt", 39, "", ""

    return make


def fine_tuned(folder: Path) -> Made:
    written(folder / "float.pt", dynamics=PLAIN)
    stored(folder / "net.pt", tuned(read_checkpoint(folder / "float.pt")))
    return "net.pt", 39, "", ""


def binned(folder: Path) -> Made:
    written(folder / "one.pt", dynamics=PLAIN)
    stored(folder / "net.pt", read_checkpoint(folder / "one.pt"), bins=3)
    return "net.pt", 39, "", ""


def recurrent(folder: Path) -> Made:
    """A NIR file with a recurrent layer."""
    rng = np.random.default_rng(0)
    nodes = {
        "a": made_nir.affine(rng, 12, 2 * TAXELS, 1.0),
        "b": made_nir.lif(12, r=2.0),
        "w": nir.Linear(rng.normal(size=(12, 12)) * 0.3),
        "c": made_nir.affine(rng, CLASSES, 12, 1.5),
        "d": made_nir.lif(CLASSES, r=2.0),
    }
    edges = [("a", "b"), ("b", "w"), ("w", "b"), ("b", "c"), ("c", "d")]
    nir.write(folder / "net.nir", made_nir.graph_with(nodes, edges, (2 * TAXELS,), (CLASSES,)))
    return "net.nir", TAXELS, "--dt 0.02", "--planes 2"


def onnx_step(folder: Path) -> Made:
    """One step of a torch module with a graph layer of its own."""
    module = made_modules.gcn()
    (folder / "net.onnx").write_bytes(made_modules.one_step(module, made_modules.example_of("gcn")))
    return "net.onnx", TAXELS, "", ""


def netx(folder: Path) -> Made:
    rng = np.random.default_rng(0)
    layers = ((12, 2 * TAXELS), (CLASSES, 12))
    made_netx.write(folder / "net.net", *(made_netx.dense(made_netx.even(rng, *shape)) for shape in layers))
    return "net.net", TAXELS, "", ""


def counting(folder: Path, counts: tuple[int, ...] = (1, 2), parts: int = 2) -> Made:
    """Counters of parts of a recording that is shorter than most, and a read-out."""
    rng = np.random.default_rng(0)
    counter = np.array(
        [(channel, part, k) for k in counts for part in range(parts) for channel in range(2 * TAXELS)]
    )
    weight = rng.integers(-9, 10, (CLASSES, len(counter)))
    sizes = {
        "taxels": TAXELS,
        "polarities": 2,
        "classes": CLASSES,
        "bins": 1,
        "steps": 10,
        "parts": parts,
        "ramp": 8,
    }
    made = Counters(**sizes, counter=counter, weight=weight, slope=9.0, threshold=150.5)
    write_counters(folder / "net.pt", made)
    return "net.pt", TAXELS, "", ""


def counting_crossbars(folder: Path) -> Made:
    """The same for the other kind of cores."""
    return *counting(folder)[:3], "--target truenorth"


def native(folder: Path) -> Made:
    network = native_network(0, taxels=TAXELS, classes=CLASSES, steps=STEPS)
    write_trained(
        folder / "net.pt", {"last": network}, graph="ring", edges=np.array([[0, 1], [1, 0]]), training={}
    )
    return "net.pt", TAXELS, "", "--target truenorth"


MAKERS: dict[str, Callable[[Path], Made]] = {
    "tactilesgnet": of_system("tactilesgnet", PLAIN, "--planes 2 --scale-groups 4"),
    "mlp": of_system("mlp", PLAIN, "--weight-bits 4"),
    "gcn": of_system("gcn", PLAIN, "--weight-bits 8,6,3,2"),
    "grid-cnn": of_system("grid-cnn", PLAIN, "--cores-for conv1=3,fc1=2"),
    "timed": of_system("tactilesgnet", TIMING),
    "binned": binned,
    "joined": joined(PLAIN),
    "joined-timed": joined(TIMING),
    "joined-tuned": joined(PLAIN, tuned),
    "fine-tuned": fine_tuned,
    "recurrent": recurrent,
    "onnx": onnx_step,
    "counters": counting,
    "netx": netx,
    "native": native,
    "counters-crossbars": counting_crossbars,
}
CROSSBARS = ("native", "counters-crossbars")
INTEGERS = (*CROSSBARS, "netx")
"""Those without a float network that compiles for the chip of the others."""
LAYERED = tuple(name for name in MAKERS if name not in CROSSBARS)
FLOAT = tuple(name for name in MAKERS if name not in INTEGERS)


@cache
def place() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="spikeloom-zoo-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def specimen(name: str) -> Specimen:
    """Make a network, its recordings and its netlist."""
    folder = place() / name
    folder.mkdir()
    file, taxels, reading, compiling = MAKERS[name](folder)
    data = folder / "data"
    rng = np.random.default_rng(7)
    steps = 3 * STEPS - 1 if name == "binned" else STEPS
    train, test = (sparse_events(rng, samples, taxels, 2, steps, rate=0.2) for samples in (8, 4))
    recordings_folder(data, train=train, test=test, classes=3 if name == "onnx" else CLASSES)
    calibrated = ["--calibrate", str(data)] if name in FLOAT and "tuned" not in name else []
    made = Specimen(folder, folder / file, tuple(reading.split()), (*compiling.split(), *calibrated))
    assert main([*made.compilation, "-o", str(made.netlist)]) == 0
    return made


@cache
def specified(name: str, index: int) -> Trace:
    """What the specification makes of one recording."""
    made = specimen(name)
    netlist = made.machine.netlist
    return spec.simulate(netlist, with_clocks(made.events, netlist.clocks)[index])


def over(names) -> pytest.MarkDecorator:
    """Run a test for each of these networks."""
    return pytest.mark.parametrize("name", names)
