"""NIR files that cannot be used: one clear line each."""

import io
from itertools import pairwise
from pathlib import Path

import h5py
import nir
import numpy as np
import pytest
from made_nir import affine, chain, cuba, graph_with, lif, lowered, tree_of

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats import hdf5
from spikeloom.compiler.formats.nir.file import graph_of
from spikeloom.compiler.formats.nir.reader import read_nir
from spikeloom.runtime.cli import main

RNG = np.random.default_rng(0)
FILES = Path(__file__).parent / "nir"
GOOD = FILES / "snntorch_leaky.nir"


def message(graph, **options):
    with pytest.raises(ModelError) as caught:
        lowered(graph, **options)
    return str(caught.value)


def two_layers(last=None, first=None, weight=None):
    """A small network, with nodes of it replaced."""
    return chain(weight or affine(RNG, 5, 4), first or lif(5), affine(RNG, 3, 5), last or lif(3))


def test_no_time_step(tmp_path, capsys):
    out = str(tmp_path / "x.loom")
    assert main(["compile", str(GOOD), "-o", out]) == 2
    said = "NIR keeps no time step, but its r is tau / 0.0001, as of steps of 0.0001 s; give --dt SECONDS"
    assert capsys.readouterr().err == f"spikeloom: {GOOD}: {said}\n"
    nir.write(tmp_path / "a.nir", two_layers())
    with pytest.raises(OptionError) as caught:
        read_nir(tmp_path / "a.nir", dt=None)
    assert str(caught.value) == f"{tmp_path}/a.nir: NIR keeps no time step; give --dt SECONDS"


@pytest.mark.parametrize("dt", ["0", "-1", "nan", "inf"])
def test_no_such_time_step(dt, tmp_path, capsys):
    assert main(["compile", str(GOOD), "--dt", dt, "-o", str(tmp_path / "x.loom")]) == 2
    line = f"spikeloom: {GOOD}: --dt {float(dt):g}: is no time step; give seconds above 0\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--graph", "manual"], "--graph: is for checkpoints, the NIR file {path} holds all it needs; leave it away"),
        (["--beta", "0.2"], "--beta: is for checkpoints, the NIR file {path} holds all it needs; leave it away"),
    ],
)
def test_options_of_checkpoints(words, line, tmp_path, capsys):
    assert main(["compile", str(GOOD), "--dt", "1e-4", *words, "-o", str(tmp_path / "x.loom")]) == 2
    assert capsys.readouterr().err == f"spikeloom: {line.format(path=GOOD)}\n"


def test_options_of_nir_files(tmp_path, capsys):
    for words, name in ((["--dt", "1"], "dt"), (["--convention", "euler"], "convention")):
        assert main(["compile", "pretrained:grasps", *words, "-o", str(tmp_path / "x.loom")]) == 2
        line = f"spikeloom: --{name}: is for NIR files, pretrained:grasps is none; leave it away\n"
        assert capsys.readouterr().err == line


def test_what_is_no_nir_file(tmp_path, capsys):
    def line(path):
        assert main(["compile", str(path), "--dt", "1", "-o", str(tmp_path / "x.loom")]) == 2
        return capsys.readouterr().err.removeprefix(f"spikeloom: {path}: ").rstrip("\n")

    assert line(tmp_path / "none.nir") == "no such file; give a NIR file"
    folder = tmp_path / "folder.nir"
    folder.mkdir()
    assert line(folder) == "is not a file; give a NIR file"
    other = tmp_path / "other.nir"
    other.write_bytes(b"text")
    assert line(other) == "is no HDF5 file, as a NIR file is; export it again"
    for length in (100, 2000, 10_000):
        other.write_bytes(GOOD.read_bytes()[:length])
        assert line(other) == "is truncated or damaged (OSError); export it again"
    with h5py.File(other, "w") as file:
        file["x"] = 1
    assert line(other) == "has no node, so it is no NIR file; export it again"


def test_a_file_that_is_too_large(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "SIZE_LIMIT", 1000)
    with pytest.raises(ModelError) as caught:
        read_nir(GOOD, dt=1.0)
    size = GOOD.stat().st_size
    line = f"{GOOD}: has {size} bytes, 1000 are allowed; a NIR file of one chip is smaller"
    assert str(caught.value) == line


def hdf5_line(tmp_path, fill):
    path = tmp_path / "x.nir"
    with h5py.File(path, "w") as file:
        fill(file)
    with pytest.raises(ModelError) as caught:
        read_nir(path, dt=1.0)
    return str(caught.value).removeprefix(f"{path}: ")


def test_files_that_reach_beyond_themselves(tmp_path):
    (tmp_path / "raw.bin").write_bytes(bytes(80))
    layout = h5py.VirtualLayout((10,), "f8")

    def external(file):
        file.create_dataset("a", (10,), "f8", external=[(str(tmp_path / "raw.bin"), 0, 80)])

    assert hdf5_line(tmp_path, lambda f: f.__setitem__("a", h5py.ExternalLink("other.h5", "/b"))) == (
        "a is a link to elsewhere, allowed are arrays in the file itself; export it again"
    )
    assert hdf5_line(tmp_path, lambda f: f.__setitem__("a", h5py.SoftLink("/b"))) == (
        "a is a link to elsewhere, allowed are arrays in the file itself; export it again"
    )
    elsewhere = "a keeps its numbers in another file, allowed is this file alone; export it again"
    assert hdf5_line(tmp_path, external) == elsewhere
    assert hdf5_line(tmp_path, lambda f: f.create_virtual_dataset("a", layout)) == elsewhere


def test_files_that_announce_too_much(tmp_path):
    line = hdf5_line(tmp_path, lambda f: f.create_dataset("a", (2**40,), "f8", chunks=(1024,)))
    assert line == "announces more than 268435456 bytes of numbers; export it again"
    line = hdf5_line(tmp_path, lambda f: f.create_dataset("a", (1,), "f8", maxshape=(None,), chunks=(2**28,)))
    assert line == "announces more than 268435456 bytes of numbers; export it again"

    def deep(file):
        for _ in range(70):
            file = file.create_group("a")

    assert hdf5_line(tmp_path, deep) == "has groups nested deeper than 64; export it again"


def structure(change):
    """The message about the content of a good file after a change."""
    tree = tree_of(two_layers())
    change(tree["node"])
    with pytest.raises(ModelError) as caught:
        graph_of(tree, "")
    return str(caught.value)


def test_structure():
    assert structure(lambda n: n.pop("nodes")) == "the graph has no nodes; export it again"
    assert structure(lambda n: n["nodes"]["n1"].pop("type")) == "node n1 has no type; export it again"
    assert structure(lambda n: n.pop("edges")) == "the graph has no list of edges; export it again"
    assert structure(lambda n: n.update(edges=[["n0"]])) == "the graph has no list of edges; export it again"
    line = "the graph has an edge n0 -> elsewhere, there is no node elsewhere; export it again"
    assert structure(lambda n: n["edges"].append(["n0", "elsewhere"])) == line
    deep = {"type": "NIRGraph", "nodes": {}, "edges": []}
    for _ in range(20):
        deep = {"type": "NIRGraph", "nodes": {"a": deep}, "edges": []}
    assert structure(lambda n: n["nodes"].update(b=deep)) == "has graphs nested deeper than 8; export a flat one"
    empty = {"type": "NIRGraph", "nodes": {"x": {"type": "Linear"}}, "edges": []}
    line = "graph b has 0 nodes of type Input, one is allowed; export it again"
    assert structure(lambda n: n["nodes"].update(b=empty)) == line


def test_inputs_and_outputs():
    graph = two_layers()
    graph.nodes["more"] = nir.Output(np.array([5]))
    graph.edges.append(("n1", "more"))
    line = "has 2 nodes of type Output (output, more), one is allowed; export one network"
    assert message(graph) == line
    graph = two_layers()
    graph.nodes["input"] = nir.Input(np.array([2**21]))
    line = "node input (Input): has the shape [2097152], allowed are up to 1048576 values; export it again"
    assert message(graph) == line
    graph = two_layers()
    graph.edges.remove(("n2", "n3"))
    assert message(graph) == "node n3 (LIF): hears nothing, so it is not reached from the input; leave it away"


def test_unknown_nodes_and_those_without_a_place():
    graph = two_layers()
    tree = tree_of(graph)
    tree["node"]["nodes"]["n0"]["type"] = "Quantum\n"
    from spikeloom.compiler.formats.nir.neurons import Steps
    from spikeloom.compiler.formats.nir.reader import network_of

    with pytest.raises(ModelError) as caught:
        network_of(graph_of(tree, ""), Steps(dt=0.02, convention="euler"))
    assert str(caught.value) == (
        r"node n0 ('Quantum\n'): is of a type that is not known here, known are Affine, AvgPool2d, Conv1d, Conv2d, "
        "CubaLIF, Flatten, IF, Identity, LI, LIF, Linear, Output, Scale, SumPool2d, Threshold; replace it"
    )
    delay = nir.Delay(np.full(5, 0.1))
    line = "node n1 (Delay): delays spikes, which networks here do not; train without"
    assert message(chain(lif(5), delay, affine(RNG, 3, 5), lif(3)), polarities=1) == line
    line = "node n1 (I): integrates without leak and never spikes; use IF"
    assert message(chain(lif(5), nir.I(np.ones(5)), lif(5)), polarities=1) == line


def ring(*edges, **nodes):
    """A layer, a further one, and what else there is."""
    both = {"a": affine(RNG, 5, 4), "b": lif(5), "c": affine(RNG, 5, 5), "d": lif(5)}
    return graph_with(both | nodes, [("a", "b"), ("b", "c"), ("c", "d"), *edges], (4,), (5,), last="d")


def test_circles_that_are_no_layer_hearing_itself():
    assert message(ring(("d", "w"), ("w", "b"), w=affine(RNG, 5, 5))) == (
        "nodes hear each other in a circle (b -> c -> d -> w -> b) with 2 spiking ones in it; a spike takes the chip a "
        "step from one to the next, so it would come back late: a layer may hear itself only, train without the rest"
    )
    chain_ = {f"w{i}": affine(RNG, 5, 5) for i in range(20)}
    around = ["d", *chain_, "b"]
    line = message(ring(*pairwise(around), **chain_))
    assert line.startswith("nodes hear each other in a circle (b -> c -> d -> w0 -> w1 -> w2 -> w3 -> … -> b) with 2 ")
    without = "nodes hear each other in a circle ({}) without neurons, so nothing in it takes a step; put a spiking "
    without += "node into it or train without"
    assert message(ring(("b", "w"), ("w", "w"), ("w", "d"), w=affine(RNG, 5, 5))) == without.format("w -> w")
    more = {"v": affine(RNG, 5, 5), "w": affine(RNG, 5, 5)}
    assert message(ring(("b", "v"), ("v", "w"), ("w", "v"), ("w", "b"), **more)) == without.format("v -> w -> v")


def test_loops_that_cannot_be_read():
    several = {"b": lif(5, tau=np.array([0.05, 0.05, 0.1, 0.1, 0.1]))}
    assert message(ring(("b", "w"), ("w", "b"), w=affine(RNG, 5, 5), **several)) == (
        "node b (LIF): hears itself and has 2 membrane time constants, which are layers of their own; give it one"
    )
    assert message(ring(("b", "w"), ("a", "w"), ("w", "b"), w=affine(RNG, 5, 5))) == (
        "node w (Affine): is in the loop of b and hears a too, of which nothing tells the step; give each a stage of "
        "its own"
    )
    assert message(ring(("b", "w"), ("w", "b"), w=affine(RNG, 4, 5))) == (
        "node b (LIF): gets values of different shapes, [5] and [4]; export it again"
    )
    filter_ = nir.LI(tau=np.full(5, 0.06), r=np.ones(5), v_leak=np.zeros(5))
    assert message(ring(("b", "w"), ("w", "b"), w=filter_)) == (
        "node b (LIF): gets currents with different time constants; a neuron of the chip has one"
    )
    graph = graph_with(
        {"a": affine(RNG, 5, 4), "b": lif(5), "x": lif(5), "d": lif(5)},
        [("a", "b"), ("b", "d"), ("x", "x"), ("x", "d")], (4,), (5,), last="d",
    )  # fmt: skip
    line = "node x (LIF): hears nothing but itself, so it is not reached from the input; leave it away"
    assert message(graph) == line


def test_shapes_that_disagree():
    line = message(chain(affine(RNG, 5, 4), lif(5), affine(RNG, 5, 3), lif(5)))
    assert line == (
        "node n2 (Affine): weight is for 3 values, it gets [5]; the matrix looks transposed, NIR wants (to, from)"
    )
    line = message(chain(affine(RNG, 5, 4), lif(5), affine(RNG, 3, 7), lif(3)))
    assert line == "node n2 (Affine): weight is for 7 values, it gets [5]; the shapes disagree, export it again"
    line = message(chain(affine(RNG, 5, 4), lif(6), affine(RNG, 3, 6), lif(3)))
    assert line == ("node n1 (LIF): r has the shape [6], it gets [5]; the shapes must be equal, export it again")
    graph = graph_with({"a": affine(RNG, 3, 12), "b": lif(3)}, [("a", "b")], (2, 6), (3,))
    assert message(graph) == "node a (Affine): weight is for 12 values, it gets [2, 6]; a Flatten is missing before it"
    graph = graph_with(
        {"a": lif(4), "b": affine(RNG, 3, 4), "c": lif(3)}, [("a", "b"), ("b", "c"), ("a", "c")], (4,), (3,)
    )
    assert message(graph) == "node c (LIF): gets values of different shapes, [3] and [4]; export it again"


def conv(**changes):
    said = {"input_shape": (5, 6), "weight": np.ones((4, 2, 3, 2)), "bias": np.zeros(4), "stride": 1, "padding": 0}
    return nir.Conv2d(**(said | {"dilation": 1, "groups": 1} | changes))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"input_shape": (6, 5)}, "is for inputs of [6, 5], it gets [5, 6]; its axes look exchanged; export it again"),
        ({"input_shape": (7, 5)}, "is for inputs of [7, 5], it gets [5, 6]; export it again"),
        (
            {"weight": np.ones((2, 4, 3, 2)), "bias": np.zeros(2)},
            "has kernels for 4 channels in 1 groups and 2 filters, its input has 2 channels (they would fit with "
            "filters and channels exchanged); export it again",
        ),
        ({"stride": 0}, "has a kernel size, stride or dilation below 1 or a padding below 0; export it again"),
        ({"dilation": 9}, "has a kernel of 3 for 5 places; export it again"),
        ({"padding": np.array([1, 2, 3])}, "padding has 3 values, wanted 2; export it again"),
        ({"stride": np.array([0.5])}, "stride is no whole number; export it again"),
        ({"bias": np.zeros(3)}, "bias has 3 values, wanted 4; export it again"),
        (
            {"groups": 3},
            "has kernels for 2 channels in 3 groups and 4 filters, its input has 2 channels; export it again",
        ),
    ],
)
def test_convolutions(changes, line):
    node = conv(**{key: value for key, value in changes.items() if key not in ("stride", "dilation", "padding")})
    for key in ("stride", "dilation", "padding"):
        if key in changes:
            setattr(node, key, changes[key])
    graph = graph_with({"a": node, "b": nir.Threshold(np.full(60, 0.5))}, [("a", "b")], (2, 5, 6), (60,))
    assert message(graph) == f"node a (Conv2d): {line}"


@pytest.mark.parametrize(
    ("neuron", "line"),
    [
        (
            lif(3, tau=0.01),
            "tau is 0.01 s, shorter than the step of 0.02 s, which the Euler convention cannot have; give another "
            "--dt, or --convention exponential",
        ),
        (
            lif(3, tau=0.01, r=100.0),
            "tau is 0.01 s, shorter than the step of 0.02 s, which the Euler convention cannot have (its r is tau / "
            "0.0001, so it was written in steps of 0.0001 s); give another --dt, or --convention exponential",
        ),
        (
            lif(3, tau=1e-5),
            "tau is 1e-05 s, shorter than the step of 0.02 s, which the Euler convention cannot have (Norse "
            "multiplies its dt into tau: such a file wants the square of that dt); give another --dt, or --convention "
            "exponential",
        ),
        (lif(3, tau=-1.0), "tau is -1, allowed are numbers above 0; train it again"),
        (lif(3, threshold=0.0), "fires 0 above its reset, allowed are thresholds above it; train it again"),
        (
            lif(3, threshold=0.5, reset=0.6),
            "fires -0.1 above its reset, allowed are thresholds above it; train it again",
        ),
        (lif(3, r=np.array([1, np.nan, 1])), "r has 1 of 3 values NaN or infinite; train it again"),
        (
            cuba(3, tau_syn=np.array([0.1, 0.2, 0.3])),
            "tau_syn is different from neuron to neuron, allowed is one for a layer's currents; use one node for each",
        ),
        (lif(3, tau=np.array([0.1, 0.2, 0.3])), "votes, and has 3 membrane time constants; give the last layer one"),
    ],
)
def test_neurons(neuron, line):
    assert message(two_layers(last=neuron)) == f"node n3 ({type(neuron).__name__}): {line}"


def test_a_reset_that_subtracts():
    neuron = lif(3)
    neuron.metadata = {"reset_mechanism": "subtract"}
    assert message(two_layers(last=neuron)) == (
        "node n3 (LIF): resets by subtraction (reset_mechanism = 'subtract'), which a neuron of this chip cannot; "
        "train with a reset to a value"
    )


def test_too_many_decays():
    many = lif(20, tau=np.linspace(0.1, 1, 20))
    line = "node n1 (LIF): has 20 different membrane time constants, 16 are allowed in a node; train with fewer"
    assert message(chain(affine(RNG, 20, 4), many, affine(RNG, 3, 20), lif(3))) == line


def test_what_is_no_vote():
    remedy = "end the network with a spiking layer, one neuron or one group of neurons a class"
    graph = chain(affine(RNG, 5, 4), lif(5), affine(RNG, 3, 5))
    assert message(graph) == f"node output (Output): gets weighted spikes of n1, a vote counts them; {remedy}"
    filter_ = nir.LI(tau=np.full(3, 0.1), r=np.ones(3), v_leak=np.zeros(3))
    graph = chain(affine(RNG, 5, 4), lif(5), affine(RNG, 3, 5), filter_)
    assert message(graph) == (
        f"node output (Output): gets the membranes of a leaky integrator, a chip counts spikes; {remedy}"
    )
    assert message(chain(affine(RNG, 5, 4))) == (
        "has no spiking neurons, so nothing can be counted; export a spiking network"
    )


def test_currents_that_meet_and_filters_that_follow_each_other():
    filters = [nir.LI(tau=np.full(5, tau), r=np.ones(5), v_leak=np.zeros(5)) for tau in (0.1, 0.2)]
    line = message(chain(affine(RNG, 5, 4), *filters, lif(5)))
    assert line == "node n2 (LI): filters a current that is filtered before; a neuron of the chip has one current"
    nodes = {"a": affine(RNG, 5, 4), "b": filters[0], "c": filters[1], "d": lif(5)}
    edges = [("a", "b"), ("a", "c"), ("b", "d"), ("c", "d")]
    line = message(graph_with(nodes, edges, (4,), (5,)))
    assert line == "node d (LIF): gets currents with different time constants; a neuron of the chip has one"


def test_layers_that_are_skipped():
    nodes = {"a": affine(RNG, 5, 4), "b": lif(5), "c": affine(RNG, 3, 5), "d": affine(RNG, 3, 4), "e": lif(3)}
    edges = [("a", "b"), ("b", "c"), ("c", "e"), ("input", "d"), ("d", "e")]
    assert message(graph_with(nodes, edges, (4,), (3,))) == (
        "layer e: listens to the input and b, which lie differently deep; a spike takes one step on the chip and would "
        "arrive too early, so put a spiking layer into the shorter way"
    )


def test_numbers_that_were_rounded_before_are_named():
    weight = nir.Linear(np.array([[1, 2, 3, 4]] * 4, np.int8))
    facts = lowered(chain(weight, lif(4))).facts
    assert "drift: rounded before the file was written: n0.weight (int8); read as they stand" in facts
    assert "square matrices are read as (to, from): n0" in facts


def test_bytes_that_are_not_text(tmp_path):
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        group = file.create_group("node")
        group["type"] = np.bytes_(b"\xff\xfe")
    path = tmp_path / "a.nir"
    path.write_bytes(content.getvalue())
    with pytest.raises(ModelError) as caught:
        read_nir(path, dt=1.0)
    assert str(caught.value) == f"{path}: has 0 nodes of type Input, one is allowed; export one network"
