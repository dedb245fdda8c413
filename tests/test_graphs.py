import json
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import refused

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.models import graphs
from spikeloom.models.graphs import NEUTOUCH, build_graph, check_coordinates, check_edges, normalised_adjacency

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

layouts = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=2, max_size=12, unique=True).map(
    lambda points: np.array(points) * 0.1
)


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


@pytest.mark.parametrize("name", NAMES)
def test_every_graph_is_symmetric_without_loops(name):
    adjacency = normalised_adjacency(build_graph(name).edges, 39)
    assert np.array_equal(adjacency, adjacency.T)
    assert not adjacency.diagonal().any()


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
    pairs = [(i, j, int(((cells[i] - cells[j]) ** 2).sum())) for i in range(n) for j in range(i + 1, n)]
    graph = nx.Graph()
    graph.add_weighted_edges_from(pairs)  # and the sorting by length keeps this order
    tree = set(nx.minimum_spanning_tree(graph, algorithm="kruskal").edges)
    near = [[i, j] for i, j, _ in pairs if np.hypot(*(layout[i] - layout[j])) < sigma - 1e-6]
    edges = build_graph(f"released:mst:{sigma}", layout).edges.tolist()
    assert {tuple(sorted(row)) for row in edges[: 2 * (n - 1)]} == tree
    assert edges[2 * (n - 1) :: 2] == near
    assert edges[1::2] == [row[::-1] for row in edges[::2]]


@given(edges=st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=30), spare=st.integers(0, 3))
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


@pytest.mark.parametrize(
    ("given_name", "canonical"),
    [("mst:2.0", "mst:2"), ("mst:-0", "mst:0"), ("knn:03", "knn:3"), ("released:manual", "released:manual")],
)
def test_names_are_canonical(given_name, canonical):
    assert build_graph(given_name).name == canonical


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *((name, "unknown; choose manual, knn:K (K 1..8) or mst:SIGMA") for name in ("grid", "", "knn", "released:")),
        *((f"knn:{k}", f"K is '{k}', allowed are whole numbers 1..8") for k in ("0", "9", "", "2.5")),
        *(
            (f"mst:{s}", f"SIGMA is '{s}', allowed are millimetres from 0")
            for s in ("-1", "nan", "inf", "", "x", "2mm")
        ),
    ],
)
def test_bad_names(name, words):
    refused(OptionError, f"graph {name!r}: {words}", build_graph, name)


@pytest.mark.parametrize(
    ("name", "words"),
    [("released:manual", "not for this one of 5 taxels"), ("knn:5", "allowed are whole numbers 1..4")],
)
def test_names_that_do_not_suit_the_layout(name, words):
    refused(OptionError, f"graph {name!r}|{words}", build_graph, name, SQUARE)


@pytest.mark.parametrize(
    ("check", "values", "words"),
    [
        (check_edges, [[0, 1], [2, 5]], "edges: row 1 joins 2 and 5, taxels are 0..4; count from 0"),
        (check_edges, [[0, 1, 2]], "edges: shape (1, 3), allowed is (edges, 2)"),
        (check_edges, [[0.0, 1.0]], "edges: dtype float64, allowed are integers"),
        (check_coordinates, np.empty((0, 2)), "coordinates: shape (0, 2), allowed is (taxels, dimensions)"),
        (check_coordinates, [[0, 0], [0, np.nan]], "coordinates: taxel 1 has a position that is not finite"),
    ],
)
def test_bad_arrays(check, values, words):
    refused(ModelError, words, check, values, *[5] * (check is check_edges))
