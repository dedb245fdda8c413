"""``estimate --against-processor``: the rule of a processor, its work counted in plain loops, and who takes less."""

from dataclasses import replace

import numpy as np
import pytest
from commands import as_json, run

from spikeloom.compiler.counters import BLOCK
from spikeloom.models.recordings.grasps import synthetic_split
from spikeloom.runtime.studies import processor


def test_operations_and_decisions_are_those_of_a_plain_program(monkeypatch):
    monkeypatch.setattr(processor, "PLANS", (((1, 4), 1), ((1, 2), 5)))
    training, test = synthetic_split("train", limit=90), synthetic_split("test", limit=20)
    rule, plan, validation = processor._rule(training, 4)
    assert validation > 0.8
    assert np.abs(rule.weight).max() <= 7
    classes, added, adds, decided = 6, 0, 0, []
    length = -(-rule.steps // plan.parts)
    rows = {tuple(key): weight for key, weight in zip(rule.counter.tolist(), rule.weight.T, strict=True)}
    for recording in test.events.reshape(len(test), -1, test.steps):
        sums, counts = np.zeros(classes, np.int64), {}
        for step, channel in np.argwhere(recording.T).tolist():
            counts[channel, step // length] = seen = counts.get((channel, step // length), 0) + 1
            adds += 2
            for threshold in plan.thresholds:
                again = seen >= threshold and (seen - threshold) % (threshold + BLOCK) == 0
                if again and (channel, step // length, threshold) in rows:
                    sums += rows[channel, step // length, threshold]
                    added += classes
        decided.append(int(sums.argmax()))
    price = processor.Price(
        synaptic_operations=np.ones(1),
        energy_j={},
        time_s={"clock": np.array([1e-3])},
        step_s={},
        dynamic_j={"one": np.array([2e-6]), "two": np.array([3e-6])},
        static_w={"one": 0.1, "two": 0.03},
        outcome=None,
    )
    found = processor.against_processor(training, test, 4, 0.02, price, np.ones(20, np.bool_))
    assert (found.chip.correct, found.processor.correct) == (20, np.count_nonzero(decided == test.labels))
    assert found.work.operations * 20 == pytest.approx(adds + added + 20 * classes)
    assert found.work.cycles * 20 == pytest.approx(12 * adds / 2 + 8 * (added + 20 * classes))
    assert found.work.most_j == pytest.approx(300e-12 * found.work.cycles)
    assert found.work.least_j == pytest.approx(1e-12 * (0.1 * found.work.operations + 10 * found.work.accesses))
    assert (found.seconds, found.chip.static_w, found.chip.dynamic_j) == (2.0, (0.03, 0.1), (2e-6, 3e-6))
    assert found.chip.pace_j == pytest.approx((0.060002, 0.200003))
    assert found.processor.pace_j == pytest.approx((7.2e-6 + found.work.least_j, 14.4e-3 + found.work.most_j))
    gain = (found.work.most_j - 2e-6) / found.events
    assert found.break_even == pytest.approx((0.03 - 7.2e-3) / gain)
    assert found.verdict.startswith("a microcontroller is cheaper at the sensor's pace: 4 to ")
    dear = {"one": np.array([1.0])}  # each event takes more on the chip, by any price
    assert (
        processor.against_processor(
            training, test, 4, 0.02, replace(price, dynamic_j=dear), np.ones(20, np.bool_)
        ).break_even
        is None
    )
    free = replace(price, static_w={"none": 0.0})
    found = processor.against_processor(training, test, 4, 0.02, free, np.ones(20, np.bool_))
    assert (found.break_even, found.verdict[:19]) == (0.0, "the chip is cheaper")
    assert "depends" in processor._verdict(replace(found.chip, pace_j=(0.0, 1.0)), found.processor)


def test_the_option(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(processor, "PLANS", (((1, 4), 1),))
    run("compile", "pretrained:grasps", "-o", "net.loom")
    words = ("estimate", "net.loom", "--data", "synthetic", "--limit", "12", "--window", "50%")
    found = as_json(*words, "--against-processor")["against_processor"]
    assert (found["samples"], found["plan"]["bits"], found["seconds"]) == (12, 8, 1.0)
    assert all(price["source"] for price in found["prices"].values())
    text = run(*words, "--against-processor")[1]
    assert "a microcontroller is cheaper at the sensor's pace" in text
    assert "break-even: at no event rate" in text
    assert "static power dominates" in run(*words)[1]
    assert "against_processor" not in as_json(*words)
