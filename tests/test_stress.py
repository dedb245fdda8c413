"""The command ``stress``: runs, rules, tables, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import made_files
import numpy as np
import pytest
from commands import as_json as answer
from made_files import (
    CLASSES,
    STEPS,
    TAXELS,
    events,
    recorded,
    recordings_folder,
    ring,
    small_checkpoint,
    weights,
)
from numpy.testing import assert_array_equal
from scipy import stats
from timed_networks import events_of, written

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.machines.loihi1 import engine, spec
from spikeloom.runtime.machines.loihi1.trace import unpack
from spikeloom.runtime.machines.votes import class_counts, readout_counts
from spikeloom.runtime.report.encode import decode, encode
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.studies.robustness.bench import Bench, by_length, distances, whole
from spikeloom.runtime.studies.robustness.curves import curve, parse_requirement, reasons, spread, unmet
from spikeloom.runtime.studies.robustness.pair import Pair, evaluate
from spikeloom.runtime.studies.robustness.perturbations import SAMPLED, longer, warm_state
from spikeloom.runtime.studies.robustness.results import Run, Spread
from spikeloom.runtime.studies.robustness.sampled import clean, generator, measure

STRESS, REPORT = (
    f"{command} net.loom --checkpoint net.pt --data data".split() for command in ("stress", "report")
)
PAGE = Path(__file__).parents[1] / "docs" / "stress.md"
FEW = "taxels_dead,events_lost,warm_state,longer,weight_bit_flips,fewer_bits"


def bench_of(network, netlist, recordings):
    count, taxels, _, steps = recordings.shape
    pair = Pair(netlist=netlist, network=network)
    return Bench(
        pair=pair,
        distance=distances(taxels, None, None),
        events=recordings,
        labels=np.arange(count) % netlist.classes,
        files=tuple(f"r{i}" for i in range(count)),
        lengths=np.full(count, steps),
    )


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small TactileSGNet and its propagation."""
    return small_checkpoint(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="module")
def bench(small):
    """That network, with recordings that are labelled as its float model decides."""
    network = expand(*small)
    made = bench_of(network, compile_network(network).netlist, events(2, samples=8))
    found, _ = clean(made)
    return replace(made, labels=found.decisions("float"))


def test_clean_recordings_are_what_reference_and_engine_say(bench, small):
    found, counted = clean(bench)
    flat = with_clocks(bench.events, bench.pair.netlist.clocks)
    trace = engine.simulate(bench.pair.netlist, flat)
    assert_array_equal(found.votes["chip"], class_counts(bench.pair.netlist, trace.counts.spikes))
    layers = float_spikes(expand(*small), bench.events)
    counts = readout_counts(bench.pair.network.readout, CLASSES, layers["fc3"])
    assert_array_equal(found.votes["float"], counts)
    for layer, (name, spikes) in enumerate(layers.items()):
        assert counted.layers[name][0] == spikes.sum()
        ids = bench.pair.netlist.compartments_of(layer)
        assert counted.layers[name][1] == trace.counts.spikes[:, ids].sum()
        assert counted.layers[name][3] == len(ids) * 8 * STEPS
    for name, spikes in verify(bench.pair.netlist, expand(*small), recorded(bench.events)).spikes.items():
        assert counted.layers[name][:3] == (spikes.float, spikes.chip, spikes.different)
    equal = np.count_nonzero(vote(found.votes["chip"]) == vote(counts))
    assert counted.equal == equal
    assert counted.right == {"float": 8, "chip": equal}


def test_recordings_after_others_without_a_reset_are_one_long_run_of_the_specification(bench):
    inputs = warm_state(bench, 2, generator("warm_state", 0))
    found, events = evaluate(bench.pair, inputs), inputs.channels(slice(None))
    for i in range(3):
        slow = spec.simulate(bench.pair.netlist, events[i, :, : inputs.lengths[i]])
        layer = bench.pair.netlist.layers[-1]
        window = slow.spikes[inputs.begin[i] + layer.depth : inputs.lengths[i] + layer.depth]
        assert_array_equal(
            found.votes["chip"][i], class_counts(bench.pair.netlist, window.sum(axis=0)[None])[0]
        )
        assert_array_equal(
            events[i, :, 2 * STEPS :], with_clocks(bench.events, bench.pair.netlist.clocks)[i]
        )


def test_ten_times_as_long_is_ten_recordings_of_which_the_last_counts(bench):
    inputs = longer(bench, 10)
    events = inputs.channels(slice(None))
    assert events.shape[2] == 10 * STEPS
    assert set(inputs.begin.tolist()) == {9 * STEPS}
    found = evaluate(bench.pair, inputs)
    trace = engine.simulate(bench.pair.netlist, events, packed=True)
    flags = unpack(trace.packed, bench.pair.netlist.n_compartments)
    depth = bench.pair.netlist.layers[-1].depth
    counts = flags[:, 9 * STEPS + depth : 10 * STEPS + depth].sum(axis=1)
    assert_array_equal(found.votes["chip"], class_counts(bench.pair.netlist, counts))


def test_clocks_are_no_taxels(tmp_path):
    """Whatever happens to taxels, clocks tick: again with each recording, and to their end in a longer one."""
    _, seen = written(tmp_path / "net.pt")
    network = expand(read_checkpoint(tmp_path / "net.pt"), seen)
    netlist = compile_network(network).netlist
    made = bench_of(network, netlist, events_of(3))
    ticks = netlist.clocks.events(15)
    sensor = netlist.taxels * netlist.polarities
    silent = SAMPLED["taxels_dead"](made.events, 39, generator("taxels_dead", 0))
    reached = whole(silent, netlist, made.lengths).channels(slice(None))
    assert not reached[:, :sensor].any()
    assert_array_equal(reached[0, sensor:], ticks)
    warm = warm_state(made, 1, generator("warm_state", 0)).channels(slice(None))
    assert_array_equal(warm[0, sensor:], np.tile(ticks, 2))
    long = longer(made, 10).channels(slice(None))
    assert_array_equal(long[0, sensor:, :15], ticks)
    assert not long[0, sensor:, 15:].any()


def test_recordings_of_different_length_are_disturbed_within_their_own(bench):
    lengths = np.array([24, 10, 24, 7, 10, 24, 24, 3])
    cut = bench.events.copy()
    for i, length in enumerate(lengths):
        cut[i, ..., length:] = 0
    found = by_length(cut, lengths, np.ones_like)
    for i, length in enumerate(lengths):
        assert found[i, ..., :length].all()
        assert not found[i, ..., length:].any()
    shorter = replace(bench, events=cut, lengths=lengths)
    reference, _ = clean(shorter)
    for name in ("saturated", "warm_state", "longer"):
        run = measure(shorter, reference, (name, 1, 0))
        assert sum(run.right.values()) <= 16
    alone = engine.simulate(bench.pair.netlist, with_clocks(cut[1:2, ..., :10], bench.pair.netlist.clocks))
    assert_array_equal(reference.votes["chip"][1], class_counts(bench.pair.netlist, alone.counts.spikes)[0])


def test_an_overflow_stops_its_recording_and_no_other(bench):
    netlist = bench.pair.netlist
    heavy = replace(netlist, format_exponent=np.full_like(netlist.format_exponent, 12))
    recordings = np.zeros_like(bench.events)
    recordings[0] = 1
    found, counted = clean(bench_of(bench.pair.network, heavy, recordings))
    assert found.stopped.tolist() == [True] + [False] * 7
    assert counted.stopped == 1
    assert found.decisions("chip")[0] == -1
    assert not found.votes["chip"][0].any()


@pytest.mark.parametrize("name", SAMPLED)
def test_every_perturbation_runs_at_its_mildest_and_harshest_the_same_for_a_seed(bench, name):
    reference, undisturbed = clean(bench)
    levels = SAMPLED[name].levels_of(TAXELS)
    for level in {levels[0], levels[-1]}:
        seeds = [0, 1] if SAMPLED[name].seeded else [0]
        runs = [measure(bench, reference, (name, level, seed)) for seed in seeds]
        assert runs == [measure(bench, reference, (name, level, seed)) for seed in seeds]
        assert [run.seed for run in runs] == seeds
        for run in runs:
            assert run.layers.keys() == undisturbed.layers.keys()
            assert run.equal <= 8
            assert decode(Run, json.loads(json.dumps(encode(run)))) == run


def test_levels_are_in_order_and_make_sense():
    assert f"battery of {len(SAMPLED)} perturbations" in PAGE.read_text("utf-8")
    for known in SAMPLED.values():
        levels = list(known.levels_of(39))
        assert levels in (sorted(levels), sorted(levels, reverse=True))
        assert all(known.least <= level <= known.most for level in levels)
        assert len(set(levels)) == len(levels)
        assert known.to in ("events", "memory", "bench")
    assert SAMPLED["taxels_dead"].levels_of(6, [2]) == (1, 2, 3, 5)
    assert SAMPLED["taxels_dead"].level_of("3") == 3


def run_of(right, *, equal=100, spikes=(1000, 1000, 100, 10000), signs=None, most=10, stopped=0, seed=0):
    model, chip = (right, right) if isinstance(right, int) else right
    return Run(
        seed=seed,
        right={"float": model, "chip": chip},
        equal=equal,
        layers={"fc": spikes},
        signs={"float": {}, "chip": signs or {}},
        most={"float": (0, most), "chip": (0, most)},
        stopped=stopped,
        saturated=0,
    )


CLEAN = run_of(90)


def curve_of(runs, name="taxels_dead"):
    return curve(name, dict(runs), CLEAN, 100, 10)


@pytest.mark.parametrize(
    ("chip", "verdict", "leaves", "chance"),
    [
        ((90, 85, 84), "robust", None, None),  # Wilson's interval of 90 in 100 begins at 82.6
        ((90, 82, 84), "degrades", 2, None),
        ((90, 60, 50), "degrades", 2, None),
        ((90, 60, 15), "breaks", 2, 3),  # that of 15 in 100 begins at 9.3, chance is 10
        ((90, 60, 16), "degrades", 2, None),  # that of 16 in 100 at 10.1
        ((10, 90, 90), "breaks", 1, 1),
    ],
)
def test_verdicts(chip, verdict, leaves, chance):
    assert wilson(90, 100)[0] == pytest.approx(0.8256, abs=1e-4)
    runs = [(level, [run_of((90, right))]) for level, right in enumerate(chip, 1)]
    found = curve_of(runs)
    place = found.breaks["chip"]
    assert (found.verdict, place.leaves, place.chance) == (verdict, leaves, chance)
    assert found.breaks["float"].leaves is found.breaks["float"].chance is None
    apart = leaves is not None and chip[leaves - 1] < 82  # else intervals of both sides overlap there
    assert found.same_place != apart


@pytest.mark.parametrize(
    ("model", "chip", "same"),
    [  # Wilson's interval of 82 in 100 ends at 88.3, that of 90 begins at 82.6, that of 60 ends at 69.1
        ((90, 90), (82, 60), True),
        ((90, 90), (60, 60), False),
        ((60, 60), (90, 90), False),
        ((90, 60), (90, 60), True),
        ((90, 90), (90, 90), True),
    ],
)
def test_the_same_place_is_one_where_intervals_overlap(model, chip, same):
    runs = [(level, [run_of(pair)]) for level, pair in enumerate(zip(model, chip, strict=True), 1)]
    assert curve_of(runs).same_place == same


def test_it_is_the_mean_over_seeds_that_counts():
    found = curve_of([(1, [run_of(right, seed=i) for i, right in enumerate((95, 70, 84))])])
    assert found.levels[0].chip.mean == pytest.approx(0.83)
    assert found.verdict == "robust"
    low, high = wilson(90, 100)
    assert spread([90], 100) == Spread(mean=0.9, low=low, high=high, values=(0.9,))
    several = spread([80, 90, 100], 100)
    values = [0.8, 0.9, 1.0]
    assert several.mean == pytest.approx(0.9)
    assert several.low == pytest.approx(stats.t.interval(0.95, 2, loc=0.9, scale=stats.sem(values))[0])
    assert several.high == 1.0


@pytest.mark.parametrize(
    ("run", "seen"),
    [
        (run_of(50), []),
        (run_of(50, spikes=(1000, 0, 1000, 10000)), ["fc is silent"]),
        (run_of(50, spikes=(1000, 6000, 100, 10000)), ["fc is saturated: fires in 60 % of all steps"]),
        (run_of(50, spikes=(1000, 300, 100, 10000)), ["fc fires 0.3 times as often"]),
        (run_of(50, spikes=(1000, 3000, 100, 10000)), ["fc fires 3 times as often"]),
        (run_of(50, spikes=(1000, 1900, 100, 10000)), []),
        (run_of(50, signs={"no vote": 20}), ["no vote in 20 of 100"]),
        (run_of(50, signs={"no vote": 19}), []),
        (run_of(50, signs={"one class": 100}, most=100), ["one class for every recording"]),
        (run_of(50, most=80), ["one class in 80 % of the decisions"]),
        (run_of(50, most=79), []),
        (run_of(50, stopped=20), ["a register overflows in 20 of 100 recordings"]),
        (
            run_of(0, spikes=(1000, 0, 1000, 10000), signs={"no vote": 100, "one class": 100}, most=100),
            ["fc is silent", "no vote in 100 of 100"],
        ),
    ],
)
def test_reasons(run, seen):
    assert list(reasons("chip", [run], run.layers, CLEAN, 100)) == seen
    silent = replace(run, layers={"fc": (0, 1000, 1000, 10000)})
    assert reasons("float", [silent], silent.layers, CLEAN, 100)[0] == "fc is silent", (
        "each side has its own"
    )


def test_spikes_in_common_and_requirements():
    for spikes, common in (((60, 40, 20, 1000), 0.8), ((0, 0, 0, 1000), 1.0)):  # as verify counts them
        assert curve_of([(1, [run_of(90, spikes=spikes)])]).levels[0].common == {"fc": common}
    found = {"taxels_dead": curve_of([(3, [run_of((90, 85))])])}
    kept, missed = (parse_requirement(f"taxels_dead:3>={share}") for share in ("0.85", "0.86"))
    assert unmet([kept, missed], found) == ("taxels_dead:3>=0.86: 0.8500 reached",)


def test_any_number_of_threads_says_the_same(spikeloom, place):
    words = (*STRESS, "--seeds", "2", "--only", FEW)
    code, out, err = spikeloom(*words, "-o", "one.json")
    assert (code, err) == (0, "")
    assert spikeloom(*words, "--jobs", "1", "-o", "two.json")[1] == out
    assert (place / "one.json").read_bytes() == (place / "two.json").read_bytes()
    report = json.loads((place / "one.json").read_bytes())
    wanted = {*FEW.split(",")}
    assert list(report["perturbations"]) == [name for name in SAMPLED if name in wanted]
    assert report["not_applicable"] == {}
    levels = report["perturbations"]["taxels_dead"]["levels"]
    assert [point["level"] for point in levels] == [1, 3, 5]
    assert levels[0]["seeds"] == [0, 1]
    assert report["perturbations"]["longer"]["levels"][0]["seeds"] == [0]
    assert report["provenance"]["netlist"] == "net.loom"


def test_requirements_decide_about_the_exit_code(as_json):
    words = (*STRESS, "--only", "taxels_dead", "--seeds", "2", "--require", "taxels_dead:2>=0")
    report = as_json(*words)
    assert (report["missed"], report["required"]) == ([], ["taxels_dead:2>=0"])
    levels = report["perturbations"]["taxels_dead"]["levels"]
    assert [point["level"] for point in levels] == [1, 2, 3, 5]
    missed = [f"taxels_dead:2>=1: {levels[1]['chip']['mean']:.4f} reached"]
    assert as_json(*words, "--require", "taxels_dead:2>=1", codes=(1,))["missed"] == missed


def test_what_does_not_apply(bench):
    netlist = compile_network(bench.pair.network, Options(storage=Fixed((Packing(planes=2),)))).netlist
    pair = Pair(netlist=netlist, network=bench.pair.network)
    assert SAMPLED["fewer_bits"].why_not(pair) == "weights are stored in several planes"
    assert SAMPLED["fewer_bits"].why_not(bench.pair) is None


def test_the_page_of_a_network_shows_it_if_it_is_a_result_about_its_netlist(as_json, refusal, place):
    as_json(*STRESS, "--only", "taxels_dead", "--seeds", "1", "-o", "page.json")
    words, content = (*REPORT, "-o", "page.html", "--stress"), (place / "page.json").read_text()
    found = json.loads(content)
    assert as_json(*words, "page.json")["stress"] == found
    assert ">taxels_dead: " in (place / "page.html").read_text("utf-8")
    sha256 = found["provenance"]["netlist_sha256"]
    for wrong, telling in (
        ("{", "something else (|write it with spikeloom stress -o"),
        ('{"recordings": 3}', "something else (|write it with spikeloom stress -o"),
        (content.replace(sha256, "0" * 64), f"sha256 000000000000…, net.loom has {sha256[:12]}…"),
    ):
        (place / "wrong.json").write_text(wrong)
        line = refusal(*words, "wrong.json")
        assert line.startswith("--stress wrong.json: ")
        assert all(part in line for part in telling.split("|"))


def test_recordings_have_one_hash_whatever_is_asked_of_them(tmp_path):
    """Also where a step of the network joins several of their bins."""
    data, model, chip = (tmp_path / name for name in ("data", "net.pt", "net.loom"))
    recordings_folder(data)
    constants = {"beta": 0.2, "theta": 0.5, "training": {"seed": 0}, "bins": 2}
    save_checkpoint(model, {"last": weights()}, **made_files.graph_facts(ring()), **constants)
    answer("compile", model, "-o", chip)
    known = ("--data", data, "--checkpoint", model)
    hashes = {
        answer("stress", chip, *known, "--only", "faster", "--seeds", 1)["provenance"]["data_sha256"],
        answer("certify", chip, *known[:2], "--most", 1)["provenance"]["data_sha256"],
        answer("report", chip, *known, "-o", tmp_path / "net.html")["provenance"]["data"]["sha256"],
    }
    assert hashes == {load_data(str(data), "test").sha256}
