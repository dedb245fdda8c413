"""Into a netlist and out of it through NIR: what is not the same is said, or refused by name."""

import shutil

import made_nir
import nir
import numpy as np
import pytest
from commands import refusal, run
from made_files import CLASSES, TAXELS, recordings_folder
from zoo import counting

from spikeloom.compiler.formats.nir.reader import read_nir
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import read_netlist


def two_layers(hidden, last, size=2 * TAXELS):
    rng = np.random.default_rng(0)
    first = made_nir.affine(rng, 12, size, 1.0)
    return made_nir.chain(first, hidden, made_nir.affine(rng, CLASSES, 12, 1.5), last)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A NIR network read in steps of 0.05 s, its netlist and own export, and recordings in other bins."""
    place = tmp_path_factory.mktemp("conversions")
    nir.write(
        place / "net.nir",
        two_layers(made_nir.lif(12, tau=0.2, r=8.0), made_nir.lif(CLASSES, tau=0.2, r=8.0)),
    )
    recordings_folder(place / "data")
    assert run("compile", place / "net.nir", "--dt", "0.05", "-o", place / "net.loom")[0] == 0
    assert run("export", place / "net.loom", "--to", "nir", "-o", place / "own.nir")[0] == 0
    return place


@pytest.mark.parametrize("words", [("run",), ("estimate",), ("verify", "--checkpoint", "net.nir")])
def test_bins_that_are_not_the_steps_of_a_nir_network_are_said(folder, monkeypatch, words):
    monkeypatch.chdir(folder)
    command, *more = words
    said = "bins of 0.02 s, the network was read in steps of 0.05 s"
    code, _, err = run(command, "net.loom", "--data", "data", *more)
    assert (code, err.count(said)) == (0, 1)
    (folder / "data" / "test" / "bins.npy").unlink(missing_ok=True)
    same = folder / "same.loom"
    assert run("compile", "net.nir", "--dt", "0.02", "-o", same)[0] == 0
    assert "read in steps" not in run(command, same, "--data", "data", *more)[2]


def test_calibration_on_other_bins_is_said(folder, tmp_path):
    given = (
        "compile",
        folder / "net.nir",
        "--dt",
        "0.05",
        "--calibrate",
        folder / "data",
        "-o",
        tmp_path / "x.loom",
    )
    assert "the network was read in steps of 0.05 s" in run(*given)[2]


def test_steps_that_a_file_states_are_not_overruled(folder, tmp_path):
    exported = folder / "own.nir"
    read_as = read_nir(exported).read_as
    assert (read_as["dt"], read_as["convention"]) == (0.05, "euler")  # those it was read in
    for option, value in (("--dt", "0.02"), ("--convention", "exponential")):
        words = refusal("compile", exported, option, value, "-o", tmp_path / "x.loom")
        assert words.startswith(f"{option} {value}: the file states")
        assert words.endswith(f"omit {option}")
    assert (
        run("compile", exported, "--dt", "0.05", "--convention", "euler", "-o", tmp_path / "x.loom")[0] == 0
    )


@pytest.mark.parametrize("words", [("explain",), ("stress", "--limit", "2")])
@pytest.mark.parametrize(("made", "read"), [((), "first"), (("--polarities-first",), "last")])
def test_a_network_in_another_order_of_polarities_is_refused(folder, tmp_path, made, read, words):
    net = tmp_path / "net.loom"
    assert run("compile", folder / "net.nir", "--dt", "0.05", *made, "-o", net)[0] == 0
    command, *more = words
    given = (net, "--checkpoint", folder / "net.nir", "--data", folder / "data", *more)
    other = "first" if made else "last"
    assert refusal(command, *given, f"--polarities-{read}").endswith(f"give --polarities-{other}")
    assert run(command, *given, f"--polarities-{other}")[0] in (0, 1)


def test_a_start_at_the_reset_is_said():
    plain = made_nir.lowered(two_layers(made_nir.lif(12), made_nir.lif(CLASSES))).facts
    moved = made_nir.lowered(two_layers(made_nir.lif(12, reset=-0.2), made_nir.lif(CLASSES))).facts
    said = [fact for fact in moved if "starts at its reset" in fact]
    assert [fact.partition(":")[0] for fact in said] == ["n1"]
    assert not any("starts at its reset" in fact for fact in plain)


def integers(path):
    """All that decides what a netlist does."""
    network = lift(read_netlist(path))
    layers = [
        (p.name, p.decay_u, p.decay_v, p.threshold.tolist(), p.bias.tolist()) for p in network.populations
    ]
    synapses = [(p.pre, p.post, p.effective().toarray().tolist()) for p in network.projections]
    return network.input, layers, synapses, network.readout.label.tolist()


@pytest.mark.parametrize("options", [(), ("--planes", "2")], ids=["a plane", "two planes"])
def test_biases_of_later_currents_come_back(tmp_path, options):
    rng = np.random.default_rng(0)
    nodes = [
        made_nir.affine(rng, 9, 6),
        made_nir.cuba(9, r=2.0, weight=3.0, leak=0.1),
        made_nir.affine(rng, 7, 9),
        made_nir.lif(7, r=2.0),
        made_nir.affine(rng, 4, 7),
        made_nir.cuba(4, r=2.5, weight=2.0),
    ]
    nir.write(tmp_path / "net.nir", made_nir.chain(*nodes))
    made = ("compile", tmp_path / "net.nir", "--dt", "0.02", "--keep-all", *options)
    assert run(*made, "-o", tmp_path / "net.loom")[0] == 0
    assert run("export", tmp_path / "net.loom", "--to", "nir", "-o", tmp_path / "own.nir")[0] == 0
    assert run("compile", tmp_path / "own.nir", "--keep-all", "-o", tmp_path / "back.loom")[0] == 0
    assert [layer[0] for layer in integers(tmp_path / "back.loom")[1]] == [
        "n1",
        "always1",
        "n3",
        "always2",
        "n5",
    ]
    assert integers(tmp_path / "back.loom") == integers(tmp_path / "net.loom")
    nir.read(tmp_path / "own.nir")


def test_a_netlist_and_its_own_export_match_whatever_the_names_of_layers(tmp_path):
    data = recordings_folder(tmp_path / "data")
    network, netlist, exported = (tmp_path / f"net.{ending}" for ending in ("pt", "loom", "nir"))
    counting(tmp_path, counts=(1, 2, 10), parts=1)
    assert run("compile", network, "-o", netlist)[0] == 0
    assert run("export", netlist, "--to", "nir", "-o", exported)[0] == 0
    names = [layer.name for layer in read_netlist(netlist).layers]
    assert names.index("count2") < names.index("count10")
    assert [one.name for one in read_nir(exported).network.populations] == names
    code, _, err = run("verify", netlist, "--data", data, "--checkpoint", exported)
    assert code != 2, err


def test_a_nir_file_of_another_name_is_recognised(folder, tmp_path):
    shutil.copy(folder / "net.nir", tmp_path / "net.pt")
    for options in ((), ("--dt", "0.02")):
        words = refusal("compile", tmp_path / "net.pt", *options, "-o", tmp_path / "x.loom")
        assert words.endswith("net.pt: is an HDF5 file, as NIR files are; let its name end in .nir")


@pytest.mark.parametrize(
    ("voted", "never"), [((0, 1, 2, 2), "3"), ((1, 3, 3, 1), "0, 2"), ((0, 1, 2, 3), "")]
)
def test_classes_that_nobody_votes_for_are_said(tmp_path, voted, never):
    votes = np.zeros((4, 4))
    votes[list(voted), range(4)] = 1
    graph = made_nir.chain(
        made_nir.affine(np.random.default_rng(0), 4, 4, 2.0), made_nir.lif(4), nir.Linear(votes)
    )
    nir.write(tmp_path / "net.nir", graph)
    code, _, err = run(
        "compile", tmp_path / "net.nir", "--dt", "0.02", "--keep-all", "-o", tmp_path / "net.loom"
    )
    assert code == 0
    said = f"no neuron votes for class {never}, which is never decided"
    assert (said in err) == bool(never)
    assert read_netlist(tmp_path / "net.loom").classes == 4
