from pathlib import Path

import networkx
import numpy as np
import pytest

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings.csvtable import read_table
from spikeloom.models.sensors import MAX_TAXELS, _parts, read_edges, read_layout, read_taxels, sensor_graph

SQUARE = "x,y\n" + "".join(f"{4 * (i % 5)},{4 * (i // 5)}\n" for i in range(25))


@pytest.fixture
def write(tmp_path):
    def write(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text, newline="")
        return path

    return write


def message(function, *arguments, error=DataError, **options) -> str:
    with pytest.raises(error) as caught:
        function(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# Tables


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
        *((text, "t.csv: no rows, expected are lines of a, b[, c]") for text in ("", "\n# nothing\n", "a,b\n")),
        *((f"{names}\n1,2\n", "line 1: columns |expected are a, b[, c]") for names in ("a,d", "a,b,b", "a;b")),
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
    line = message(read_table, write("t.csv", text), ("a", "b"), ("c",))
    assert all(part in line for part in telling.split("|"))


# Taxels


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
        ("".join(f"{i},0\n" for i in range(MAX_TAXELS + 1)), f"{MAX_TAXELS + 1} taxels, the limit is {MAX_TAXELS}"),
    ],
)
def test_positions_that_cannot_be(write, text, telling):
    assert telling in message(read_taxels, write("c.csv", text))


def test_layouts(write):
    n, places = read_layout(write("c.csv", SQUARE))
    assert (n, places.shape) == (25, (25, 2))
    assert read_layout("25") == (25, None)
    assert read_layout(str(MAX_TAXELS)) == (MAX_TAXELS, None)


@pytest.mark.parametrize("word", ["0", str(MAX_TAXELS + 1), "9" * 5000])
def test_numbers_of_taxels_that_cannot_be(word):
    assert message(read_layout, word, error=OptionError) == (
        f"--taxels {word}: allowed are 1..{MAX_TAXELS} taxels; give another number, or a CSV file"
    )


# Edges


def test_edges_count_in_both_directions(write):
    path = write("e.csv", "source,target\n2,0\n0,1\n1,0\n")
    edges, warnings = read_edges(path, 3)
    assert edges.tolist() == [[0, 1], [0, 2], [1, 0], [2, 0]]
    assert warnings == ()  # a list that has both directions repeats nothing
    edges, warnings = read_edges(path, 3, directed=True)
    assert edges.tolist() == [[0, 1], [1, 0], [2, 0]]
    assert warnings == ()
    assert read_edges(write("e.csv", "target,source\n1,0\n"), 2, directed=True)[0].tolist() == [[0, 1]]


@pytest.mark.parametrize("directed", [False, True])
def test_repeated_edges_count_once(write, directed):
    edges, warnings = read_edges(write("e.csv", "0,1\n1,2\n0,1\n"), 3, directed=directed)
    assert len(edges) == (2 if directed else 4)
    assert warnings == ("e.csv: 1 line repeats an edge (first 0,1 at line 3); each counts once",)
    _, warnings = read_edges(write("e.csv", "source,target\n0,1\n0,1\n0,1\n"), 3, directed=directed)
    assert warnings == ("e.csv: 2 lines repeat edges (first 0,1 at line 3); each counts once",)


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
    assert message(read_edges, path, 3).startswith(f"e.csv: line 3: {found}")


# Graphs


def test_named_graph_on_another_sensor(write):
    graph, warnings = sensor_graph(graph="mst:4.1", taxels=write("c.csv", SQUARE))
    assert (graph.name, graph.n_taxels, len(graph.edges)) == ("mst:4.1", 25, 2 * 40)  # the grid has 40 links
    assert warnings == ()


def test_edges_from_a_file(write):
    edges = write("e.csv", "0,1\n1,2\n")
    graph, warnings = sensor_graph(edges=edges)
    assert (graph.name, graph.n_taxels, graph.edges.tolist()) == ("edges:e.csv", 3, [[0, 1], [1, 0], [1, 2], [2, 1]])
    assert warnings == ()
    graph, warnings = sensor_graph(edges=edges, taxels="5", directed=True)
    assert (graph.n_taxels, graph.edges.tolist()) == (5, [[0, 1], [1, 2]])
    assert warnings == (
        "e.csv: taxels 3 and 4 have no edges, each receives its own events only; add edges if they should not",
    )
    graph, _ = sensor_graph(edges=edges, taxels=write("c.csv", SQUARE))
    assert graph.coordinates[6].tolist() == [4, 4]


def test_all_warnings_come(write):
    text = "0,1\n1,0\n2,3\n0,1\n" + "".join(f"{i},{i + 1}\n" for i in range(4, 8))
    _, warnings = sensor_graph(edges=write("e.csv", text), taxels="30")
    assert warnings == (
        "e.csv: 1 line repeats an edge (first 0,1 at line 4); each counts once",
        "e.csv: taxels 9, 10, 11, 12, 13, 14, 15, 16 and 13 more have no edges, each receives its own events "
        "only; add edges if they should not",
        "e.csv: the graph has 3 parts, of 5, 2 and 2 taxels (with taxels 4, 0 and 2); touch does not spread "
        "between them",
    )


@pytest.mark.parametrize("seed", range(8))
def test_parts_agree_with_networkx(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 80))
    edges = rng.integers(0, n, (int(rng.integers(1, n)), 2))
    network = networkx.Graph(edges.tolist())
    network.add_nodes_from(range(n))
    expected = np.empty(n, dtype=np.int64)
    for part in networkx.connected_components(network):
        expected[list(part)] = min(part)
    assert _parts(edges, n).tolist() == expected.tolist()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "--graph and --edges: neither was given, allowed is one of them; --graph takes manual, knn:K"),
        ({"graph": "manual", "edges": "e.csv"}, "--graph and --edges: both were given, allowed is one of them"),
        ({"graph": "manual", "directed": True}, "--directed: only edges from a file have directions"),
        ({"graph": "knn:2", "taxels": "25"}, "--taxels 25: --graph knn:2 needs positions; give a CSV file"),
        ({"graph": "manual", "taxels": "c.csv"}, "graph 'manual': drawn by hand for the NeuTouch layout, not for"),
    ],
)
def test_options_that_exclude_each_other(write, monkeypatch, options, words):
    monkeypatch.chdir(write("c.csv", SQUARE).parent)
    write("e.csv", "0,1\n")
    assert message(sensor_graph, **options, error=OptionError).startswith(words)
