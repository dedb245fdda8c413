"""Run a TrueNorth netlist in RANC's hardware description, and compare every spike, membrane and packet with ours.

    python benchmarks/cosimulate.py NET.loom DATA --rtl RANC [--simulator iverilog] [--work FOLDER] [--limit N] [--json]

RANC is a clone of github.com/UA-RCL/RANC; a recording takes a minute or so by verilator. What is built and finished
stays in the folder of ``--work``, and the same command goes on from it. The exit code is 1 where something differs.

The cores, their routers and the output bus are RANC's; the wires between these, and what reads and writes
files, are ``harness.v``. Each recording is a run of its own, from memories as they are written, for the
description clears nothing.

Verilator 5.006 makes wrong code of these sources where it inlines gates, so that it is built without; Icarus
runs them as they are, about a hundred times slower.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError, SpikeloomError
from spikeloom.compiler.formats.ranc import Mesh, Terms, expressed, mesh_of
from spikeloom.compiler.formats.ranc_memory import memories, packet_lines, sizes
from spikeloom.compiler.targets.truenorth.netlist import crossbar_bytes
from spikeloom.compiler.types import EventArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.truenorth.machine import TrueNorth
from spikeloom.runtime.report.console import Progress, progress
from spikeloom.runtime.report.encode import INLINE, encode, read_json, write_json
from spikeloom.runtime.report.sections import Outcome, Section, Text, terminal
from spikeloom.runtime.requests.choices import SplitChoice

HARNESS = Path(__file__).with_name("harness.v")

IN_A_CLONE = "hardware/IP/RANCNetwork/src/sources"
FRONT_END = ("PacketFetch.v", "RANCNetwork.v", "RANCNetworkGrid.v", "RANCNetwork_S00_AXIS.v")
"""Sources that are not used: RANC's mesh, whose cores the harness could not look into, and its bus to a processor."""

SIMULATORS = {
    "verilator": "verilator --binary -j 1 -O3 -fno-gate --output-split 5000 --output-split-cfuncs 300 --noassert "
    "--x-assign fast --x-initial fast -Wno-fatal -Wno-lint -Wno-style -Wno-BLKANDNBLK -I. --top-module harness "
    "-Mdir build -o ../simulation -MAKEFLAGS \"OPT_FAST='-O2 -march=native'\"",
    "iverilog": "iverilog -g2012 -s harness -I . -o simulation",
}
"""Words that build ``simulation`` of the harness and the sources, by program, the faster one first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """What ran, and what differs, in one recording or in all."""

    ticks: int = 0
    cycles: int = 0  # Of the longest tick
    spikes: int = 0
    spikes_different: int = 0
    membranes: int = 0
    membranes_different: int = 0
    outputs_different: int = 0  # Packets on the output bus, by tick and class
    packets_lost: int = 0  # Those that reached a core in the cycle in which it clears what it has done
    error_cycles: int = 0  # Cycles in which some core reported an error

    def __add__(self, other: Compared) -> Compared:
        both = {each.name: getattr(self, each.name) + getattr(other, each.name) for each in fields(self)}
        return Compared(**both | {"cycles": max(self.cycles, other.cycles)})

    @property
    def differences(self) -> int:
        """Spikes, membranes and packets that differ or are lost, and errors."""
        wrong = self.spikes_different + self.membranes_different + self.outputs_different
        return wrong + self.packets_lost + self.error_cycles


@dataclass(frozen=True, slots=True, kw_only=True)
class Cosimulation:
    """What the hardware made of a network; `clock_hz` is what keeps the pace of the sensor, `step_s` a data step."""

    simulator: str
    rtl_sha256: str  # Of its sources, in the order of their names
    netlist_sha256: str  # Of the network's file
    neurons: int
    cores: int
    doubled: int  # Neurons whose numbers are twice ours in RANC's terms
    exact_ticks: int | None  # As in a file for RANC's simulator
    step_s: float
    clock_hz: float
    total: Compared = field(metadata=INLINE)
    recordings: Mapping[str, Compared]


def sources_in(folder: str) -> list[Path]:
    """Verilog files of RANC's cores in a folder, or in a clone of its repository; OptionError if there are none."""
    for place in (Path(folder) / IN_A_CLONE, Path(folder)):
        if (place / "Core.v").is_file():
            return [each.absolute() for each in sorted(place.glob("*.v")) if each.name not in FRONT_END]
    raise OptionError(
        f"--rtl {folder}: no Core.v in it; give a clone of github.com/UA-RCL/RANC, or its {IN_A_CLONE}"
    )


def simulator_for(wanted: str | None) -> str:
    """The program that is wanted, or the fastest that is installed; OptionError if there is none."""
    installed = [name for name in SIMULATORS if wanted in (None, name) and shutil.which(name)]
    if not installed:
        raise OptionError(
            f"{wanted or ' or '.join(SIMULATORS)}: not found; install it, it builds the hardware"
        )
    return installed[0]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Built:
    """A network in the hardware description, ready to run recordings in a folder."""

    machine: TrueNorth
    terms: Terms
    mesh: Mesh
    sizes: dict[str, int]
    folder: Path
    files: Mapping[str, str]  # That a run reads, beside its recording
    key: str  # Changes with everything that a run depends on, but its recording

    def run(self, events: EventArray) -> Compared:
        """Compare one recording (n_inputs, T); OptionError if a tick does not end."""
        with tempfile.TemporaryDirectory(prefix="recording-", dir=self.folder) as here:
            return self._compared(events, Path(here))

    def _compared(self, events: EventArray, here: Path) -> Compared:
        lines = packet_lines(self.terms, self.sizes, events)
        _write(here, {**self.files, "input.txt": "\n".join(lines) + "\n"})
        _call([self.folder / "simulation"], here)
        trace = self.machine.simulate(events[None], spikes=True, membranes=True)
        assert trace.spikes is not None, "spikes are kept"
        assert trace.membranes is not None, "membranes are kept"
        spikes = trace.spikes[0]
        membranes = trace.membranes[0] * self.terms.scale + self.terms.shift
        ticks, cycles, dropped, errors = map(int, (here / "end.txt").read_text("utf-8").split())
        if ticks < len(spikes):
            raise OptionError(f"--rtl: tick {max(ticks, 0)} does not end; give RANC's sources as they are")

        netlist = self.machine.netlist
        bits = self.sizes["MEMBRANE_BITS"]
        wrong_spikes = wrong_membranes = 0
        for core, place in enumerate((self.mesh.x + self.mesh.width * self.mesh.y).tolist()):
            ours = slice(*netlist.core_neurons[core : core + 2].tolist())
            words = np.fromfile(here / f"core_{place:03d}.bin", "<u4").astype(np.int64).reshape(ticks, -1)
            fired = words >> 31
            fields = words & ((1 << bits) - 1)
            fields -= (fields >> (bits - 1)) << bits
            count = spikes[:, ours].shape[1]
            wrong_spikes += int(
                np.count_nonzero(fired[:, :count] != spikes[:, ours]) + fired[:, count:].sum()
            )
            wrong_membranes += int(np.count_nonzero(fields[:, :count] != membranes[:, ours]))
        votes = np.zeros(
            (ticks, netlist.classes + 1), np.int64
        )  # the last is the way out of neurons without a target
        np.add.at(
            votes.T, np.where(netlist.readout_class < 0, netlist.classes, netlist.readout_class), spikes.T
        )
        out = np.array((here / "out.txt").read_text("utf-8").split(), np.int64)
        np.subtract.at(votes, (out[::2], out[1::2]), 1)
        return Compared(
            ticks=ticks,
            cycles=cycles,
            spikes=int(np.count_nonzero(spikes)),
            spikes_different=wrong_spikes,
            membranes=membranes.size,
            membranes_different=wrong_membranes,
            outputs_different=int(np.abs(votes[:, :-1]).sum()),
            packets_lost=dropped,
            error_cycles=errors,
        )


def build(machine: TrueNorth, folder: Path, sources: Sequence[Path], simulator: str, ticks: int) -> Built:
    """Write the memories of a network, and build it where that was not done already.

    ModelError if RANC has not what it uses, in recordings of so many `ticks`; OptionError if the sources are
    no good.
    """
    terms = expressed(machine.netlist, ticks)
    widths = sizes(terms, machine.target)
    files = {
        "sizes.vh": "".join(f"localparam {name} = {value};\n" for name, value in widths.items()),
        "empty.mem": "",
    }
    words = [*shlex.split(SIMULATORS[simulator]), str(HARNESS), *map(str, sources)]
    parts = [
        SIMULATORS[simulator],
        files["sizes.vh"],
        *(each.read_text("utf-8") for each in (HARNESS, *sources)),
    ]
    made = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    if not (stamp := folder / "built").is_file() or stamp.read_text("utf-8") != made:
        _write(folder, files)
        _call(words, folder)
        stamp.write_text(made, "utf-8")
    files |= memories(terms, widths)
    key = hashlib.sha256("\0".join([made, *files.values()]).encode()).hexdigest()
    mesh = mesh_of(machine.netlist)
    return Built(machine=machine, terms=terms, mesh=mesh, sizes=widths, folder=folder, files=files, key=key)


def _write(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        (folder / name).write_text(text, "utf-8")


def _call(words: Sequence[str | Path], folder: Path) -> None:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode:
        said = next(
            (line for line in done.stderr.splitlines() if "rror" in line), f"exit code {done.returncode}"
        )
        raise OptionError(
            f"--rtl: {Path(words[0]).name} fails: {said.strip()}; give RANC's sources as they are"
        )


def cosimulate(
    machine: TrueNorth, data: Recordings, *, rtl: str, simulator: str | None, folder: Path
) -> Outcome:
    """Run recordings through the hardware description; exit code 1 where something differs.

    What is finished stays in the `folder`, and is not done again. Raises as :func:`build` and
    :meth:`Built.run`.
    """
    sources = sources_in(rtl)
    program = simulator_for(simulator)
    netlist = machine.netlist
    progress("building the hardware")
    built = build(machine, folder.absolute(), sources, program, netlist.ticks(data.events.shape[-1]))
    count = Progress(len(data))
    compared = dict[str, Compared]()
    for index, name in enumerate(data.files):
        count(index, f"{program} runs recording")
        events = with_clocks(data.events[index : index + 1], netlist.clocks)[0, :, : data.steps_of(index)]
        key = hashlib.sha256(built.key.encode() + np.packbits(events > 0).tobytes()).hexdigest()
        done = folder / f"{key[:16]}.json"
        if not done.is_file():
            write_json(str(done), built.run(events))
        compared[name] = read_json(Compared, done, "--work", "benchmarks/cosimulate.py")
    total = sum(compared.values(), Compared())
    step_s = data.seconds * netlist.bins
    result = Cosimulation(
        simulator=program,
        rtl_sha256=hashlib.sha256(b"".join(each.read_bytes() for each in sources)).hexdigest(),
        netlist_sha256=hashlib.sha256(crossbar_bytes(netlist)).hexdigest(),
        neurons=netlist.n_neurons,
        cores=netlist.n_cores,
        doubled=int(np.count_nonzero(built.terms.scale > 1)),
        exact_ticks=built.terms.ticks,
        step_s=step_s,
        clock_hz=total.cycles * netlist.bin_ticks / step_s,
        total=total,
        recordings=compared,
    )
    return Outcome(result, sections, 1 if total.differences else 0)


def sections(found: Cosimulation) -> list[Section]:
    """The same for people."""
    total = found.total
    lines = [
        f"{found.neurons:,} neurons in {found.cores} cores of RANC's hardware, by {found.simulator}; "
        f"{len(found.recordings)} recordings, {total.ticks:,} ticks",
        f"spikes that differ: {total.spikes_different:,} (of {total.spikes:,} that are due)",
        f"membranes that differ: {total.membranes_different:,} of {total.membranes:,}",
        f"packets on the output bus that differ: {total.outputs_different:,}; lost in cores: {total.packets_lost:,}; "
        f"cycles with an error: {total.error_cycles:,}",
        f"cycles of the longest tick: {total.cycles:,}; {found.clock_hz / 1e6:.3g} MHz keep the pace of "
        f"{1e3 * found.step_s:g} ms a data step",
    ]
    if wrong := [name for name, each in found.recordings.items() if each.differences]:
        lines.append(f"recordings that differ: {', '.join(wrong)}")
    return [Section("Hardware", [Text("\n".join(lines))])]


def main(arguments: argparse.Namespace) -> Outcome:
    """Run the recordings."""
    machine = machine_for(arguments.netlist)
    if not isinstance(machine, TrueNorth):
        raise OptionError(f"{arguments.netlist}: no hardware description of {machine.target.title} is known")
    choice = SplitChoice(split=arguments.split, limit=arguments.limit)
    data = load_recordings(arguments.data, choice, machine.netlist)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(arguments.work or temporary)
        folder.mkdir(parents=True, exist_ok=True)
        return cosimulate(machine, data, rtl=arguments.rtl, simulator=arguments.simulator, folder=folder)


def options(words: list[str] | None = None) -> argparse.Namespace:
    """What was typed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("netlist")
    parser.add_argument("data")
    parser.add_argument("--rtl", required=True)
    parser.add_argument("--simulator", choices=tuple(SIMULATORS))
    parser.add_argument("--work")
    parser.add_argument("--split", default="test")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--json", action="store_true")
    return parser.parse_args(words)


if __name__ == "__main__":
    given = options()
    try:
        outcome = main(given)
    except (SpikeloomError, OSError) as error:
        sys.exit(str(error))
    print(json.dumps(encode(outcome.result)) if given.json else terminal(outcome.sections(outcome.result)))
    sys.exit(outcome.code)
