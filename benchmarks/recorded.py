"""Recorded runs of Loihi beside the specification: ``python benchmarks/recorded.py SLAYER OUT.json``.

SLAYER is a checkout of github.com/bamsumit/slayerPytorch, whose licence keeps its test data out of this repository: a
network of 250 channels, 25 hidden neurons and one output over 500 steps, and a step response of one neuron.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from made import made

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1 import spec
from spikeloom.runtime.machines.loihi1.trace import Trace

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from random_netlists import Axon, Neuron, build

DATA = "test/test_files/Loihi"
CHANNELS, HIDDEN, STEPS = 250, 25, 500
NEURON = {"decay_u": 1023, "decay_v": 128, "threshold": 80}
"""Registers of its settings iDecay 1024, vDecay 128, vThMant 80."""

VOLTAGES = {
    "loihiHiddenVoltage": 0,
    "loihiHiddenVoltage23": 23,
    "loihiHiddenVoltage24": 24,
    "loihiOutputVoltage": 25,
}
"""Files of recorded voltages, and whose they are."""


def make_network(folder: Path) -> Netlist:
    """The trained weights, rounded to even numbers as its own test does."""
    first, second = (
        2 * np.round(2 * np.loadtxt(folder / "snnData" / f"w{i}learned.txt", ndmin=2)).astype(int)
        for i in (1, 2)
    )
    axons = [Axon(source=i, targets=tuple(enumerate(column))) for i, column in enumerate(first.T.tolist())]
    axons += [
        Axon(source=CHANNELS + i, targets=((HIDDEN, weight),))
        for i, weight in enumerate(second.ravel().tolist())
    ]
    neurons = [Neuron(layer=int(i == HIDDEN), **NEURON) for i in range(HIDDEN + 1)]
    return build(neurons, axons, n_inputs=CHANNELS, depths=[0, 0])


def compare(slayer: Path, simulate: Callable[[Netlist, np.ndarray], Trace]) -> dict[str, dict[str, int]]:
    """Recorded spikes and voltages, and how many of ours differ.

    A file's first voltage is that of step 1. In the step of a spike the record holds a count of the refractory time
    instead of a voltage; these are left out.
    """
    folder = slayer / DATA

    def recorded(name: str, neurons: int) -> np.ndarray:
        spikes = np.zeros((neurons, STEPS), np.uint8)
        spikes[tuple(np.loadtxt(folder / "LoihiData" / f"{name}.txt", int, ndmin=2).T)] = 1
        return spikes

    trace = simulate(make_network(folder), recorded("loihiInputSpikes", CHANNELS))
    spikes = np.concatenate([recorded("loihiHiddenSpikes", HIDDEN), recorded("loihiOutputSpikes", 1)])
    voltages, wrong = 0, 0
    for name, neuron in VOLTAGES.items():
        silent = ~trace.spikes[1:, neuron]
        differing = np.loadtxt(folder / "LoihiData" / f"{name}.txt") != trace.membranes[1:, neuron]
        voltages, wrong = voltages + int(silent.sum()), wrong + int((differing & silent).sum())
    response = np.array(
        (folder / "LoihiData" / "LoihiVth05.txt").read_text("ascii").splitlines()[1].split(","), int
    )
    single = build([Neuron(**NEURON)], [Axon(source=0, targets=((0, 2),))], n_inputs=1, depths=[0])
    ours = simulate(single, np.eye(1, len(response), 1, np.uint8)).membranes[:, 0]
    return {
        "spikes": {"recorded": int(spikes.sum()), "wrong": int((trace.spikes.T != spikes).sum())},
        "voltages": {
            "recorded": voltages + len(response),
            "wrong": wrong + int((ours != response).sum()),
        },
    }


if __name__ == "__main__":
    slayer = Path(sys.argv[1])
    files = [slayer / DATA / part for part in ("LoihiData", "snnData")]
    digest = hashlib.sha256(
        b"".join(path.read_bytes() for folder in files for path in sorted(folder.iterdir()))
    )
    result = made() | {"data_sha256": digest.hexdigest()} | compare(slayer, spec.simulate)
    print(result)
    with write_atomically(sys.argv[2]) as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())
