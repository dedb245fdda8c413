"""NIR files that cannot be used: the words that each refusal must have."""

import shutil
import sys
import tracemalloc
from itertools import pairwise
from pathlib import Path

import h5py
import nir
import numpy as np
import oracles
import pytest
from made_nir import affine, chain, cuba, graph_with, lif, lowered, tree_of

from spikeloom.compiler import files
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats import hdf5
from spikeloom.compiler.formats.nir.file import graph_of
from spikeloom.compiler.formats.nir.reader import network_of, read_nir
from spikeloom.compiler.formats.nir.stages import Steps

RNG = np.random.default_rng(0)
FILES = Path(__file__).parent / "nir"
GOOD = FILES / "snntorch_leaky.nir"


def refused(call, *arguments, **options):
    """The only line of a refusal."""
    return oracles.refused(ModelError, "", call, *arguments, **options)


def declared(size):
    """A network whose output says another number of classes."""
    graph = two_layers()
    graph.nodes["output"] = nir.Output(np.array([size]))
    return graph


def two_layers(last=None, first=None):
    """A small network, with nodes of it replaced."""
    return chain(affine(RNG, 5, 4), first or lif(5), affine(RNG, 3, 5), last or lif(3))


def with_node(name, node, edge=None):
    graph = two_layers()
    graph.nodes[name] = node
    graph.edges += [edge] if edge else []
    return graph


def without_edge(*edge):
    graph = two_layers()
    graph.edges.remove(edge)
    return graph


def ring(*edges, **nodes):
    """A layer, a further one, and what else there is."""
    both = {"a": affine(RNG, 5, 4), "b": lif(5), "c": affine(RNG, 5, 5), "d": lif(5)}
    return graph_with(both | nodes, [("a", "b"), ("b", "c"), ("c", "d"), *edges], (4,), (5,), last="d")


def circle(count):
    """Two layers in a circle with so many stages between them."""
    stages = {f"w{i}": affine(RNG, 5, 5) for i in range(count)}
    return ring(*pairwise(["d", *stages, "b"]), **stages)


def conv(**changes):
    """A convolution on (2, 5, 6), some of its parameters changed behind its back."""
    said = {
        "input_shape": (5, 6),
        "weight": np.ones((4, 2, 3, 2)),
        "bias": np.zeros(4),
        "stride": 1,
        "padding": 0,
    }
    late = {key: changes.pop(key) for key in ("stride", "dilation", "padding") if key in changes}
    node = nir.Conv2d(**(said | {"dilation": 1, "groups": 1} | changes))
    for key, value in late.items():
        setattr(node, key, value)
    return graph_with({"a": node, "b": nir.Threshold(np.full(60, 0.5))}, [("a", "b")], (2, 5, 6), (60,))


def subtracting():
    neuron = lif(3)
    neuron.metadata = {"reset_mechanism": "subtract"}
    return two_layers(last=neuron)


def subtracting_as_a_whole():
    graph = two_layers()
    graph.metadata = {"reset_mechanism": "subtract"}
    return graph


def leaky(size, tau):
    return nir.LI(tau=np.full(size, tau), r=np.ones(size), v_leak=np.zeros(size))


W = affine(RNG, 5, 5)
ALONE = {"a": affine(RNG, 5, 4), "b": lif(5), "x": lif(5), "d": lif(5)}
SKIP = {"a": affine(RNG, 5, 4), "b": lif(5), "c": affine(RNG, 3, 5), "d": affine(RNG, 3, 4), "e": lif(3)}

GRAPHS = [
    (
        "has 2 nodes of type Output (output, more), one is allowed",
        lambda: with_node("more", nir.Output(np.array([5]))),
    ),
    (
        "has the shape [2097152], allowed are up to 1048576",
        lambda: with_node("input", nir.Input(np.array([2**21]))),
    ),
    ("node n3 (LIF): receives nothing", lambda: without_edge("n2", "n3")),
    (
        "(Delay): is of a type that has no place here",
        lambda: chain(lif(5), nir.Delay(np.full(5, 0.1)), affine(RNG, 3, 5), lif(3)),
    ),
    ("circle (b -> c -> d -> w0 -> w1 -> w2 -> w3 -> … -> b) with 2", lambda: circle(20)),
    ("is in the loop of b and receives a too", lambda: ring(("b", "w"), ("a", "w"), ("w", "b"), w=W)),
    ("values of different shapes, [5] and [4]", lambda: ring(("b", "w"), ("w", "b"), w=affine(RNG, 4, 5))),
    ("currents with different time constants", lambda: ring(("b", "w"), ("w", "b"), w=leaky(5, 0.06))),
    (
        "node x (LIF): receives nothing but its own",
        lambda: graph_with(ALONE, [("a", "b"), ("b", "d"), ("x", "x"), ("x", "d")], (4,), (5,), last="d"),
    ),
    (
        "weight is for 7 values, it gets [5]; the shapes disagree",
        lambda: chain(W, lif(5), affine(RNG, 3, 7), lif(3)),
    ),
    ("for inputs of [6, 5], it gets [5, 6]", lambda: conv(input_shape=(6, 5))),
    ("stride or dilation below 1", lambda: conv(stride=0)),
    ("has a kernel of 3 for 5 places", lambda: conv(dilation=9)),
    ("2 channels in 3 groups", lambda: conv(groups=3)),
    ("tau is 0.01 s, shorter than the step of 0.02 s", lambda: two_layers(lif(3, tau=0.01))),
    ("(its r is tau / 0.0001, so", lambda: two_layers(lif(3, tau=0.01, r=100.0))),
    ("fires 0 above its reset", lambda: two_layers(lif(3, threshold=0.0))),
    ("r has 1 of 3 values NaN or infinite", lambda: two_layers(lif(3, r=np.array([1, np.nan, 1])))),
    (
        "tau_syn is different from neuron to neuron",
        lambda: two_layers(cuba(3, tau_syn=np.array([0.1, 0.2, 0.3]))),
    ),
    (
        "n3 (LIF): tau is different from neuron to neuron",
        lambda: two_layers(lif(3, tau=np.array([0.1, 0.2, 0.3]))),
    ),
    ("resets by subtraction (reset_mechanism = 'subtract')", subtracting),
    ("the graph resets by subtraction", subtracting_as_a_whole),
    ("node output (Output): is declared [4], it gets [3]", lambda: declared(4)),
    ("gets weighted spikes of n1", lambda: chain(affine(RNG, 5, 4), lif(5), affine(RNG, 3, 5))),
    ("has no spiking neurons", lambda: chain(affine(RNG, 5, 4))),
    (
        "filters a current that is filtered",
        lambda: chain(affine(RNG, 5, 4), leaky(5, 0.1), leaky(5, 0.2), lif(5)),
    ),
    (
        "the input and b, which are at different depths",
        lambda: graph_with(
            SKIP, [("a", "b"), ("b", "c"), ("c", "e"), ("input", "d"), ("d", "e")], (4,), (3,)
        ),
    ),
]


@pytest.mark.parametrize(("words", "made"), GRAPHS, ids=[words[:40] for words, _ in GRAPHS])
def test_networks_that_the_chip_cannot_have(words, made):
    graph = made()
    odd = np.prod(graph.nodes["input"].input_type["input"]) % 2
    assert words in refused(lowered, graph, polarities=1 if odd else None)


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("the graph has no nodes", lambda n: n.pop("nodes")),
        ("node n1 has no type", lambda n: n["nodes"]["n1"].pop("type")),
        ("the graph has no list of edges", lambda n: n.update(edges=[["n0"]])),
        ("there is no node elsewhere", lambda n: n["edges"].append(["n0", "elsewhere"])),
        (
            "graph b: has 0 nodes of type Input",
            lambda n: n["nodes"].update(
                b={"type": "NIRGraph", "nodes": {"x": {"type": "Linear"}}, "edges": []}
            ),
        ),
        (
            r"node n0 ('Quantum\n'): is of a type that has no place here, allowed are Affine, AvgPool2d",
            lambda n: n["nodes"]["n0"].update(type="Quantum\n"),
        ),
    ],
)
def test_structure(words, change):
    tree = tree_of(two_layers())
    change(tree["node"])
    steps = Steps(dt=0.02, convention="euler")
    assert words in refused(lambda: network_of(graph_of(tree, ""), steps))


def test_time_steps(tmp_path):
    for dt in (0.0, -1.0, np.nan, np.inf):
        oracles.refused(OptionError, f"--dt {dt:g}: is no time step", read_nir, GOOD, dt=dt)
    oracles.refused(OptionError, "no time step, but its r is tau / 0.0001", read_nir, GOOD)
    nir.write(tmp_path / "a.nir", two_layers())
    oracles.refused(OptionError, "NIR keeps no time step; give --dt SECONDS", read_nir, tmp_path / "a.nir")


@pytest.mark.parametrize("stated", [-1.0, np.nan, True])
def test_a_file_that_states_no_time_step(tmp_path, stated):
    graph = two_layers()
    graph.metadata = {"dt": stated}
    nir.write(tmp_path / "a.nir", graph)
    words = f"states steps of {stated} s, which are none; export it again"
    for given in (None, 0.02):
        assert words in refused(read_nir, tmp_path / "a.nir", dt=given)


def test_sizes_are_limited_before_memory_is_taken():
    """A window of the padding's size, and a matrix for each of many rows."""
    window = nir.SumPool2d(np.array([2**14, 2**14]), np.array([1, 1]), np.array([2**13, 2**13]))
    rows = np.ones((2**14, 1))
    large = [
        graph_with({"a": window, "b": lif(4)}, [("a", "b")], (1, 2, 2), (4,)),
        graph_with({"a": nir.Linear(rows), "b": lif(4)}, [("a", "b")], (2**14, 1), (4,)),
    ]
    tracemalloc.start()
    for graph in large:
        assert "weights once written out" in refused(lowered, graph, polarities=1)
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()


def nested(file):
    file["a"] = file


@pytest.mark.parametrize(
    ("words", "fill"),
    [
        ("has no node, so it is no NIR file", lambda f: f.__setitem__("x", 1)),
        ("a is a link to elsewhere", lambda f: f.__setitem__("a", h5py.ExternalLink("other.h5", "/b"))),
        (
            "a keeps its numbers in another",
            lambda f: f.create_dataset("a", (10,), "f8", external=[("raw.bin", 0, 80)]),
        ),
        ("announces more than 268435456", lambda f: f.create_dataset("a", (2**40,), "f8", chunks=(1024,))),
        (
            "announces more than 268435456",
            lambda f: f.create_dataset("a", (1,), "f8", maxshape=(None,), chunks=(2**28,)),
        ),
        ("(RecursionError: ", nested),
        (
            "has 0 nodes of type Input",
            lambda f: f.create_group("node").__setitem__("type", np.bytes_(b"\xff\xfe")),
        ),
    ],
)
def test_contents_of_hdf5(tmp_path, monkeypatch, words, fill):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "raw.bin").write_bytes(bytes(80))
    with h5py.File("x.nir", "w") as file:
        fill(file)
    assert words in refused(read_nir, tmp_path / "x.nir", dt=1.0)


def spin(*_):
    while True:
        pass


def test_a_file_on_which_the_library_spins_is_given_up(monkeypatch):
    monkeypatch.setattr(hdf5, "MOST_SECONDS", 1)
    monkeypatch.setattr(hdf5, "_group", spin)
    assert "dies on it, or takes more than 1 s" in refused(read_nir, GOOD, dt=1.0)


@pytest.mark.parametrize("ends", [hdf5._ends_in_fork, hdf5._ends_elsewhere])
def test_another_process_reads_it_first(ends):
    assert ends(Path(GOOD).read_bytes())
    assert ends(b"no HDF5 at all, which its reader says later")


def test_a_process_that_ends_badly_is_noticed_where_nothing_forks(monkeypatch):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    assert not hdf5._ends_elsewhere(Path(GOOD).read_bytes())


def test_words_count_as_long_as_they_are():
    with h5py.File("words", "w", driver="core", backing_store=False) as file:
        file.create_dataset("few", data=["a", "bc"], dtype=h5py.string_dtype())
        file.create_dataset("long", data=["x" * 4000] * 30, dtype=h5py.string_dtype())
        assert hdf5._entry(file, "few", [1000]) == ["a", "bc"]
        oracles.refused(ModelError, "announces more than", hdf5._entry, file, "long", [100_000])


def test_what_is_no_nir_file(tmp_path, monkeypatch):
    assert "no such file" in refused(read_nir, tmp_path / "other.nir", dt=1.0)
    monkeypatch.setattr(files, "SIZE_LIMIT", 1000)
    assert "more than 1000 bytes, the limit of a NIR file" in refused(read_nir, GOOD, dt=1.0)
