"""Levels of equivalence: shares, the paired test, gates and their messages."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import own_file, recordings_folder

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.cli import main
from spikeloom.runtime.equivalence.levels import levels_of, mcnemar, parse_requirements, spike_agreement, unmet
from spikeloom.runtime.equivalence.verdict import LayerSpikes, Level


def layer(float_: int, chip: int, different: int) -> LayerSpikes:
    return LayerSpikes(float=float_, chip=chip, different=different, ill_posed=0)


def verdict(**changes):
    base = {
        "files": ("a", "b", "c", "d"),
        "labels": np.array([0, 1, 1, 0]),
        "float_predictions": np.array([0, 1, 0, 0]),
        "chip_predictions": np.array([0, 1, 1, 1]),
        "float_counts": np.array([[3, 0], [1, 2], [2, 1], [4, 0]]),
        "chip_counts": np.array([[3, 0], [1, 3], [1, 2], [1, 2]]),
        "spikes": {"conv1": layer(60, 40, 20), "fc1": layer(10, 10, 1)},
        "spec_samples": 3,
        "spec_equals_engine": True,
        "decision_agreement": 0.5,
        "quantised_different": None,
        "engine": "spikeloom",
        "engine_different": None,
    }
    return SimpleNamespace(**(base | changes))


def test_levels_of_a_verdict():
    levels = {level.name: level for level in levels_of(verdict())}
    assert {name: level.share for name, level in levels.items()} == {"E0": 1.0, "E1": None, "E2": 0.8, "E3": 0.5}
    assert levels["E0"].text == "specification = engine in every spike, membrane and count of 3 recordings"
    further = levels_of(verdict(engine="onnx", engine_different=1234))[0].text
    assert further == f"{levels['E0'].text}; onnx beside it, 1,234 differing spikes on 4 recordings"
    assert levels["E2"].text == "spikes in common with the float model: conv1 80.00 %, fc1 95.00 %"
    assert levels["E3"].text == (
        "2 of 4 decisions equal; right on float only 1, on chip only 1 (exact McNemar p = 1); "
        "class votes moved: 8 of 13"
    )
    broken = levels_of(verdict(spec_equals_engine=False))[0]
    assert broken.share == 0.0
    assert "NOT in every spike" in broken.text


@pytest.mark.parametrize(("different", "share"), [(0, 1.0), (3, 0.0)])
def test_a_fine_tuned_model_is_the_chip_or_is_not(different, share):
    level = levels_of(verdict(quantised_different=different))[1]
    assert (level.name, level.share) == ("E1", share)
    assert level.text == f"fine-tuned model = chip: {different} differing spikes of 50 on 4 recordings"
    assert bool(unmet((level,), {"E1": 1.0})) == bool(different)


def test_silent_layers_agree_and_disjoint_ones_do_not():
    assert spike_agreement(layer(0, 0, 0)) == 1.0
    assert spike_agreement(layer(5, 5, 10)) == 0.0


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=30))
def test_the_paired_test_is_symmetric_and_a_probability(pairs):
    labels = np.zeros(len(pairs), int)
    first, second = (np.array([not pair[i] for pair in pairs], int) for i in (0, 1))
    a, b, p = mcnemar(labels, first, second)
    assert (b, a, p) == mcnemar(labels, second, first)
    assert 0 < p <= 1
    assert a == sum(x and not y for x, y in pairs)
    if a == b:
        assert p == 1


def test_the_paired_test_on_a_known_case():
    # 1 against 7 discordant pairs: 2 * (1 + 8) / 2**8
    labels = np.zeros(8, int)
    first = np.array([0] + [1] * 7)
    assert mcnemar(labels, first, 1 - first) == (1, 7, 18 / 256)


def test_requirements_are_read_and_held_against_levels():
    assert parse_requirements("E0,E1,E2=0.99,E3=1") == {"E0": 1.0, "E1": 1.0, "E2": 0.99, "E3": 1.0}
    levels = (Level(name="E1", share=None, text="not applicable"), Level(name="E2", share=0.98, text=""))
    assert unmet(levels, {"E1": 1.0, "E2": 0.99}) == ["E1: not applicable", "E2: 0.9800 reached, 0.99 required"]
    assert unmet(levels, {"E2": 0.98}) == []
    assert unmet(levels, {}) == []


@pytest.mark.parametrize(
    ("words", "why"),
    [
        *((words, "give each of E0, E1, E2=SHARE, E3=SHARE once at most") for words in ("E4", "E0,E0", "")),
        ("E2", "needs a share, as in E2=0.98"),
        ("E0=1", "takes no share"),
        *((f"E3={share}", "give a number from 0 to 1") for share in ("2", "much", "nan")),
    ],
)
def test_gates_that_cannot_be_read(words, why):
    with pytest.raises(OptionError, match=f"^--require {words}: '{words.split(',')[-1]}': .*{why}"):
        parse_requirements(words)


def test_gates_on_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    own_file(tmp_path / "net.pt")
    recordings_folder(tmp_path / "data")
    assert main(["compile", "net.pt", "-o", "x.loom"]) == 0
    words = ["verify", "x.loom", "--checkpoint", "net.pt", "--data", "data", "--json"]
    capsys.readouterr()
    for require, code in (("E0,E2=0.1,E3=0.5", 0), ("E1", 1), ("E2=1", 1)):
        assert main([*words, "--require", require]) == code
        report = json.loads(capsys.readouterr().out)
        assert bool(report["missed"]) == bool(code)
        assert [level["name"] for level in report["levels"]] == ["E0", "E1", "E2", "E3"]
