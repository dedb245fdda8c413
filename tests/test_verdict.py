"""What a verdict says: levels, the paired test, gates, and known ways to fail by name."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import CLASSES, events, own_file, recordings_folder, small_checkpoint, weights

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.passes.expand import expand
from spikeloom.runtime.cli import main
from spikeloom.runtime.equivalence.breakdowns import breakdowns
from spikeloom.runtime.equivalence.sections import sections
from spikeloom.runtime.equivalence.verdict import (
    LayerSpikes,
    Level,
    levels_of,
    mcnemar,
    parse_requirements,
    spike_agreement,
    unmet,
)
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.report.sections import terminal

# -- levels ------------------------------------------------------------------------------------------------------------


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


# -- breakdowns --------------------------------------------------------------------------------------------------------

FILES = tuple("abcdef")
LABELS = np.arange(6) % CLASSES


def found(before, after, *, votes=None, recordings=None, lengths=None):
    """Breakdowns of one layer ``fc`` whose neurons 0 and 2 to 4 are compared."""
    votes = votes or (np.array([[3, 1], [1, 3]]), np.array([[3, 1], [1, 3]]))
    recordings = np.ones((len(votes[0]), 4, 10), np.uint8) if recordings is None else recordings
    compared = [np.array([0, 2, 3, 4])]
    made = breakdowns(["fc"], [before], [after], compared, votes, recordings, FILES[: len(votes[0])], lengths)
    return [(b.kind, b.layer, b.count, b.text) for b in made]


def spikes(*counts):
    made = np.zeros((2, 20, 4), bool)
    for neuron, count in enumerate(counts):
        made[0, :count, neuron] = True
    return made


def test_equal_networks_have_none():
    assert found(spikes(20, 0, 3, 1), spikes(20, 0, 3, 1)) == []


def test_a_silent_layer():
    expected = ("silent layer", "fc", 14, "fc never fires on the chip; it fires 14 times in the float model")
    assert found(spikes(9, 0, 5, 0), spikes()) == [expected]
    assert found(spikes(9), spikes()) == []  # too few to speak of


def test_neurons_that_fall_silent_or_wake_up():
    first = "fc neurons that fire in the float model and never on the chip: 3 (20 times), 0 (11 times)"
    second = "fc neurons that fire on the chip and never in the float model: 4 (10 times)"
    assert found(spikes(11, 9, 20, 0), spikes(0, 0, 0, 10)) == [
        ("silenced neurons", "fc", 2, first),
        ("woken neurons", "fc", 1, second),
    ]


def test_one_class_for_all():
    votes = np.array([[3, 1], [1, 3], [0, 2]]), np.array([[1, 2], [1, 3], [0, 2]])
    text = "the chip decides class 1 for every recording, the float model 2 classes"
    assert found(spikes(), spikes(), votes=votes) == [("one class", None, 3, text)]
    assert found(spikes(), spikes(), votes=(votes[1], votes[1])) == []  # as the float model does


def test_votes_that_decide_nothing():
    votes = np.array([[3, 1], [1, 3], [0, 2], [2, 0]]), np.array([[0, 0], [1, 3], [0, 2], [2, 2]])
    assert found(spikes(), spikes(), votes=votes) == [
        ("no vote", None, 1, "without a single vote, so class 0 by rule: 1 of 4 recordings (a)"),
        ("tied votes", None, 1, "decided among equal votes, the first class taken: 1 of 4 recordings (d)"),
    ]


def test_nearly_empty_recordings():
    votes = (np.array([[3, 1]] * 5), np.array([[3, 1]] * 4 + [[1, 3]]))
    recordings = np.zeros((5, 10, 200), np.uint8)
    recordings[:, 0, 0] = 1  # one event in two thousand entries
    text = "events in less than 0.1 % of all entries, decided equally 4 times: 5 of 5 recordings (a, b, c and 2 more)"
    assert found(spikes(), spikes(), votes=votes, recordings=recordings) == [("nearly empty", None, 5, text)]
    assert found(spikes(), spikes(), votes=votes, recordings=recordings, lengths=np.full(5, 100)) == []


def verified(folder, arrays, recordings, packing, **options):
    checkpoint, adjacency = small_checkpoint(folder, last=arrays)
    netlist = compile_network(expand(checkpoint, adjacency), Options(packings=(packing,), **options)).netlist
    made = verify(netlist, checkpoint, adjacency, recordings, LABELS, FILES)
    return {breakdown.kind: breakdown for breakdown in made.breakdowns}, terminal(sections(made))


@pytest.mark.parametrize("bits", [4, 8])
def test_a_neuron_that_fires_by_a_hair_from_its_bias_alone(tmp_path, bits):
    """Bias 0.400005 ends at 0.500006, above the threshold: eight bits find a scale that keeps it, four do not."""
    arrays = weights()
    arrays["fc2.weight"][3], arrays["fc2.bias"][3] = 0, 0.400005
    recordings = events(2, steps=60)
    kinds, text = verified(tmp_path, arrays, recordings, Packing(bits=bits), keep_all=True, training_events=events(1))
    line = "breakdown: fc2 neurons that fire in the float model and never on the chip: 3 (42 times)"
    assert (line in text) == ("silenced neurons" in kinds) == (bits == 4)


def test_a_network_that_rounding_silences(tmp_path):
    """A weight that never sees a spike sets the scale; at two bits nothing is left beside it."""
    arrays = weights()
    arrays["fc3.weight"][:, 0] = 60.0
    arrays["fc2.weight"][0], arrays["fc2.bias"][0] = 0, 0
    kinds, text = verified(tmp_path, arrays, events(2), Packing(bits=2), keep_all=True)
    assert kinds["silent layer"].layer == "fc3"
    assert kinds["no vote"].count == 6
    assert "breakdown: fc3 never fires on the chip; it fires " in text
    assert "breakdown: without a single vote, so class 0 by rule: 6 of 6 recordings (a, b, c and 3 more)" in text


def test_an_outlier_that_eats_the_scale(tmp_path, capsys):
    arrays = weights()
    arrays["fc1.weight"][0, 0] = 400.0
    small_checkpoint(tmp_path, last=arrays)
    assert main(["compile", str(tmp_path / "small.pt"), "-o", str(tmp_path / "net.loom")]) == 0
    out = capsys.readouterr().out
    assert "fc1: 100 % of its weights round to zero; more --planes, --scale-groups or --weight-bits keep them" in out
    words = ["compile", str(tmp_path / "small.pt"), "--planes", "2", "-o", str(tmp_path / "net.loom")]
    assert main(words) == 0
    assert "round to zero" not in capsys.readouterr().out
