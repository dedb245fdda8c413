"""What holds for every network: each invariant over the whole zoo, and the keys of ``--json`` that scripts rely on."""

import hashlib
import json
from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from commands import as_json, run
from numpy.testing import assert_array_equal
from oracles import assert_as_specified, check_costs
from random_crossbars import recording_of
from random_netlists import assert_equal, by_engine, by_steps
from zoo import CROSSBARS, FLOAT, LAYERED, MAKERS, over, specified, specimen

import spikeloom
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.formats.text import text
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import netlist_bytes, read_netlist
from spikeloom.compiler.targets.truenorth.netlist import crossbar_bytes
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.recordings.events import of_length
from spikeloom.runtime.commands.options import request_of
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.machines.backends import backend_of, machine_for
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.blocks import lay_out_blocks
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.machines.truenorth import engine as crossbar_engine
from spikeloom.runtime.machines.truenorth import spec as crossbar_spec
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.requests.main_job import VerifyRequest

CHECKPOINTS = tuple(name for name in FLOAT if name not in ("recurrent", "onnx", "counters"))
STEP_BY_STEP = ("recurrent", "onnx", "counters")
"""Those that the kernel of layers does not take: a loop, or sums that may leave 16 bits."""


def channels(made):
    """Recordings (samples, channels, steps) with the clocks of the network."""
    return with_clocks(made.events, made.machine.netlist.clocks)


def float_side(made):
    """The float network as the commands load it."""
    words = [str(made.netlist), "--checkpoint", str(made.network), *made.reading, "--data", str(made.data)]
    return load_network(str(made.network), request_of(VerifyRequest, words), made.machine.netlist)


LISTS = """
anytime:
    bins chip_steps decisions files full held_out labelled labels least_interval rules samples source split windows
chart:
    budget chosen_by command data format grid networks points refused spikeloom tables target
compile:
    chips classes compartments cores layers limits neurons provenance sha256 synapse_words synapse_words_unrolled
    synapses synapses_nonzero synapses_stored target taxels tiles bins? calibration? clocks? core_bound? exactness?
    facts? free_running? layout? path? placement? proofs? removals? keep? trials? finetune?
compile, crossbars:
    axons classes cores crossing_points drain_ticks feeds layers limits max_crossing_points_of_an_axon neurons
    provenance sha256 target taxels tick_clocks ticks_per_step wires bins? clocks?
data:
    bin_s dead duration_s events found hot labels one_sided rate recordings rules source split steps taxels
    unlabelled
estimate:
    chip_steps cores detail energy_by_part_j energy_range_j host injection layers max measured min not_modelled
    not_priced pace per_inference prices samples static time
estimate, crossbars:
    cores cores_of_chip energy injection layers max min not_priced pace per_inference samples static_w
explain:
    causes diagnosis different faults graph layers recording reference roots sample searched split steps top
export netx:
    bytes exact format layers neurons path sha256 synapses
export nir:
    bytes convention dt format neurons path sha256 synapses
export onnx:
    bytes form format inputs neurons outputs path sha256 synapses
export sanafe:
    bytes cores format groups input_cores neurons path sha256 synapses
finetune:
    before bin_s? command data data_sha256 epochs file fine_tuned_from fine_tuned_weights history last netlist? seed
    sha256 test_samples train_sha256 weight_bits
inspect checkpoint:
    assumed beta classes given graph layers layout sha256 system taxels theta training bins? dynamics? hops? towers?
inspect checkpoint, crossbars:
    classes clocks copies edges graph layers levels sets sha256 system taxels towers training weights
inspect netlist:
    chips classes compartments cores layers limits neurons provenance sha256 synapse_words synapse_words_unrolled
    synapses synapses_nonzero synapses_stored target taxels tiles bins? clocks? free_running?
join:
    classes command file graph layers sha256 system towers
lean:
    differ layers output rows samples source split taken taxels
report:
    cores costs decisions netlist output provenance recording taxels verify
run:
    accuracy counts files labelled labels predictions samples
stress:
    classes clean missed not_applicable perturbations provenance recordings required seeds conditions?
train:
    protocols runs left_out?
verify:
    accuracy breakdowns decision_agreement engine engine_different first_divergence ladder levels membranes_saturated
    missed model netlist not_compared same_checkpoint samples spec_different spec_equals_engine spec_samples spikes
    target votes_moved row_different?
watch bin:
    bins counts decision grasp kind margin time_s
watch end:
    after_decision bins events grasps interrupted kind late repeated
watch grasp:
    bins counts decision grasp kind margin time_s
"""
"""A command, and the keys that scripts rely on; with a question mark those that only some networks have."""


@cache
def tables():
    """Of each command those keys that are always there, and those that may be."""
    found = {}
    for line in LISTS.strip().splitlines():
        if not line.startswith(" "):
            always, sometimes = found[line.rstrip(":")] = set(), set()
        for word in line.split() if line.startswith(" ") else ():
            (sometimes if word.endswith("?") else always).add(word.rstrip("?"))
    return found


def require_keys(what, found):
    always, sometimes = tables()[what]
    assert always <= set(found) <= always | sometimes


@over(LAYERED)
def test_every_kernel_is_the_specification(name):
    made = specimen(name)
    netlist = made.machine.netlist
    assert isinstance(lay_out_blocks(netlist), str) == (name in STEP_BY_STEP)
    total = np.zeros(len(netlist.layers), int)
    for index, recording in enumerate(channels(made)[:2]):
        expected = specified(name, index)
        for simulate in (by_engine, by_steps):
            assert_equal(simulate(netlist, recording), expected)
        total += [
            expected.counts.spikes[netlist.compartments_of(layer)].sum() for layer in range(len(total))
        ]
    assert total.all(), "a layer is silent, so nothing is tested here"


@over(CROSSBARS)
def test_the_engine_of_crossbars_is_the_specification(name):
    made = specimen(name)
    netlist = made.machine.netlist
    batch = crossbar_engine.simulate(netlist, channels(made), spikes=True, membranes=True)
    for sample, recording in enumerate(channels(made)):
        assert_equal(recording_of(batch, sample), crossbar_spec.simulate(netlist, recording))
    assert all(batch.spikes[..., netlist.layer == layer].any() for layer in range(len(netlist.layers)))


@over(LAYERED)
def test_onnxruntime_is_the_specification(name):
    pytest.importorskip("onnxruntime")
    made = specimen(name)
    for index, recording in enumerate(channels(made)[:2]):
        assert_as_specified(made.machine.netlist, recording, specified(name, index))


@over(LAYERED)
def test_the_integer_network_of_a_netlist_is_the_engine(name):
    made = specimen(name)
    netlist = made.machine.netlist
    trace = engine.simulate(netlist, channels(made), spikes=True, membranes=True)
    found = run_integer(lift(netlist), channels_last(made.events, netlist.clocks), membranes=True)
    for layer in range(len(netlist.layers)):
        held = netlist.neuron[netlist.compartments_of(layer)]
        assert_array_equal(aligned(netlist, trace.spikes, layer), found.spikes[layer])
        assert_array_equal(
            aligned(netlist, trace.membranes, layer)[..., held], found.membranes[layer][..., held]
        )


@over(MAKERS)
def test_each_recording_is_decided_as_it_is_alone(name):
    made = specimen(name)
    steps = made.events.shape[-1]
    lengths = np.array([steps, 1, steps - 2, steps])
    together = made.machine.run(made.events, lengths=lengths)
    for index, length in enumerate(lengths):
        alone = made.machine.run(made.events[index : index + 1, ..., :length])
        assert_array_equal(together.votes[index], alone.votes[0])
    assert together.votes.any()


@over(MAKERS)
def test_a_file_holds_the_netlist_to_the_byte(name):
    made = specimen(name)
    made.machine.legal()
    content = made.netlist.read_bytes()
    assert (crossbar_bytes if name in CROSSBARS else netlist_bytes)(made.machine.netlist) == content
    if name in LAYERED:
        lines = text(made.machine.netlist).splitlines()
        assert lines == text(read_netlist(made.netlist)).splitlines()


@over(MAKERS)
def test_compiled_again_the_bytes_are_the_same(name, tmp_path):
    made = specimen(name)
    found = as_json(*made.compilation, "-o", tmp_path / "again.loom")
    require_keys("compile" + ", crossbars" * (name in CROSSBARS), found)
    assert found["sha256"] == hashlib.sha256(made.netlist.read_bytes()).hexdigest()
    assert (tmp_path / "again.loom").read_bytes() == made.netlist.read_bytes()


@over(LAYERED)
def test_costs_are_those_counted_spike_by_spike(name):
    made = specimen(name)
    traces = [specified(name, index) for index in range(2)]
    assert check_costs(made.machine.netlist, channels(made)[:2], traces).synaptic_operations.sum() > 0


@over(CROSSBARS)
def test_costs_of_crossbars_are_those_counted_tick_by_tick(name):
    made = specimen(name)
    netlist = made.machine.netlist
    _, price = made.machine.price(made.events, bin_s=0.02)
    points = np.bincount(netlist.axon_of_synapse(), minlength=netlist.n_axons)
    marginal = made.machine.target.energy[1]
    for sample, recording in enumerate(channels(made)):
        counts = crossbar_spec.simulate(netlist, recording).counts
        events = sum(int(ticks) * int(lines) for ticks, lines in zip(counts.axons, points, strict=True))
        assert price.synaptic_operations[sample] == events > 0
        seconds = int(counts.ticks) * 1e-3
        assert price.time_s["tick"][sample] == pytest.approx(seconds)
        joules = events * marginal.joule("synaptic_event") + marginal.floor_w * seconds
        assert price.energy_j[marginal.name][sample] == pytest.approx(joules)


@over(CHECKPOINTS)
def test_the_expanded_network_is_the_float_model(name):
    made = specimen(name)
    loaded = float_side(made)
    for dtype in ("float64", "float32"):
        wanted = float_spikes(loaded.network, made.events, dtype=dtype)
        inputs = channels_last(made.events, loaded.network.input.clocks)
        found = run_float(loaded.network, inputs, dtype=dtype).spikes
        for ours, (layer, theirs) in zip(found, wanted.items(), strict=True):
            assert_array_equal(ours, theirs, err_msg=layer)
            assert theirs.any(), layer


@over(MAKERS)
def test_the_lowered_model_is_the_chip(name, monkeypatch, tmp_path):
    made, lowered = specimen(name), []
    backend = backend_of(made.machine.netlist.target)
    lower = backend.lower
    monkeypatch.setattr(
        type(backend), "lower", lambda _, *words: lowered.append(lower(*words)) or lowered[0]
    )
    assert run(*made.compilation, "-o", tmp_path / "net.loom")[0] == 0
    (found,) = lowered
    data = made.recordings
    ran = made.machine.run(data.events, lengths=data.lengths, spikes=True)
    expected = found.model.spikes(data.events)
    for layer, first in found.model.first.items():
        assert not made.machine.differing(ran, layer, expected[layer], first, data.step_counts), layer
    assert any(spikes.any() for spikes in expected.values())


@over((*FLOAT, *CROSSBARS))
def test_verify_holds_every_network_to_its_file(name):
    made = specimen(name)
    words = ("verify", made.netlist, "--checkpoint", made.network, *made.reading, "--data", made.data)
    found = as_json(*words, "--spec-samples", 1, *([] if name in CROSSBARS else ["--require", "E0"]))
    require_keys("verify", found)
    assert found["spec_equals_engine"] is found["same_checkpoint"] is True
    if name in CROSSBARS or "tuned" in name:
        assert all(layer["spikes"] and not layer["different"] for layer in found["model"].values())
    if name in CROSSBARS:
        assert (found["missed"], found["membranes_saturated"]) == ([], 0)
        if found["decision_agreement"] is not None:
            assert (found["decision_agreement"], found["votes_moved"]) == (1, 0)
        return
    assert not any(found["ladder"][0]["different"].values()), "the float network in float64"
    assert all(layer["float"] > 0 for layer in found["spikes"].values())
    assert found["ladder"][-1]["different"] == {
        name: each["different"] for name, each in found["spikes"].items()
    }
    first = next(iter(found["spikes"].values()))
    assert first["different"] <= 0.1 * first["float"] + 6  # of 4 bits, chosen on four recordings


@over(MAKERS)
def test_run_estimate_and_inspect_agree(name):
    made = specimen(name)
    kind = ", crossbars" if name in CROSSBARS else ""
    decided = as_json("run", made.netlist, "--data", made.data)
    require_keys("run", decided)
    run = made.machine.run(made.events)
    assert decided["counts"] == run.votes.tolist()
    assert decided["predictions"] == run.decisions.tolist()
    costs = as_json("estimate", made.netlist, "--data", made.data)
    require_keys("estimate" + kind, costs)
    shown = as_json("inspect", made.netlist)
    require_keys("compile, crossbars" if kind else "inspect netlist", shown)
    assert [layer["name"] for layer in shown["layers"]] == list(made.machine.layers)
    if name in (*CHECKPOINTS, "native"):
        require_keys("inspect checkpoint" + kind * (name == "native"), as_json("inspect", made.network))


@over(FLOAT)
def test_explain_prints_the_keys_of_the_table(name):
    made = specimen(name)
    words = ("explain", made.netlist, "--checkpoint", made.network, *made.reading, "--data", made.data)
    found = as_json(*words, "--sample", "sample_1_label_1.npy")
    require_keys("explain", found)


COMMANDS = {
    "report": ("timed", "report {net} --checkpoint {file} --data {data} -o {out}/page.html"),
    "anytime": ("timed", "anytime {net} --data {data}"),
    "lean": ("joined-timed", "lean {file} --data {data} -o {out}/lean.loom"),
    "stress": (
        "recurrent",
        "stress {net} --checkpoint {file} --dt 0.02 --data {data} --seeds 1 --only taxels_dead",
    ),
    "chart": ("binned", "chart {file} --data {data} --grid bits=8 --jobs 1 -o {out}/chart"),
    "train": ("mlp", "train --data {data} --system mlp --features 2 --epochs 1 -o {out}/x.pt"),
    "finetune": (
        "recurrent",
        "finetune {file} --dt 0.02 --data {data} --weight-bits 4 --epochs 1 -o {out}/x.nir",
    ),
    "join": ("joined", "join {folder}/1.pt {folder}/2.pt -o {out}/x.pt"),
    "data": ("mlp", "data describe {data}"),
    **{
        f"export {form}": (name, f"export {{net}} --to {form} -o {{out}}/x{suffix}")
        for form, name, suffix in (
            ("onnx", "timed", ".onnx"),
            ("nir", "recurrent", ".nir"),
            ("sanafe", "recurrent", ".yaml"),
        )
    },
}
"""A command, the network that it is run on, and its words."""


@pytest.mark.parametrize("command", COMMANDS)
def test_other_commands_print_the_keys_of_the_table(command, tmp_path):
    name, words = COMMANDS[command]
    made = specimen(name)
    places = {
        "net": made.netlist,
        "file": made.network,
        "data": made.data,
        "folder": made.folder,
        "out": tmp_path,
    }
    require_keys(command, as_json(*words.format(**places).split(), codes=(0, 1)))


@over(LAYERED)
def test_watch_decides_as_run(name, tmp_path):
    made = specimen(name)
    lines = []
    for recording in made.events:
        step, taxel, polarity = np.nonzero(recording.transpose(2, 0, 1))
        bin_s = 0.02 * made.machine.netlist.bins
        lines += [
            f"{bin_s * (s + 0.5):.3f},{x},{p}" for s, x, p in zip(step, taxel, polarity, strict=True)
        ] + [""]
    (tmp_path / "lines.csv").write_text("\n".join(lines) + "\n")
    words = [
        "watch",
        made.netlist,
        "--input",
        tmp_path / "lines.csv",
        "--bins",
        made.events.shape[-1],
        "--json",
    ]
    shown = [json.loads(line) for line in run(*words)[1].splitlines()]
    for entry in shown:
        require_keys(f"watch {entry['kind']}", entry)
    counts = [entry["counts"] for entry in shown if entry["kind"] == "grasp"]
    assert counts == made.machine.run(made.events).votes.tolist()


NETWORKS = {
    "grasps": {},
    "objects": {"planes": "2", "scale_groups": "4"},
    "containers": {"weight_bits": "8,4,4,8", "chips": 2},
    "objects-200ms": {"weight_bits": "3"},
    "objects-counters": {},
    "containers-counters": {},
    "objects-truenorth": {"target": "truenorth"},
    "containers-truenorth": {"target": "truenorth"},
}
"""Name of a shipped network, and how it is stored."""


@cache
def grasps():
    return spikeloom.recordings("synthetic").test


def digest(values):
    array = np.ascontiguousarray(values)
    whole = array.astype(np.int64 if array.dtype.kind in "iub" else np.float64)
    return hashlib.sha256(f"{array.shape}".encode() + whole.tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("name", NETWORKS)
def test_integers_votes_and_costs_are_as_recorded(name, golden):
    net = spikeloom.compile(f"pretrained:{name}", **NETWORKS[name])
    assert net.check().holds
    netlist = machine_for(net.path).netlist
    arrays = {each.name: getattr(netlist, each.name) for each in fields(netlist)}
    found = {key: digest(value) for key, value in arrays.items() if isinstance(value, np.ndarray)}
    events = of_length(grasps(), netlist.clocks.length).events[:12]
    done, price = machine_for(net.path).price(events, bin_s=0.02)
    found["votes"] = done.votes.tolist()
    found["costs"] = encode([price.synaptic_operations, price.energy_j, price.time_s])
    golden(f"{name}.json", json.dumps(found, indent=1) + "\n")
