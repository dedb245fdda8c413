"""The Python interface and one name of ours; the main job on the released checkpoint and the real recordings."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from commands import as_json
from made_files import TAXELS
from oracles import refused
from torch import nn

import spikeloom as api
from spikeloom.compiler.errors import CapacityError, DataError, ModelError, OptionError
from spikeloom.runtime.report.encode import encode


@pytest.fixture(scope="module")
def data(place):
    return api.recordings(str(place / "data"))


@pytest.fixture(scope="module")
def net(place, data):
    return api.compile(str(place / "net.pt"), calibrate=data.train, weight_bits="4")


def test_recordings_are_there_and_show_as_one_line(data):
    assert repr(data.test).startswith("data, test: 6 recordings, 6 taxels, up to 24 steps")
    refused(DataError, "nowhere: no such folder or file", api.recordings, "nowhere")


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


def test_modules_come_in_as_they_are(data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = nn.Sequential(nn.Linear(2 * TAXELS, 5), api.LIF(), nn.Linear(5, 4), api.LIF())
    net = api.compile(module, example=torch.zeros(1, 2 * TAXELS))
    assert "E0  specification = engine" in str(net.verify(data.test, min_agreement=0.0))
    assert net.report("page.html", data).value.provenance.checkpoint.file == "module"
    refused(OptionError, "example=", api.compile, module)
    tuned = api.finetune(module, data, "tuned.nir", example=torch.zeros(1, 2 * TAXELS), epochs=1)
    assert tuned.verify(data.test, min_agreement=0.0).value.model_different == 0
    assert "written: tuned.nir, tuned.loom" in str(tuned)


def test_what_does_not_suit_is_refused(data, net):
    with pytest.raises(OptionError, match=r"wieght_bits: unknown option; allowed: .*weight_bits"):
        api.compile("pretrained:grasps", wieght_bits="4")
    assert len(net.run(data.test, limit=2).value.files) == 2
    refused(DataError, "has 39 taxels, the network has 6", net.run, api.recordings("synthetic").test)
    refused(OptionError, "data: ndarray found", net.run, data.test.events)
    refused(OptionError, "limit x: not a number of type int", lambda: net.run(data, limit="x"))
    refused(OptionError, "save none/x.loom: the folder does not exist", net.save, "none/x.loom")
    refused(OptionError, "save x.pt: has to end in .loom", net.save, "x.pt")
    module = nn.Sequential(nn.Linear(2 * TAXELS, 4), api.LIF())
    refused(OptionError, "give example=", lambda: api.compile(module, example="x"))
    refused(ModelError, "example of shape (1, 3)", lambda: api.compile(module, example=torch.zeros(1, 3)))
    example = torch.zeros(1, 2 * TAXELS)
    refused(CapacityError, "truenorth.neuron.", lambda: api.compile(module, example=example, target="truenorth"))


def test_values_of_python_are_those_of_the_words(place, data, net):
    network = str(place / "net.pt")
    assert api.compile(Path(network), calibrate=data, weight_bits=4).path.read_bytes() == net.path.read_bytes()
    assert api.compile(network, weight_bits=[8, 4, 4, 8]).path.read_bytes() == (
        api.compile(network, weight_bits="8,4,4,8").path.read_bytes()
    )
    assert str(net.run(data, limit="2")) == str(net.run(data.test, limit=2))


def test_the_module_lists_its_public_names():
    assert dir(api) == sorted(api.__all__)


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


@pytest.mark.recordings
def test_the_chip_is_within_one_sample_of_the_float_model(compiled, objects_zip, checkpoints):
    report = as_json("run", compiled[0], "--data", objects_zip)
    expected = json.loads((checkpoints / "objects_manual.expected.json").read_text())
    assert report["samples"] == 144
    assert (report["files"], report["labels"]) == (expected["files"], expected["labels"])
    right = sum(a == b for a, b in zip(report["predictions"], report["labels"], strict=True))
    assert abs(right - RIGHT) <= 1
    assert report["accuracy"] == right / 144
    agreeing = sum(a == b for a, b in zip(report["predictions"], expected["predictions"], strict=True))
    assert agreeing >= 0.95 * 144
