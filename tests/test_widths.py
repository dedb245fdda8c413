"""The search over widths: what it counts is what the compiler builds."""

import numpy as np
import pytest
from random_networks import LOIHI, chain, random_checkpoint, small_target

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.interpret import cut, run_float, run_integer, vote
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.storage.width_search import WidthPoint, search_widths, widths_front

WIDTHS = (2, 4, 8)


def drawn(seed, *, samples=24, steps=16, taxels=5, rate=0.3):
    """A small network, recordings and labels that it gets right half the time."""
    checkpoint = random_checkpoint(seed=seed, taxels=taxels, sizes=(7, 6, 4))
    rng = np.random.default_rng(seed + 100)
    events = (rng.random((samples, taxels, 2, steps)) < rate).astype(np.uint8)
    network = expand(checkpoint, np.full((taxels, taxels), 1 / taxels))
    decided = vote(run_float(network, channels(events)).spikes[-1].sum(axis=1))
    labels = np.where(rng.random(samples) < 0.5, decided, rng.integers(0, 4, samples))
    return checkpoint, network, events, labels


def channels(events):
    samples, taxels, polarities, steps = events.shape
    return events.reshape(samples, taxels * polarities, steps).transpose(0, 2, 1).astype(bool)


def compiled(checkpoint, events, bits, groups=1):
    taxels = events.shape[1]
    packings = [Packing(bits=b, groups=groups) for b in bits]
    return compile_network(
        expand(checkpoint, np.full((taxels, taxels), 1 / taxels)), Options(packings=packings, training_events=events)
    )


def decisions(integer, events, lengths=None):
    return vote(cut(run_integer(integer, events).spikes[-1], lengths).sum(axis=1))


@pytest.mark.parametrize(("seed", "groups"), [(0, 1), (2, 2)])
def test_figures_are_those_of_the_compiler(seed, groups):
    """Every point that is built counts what the compiled netlist does, and no other built point beats it."""
    checkpoint, network, events, labels = drawn(seed)
    samples, flat = 9, channels(events)
    made = search_widths(network, LOIHI, flat, labels, widths=WIDTHS, groups=groups, samples=samples)
    picked = np.linspace(0, len(events) - 1, samples).round().astype(int)
    wanted = vote(run_float(network, flat[picked]).spikes[-1].sum(axis=1))
    assert (made.samples, made.float_right) == (samples, np.count_nonzero(wanted == labels[picked]))
    assert {point.bits for point in made.built} <= {point.bits for point in made.points}
    assert {(8,) * 4, (2,) * 4} <= {point.bits for point in made.points}
    for point in made.built:
        compilation = compiled(checkpoint, events, point.bits, groups)
        decided = decisions(compilation.integer, flat[picked])
        assert point.equal == np.count_nonzero(decided == wanted)
        assert point.right == np.count_nonzero(decided == labels[picked])
        assert point.cores == compilation.netlist.n_cores
        used = sum(use.used for use in measure(compilation.netlist, LOIHI) if use.name == "core.synapse_words")
        assert point.words <= used


@pytest.mark.parametrize("seed", range(2))
def test_the_descent_takes_the_best_neighbour_and_builds_the_best(seed):
    _, network, events, labels = drawn(seed)
    made = search_widths(network, LOIHI, channels(events), labels, widths=WIDTHS)
    best = {point.bits for by in ("equal", "right") for point in widths_front(made.built, by)}
    assert best <= {point.bits for point in made.built} <= {point.bits for point in made.points}
    points = {point.bits: point for point in made.points}
    for figure in ("equal", "right"):
        at = (8, 8, 8, 8)
        while at != (2, 2, 2, 2):
            below = [(*at[:i], WIDTHS[WIDTHS.index(b) - 1], *at[i + 1 :]) for i, b in enumerate(at) if b > 2]
            at = max(below, key=lambda bits: (getattr(points[bits], figure), -points[bits].words))


def test_recordings_count_up_to_their_own_length():
    checkpoint, network, events, labels = drawn(6)
    lengths = np.random.default_rng(0).integers(3, events.shape[3] + 1, len(events))
    for index, length in enumerate(lengths):
        events[index, ..., length:] = 0
    flat = channels(events)
    made = search_widths(network, LOIHI, flat, labels, widths=(2, 8), lengths=lengths)
    wanted = vote(cut(run_float(network, flat).spikes[-1], lengths).sum(axis=1))
    assert made.float_right == np.count_nonzero(wanted == labels)
    for point in made.built:
        decided = decisions(compiled(checkpoint, events, point.bits).integer, flat, lengths)
        assert point.equal == np.count_nonzero(decided == wanted)


def test_memory_is_counted_list_by_list():
    network = chain(np.full((70, 3), 0.3), np.full((2, 70), 0.1))
    events = np.random.default_rng(0).random((8, 20, 3)) < 0.4
    made = search_widths(network, LOIHI, events, np.zeros(8, int), widths=(8,))
    # three lists of 70 in blocks of 64 and 6, seventy of 2, each block with 10 bits more, in whole words
    assert [point.words for point in made.built] == [3 * (9 + 1) + 70]
    assert [point.words for point in made.points] == [-(-8 * (3 * 70 + 70 * 2) // 64)]


def test_what_does_not_fit_the_chip_is_not_built():
    network = chain(np.random.default_rng(0).normal(0, 0.3, (40, 30)))
    events = np.random.default_rng(1).random((8, 20, 30)) < 0.3
    found = search_widths(
        network, small_target(core_synapse_words=60, chip_cores=2), events, np.zeros(8, int), widths=(2, 8)
    )
    assert [point.bits for point in found.points] == [(8,), (2,)]
    assert [point.bits for point in found.built] == [(2,)]


def test_a_front_rises_with_memory():
    figures = [(2, 9, 5), (3, 9, 7), (4, 12, 7), (5, 4, 1), (6, 20, 8), (8, 20, 8)]
    points = [WidthPoint(bits=(b,), words=w, equal=e, right=10 - e) for b, w, e in figures]
    assert [p.bits[0] for p in widths_front(points, "equal")] == [5, 3, 6]
    assert [p.bits[0] for p in widths_front(points, "right")] == [5]
    assert widths_front([], "equal") == ()
