"""Large skins on several chips: time and memory of compiling and running against the number of synapses.

Command: ``python benchmarks/skins.py -o skins.json --chart skins``

A skin is a square lattice of taxels whose numbers run patch by patch, 16 x 16 taxels each; neighbours are joined. A
graph convolution of 16 features (K = 3) covers it. Each patch, 4,096 convolution neurons and so as many as one core
can hear, has its own 64 neurons of fc1 and its own vote of 10 classes; votes add up. Weights are random, events too
(2 % of the channels in a step). Each size runs in a process of its own; memory is the most that the process held
beyond what it held after a tiny skin had been through, so the float network is part of it. The engine's spikes are
those of the kernel of steps, which shares no code with it.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import multiprocessing
import platform
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from growth_chart import draw_skins
from made import made
from scipy import sparse

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.ir import INPUT, Input, Network, Population, Projection, Readout
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.layout.place import chip_count
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.loihi1 import engine

TAXELS = (1000, 2000, 5000, 10000, 20000, 50000, 100000)
SIDE, FEATURES, HIDDEN, CLASSES, HOPS = 16, 16, 64, 10, 4
BETA, THETA = 0.2, 0.5
DENSITY, STEPS, RECORDINGS = 0.02, 50, 4


def lattice(taxels: int) -> sparse.csr_array:
    """Normalised propagation matrix of the skin."""
    patch, inner = np.divmod(np.arange(taxels), SIDE * SIDE)
    across = int(np.ceil(np.sqrt(patch[-1] + 1)))
    x = patch % across * SIDE + inner % SIDE
    y = patch // across * SIDE + inner // SIDE
    width = across * SIDE + 1
    place = {int(p): i for i, p in enumerate(y * width + x)}
    pairs = [(i, place[p + step]) for p, i in place.items() for step in (1, width) if p + step in place]
    a, b = np.array(pairs).T
    joined = sparse.csr_array((np.ones(2 * len(a)), (np.append(a, b), np.append(b, a))), (taxels, taxels))
    scale = sparse.diags_array(np.asarray(joined.sum(axis=1)).ravel() ** -0.5)
    return sparse.csr_array(scale @ joined @ scale)


def stacked(parts: Iterable[sparse.csr_array]) -> sparse.csr_array:
    """Rows of matrices below each other, with indices of 32 bits."""
    return sparse.vstack(
        [
            sparse.csr_array((p.data, p.indices.astype(np.int32), p.indptr.astype(np.int32)), p.shape)
            for p in parts
        ],
        format="csr",
    )


def convolution(adjacency: sparse.csr_array, hops: np.ndarray) -> sparse.csr_array:
    """The synapses of a graph convolution, ``sum_k A^k ⊗ W_k^T``, made patch by patch."""
    powers = [sparse.eye_array(adjacency.shape[0], format="csr")]
    for _ in hops[1:]:
        powers.append(adjacency @ powers[-1])

    def patch(rows: slice) -> sparse.csr_array:
        kinds = zip(powers, hops, strict=True)
        made = sum((sparse.kron(power[rows], hop, format="csr") for power, hop in kinds), start=0)
        made.sort_indices()
        return made

    return stacked(patch(slice(first, first + SIDE**2)) for first in range(0, adjacency.shape[0], SIDE**2))


def block_diagonal(blocks: Iterable[np.ndarray], columns: int) -> sparse.csr_array:
    """Dense blocks, each to the right of and below the one before, `columns` wide together."""

    def parts() -> Iterator[sparse.csr_array]:
        first = 0
        for block in blocks:
            rows, width = block.shape
            place = np.tile(np.arange(first, first + width), rows)
            yield sparse.csr_array(
                (block.ravel(), place, np.arange(0, block.size + 1, width)), (rows, columns)
            )
            first += width

    return stacked(parts())


def skin(taxels: int, seed: int = 0) -> Network:
    """The network of a skin, in float64."""
    rng = np.random.default_rng(seed)
    conv = convolution(lattice(taxels), rng.normal(0, 0.7, (HOPS, FEATURES, 2)))
    sizes = [min(SIDE * SIDE, taxels - first) * FEATURES for first in range(0, taxels, SIDE * SIDE)]
    hidden = block_diagonal((rng.normal(0, 3 / size**0.5, (HIDDEN, size)) for size in sizes), sum(sizes))
    votes = block_diagonal((rng.normal(0, 0.3, (CLASSES, HIDDEN)) for _ in sizes), HIDDEN * len(sizes))
    weights = [conv, hidden, votes]
    return Network(
        input=Input(taxels=taxels, polarities=2),
        populations=tuple(
            Population(name=name, beta=BETA, theta=THETA, bias=rng.normal(0, 0.05, weight.shape[0]))
            for name, weight in zip(("conv1", "fc1", "fc2"), weights, strict=True)
        ),
        projections=tuple(
            Projection(pre=post - 1 if post else INPUT, post=post, weight=weight)
            for post, weight in enumerate(weights)
        ),
        readout=Readout(population=2, label=np.tile(np.arange(CLASSES), len(sizes))),
        classes=CLASSES,
    )


def held() -> int:
    """Most bytes that this process held since this was last asked, as Linux counts them."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return int(peak.split()[1]) * 1024


def measure(taxels: int) -> dict[str, Any]:
    """One size: compile, prepare, run and compare."""
    small = compile_network(skin(SIDE)).netlist  # imports and compiles what the work needs
    for stepwise in (False, True):
        engine.simulate(engine.prepare(small, stepwise=stepwise), np.zeros((1, small.n_inputs, 4), np.uint8))
    held()
    idle, start = held(), time.perf_counter()
    network = skin(taxels)
    ctypes.CDLL(None).malloc_trim(0)  # what making it left behind
    made = time.perf_counter()
    built = held()
    compilation = compile_network(network, Options(chips=1 + taxels // 1000))
    netlist, placement = compilation.netlist, compilation.placement
    compiled, compile_bytes = time.perf_counter(), held()
    del network, compilation
    held()
    prepared = engine.prepare(netlist)
    ready, prepare_bytes = time.perf_counter(), held()
    events = (np.random.default_rng(1).random((RECORDINGS, netlist.n_inputs, STEPS)) < DENSITY).astype(
        np.uint8
    )
    engine.simulate(prepared, events[:1], threads=1)
    warm = time.perf_counter()
    trace = engine.simulate(prepared, events, threads=1)
    ran = time.perf_counter()
    run_bytes = held()
    stepwise = engine.simulate(engine.prepare(netlist, stepwise=True), events[:1], threads=1)
    assert prepared.blocks is not None
    assert np.array_equal(stepwise.counts.spikes, trace.counts.spikes[:1])
    return {
        "taxels": taxels,
        "neurons": netlist.n_compartments,
        "synapses": netlist.n_synapses,
        "cores": netlist.n_cores,
        "chips": chip_count(netlist.core_tile, load_target("loihi1")),
        "packets_between_chips": placement.between_chips,
        "network_s": made - start,
        "compile_s": compiled - made,
        "prepare_s": ready - compiled,
        "run_ms": 1e3 * (ran - warm) / RECORDINGS,
        "synaptic_operations": float((trace.counts.inputs.sum() + trace.counts.spikes.sum()) / RECORDINGS),
        "spikes_per_neuron_step": float(trace.counts.spikes.mean() / STEPS),
        "network_bytes": built - idle,
        "compile_bytes": compile_bytes - idle,
        "run_bytes": max(run_bytes, prepare_bytes) - idle,
        "peak_bytes": max(built, compile_bytes, prepare_bytes, run_bytes),
    }


def main() -> None:
    """Measure every size and write what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("-o", "--output", required=True)
    parser.add_argument("--chart", metavar="STEM")
    parser.add_argument("--taxels", type=int, nargs="+", default=TAXELS)
    arguments = parser.parse_args()
    rows = []
    for taxels in arguments.taxels:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(measure, (taxels,))
        rows.append(row)
        each = {key: row[f"{key}_bytes"] / row["synapses"] for key in ("compile", "run")}
        print(
            f"{taxels} taxels, {row['synapses']:,} synapses, {row['cores']} cores, {row['chips']} chip(s): compiled in "
            f"{row['compile_s']:.1f} s ({each['compile']:.0f} bytes a synapse), prepared in {row['prepare_s']:.1f} s, "
            f"run in {row['run_ms']:.0f} ms a recording ({each['run']:.0f}); peak {row['peak_bytes'] / 2**30:.2f} GiB",
            flush=True,
        )
    result = made() | {"machine": platform.processor() or platform.machine(), "steps": STEPS}
    result |= {"density": DENSITY, "skins": rows}
    with write_atomically(arguments.output) as file:
        file.write(json.dumps(result, indent=1).encode() + b"\n")
    if arguments.chart:
        draw_skins(result, arguments.chart)


if __name__ == "__main__":
    main()
