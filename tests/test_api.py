"""The Python interface and one name of ours; the main job on the released checkpoint and the real recordings."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import as_json
from made_files import TAXELS
from oracles import refused
from torch import nn

import spikeloom as api
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.runtime.report.encode import encode


@pytest.fixture(scope="module")
def data(place):
    return api.recordings(str(place / "data"))


@pytest.fixture(scope="module")
def net(place, data):
    return api.compile(str(place / "net.pt"), calibrate=data.train, weight_bits="4")


def test_results_are_those_of_the_commands(data, net, as_json):
    words = {
        "compile": ["net.pt", "--calibrate", "data", "--weight-bits", "4", "-o", "net.loom"],
        "verify": ["net.loom", "--checkpoint", "net.pt", "--data", "data"],
        "estimate": ["net.loom", "--data", "data"],
        "run": ["net.loom", "--data", "data"],
    }
    found = {name: getattr(net, name)(data.test) for name in ("verify", "estimate", "run")} | {"compile": net.result}
    for name, options in words.items():
        assert as_json(name, *options, codes=(0, 1)) == json.loads(json.dumps(encode(found[name].value)))
    net.save("copy.loom")
    assert Path("copy.loom").read_bytes() == Path("net.loom").read_bytes()
    again = api.load("copy.loom", network="net.pt")
    assert str(again.verify(data.test)) == str(found["verify"])
    refused(OptionError, "network=", api.load("copy.loom").verify, data.test)


def test_results_show_themselves(data, net):
    verdict = net.verify(data.test)
    assert str(verdict).startswith(repr(verdict).removesuffix("\n…"))
    assert repr(verdict).count("\n") <= 8
    assert "<table" in verdict._repr_html_()
    assert repr(net).startswith("loihi1: ")


def test_modules_come_in_as_they_are(data):
    module = nn.Sequential(nn.Linear(2 * TAXELS, 5), api.LIF(), nn.Linear(5, 4), api.LIF())
    net = api.compile(module, example=torch.zeros(1, 2 * TAXELS))
    assert "E0  specification = engine" in str(net.verify(data.test, min_agreement=0.0))
    refused(OptionError, "example=", api.compile, module)


def test_what_does_not_suit_is_refused(data, net):
    with pytest.raises(OptionError, match=r"wieght_bits: unknown option; allowed: .*weight_bits"):
        api.compile("pretrained:grasps", wieght_bits="4")
    assert len(net.run(data.test, limit=2).value.files) == 2
    refused(DataError, "has 39 taxels, the network has 6", net.run, api.recordings("synthetic").test)


def test_a_folder_of_the_same_name_is_in_nobodys_way(tmp_path):
    """Scripts in a project with packages ``models``, ``runtime`` and ``compiler`` of its own import both."""
    for name in ("models", "runtime", "compiler"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("OWN = True\n")
    code = (
        "import models, runtime, compiler, spikeloom\n"
        "net = spikeloom.compile('pretrained:grasps')\n"
        "assert models.OWN and runtime.OWN and compiler.OWN and 'spikeloom.models' in __import__('sys').modules"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)


def test_only_one_name_is_on_the_path():
    code = "import importlib.util as u, sys; sys.exit(any(map(u.find_spec, ('compiler', 'runtime', 'models'))))"
    assert subprocess.run([sys.executable, "-I", "-c", code], check=False).returncode == 0


RIGHT = 127  # of 144, by the released code's own outputs


@pytest.fixture(scope="module")
def compiled(tmp_path_factory, released_checkpoint, objects_zip) -> tuple[Path, dict]:
    """Netlist of the released checkpoint as a user compiles it, and what the command said."""
    path = tmp_path_factory.mktemp("objects") / "objects.loom"
    words = ["--graph", "manual", "--target", "loihi1", "--weight-bits", 8, "--calibrate", objects_zip, "-o", path]
    return path, as_json("compile", released_checkpoint, *words)


# -- the released checkpoint -------------------------------------------------------------------------------------------
@pytest.mark.recordings
def test_the_netlist_has_the_published_size(compiled):
    path, report = compiled
    layers = {layer["name"]: layer for layer in report["layers"]}
    assert list(layers) == ["conv1", "fc1", "fc2", "fc3"]
    assert [layer["neurons"] for layer in layers.values()] == [2496, 128, 256, 36]
    assert [layer["synapses"] for layer in layers.values()] == [97_920, 319_488, 32_768, 9_216]
    assert report["synapses"] == 459_392
    assert report["neurons"] == 2916
    assert report["cores"] <= 9
    assert report["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert all(limit["used"] <= limit["allowed"] for limit in report["limits"])
    assert all(proof["holds"] for proof in report["proofs"])


@pytest.mark.recordings
def test_the_chip_is_within_one_sample_of_the_float_model(compiled, objects_zip, shared_dir):
    report = as_json("run", compiled[0], "--data", objects_zip)
    expected = json.loads((shared_dir / "checkpoints" / "objects_manual.expected.json").read_text())
    assert report["samples"] == 144
    assert (report["files"], report["labels"]) == (expected["files"], expected["labels"])
    right = sum(a == b for a, b in zip(report["predictions"], report["labels"], strict=True))
    assert abs(right - RIGHT) <= 1
    assert report["accuracy"] == right / 144
    agreeing = sum(a == b for a, b in zip(report["predictions"], expected["predictions"], strict=True))
    assert agreeing >= 0.95 * 144


@pytest.mark.recordings
def test_verify_passes(compiled, released_checkpoint, objects_zip, shared_dir):
    words = ["--checkpoint", released_checkpoint, "--graph", "manual", "--data", objects_zip, "--limit", 16]
    report = as_json("verify", compiled[0], *words, "--spec-samples", 1)
    expected = json.loads((shared_dir / "checkpoints" / "objects_manual.expected.json").read_text())
    assert report["spec_equals_engine"] is True
    assert report["same_checkpoint"] is True
    right = np.equal(expected["predictions"][:16], expected["labels"][:16])
    assert report["accuracy"]["float"] == right.mean()
    assert report["decision_agreement"] >= 0.95
    ladder = {rung["stage"]: rung["different"] for rung in report["ladder"]}
    assert ladder["saturation"] == {name: layer["different"] for name, layer in report["spikes"].items()}
    # rounded weights cost what there is to lose; the realised decay is a hair beside them
    for name, layer in report["spikes"].items():
        assert ladder["beta"][name] < layer["different"] / 20
        assert 0.5 < ladder["weights"][name] / layer["different"] < 2
        assert layer["different"] < layer["float"]
    first = report["first_divergence"]
    assert first["file"] == expected["files"][0]
    assert (first["float_membrane"] > first["theta"]) != (first["chip_membrane"] > first["chip_theta"])


@pytest.mark.recordings
def test_the_shipped_network_of_longer_bins(tmp_path, objects_zip):
    """What its card says of it on the chip, at a fifth of what steps of 20 ms take."""
    netlist = tmp_path / "n.loom"
    as_json("compile", "pretrained:objects-200ms", "--weight-bits", 8, "--calibrate", objects_zip, "-o", netlist)
    report = as_json("run", netlist, "--data", objects_zip, "--detail", "counts")
    assert report["accuracy"] == 130 / 144
    assert report["costs"]["pace"]["bin_s"] == pytest.approx(0.2)
    mean = report["costs"]["per_inference"]
    assert 1.1e6 < mean["synaptic_operations"] < 1.2e6
    assert 30e-6 < mean["energy_j"]["davies2018"] < 36e-6
