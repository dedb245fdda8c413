"""``estimate --against-processor``: the rule of a processor, its work counted in plain loops, and who takes less."""

from dataclasses import replace

import numpy as np
import pytest
from commands import as_json, run
from oracles import refused

from spikeloom.compiler.counters import BLOCK
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.grasps import synthetic_split
from spikeloom.runtime.commands.main_job import estimate
from spikeloom.runtime.requests.main_job import EstimateRequest
from spikeloom.runtime.studies import processor

PRICE = processor.Price(
    synaptic_operations=np.ones(1),
    energy_j={},
    time_s={"clock": np.array([1e-3])},
    step_s={},
    dynamic_j={"one": np.array([2e-6]), "two": np.array([3e-6])},
    static_w={"one": 0.1, "two": 0.03},
    outcome=None,
)


def test_operations_and_decisions_are_those_of_a_plain_program(monkeypatch):
    monkeypatch.setattr(processor, "PLANS", (((1, 4), 1), ((1, 2), 5)))
    training, test = synthetic_split("train", limit=90), synthetic_split("test", limit=20)
    chosen = processor._rule(training, 4)
    rule, plan = chosen.counters, chosen.plan
    assert (chosen.right.mean() > 0.8, np.abs(rule.weight).max()) == (True, 7)
    added, adds, decided, length = 0, 0, [], -(-rule.steps // plan.parts)
    rows = dict(zip(map(tuple, rule.counter.tolist()), rule.weight.T, strict=True))
    for recording in test.events.reshape(len(test), -1, test.steps):
        sums, counts = np.zeros(6, np.int64), dict.fromkeys(np.ndindex(len(recording), plan.parts), 0)
        for step, channel in np.argwhere(recording.T).tolist():
            counts[channel, step // length] += 1
            adds += 2
            for threshold in plan.thresholds:
                over = counts[channel, step // length] - threshold
                row = rows.get((channel, step // length, threshold))
                if row is not None and over >= 0 and over % (threshold + BLOCK) == 0:
                    sums += row
                    added += 6
        decided.append(int(sums.argmax()))

    def against(price):
        return processor.against_processor(training, test, 4, 0.02, price, np.ones(20, np.bool_))

    bare = replace(test, held=np.zeros_like(test.events))
    refused(DataError, "no events", processor.against_processor, training, bare, 4, 0.02, PRICE, None)
    monkeypatch.setattr(processor, "PLANS", (((1, 4), 1), ((1, 2), 10)))
    assert processor._rule(joined_bins(training, 4), 4).plan.parts == 1  # of 25 steps ten parts have none
    monkeypatch.setattr(processor, "PLANS", (((1, 4), 1), ((1, 2), 5)))

    found = against(PRICE)
    work, chip, small = found.work, found.chip, found.processor
    assert (chip.correct, small.correct) == (20, np.count_nonzero(decided == test.labels))
    assert work.operations * 20 == pytest.approx(adds + added + 120)
    assert work.cycles * 20 == pytest.approx(12 * adds / 2 + 8 * (added + 120))
    assert work.most_j == pytest.approx(300e-12 * work.cycles)
    assert work.least_j == pytest.approx(1e-12 * (0.1 * work.operations + 10 * work.accesses))
    assert (found.seconds, chip.static_w, chip.dynamic_j) == (2.0, (0.03, 0.1), (2e-6, 3e-6))
    assert (*chip.pace_j, chip.events_per_s) == pytest.approx((0.060002, 0.200003, 1e3 * found.events))
    assert small.pace_j == pytest.approx((7.2e-6 + work.least_j, 14.4e-3 + work.most_j))
    assert found.break_even == pytest.approx((0.03 - 7.2e-3) / (work.most_j - 2e-6) * found.events)
    assert found.verdict.startswith("a microcontroller is cheaper at the sensor's pace: 4 to ")
    assert against(replace(PRICE, dynamic_j={"one": np.array([1.0])})).break_even is None
    free = against(replace(PRICE, static_w={"none": 0.0}))
    assert (free.break_even, free.verdict[:19]) == (0.0, "the chip is cheaper")
    assert "depends" in processor._verdict(replace(chip, pace_j=(0.0, 1.0)), small)


def test_the_option(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(processor, "PLANS", (((1, 4), 1),))
    run("compile", "pretrained:grasps", "-o", "net.loom")
    words = ("estimate", "net.loom", "--data", "synthetic", "--limit", "12", "--window", "50%")
    found = as_json(*words, "--against-processor")["against_processor"]
    assert (found["samples"], found["plan"]["bits"], found["seconds"]) == (12, 8, 1.0)
    assert all(price["source"] for price in found["prices"].values())
    text = run(*words, "--against-processor")[1]
    for telling in (
        "a microcontroller is cheaper at the sensor's pace",
        "at no event rate",
        "static power dominates",
    ):
        assert telling in text
    metrics = as_json(*words, "--neurobench")
    assert (
        0
        < metrics["neurobench"]["synaptic_operations"]["Effective_ACs"]
        <= metrics["per_inference"]["synaptic_operations"]
    )
    assert metrics.keys() - as_json(*words).keys() == {"neurobench"}
    request = EstimateRequest(
        netlist="net.loom", data=synthetic_split("test", limit=12), against_processor=True
    )
    refused(OptionError, "needs the training split", estimate.run, request)
