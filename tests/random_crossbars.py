"""Networks for crossbar cores, by hand, random or drawn by hypothesis, and what holds for them in plain loops."""

from dataclasses import fields, replace

import numpy as np
from hypothesis import strategies as st
from made_files import sparse_events
from random_netlists import assert_equal

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.dynamics import clocks_over
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron
from spikeloom.compiler.targets.truenorth.counting import LARGEST
from spikeloom.compiler.targets.truenorth.native import (
    UNIT,
    NativeNetwork,
    Stage,
    highest_level,
    steepest_leak,
)
from spikeloom.runtime.machines.truenorth import engine, spec
from spikeloom.runtime.machines.truenorth.spec import Counts, Trace

CHIP = load_target("truenorth")

WEIGHTS = st.one_of(st.integers(-256, 255), st.integers(-3, 3))
NEURONS = st.builds(
    Neuron,
    weights=st.tuples(WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS),
    leak=st.one_of(st.integers(-256, 255), st.integers(-3, 3)),
    leak_reversal=st.booleans(),
    threshold=st.one_of(st.integers(0, 8), st.integers(0, 2**18 - 1)),
    reset_mode=st.integers(0, 2),
    reset=st.one_of(st.just(0), st.integers(-256, 255)),
    negative_threshold=st.one_of(st.integers(0, 8), st.integers(0, 2**18 - 1)),
    negative_saturates=st.booleans(),
    initial=st.one_of(st.just(0), st.integers(-(2**19), 2**19 - 1)),
)
IN_RANCS_TERMS = st.builds(
    Neuron,
    weights=st.tuples(WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS),
    leak=st.integers(-5, 5),
    threshold=st.integers(0, 20),
    reset_mode=st.integers(0, 2),
    reset=st.integers(-4, 4),
    negative_threshold=st.one_of(st.integers(0, 20), st.just(2**18 - 1)),
    negative_saturates=st.booleans(),
    initial=st.integers(-9, 9),
)
"""Without leak reversal; those that RANC cannot hold above their floor are refused."""


def with_limit(rule: str, value: int):
    """The chip with another limit."""
    return replace(CHIP, limits={**CHIP.limits, rule: replace(CHIP.limits[rule], value=value)})


def relays(*, delay: int = 1, tick: int = 0, first: int = 0) -> Draft:
    """Two cores; an input reaches neuron 0 of core 0, whose spikes reach neuron 0 of core 1, which votes."""
    draft = Draft()
    for x in (0, 1):
        draft.axon(draft.core(x, 0), 0, [draft.neuron(x, Neuron(), layer=f"layer{x}")])
    draft.feed(0, 0, 0, tick=tick)
    draft.wire((0, 0), 1, 0, delay)
    draft.vote((1, 0), 0, first=first)
    return draft


def alone(neuron: Neuron, *, channels: int = 1) -> Draft:
    """One neuron on one axon, which input channels reach."""
    draft = Draft()
    draft.axon(draft.core(), 0, [draft.neuron(0, neuron, layer="layer0")])
    for channel in range(channels):
        draft.feed(channel, 0, 0)
    return draft


@st.composite
def crossbars(draw, neurons=NEURONS, *, channels=3):
    """A legal network of one to three cores, with wires in loops, shared axons, feeds and clocks."""
    draft = Draft()
    cores = draw(st.integers(1, 3))
    for core in range(cores):
        draft.core(draw(st.integers(0, 4)), core)
        held = [
            draft.neuron(core, draw(neurons), layer=f"layer{core}") for _ in range(draw(st.integers(1, 4)))
        ]
        for _ in range(draw(st.integers(1, 4))):
            draft.axon(core, draw(st.integers(0, 3)), draw(st.lists(st.sampled_from(held), unique=True)))

    def axon():
        core = draw(st.integers(0, cores - 1))
        return core, draw(st.sampled_from(draft.cores[core].axons))[0]

    for core in range(cores):
        for number in range(len(draft.cores[core].neurons)):
            end = draw(st.sampled_from(["axon", "vote", "nothing"]))
            if end == "axon":
                draft.wire((core, number), *axon(), draw(st.integers(1, 15)))
            elif end == "vote":
                draft.vote((core, number), draw(st.integers(0, 1)), first=draw(st.integers(0, 5)))
    for channel in range(channels):
        for _ in range(draw(st.integers(0, 2))):
            draft.feed(channel, *axon(), tick=draw(st.integers(0, 4)))
    for _ in range(draw(st.integers(0, 2))):
        draft.clock(*axon(), period=draw(st.integers(1, 5)), phase=draw(st.integers(0, 5)))
    return draft.netlist(taxels=channels, polarities=1, classes=2, bin_ticks=draw(st.integers(1, 3)))


def events(seed: int, channels: int, steps: int, *, samples: int | None = None):
    """Recordings of a third of all events."""
    shape = (channels, steps) if samples is None else (samples, channels, steps)
    return sparse_events(seed, *shape, rate=1 / 3)


def recording_of(batch: Trace, sample: int = 0) -> Trace:
    """One recording of a batch, cut to its own ticks."""
    counts = Counts(**{field.name: getattr(batch.counts, field.name)[sample] for field in fields(Counts)})
    ticks = int(counts.ticks)
    return Trace(
        counts=counts, spikes=batch.spikes[sample, :ticks], membranes=batch.membranes[sample, :ticks]
    )


def both(netlist, recording) -> Trace:
    """What the specification makes of a recording, after the engine made the same of it."""
    expected = spec.simulate(netlist, recording)
    found = engine.simulate(netlist, recording[None], spikes=True, membranes=True)
    assert_equal(expected, recording_of(found))
    return expected


def random_stage(rng, name, inputs, size, depth, *, copies, clocks) -> Stage:
    blocks, width = inputs.shape
    most = highest_level(copies)
    threshold = rng.integers(20, 400, blocks * size)
    reach = steepest_leak(threshold, depth) // 2
    return Stage(
        name=name,
        inputs=inputs,
        level=rng.integers(-most, most + 1, (blocks, width + clocks, size)),
        threshold=threshold,
        floor=threshold * rng.integers(1, 3, blocks * size),
        leak=rng.integers(-reach, reach + 1),
    )


def random_network(
    seed, *, copies=3, blocks=2, taxels=4, features=2, hidden=(6, 4), classes=3, clocks=2, steps=12
) -> NativeNetwork:
    """A first stage, hidden ones in blocks that receive a random half each, and two voters a class."""
    rng, fan_in = np.random.default_rng(seed), taxels * features
    stages = [random_stage(rng, "conv1", np.arange(2 * taxels)[None], fan_in, 0, copies=copies, clocks=0)]
    for depth, size in enumerate((*hidden, 2 * classes), 1):
        inputs = rng.permutation(fan_in).reshape(blocks, -1)
        stages.append(random_stage(rng, f"fc{depth}", inputs, size, depth, copies=copies, clocks=clocks))
        fan_in = blocks * size
    return NativeNetwork(
        taxels=taxels,
        polarities=2,
        classes=classes,
        copies=copies,
        stages=tuple(stages),
        clocks=clocks_over(clocks, steps),
    )


def random_events(seed, network, *, samples=2, steps=12):
    shape = (samples, network.taxels, network.polarities, steps)
    return sparse_events(seed, *shape, rate=0.4)


def defined_spikes(network, events) -> dict[str, np.ndarray]:
    """Spikes (steps, neurons) of each layer for one recording (taxels, polarities, steps), as they are defined."""
    steps, found = events.shape[-1], {}
    before, ticks = events.reshape(-1, steps).T, network.clocks.events(steps).T
    for stage in network.stages:
        spikes = np.zeros((steps, stage.neurons), bool)
        for n in range(stage.neurons):
            block, column = divmod(n, stage.size)
            held = 0
            for t in range(steps):
                active = [*before[t, stage.inputs[block]], *ticks[t, : stage.clocks]]
                levels = zip(stage.level[block, :, column].tolist(), active, strict=True)
                held += UNIT * sum(level * int(x) for level, x in levels) + int(stage.leak[n])
                spikes[t, n] = held >= stage.threshold[n]
                held = 0 if spikes[t, n] else max(held, -int(stage.floor[n]))
        found[stage.name] = before = spikes
    return found


def random_counters(
    seed, *, taxels=3, parts=1, classes=3, thresholds=(1, 3), most=LARGEST, steps=20, ramp=12
):
    """Some counters of a sensor, whose sums of the data never reach the threshold."""
    rng = np.random.default_rng(seed)
    kinds = [
        (channel, part, k) for k in thresholds for part in range(parts) for channel in range(2 * taxels)
    ]
    counter = np.array(kinds)[rng.random(len(kinds)) < 0.8][::-1]
    weight = rng.integers(-most, most + 1, (classes, len(counter))) * (
        rng.random((classes, len(counter))) < 0.7
    )
    slope = int(rng.integers(1, 9))
    highest = int(weight.clip(min=0).sum(axis=1).max())
    sizes = {"taxels": taxels, "polarities": 2, "classes": classes, "bins": 1, "steps": steps}
    threshold = highest + slope * steps + 0.5
    return Counters(
        **sizes,
        parts=parts,
        ramp=ramp,
        counter=counter,
        weight=weight,
        slope=float(slope),
        threshold=threshold,
    )


def without_idle(counters) -> Counters:
    """The same without counters that no weight leads on, as training makes them."""
    kept = counters.weight.any(axis=0)
    return replace(counters, counter=counters.counter[kept], weight=counters.weight[:, kept])


def counter_events(seed, counters, rate=0.3):
    """A recording (taxels, polarities, steps) that is silent in the ramp."""
    shape = counters.taxels, counters.polarities, counters.clocks.length
    events = sparse_events(seed, *shape, rate=rate)
    events[..., counters.steps :] = 0
    return events
