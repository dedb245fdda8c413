"""A live stream is a run of the whole recording, bit for bit; ``watch`` decides so, whatever its lines are like."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import commands
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_files import sparse_events
from numpy.testing import assert_array_equal
from oracles import refused
from random_netlists import Axon, Neuron, build, lively, netlists, recordings, voting

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.errors import DataError, NumericRangeError
from spikeloom.compiler.targets.loihi1.netlist import Netlist, write_netlist
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.cli import build_parser
from spikeloom.runtime.commands.exchange import watch
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.capabilities import Stoppable
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.stream import Step, Stream
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.studies.anytime import exits

HEADER = "time_s,taxel,polarity"
LIVELY = lively()


LATE = "spikeloom: 1 event so far after the end of a bin, this one of {} s: late, not used\n"


def objects(*words: object, said: str = "") -> dict[str, list[dict]]:
    """All objects that the command prints, by kind."""
    code, out, err = commands.run("watch", *words, "--json")
    assert (code, err) == (0, said)
    values = [json.loads(line) for line in out.splitlines()]
    return {kind: [v for v in values if v["kind"] == kind] for kind in ("bin", "grasp", "end")}


@pytest.fixture
def lively_file(tmp_path) -> Path:
    write_netlist(LIVELY, tmp_path / "net.loom")
    return tmp_path / "net.loom"


@pytest.fixture
def pair_file(tmp_path) -> Path:
    """One taxel; every event of polarity p in a bin is one vote for class p, at once."""
    axons = [Axon(source=polarity, targets=((polarity, 110),)) for polarity in (0, 1)]
    netlist = build([Neuron(), Neuron()], axons, n_inputs=2, depths=[0])
    netlist = replace(netlist, taxels=1, polarities=2, classes=2, readout_class=read_only([0, 1]))
    write_netlist(netlist, tmp_path / "pair.loom")
    return tmp_path / "pair.loom"


@pytest.fixture
def lines(tmp_path):
    """Write event lines to a file; the option that reads it."""

    def write(content: str | bytes) -> str:
        path = tmp_path / "events.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return f"--input={path}"

    return write


def votes_of_run(netlist: Netlist, events: np.ndarray) -> list[int]:
    """Votes that `run` counts for a recording (n_inputs, T) or (taxels, 2, T)."""
    flat = events.reshape(1, netlist.n_inputs, -1)
    return class_counts(netlist, engine.simulate(netlist, flat, threads=1).counts.spikes)[0].tolist()


def as_lines(events: np.ndarray, seed: int = 0, *, low: int = 0, inside: int = 0) -> str:
    """Event lines of a recording (taxels, 2, T), in any order, up to `inside` microseconds into each bin of 20 ms."""
    rng = np.random.default_rng(seed)
    text = []
    for t, bin_events in enumerate(np.moveaxis(events, -1, 0)):
        for taxel, polarity in rng.permutation(np.argwhere(bin_events)):
            micros = 20_000 * t + rng.integers(inside + 1)
            text.append(f"{micros // 10**6}.{micros % 10**6:06},{taxel},{polarity or low}\n")
    return "".join(text)


def random_events(seed: int, length: int = 40) -> np.ndarray:
    """A recording (10, 2, length) whose last bin is not empty."""
    events = sparse_events(seed, 10, 2, length, rate=0.1)
    events[3, 1, -1] = 1
    return events


@pytest.mark.parametrize("low", [0, -1])
@pytest.mark.parametrize("inside", [0, 19_999])
def test_any_recording_is_a_run(lively_file, lines, low, inside):
    for seed in range(2):
        events = random_events(seed)
        found = objects(lively_file, lines(as_lines(events, seed, low=low, inside=inside)))
        assert [grasp["counts"] for grasp in found["grasp"]] == [votes_of_run(LIVELY, events)]
        trace = engine.simulate(LIVELY, events.reshape(1, 20, -1), spikes=True, threads=1)
        for t, counts in enumerate(class_counts(LIVELY, np.cumsum(trace.spikes[0], axis=0))[:40]):
            second, best = np.sort(counts)[-2:]
            shown = {"decision": counts.argmax(), "margin": best - second, "counts": counts.tolist()}
            time_s = pytest.approx((t + 1) * 0.02, abs=1e-12)
            assert found["bin"][t] == {"kind": "bin", "grasp": 1, "bins": t + 1, "time_s": time_s} | shown
        assert len(found["bin"]) == 40
        total = {"kind": "end", "grasps": 1, "bins": 40, "events": int(events.sum()), "interrupted": False}
        assert found["end"] == [total | dict.fromkeys(("repeated", "late", "after_decision"), 0)]


def test_several_grasps_are_runs_of_their_own(lively_file, lines):
    grasps = [random_events(seed, length) for seed, length in ((1, 40), (2, 25), (3, 33))]
    first, second, third = (as_lines(events) for events in grasps)
    header = f"{HEADER.upper()}\n"
    content = f"\ufeff# first\n\n# {header}# {header}{first}\n{header}{second}# pause\n"
    content += f"reset\n\n   \nreset\n{third.rstrip()}"
    for text in (content, content.replace("\n", "\r\n"), content.replace(",", " ,  ")):
        found = objects(lively_file, lines(text))
        shown = [(grasp["grasp"], grasp["bins"], grasp["counts"]) for grasp in found["grasp"]]
        votes = [votes_of_run(LIVELY, events) for events in grasps]
        assert shown == list(zip([1, 2, 3], [40, 25, 33], votes, strict=True))


def test_exact_edges_of_bins(pair_file, lines):
    # 0.58 / 0.02 is below 29 in binary floating point
    found = objects(pair_file, lines("0.579999,0,0\n0.58,0,0\n5.8e-1,0,1\n0.60,0,1\n"))
    assert [each["counts"] for each in found["bin"][28:]] == [[1, 0], [2, 1], [2, 2]]
    content = (
        "0.000000000000000000e+00,0.000e+00,1.000e+00\n+0.02,+0,+1\n4E-2,0,-1\n"  # as programs write numbers
    )
    assert objects(pair_file, lines(content))["grasp"][0]["counts"] == [1, 2]
    found = objects(pair_file, "--bin", "0.003", lines("0.0089,0,0\n0.009,0,1\n"))
    assert [each["counts"] for each in found["bin"]] == [[0, 0], [0, 0], [1, 0], [1, 1]]


def test_a_file_is_read_as_recordings_are(lively_file, lines):
    # a sensor that counts in binary floating point misses half of the edges by a little
    rng = np.random.default_rng(0)
    rows = sorted(
        (k * 0.01 * (1 - e), *rng.integers([10, 2])) for k in range(200) for e in (0, 1e-15, 1e-10, 1e-7)
    )
    path = lines("taxel,time_s,label,polarity\n" + "".join(f"{x},{t!r},4,{p}  # {p}\n" for t, x, p in rows))
    read = load_data(path.removeprefix("--input="), taxels=10)
    found = objects(lively_file, path)
    assert found["grasp"][0]["bins"] == read.steps == 100
    assert found["grasp"][0]["counts"] == votes_of_run(LIVELY, read.events[0])
    assert found["end"][0]["late"] == 0


def test_late_and_repeated_events_are_counted_and_not_used(lively_file, lines):
    events = random_events(4)
    rows = as_lines(events).splitlines()
    rows.insert(len(rows) // 2, "0.0,3,1")
    rows.insert(len(rows) * 3 // 4, "0.01,3,0")
    rows[-1:] = rows[-1:] * 3
    found = objects(lively_file, lines("\n".join(rows)), said=LATE.format("0.0"))
    assert found["grasp"][0]["counts"] == votes_of_run(LIVELY, events)
    end = found["end"][0]
    assert (end["late"], end["repeated"], end["events"]) == (2, 2, events.sum() + 4)


def test_grasps_of_a_given_length(lively_file, lines):
    long, short = random_events(5, 40), random_events(6, 20)
    path = lines(as_lines(long) + "\n" + as_lines(short))
    found = objects(lively_file, path, "--bins", 30)
    padded = np.concatenate([short, np.zeros((10, 2, 10), np.uint8)], axis=2)
    assert [grasp["counts"] for grasp in found["grasp"]] == [
        votes_of_run(LIVELY, long[:, :, :30]),
        votes_of_run(LIVELY, padded),
    ]
    assert found["end"][0]["after_decision"] == long[:, :, 30:].sum()
    assert found["end"][0]["bins"] == 60


def test_origin(lively_file, lines):
    events = random_events(8)
    events[0, 0, 0] = 1
    moved = np.concatenate([np.zeros((10, 2, 50), np.uint8), events], axis=2)
    path = lines(as_lines(moved))
    counts = [objects(lively_file, path, "--origin", o)["grasp"][0]["counts"] for o in ("zero", "first")]
    assert counts == [votes_of_run(LIVELY, moved), votes_of_run(LIVELY, events)]
    assert counts[0] != counts[1]


@pytest.mark.parametrize("speed", ["real", "full"])
def test_silence(pair_file, monkeypatch, speed):
    """In real time bins go by without events: the second event waits for ten of them, however long that takes."""
    read_end, write_end = os.pipe()
    passed, step = threading.Semaphore(0), Stream.step
    monkeypatch.setattr(Stream, "step", lambda *words: passed.release() or step(*words))

    def write() -> None:
        os.write(write_end, b"0.0,0,1\n# nothing\n0.0")
        for _ in range(10 * (speed == "real")):
            passed.acquire(timeout=60)
        os.write(write_end, b"1,0,1\n")
        os.close(write_end)

    thread = threading.Thread(target=write)
    thread.start()
    found = objects(
        pair_file,
        "--input",
        f"/dev/fd/{read_end}",
        "--speed",
        speed,
        said=LATE.format("0.01") * (speed == "real"),
    )
    thread.join()
    os.close(read_end)
    end = found["end"][0]
    if speed == "real":  # the clock went on, and the second event came long after its bin
        assert end["bins"] >= 10
        assert (end["late"], found["grasp"][0]["counts"]) == (1, [0, 1])
    else:
        assert end["bins"] == 1
        assert end["repeated"] == 1


@pytest.mark.parametrize(
    ("content", "line", "said"),
    [
        ("0,0,0\nhello\n", 2, "'hello' found"),
        (f"{HEADER}\n# x\n{HEADER}\n", 3, f"'{HEADER}' found"),
        ("time_s,taxel,polarity,label,label\n", 1, "label,label' found"),
        (b"\xff\xfe\x00\n", 1, "found"),
        ("-0.1,0,0\n", 1, "time -0.1 found, allowed are 0 to 1e+12"),
        ("\n\nnan,0,0\n", 3, "time nan found"),
        ("0,10,0\n", 1, "taxel 10 found, allowed are 0 to 9"),
        ("0,1.5,0\n", 1, "taxel 1.5 found"),
        ("0,1,2\n", 1, "polarity 2 found"),
        ("0,1,0\n0,1,1\n0,2,-1\n", 3, "polarity -1 found after polarity 0"),
        ("0,1,0\n" + "7" * 1500, 2, "longer than 1000 bytes"),
        (
            "0,1,0\n2000.02,1,0\n",
            2,
            "time 2000.02 s leaves 100001 bins without an event, allowed are 100000",
        ),
    ],
)
def test_bad_lines(lively_file, lines, content, line, said):
    told = commands.refusal("watch", lively_file, lines(content))
    assert f"events.csv, line {line}: " in told
    assert said in told


def test_a_reader_that_goes_away_ends_it(pair_file, lines, monkeypatch):
    class Gone(io.StringIO):
        def write(self, _text: str) -> int:
            raise BrokenPipeError

    path = lines("0,0,0\n0.02,0,0\nnot reached\n")
    monkeypatch.setattr(sys, "stdout", Gone())
    assert watch.run(build_parser("watch").parse_args(["watch", str(pair_file), path])).result.interrupted


@pytest.mark.parametrize("end", [signal.SIGINT, None])
def test_standard_input_and_interruption(pair_file, end):
    code = "import signal, sys; from spikeloom.runtime import cli; signal.signal(2, signal.default_int_handler); "
    process = subprocess.Popen(  # jobs in the background start with interrupts ignored
        [sys.executable, "-c", f"{code}sys.exit(cli.main(['watch', sys.argv[1]]))", pair_file],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        process.stdin.write("0.00,0,0\n0.02,0,1\n0.04,0,1\n0.06,0,1\n")
        process.stdin.flush()
        lines = [process.stdout.readline() for _ in range(2)]
        if end is not None:
            process.send_signal(end)
        out, err = process.communicate(timeout=60)
    assert lines == ["    0.02 s  class 0, 1 vote, 1 ahead\n", "    0.06 s  class 1, 2 votes, 1 ahead\n"]
    assert (process.returncode, err) == (0, "")
    # where it is interrupted, the open bin does not count
    votes, ahead, bins, last = ("2 votes", 1, 3, "interrupted\n") if end else ("3 votes", 2, 4, "")
    assert out == (
        f"grasp 1: class 1, {votes}, {ahead} ahead, after {bins} bins (0.0{2 * bins} s)\n"
        f"1 grasp, {bins} bins, 4 events, 0 repeated within a bin, 0 late\n{last}"
    )


@pytest.mark.parametrize("factor", [None, 1.5, 0.0])
def test_a_grasp_ends_as_soon_as_it_is_sure(lively_file, lines, factor):
    ended = 0
    for seed in range(2):
        events = random_events(seed)
        given = () if factor is None else (factor,)
        found = objects(lively_file, lines(as_lines(events, seed)), "--bins", 40, "--until-sure", *given)
        votes = (
            Stoppable.required(machine_of(LIVELY))
            .cumulative(events.reshape(1, 20, 1, 40), np.array([40]))
            .votes
        )
        at = exits.standing(votes, np.array([40]))
        sure = exits.proven(votes, at, exits.most_votes(Stoppable.required(machine_of(LIVELY)), 40))
        end = int(exits.exits(sure, at, np.inf if factor is None else factor)[0])
        early = end + 3 < 39  # the read-out lags three steps
        bins = end + 4 if early else 40
        (grasp,) = found["grasp"]
        assert (grasp["bins"], grasp["early"], len(found["bin"])) == (bins, early, bins)
        assert grasp["decision"] == at.leader[0, end if early else -1]
        assert found["end"][0]["early"] == early
        after = events[..., bins + 1 :].sum() + (events[..., bins].sum() if early else 0)
        assert (found["end"][0]["late"], found["end"][0]["after_decision"]) == (0, after)
        ended += early
    assert ended or factor is None


def events_of(netlist: Netlist, seed: int, length: int = 30) -> np.ndarray:
    return sparse_events(seed, netlist.n_inputs, length, rate=0.15)


def play(stream: Stream, events: np.ndarray) -> list[Step]:
    """All steps of a recording (n_inputs, T), to its end."""
    return [*(stream.step(column) for column in events.T), *stream.finish()]


def assert_is_run(netlist: Netlist, steps: list[Step], events: np.ndarray) -> None:
    """Spikes of every layer, votes and decisions of all chip steps are those of the engine."""
    trace = engine.simulate(netlist, events[None], spikes=True, threads=1)
    assert [step.index for step in steps] == list(range(events.shape[1] + netlist.max_depth))
    for layer in range(len(netlist.layers)):
        found = np.array([step.spikes[layer] for step in steps], np.bool_)
        found = found.reshape(len(steps), netlist.layers[layer].neurons)
        expected = np.zeros_like(found)
        ids = netlist.compartments_of(layer)
        expected[:, netlist.neuron[ids]] = trace.spikes[0][:, ids]
        assert_array_equal(found, expected, strict=True)
    so_far = np.cumsum(trace.spikes[0], axis=0)
    votes = class_counts(netlist, so_far)
    assert_array_equal(
        np.array([s.counts for s in steps], np.int64).reshape(votes.shape), votes, strict=True
    )
    assert [step.decision for step in steps] == votes.argmax(axis=1).tolist()


@given(st.data())
def test_any_network(data):
    netlist = voting(data.draw(netlists(weight_exponents=(-1, 0, 0, 3))), data.draw(st.integers(1, 3)))
    events = data.draw(recordings(netlist, max_length=12))
    stream = Stream(engine.prepare(netlist, stepwise=True))
    expected = None
    try:
        engine.simulate(netlist, events[None], threads=1)
    except NumericRangeError as error:
        expected = str(error)
    if expected is None:
        assert_is_run(netlist, play(stream, events), events)
    else:
        assert refused(NumericRangeError, "", play, stream, events) == expected
        refused(DataError, "", stream.step, events[:, 0] * 0)


FORMS = {
    "list": lambda column: column.tolist(),
    "float32": lambda column: column.astype(np.float32),
    "bool": lambda column: column.astype(np.bool_),
    "sensor": lambda column: np.asfortranarray(column.reshape(10, 2)),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_forms_of_events(form):
    netlist, events = LIVELY, events_of(LIVELY, 4)
    stream, steps = Stream(engine.prepare(netlist, stepwise=True)), []
    for column in events.T:
        given_events = form(column)
        steps.append(stream.step(given_events))
        if isinstance(given_events, np.ndarray) and not np.shares_memory(given_events, events):
            given_events[:] = 1  # is not kept
    assert_is_run(netlist, [*steps, *stream.finish()], events)


@pytest.mark.parametrize(
    ("counts", "decision", "margin"),
    [([0, 0, 0], 0, 0), ([1, 4, 2], 1, 2), ([3, 5, 5], 1, 0), ([7], 0, 7), ([2, 9], 1, 7)],
)
def test_decision_and_margin(counts, decision, margin):
    step = Step(index=0, spikes=(), counts=np.array(counts))
    assert (step.decision, step.margin) == (decision, margin)


@pytest.mark.parametrize(
    ("events", "found"),
    [
        (np.zeros(19), "shape (19,) found, allowed are (10, 2) (taxels, polarities) and (20,)"),
        (1, "shape () found"),
        (["1"] * 20, "type <U1 found, allowed are numbers and bool"),
        ([0] * 19 + [2], "the value 2 found, allowed are 0 and 1"),
    ],
)
def test_events_that_are_none(events, found):
    netlist = LIVELY
    stream = Stream(engine.prepare(netlist, stepwise=True))
    refused(DataError, f"stream: a bin |{found}", stream.step, events)
    # nothing has happened: the grasp goes on
    good = events_of(netlist, 6)
    assert_is_run(netlist, play(stream, good), good)


def test_an_overflow_or_its_end_ends_the_stream_until_reset():
    axons = [Axon(source=0, exponent=7, targets=((0, 254), (0, 254))), Axon(source=1, targets=((0, 110),))]
    netlist = build([Neuron()], axons, n_inputs=2, depths=[0])
    stream = Stream(engine.prepare(netlist, stepwise=True))
    refused(NumericRangeError, "", stream.step, [1, 0])
    refused(DataError, "", stream.step, [0, 0])
    refused(DataError, "", stream.finish)
    stream.reset()
    assert stream.step([0, 1]).spikes[0].tolist() == [True]
    stream.finish()
    refused(DataError, "a step after the end found|call reset()", stream.step, [0, 0])
    refused(DataError, "a second end found|call reset()", stream.finish)
