"""Roots and what follows from them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from random_networks import chain, integer_chain

from spikeloom.runtime.equivalence.explanation.roots import Root, find_roots, sources_of


def array(*rows):
    """Booleans (steps, neurons) from one word a step."""
    return np.array([[letter == "x" for letter in row] for row in rows])


def never(like):
    return [np.zeros_like(a) for a in like]


ALL_TO_ALL = ((), ((0, np.ones((2, 2), bool)),))
"""Two neurons that hear no differences, and two that hear both of them."""


def test_an_entry_with_agreeing_inputs_is_a_root_and_what_hears_it_follows():
    differs = [array("..", "x.", ".."), array("..", ".x", "x.")]
    (root,) = find_roots(differs, never(differs), ALL_TO_ALL)
    assert root == Root(layer=0, neuron=0, step=1, begin=0, dragged=2, alone=2)


def test_a_difference_acts_from_its_own_step_on_and_not_before():
    differs = [array("..", "..", "x."), array("..", "x.", "..")]
    first, second = find_roots(differs, never(differs), ALL_TO_ALL)
    assert (first.layer, first.step, first.dragged) == (1, 1, 0)
    assert (second.layer, second.step, second.dragged) == (0, 2, 0)


def test_an_entry_may_have_several_roots():
    differs = [array("xx", "..", ".."), array("..", "..", "x.")]
    roots = find_roots(differs, never(differs), ALL_TO_ALL)
    assert [(root.layer, root.neuron, root.dragged, root.alone) for root in roots] == [(0, 0, 1, 0), (0, 1, 1, 0)]


def test_the_neurons_own_past_counts():
    differs = [array("x.", "..", "x.")]
    (root,) = find_roots(differs, never(differs), ((),))
    assert (root.step, root.dragged, root.alone) == (0, 1, 1)


def test_a_common_reset_forgets_inputs_and_past():
    differs = [array("x.", "..", "x."), array("x.", "..", "..")]
    resets = [array("..", "x.", ".."), array("..", "..", "..")]
    roots = find_roots(differs, resets, ALL_TO_ALL)
    assert [(r.layer, r.step, r.begin, r.dragged) for r in roots] == [(0, 0, 0, 1), (0, 2, 2, 0)]


def test_who_is_not_connected_does_not_follow():
    only_second = ((), ((0, np.array([[False, True], [False, True]])),))
    differs = [array("x.", ".."), array("x.", ".x")]
    roots = find_roots(differs, never(differs), only_second)
    assert [(r.layer, r.neuron, r.dragged) for r in roots] == [(0, 0, 1), (1, 0, 0)]


def test_roots_that_drag_most_come_first_then_by_place():
    differs = [array("xx", "..", ".x"), array("..", "..", "..")]
    roots = find_roots(differs, never(differs), ALL_TO_ALL)
    assert [(r.neuron, r.step, r.dragged) for r in roots] == [(1, 0, 1), (0, 0, 0)]


def test_no_difference_no_root():
    assert find_roots([array("..")], [array("..")], ((),)) == ()


def test_a_synapse_counts_if_it_is_there_on_either_side():
    network = chain([[1.0, 1.0]], [[0.5]], [[0.0], [0.25]])
    integer = integer_chain([[2, 2]], [[0]], [[2], [0]])
    first, second, third = sources_of(network, integer)
    assert first == ()
    assert [(pre, connected.tolist()) for pre, connected in second] == [(0, [[True]])]
    assert [(pre, connected.tolist()) for pre, connected in third] == [(1, [[True, True]])]


# -- against the definition, one entry at a time -----------------------------------------------------------------------


@st.composite
def difference_graphs(draw):
    sizes = draw(st.lists(st.integers(1, 3), min_size=1, max_size=3))
    steps = draw(st.integers(1, 7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    density = draw(st.sampled_from([0.1, 0.3, 0.6]))
    differs = [rng.random((steps, size)) < density for size in sizes]
    resets = [(rng.random(d.shape) < 0.3) & ~d for d in differs]
    sources = tuple(
        ((post - 1, rng.random((sizes[post - 1], size)) < draw(st.sampled_from([0.5, 1.0]))),) if post else ()
        for post, size in enumerate(sizes)
    )
    return differs, resets, sources


def by_definition(differs, resets, sources):
    """Roots of every entry, found by looking at all that it remembers."""

    def begin(layer, neuron, step):
        return max([t + 1 for t in range(step) if resets[layer][t, neuron]], default=0)

    roots: dict[tuple[int, int, int], set[tuple[int, int, int]]] = {}
    for step in range(len(differs[0])):
        for layer, differing in enumerate(differs):
            for neuron in np.flatnonzero(differing[step]).tolist():
                since = begin(layer, neuron, step)
                parents = [(layer, neuron, t) for t in range(since, step) if differing[t, neuron]]
                for pre, connected in sources[layer]:
                    parents += [
                        (pre, j, t)
                        for j in np.flatnonzero(connected[:, neuron]).tolist()
                        for t in range(since, step + 1)
                        if differs[pre][t, j]
                    ]
                entry = (layer, neuron, step)
                roots[entry] = set().union(*(roots[p] for p in parents)) if parents else {entry}
    return roots


@given(difference_graphs())
def test_one_pass_finds_what_the_definition_says(graph):
    differs, resets, sources = graph
    expected = by_definition(differs, resets, sources)
    found = {(r.layer, r.neuron, r.step): (r.dragged, r.alone) for r in find_roots(differs, resets, sources)}
    assert found == {
        entry: (
            sum(entry in held for held in expected.values()) - 1,
            sum(held == {entry} for held in expected.values()) - 1,
        )
        for entry, held in expected.items()
        if entry in held
    }
