"""Networks that a Loihi was measured with: measured figures, and the predictions that they are held against."""

import hashlib
import importlib
import json
import zipfile
from pathlib import Path

import pytest

from spikeloom.compiler.targets.base import load_target

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def module(monkeypatch):
    """Import a benchmark by its name, as one that is run as a script finds its neighbours."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


@pytest.fixture
def stored():
    return {
        name: json.loads((BENCHMARKS / "results" / f"{name}.json").read_text())
        for name in ("silicon", "silicon-predictions")
    }


def test_what_chips_took_is_in_their_logs(module, power_logs, stored):
    silicon_measured = module("silicon_measured")
    with zipfile.ZipFile(power_logs) as archive:
        found = silicon_measured.measured(archive)
    told = silicon_measured.Predictions(stored["silicon-predictions"])
    wanted = stored["silicon"]
    assert hashlib.sha256(power_logs.read_bytes()).hexdigest() == wanted["data_sha256"]
    assert list(found) == list(wanted["measured"])
    for name, each in found.items():
        assert each["inference_j"] == pytest.approx(wanted["measured"][name]["inference_j"])
    for point, before in zip(silicon_measured.points(found, told), wanted["points"], strict=True):
        assert point["times"] == pytest.approx(before["times"])
    # a way of its own to the slope: from the ends of the line
    ends = [found[f"N={n}"]["inference_j"]["total"] for n in (1, 10)]
    assert wanted["points"][8]["measured"] == pytest.approx((ends[1] - ends[0]) / 9, rel=0.02)


def test_predictions_are_those_that_were_compared(stored):
    content = (BENCHMARKS / "results" / "silicon-predictions.json").read_bytes()
    assert hashlib.sha256(content).hexdigest() == stored["silicon"]["predictions_sha256"]


def test_an_estimate_says_what_was_measured(stored):
    line = load_target("loihi1").measured
    at = {point["name"]: point["times"] for point in stored["silicon"]["points"]}
    branch, braille, digits = (
        at[name] for name in ("a branch, an inference", "braille, a sample", "ntidigits, a sample")
    )
    assert f"took {branch['davies2018']:.1f} (davies2018) and {branch['sanafe']:.1f} (sanafe)" in line
    for each in (braille, digits):
        assert f"{each['davies2018']:.1f} and {each['sanafe']:.1f} times for" in line
    steps = [at[f"{name}, a step"]["sanafe"] for name in ("braille", "ntidigits")]
    assert f"{steps[0]:.1f} and {steps[1]:.1f} times these times" in line


def test_the_published_layout_takes_the_published_cores(module, braille_net):
    silicon = module("silicon")
    network, _ = silicon.integers_of(silicon.tree_of(braille_net))
    netlist = silicon.laid_out(network, silicon.FILES["braille"][2])
    assert netlist.n_cores == 52
    assert [layer.name for layer in netlist.layers] == ["input0", "recurrent2", "dense3"]
