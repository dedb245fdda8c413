"""Networks of crossbar cores drawn by hypothesis, and how traces are compared."""

from dataclasses import fields

import numpy as np
from hypothesis import strategies as st

from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron

WEIGHTS = st.one_of(st.integers(-256, 255), st.integers(-3, 3))
NEURONS = st.builds(
    Neuron,
    weights=st.tuples(WEIGHTS, WEIGHTS, WEIGHTS, WEIGHTS),
    leak=st.one_of(st.integers(-256, 255), st.integers(-3, 3)),
    leak_reversal=st.booleans(),
    threshold=st.one_of(st.integers(0, 8), st.integers(0, 2**18 - 1)),
    mask_bits=st.one_of(st.just(0), st.just(0), st.integers(0, 18)),
    reset_mode=st.integers(0, 2),
    reset=st.one_of(st.just(0), st.integers(-256, 255)),
    negative_threshold=st.one_of(st.integers(0, 8), st.integers(0, 2**18 - 1)),
    negative_saturates=st.booleans(),
    initial=st.one_of(st.just(0), st.integers(-(2**19), 2**19 - 1)),
)


@st.composite
def crossbars(draw, neurons=NEURONS, *, channels=3):
    """A legal network of one to three cores, with wires in loops, shared axons, feeds and clocks."""
    draft = Draft()
    cores = draw(st.integers(1, 3))
    for core in range(cores):
        draft.core(draw(st.integers(0, 4)), core)
        for _ in range(draw(st.integers(1, 4))):
            draft.axon(core, draw(st.integers(0, 3)))
        held = [draft.neuron(core, draw(neurons), layer=f"layer{core}") for _ in range(draw(st.integers(1, 4)))]
        for line, _ in draft.cores[core].axons:
            draft.connect(core, line, draw(st.lists(st.sampled_from(held), unique=True)))

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


def events(draw_seed: int, channels: int, steps: int, *, samples: int | None = None):
    """Recordings of a third of all events."""
    shape = (channels, steps) if samples is None else (samples, channels, steps)
    return (np.random.default_rng(draw_seed).random(shape) < 1 / 3).astype(np.uint8)


def assert_same(one, other) -> None:
    """Every spike, membrane and count of two traces is equal."""
    for field in fields(one.counts):
        np.testing.assert_array_equal(getattr(one.counts, field.name), getattr(other.counts, field.name), field.name)
    np.testing.assert_array_equal(one.membranes, other.membranes, "membranes")
    np.testing.assert_array_equal(one.spikes, other.spikes, "spikes")
