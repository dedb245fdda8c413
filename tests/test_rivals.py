"""The benchmark's workload: our netlist, the plain references and the rivals' runners must agree."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from random_netlists import Axon, Neuron, build

from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX
from spikeloom.runtime.machines.loihi1.engine import prepare, simulate
from spikeloom.runtime.machines.loihi1.trace import aligned

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture(scope="module")
def module():
    """Import a benchmark by its name, as one that is run as a script finds its neighbours."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module


@pytest.fixture(scope="module")
def workload(module):
    return module("workload")


@pytest.fixture(scope="module")
def busy(workload):
    """The busy network on random events: events, its layers in weight units, its netlist."""
    events = np.random.default_rng(5).random((6, 12, 78)) < 0.13
    layers = workload.build_chain(events)
    return events, layers, workload.place_chain(layers, taxels=39)


def channels_first(events):
    return np.ascontiguousarray(events.transpose(0, 2, 1)).view(np.uint8)


def test_recurrence_by_hand(workload):
    # 100 stays; 100 * 819 / 4096 = 19 and 82 are 101: spike, zero; -7 decays to -1, toward zero
    current = np.array([[[100], [82], [-7], [101], [101]]])
    assert workload.recurrence(current, 100)[0, :, 0].tolist() == [False, True, False, False, True]


def test_busy_weights_are_the_documented_ones(workload):
    weights = workload.random_weights()
    assert [w.shape for w in weights] == [(2496, 78), (128, 2496), (256, 128), (36, 256)]
    assert np.count_nonzero(weights[0]) == 84_207  # pairs of taxels within three hops, but for weights that round to 0
    assert max(np.abs(w).max() for w in weights) == 127
    for w in weights:
        assert max(np.maximum(w, 0).sum(axis=1).max(), np.maximum(-w, 0).sum(axis=1).max()) <= ONE_STEP_SUM_MAX


def test_busy_thresholds_keep_to_the_rates(workload, busy):
    events, layers, _ = busy
    spikes = workload.reference(workload.chain_of(workload.place_chain(layers, taxels=39)), events)
    for found, rate in zip(spikes, workload.RATES, strict=True):
        assert 0 < found.mean() <= rate


def test_the_netlist_holds_the_chain(workload, busy):
    _, layers, netlist = busy
    for stage, (weight, bias, threshold) in zip(workload.chain_of(netlist), layers, strict=True):
        assert np.array_equal(stage.weight, weight)
        assert np.array_equal(stage.bias, bias * 64)
        assert np.all(stage.threshold == threshold * 64)


def test_our_spikes_are_those_of_the_reference(workload, busy):
    events, _, netlist = busy
    trace = simulate(netlist, channels_first(events), threads=1, spikes=True)
    for layer, expected in enumerate(workload.reference(workload.chain_of(netlist), events)):
        assert expected.any()
        assert np.array_equal(aligned(netlist, trace.spikes, layer), expected)


def test_our_spikes_without_windows_are_those_of_the_pipelined_reference(workload, busy):
    events, _, netlist = busy
    events = np.concatenate([events, np.zeros_like(events[:, :4])], axis=1)
    trace = simulate(prepare(netlist, gated=False), channels_first(events), threads=1, spikes=True)
    for layer, expected in enumerate(workload.reference(workload.chain_of(netlist), events, delay=1)):
        assert np.array_equal(trace.spikes[:, :, netlist.compartments_of(layer)], expected)


@pytest.mark.parametrize(
    ("neurons", "message"),
    [
        ([Neuron(decay_v=2048)], r"decays other than 0\.2 are not given to the rivals"),
        ([Neuron(), Neuron(layer=1)], r"layer1: listens to another layer than the one before"),
    ],
)
def test_other_networks_are_refused(workload, neurons, message):
    axons = [Axon(source=0, targets=((0, 2),)), Axon(source=0, targets=((len(neurons) - 1, 2),))]
    netlist = build(neurons, axons, n_inputs=1, depths=[0, 1][: len(neurons)])
    with pytest.raises(ValueError, match=f"^{message}$"):
        workload.chain_of(netlist)


def test_typical_recordings_are_those_near_the_average(workload):
    events = np.zeros((4, 10, 10), np.bool_)
    for recording, amount in zip(events, (0, 30, 50, 100), strict=True):
        recording.flat[:amount] = True
    assert workload.typical(events, 2).tolist() == [2, 1]  # the average is 45


@pytest.fixture(scope="module")
def task(module, workload, busy, tmp_path_factory):
    """What the workers read."""
    events, _, netlist = busy
    path = tmp_path_factory.mktemp("rivals") / "task.npz"
    module("rivals").write_task(path, netlist, events, workload.typical(events, 2))
    return module("worker").read_task(str(path))


@pytest.mark.parametrize("share", ["all", "few"])
@pytest.mark.parametrize("mode", ["spikes", "totals", "counts", "cycle"])
def test_our_runner_agrees_in_every_mode(module, task, mode, share):
    job = module("rival_ours").prepare_job(task, [mode, share])
    assert job.recordings == (6 if share == "all" else 2)
    assert job.differing([job.run(unit) for unit in range(job.units)]) == [0, 0, 0, 0]


def test_our_runner_says_what_it_lacks(module, task):
    with pytest.raises(module("worker").UnfitError, match=r"^there is no mode fastest, only spikes, totals, "):
        module("rival_ours").prepare_job(task, ["fastest", "all"])


@pytest.mark.parametrize("share", ["all", "few"])
def test_the_runner_of_onnxruntime_agrees(module, task, share):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    job = module("rival_onnx").prepare_job(task, [share])
    assert job.differing([job.run(unit) for unit in range(job.units)]) == [0, 0, 0, 0]


def test_both_loops_of_torch_give_nearly_our_spikes(module, task):
    found = []
    for loop in ("layers", "steps"):
        job = module("rival_torch").prepare_job(task, [loop, "few"])
        found.append([job.run(unit) for unit in range(job.units)])
        spikes = sum(int(task.expected("aligned", layer).sum()) for layer in range(4))
        # decay 0.2 for 819/4096, and no truncation
        assert sum(job.differing(found[-1])) < 0.1 * spikes
    for by_layers, by_steps in zip(*found, strict=True):
        assert all(bool((a == b).all()) for a, b in zip(by_layers, by_steps, strict=True))


def test_workers_run_in_pairs_and_those_that_cannot_are_skipped(module, task):
    rivals = module("rivals")

    def entry(name, mode, against=""):
        return rivals.Entry(
            name=name, rival="ours", options=(mode, "few"), computes="", together=False, against=against
        )

    entries = [
        entry("ours", "spikes"),
        entry("rival", "totals", "spikes"),
        entry("odd", "fastest", "counts"),
    ]
    found = rivals.measure(task.path, entries, {}, rounds=1)
    assert found["odd"]["skipped"].startswith("there is no mode fastest")
    assert found["rival"]["against"] == "ours"
    assert found["ours"]["differing_spikes"] == found["rival"]["differing_spikes"] == [0, 0, 0, 0]
    assert [found[name]["laps"] for name in ("ours", "rival")] == [1, 1]
    assert 0 < found["rival"]["ratio"]["min"] <= found["rival"]["ratio"]["median"] <= found["rival"]["ratio"]["max"]
    assert found["rival"]["peak_mb"] > 1
    assert "odd: skipped, there is no mode fastest" in rivals.text(
        "tiny",
        {"compartments": 1, "synapses": 1, "steps": 1, "activity": [0.1], "synaptic_operations": 1, "entries": found},
    )


def test_a_rival_that_cannot_start_says_why(module, task):
    rivals = module("rivals")
    entry = rivals.Entry(name="gone", rival="missing", options=(), computes="", together=False)
    said = rivals.measure(task.path, [entry], {}, rounds=1)["gone"]["skipped"]
    assert said.startswith("it ended: ")
    assert "rival_missing.py" in said


def test_charts_are_drawn_the_same_twice(module, tmp_path):
    spread = {"min": 0.4, "median": 0.5, "max": 0.7}
    entries = {
        "spikeloom spikes": {"cpu_ms": spread},
        "other": {"cpu_ms": spread, "ratio": spread},
        "no": {"skipped": ""},
    }
    growth = {name: [{"ms": 1, "threads": n, "steps": n, "synapses": n, "input_density": n} for n in (1, 2)]
              for name in ("activity", "steps", "synapses", "threads")}  # fmt: skip
    for stem in ("first", "second"):
        module("rivals_chart").draw(
            {"workloads": {"tiny": {"synaptic_operations": 5e6, "entries": entries}}}, str(tmp_path / stem)
        )
        module("growth_chart").draw(growth, str(tmp_path / stem))
    drawn = sorted(path.name for path in tmp_path.glob("first*"))
    assert len(drawn) == 10
    for name in drawn:
        assert (tmp_path / name).read_bytes() == (tmp_path / name.replace("first", "second")).read_bytes()


def test_a_wrong_spike_is_found(task):
    spikes = [task.expected("aligned", layer).copy() for layer in range(4)]
    spikes[2][1, 3, 4] ^= True
    assert task.differing("aligned", spikes) == [0, 0, 1, 0]


def test_weights_are_split_into_mantissas_and_a_power_of_two(module):
    worker = module("worker")
    none = np.zeros(1, np.int64)

    def layer(*weights, threshold=none):
        return worker.Layer(weight=np.array([weights]), bias=none, threshold=threshold, core=none, dense=True)

    small, unit = layer(-32, 96, 0).mantissas()
    assert (small.tolist(), unit) == ([[-1, 3, 0]], 32)
    with pytest.raises(worker.UnfitError, match=r"^its weights take more than 8 bits$"):
        layer(129, 2).mantissas()
    with pytest.raises(worker.UnfitError, match=r"^its thresholds differ within a layer$"):
        layer(1, threshold=np.array([64, 128])).common_threshold()
