"""The search over widths: what it counts is what the compiler builds, and nothing cheaper was overlooked."""

import itertools

import numpy as np
import pytest
from random_networks import LOIHI, chain, random_checkpoint, small_target

from spikeloom.compiler import Options, Recipe, compile_network
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.interpret import cut, run_float, run_integer, vote
from spikeloom.compiler.passes.calibrate import calibrate, evenly_spaced
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.passes.prune import disconnect, never_fires
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.storage import branches
from spikeloom.compiler.targets.loihi1.storage.quantize import assemble, shortlist
from spikeloom.compiler.targets.loihi1.storage.width_search import Found, Point, check_widths, front, search

WIDTHS = (2, 4, 8)


def drawn(seed, *, samples=40, steps=25, taxels=5, rate=0.3):
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
    recipes = [Recipe(bits=b, groups=groups) for b in bits]
    return compile_network(
        expand(checkpoint, np.full((taxels, taxels), 1 / taxels)), Options(recipes=recipes, training_events=events)
    )


def decisions(integer, events, lengths=None):
    return vote(cut(run_integer(integer, events).spikes[-1], lengths).sum(axis=1))


def usual_forms(network, calibration, groups=1):
    """The scale of each layer and width that moves the class counts least beside other layers at full width."""
    network = disconnect(network, never_fires(network))
    exponents = LOIHI.choices["synapse.exponent"]
    offered = {
        (post, bits): shortlist(network, post, Recipe(bits=bits, groups=groups), exponents, calibration, None)
        for post in range(len(network.populations))
        for bits in WIDTHS
    }
    wanted = calibration.spikes[-1].sum(axis=1)
    found = {}
    for (post, bits), candidates in offered.items():
        distances = []
        for candidate in candidates:
            layers = [offered[other, max(WIDTHS)][0].layer for other in range(len(network.populations))]
            layers[post] = candidate.layer
            spikes = run_integer(assemble(network, layers), calibration.events).spikes[-1]
            distances.append(np.abs(spikes.sum(axis=1) - wanted).sum())
        found[post, bits] = candidates[int(np.argmin(distances))].layer, len(candidates)
    return network, found


@pytest.mark.parametrize(("seed", "groups"), [(0, 1), (1, 1), (2, 2)])
def test_all_combinations_are_those_of_brute_force(seed, groups):
    checkpoint, network, events, labels = drawn(seed)
    samples, flat = 17, channels(events)
    found = search(network, LOIHI, flat, labels, widths=WIDTHS, groups=groups, samples=samples)
    picked = np.linspace(0, len(events) - 1, samples).round().astype(int)
    wanted = vote(run_float(network, flat[picked]).spikes[-1].sum(axis=1))
    assert found.samples == samples
    assert found.float_right == np.count_nonzero(wanted == labels[picked])
    assert [point.bits for point in found.points] == list(itertools.product(WIDTHS, repeat=4))
    pruned, forms = usual_forms(network, calibrate(network, evenly_spaced(flat)), groups)
    by_compiler = 0
    for point in found.points:
        taken = [forms[post, bits] for post, bits in enumerate(point.bits)]
        decided = decisions(assemble(pruned, [layer for layer, _ in taken]), flat[picked])
        assert (point.equal, point.right) == (
            np.count_nonzero(decided == wanted),
            np.count_nonzero(decided == labels[picked]),
        )
        if all(offered == 1 for _, offered in taken) and by_compiler < 3:
            by_compiler += 1  # nothing to settle: the compiler makes this very network
            built = decisions(compiled(checkpoint, events, point.bits, groups).integer, flat[picked])
            assert np.array_equal(built, decided)
    for point in found.built[:: max(1, len(found.built) // 4)]:
        compilation = compiled(checkpoint, events, point.bits, groups)
        decided = decisions(compilation.integer, flat[picked])
        assert point.equal == np.count_nonzero(decided == wanted)
        assert point.right == np.count_nonzero(decided == labels[picked])
        assert point.cores == compilation.netlist.n_cores
        uses = measure(compilation.netlist, LOIHI)
        assert point.words <= sum(use.used for use in uses if use.name == "core.synapse_words")


@pytest.mark.parametrize("seed", [3, 4])
def test_the_front_leaves_nothing_cheaper(seed):
    _, network, events, labels = drawn(seed)
    found = search(network, LOIHI, channels(events), labels, widths=WIDTHS)
    built = {point.bits: point for point in found.built}
    memory = {point.bits: point.words for point in found.points}
    for by in ("equal", "right"):
        current = {point.bits: getattr(built.get(point.bits, point), by) for point in found.points}
        for share in range(found.samples + 1):
            reaching = [bits for bits, count in current.items() if count >= share]
            if reaching:
                cheapest = min(memory[bits] for bits in reaching)
                assert any(memory[bits] == cheapest and getattr(point, by) >= share for bits, point in built.items())


def test_settling_decides_between_scales():
    """Some network on some front takes another scale than its layers do as a rule."""
    moved = 0
    for seed in range(3):
        _, network, events, labels = drawn(seed)
        found = search(network, LOIHI, channels(events), labels, widths=WIDTHS)
        estimated = {point.bits: point for point in found.points}
        moved += sum(
            (point.equal, point.right) != (estimated[point.bits].equal, estimated[point.bits].right)
            for point in found.built
        )
    assert moved > 0


def test_layers_may_run_in_any_stacks(monkeypatch):
    _, network, events, labels = drawn(5)
    together = search(network, LOIHI, channels(events), labels, widths=WIDTHS)
    monkeypatch.setattr(branches, "STACKED", 1)
    assert search(network, LOIHI, channels(events), labels, widths=WIDTHS[::-1]) == together


def test_recordings_count_up_to_their_own_length():
    _, network, events, labels = drawn(6)
    lengths = np.random.default_rng(0).integers(3, events.shape[3] + 1, len(events))
    for index, length in enumerate(lengths):
        events[index, ..., length:] = 0
    flat = channels(events)
    found = search(network, LOIHI, flat, labels, widths=WIDTHS, lengths=lengths)
    pruned, forms = usual_forms(network, calibrate(network, evenly_spaced(flat)))
    integer = assemble(pruned, [forms[post, 4][0] for post in range(4)])
    wanted = vote(cut(run_float(network, flat).spikes[-1], lengths).sum(axis=1))
    decided = decisions(integer, flat, lengths)
    assert next(p for p in found.points if p.bits == (4, 4, 4, 4)).equal == np.count_nonzero(decided == wanted)
    assert found.float_right == np.count_nonzero(wanted == labels)


def test_without_labels_agreement_alone_counts():
    _, network, events, labels = drawn(7)
    labels[3] = -1
    found = search(network, LOIHI, channels(events), labels, widths=WIDTHS)
    assert found.float_right is None
    assert {point.right for point in (*found.points, *found.built)} == {None}
    assert found.built


def test_memory_grows_with_the_widths_and_counts_every_list():
    network = chain(np.full((70, 3), 0.3), np.full((2, 70), 0.1))
    events = np.random.default_rng(0).random((8, 20, 3)) < 0.4
    found = search(network, LOIHI, events, np.zeros(8, int), widths=WIDTHS)
    words = {point.bits: point.words for point in found.points}
    # three lists of 70 in blocks of 64 and 6, seventy of 2, each block with 10 bits more, in whole words
    assert words[8, 8] == 3 * (9 + 1) + 70
    assert words[2, 2] == 3 * (3 + 1) + 70
    assert words[2, 8] == words[2, 2]


def test_a_layer_that_no_core_holds_whole_is_estimated_in_parts():
    network = chain(np.random.default_rng(0).normal(0, 0.3, (40, 30)))
    events = np.random.default_rng(1).random((8, 20, 30)) < 0.3
    whole = search(network, LOIHI, events, np.zeros(8, int), widths=(6,))
    parts = search(network, small_target(core_synapse_words=100), events, np.zeros(8, int), widths=(6,))
    # lists of 40 take 250 bits, four words; lists of 26 and 14 take three and two
    assert (whole.points[0].words, parts.points[0].words) == (30 * 4, 30 * (3 + 2))
    assert parts.points[0].equal == whole.points[0].equal
    assert parts.built[0].cores == 2 > whole.built[0].cores == 1


def test_what_does_not_fit_the_chip_is_not_built():
    network = chain(np.random.default_rng(0).normal(0, 0.3, (40, 30)))
    events = np.random.default_rng(1).random((8, 20, 30)) < 0.3
    found = search(network, small_target(core_synapse_words=60, chip_cores=2), events, np.zeros(8, int), widths=(2, 8))
    assert [point.bits for point in found.points] == [(2,), (8,)]
    assert [point.bits for point in found.built] == [(2,)]


def test_a_width_without_a_scale_is_left_out_for_its_layer(monkeypatch):
    _, network, events, labels = drawn(8)

    def no_two(network, post, recipe, *rest):
        if recipe.bits == 2 or post == unusable:
            raise ModelError(f"layer {post}: no scale at {recipe.bits} bits")
        return shortlist(network, post, recipe, *rest)

    unusable = None
    monkeypatch.setattr(branches, "shortlist", no_two)
    found = search(network, LOIHI, channels(events), labels, widths=(2, 8))
    assert [point.bits for point in found.points] == [(8, 8, 8, 8)]
    unusable = 1
    with pytest.raises(ModelError, match=r"^layer 1: no scale at 8 bits$"):
        search(network, LOIHI, channels(events), labels, widths=(2, 8))


def test_a_front_rises_with_memory():
    figures = [(2, 9, 5), (3, 9, 7), (4, 12, 7), (5, 4, 1), (6, 20, 8), (8, 20, 8)]
    points = [Point(bits=(b,), words=w, equal=e, right=10 - e) for b, w, e in figures]
    assert [p.bits[0] for p in front(points, "equal")] == [5, 3, 6]
    assert [p.bits[0] for p in front(points, "right")] == [5]
    assert front([], "equal") == ()
    assert Found(samples=1, float_right=None, points=(), built=()).built == ()


@pytest.mark.parametrize(
    ("widths", "groups", "layers", "message"),
    [
        ([7], 1, 4, "--widths 7: Intel Loihi 1 does not store 7 bits; allowed: 2, 3, 4, 5, 6, 8"),
        (
            [2, 3, 4, 5, 6, 8],
            1,
            5,
            "--widths 2,3,4,5,6,8: 6 widths in 5 layers are 7,776 combinations, the search tries them all up to 4,096; "
            "give 5 at most",
        ),
        (
            [2, 8],
            1,
            13,
            "--widths 2,8: 2 widths in 13 layers are 8,192 combinations, the search tries them all up to 4,096; "
            "give 1 at most",
        ),
        (
            [4],
            9,
            4,
            "--scale-groups 9: a core of Intel Loihi 1 holds 8 thresholds; give a number from 1 to 8",
        ),
    ],
)
def test_widths_that_cannot_be_searched(widths, groups, layers, message):
    with pytest.raises(OptionError) as caught:
        check_widths(widths, groups, layers, LOIHI)
    assert str(caught.value) == message


def test_widths_are_searched_once_each():
    assert check_widths([8, 2, 8], 1, 4, LOIHI) == (2, 8)
    assert check_widths([2, 3, 4, 5, 6, 8], 1, 4, LOIHI) == (2, 3, 4, 5, 6, 8)
