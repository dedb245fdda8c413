"""Crossbar cores in a simulator of the hardware description of RANC, which others designed, beside our own.

The cores, their routers and the output bus are RANC's; the wires between these, and what reads and writes files, are
``harness.v``. Each recording is a run of its own, from memories as they are written, for the description clears
nothing. Every spike and every membrane of every neuron is compared, and every packet on the output bus.

Verilator 5.006 makes wrong code of these sources where it inlines gates, so that it is built without; Icarus runs them
as they are, about a hundred times slower.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.ranc import EventArray, Mesh, Terms, expressed, mesh_of
from spikeloom.compiler.formats.ranc_memory import memories, packet_lines, sizes
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.truenorth.machine import TrueNorth
from spikeloom.runtime.report.console import Progress, progress
from spikeloom.runtime.report.encode import read_json, write_json
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text

HARNESS = Path(__file__).with_name("harness.v")

IN_A_CLONE = "hardware/IP/RANCNetwork/src/sources"
FRONT_END = ("PacketFetch.v", "RANCNetwork.v", "RANCNetworkGrid.v", "RANCNetwork_S00_AXIS.v")
"""Sources that are not used: RANC's mesh, whose cores the harness could not look into, and its bus to a processor."""

SIMULATORS = {
    "verilator": (
        *("verilator", "--binary", "-j", "1", "-O3", "-fno-gate", "--x-assign", "fast", "--x-initial", "fast"),
        *("--noassert", "-Wno-fatal", "-Wno-lint", "-Wno-style", "-Wno-BLKANDNBLK", "-I."),
        *("--top-module", "harness", "-Mdir", "build", "-o", "../simulation"),
        *("-MAKEFLAGS", "OPT_FAST='-O2 -march=native'"),
    ),
    "iverilog": ("iverilog", "-g2012", "-s", "harness", "-I", ".", "-o", "simulation"),
}
"""Words that build ``simulation`` of the harness and the sources, by program, the faster one first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One recording: what ran, and what differs; `cycles` are those of its longest tick."""

    recording: str
    ticks: int
    cycles: int
    spikes: int
    spikes_different: int
    membranes: int
    membranes_different: int
    outputs_different: int  # Packets on the output bus, by tick and class
    packets_lost: int  # Spikes that reached a core in the cycle in which it clears those it has done
    error_cycles: int  # Cycles in which some core reported an error

    @property
    def differences(self) -> int:
        """Spikes, membranes and packets that differ, and errors."""
        parts = (self.spikes_different, self.membranes_different, self.outputs_different, self.packets_lost)
        return sum(parts) + self.error_cycles


@dataclass(frozen=True, slots=True, kw_only=True)
class Cosimulation:
    """What the hardware description made of a network; `clock_hz` keeps the pace of `step_s` a data step."""

    simulator: str
    rtl_sha256: str  # Of its sources, in the order of their names
    neurons: int
    cores: int
    doubled: int  # Neurons whose numbers are twice ours in RANC's terms
    exact_ticks: int | None
    step_s: float
    ticks_per_step: int
    recordings: tuple[Compared, ...]

    json_properties = ("differences", "spikes", "membranes", "cycles_per_tick", "clock_hz")

    @property
    def differences(self) -> int:
        """Of all recordings."""
        return sum(each.differences for each in self.recordings)

    @property
    def spikes(self) -> int:
        """Of all recordings."""
        return sum(each.spikes for each in self.recordings)

    @property
    def membranes(self) -> int:
        """Of all recordings."""
        return sum(each.membranes for each in self.recordings)

    @property
    def cycles_per_tick(self) -> int:
        """Of the longest tick."""
        return max(each.cycles for each in self.recordings)

    @property
    def clock_hz(self) -> float:
        """Cycles a second at which a data step takes no longer than the sensor's."""
        return self.cycles_per_tick * self.ticks_per_step / self.step_s


def sources_in(folder: str) -> list[Path]:
    """Verilog files of RANC's cores in a folder, or in a clone of its repository; OptionError if there are none."""
    for place in (Path(folder) / IN_A_CLONE, Path(folder)):
        if (place / "Core.v").is_file():
            return [each.absolute() for each in sorted(place.glob("*.v")) if each.name not in FRONT_END]
    raise OptionError(f"--rtl {folder}: no Core.v in it; give a clone of github.com/UA-RCL/RANC, or its {IN_A_CLONE}")


def simulator_for(wanted: str | None) -> str:
    """The program that is wanted, or the fastest that is installed; OptionError if there is none."""
    found = [name for name in SIMULATORS if wanted in (None, name) and shutil.which(name)]
    if not found:
        raise OptionError(f"{wanted or ' or '.join(SIMULATORS)}: not found; install it, it builds the hardware")
    return found[0]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Built:
    """A network in the hardware description, ready to run recordings in a folder."""

    machine: TrueNorth
    terms: Terms
    mesh: Mesh
    sizes: dict[str, int]
    folder: Path
    key: str  # Changes with everything that a run depends on, but its recording

    def run(self, name: str, events: EventArray) -> Compared:
        """Compare one recording (n_inputs, T) of some name; OptionError if a tick does not end."""
        here = self.folder / "recording"
        shutil.rmtree(here, ignore_errors=True)
        here.mkdir()
        for memory in self.folder.glob("*.mem"):
            (here / memory.name).symlink_to(memory)
        (here / "input.txt").write_text("\n".join(packet_lines(self.terms, self.sizes, events)) + "\n", "utf-8")
        _call([self.folder / "simulation"], here)
        trace = self.machine.simulate(events[None], spikes=True, membranes=True)
        assert trace.spikes is not None, "spikes are kept"
        assert trace.membranes is not None, "membranes are kept"
        spikes, membranes = trace.spikes[0], trace.membranes[0] * self.terms.scale + self.terms.shift
        ticks, cycles, lost, errors = map(int, (here / "end.txt").read_text("utf-8").split())
        if ticks < len(spikes):
            raise OptionError(f"--rtl: tick {max(ticks, 0)} of {name} does not end; give RANC's sources as they are")

        netlist, bits = self.machine.netlist, self.sizes["MEMBRANE_BITS"]
        places = (self.mesh.x + self.mesh.width * self.mesh.y)[netlist.core_of_neuron()]
        wrong = [0, 0]
        for place in range(self.mesh.width * self.mesh.height):
            if (place % self.mesh.width, place // self.mesh.width) == self.mesh.bus:
                continue
            ours = np.flatnonzero(places == place)
            words = np.fromfile(here / f"core_{place:03d}.bin", "<u4").reshape(ticks, -1).astype(np.int64)
            fired, held = words >> 31, words & ((1 << bits) - 1)
            held -= (held >> (bits - 1)) << bits
            wrong[0] += int(np.count_nonzero(fired[:, : len(ours)] != spikes[:, ours]) + fired[:, len(ours) :].sum())
            wrong[1] += int(np.count_nonzero(held[:, : len(ours)] != membranes[:, ours]))
        out = np.array((here / "out.txt").read_text("utf-8").split(), np.int64).reshape(-1, 2)
        voters = np.flatnonzero(netlist.readout_class >= 0)
        votes = np.zeros((ticks, netlist.classes + 1), np.int64)
        np.subtract.at(votes, tuple(out.T), 1)
        for voter in voters.tolist():
            votes[:, netlist.readout_class[voter]] += spikes[:, voter]
        return Compared(
            recording=name,
            ticks=ticks,
            cycles=cycles,
            spikes=int(np.count_nonzero(spikes)),
            spikes_different=wrong[0],
            membranes=membranes.size,
            membranes_different=wrong[1],
            outputs_different=int(np.abs(votes[:, : netlist.classes]).sum()),
            packets_lost=lost,
            error_cycles=errors,
        )


def build(machine: TrueNorth, folder: Path, sources: Sequence[Path], simulator: str, ticks: int) -> Built:
    """Write the memories of a network, and build it where that was not done already.

    ModelError if RANC has not what it uses, in recordings of so many `ticks`; OptionError if the sources are no good.
    """
    terms = expressed(machine.netlist, ticks)
    found = sizes(terms, machine.target)
    files = {"sizes.vh": "".join(f"localparam {name} = {value};\n" for name, value in found.items()), "empty.mem": ""}
    words = [*SIMULATORS[simulator], str(HARNESS), *map(str, sources)]
    parts = [*SIMULATORS[simulator], files["sizes.vh"], *(each.read_text("utf-8") for each in (HARNESS, *sources))]
    made = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    if not (stamp := folder / "built").is_file() or stamp.read_text("utf-8") != made:
        for name, text in files.items():
            (folder / name).write_text(text, "utf-8")
        _call(words, folder)
        stamp.write_text(made, "utf-8")
    for name, text in memories(terms, found):
        files[name] = text
        (folder / name).write_text(text, "utf-8")
    key = hashlib.sha256("\0".join([made, *files.values()]).encode()).hexdigest()
    return Built(machine=machine, terms=terms, mesh=mesh_of(machine.netlist), sizes=found, folder=folder, key=key)


def _call(words: Sequence[str | Path], folder: Path) -> None:
    done = subprocess.run(  # noqa: S603 -- a program of a fixed name, or what it built
        words, cwd=folder, capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode:
        said = next((line for line in done.stderr.splitlines() if "rror" in line), f"exit code {done.returncode}")
        raise OptionError(f"--rtl: {Path(words[0]).name} fails: {said.strip()}; give RANC's sources as they are")


def cosimulate(
    machine: TrueNorth, data: Recordings, *, rtl: str, simulator: str | None, folder: Path, bin_s: float
) -> Outcome:
    """Run recordings through the hardware description; exit code 1 where something differs.

    What is finished stays in the `folder`, and is not done again. Raises as :func:`build` and :meth:`Built.run`.
    """
    sources, program, netlist = sources_in(rtl), simulator_for(simulator), machine.netlist
    progress("building the hardware")
    built = build(machine, folder.absolute(), sources, program, netlist.ticks(data.events.shape[-1]))
    count, found = Progress(len(data)), []
    for index, name in enumerate(data.files):
        count(index, f"{program} runs recording")
        events = with_clocks(data.events[index : index + 1], netlist.clocks)[0, :, : data.steps_of(index)]
        key = hashlib.sha256(built.key.encode() + np.packbits(events > 0).tobytes()).hexdigest()
        done = folder / f"{key[:16]}.json"
        if not done.is_file():
            write_json(str(done), built.run(name, events))
        found.append(read_json(Compared, done, "--work", "spikeloom cosimulate"))
    result = Cosimulation(
        simulator=program,
        rtl_sha256=hashlib.sha256(b"".join(each.read_bytes() for each in sources)).hexdigest(),
        neurons=netlist.n_neurons,
        cores=netlist.n_cores,
        doubled=int(np.count_nonzero(built.terms.scale > 1)),
        exact_ticks=built.terms.ticks,
        step_s=bin_s * netlist.bins,
        ticks_per_step=netlist.bin_ticks,
        recordings=tuple(found),
    )
    return Outcome(result, sections, 1 if result.differences else 0)


def sections(found: Cosimulation) -> list[Section]:
    """The same for people."""
    names = ("spikes", "membranes", "outputs")
    wrong = {name: sum(getattr(each, f"{name}_different") for each in found.recordings) for name in names}
    lost = sum(each.packets_lost for each in found.recordings)
    ticks, errors = (sum(getattr(each, name) for each in found.recordings) for name in ("ticks", "error_cycles"))
    lines = [
        f"{found.neurons:,} neurons in {found.cores} cores of RANC's hardware, by {found.simulator}; "
        f"{len(found.recordings)} recordings, {ticks:,} ticks",
        f"spikes that differ: {wrong['spikes']:,} (of {found.spikes:,} spikes)",
        f"membranes that differ: {wrong['membranes']:,} of {found.membranes:,}",
        f"packets on the output bus that differ: {wrong['outputs']:,}; lost in cores: {lost:,}; "
        f"cycles with an error: {errors:,}",
        f"cycles of the longest tick: {found.cycles_per_tick:,}; {found.clock_hz / 1e6:.3g} MHz keep a data step of "
        f"{1e3 * found.step_s:g} ms",
    ]
    differing = [
        [each.recording, f"{each.spikes_different:,}", f"{each.membranes_different:,}", f"{each.packets_lost:,}"]
        for each in found.recordings
        if each.differences
    ]
    table = [Table(["recording", "spikes", "membranes", "lost"], differing[:20])] if differing else []
    return [Section("Hardware", [Text("\n".join(lines)), *table])]
