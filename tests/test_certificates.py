"""The file of certificates, and the program of its own that checks it: on both chips, and with errors planted in it."""

import ast
import io
import json
import shutil
import subprocess
import sys
import tokenize
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest
from commands import run
from made_files import events, recordings_folder
from random_crossbars import random_counters, without_idle
from test_stability import small_netlist
from zoo import MAKERS, over, specimen

from spikeloom.compiler.archive import archive_bytes, read_members
from spikeloom.compiler.formats.counters import counting_network
from spikeloom.compiler.targets.loihi1.netlist import write_netlist
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.truenorth.netlist import write_crossbars
from spikeloom.compiler.targets.truenorth.passes import compile_crossbars
from spikeloom.runtime.studies.robustness.proofs.entries import channels_of

CHECKER = Path(__file__).parents[1] / "examples" / "check_certificate.py"
ck = run_path(str(CHECKER))


def certified(folder, netlist, data, *options):
    code, _, err = run(
        "certify", netlist, "--data", data, "--certificate", folder / "cert", "--shift", "0", *options
    )
    assert code == 0, err
    return read_members(folder / "cert")


def checked(folder, netlist, members):
    """What the program says of a certificate of these members."""
    manifest = json.loads(str(members["manifest"]))
    arrays = {name: each for name, each in members.items() if name not in ("manifest", "sha256")}
    (folder / "planted").write_bytes(archive_bytes(manifest, arrays))
    words = [sys.executable, "-I", CHECKER, netlist, folder / "planted"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("name", ["check_certificate.py", "check_groups.py", "check_counts.py"])
def test_the_checker_needs_numpy_alone_and_is_short(name):
    text = CHECKER.with_name(name).read_text()
    tree = ast.parse(text)
    names = {
        name.split(".")[0]
        for node in ast.walk(tree)
        for name in (
            [each.name for each in node.names]
            if isinstance(node, ast.Import)
            else [node.module]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert names <= {*sys.stdlib_module_names, "numpy"}
    quiet = {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
    }
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = {
        line for each in tokens if each.type not in quiet for line in range(each.start[0], each.end[0] + 1)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            code -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    assert len(code) <= 300


@over(MAKERS)
def test_the_checker_runs_every_kind_of_network_as_the_engines_do(name):
    made = specimen(name)
    netlist = made.machine.netlist
    about, arrays = ck["load"](made.netlist)
    chip = {"loihi1": ck["Loihi"], "truenorth": ck["TrueNorth"]}[about["target"]](about, arrays)
    channels = channels_of(made.events, netlist)
    for one, votes in zip(channels, made.machine.votes(channels), strict=True):
        counts = ck["run"](chip, one > 0, np.zeros(one.shape, np.bool_), 0)[1]
        np.testing.assert_array_equal(counts.sum(axis=0), votes)


def test_certificates_of_several_events_hold_and_planted_errors_do_not(tmp_path):
    write_netlist(small_netlist(4), tmp_path / "net.loom")
    write_netlist(small_netlist(1), tmp_path / "other.loom")
    recordings_folder(tmp_path / "data", test=events(4, samples=2, steps=50, rate=0.1))
    good = certified(tmp_path, tmp_path / "net.loom", tmp_path / "data")
    assert set(good["rule"].tolist()) <= {2, 3}
    assert good["unaltered"].max() >= 2
    assert np.all(np.diff(good["change_bounds"]) > 0)
    assert set(good["pasts"][:, 1].tolist()) == {0, 1}
    code, said = checked(tmp_path, tmp_path / "net.loom", good)
    assert code == 0, said
    assert f"no {good['unaltered'][1]} events alter that" in said

    def planted(**changes):
        code, said = checked(tmp_path, tmp_path / "net.loom", good | changes)
        assert code == 1
        return said

    at_most = np.diff(good["change_bounds"])
    assert "that no" in planted(unaltered=at_most)  # which these changes do alter
    assert "rule 1 cannot" in planted(rule=np.ones_like(good["rule"]))
    assert "rule 7 cannot" in planted(rule=np.full_like(good["rule"], 7))
    assert "the decision" in planted(decision=1 - np.minimum(good["decision"], 1))
    fewer = {"changes": good["changes"][1:], "change_bounds": np.maximum(good["change_bounds"] - 1, 0)}
    assert "changes named" in planted(**fewer)
    assert "does not have" in planted(changes=good["changes"] * 0 + good["bins"].shape[0])
    for wrong in ([0, 0, 5], [3, 1, 2], [1, 2, 5], [1, 0, 50], [1, 0, -1]):
        assert "told apart" in planted(pasts=np.broadcast_to(wrong, good["pasts"].shape).astype(np.int64))
    without = {"pasts": good["pasts"][:0], "past_bounds": good["past_bounds"] * 0}
    assert "that no" in planted(**without)
    code, said = checked(tmp_path, tmp_path / "other.loom", good)
    assert code == 1
    assert "another netlist" in said
    older = json.dumps(json.loads(str(good["manifest"])) | {"version": 1})
    assert "version 1; this program checks 2, so certify again" in planted(manifest=older)
    alone = shutil.copy(CHECKER, tmp_path)
    words = [sys.executable, "-I", alone, tmp_path / "net.loom", tmp_path / "cert"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "not checked: check_groups.py is missing beside this program; copy it there\n"


@pytest.mark.parametrize("chip", ["loihi1", "truenorth"])
@pytest.mark.parametrize(("seed", "parts"), [(4, 1), (0, 2), (4, 2)])
def test_certificates_of_counters_hold_and_planted_errors_do_not(tmp_path, seed, parts, chip):
    counters = without_idle(random_counters(seed, taxels=2, parts=parts))
    if chip == "loihi1":
        write_netlist(compile_network(counting_network(counters)).netlist, tmp_path / "net.loom")
    else:
        write_crossbars(compile_crossbars(counters).netlist, tmp_path / "net.loom")
    test = events(seed, samples=3, taxels=2, steps=14, rate=0.25)
    recordings_folder(tmp_path / "data", test=test)
    good = certified(tmp_path, tmp_path / "net.loom", tmp_path / "data")
    code, said = checked(tmp_path, tmp_path / "net.loom", good)
    assert code == 0, said
    assert good["rule"].max() == 4
    assert good["unaltered"].max() >= 2
    fallen, by_counts = np.diff(good["change_bounds"]), {"rule": np.full_like(good["rule"], 4)}
    if fallen.any():  # by so many: the certificates are of the largest number that can be
        code, said = checked(tmp_path, tmp_path / "net.loom", good | by_counts | {"unaltered": fallen})
        assert code == 1
        assert "events alter the decision" in said
    elif chip == "loihi1":
        code, said = checked(tmp_path, tmp_path / "net.loom", good | {"unaltered": good["unaltered"] + 20})
        assert code == 1
        assert "no sum saturates" in said


@over(["tactilesgnet", "native"])
def test_numbers_of_events_are_believed_of_no_network_but_counters(tmp_path, name):
    made = specimen(name)
    good = certified(tmp_path, made.netlist, made.data, "--most", "1")
    planted = {"rule": np.full_like(good["rule"], 4), "unaltered": good["unaltered"] * 2}
    code, said = checked(tmp_path, made.netlist, good | planted)
    assert code == 1
    assert "counting network" in said or "one vote" in said
    if name == "native":
        code, said = checked(
            tmp_path, made.netlist, good | planted | {"rule": np.full_like(good["rule"], 2)}
        )
        assert code == 1
        assert "rule 2, which is for Loihi" in said


@over(["tactilesgnet", "counters", "native", "counters-crossbars"])
def test_certificates_of_single_events_are_checked_on_both_chips(tmp_path, name):
    made = specimen(name)
    good = certified(tmp_path, made.netlist, made.data, "--most", "1")
    code, said = checked(tmp_path, made.netlist, good)
    assert code == 0, said
    stable, fallen = good["unaltered"] > 0, np.diff(good["change_bounds"]) > 0
    assert np.all(stable != fallen)
    if fallen.any():
        each = {"rule": np.ones_like(good["rule"]), "unaltered": np.ones_like(good["unaltered"])}
        code, said = checked(tmp_path, made.netlist, good | each)
        assert code == 1
        assert "no single event" in said


def test_proofs_stand_against_all_inputs_of_random_networks(tmp_path, monkeypatch):
    script = CHECKER.parents[1] / "benchmarks" / "soundness.py"
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path / "found.json"), "--networks", "5"])
    run_path(str(script), run_name="__main__")
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["tried"] > 1000
    assert found["wrong"] == 0
    assert set(found["by_kind"]) == {"counters", "float model", "layers"}
