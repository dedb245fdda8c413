"""What the chip makes of a trained network: decisions, operations, energy, and first-layer neurons that never fire."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import cut, vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import Compilation, compile_network, without
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.checkpoint import propagation
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
from spikeloom.runtime.machines.votes import predictions, readout_counts

Json = dict[str, Any]

TARGET = "loihi1"

EPOCHS = ("last", "clean")
"""Epochs whose weights are put on the chip; the best one is chosen on the test split and says nothing."""

HOPELESS = 1.5
"""What a network uses of a limit with scales from its weights, at which better scales cannot make it fit."""

PART = 16
"""Recordings whose float spikes are held at a time."""


def measure(path: Path, training: Recordings, test: Recordings) -> Json:
    """Compile a checkpoint at 8 bits, scales chosen on training recordings, and run the test recordings.

    Returns
    -------
    dict
        ``last`` and ``clean`` epoch, see `_figures`; or ``refused``, the limits of the chip that it breaks.
    """
    target = load_target(TARGET)
    found: Json = {"target": TARGET, "bits": 8}
    epochs: dict[int, Json] = {}
    for which in EPOCHS:
        checkpoint = read_checkpoint(path, weights=which)
        epoch = (checkpoint.training or {})[which]["epoch"]
        if epoch not in epochs:
            network = expand(checkpoint, propagation(checkpoint, None, str(path))[1])
            try:
                compilation = _compiled(network, training)
            except CapacityError as error:
                return found | {"refused": [str(violation) for violation in error.violations]}
            decided = float_decisions(network, test)
            epochs[epoch] = {"epoch": epoch} | _figures(compilation, target, training, test, decided)
        found[which] = epochs[epoch]
    return found


def _compiled(network: Network, training: Recordings) -> Compilation:
    """The network on the chip, scales chosen on training recordings."""
    try:
        compile_network(
            network
        )  # scales from the weights: a second, where choosing them takes minutes in vain
    except CapacityError as error:
        if any(int(each.used) > HOPELESS * int(each.allowed) for each in error.violations):
            raise
    return compile_network(network, Options(training_events=training.events))


def float_decisions(network: Network, test: Recordings) -> IntArray:
    """Class of each recording by the float32 model, in the released operator order."""
    from spikeloom.models.networks.reference import float_spikes

    counts = []
    for first in range(0, len(test), PART):
        part = slice(first, first + PART)
        *_, spikes = float_spikes(network, test.events[part]).values()
        lengths = None if test.lengths is None else test.lengths[part]
        counts.append(readout_counts(network.readout, network.classes, cut(spikes, lengths)))
    return vote(np.concatenate(counts))


def _flat(recordings: Recordings) -> engine.EventArray:
    return recordings.events.reshape(len(recordings), -1, recordings.steps)


def _figures(
    compilation: Compilation, target: Target, training: Recordings, test: Recordings, decided: IntArray
) -> Json:
    """Figures of one netlist, and of the same without first-layer neurons that no training recording makes fire."""
    netlist = compilation.netlist
    spikes, costs = _costs(netlist, target, test)
    chip = predictions(netlist, spikes)
    held = netlist.compartments_of(0)
    in_training = engine.simulate(netlist, _flat(training), lengths=training.lengths).counts.spikes.sum(
        axis=0
    )
    quiet = in_training[held] == 0
    first = netlist.layers[0]
    found: Json = {
        "float_correct": int(np.sum(decided == test.labels)),
        "correct": int(np.sum(chip == test.labels)),
        "equal": int(np.sum(chip == decided)),
        **costs,
        "first_layer": {
            "neurons": first.neurons,
            "cannot_fire": first.neurons - len(held) - len(first.unread),
            "unheard": len(first.unread),
            "quiet_in_training": int(quiet.sum()),
            "quiet_in_both": int(np.sum(quiet & (spikes[:, held].sum(axis=0) == 0))),
        },
    }
    unused = tuple(np.zeros(population.size, np.bool_) for population in compilation.integer.populations)
    unused[0][netlist.neuron[held[quiet]]] = True
    if quiet.all():
        unused[0][netlist.neuron[held[0]]] = False  # a layer keeps one neuron
    steps = (
        float(training.steps * len(training)) if training.lengths is None else float(training.lengths.sum())
    )
    lean = without(compilation, unused, rates=_rates(compilation, in_training / steps))
    lean_spikes, lean_costs = _costs(lean, target, test)
    lean_chip = predictions(lean, lean_spikes)
    found["without_quiet"] = {
        "correct": int(np.sum(lean_chip == test.labels)),
        "equal_to_chip": int(np.sum(lean_chip == chip)),
        **lean_costs,
    }
    return found


def _rates(compilation: Compilation, rates: FloatArray) -> tuple[FloatArray, ...]:
    """Spikes per step of each neuron of each population, from those of each compartment."""
    netlist = compilation.netlist
    found = []
    for layer, population in enumerate(compilation.integer.populations):
        whole = np.zeros(population.size)
        ids = netlist.compartments_of(layer)
        whole[netlist.neuron[ids]] = rates[ids]
        found.append(whole)
    return tuple(found)


def _costs(netlist: Netlist, target: Target, test: Recordings) -> tuple[IntArray, Json]:
    """Spikes of each compartment on the test recordings, and what an inference costs in the mean."""
    trace, found = estimate(netlist, target, _flat(test), lengths=test.lengths)
    operations = found.costs.synaptic_operations
    return trace.counts.spikes, {
        "synaptic_operations": float(operations.sum(axis=1).mean()),
        "first_layer_operations": float(operations[:, 0].mean()),
        "energy_j": _means(found.costs.energy),
        "first_layer_energy_j": _means({name: each[:, :1] for name, each in found.costs.energy.items()}),
        "cores": netlist.n_cores,
        "neurons": netlist.n_compartments,
        "synapses": netlist.n_synapses,
    }


def _means(energy: Mapping[str, FloatArray]) -> dict[str, float]:
    """Joules of an inference by table."""
    return {name: float(each.sum(axis=1).mean()) for name, each in energy.items()}
