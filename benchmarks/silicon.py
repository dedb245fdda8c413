"""What our prices say of networks that a Loihi 1 was measured with: ``python benchmarks/silicon.py FOLDER OUT.json``.

FOLDER holds ``netLoihi_rec_th10.net`` and ``ntidigits.net`` of github.com/intel-nrc-ecosystem/models (3dc53bf). The
keyword spotter and its scaled family (github.com/abr/power_benchmarks) are drawn here from the distributions that are
stated there. Nothing measured is read and nothing is fitted: what is not known spans an interval, and no figure is
compared.
"""

import hashlib
import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from made import made
from scipy import sparse

from spikeloom.compiler import ir
from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.hdf5 import Tree, read_hdf5
from spikeloom.compiler.formats.netx.reader import integers_of
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.integers import (
    MANTISSA,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
)
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate

Json = dict[str, Any]

LAYERS, WIDTH, FEATURES = 10, 256, 390
LARGEST = 0.05
"""Weights and biases of the scaled networks are uniform within this, in units of activity."""

STEP = 2 * np.round(127 / LARGEST) / 2
"""Weight steps of a weight of one: the largest is 127 steps, with a mantissa of 254 at exponent -1."""

SPIKES = {"silent": 0.0, "low": 0.2, "central": 0.5, "high": 1.0}
"""Spikes a step of a neuron of activity one: amplitudes 0.005, 0.002 and 0.001 at 1 ms a step.

Nengo's published keyword spotter was trained with 0.002 and runs with 0.005; silent are biases of the stated
distribution taken as spikes a second.
"""

INPUT = {"silent": 0.0, "low": 0.02, "central": 0.1, "high": 0.3}
"""Events a step and channel of what comes through the x86 into the keyword networks."""

SEEDS = {0: 3, 1: 4, 2: 3}
"""Draws of the weights by number of branches: branches are alike, so more of them lie on the line through 1 and 2."""

INFERENCE = 10
"""Chip steps of an inference of the keyword networks; their input stays while it lasts."""

WARM, RUN = 500, 1500
"""Steps of a run of theirs, in which membranes come from rest to their rates, and at its end."""

RATES = {"low": 0.002, "central": 0.01, "high": 0.05}
"""Events a step and channel of the recordings of a file, of which none is public; in bursts of ten steps."""

RECORDINGS = 5

RELAY = {"iDecay": 4096, "vDecay": 4095, "vThMant": 1, "refDelay": 1}
"""Neurons that SLAYER's tool chain puts before the first layer: they send on in the next step what they get."""

FILES = {
    "braille": ("netLoihi_rec_th10.net", 270, {"recurrent2": 45, "dense3": 2, "input0": 5}),
    "ntidigits": ("ntidigits.net", 3000, {"dense2": 2, "dense3": 2, "dense4": 1, "input0": 1}),
}
"""File, steps of a sample, and how many cores the published layout gives to each layer."""


def population(name: str, size: int, bias: FloatArray) -> IntegerPopulation:
    """Neurons that integrate and fire at one, without a leak; biases (size,) are added in every step."""
    mantissa = np.rint(bias * STEP * 64 / 4).astype(np.int64)
    return IntegerPopulation(
        name=name,
        beta=1.0,
        theta=1.0,
        scale=np.full(size, STEP),
        decay_u=4095,
        decay_v=0,
        threshold=np.full(size, int(STEP)),
        bias_mantissa=mantissa,
        bias_exponent=np.where(mantissa != 0, 2, 0),
    )


def keywords(branches: int, seed: int, spikes: float) -> IntegerNetwork:
    """Input layer, branches of ten layers, output layer: weights and biases uniform, `spikes` a step per activity."""
    draw = np.random.default_rng([seed, branches])
    populations: list[IntegerPopulation] = []
    projections: list[IntegerProjection] = []

    def layer(name: str, pres: Sequence[tuple[int, int]]) -> int:
        populations.append(population(name, WIDTH, draw.uniform(-LARGEST, LARGEST, WIDTH) * spikes))
        for pre, size in pres:
            weight = draw.uniform(-LARGEST, LARGEST, (WIDTH, size))
            mantissa = sparse.csr_array((2 * np.rint(weight * STEP)).astype(MANTISSA))
            projections.append(
                IntegerProjection(pre=pre, post=len(populations) - 1, weight=mantissa, exponent=-1, bits=8)
            )
        return len(populations) - 1

    first = layer("input", [(ir.INPUT, FEATURES)])
    ends = []
    for branch in range(branches):
        last = first
        for depth in range(LAYERS):
            last = layer(f"b{branch}l{depth}", [(last, WIDTH)])
        ends.append((last, WIDTH))
    layer("output", ends or [(first, WIDTH)])
    return IntegerNetwork(
        input=ir.Input(taxels=FEATURES, polarities=1),
        populations=tuple(populations),
        projections=tuple(projections),
        readout=ir.Readout(population=len(populations) - 1, label=np.arange(WIDTH)),
        classes=WIDTH,
    )


def laid_out(network: IntegerNetwork, cores: dict[str, int]) -> Netlist:
    """A netlist with at least so many cores for each layer."""
    return compile_network(network, Options(cores_for=cores)).netlist


def with_biases(netlist: Netlist, network: IntegerNetwork) -> Netlist:
    """The same cores and synapses with the biases of a network."""
    mantissa = np.stack([each.bias_mantissa for each in network.populations])[netlist.layer, netlist.neuron]
    exponent = np.where(mantissa != 0, 2, 0)
    return replace(
        netlist,
        bias_mantissa=read_only(mantissa.astype(netlist.bias_mantissa.dtype)),
        bias_exponent=read_only(exponent.astype(netlist.bias_exponent.dtype)),
    )


def priced(netlist: Netlist, events: IntArray, lengths: IntArray, per: int) -> Json:
    """Cores, and by table joules, parts and times of recordings, each amount divided by `per` steps.

    With several lengths the first recording's amounts are taken off the second's.
    """
    target = load_target("loihi1")
    trace, found = estimate(netlist, target, events, lengths=lengths)
    end = int(lengths.max())

    def amount(each: FloatArray) -> float:
        of = each.reshape(len(lengths), -1).sum(axis=1)
        return float((of[1] - of[0] if lengths.min() < end else of.mean()) / per)

    parts = cost.by_part(target, found.costs.events)
    return {
        "cores": netlist.n_cores,
        "neurons": netlist.n_compartments,
        "spikes_per_step": amount(trace.counts.spikes.astype(np.float64)),
        "synaptic_operations_per_step": amount(found.costs.synaptic_operations),
        "energy_per_step_j": {name: amount(each) for name, each in found.costs.energy.items()},
        "parts_per_step_j": {
            name: {part: amount(each) for part, each in by.items()} for name, by in parts.items()
        },
        "step_s": {
            name: float(times.duration_ns[lengths == end, end - per : end].mean() * 1e-9)
            for name, times in found.simple.items()
        },
    }


def keyword_rows() -> Iterator[Json]:
    """The scaled family and the keyword spotter, by step."""
    rng = np.random.default_rng(2019)
    lengths = np.array([WARM, RUN])
    family = [(f"N={branches}", branches, {"input": 8, "output": 8}) for branches in SEEDS]
    for name, branches, cores in [*family, ("spotter", 0, {"input": 2, "output": 1})]:
        for seed in range(SEEDS[branches]):
            drawn = keywords(branches, seed, SPIKES["high"])
            netlist = laid_out(drawn, cores)
            for level, spikes in SPIKES.items():
                if level == "silent" and seed:
                    continue
                once = (rng.random((1, FEATURES, RUN)) < INPUT[level]).astype(np.uint8)
                now = with_biases(netlist, keywords(branches, seed, spikes))
                row = priced(now, np.repeat(once, 2, axis=0), lengths, RUN - WARM)
                yield {"network": name, "branches": branches, "level": level, "seed": seed, **row}


def tree_of(path: Path) -> Tree:
    """A file of SLAYER as its tool chain takes it: relays before the first layer, no delays, no average behind."""
    tree, _ = read_hdf5(path, "netx file")
    layers = tree["layer"]
    layers["0"] |= {"neuron": {"type": "LOIHI"} | {k: np.array(v) for k, v in RELAY.items()}}
    layers["0"] |= {"weight": np.array(2)}
    for key in [key for key, layer in layers.items() if layer["type"] == ["average"]]:
        del layers[key]
    for layer in layers.values():
        layer.pop("delay", None)
    return tree


def file_rows(folder: Path) -> Iterator[Json]:
    """Networks of files on made recordings, in the published layout and in ours, per sample."""
    rng = np.random.default_rng(2022)
    for name, (file, steps, published) in FILES.items():
        network, _ = integers_of(tree_of(folder / file))
        channels = network.input.size
        own = channels // 2 if name.startswith("braille") else channels  # it takes each channel twice
        netlists = {"published": laid_out(network, published), "ours": laid_out(network, {})}
        for level, rate in RATES.items():
            bursts = np.repeat(rng.gamma(0.3, rate / 0.3, (RECORDINGS, own, steps // 10)), 10, axis=2)
            events = np.tile(rng.random(bursts.shape) < bursts, (1, channels // own, 1)).astype(np.uint8)
            for layout, netlist in netlists.items():
                row = priced(netlist, events, np.full(RECORDINGS, steps), steps)
                made_of = {"layout": layout, "input_rate": float(events.mean()), "steps": steps}
                yield {"network": name, "level": level, **made_of, **row}


def slopes(rows: Sequence[Json]) -> Json:
    """Joules of an inference for each further branch, by level, table and part: least squares over N of 1 and more."""
    found: Json = {}
    for level in SPIKES:
        some = [row for row in rows if row["level"] == level and row.get("branches")]
        branches = [row["branches"] for row in some]
        for table in some[0]["energy_per_step_j"]:
            amounts = {part: [row["parts_per_step_j"][table][part] for row in some] for part in cost.PARTS}
            amounts["all"] = [row["energy_per_step_j"][table] for row in some]
            found.setdefault(level, {})[table] = {
                part: INFERENCE * float(np.polyfit(branches, each, 1)[0]) for part, each in amounts.items()
            }
    return found


def main() -> None:
    """Write every row on a line, the slope over the branches, and the hashes of the files."""
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    rows = []
    for row in itertools.chain(file_rows(folder), keyword_rows()):
        print(row["network"], row["level"], flush=True)
        rows.append(row)
    files = {file: hashlib.sha256((folder / file).read_bytes()).hexdigest() for file, *_ in FILES.values()}
    content = made() | {
        "files_sha256": files,
        "inference_steps": INFERENCE,
        "slope_per_branch_j": slopes(rows),
    }
    head = json.dumps(content, indent=2)[:-2]
    lines = ",\n".join("    " + json.dumps(row) for row in rows)
    with write_atomically(out) as file:
        file.write(f'{head},\n  "rows": [\n{lines}\n  ]\n}}\n'.encode())


if __name__ == "__main__":
    main()
