"""Every way in and every way to an answer: the product of two lists, which ``test_matrix`` runs.

A *way out* is a row of :data:`WAYS_OUT`: a command, or a function in Python, and how its answer is read; ways in are in
``ways_in``. What cannot be is in :data:`REFUSED`, by what the network is and what is asked, with words of the refusal.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import commands
import numpy as np
import onnxruntime
import plain_count
import zoo
from ways_in import FORMATS, WAYS_IN, Made, lines_of, ran, record

import spikeloom
from spikeloom.compiler.errors import SpikeloomError
from spikeloom.compiler.formats import CHECKPOINTS
from spikeloom.runtime.compiled import Compiled

Answer = dict[str, Any]
"""What a way out says of the test recordings; its keys are those of :func:`truth`."""


class RefusedError(Exception):
    """What was asked is refused by the product, in one line."""


@dataclass(frozen=True, eq=False)
class Case:
    """A way in, made, recorded and compiled."""

    name: str
    made: Made
    folder: Path
    test: Sequence[np.ndarray] = field(repr=False)  # (taxels, polarities, bins) each

    @property
    def data(self) -> str:
        return str(self.folder / f"data{FORMATS[self.made.recorded][0]}")

    @property
    def netlist(self) -> str:
        return str(self.folder / "net.loom")

    @property
    def network(self) -> str:
        assert self.made.network is not None
        return str(self.folder / self.made.network)

    @property
    def reading(self) -> list[str]:
        return self.made.reading.format(folder=self.folder).split()

    @cached_property
    def compiled(self) -> Compiled:
        """The same in Python."""
        if self.made.module is not None:
            module, example = self.made.module()
            given = {"calibrate": spikeloom.recordings(self.data), "weight_bits": "8"}
            return spikeloom.compile(module, example=example, **given)
        return spikeloom.load(self.netlist, network=self.network, **self.keywords)

    @property
    def keywords(self) -> dict[str, Any]:
        """Options that say how the network is read, in Python."""
        names = [word.removeprefix("--").replace("-", "_") for word in self.reading[::2]]
        numbers = {"run": int, "dt": float, "polarities": int}
        given = zip(names, self.reading[1::2], strict=True)
        return {name: numbers.get(name, str)(value) for name, value in given}

    @cached_property
    def said(self) -> dict:
        """The manifest of the netlist."""
        return plain_count.opened(Path(self.netlist)).said

    @cached_property
    def traits(self) -> set[str]:
        """What may be refused by name."""
        traits = {self.name, self.said["target"]}
        traits |= {"integers"} if not self.made.rounded and self.said["target"] == "loihi1" else set()
        traits |= {"free-running"} if "blank" in self.said else set()
        traits |= {"memory"} if self.made.network is None else set()
        traits |= {"polarities"} if self.made.polarities != 2 else set()
        whole = self.made.network is not None and not self.made.network.endswith(CHECKPOINTS)
        return traits | ({"whole file"} if whole else set())

    def typed(self, *words: object) -> Any:
        """What a command prints with ``--json``; RefusedError with its line."""
        code, out, err = commands.run(*words, "--json")
        if code == 2:
            lines = err.splitlines()
            assert out == "", out
            assert lines[-1].startswith("spikeloom: ")
            raise RefusedError(" | ".join(lines))
        return [json.loads(line) for line in out.splitlines()]


@cache
def truth(made: Case, netlist: str | None = None, window: int | None = None) -> Answer:
    """What every answer is due to say: from the arrays of its netlist, or of another one, on a part of recordings."""
    counted = plain_count.counted(Path(netlist or made.netlist), made.test, window or made.made.window)
    labels = np.arange(len(made.test)) % made.made.classes
    energy = counted.energy

    def of_all(values: np.ndarray) -> list[float]:
        return [float(values.mean()), float(values.min()), float(values.max())]

    return {
        "decisions": counted.decisions,
        "votes": counted.votes.tolist(),
        "right": int((counted.decisions == labels).sum()),
        "spikes": counted.spikes.sum(axis=0).tolist(),
        "spikes of one": counted.spikes[1].tolist(),
        "operations": of_all(counted.operations),
        "energy": {table: of_all(joules) for table, joules in energy.items()},
        "mean operations": float(counted.operations.mean()),
        "mean energy": {table: float(joules.mean()) for table, joules in energy.items()},
    }


@cache
def case(name: str) -> Case:
    """A way in, made once a run."""
    folder = zoo.place() / f"way {name}".replace(" ", "-")
    folder.mkdir()
    made = WAYS_IN[name](folder)
    made_case = Case(name, made, folder, record(folder, made))
    if made.network is None:
        made_case.compiled.save(made_case.netlist)
    else:
        compile_as(made_case, made.compiling, made_case.netlist)
    return made_case


STORAGE_OPTIONS = ("--weight-bits", "--planes", "--scale-groups")


def compile_as(made: Case, options: str, output: str) -> None:
    """Compile the network of a case; what is stored in 8 bits unless options, or its file, say otherwise."""
    words = options.split()
    tuned = {"fine-tuned", "joined-tuned", "fine-tuned by command", "NIR fine-tuned by command"}
    if made.made.rounded:
        words += ["--calibrate", made.data]
        own = made.name in tuned or any(option in words for option in STORAGE_OPTIONS)
        words += [] if own else ["--weight-bits", "8"]
    ran("compile", made.network, *made.reading, *words, "-o", output)


# -- ways out ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class WayOut:
    """A command and the door through which it is asked; what asks it gives its answer."""

    command: str
    door: str  # ``typed``, ``Python``, or ``cluster``
    ask: Callable[[Case], Answer]
    slow: bool = False  # Whether it takes seconds
    long: bool = False  # Whether it takes long enough that some ways in are enough by default


WAYS_OUT: dict[str, WayOut] = {}


def way_out(name: str, command: str, door: str = "typed", **about: bool):
    """Register a way to an answer by the function that asks."""

    def register(ask: Callable[[Case], Answer]) -> Callable[[Case], Answer]:
        WAYS_OUT[name] = WayOut(command, door, ask, **about)
        return ask

    return register


def _run(found: Any, _: Case) -> Answer:
    return {"decisions": found["predictions"], "votes": found["counts"]}


def _verify(found: Any, made: Case) -> Answer:
    assert found["spec_equals_engine"]
    assert found["engine_different"] in (None, 0)
    spikes = {"spikes": [layer["chip"] for layer in found["spikes"].values()]} if found["spikes"] else {}
    return {"right": round(found["accuracy"]["chip"] * len(made.test))} | spikes


def _estimate(found: Any, _: Case) -> Answer:
    three = [found[name] for name in ("per_inference", "min", "max")]
    operations = "synaptic_operations" if "synaptic_operations" in three[0] else "synaptic_events"
    return {
        "operations": [each[operations] for each in three],
        "energy": {table: [each["energy_j"][table] for each in three] for table in three[0]["energy_j"]},
    }


def _report(found: Any, made: Case) -> Answer:
    right = {"decisions": found["decisions"]["chip"]}
    return _verify(found["verify"], made) | _estimate(found["costs"], made) | right


def _explain(found: Any, _: Case) -> Answer:
    return {"spikes of one": [layer["chip_spikes"] for layer in found["layers"]]}


def _stress(found: Any, made: Case) -> Answer:
    """The clean run; and each perturbation at the level at which it does nothing."""
    clean = found["clean"]["right"]["chip"]
    for name, curve in found["perturbations"].items():
        (level,) = curve["levels"]
        assert round(level["chip"]["mean"] * len(made.test)) == clean, name
        assert level["stopped"] == 0, name
    assert found["perturbations"].keys() | found["not_applicable"].keys() == {
        name for name, level in NEUTRAL.items() if not isinstance(level, str)
    }
    return {"right": clean, "spikes": [layer[1] for layer in found["clean"]["layers"].values()]}


def _costs(found: Any) -> Answer:
    return {"mean operations": found["operations"], "mean energy": found["energy_j"]}


def _anytime(found: Any, _: Case) -> Answer:
    assert found["windows"][-1]["chip"]["correct"] == found["full"]["correct"]
    assert found["rules"][0]["differ"] == 0
    ends = {"decisions": found["decisions"], "right": found["full"]["correct"]}
    return ends | _costs(found["full"])


def _certify(found: Any, _: Case) -> Answer:
    return {"decisions": [each["decision"] for each in found["certificates"]]}


NEUTRAL: dict[str, float | str] = {
    **dict.fromkeys(("taxels_dead", "taxels_dead_adjacent", "taxels_stuck", "taxels_stuck_adjacent"), 0),
    **dict.fromkeys(("events_lost", "events_spurious", "time_jitter", "start_late", "start_early"), 0),
    **dict.fromkeys(("faster", "slower", "longer", "near_empty"), 1),
    **dict.fromkeys(("polarity_swapped", "saturated", "weight_bit_flips", "neurons_silent"), 0),
    **dict.fromkeys(("neurons_firing", "threshold_spread", "ties_fire", "layers_late"), 0),
    **dict.fromkeys(("threshold_raised", "threshold_lowered", "shorter_decay"), 1),
    "fewer_bits": 8,
    "warm_state": "another recording comes first at every level",
}
"""Of each perturbation the level at which it does nothing, or why it has none."""

LONG = ("report", "stress", "certify")
"""Those of the next that take a tenth of a second."""

BY_BOTH_DOORS: dict[str, tuple[str, Callable[[Any, Case], Answer]]] = {
    "run": ("", _run),
    "verify": ("--spec-samples 1", _verify),
    "estimate": ("", _estimate),
    "report": ("--spec-samples 1", _report),
    "explain": ("--sample 1", _explain),
    "stress": ("--seeds 1 --jobs 1", _stress),
    "anytime": ("", _anytime),
    "certify": ("--limit 2 --shift 1 --most 1 --jobs 1", _certify),
}
"""Commands that are methods, too: options, and how their JSON is read."""

COMPARING = ("verify", "report", "explain", "stress")
"""Those of them that take the network beside the netlist."""


def _typed(command: str, made: Case, options: str) -> Any:
    network = made.made.network
    beside = ["--checkpoint", made.network, *made.reading] if command in COMPARING and network else []
    page = ["-o", made.folder / "page.html"] if command == "report" else []
    (found,) = made.typed(command, made.netlist, *beside, "--data", made.data, *options.split(), *page)
    return found


def _in_python(command: str, made: Case, options: str) -> Any:
    words = [word.removeprefix("--").replace("-", "_") for word in options.split()]
    given: dict[str, Any] = {name: int(value) for name, value in zip(words[::2], words[1::2], strict=True)}
    page = [str(made.folder / "page.html")] if command == "report" else []
    try:
        found = getattr(made.compiled, command)(*page, spikeloom.recordings(made.data), **given)
    except SpikeloomError as error:
        raise RefusedError(str(error)) from None
    return json.loads(found.to_json())


def _by_both_doors(command: str, options: str, read: Callable[[Any, Case], Answer]) -> None:
    long = command in LONG
    way_out(command, command, long=long)(lambda made: read(_typed(command, made, options), made))
    way_out(f"Python {command}", command, "Python", long=long)(
        lambda made: read(_in_python(command, made, options), made)
    )


for _command, (_options, _read) in BY_BOTH_DOORS.items():
    _by_both_doors(_command, _options, _read)


@way_out("run and estimate of a part", "run")
def _of_a_part(made: Case) -> Answer:
    decided, costs = (_typed(command, made, "--window 40%") for command in ("run", "estimate"))
    return _run(decided, made) | _estimate(costs, made) | {"window": 40}


@way_out("estimate by the cycle", "estimate")
def _by_cycle(made: Case) -> Answer:
    return _estimate(_typed("estimate", made, "--detail cycle"), made)


@way_out("verify beside onnxruntime", "verify", long=True)
def _beside_onnx(made: Case) -> Answer:
    return _verify(_typed("verify", made, "--engine onnx --spec-samples 1"), made)


@way_out("certify on a cluster", "certify", "cluster", slow=True)
def _on_cluster(made: Case) -> Answer:
    return _certify(_typed("certify", made, "--limit 2 --shift 1 --most 1 --scheduler local:1"), made)


def seen_by(made: Case) -> list[np.ndarray]:
    """Of each recording the part that the network takes, in its own bins."""
    return [each[..., : max(1, each.shape[-1] * made.made.window // 100)] for each in made.test]


@way_out("watch", "watch")
def _watch(made: Case) -> Answer:
    lines = [line for recording in seen_by(made) for line in [*lines_of(recording), ""]]
    (made.folder / "lines.csv").write_text("\n".join(lines) + "\n")
    found = made.typed("watch", made.netlist, "--input", made.folder / "lines.csv")
    grasps = [each for each in found if each["kind"] == "grasp"]
    return {
        name: [each[key] for each in grasps]
        for name, key in (("decisions", "decision"), ("votes", "counts"))
    }


@way_out("stream", "stream", "Python")
def _stream(made: Case) -> Answer:
    try:
        stream = made.compiled.stream()
    except SpikeloomError as error:
        raise RefusedError(str(error)) from None
    channels = made.made.taxels * made.made.polarities
    decisions, votes = [], []
    for recording in made.test:
        for events in plain_count.in_steps(recording, made.said, made.made.window)[:channels].T:
            stream.step(events)
        last = [*stream.finish()][-1:]
        votes += [step.counts.tolist() for step in last]
        decisions.append(stream.decision)
        stream.reset()
    return {"decisions": decisions} | ({"votes": votes} if votes else {})


def _as_charted(made: Case) -> str:
    """The netlist that a chart, or ``lean``, makes by itself."""
    if not made.made.compiling:
        return made.netlist
    plain = str(made.folder / "plain.loom")
    if not Path(plain).exists():
        compile_as(made, "", plain)
    return plain


def _charted(found: Any, made: Case) -> Answer:
    """Its one point; the netlist that it measured is the one that is compiled."""
    (point,) = found["points"]
    netlist = made.folder / "chart" / "netlists" / Path(point["netlist"]).name
    with np.load(netlist) as ours, np.load(_as_charted(made)) as theirs:
        for name in set(ours.files) - {"manifest", "sha256"}:
            assert np.array_equal(ours[name], theirs[name]), name
    return {"right": point["test"]["correct"]} | _costs(point["test"]) | {"netlist": str(netlist)}


@way_out("chart", "chart", long=True)
def _chart(made: Case) -> Answer:
    takes = made.made.network is not None and made.made.network.endswith(CHECKPOINTS)
    network = "module" if made.made.network is None else made.network
    grid = ["--grid", f"bits=8,window={made.made.window}%", "--jobs", "1", "-o", made.folder / "chart"]
    reading = made.reading if takes else []
    (found,) = made.typed("chart", network, *reading, "--data", made.data, *grid)
    return _charted(found, made)


@way_out("Python chart", "chart", "Python", long=True)
def _chart_in_python(made: Case) -> Answer:
    reading = made.keywords if made.made.network is not None and made.network.endswith(CHECKPOINTS) else {}
    network = "module" if made.made.network is None else made.network
    grid = f"bits=8,window={made.made.window}%"
    data, folder = spikeloom.recordings(made.data), str(made.folder / "chart")
    try:
        found = spikeloom.chart(network, data, folder, grid=grid, jobs=1, **reading)
    except SpikeloomError as error:
        raise RefusedError(str(error)) from None
    return _charted(json.loads(found.to_json()), made)


@way_out("lean", "lean", long=True)
def _lean(made: Case) -> Answer:
    network = "module" if made.made.network is None else made.network
    (found,) = made.typed("lean", network, *made.reading, "--data", made.data)
    whole = found["rows"][0]
    assert (whole["name"], whole["test"]["differ"]) == ("nothing", 0)
    return {"right": whole["test"]["right"]} | _costs(whole) | {"netlist": _as_charted(made)}


def _exported(made: Case, form: str, ending: str, *options: object) -> Path:
    path = made.folder / f"out-{form}.{ending}"
    made.typed("export", made.netlist, "--to", form, *options, "-o", path)
    return path


@way_out("export nir, compile, run, estimate", "export nir", long=True)
def _by_nir(made: Case) -> Answer:
    """The file brings its integers, but not where they lie, so that energies are those of the new netlist."""
    back = str(made.folder / "back.loom")
    words = made.made.compiling.split()
    layout = (
        words if {"--free-running", "--cores-for"} & set(words) else []
    )  # which changes what lists store
    made.typed("compile", _exported(made, "nir", "nir"), *layout, "-o", back)
    (found,) = made.typed("run", back, "--data", made.data)
    (costs,) = made.typed("estimate", back, "--data", made.data)
    there = truth(made)
    answer = _run(found, made) | _estimate(costs, made) | {"netlist": back}
    assert [answer["votes"], answer["operations"]] == [there["votes"], there["operations"]]
    return answer


@way_out("export onnx, onnxruntime", "export onnx")
def _by_onnx(made: Case) -> Answer:
    session = onnxruntime.InferenceSession(_exported(made, "onnx", "onnx").read_bytes())
    names = [port.name for port in session.get_outputs()]
    votes, decisions = [], []
    for recording in made.test:
        steps = plain_count.in_steps(recording, made.said, made.made.window)
        given = {"events": steps.T[:, None].astype(np.uint8)}
        found = dict(zip(names, session.run(names, given), strict=True))
        votes += found["votes"].tolist()
        decisions += found["class"].tolist()
    return {"votes": votes, "decisions": decisions}


OF_SOME = ("certify", "Python certify", "certify on a cluster")
"""Ways out that are asked about the first recordings only."""

IN_SHORT = ("released", "window", "module", "recurrent", "counters", "counters-crossbars", "native", "netx")
"""Ways in on which ways out that are long are asked by default."""

WIDE = ("mlp", "gcn", "grid-cnn", "binned", "joined", "joined-timed", "joined-tuned", "fine-tuned")
"""Ways in on 39 taxels that are asked nothing by default."""


# -- what cannot be ----------------------------------------------------------------------------------------------------
_ONE_CHIP = "is for IBM TrueNorth, which {} does not take; give one for another chip"
_INTEGERS = "holds integers, no float network to compare with; compile it, then inspect and run the netlist"
_NO_FILE = "the following arguments are required: --checkpoint"
_WINDOWS = "is free-running, which this cannot take; compile it without --free-running"
_CORES = "holds crossbar cores (--target truenorth), this is for cores of compartments (--target loihi1)"
_UNCOMPILED = "is a network trained for TrueNorth, not yet compiled"
_BY_BIN = "IBM TrueNorth: runs whole recordings, not bin after bin; give one for another chip"

REFUSED: dict[str, dict[str, str]] = {
    "truenorth": {
        **{command: _ONE_CHIP.format(command) for command in ("explain", "stress", "anytime")},
        "estimate by the cycle": "--detail cycle: truenorth has no such price model; allowed: counts",
        "verify beside onnxruntime": "--engine onnx: is not for IBM TrueNorth; omit it",
        "watch": _BY_BIN,
        "stream": _BY_BIN,
        "export nir": _CORES,
        "export onnx": _CORES,
    },
    "native": {"report": "there is no float model to show", "chart": _UNCOMPILED, "lean": _UNCOMPILED},
    "free-running": {
        **dict.fromkeys(("explain", "anytime", "certify"), _WINDOWS),
        **dict.fromkeys(
            ("verify beside onnxruntime", "export onnx"), "onnx: a free-running netlist has no windows"
        ),
    },
    "integers": {
        **dict.fromkeys(("verify", "report", "explain", "stress", "lean"), _INTEGERS),
        "chart": "is not a checkpoint; give a file of spikeloom train or of the released layout",
    },
    "memory": {
        **dict.fromkeys(("typed verify", "typed report", "typed explain", "typed stress"), _NO_FILE),
        **dict.fromkeys(("chart", "lean"), "module: no such file"),
    },
    "whole file": {"chart": "a chart takes checkpoints"},
    "polarities": {"watch": "per taxel found, event lines have 2"},
}
"""By trait of a network and by command, command with its door, or way out: words of the refusal."""

NO_ANSWER = {
    "demo": "run, verify and estimate of a shipped network, see test_readme",
    "doctor": "is about the installation",
    "compile": "makes every netlist here",
    "inspect": "is about a netlist, not recordings; its numbers are those of the file",
    "smallest": "trains its own networks; test_smallest repeats what it chose by its commands",
    "train": "a way in: trained counters",
    "finetune": "a way in: fine-tuned by command",
    "join": "a way in: joined by command",
    "data": "is about recordings alone, see test_data_commands",
    "load": "opens every network here in Python",
    "recordings": "opens all recordings here in Python",
    "export sanafe": "SANA-FE itself reads it in test_sanafe and benchmarks/agreement.py",
    "export ranc": "its terms run in test_truenorth_files, its hardware in test_cosimulation",
    "check": "compares files, runs nothing, see test_netlist_proof",
    "save": "copies a file",
}
"""Commands, functions and formats that are no way to an answer about recordings, and why."""


def refusal_of(made: Case, name: str) -> str | None:
    """Words of the refusal that is due, if one is."""
    way = WAYS_OUT[name]
    keys = (name, way.command, f"{way.door} {way.command}")
    for trait in sorted(made.traits):
        for key in keys:
            if key in REFUSED.get(trait, {}):
                return REFUSED[trait][key]
    return None
