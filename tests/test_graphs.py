import json
import subprocess
import sys
from pathlib import Path

import networkx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.models import graphs
from spikeloom.models.graphs import (
    NEUTOUCH,
    Graph,
    build_graph,
    check_coordinates,
    check_edges,
    normalised_adjacency,
)

NAMES = [
    "manual",
    *(f"knn:{k}" for k in range(1, 9)),
    "mst:0",
    "mst:1.5",
    "mst:2",
    "mst:2.5",
    "mst:3",
    "mst:3.5",
    "mst:4",
]
# A square and its centre: every kind of tie in five taxels.
SQUARE = np.array([[0, 0], [2, 0], [0, 2], [2, 2], [1, 1]], dtype=float)
# Decimals whose distances, 0.3 both, differ in the last bit.
DECIMALS = np.array([[0.4], [0.1], [0.7]])

layouts = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=2, max_size=12, unique=True).map(
    lambda points: np.array(points) * 0.1
)


def pairs_within(name: str, hops: int) -> int:
    graph = build_graph(name)
    step = (normalised_adjacency(graph.edges, graph.n_taxels) > 0).astype(int) + np.eye(graph.n_taxels, dtype=int)
    return int((np.linalg.matrix_power(step, hops) > 0).sum())


@pytest.fixture(scope="module")
def released(shared_dir: Path) -> dict:
    return json.loads((shared_dir / "checkpoints/released_graphs.json").read_text())


@pytest.mark.recordings
def test_the_coordinates_are_the_released_ones(released):
    assert NEUTOUCH.tolist() == released["coordinates_mm"]
    assert list(released["edges"]) == NAMES


@pytest.mark.recordings
@pytest.mark.parametrize("name", NAMES)
def test_every_released_edge_list_is_reproduced_in_its_order_and_the_plain_name_collapses_repeats(released, name):
    rows = released["edges"][name]
    assert build_graph(f"released:{name}").edges.tolist() == rows
    assert [tuple(row) for row in build_graph(name).edges.tolist()] == list(dict.fromkeys(map(tuple, rows)))


@pytest.mark.parametrize(
    ("name", "edges", "collapsed"),
    [
        ("manual", 146, 146),
        ("knn:1", 78, 66),
        ("knn:3", 234, 156),
        ("knn:8", 624, 382),
        ("mst:0", 76, 76),
        ("mst:1.5", 84, 76),
        ("mst:2", 132, 96),
        ("mst:3.5", 330, 254),
        ("mst:4", 406, 330),
    ],
)
def test_numbers_of_edges(name, edges, collapsed):
    assert len(build_graph(f"released:{name}").edges) == edges
    assert len(build_graph(name).edges) == collapsed


def test_mean_degrees_of_the_paper():
    """The paper gives 1.9 to 10.4 for its trees with sigma; it counts repeated edges."""
    sigmas = ["0", "1.5", "2", "2.5", "3", "3.5", "4"]
    degrees = [len(build_graph(f"released:mst:{sigma}").edges) / 39 for sigma in sigmas]
    assert [round(degree, 2) for degree in degrees] == [1.95, 2.15, 3.38, 4.15, 5.13, 8.46, 10.41]


@pytest.mark.parametrize(
    ("name", "pairs"),
    [("manual", 765), ("mst:0", 355), ("knn:1", 217), ("knn:3", 817), ("knn:4", 921), ("mst:4", 1261)],
)
def test_pairs_within_three_hops(name, pairs):
    """128 synapses each: 97,920 on the manual graph, 45,440 on the tree."""
    assert pairs_within(name, 3) == pairs
    assert pairs_within(f"released:{name}", 3) == pairs


@pytest.mark.parametrize("name", NAMES)
def test_every_graph_is_symmetric_without_loops(name):
    adjacency = normalised_adjacency(build_graph(name).edges, 39)
    assert np.array_equal(adjacency, adjacency.T)
    assert not adjacency.diagonal().any()


def test_trees_span():
    assert networkx.is_tree(networkx.Graph(build_graph("mst:0").edges.tolist()))
    assert networkx.is_connected(networkx.Graph(build_graph("manual").edges.tolist()))


def test_stored_choices_are_between_equal_distances():
    """The data may only say how ties are broken: on any order of preference, lengths are the same."""
    distance = graphs._distances(NEUTOUCH)
    away = distance + np.diag(np.full(39, np.inf))
    for k in range(1, 9):
        neighbours = build_graph(f"released:knn:{k}").edges[: 39 * k, 1].reshape(39, k)
        assert np.array_equal(np.take_along_axis(away, neighbours, axis=1), np.sort(away, axis=1)[:, :k])
    chosen = build_graph("mst:0").edges[::2]
    by_rule = graphs._tree(distance, 20, [])
    lengths = [np.sort(distance[pairs[:, 0], pairs[:, 1]]) for pairs in (chosen, by_rule)]
    assert np.array_equal(*lengths)
    assert {frozenset(pair) for pair in chosen.tolist()} != {frozenset(pair) for pair in by_rule.tolist()}


@pytest.mark.parametrize(
    ("name", "edges"),
    [
        ("knn:1", [[0, 4], [1, 4], [2, 4], [3, 4], [4, 0], [4, 1], [4, 2], [4, 3]]),
        (
            "released:knn:1",
            [[0, 4], [1, 4], [2, 4], [3, 4], [4, 0], [4, 0], [4, 1], [4, 2], [4, 3], [0, 4]],
        ),
        ("mst:0", [[0, 4], [4, 0], [4, 1], [1, 4], [4, 2], [2, 4], [4, 3], [3, 4]]),
        ("mst:1.42", [[0, 4], [4, 0], [4, 1], [1, 4], [4, 2], [2, 4], [4, 3], [3, 4]]),
    ],
)
def test_ties_go_to_the_lower_index_on_other_layouts(name, edges):
    assert build_graph(name, SQUARE).edges.tolist() == edges


def test_ties_in_decimals_are_ties():
    assert abs(0.4 - 0.1) != abs(0.4 - 0.7)
    assert build_graph("released:knn:1", DECIMALS).edges.tolist() == [[0, 1], [1, 0], [2, 0], [1, 0], [0, 1], [0, 2]]


def test_sigma_is_exclusive():
    assert len(build_graph("mst:2", SQUARE).edges) == 8
    assert len(build_graph("mst:2.01", SQUARE).edges) == 16
    assert len(build_graph("released:mst:2.01", SQUARE).edges) == 24


@given(layout=layouts, k=st.integers(1, 8))
def test_neighbours_agree_with_a_plain_search(layout, k):
    n = len(layout)
    k = min(k, n - 1)
    cells = np.rint(layout * 10).astype(int)
    expected = []
    for i in range(n):
        others = [(int(((cells[i] - cells[j]) ** 2).sum()), j) for j in range(n) if j != i]
        expected += [[i, j] for _, j in sorted(others)[:k]]
    assert build_graph(f"released:knn:{k}", layout).edges.tolist() == expected + [[j, i] for i, j in expected]


@given(layout=layouts, sigma=st.sampled_from([0.0, 0.1, 0.15, 0.25, 1.0]))
def test_trees_agree_with_kruskal(layout, sigma):
    """Lower index pairs first: Kruskal over (length, low, high) has one answer."""
    n = len(layout)
    cells = np.rint(layout * 10).astype(int)
    ranked = sorted((int(((cells[i] - cells[j]) ** 2).sum()), i, j) for i in range(n) for j in range(i + 1, n))
    parts = list(range(n))
    tree = set()
    for _, i, j in ranked:
        if parts[i] != parts[j]:
            tree.add((i, j))
            parts = [parts[i] if part == parts[j] else part for part in parts]
    near = [
        (i, j)
        for _, i, j in sorted(ranked, key=lambda row: row[1:])
        if np.hypot(*(layout[i] - layout[j])) < sigma - 1e-6
    ]
    edges = build_graph(f"released:mst:{sigma}", layout).edges.tolist()
    assert {tuple(sorted(row)) for row in edges[: 2 * (n - 1)]} == tree
    assert edges[2 * (n - 1) :: 2] == [list(pair) for pair in near]
    assert edges[1::2] == [row[::-1] for row in edges[::2]]


@given(
    edges=st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=30),
    spare=st.integers(0, 3),
)
def test_normalisation_agrees_with_its_formula(edges, spare):
    n = 7 + spare
    rows = np.array(edges, dtype=np.int64).reshape(-1, 2)
    result = normalised_adjacency(rows, n)
    into = [sum(target == i for _, target in edges) for i in range(n)]
    expected = np.zeros((n, n))
    for source, target in edges:
        if into[source]:
            expected[target, source] += 1 / np.sqrt(into[source] * into[target])
    np.testing.assert_allclose(result, expected, rtol=1e-14, atol=0)
    assert result.dtype == np.float64


def test_normalisation_by_hand():
    """A path 0 - 1 - 2, the pair 0 - 1 listed twice; taxel 3 alone; no loops added."""
    edges = [[0, 1], [1, 0], [0, 1], [1, 0], [1, 2], [2, 1]]
    a, b = 2 / np.sqrt(6), 1 / np.sqrt(3)
    expected = [[0, a, 0, 0], [a, 0, b, 0], [0, b, 0, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(normalised_adjacency(edges, 4), expected, rtol=1e-15, atol=0)


def test_direction_is_target_by_source():
    result = normalised_adjacency([[0, 1], [1, 0], [0, 2]], 3)
    assert (result[2, 0], result[0, 2]) == (1, 0)
    assert not normalised_adjacency(np.empty((0, 2), dtype=int), 3).any()


def test_repeats_change_the_weights():
    plain, repeated = (normalised_adjacency(build_graph(name).edges, 39) for name in ("knn:3", "released:knn:3"))
    assert ((plain > 0) == (repeated > 0)).all()
    assert not np.allclose(plain, repeated)


@pytest.mark.parametrize(
    ("given_name", "canonical"),
    [
        ("mst:2.0", "mst:2"),
        ("released:mst:1.50", "released:mst:1.5"),
        ("mst:-0", "mst:0"),
        ("knn:03", "knn:3"),
        ("released:manual", "released:manual"),
    ],
)
def test_names_are_canonical(given_name, canonical):
    assert build_graph(given_name).name == canonical


def test_graphs_are_read_only_copies():
    mine = SQUARE.copy()
    graph = build_graph("knn:1", mine)
    mine[0, 0] = 9
    assert graph.coordinates[0, 0] == 0
    assert graph.n_taxels == 5
    for array in (graph.coordinates, graph.edges, NEUTOUCH):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *((name, "unknown; choose manual, knn:K (K 1..8) or mst:SIGMA") for name in ("grid", "", "knn", "released:")),
        ("released:released:manual", "unknown; "),
        ("manual:3", "unknown; "),
        *((f"knn:{k}", f"K is '{k}', allowed are whole numbers 1..8") for k in ("0", "9", "", "2.5")),
        ("released:knn:x", "K is 'x', allowed are whole numbers 1..8"),
        *(
            (f"mst:{s}", f"SIGMA is '{s}', allowed are millimetres from 0")
            for s in ("-1", "nan", "inf", "", "x", "2mm")
        ),
    ],
)
def test_bad_names(name, words):
    with pytest.raises(OptionError) as caught:
        build_graph(name)
    assert str(caught.value).startswith(f"graph {name!r}: {words}")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("released:manual", "drawn by hand for the NeuTouch layout, not for this one of 5 taxels"),
        ("knn:5", "K is '5', allowed are whole numbers 1..4 (the layout has 5 taxels)"),
    ],
)
def test_names_that_do_not_suit_the_layout(name, words):
    with pytest.raises(OptionError) as caught:
        build_graph(name, SQUARE)
    assert str(caught.value).startswith(f"graph {name!r}: {words}")


@pytest.mark.parametrize(
    ("check", "values", "words"),
    [
        (check_edges, [[0, 1], [2, 5]], "edges: row 1 joins 2 and 5, taxels are 0..4; count from 0"),
        (check_edges, [[-1, 1]], "edges: row 0 joins -1 and 1, taxels are 0..4"),
        (check_edges, [0, 1], "edges: shape (2,), allowed is (edges, 2)"),
        (check_edges, [[0, 1, 2]], "edges: shape (1, 3), allowed is (edges, 2)"),
        (check_edges, [[0.0, 1.0]], "edges: dtype float64, allowed are integers"),
        (check_coordinates, [1.0, 2.0], "coordinates: shape (2,), allowed is (taxels, dimensions)"),
        (check_coordinates, np.empty((0, 2)), "coordinates: shape (0, 2), allowed is (taxels, dimensions)"),
        (check_coordinates, [[0, 0], [0, np.nan]], "coordinates: taxel 1 has a position that is not finite"),
    ],
)
def test_bad_arrays(check, values, words):
    with pytest.raises(ModelError) as caught:
        check(values, 5) if check is check_edges else check(values)
    assert str(caught.value).startswith(words)


def test_a_graph_checks_its_own_parts():
    with pytest.raises(ModelError, match=r"^edges: row 0 joins 0 and 7, taxels are 0\.\.4; "):
        Graph(name="mine", coordinates=SQUARE, edges=np.array([[0, 7]]))


def test_graphs_load_no_torch():
    code = "import sys, spikeloom.models.graphs; print(sorted({'torch', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
