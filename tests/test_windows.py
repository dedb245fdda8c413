"""The first part of recordings, and that nothing later reaches back."""

import numpy as np
import pytest
from made_files import CLASSES, STEPS, events, small_checkpoint

from spikeloom.compiler import compile_network
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import first_part, parse_window
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.machines.votes import class_counts, predictions


def made(lengths=None, *, samples=3, steps=10):
    return Recordings(
        events=events(samples=samples, steps=steps),
        labels=np.arange(samples),
        files=tuple("abcdefgh"[:samples]),
        split="test",
        source="made",
        lengths=lengths,
    )


def test_whole_steps_and_one_at_least():
    whole = made()
    for percent, steps in ((1, 1), (10, 1), (19, 1), (20, 2), (25, 2), (50, 5), (99, 9)):
        found = first_part(whole, percent)
        assert found.lengths is None
        np.testing.assert_array_equal(found.events, whole.events[..., :steps])
        assert (found.files, found.labels.tolist()) == (whole.files, whole.labels.tolist())
    assert first_part(whole, 100) is whole


def test_every_recording_keeps_its_part_of_its_own_length():
    found = first_part(made(np.array([10, 5, 1])), 50)
    assert found.lengths.tolist() == [5, 2, 1]
    assert found.steps == 5


@pytest.mark.parametrize(("words", "percent"), [("1%", 1), ("50", 50), (" 100% ", 100)])
def test_whole_per_cent(words, percent):
    assert parse_window(words) == percent


@pytest.mark.parametrize("words", ["0", "0%", "101%", "-5%", "12.5%", "half", "", "٣%", "50%%", "1000"])
def test_what_is_no_part(words):
    with pytest.raises(OptionError, match=r"give whole per cent from 1% to 100%$"):
        parse_window(words)


def test_the_chip_decides_a_part_as_it_does_when_more_follows(tmp_path):
    network = expand(*small_checkpoint(tmp_path))
    netlist = compile_network(network).netlist
    data = made(samples=8, steps=STEPS)
    whole = engine.simulate(netlist, with_clocks(data.events, netlist.clocks), spikes=True)
    last = aligned(netlist, whole.spikes, len(netlist.layers) - 1)
    for percent in (30, 50, 90):
        part = first_part(data, percent)
        counts = engine.simulate(netlist, with_clocks(part.events, netlist.clocks)).counts.spikes
        kept = last[:, : STEPS * percent // 100].sum(axis=1)
        assert kept.shape == (8, CLASSES)
        np.testing.assert_array_equal(class_counts(netlist, counts), kept)
        np.testing.assert_array_equal(predictions(netlist, counts), kept.argmax(axis=1))
