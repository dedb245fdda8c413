"""Why Catalyst N1 is no target: ``python benchmarks/catalyst_n1.py RTL OUT.json`` asks its own Verilog, by iverilog.

RTL is the folder ``rtl`` of a checkout of github.com/catalyst-neuromorphic/catalyst-n1. Two cores are given small
networks whose sums are known; what arrives is read back by its probe.
"""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from made import made

from spikeloom.compiler.files import write_atomically

FILES = ("sram.v", "spike_fifo.v", "scalable_core_v2.v", "neuromorphic_mesh.v")
SIZES = {"NUM_CORES": 2, "CORE_ID_BITS": 1, "NUM_NEURONS": 256, "NEURON_BITS": 8, "POOL_DEPTH": 1024}
SIZES |= {"POOL_ADDR_BITS": 10, "COUNT_BITS": 8}
THRESHOLD, REFRACTORY, DECAY_V, DECAY_U = 0, 3, 16, 17  # numbers of parameters of a neuron
MEMBRANE, CURRENT = 0, 13  # numbers of what a probe reads

BENCH = """
module bench;
{declarations}
  neuromorphic_mesh #({parameters}) mesh ({ports});
  always #5 clk = ~clk;
  integer file, found, a, b, c, d, e, f; reg [7:0] word;
  task tick; begin @(posedge clk); #1; end endtask
  initial begin
    clk = 0; rst_n = 0; link_rx_empty = 1; repeat (4) tick; rst_n = 1; repeat (2) tick;
    file = $fopen("commands", "r");
    while (!$feof(file)) begin
      found = $fscanf(file, " %c %d %d %d %d %d %d\\n", word, a, b, c, d, e, f);
      case (word)
        "P": begin prog_param_we = 1; prog_param_core = a; prog_param_neuron = b; prog_param_id = c;
                   prog_param_value = d; tick; prog_param_we = 0; end
        "S": begin prog_pool_we = 1; prog_pool_core = a; prog_pool_addr = b; prog_pool_src = c; prog_pool_target = d;
                   prog_pool_weight = e; tick; prog_pool_we = 0;
                   prog_index_we = 1; prog_index_core = a; prog_index_neuron = c; prog_index_base = b;
                   prog_index_count = 1; tick; prog_index_we = 0; end
        "R": begin prog_route_we = 1; prog_route_src_core = a; prog_route_src_neuron = b; prog_route_slot = 0;
                   prog_route_dest_core = c; prog_route_dest_neuron = d; prog_route_weight = e;
                   tick; prog_route_we = 0; end
        "E": begin ext_valid = 1; ext_core = a; ext_neuron_id = b; ext_current = c; tick; ext_valid = 0; tick; end
        "T": begin start = 1; tick; start = 0; while (!timestep_done) tick; repeat (4) tick; end
        "Q": begin probe_read = 1; probe_core = a; probe_neuron = b; probe_state_id = c; tick; probe_read = 0;
                   while (!probe_valid) tick; $display("read %0d", probe_data); tick; end
      endcase
    end
    $finish;
  end
endmodule
"""
Command = tuple[object, ...]


def bench_of(mesh: str) -> str:
    """A test bench that drives every port of the mesh from a file of commands."""
    ports = re.findall(r"^    (input|output)\s+(?:wire|reg)\s+(signed )?(\[[^]]*\] )?\s*(\w+)", mesh, re.MULTILINE)
    sizes = SIZES | {"DATA_WIDTH": 16, "ROUTE_SLOT_BITS": 3, "GLOBAL_ROUTE_SLOT_BITS": 2}
    lines = [f"  localparam {name} = {value};" for name, value in sizes.items()]
    for way, signed, width, name in ports:
        lines.append(
            f"  {'reg' if way == 'input' else 'wire'} {signed}{width}{name}{' = 0' if way == 'input' else ''};"
        )
    return BENCH.format(
        declarations="\n".join(lines),
        parameters=", ".join(f".{name}({name})" for name in SIZES),
        ports=", ".join(f".{name}({name})" for *_, name in ports),
    )


def run(rtl: Path, commands: Sequence[Command]) -> list[int]:
    """What the probe reads in these commands."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "bench.v").write_text(bench_of((rtl / "neuromorphic_mesh.v").read_text("utf-8")), "utf-8")
        padded = [" ".join(map(str, (*command, *[0] * (7 - len(command))))) for command in commands]
        (Path(folder) / "commands").write_text("\n".join(padded) + "\n", "utf-8")
        sources = [str((rtl / name).resolve()) for name in FILES]
        words = ["iverilog", "-g2012", "-DSIMULATION", "-s", "bench", "-o", "bench.vvp", "bench.v", *sources]
        subprocess.run(words, cwd=folder, check=True)
        said = subprocess.run(["vvp", "-n", "bench.vvp"], cwd=folder, check=True, capture_output=True, text=True).stdout
    return [int(line.split()[1]) for line in said.splitlines() if line.startswith("read ")]


def neuron(core: int, number: int, threshold: int = 32767, decay_u: int = 4095, decay_v: int = 4095) -> list[Command]:
    """Parameters of a neuron that integrates currents."""
    values = {THRESHOLD: threshold, REFRACTORY: 0, DECAY_V: decay_v, DECAY_U: decay_u}
    return [("P", core, number, which, value) for which, value in values.items()]


def firing(neurons: Sequence[int]) -> list[Command]:
    """Let these neurons of core 0 fire together: a current in one step, the membrane in the next."""
    return [*(("E", 0, each, 100) for each in neurons), ("T",), ("T",)]


def within_a_core(rtl: Path, senders: int) -> int:
    """Sum that arrives at a neuron when so many of its core fire at once, each with a weight of 1."""
    commands = [*neuron(0, 255)]
    for each in range(senders):
        commands += [*neuron(0, each, threshold=50), ("S", 0, each, each, 255, 1)]
    return run(rtl, [*commands, *firing(range(senders)), ("T",), ("Q", 0, 255, CURRENT)])[0]


def between_cores(rtl: Path, weights: Sequence[int]) -> int:
    """Sum that arrives at a neuron of core 1 when neurons of core 0 fire at once, each with its weight."""
    commands = [*neuron(1, 0)]
    for each, weight in enumerate(weights):
        commands += [*neuron(0, each, threshold=50), ("R", 0, each, 1, 0, weight)]
    return run(rtl, [*commands, *firing(range(len(weights))), ("T",), ("Q", 1, 0, CURRENT)])[0]


def decayed(rtl: Path, current: int, decay_u: int) -> int:
    """What a step leaves of a current."""
    commands = [*neuron(0, 0, decay_u=decay_u), ("E", 0, 0, current), ("T",), ("T",), ("Q", 0, 0, CURRENT)]
    return run(rtl, commands)[0]


def driven_down(rtl: Path) -> int:
    """Membrane after two currents of -30000."""
    drive: list[Command] = [("E", 0, 0, -30000), ("T",)]
    return run(rtl, [*neuron(0, 0, decay_v=1), *drive, *drive, ("T",), ("Q", 0, 0, MEMBRANE)])[0]


def main() -> None:
    """Ask and write."""
    rtl = Path(sys.argv[1])
    result = made() | {
        "data_sha256": hashlib.sha256(b"".join((rtl / name).read_bytes() for name in FILES)).hexdigest(),
        "within a core": {str(senders): within_a_core(rtl, senders) for senders in (10, 64, 65, 100)},
        "between cores": {"weights": [100, 200, 400], "arrives": between_cores(rtl, [100, 200, 400])},
        "membrane after two currents of -30000": driven_down(rtl),
        "kept of a current": {
            str(value): {str(decay): decayed(rtl, value, decay) for decay in (3277, 4095)}
            for value in (-100, -5, 5, 100)
        },
    }
    print(json.dumps(result, indent=1))
    with write_atomically(sys.argv[2]) as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
