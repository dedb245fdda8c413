"""Known ways to fail must be said by name."""

import numpy as np
import pytest
from made_files import CLASSES, events, small_checkpoint, weights

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.passes.expand import expand
from spikeloom.runtime import cli
from spikeloom.runtime.equivalence.breakdowns import breakdowns
from spikeloom.runtime.equivalence.sections import sections
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal

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


# --- networks ---------------------------------------------------------------------------------------------------------


def verified(folder, arrays, recordings, packing, **options):
    checkpoint, adjacency = small_checkpoint(folder, last=arrays)
    netlist = compile_network(expand(checkpoint, adjacency), Options(packings=(packing,), **options)).netlist
    verdict = verify(netlist, checkpoint, adjacency, recordings, LABELS, FILES)
    return {breakdown["kind"]: breakdown for breakdown in encode(verdict)["breakdowns"]}, terminal(sections(verdict))


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
    assert kinds["silent layer"]["layer"] == "fc3"
    assert kinds["no vote"]["count"] == 6
    assert "breakdown: fc3 never fires on the chip; it fires " in text
    assert "breakdown: without a single vote, so class 0 by rule: 6 of 6 recordings (a, b, c and 3 more)" in text


def test_an_outlier_that_eats_the_scale(tmp_path, capsys):
    arrays = weights()
    arrays["fc1.weight"][0, 0] = 400.0
    small_checkpoint(tmp_path, last=arrays)
    assert cli.main(["compile", str(tmp_path / "small.pt"), "-o", str(tmp_path / "net.loom")]) == 0
    out = capsys.readouterr().out
    assert "fc1: 100 % of its weights round to zero; more --planes, --scale-groups or --weight-bits keep them" in out
    words = ["compile", str(tmp_path / "small.pt"), "--planes", "2", "-o", str(tmp_path / "net.loom")]
    assert cli.main(words) == 0
    assert "round to zero" not in capsys.readouterr().out
