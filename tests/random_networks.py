"""Networks built by hand or drawn by hypothesis, float and integer, for the tests of the compiler."""

import dataclasses
import itertools
import math

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from scipy import sparse

from spikeloom.compiler.checkpoint import Checkpoint, Dense
from spikeloom.compiler.dynamics import PLAIN
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.ir import INPUT, Input, Network, Population, Projection, Readout
from spikeloom.compiler.targets.base import Quantity, Target, load_target
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.integers import (
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    run_integer,
)
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.registers import weight_step
from spikeloom.models.graphs import normalised_adjacency

LOIHI = load_target("loihi1")
"""The chip that most tests compile for."""

BITS = (2, 3, 4, 5, 6, 8)
"""Storage widths of a mixed-sign weight."""


def small_target(**limits: int) -> Target:
    """Loihi 1 with other limits; ``core_axons_in=3`` sets ``core.axons_in``."""
    changed = {name.replace("_", ".", 1): value for name, value in limits.items()}
    assert set(changed) <= set(LOIHI.limits)
    return dataclasses.replace(
        LOIHI,
        limits={
            rule: Quantity(value=changed.get(rule, old.value), unit=old.unit, source=old.source)
            for rule, old in LOIHI.limits.items()
        },
    )


def stored(dense, structure=None):
    """csr_array of `dense` that stores every entry, zeros too, or those where `structure` holds."""
    dense = np.asarray(dense)
    row, column = np.nonzero(np.ones(dense.shape) if structure is None else structure)
    matrix = sparse.csr_array((dense[row, column], (row, column)), shape=dense.shape)
    matrix.sort_indices()
    return matrix


def chain(*weights, beta=0.2, theta=0.5, biases=None, polarities=1) -> Network:
    """Float network of dense layers, one after the other; ``weights[k]`` is (outputs, inputs)."""
    weights = [np.asarray(weight, float) for weight in weights]
    biases = biases or [np.zeros(len(weight)) for weight in weights]
    return Network(
        input=Input(taxels=weights[0].shape[1] // polarities, polarities=polarities),
        populations=tuple(
            Population(name=f"fc{i + 1}", beta=beta, theta=theta, bias=np.asarray(bias, float))
            for i, bias in enumerate(biases)
        ),
        projections=tuple(
            Projection(pre=i - 1 if i else INPUT, post=i, weight=stored(weight))
            for i, weight in enumerate(weights)
        ),
        readout=Readout(population=len(weights) - 1, label=np.arange(len(weights[-1]))),
        classes=len(weights[-1]),
    )


def integer_population(name, size, *, threshold=100, decay_u=4095, decay_v=3277, bias=0, exponent=0):
    """Integer population with equal neurons, or with one threshold or bias mantissa each."""
    return IntegerPopulation(
        name=name,
        beta=0.2,
        theta=0.5,
        scale=np.full(size, 2.0 * float(np.max(threshold, initial=1))),
        decay_u=decay_u,
        decay_v=decay_v,
        threshold=np.broadcast_to(np.asarray(threshold, np.int64), (size,)).copy(),
        bias_mantissa=np.broadcast_to(np.asarray(bias, np.int64), (size,)).copy(),
        bias_exponent=np.broadcast_to(np.asarray(exponent, np.int64), (size,)).copy(),
    )


def integer_chain(*weights, bits=8, exponent=0, thresholds=None, polarities=1) -> IntegerNetwork:
    """Integer network of layers, one after the other; zero weights are not stored."""
    weights = [np.asarray(weight, np.int64) for weight in weights]
    thresholds = thresholds or [100] * len(weights)
    return IntegerNetwork(
        input=Input(taxels=weights[0].shape[1] // polarities, polarities=polarities),
        populations=tuple(
            integer_population(f"fc{i + 1}", len(weight), threshold=threshold)
            for i, (weight, threshold) in enumerate(zip(weights, thresholds, strict=True))
        ),
        projections=tuple(
            IntegerProjection(
                pre=i - 1 if i else INPUT,
                post=i,
                weight=stored(weight, weight != 0),
                exponent=exponent,
                bits=bits,
            )
            for i, weight in enumerate(weights)
        ),
        readout=Readout(population=len(weights) - 1, label=np.arange(len(weights[-1]))),
        classes=len(weights[-1]),
    )


def varied(*shape):
    """Weights of which no two lists are alike."""
    return 2 * np.random.default_rng(0).integers(1, 120, shape)


def with_population(network, index, **changes):
    """The network with another population there."""
    populations = list(network.populations)
    populations[index] = dataclasses.replace(populations[index], **changes)
    return dataclasses.replace(network, populations=tuple(populations))


def ring(taxels):
    """Normalised adjacency of taxels in a circle."""
    source = np.arange(taxels)
    edges = np.stack([source, (source + 1) % taxels], axis=1)
    return normalised_adjacency(np.concatenate([edges, edges[:, ::-1]]), taxels)


def random_checkpoint(
    *, taxels=5, features=3, hops=4, sizes=(6, 5, 4), seed=0, beta=0.2, theta=0.5
) -> Checkpoint:
    """A small TactileSGNet with random float32 weights."""
    rng = np.random.default_rng(seed)

    def draw(*shape, spread=1.0):
        return rng.normal(0, spread, shape).astype(np.float32)

    widths = [taxels * features, *sizes]
    known = {
        "hops": draw(hops, features, 2),
        "conv_bias": draw(features, spread=0.1),
        "dense": tuple(
            Dense(name=f"fc{i}", weight=draw(size, before, spread=before**-0.5), bias=draw(size, spread=0.1))
            for i, (before, size) in enumerate(zip(widths, sizes, strict=False), 1)
        ),
        "beta": beta,
        "theta": theta,
        "system": "tactilesgnet",
        "dynamics": PLAIN,
        "towers": 1,
        "bins": 1,
    }
    # where the weights come from is nothing to the passes
    return Checkpoint(**{field.name: None for field in dataclasses.fields(Checkpoint)} | known)


def _wiring(draw):
    """A sensor, population sizes by depth, projections (pre, post, shape) to the next depth and to itself, votes."""
    by_depth = draw(st.lists(st.lists(st.integers(1, 7), min_size=1, max_size=2), min_size=1, max_size=3))
    ids, sizes = [], []
    for layer in by_depth:
        ids.append(list(range(len(sizes), len(sizes) + len(layer))))
        sizes += layer
    pairs = [(INPUT, post) for post in ids[0]]
    for before, after in itertools.pairwise(ids):
        for post in after:
            pairs += [
                (pre, post) for pre in draw(st.lists(st.sampled_from(before), min_size=1, unique=True))
            ]
    pairs += [(post, post) for post in draw(st.lists(st.integers(0, len(sizes) - 1), unique=True))]
    sensor = Input(taxels=draw(st.integers(1, 5)), polarities=draw(st.sampled_from([1, 2])))
    every = {INPUT: sensor.size} | dict(enumerate(sizes))
    classes = draw(st.integers(1, 4))
    label = draw(st.lists(st.integers(0, classes - 1), min_size=sizes[-1], max_size=sizes[-1]))
    votes = {"readout": Readout(population=len(sizes) - 1, label=np.array(label)), "classes": classes}
    return sensor, sizes, [(pre, post, (every[post], every[pre])) for pre, post in pairs], votes


@st.composite
def float_networks(draw, *, betas=(0.0, 0.2, 0.5, 0.9)) -> Network:
    """Float networks whose weights and biases are multiples of 1/64, so that sums are exact in any order."""
    sensor, sizes, pairs, votes = _wiring(draw)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spread, density = draw(st.sampled_from([1, 8, 64, 300])), draw(st.sampled_from([0.3, 0.8, 1.0]))
    return Network(
        input=sensor,
        populations=tuple(
            Population(
                name=f"layer{i}",
                beta=draw(st.sampled_from(betas)),
                theta=draw(st.sampled_from([0.25, 0.5, 1.0, 3.0])),
                bias=rng.integers(-40, 40, size) / 64 * draw(st.sampled_from([0, 1])),
            )
            for i, size in enumerate(sizes)
        ),
        projections=tuple(
            Projection(
                pre=pre,
                post=post,
                weight=stored(rng.integers(-spread, spread + 1, shape) / 64, rng.random(shape) < density),
            )
            for pre, post, shape in pairs
        ),
        **votes,
    )


@st.composite
def integer_networks(draw, *, exponents=(-1, 0, 1, 3), bits=BITS) -> IntegerNetwork:
    """Integer networks with registers at their extremes, several thresholds, and stored zeros."""
    sensor, sizes, pairs, votes = _wiring(draw)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    density = draw(st.sampled_from([0.0, 0.3, 0.8, 1.0]))

    def projection(pre, post, shape):
        width = draw(st.sampled_from(bits))
        step = weight_step(width)
        structure = rng.random(shape) < density
        mantissa = rng.integers(-256 // step, (256 - step) // step, shape, endpoint=True) * step
        return IntegerProjection(
            pre=pre,
            post=post,
            weight=stored(mantissa, structure),
            exponent=draw(st.sampled_from(exponents)),
            bits=width,
        )

    return IntegerNetwork(
        input=sensor,
        populations=tuple(
            integer_population(
                f"layer{i}",
                size,
                threshold=rng.choice([0, 1, 127, 500, 2**17 - 1], size) if draw(st.booleans()) else 64,
                decay_u=draw(st.sampled_from([0, 2048, 4095, 4095])),
                decay_v=draw(st.sampled_from([0, 1, 3277, 4095])),
                bias=rng.integers(-4095, 4096, size) if draw(st.booleans()) else 0,
                exponent=rng.integers(0, 8, size),
            )
            for i, size in enumerate(sizes)
        ),
        projections=tuple(projection(*pair) for pair in pairs),
        **votes,
    )


@st.composite
def recordings_for(draw, channels, *, samples=3, most=9) -> np.ndarray:
    """Events (samples, steps, channels) bool."""
    shape = (draw(st.integers(1, samples)), draw(st.integers(1, most)), channels)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return rng.random(shape) < draw(st.sampled_from([0.1, 0.5, 1.0]))


def dense_weights(network: IntegerNetwork, post: int) -> dict[int, np.ndarray]:
    """Effective weights into a population by source, (neurons of post, neurons of pre), in plain integers."""
    found = {}
    for p in network.projections:
        if p.post == post:
            effective = p.weight.toarray().astype(np.int64) * 2 ** (p.exponent + 1)
            assert not np.any(effective % 2)
            found[p.pre] = found.get(p.pre, 0) + effective // 2
    return found


def compiled(network, target=LOIHI, provenance=None):
    """Netlist with core k on tile k."""
    return seated(network, partition(network, target), target, provenance)


def seated(network, parts, target=LOIHI, provenance=None):
    """Netlist of a partition, with core k on tile k."""
    return emit(network, parts, tuple(range(len(parts))), target, provenance or {})


def words_of_list(entries, weight_bits, index):
    """Blocks of up to 64 entries, ten header bits each, in whole words of 64 bits."""
    total = 0
    while entries > 0:
        block = min(entries, 64)
        total += math.ceil((block * (weight_bits + index) + 10) / 64)
        entries -= block
    return total


def counted(netlist, target=LOIHI, chunks=None):
    """Use of each limit by each core, counted one compartment and one axon at a time.

    Lists that are alike but for a base of up to 256 are one; given the `chunks` of each core, only from a
    layer into a chunk.
    """
    reach = target.limit("core.dense_base") + 1
    cores = []
    for core in range(netlist.n_cores):
        compartments = range(*netlist.core_compartments[core : core + 2])
        axons = range(*netlist.core_axons[core : core + 2])
        memory, formats, base = {}, set(), 0
        starts = np.cumsum([chunk.size for chunk in chunks[core]]) if chunks else []
        for axon in axons:
            first, last = (int(bound) for bound in netlist.axon_synapses[axon : axon + 2])
            form = int(netlist.axon_format[axon])
            index = int(netlist.format_index_bits[form])
            places, weights = (
                netlist.synapse_target[first:last].tolist(),
                netlist.synapse_weight[first:last].tolist(),
            )
            low, source = min(places, default=0), int(netlist.axon_source[axon]) - netlist.n_inputs
            layer = int(netlist.layer[source]) if source >= 0 else -1
            where = (layer, sum(low >= start for start in starts)) if chunks else ()
            content = (
                form,
                low // reach,
                *((place - low, weight) for place, weight in zip(places, weights, strict=True)),
            )
            memory[where, content] = words_of_list(
                last - first, int(netlist.format_weight_bits[form]), index
            )
            formats.add(form)
            if index == 0:
                base = max(base, int(netlist.synapse_target[first]))
        cores.append(
            {
                "core.compartments": len(compartments),
                "core.axons_in": len(axons),
                "core.axons_out": sum(
                    int(s) - netlist.n_inputs in compartments for s in netlist.axon_source
                ),
                "core.synapse_words": sum(memory.values()),
                "core.threshold_slots": len({int(netlist.threshold[c]) for c in compartments}),
                "core.synapse_formats": len(formats),
                "core.compartment_configs": len(
                    {(int(netlist.decay_u[c]), int(netlist.decay_v[c])) for c in compartments}
                ),
                "core.dense_base": base,
            }
        )
    return cores


@st.composite
def tight_targets(draw):
    """Chips so small that ten neurons need several cores."""
    return small_target(
        core_compartments=draw(st.integers(1, 8)),
        core_axons_in=draw(st.integers(4, 30)),
        core_axons_out=draw(st.integers(2, 30)),
        core_synapse_words=draw(st.integers(6, 40)),
        core_threshold_slots=draw(st.integers(1, 4)),
        core_synapse_formats=draw(st.integers(2, 5)),
        core_compartment_configs=draw(st.integers(1, 3)),
        core_dense_base=draw(st.sampled_from([0, 3, 256])),
    )


@st.composite
def roomy_targets(draw):
    """Chips on which a core holds several small layers, whatever their order: dense lists may start anywhere."""
    return small_target(
        core_compartments=draw(st.integers(4, 10)),
        core_axons_in=draw(st.integers(10, 40)),
        core_axons_out=draw(st.integers(6, 40)),
        core_synapse_words=draw(st.integers(10, 50)),
        core_threshold_slots=draw(st.integers(4, 8)),
        core_compartment_configs=draw(st.integers(1, 3)),
    )


def legal_partition(network, target):
    """Partition of a network; gives up the example where it does not fit."""
    try:
        return partition(network, target)
    except CapacityError:
        assume(False)


def moved(integer, calibration):
    """Spikes of the calibration recordings that differ from float64."""
    found = run_integer(integer, calibration.events).spikes
    return sum(int(np.count_nonzero(a != b[:])) for a, b in zip(found, calibration.spikes, strict=True))


def assert_same_layers(*runs):
    """Spikes, layer by layer, are the same in every run."""
    for layers in zip(*runs, strict=True):
        for other in layers[1:]:
            assert_array_equal(other, layers[0])
