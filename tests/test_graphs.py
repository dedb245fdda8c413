"""Sensors as files name them, and the graphs over their taxels."""

import json
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from oracles import refused

from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.models.graphs import (
    NEUTOUCH,
    build_graph,
    check_coordinates,
    check_edges,
    normalised_adjacency,
)
from spikeloom.models.recordings.csvtable import read_table
from spikeloom.models.sensors import MAX_TAXELS, read_edges, read_layout, read_taxels, sensor_graph

NAMES = ["manual", *(f"knn:{k}" for k in range(1, 9))]
NAMES += [f"mst:{sigma}" for sigma in ("0", "1.5", "2", "2.5", "3", "3.5", "4")]

layouts = st.lists(
    st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=2, max_size=12, unique=True
).map(lambda points: np.array(points) * 0.1)


@pytest.fixture(scope="module")
def released(checkpoints: Path) -> dict:
    return json.loads((checkpoints / "released_graphs.json").read_text())


@pytest.mark.recordings
def test_the_coordinates_are_the_released_ones(released):
    assert NEUTOUCH.tolist() == released["coordinates_mm"]
    assert list(released["edges"]) == NAMES


@pytest.mark.recordings
@pytest.mark.parametrize("name", NAMES)
def test_every_released_edge_list_is_reproduced_in_its_order_and_the_plain_name_collapses_repeats(
    released, name
):
    rows = released["edges"][name]
    assert build_graph(f"released:{name}").edges.tolist() == rows
    assert [tuple(row) for row in build_graph(name).edges.tolist()] == list(dict.fromkeys(map(tuple, rows)))


@pytest.mark.parametrize("name", NAMES)
def test_every_graph_is_symmetric_without_loops(name):
    adjacency = normalised_adjacency(build_graph(name).edges, 39)
    assert np.array_equal(adjacency, adjacency.T)
    assert not adjacency.diagonal().any()


@given(layout=layouts, k=st.integers(1, 8))
def test_neighbours_agree_with_a_plain_search(layout, k):
    n = len(layout)
    k = min(k, n - 1)
    cells = np.rint(layout * 10).astype(int)
    expected = []
    for i in range(n):
        others = [(int(((cells[i] - cells[j]) ** 2).sum()), j) for j in range(n) if j != i]
        expected += [[i, j] for _, j in sorted(others)[:k]]
    assert build_graph(f"released:knn:{k}", layout).edges.tolist() == expected + [
        [j, i] for i, j in expected
    ]


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
    assert_allclose(result, expected, rtol=1e-14, atol=0)
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
        *(
            (name, "unknown; choose manual, knn:K (K 1..8) or mst:SIGMA")
            for name in ("grid", "", "knn", "released:")
        ),
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
    refused(OptionError, f"graph {name!r}|{words}", build_graph, name, np.arange(10.0).reshape(5, 2))


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


RASTER = "x,y\n" + "".join(f"{4 * (i % 5)},{4 * (i // 5)}\n" for i in range(25))


@pytest.mark.parametrize(
    "text",
    [
        "1,2\n3,4\n",
        "a,b\n1,2\n3,4",
        "B, A\n2,1\n4,3\n",
        "\ufeffa,b\r\n1,2\r\n3,4\r\n",
        "# a, b\n1,2\n3,4\n",
        "# made on Monday\n\n  \n1, 2  # first\n \n  # more\n3.0,4e0\n  ",
        "1,2\r3,4\r",
        " 1 ,\t2\n+3,04\n",
    ],
)
def test_tables_with_and_without_names(write, text):
    table = read_table(write("t.csv", text), ("a", "b"), ("c",))
    assert {name: column.tolist() for name, column in table.columns.items()} == {"a": [1, 3], "b": [2, 4]}


@pytest.mark.parametrize(
    ("text", "telling"),
    [
        *(
            (text, "t.csv: no rows, expected are lines of a, b[, c]")
            for text in ("", "\n# nothing\n", "a,b\n")
        ),
        *(
            (f"{names}\n1,2\n", "line 1: columns |expected are a, b[, c]")
            for names in ("a,d", "a,b,b", "a;b")
        ),
        *((text, "in its first row, expected are a, b[, c]") for text in ("1\n2\n", "1,2,3,4\n")),
        ("a,b\n1,2,3\n", "line 2: 3 columns, expected are 2 (a, b)"),
        ("1,2\n\n3\n", "line 3: 1 column, expected are 2 (a, b)"),
        ("1,2\n3,x\n", "line 2: b is 'x', not a number"),
        ("a,b\n1_0,2\n", "line 2: a is '1_0', not a number"),
        ("a,b\n1,\u0661\n", "line 2: b is '\u0661', not a number"),
        ("a,b\n1,\n", "line 2: b is '', not a number"),
        (f"1,{'x' * 99}\n", f"line 1: b is '{'x' * 40}', not a number"),
        ("1,2\0\n", "line 1: b is '2\\x00', not a number"),
    ],
)
def test_tables_name_the_fault(write, text, telling):
    line = refused(DataError, "", read_table, write("t.csv", text), ("a", "b"), ("c",))
    assert all(part in line for part in telling.split("|"))


def test_positions(write):
    assert read_taxels(write("c.csv", "0,0\n1.5,-2\n")).tolist() == [[0, 0], [1.5, -2]]
    assert read_taxels(write("c.csv", "z,y,x\n1,2,3\n")).tolist() == [[3, 2, 1]]


@pytest.mark.parametrize(
    ("text", "telling"),
    [
        ("x,y\n0,0\n1,nan\n", "line 3: y is nan, allowed are -1e+06 to 1e+06"),
        ("0,0,0\n0,0,2e6\n", "line 2: z is 2e+06, allowed"),
        ("x,y\n0,0\n1,1\n0,0\n1,1\n", "line 4: taxels 0 and 2 share one position"),
        ("x\n0\n", "line 1: columns x, expected are x, y[, z]"),
        (
            "".join(f"{i},0\n" for i in range(MAX_TAXELS + 1)),
            f"{MAX_TAXELS + 1} taxels, the limit is {MAX_TAXELS}",
        ),
    ],
)
def test_positions_that_cannot_be(write, text, telling):
    assert telling in refused(DataError, "", read_taxels, write("c.csv", text))


def test_layouts(write):
    n, places = read_layout(write("c.csv", RASTER))
    assert (n, places.shape) == (25, (25, 2))
    assert read_layout("25") == (25, None)
    assert read_layout(str(MAX_TAXELS)) == (MAX_TAXELS, None)


@pytest.mark.parametrize("word", ["0", str(MAX_TAXELS + 1), "9" * 5000])
def test_numbers_of_taxels_that_cannot_be(word):
    assert refused(OptionError, "", read_layout, word) == (
        f"--taxels {word}: allowed are 1..{MAX_TAXELS} taxels; give another number, or a CSV file"
    )


def test_edges_count_in_both_directions(write):
    path = write("e.csv", "source,target\n2,0\n0,1\n1,0\n")
    assert read_edges(path, 3).tolist() == [[0, 1], [0, 2], [1, 0], [2, 0]]
    assert read_edges(path, 3, directed=True).tolist() == [[0, 1], [1, 0], [2, 0]]
    assert read_edges(write("e.csv", "target,source\n1,0\n"), 2, directed=True).tolist() == [[0, 1]]


@pytest.mark.parametrize("directed", [False, True])
def test_repeated_edges_count_once(write, directed):
    edges = read_edges(write("e.csv", "0,1\n1,2\n0,1\n"), 3, directed=directed)
    assert len(edges) == (2 if directed else 4)


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ("0,3", "target 3, taxels are whole numbers 0..2"),
        ("-1,0", "source -1, taxels are whole numbers 0..2"),
        ("0.5,1", "source 0.5, taxels are whole numbers 0..2"),
        ("0,nan", "target nan, taxels are whole numbers 0..2"),
        ("2,2", "joins taxel 2 to itself, allowed are two taxels"),
        ("a,b", "source is 'a', not a number"),
    ],
)
def test_edges_to_nowhere(write, row, found):
    path = write("e.csv", f"source,target\n0,1\n{row}\n")
    assert refused(DataError, "", read_edges, path, 3).startswith(f"e.csv: line 3: {found}")


def test_named_graph_on_another_sensor(write):
    graph, warning = sensor_graph(graph="mst:4.1", taxels=write("c.csv", RASTER))
    assert (graph.name, graph.n_taxels, len(graph.edges)) == ("mst:4.1", 25, 2 * 40)  # the grid has 40 links
    assert warning is None


def test_edges_from_a_file(write):
    edges = write("e.csv", "0,1\n1,2\n")
    graph, warning = sensor_graph(edges=edges)
    assert (graph.name, graph.n_taxels, graph.edges.tolist()) == (
        "edges:e.csv",
        3,
        [[0, 1], [1, 0], [1, 2], [2, 1]],
    )
    assert warning is None
    graph, warning = sensor_graph(edges=edges, taxels="5", directed=True)
    assert (graph.n_taxels, graph.edges.tolist()) == (5, [[0, 1], [1, 2]])
    assert warning == (
        "e.csv: the graph has 3 parts, of 3, 1, 1 taxels (with taxels 0, 3, 4); touch does not spread between them"
    )
    graph, _ = sensor_graph(edges=edges, taxels=write("c.csv", RASTER))
    assert graph.coordinates[6].tolist() == [4, 4]


def test_a_graph_in_parts_is_noticed(write):
    text = "0,1\n1,0\n2,3\n0,1\n" + "".join(f"{i},{i + 1}\n" for i in range(4, 8))
    _, warning = sensor_graph(edges=write("e.csv", text), taxels="30")
    assert warning == (
        "e.csv: the graph has 24 parts, of 5, 2, 2, 1, 1, 1, 1, 1 taxels (with taxels 4, 0, 2, 9, 10, 11, 12, 13 and "
        "16 more); touch does not spread between them"
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "--graph and --edges: neither was given, allowed is one of them; --graph takes manual, knn:K"),
        (
            {"graph": "manual", "edges": "e.csv"},
            "--graph and --edges: both were given, allowed is one of them",
        ),
        ({"graph": "manual", "directed": True}, "--directed: only edges from a file have directions"),
        ({"graph": "knn:2", "taxels": "25"}, "--taxels 25: --graph knn:2 needs positions; give a CSV file"),
        (
            {"graph": "manual", "taxels": "c.csv"},
            "graph 'manual': drawn by hand for the NeuTouch layout, not for",
        ),
    ],
)
def test_options_that_exclude_each_other(write, monkeypatch, options, words):
    monkeypatch.chdir(write("c.csv", RASTER).parent)
    write("e.csv", "0,1\n")
    assert refused(OptionError, "", sensor_graph, **options).startswith(words)
