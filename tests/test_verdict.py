"""What a verdict says: levels, gates, ways to fail by name, and whether a netlist is its checkpoint, rounded."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import events, recorded, small_checkpoint, weights
from scipy import stats

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.equivalence.breakdowns import breakdowns
from spikeloom.runtime.equivalence.verdict import (
    LayerSpikes,
    Level,
    ModelSpikes,
    Verdict,
    in_a_sentence,
    mcnemar,
    parse_requirements,
    spike_agreement,
    unmet,
)
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.machines.netlist_check import NetlistCheck


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
        "spec_different": 0,
        "target": "loihi1",
        "membranes_saturated": None,
        "model": None,
        "engine": "spikeloom",
        "engine_different": None,
        "row_different": None,
        "netlist": NetlistCheck(),
    }
    return Verdict(**(base | changes))


def lowered(different: int):
    return {"model": {"conv1": ModelSpikes(spikes=9, different=different)}}


def test_levels_without_a_float_model():
    alone = verdict(
        **lowered(0), float_predictions=None, float_counts=None, spikes={}, required={"E0": 1, "E1": 1}
    )
    assert [level.share for level in alone.levels] == [1, 1, 1, None, None]
    assert (alone.accuracy, alone.decision_agreement, alone.missed) == ({"chip": 0.75}, None, ())
    assert "every spike of its model and is right on 3 of 4 recordings" in in_a_sentence(alone)


def test_levels_of_a_verdict():
    for changes, e0, e1 in (
        ({}, 1.0, None),
        ({"spec_different": 2}, 0.0, None),
        ({"engine_different": 1}, 0.0, None),
        (lowered(3), 1, 0),
        (lowered(0), 1, 1),
        (lowered(0) | {"membranes_saturated": 1}, 1, 0),
    ):
        levels = {level.name: level.share for level in verdict(**changes).levels}
        assert levels == {"EN": 1.0, "E0": e0, "E1": e1, "E2": 0.8, "E3": 0.5}
    text = verdict().levels[4].text
    assert "right on float only 1, on chip only 1 (exact McNemar p = 1); class votes moved: 8 of 13" in text
    silent, disjoint = layer(0, 0, 0), layer(5, 5, 10)
    assert (spike_agreement(silent), spike_agreement(disjoint)) == (1.0, 0.0)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=30))
def test_the_paired_test_is_the_binomial_one_of_scipy(pairs):
    labels = np.zeros(len(pairs), int)
    first, second = (np.array([not pair[i] for pair in pairs], int) for i in (0, 1))
    a, b, p = mcnemar(labels, first, second)
    assert (a, b) == (pairs.count((True, False)), pairs.count((False, True)))
    assert p == pytest.approx(stats.binomtest(a, a + b).pvalue if a + b else 1)


def test_requirements_are_read_and_held_against_levels():
    assert parse_requirements("E0,E1,E2=0.99,E3=1") == {"E0": 1.0, "E1": 1.0, "E2": 0.99, "E3": 1.0}
    levels = (Level(name="E1", share=None, text="not applicable"), Level(name="E2", share=0.98, text=""))
    assert unmet(levels, {"E1": 1.0, "E2": 0.99}) == [
        "E1: not applicable",
        "E2: 0.9800 reached, 0.99 required",
    ]
    assert unmet(levels, {"E2": 0.98}) == []
    assert unmet(levels, {}) == []


@pytest.mark.parametrize(
    ("words", "why"),
    [
        *((words, "give each of EN, E0, E1, E2=SHARE, E3=SHARE once at most") for words in ("E4", "E0,E0")),
        ("E2", "needs a share, as in E2=0.98"),
        ("E0=1", "takes no share"),
        *((f"E3={share}", "give a number from 0 to 1") for share in ("2", "nan")),
    ],
)
def test_gates_that_cannot_be_read(words, why):
    with pytest.raises(OptionError, match=f"^--require {words}: '{words.split(',')[-1]}': .*{why}"):
        parse_requirements(words)


FILES = tuple("abcdef")


def found(before, after, *, votes=None):
    """Breakdowns of one layer ``fc`` whose neurons 0 and 2 to 4 are compared."""
    votes = votes or (np.array([[3, 1], [1, 3]]), np.array([[3, 1], [1, 3]]))
    compared = [np.array([0, 2, 3, 4])]
    made = breakdowns(["fc"], [before], [after], compared, votes, FILES[: len(votes[0])])
    return [(b.kind, b.layer, b.count, b.text) for b in made]


def spikes(*counts):
    """Of each of the four, over all recordings."""
    return np.array([*counts, *[0] * (4 - len(counts))])


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ((20, 0, 3, 1), (20, 0, 3, 1), []),
        ((9, 0, 5, 0), (), [("silent layer", "fc", 14)]),
        ((9,), (), []),  # too few to speak of
        ((11, 9, 20, 0), (0, 0, 0, 10), [("silenced neurons", "fc", 2), ("woken neurons", "fc", 1)]),
    ],
)
def test_neurons_that_fall_silent_or_wake_up(before, after, expected):
    made = found(spikes(*before), spikes(*after))
    assert [breakdown[:3] for breakdown in made] == expected
    if len(made) == 2:  # neurons by their numbers in the layer, the busiest first
        assert made[0][3].endswith(": 3 (20 times), 0 (11 times)")
        assert made[1][3].endswith(": 4 (10 times)")


VOTED = np.array([[3, 1], [1, 3], [0, 2], [2, 0]])


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (VOTED[:3], [[1, 2], [1, 3], [0, 2]], [("one class", None, 3)]),
        (VOTED[1:3], VOTED[1:3], []),  # as the float model does
        (VOTED, [[0, 0], [1, 3], [0, 2], [2, 2]], [("no vote", None, 1), ("tied votes", None, 1)]),
    ],
)
def test_votes_that_decide_little(before, after, expected):
    made = found(spikes(), spikes(), votes=(before, np.array(after)))
    assert [breakdown[:3] for breakdown in made] == expected
    assert len(made) < 2 or (made[0][3].endswith("(a)") and made[1][3].endswith("(d)"))


def verified(folder, arrays, recordings, packing, **options):
    checkpoint, adjacency = small_checkpoint(folder, last=arrays)
    netlist = compile_network(
        expand(checkpoint, adjacency), Options(storage=Fixed((packing,)), **options)
    ).netlist
    made = verify(netlist, expand(checkpoint, adjacency), recorded(recordings))
    return {breakdown.kind: breakdown for breakdown in made.breakdowns}


@pytest.mark.parametrize("bits", [4, 8])
def test_a_neuron_that_fires_by_a_hair_from_its_bias_alone(tmp_path, bits):
    """Bias 0.400005 ends at 0.500006, above the threshold: eight bits find a scale that keeps it, four do not."""
    arrays = weights()
    arrays["fc2.weight"][3], arrays["fc2.bias"][3] = 0, 0.400005
    recordings = events(2, steps=60)
    kinds = verified(
        tmp_path, arrays, recordings, Packing(bits=bits), keep_all=True, training_events=events(1)
    )
    assert ("silenced neurons" in kinds) == (bits == 4)
    assert bits == 8 or "fc2 neurons that fire in the float model" in kinds["silenced neurons"].text


def test_a_network_that_rounding_silences(tmp_path):
    """A weight that never sees a spike sets the scale; at two bits nothing is left beside it."""
    arrays = weights()
    arrays["fc3.weight"][:, 0] = 60.0
    arrays["fc2.weight"][0], arrays["fc2.bias"][0] = 0, 0
    kinds = verified(tmp_path, arrays, events(2), Packing(bits=2), keep_all=True)
    assert kinds["silent layer"].layer == "fc3"
    assert kinds["no vote"].count == 6
