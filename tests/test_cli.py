"""The command line: what each command prints, where, with which exit code, and what it says of its own cost."""

import hashlib
import io
import json
import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from made_files import CLASSES, FEATURES, STEPS, TAXELS, events, own_file
from made_files import weights as made_weights
from numpy.testing import assert_array_equal

from spikeloom.__main__ import main as start
from spikeloom.compiler import __version__, layer_kernel
from spikeloom.compiler.formats.text import text
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.targets.base import EVENTS, load_target
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.compiler.targets.loihi1.passes import PASSES
from spikeloom.models.graphs import build_graph
from spikeloom.models.progress import FORM
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.grasps import synthetic_split
from spikeloom.runtime import cli
from spikeloom.runtime.commands.main_job import demo
from spikeloom.runtime.equivalence import reference
from spikeloom.runtime.inputs import network
from spikeloom.runtime.inputs import recordings as recordings_input
from spikeloom.runtime.machines import base
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import pricing

SIZES = {"conv1": TAXELS * FEATURES, "fc1": 9, "fc2": 8, "fc3": CLASSES}


def test_compile_counts_and_says_what_was_realised(as_json, tmp_path, place):
    report = as_json(
        "compile", "net.pt", "--calibrate", "data", "--weight-bits", 8, "-o", tmp_path / "out.loom"
    )
    content = (tmp_path / "out.loom").read_bytes()
    assert content == (place / "net.loom").read_bytes()
    assert report["sha256"] == hashlib.sha256(content).hexdigest()
    assert (report["target"], report["neurons"]) == ("loihi1", sum(SIZES.values()))
    # ring of six taxels with K = 3: every taxel reaches every other
    fan_in = {"conv1": 2 * TAXELS, "fc1": SIZES["conv1"], "fc2": 9, "fc3": 8}
    structural = {name: SIZES[name] * fan_in[name] for name in SIZES}
    assert report["synapses"] == sum(structural.values())
    keys = ["name", "neurons", "synapses", "max_fan_in", "weight_bits", "cores"]
    assert [[layer[key] for key in keys] for layer in report["layers"]] == [
        [name, SIZES[name], structural[name], fan_in[name], 8, [0]] for name in SIZES
    ]
    for layer in report["layers"]:
        assert (layer["theta"], layer["beta"], layer["beta_realised"]) == (0.5, 0.2, 819 / 4096)
        assert layer["theta_realised"] == layer["threshold"] / layer["scale"]
    assert report["synapses"] >= report["synapses_stored"] >= report["synapses_nonzero"] > 0
    words = sum(limit["used"] for limit in report["limits"] if limit["name"] == "core.synapse_words")
    assert report["synapse_words_unrolled"] >= report["synapse_words"] == words
    assert {limit["name"] for limit in report["limits"]} <= set(load_target("loihi1").limits)
    assert [limit for limit in report["limits"] if limit["name"] == "chip.cores"] == [
        {"name": "chip.cores", "used": report["cores"], "allowed": 128, "core": None}
    ]


def test_provenance_names_everything_that_decided(as_json, place):
    report = as_json("inspect", "net.loom")
    source = {"checkpoint_sha256": hashlib.sha256((place / "net.pt").read_bytes()).hexdigest()}
    source |= {"spikeloom": __version__, "run": 0, "weights": "last", "graph": "ring"}
    storage = {
        "weight_bits": 8,
        "planes": 1,
        "scale_groups": 1,
        "compensated": ["conv1", "fc1", "fc2", "fc3"],
    }
    options = {"spike_exact": False, "keep_all": False, "prune_unused": False, "calibrated": True}
    options |= {"data": "data", "digests": report["provenance"]["digests"]}
    options |= {"calibrated_sha256": load_data(place / "data", "train").events_sha256}
    assert report["provenance"] == source | storage | options


def test_dumps_go_to_standard_error(spikeloom, tmp_path):
    words = [word for step in PASSES for word in ("--dump-after", step.name)]
    code, out, err = spikeloom("compile", "net.pt", *words, "-o", tmp_path / "out.loom", "--json")
    assert (code, json.loads(out)["neurons"]) == (0, 51)
    assert err.endswith(text(read_netlist(tmp_path / "out.loom")))
    assert err.startswith("Network\n  input (taxels 6) (polarities 2)")
    assert "\nIntegerNetwork\n" in err
    assert "\nLayout\n" in err


def test_limit_and_split_choose_the_recordings(as_json):
    everything = as_json("run", "net.loom", "--data", "data")
    assert everything["files"] == [f"sample_{i}_label_{i % CLASSES}.npy" for i in range(6)]
    assert everything["labels"] == [i % CLASSES for i in range(6)]
    right = sum(a == b for a, b in zip(everything["labels"], everything["predictions"], strict=True))
    assert 0 < right < 6
    assert everything["accuracy"] == right / 6
    two = as_json("run", "net.loom", "--data", "data", "--limit", 2)
    for key in ("files", "labels", "predictions", "counts"):
        assert two[key] == everything[key][:2]
    assert as_json("run", "net.loom", "--data", "data", "--limit", 100, "--split", "test") == everything
    assert as_json("run", "net.loom", "--data", "data", "--split", "train")["counts"] != everything["counts"]


def test_spikes_are_written_aligned_with_the_data(as_json, tmp_path, place):
    report = as_json("run", "net.loom", "--data", "data", "--spikes", tmp_path / "out.npz")
    netlist = read_netlist(place / "net.loom")
    expected = run_integer(lift(netlist), channels_last(events(2))).spikes
    with np.load(tmp_path / "out.npz", allow_pickle=False) as archive:
        assert archive.files == list(SIZES)
        for name, spikes in zip(SIZES, expected, strict=True):
            assert archive[name].dtype == np.bool_
            assert archive[name].shape == (6, STEPS, SIZES[name])
            assert_array_equal(archive[name], spikes)
            assert spikes.any()
        assert archive["fc3"].sum(axis=1).tolist() == report["counts"]


def test_verify_fails_when_decisions_agree_too_rarely(spikeloom, tmp_path):
    coarse = tmp_path / "coarse.loom"
    assert spikeloom("compile", "net.pt", "--weight-bits", "3", "-o", coarse)[0] == 0
    words = ["verify", coarse, "--checkpoint", "net.pt", "--data", "data", "--spec-samples", "1", "--json"]
    code, out, _ = spikeloom(*words, "--min-agreement", 1)
    report = json.loads(out)
    agreement = report["decision_agreement"]
    assert 0 < agreement < 1
    assert (code, report["missed"]) == (1, [f"E3: {agreement:.4f} reached, 1 required"])
    assert spikeloom(*words, "--min-agreement", agreement)[0] == 0  # exactly at the bound passes


def test_an_interrupt_while_python_loads_the_command(monkeypatch, capsys):
    class Loading(types.ModuleType):
        def __getattr__(self, name):
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "spikeloom.runtime.cli", Loading("spikeloom.runtime.cli"))
    assert start() == 2
    assert capsys.readouterr().err == "spikeloom: interrupted; nothing was written\n"


def test_the_epoch_is_that_of_the_netlist(spikeloom, tmp_path):
    """A checkpoint may hold several; one that is named is taken all the same."""
    net, both = tmp_path / "best.loom", tmp_path / "both.pt"
    own_file(both, last=made_weights(5), best=made_weights(0))
    assert spikeloom("compile", both, "--weights", "best", "-o", net)[0] == 0
    words = ["verify", net, "--checkpoint", both, "--data", "data", "--min-agreement", "0", "--json"]
    for options, same in (((), True), (("--weights", "best"), True), (("--weights", "last"), False)):
        assert json.loads(spikeloom(*words, *options)[1])["same_checkpoint"] is same


def test_a_table_of_ones_own_prices_alone(as_json, tmp_path):
    prices = [f'{event} = {{ value = 1000.0, unit = "pJ", source = "mine" }}' for event in EVENTS]
    (tmp_path / "mine.toml").write_text("\n".join(['[energy.mine]\ntitle = "Mine"', *prices]))
    report = as_json("estimate", "net.loom", "--data", "data", "--table", tmp_path / "mine.toml")
    known = as_json("estimate", "net.loom", "--data", "data", "--table", "davies2018")
    assert (list(report["per_inference"]["energy_j"]), report["energy_range_j"]) == (["mine"], None)
    assert list(known["per_inference"]["energy_j"]) == ["davies2018"]
    assert report["per_inference"]["energy_j"]["mine"] > known["per_inference"]["energy_j"]["davies2018"]


@pytest.fixture
def shipped_grasps(monkeypatch, tmp_path):
    """A made-up network in place of the shipped one, and few grasps."""
    last = made_weights(taxels=39, sizes=(6, 5, 6))
    path = str(own_file(tmp_path / "grasps.pt", last=last, graph=build_graph("manual")))
    monkeypatch.setattr(network, "shipped", lambda name: path if name == "pretrained:grasps" else name)
    monkeypatch.setattr(
        recordings_input, "synthetic_split", lambda split, **_: synthetic_split(split, limit=6)
    )


def test_demo_compiles_ahead_on_another_core_where_no_machine_code_is_kept(tmp_path, monkeypatch):
    kept = types.SimpleNamespace(stats=types.SimpleNamespace(cache_path=tmp_path))
    monkeypatch.setattr(layer_kernel, "run_layer", kept)
    monkeypatch.setattr(demo, "usable_cores", lambda: 1)
    assert demo._compile_ahead(str(tmp_path)) is None
    monkeypatch.setattr(demo, "usable_cores", lambda: 2)
    ahead = demo._compile_ahead(str(tmp_path))
    ahead.join()
    assert ahead.exitcode == 0
    assert all(outcome.code == 0 for *_, outcome in demo._outcomes(demo.IN_SMALL, str(tmp_path)))
    (tmp_path / "layer_kernel.run_layer-1.py311.nbi").touch()
    assert demo._compile_ahead(str(tmp_path)) is None


@pytest.mark.usefixtures("shipped_grasps")
def test_demo_runs_the_main_job(spikeloom, tmp_path, monkeypatch):
    (tmp_path / "kept").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "kept"))
    code, out, err = spikeloom("demo", "--json")
    assert err == ""
    reports = json.loads(out)
    assert list(reports) == ["compile", "verify", "estimate"]
    assert reports["verify"]["samples"] == reports["estimate"]["samples"] == 6
    assert code == (0 if reports["verify"]["decision_agreement"] >= 0.95 else 1)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["grasps.pt", "kept"]
    *_, verdict, kept, following = spikeloom("demo")[1].splitlines()
    assert verdict.startswith("verdict: The netlist is its checkpoint, rounded; ")
    assert following.split()[3] in kept
    assert Path(following.split()[3]).is_file()


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    for group, names in cli.GROUPS.items():
        assert all(f"\n  {name} " in out.split(f"\n{group}:")[1] for name in names)


@pytest.mark.parametrize(
    ("words", "shown"),
    [(["-V"], f"spikeloom {__version__}"), (["help"], "COMMAND"), (["help", "run"], "NET.loom")],
)
def test_short_words_for_help_and_version(capsys, words, shown):
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 0
    assert shown in capsys.readouterr().out


HEAVY = "torch tqdm numba scipy.stats matplotlib onnx onnxruntime networkx h5py jinja2"
"""Packages that take a tenth of a second and more to load."""

NEEDED = {
    "--help": "",
    **{f"{name} --help": "" for name in sorted(set(cli.COMMANDS) - {"demo", "export", "report", "verify"})},
    "compile pretrained:grasps -o g.loom": "",
    "inspect pretrained:grasps": "",
    "inspect g.loom": "",
    "data describe synthetic": "",
    "export --help": "networkx",
    "verify --help": "numba",
    "run g.loom --data synthetic --spikes g.npz": "",
    "estimate g.loom --data synthetic": "",
    "verify g.loom --checkpoint pretrained:grasps --data synthetic --limit 2": "",
}
"""Those that a command may load beyond what the commands above it do."""


def test_no_command_loads_what_it_does_not_use(tmp_path):
    """In one process, that of the commands which load least first."""
    code = f"""
import contextlib, io, json, sys
from spikeloom.runtime import cli
for words, allowed in json.loads(sys.argv[1]).items():
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        assert cli.main(words.split()) == 0, words
    loaded = set({HEAVY.split()}) & set(sys.modules)
    assert loaded <= set(allowed), (words, loaded)
    assert words != "--help" or "numpy" not in sys.modules
"""
    allowed: set[str] = set()
    table = {words: sorted(allowed := allowed | set(more.split())) for words, more in NEEDED.items()}
    subprocess.run([sys.executable, "-c", code, json.dumps(table)], check=True, cwd=tmp_path)


@pytest.mark.parametrize(
    ("words", "others"),
    [
        ("inspect g.loom", "compiler.passes.prune models.recordings.events"),
        (
            "estimate g.loom --data synthetic --limit 1",
            "compiler.targets.loihi1.passes compiler.formats.torch_checkpoint",
        ),
    ],
)
def test_a_netlist_is_read_without_what_compiles(place, spikeloom, words, others):
    """`inspect` does not load readers of recordings either."""
    assert spikeloom("compile", "pretrained:grasps", "-o", "g.loom")[0] == 0
    code = f"""
import sys
from spikeloom.runtime import cli
assert cli.main({words.split()}) == 0
for name in {others.split()}:
    assert "spikeloom." + name not in sys.modules, name
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=place, stdout=subprocess.DEVNULL)


@pytest.mark.usefixtures("spikeloom")
def test_progress_goes_to_a_terminal_only(monkeypatch, capsys):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    assert cli.main(["run", "net.loom", "--data", "data", "--json"]) == 0
    json.loads(capsys.readouterr().out)
    assert "\r\x1b[Krunning: 0 of 6 …" in terminal.getvalue()
    assert terminal.getvalue().endswith("\r\x1b[K")  # and cleared


def test_progress_for_programs_is_lines_of_json(spikeloom, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv(FORM, "")  # so that it is unset afterwards
    assert cli.main(["run", "net.loom", "--data", "data", "--json", "--progress", "json"]) == 0
    out, err = capsys.readouterr()
    json.loads(out)
    lines = [json.loads(line) for line in err.splitlines()]
    assert {"label": "running", "done": 0, "total": 6} in lines
    assert all(line["label"] for line in lines)
    words = ["train", "--data", "data", "--taxels", str(TAXELS), "--system", "mlp", "--epochs", "2"]
    words += ["-o", str(tmp_path / "x.pt")]
    assert cli.main(words) == 0
    epochs = [json.loads(line) for line in capsys.readouterr().err.splitlines() if line.startswith("{")]
    assert [line["done"] for line in epochs if line["label"] == "seed 0, all data"] == [1, 2]


def test_a_reader_that_leaves_early_is_no_mistake(spikeloom, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert cli.main(["inspect", "net.loom"]) == 0
        monkeypatch.undo()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is always full")
def test_a_full_disk_behind_standard_output(spikeloom, monkeypatch, capsys):
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert cli.main(["inspect", "net.loom"]) == 2
    assert capsys.readouterr().err == (
        "spikeloom: standard output: No space left on device; check space and permissions\n"
    )


@pytest.mark.parametrize("words", [["--print-completion"], ["--print-completion", "fish"]])
def test_completion_is_for_some_shells(capsys, words):
    assert cli.main(words) == 2
    assert "--print-completion: give one of bash, zsh, tcsh" in capsys.readouterr().err


def test_a_closed_standard_output(spikeloom, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert cli.main(["inspect", "net.loom"]) == 2
    assert "standard output: is closed" in capsys.readouterr().err


def test_inspect_says_the_bins_that_a_network_was_trained_on(spikeloom, tmp_path):
    own_file(tmp_path / "binned.pt", training={"data": "taps", "bin_s": 0.05})
    spikeloom("compile", tmp_path / "binned.pt", "-o", tmp_path / "binned.loom")
    assert "\n  trained on bins of 0.05 s\n" in spikeloom("inspect", tmp_path / "binned.loom")[1]


def test_a_terminal_without_greek_letters(spikeloom, monkeypatch):
    plain = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", plain)
    assert cli.main(["inspect", "net.loom"]) == 0
    out = plain.buffer.getvalue().decode("ascii")
    assert out.startswith("loihi1: 51 neurons, ")
    assert "?" in out


def test_labelled_recordings_are_scored_and_a_table_scores_the_rest(as_json, tmp_path):
    for index, name in enumerate(("a_label_0", "b_label_1", "c", "d")):
        rows = [f"0.{step:02d},{(step + index) % TAXELS},{step % 2}" for step in range(0, 60, 2)]
        (tmp_path / f"{name}.csv").write_text("\n".join(rows))
    report = as_json("run", "net.loom", "--data", tmp_path)
    right = sum(report["predictions"][i] == report["labels"][i] for i in range(2))
    assert (report["samples"], report["labelled"], report["labels"]) == (4, 2, [0, 1, -1, -1])
    assert report["accuracy"] == right / 2
    (tmp_path / "labels.csv").write_text("file,label\nc.csv,2\nd.csv,3\n")
    report = as_json("run", "net.loom", "--data", tmp_path)
    assert (report["labels"], report["labelled"]) == ([0, 1, 2, 3], 4)


RUNNING = ("run", "net.loom", "--data", "data")
VERIFYING = ("verify", "net.loom", "--checkpoint", "net.pt", "--data", "data")
LAYERS = ["conv1", "fc1", "fc2", "fc3"]


@pytest.fixture
def passes(monkeypatch):
    """Recordings of every pass of the engine."""
    found, simulate = [], engine.simulate

    def counted(netlist, events, **options):
        found.append(len(events))
        return simulate(netlist, events, **options)

    monkeypatch.setattr(engine, "simulate", counted)
    return found


@pytest.mark.parametrize(
    "words",
    [
        (*RUNNING, "--spikes", "out.npz"),
        *(("estimate", *RUNNING[1:], "--detail", detail) for detail in ("counts", "cycle")),
        VERIFYING,
    ],
)
def test_it_does_not_matter_how_many_recordings_are_held_at_a_time(as_json, monkeypatch, words):
    def found():
        report = as_json(*words, codes=(0, 1))
        return report, dict(np.load("out.npz")) if "--spikes" in words else {}

    report, spikes = found()
    monkeypatch.setattr(base, "HELD", 1)
    monkeypatch.setattr(pricing, "HELD", 1)
    monkeypatch.setattr("spikeloom.models.networks.reference.STEPS", 7)
    again, parts = found()
    assert again == report
    assert list(spikes) == (LAYERS if spikes else [])
    for name, each in spikes.items():
        assert_array_equal(parts[name], each, strict=True)


@pytest.mark.parametrize(
    ("words", "runs"),
    [
        (RUNNING, 1),
        ((*RUNNING, "--spikes", "out.npz"), 1 + len(LAYERS)),
        (("estimate", *RUNNING[1:], "--detail", "cycle"), 1),
    ],
)
def test_every_recording_is_run_once_and_for_each_layer_that_is_written(spikeloom, passes, words, runs):
    spikeloom(*words)
    assert passes == [6] * runs


def test_a_rung_that_is_proven_is_what_it_would_be(as_json, monkeypatch):
    proven = as_json(*VERIFYING, codes=(0, 1))["ladder"]
    asked = []
    unproven = [type("Proof", (), {"holds": False})()]
    monkeypatch.setattr(reference, "prove_ranges", lambda network: asked.append(network) or unproven)
    assert as_json(*VERIFYING, codes=(0, 1))["ladder"] == proven
    assert asked


def test_exit_codes_of_failed_checks(spikeloom, as_json, tmp_path):
    assert as_json(*VERIFYING, "--require", "E2=1", codes=(1,))["missed"]
    chart = (
        "chart",
        "net.pt",
        "--data",
        "data",
        "--jobs",
        "1",
        "--grid",
        "bits=8",
        "-o",
        tmp_path / "chart",
    )
    assert as_json(*chart, "--budget", "energy=1nJ", codes=(1,))["points"]
    code, _, err = spikeloom("compile", "net.pt", "--target", "truenorth", "-o", tmp_path / "x.loom")
    *rules, _ = err.splitlines()
    assert code == 2
    assert len(rules) > 1
    assert all("(truenorth." in line for line in rules)
