"""What the rivals run: a busy network with random weights, any compiled netlist, and what must come out of them.

The *busy network* has the shape of TactileSGNet on its manual graph (78 channels, 2496 + 128 + 256 + 36 neurons) and
random 8-bit weights; its thresholds are set so that 8 to 12 % of the neurons of each layer spike in a step, half as
much again as in a trained network. Rivals know neither cores nor axons, so every netlist is handed to them as a
`Chain`: dense integer matrices, one for each layer, over the compartments that the chip holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from spikeloom.compiler.ir import INPUT, Input, Readout
from spikeloom.compiler.passes.expand import hop_powers, synapses
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerPopulation, IntegerProjection
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.layout.place import core_traffic, place
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import ONE_STEP_SUM_MAX, decay_registers, encode_bias
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import build_graph, normalised_adjacency

SpikeArray = npt.NDArray[np.bool_]

FEATURES, HOPS, HIDDEN, CLASSES = 64, 3, (128, 256), 36
BETA = 0.2
RATES = (0.08, 0.10, 0.10, 0.12)
"""Largest share of each layer's neurons that may spike in a step of the recordings that set the thresholds."""

CALIBRATION, SHARP = 32, 8
"""Recordings that set the spread of the biases, and the first of these, which set the thresholds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stage:
    """One layer of a chain; membranes and biases count in 1/64 of a weight unit.

    Parameters
    ----------
    weights : dict of int to (neurons, sources) int64
        Weight units, by the layer that is listened to; the input is -1.
    bias : (neurons,) int64
        Added to the membrane in every step.
    threshold : (neurons,) int64
        A spike needs a membrane above it.
    core : (neurons,) int64
        Where our placer put each neuron.
    decay : int
        4096ths of the membrane that a step takes.
    dense : bool
        Whether most of its synapses are stored in dense lists.
    """

    weights: dict[int, IntArray]
    bias: IntArray
    threshold: IntArray
    core: IntArray
    decay: int
    dense: bool

    @property
    def weight(self) -> IntArray:
        """Weights of a stage that listens to one other."""
        (weight,) = self.weights.values()
        return weight

    def arrays(self, index: int) -> dict[str, object]:
        """What a task file holds of it."""
        held: dict[str, object] = {
            f"weight{index} {source}": weight for source, weight in self.weights.items()
        }
        return held | {
            f"{key}{index}": getattr(self, key) for key in ("bias", "threshold", "core", "decay", "dense")
        }


Chain = tuple[Stage, ...]
"""Layers that each listen to the one before, the first to the input; decay 819/4096, currents without memory."""


def stages_of(netlist: Netlist) -> Chain:
    """Dense matrices of a netlist of any wiring.

    Raises
    ------
    ValueError
        If a current outlasts its step, or the decays of a layer differ.
    """
    forgets, _ = decay_registers(BETA)
    if np.any(netlist.decay_u != forgets):
        raise ValueError("currents that outlast a step are not given to the rivals")
    source = netlist.axon_source[netlist.axon_of_synapse()]
    target = netlist.synapse_compartment()
    weight = netlist.effective_weight()
    dense = (netlist.format_index_bits[netlist.axon_format] == 0)[netlist.axon_of_synapse()]
    sources = {-1: np.arange(netlist.n_inputs)}
    sources |= {i: netlist.n_inputs + netlist.compartments_of(i) for i in range(len(netlist.layers))}
    place, layer_of = np.zeros((2, netlist.n_inputs + netlist.n_compartments), np.int64)
    for index, members in sources.items():
        place[members], layer_of[members] = np.arange(len(members)), index
    stages = []
    for layer in range(len(netlist.layers)):
        ids = netlist.compartments_of(layer)
        mine = netlist.layer[target] == layer
        weights = {}
        for index in np.unique(layer_of[source[mine]]).tolist():
            matrix = np.zeros((len(ids), len(sources[index])), np.int64)
            chosen = mine & (layer_of[source] == index)
            rows, columns = place[netlist.n_inputs + target[chosen]], place[source[chosen]]
            np.add.at(matrix, (rows, columns), weight[chosen])
            weights[index] = matrix
        (decay,) = np.unique(netlist.decay_v[ids])
        stages.append(
            Stage(
                weights=weights,
                bias=(netlist.bias_mantissa << netlist.bias_exponent)[ids],
                threshold=netlist.threshold[ids] << 6,
                core=netlist.core_of_compartment()[ids],
                decay=int(decay),
                dense=bool(dense[mine].mean() > 0.5),
            )
        )
    return tuple(stages)


def chain_of(netlist: Netlist) -> Chain:
    """Dense matrices of a netlist that is a chain.

    Raises
    ------
    ValueError
        If it is no chain of layers, or its decays are others.
    """
    stages, (_, decay) = stages_of(netlist), decay_registers(BETA)
    for index, stage in enumerate(stages):
        if stage.decay != decay:
            raise ValueError(f"decays other than {BETA} are not given to the rivals")
        if list(stage.weights) != [index - 1]:
            raise ValueError(f"{netlist.layers[index].name}: listens to another layer than the one before")
    return stages


def recurrence(current: IntArray, threshold: IntArray | int) -> SpikeArray:
    """Spikes for given currents (recordings, steps, neurons), biases included, all in 1/64 of a weight unit."""
    spikes = np.zeros(current.shape, np.bool_)
    membrane = np.zeros(current[:, 0].shape, np.int64)
    for step in range(current.shape[1]):
        membrane = np.sign(membrane) * (np.abs(membrane) * 819 >> 12) + current[:, step]
        spikes[:, step] = membrane > threshold
        membrane[spikes[:, step]] = 0
    return spikes


def _currents(weight: IntArray, bias: IntArray, spikes: SpikeArray) -> IntArray:
    # float64 products of integers below 2**53 are exact
    sums = spikes.astype(np.float64) @ weight.T.astype(np.float64)
    return (np.rint(sums).astype(np.int64) << 6) + bias


def reference(chain: Chain, events: SpikeArray, *, delay: int = 0, first_delay: int = 0) -> list[SpikeArray]:
    """Spikes of each layer, (recordings, steps, neurons), by plain NumPy integers.

    Parameters
    ----------
    chain : Chain
        The network.
    events : (recordings, steps, channels) bool
        Input; pad it with silence where spikes shall drain.
    delay : int
        Steps from a layer to the next: 0 as trained, 1 as chips and their simulators have it, every layer integrating
        its biases from the first step on.
    first_delay : int
        Steps from the input to the first layer.
    """
    found: list[SpikeArray] = []
    spikes = events
    for index, stage in enumerate(chain):
        late = delay if index else first_delay
        silence = np.zeros((len(spikes), late, spikes.shape[2]), np.bool_)
        heard = np.concatenate([silence, spikes], axis=1)[:, : spikes.shape[1]]
        spikes = recurrence(_currents(stage.weight, stage.bias, heard), stage.threshold)
        found.append(spikes)
    return found


def random_weights(seed: int = 0) -> list[IntArray]:
    """Weights of the busy network: uniform draws of torch's ranges, the convolution expanded, rounded to 8 bits.

    Parameters
    ----------
    seed : int
        Of the draws.
    """
    rng = np.random.default_rng(seed)
    graph = build_graph("manual")
    bound = np.sqrt(6 / (2 + FEATURES))
    filters = rng.uniform(-bound, bound, (HOPS + 1, FEATURES, 2))
    convolution = synapses(hop_powers(normalised_adjacency(graph.edges, graph.n_taxels), HOPS + 1), filters)
    weights = [convolution.toarray()]
    for size in (*HIDDEN, CLASSES):
        before = len(weights[-1])
        weights.append(rng.uniform(-1, 1, (size, before)) / np.sqrt(before))
    return [rounded(weight) for weight in weights]


def rounded(weight: FloatArray) -> IntArray:
    """Weights of 8 bits, fewer levels where one step's sum could pass the chip's accumulator: no input overflows it."""
    one_sided = max(np.maximum(weight, 0).sum(axis=1).max(), np.maximum(-weight, 0).sum(axis=1).max())
    # each entry may be rounded up by a half
    scale = min(127 / np.abs(weight).max(), (ONE_STEP_SUM_MAX - weight.shape[1] / 2) / one_sided)
    return np.rint(weight * scale).astype(np.int64)


def _threshold(current: IntArray, rate: float, high: int) -> int:
    """Smallest threshold in weight units, up to `high`, at which at most `rate` of all neurons spike."""
    low = 1
    while low < high:
        middle = (low + high) // 2
        if recurrence(current, middle << 6).mean() > rate:
            low = middle + 1
        else:
            high = middle
    return low


def build_chain(
    events: SpikeArray,
    *,
    weights: Sequence[IntArray] | None = None,
    rates: Sequence[float] = RATES,
    seed: int = 0,
) -> list[tuple[IntArray, IntArray, int]]:
    """Weights, biases and threshold of each layer of the busy network, in weight units.

    Parameters
    ----------
    events : (recordings, steps, channels) bool
        Recordings whose first `CALIBRATION` set biases and thresholds.
    weights : sequence of (neurons, sources) int64, optional
        By default those of `random_weights`.
    rates : sequence of float
        One for each layer, see `RATES`.
    seed : int
        Of weights and biases.
    """
    rng = np.random.default_rng(seed + 1)
    spikes, layers = events[:CALIBRATION], []
    for weight, rate in zip(weights or random_weights(seed), rates, strict=True):
        without = _currents(weight, np.zeros(len(weight), np.int64), spikes)
        bias = np.rint(rng.normal(0, 0.1 * (without / 64).std(), len(weight))).astype(np.int64)
        current = without + (bias << 6)
        threshold = _threshold(current[:SHARP], rate, 2 * int(without.max() >> 6))
        spikes = recurrence(current, threshold << 6)
        layers.append((weight, bias, threshold))
    return layers


def place_chain(layers: Sequence[tuple[IntArray, IntArray, int]], *, taxels: int) -> Netlist:
    """Partition, place and write down a chain for Loihi 1; two polarities a taxel, the last layer votes.

    Weights are stored in 8 bits at exponent -1, where the even mantissas of a mixed-sign format are all integers.

    Raises
    ------
    CapacityError
        If it does not fit the chip.
    """
    decay_u, decay_v = decay_registers(BETA)
    populations, projections = [], []
    for index, (weight, bias, threshold) in enumerate(layers):
        mantissa, exponent = encode_bias(bias * 64.0)
        assert np.array_equal(mantissa << exponent, bias << 6), (
            "biases of whole weight units need no rounding"
        )
        populations.append(
            IntegerPopulation(
                name="conv1" if index == 0 else f"fc{index}",
                beta=BETA,
                theta=float(threshold),
                scale=np.ones(len(bias)),
                decay_u=decay_u,
                decay_v=decay_v,
                threshold=np.full(len(bias), threshold),
                bias_mantissa=mantissa,
                bias_exponent=exponent,
            )
        )
        projections.append(
            IntegerProjection(
                pre=index - 1 if index else INPUT,
                post=index,
                weight=sparse.csr_array(2 * weight),
                exponent=-1,
                bits=8,
            )
        )
    classes = populations[-1].size
    network = IntegerNetwork(
        input=Input(taxels=taxels, polarities=2),
        populations=tuple(populations),
        projections=tuple(projections),
        readout=Readout(population=len(populations) - 1, label=np.arange(classes)),
        classes=classes,
    )
    chip = load_target("loihi1")
    parts = partition(network, chip)
    netlist = emit(network, parts, place(core_traffic(network, parts, None), chip).tiles, chip, {})
    require_legal(netlist, chip)
    return netlist


def typical(events: SpikeArray, count: int) -> IntArray:
    """Indices of the recordings whose input is nearest to the average; activity differs 200-fold between them."""
    density: FloatArray = events.mean(axis=(1, 2))
    nearest: IntArray = np.argsort(np.abs(density - density.mean()), kind="stable")[:count]
    return nearest


def synaptic_operations(chain: Chain, events: SpikeArray, spikes: Sequence[SpikeArray]) -> float:
    """Non-zero synapses that spikes visit, per recording."""
    sources = [events, *spikes[:-1]]
    fan_out = [np.count_nonzero(stage.weight, axis=0) for stage in chain]
    return float(
        sum(s.sum(axis=(0, 1)) @ fan for s, fan in zip(sources, fan_out, strict=True)) / len(events)
    )
