"""Recordings that are not what they seem: for each lie, whether commands refuse it, say it, or give the same answer.

One table. What nobody can know from the numbers is in it, too, with the reason: then the answer is another, in silence,
and a row fails as soon as something can be said.
"""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import commands
import numpy as np
import pytest

CLASSES, TAXELS, SECONDS, BIN = ("cork", "foam", "steel"), 6, 1.0, 0.05

Event = tuple[float, int, int]
File = tuple[str, list[Event]]
"""Class and events of a recording."""
Folder = dict[str, list[File]]
"""Recordings of each split."""


def touches(seed: int, samples: int) -> list[File]:
    """Recordings whose class decides where and when there are events: rising ones first."""
    made = []
    for index in range(samples):
        kind = index % len(CLASSES)
        rng = np.random.default_rng([seed, index])
        time = np.sort(rng.uniform(0.01, SECONDS, 80)).round(3)
        taxel = np.where(
            rng.random(80) < 0.7, 2 * kind + rng.integers(0, 2, 80), rng.integers(0, TAXELS, 80)
        )
        polarity = time < (0.3 + 0.2 * kind)
        made.append(
            (CLASSES[kind], [(t, int(n), int(p)) for t, n, p in zip(time, taxel, polarity, strict=True)])
        )
    return made


def truth() -> Folder:
    return {"train": touches(0, 18), "test": touches(1, 9)}


def write(folder: Path, data: Folder) -> Path:
    """Write recordings as event files with their class in the name."""
    shutil.rmtree(folder, ignore_errors=True)
    for split, files in data.items():
        (folder / split).mkdir(parents=True)
        for index, (kind, rows) in enumerate(files):
            lines = ["time_s,taxel,polarity", *(f"{t:g},{n},{p}" for t, n, p in rows)]
            (folder / split / f"touch_{index:02}_label_{kind}.csv").write_text("\n".join(lines))
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A network of counters and one that was trained by gradients, of the same recordings, and their netlists."""
    at = tmp_path_factory.mktemp("lies")
    write(at / "data", truth())
    (at / "places.csv").write_text("\n".join(f"{3 * n},{n % 2}" for n in range(TAXELS)))
    shared = ["--data", at / "data", "--bin", BIN, "--taxels", at / "places.csv"]
    for words in (
        ["train", "--system", "counters", *shared, "-o", at / "net.pt"],
        ["compile", at / "net.pt", "-o", at / "net.loom"],
        [
            "train",
            "--system",
            "mlp",
            "--features",
            "2",
            "--hidden",
            "8",
            "--epochs",
            "1",
            *shared,
            "-o",
            at / "mlp.pt",
        ],
        ["compile", at / "mlp.pt", "--weight-bits", "8", "-o", at / "mlp.loom"],
    ):
        code, _, err = commands.run(*words)
        assert code == 0, err
    return at


# -- lies --------------------------------------------------------------------------------------------------------------
Change = Callable[[Folder], Folder]


def each(change: Callable[[list[Event]], list[Event]], split: str = "test") -> Change:
    """The events of every recording of a split are others."""
    return lambda data: data | {split: [(kind, change(rows)) for kind, rows in data[split]]}


def event(change: Callable[[float, int, int], Event], split: str = "test") -> Change:
    """Every event of a split is another."""
    return each(lambda rows: [change(*row) for row in rows], split)


def classes(names: Mapping[str, str], split: str = "test") -> Change:
    """Classes of a split are called otherwise."""
    return lambda data: data | {split: [(names.get(kind, kind), rows) for kind, rows in data[split]]}


def without(kind: str, split: str) -> Change:
    return lambda data: data | {split: [one for one in data[split] if one[0] != kind]}


def first(change: Callable[[list[Event]], list[Event]]) -> Change:
    """The events of one recording are others."""
    return lambda data: data | {"test": [("cork", change(data["test"][0][1])), *data["test"][1:]]}


REFUSED, SAID, SAME, UNKNOWN = "refused", "said", "same", "unknown"
RUN = "run net.loom --data lie"
TRAIN = "train --system counters --data lie --bin 0.05 -o out.pt"
READING = (
    RUN,
    "run mlp.loom --data lie",
    "verify net.loom --checkpoint net.pt --data lie",
    "estimate net.loom --data lie",
    "anytime net.loom --data lie",
    "report net.loom --checkpoint net.pt --data lie -o out.html",
)


@dataclass(frozen=True)
class Lie:
    """What lies, what is due, and which words say it, or why nobody can know."""

    what: str
    change: Change
    due: str
    words: str
    lines: tuple[str, ...] = (RUN,)


PERMUTED = (3, 0, 5, 1, 4, 2)
SWAPPED = {"cork": "foam", "foam": "cork"}

LIES = (
    # taxels
    Lie(
        "taxels permuted", event(lambda t, n, p: (t, PERMUTED[n], p)), UNKNOWN, "recordings say no positions"
    ),
    Lie(
        "taxels count from 1",
        event(lambda t, n, p: (t, n + 1, p)),
        REFUSED,
        "they seem to count from 1",
        READING,
    ),
    Lie(
        "taxels count from 1, in training",
        lambda data: event(lambda t, n, p: (t, n + 1, p), "train")(
            event(lambda t, n, p: (t, n + 1, p))(data)
        ),
        SAID,
        "if these count from 1, count from 0",
        (TRAIN,),
    ),
    Lie(
        "another, smaller sensor",
        event(lambda t, n, p: (t, n // 3, p)),
        SAID,
        "has events of taxels 0..1 only",
    ),
    Lie(
        "another sensor of the same size",
        event(lambda t, n, p: (t, TAXELS - 1 - n, p)),
        UNKNOWN,
        "recordings say no more of a sensor than how many taxels there are",
    ),
    Lie("a broken taxel", event(lambda t, _, p: (t, 0, p)), SAID, "has events of taxels 0..0 only"),
    Lie("a taxel of -1", event(lambda t, n, p: (t, n or -1, p)), REFUSED, "taxel -1, allowed", (RUN, TRAIN)),
    Lie(
        "half a taxel",
        first(lambda rows: [(0.1, 1.5, 0), *rows]),
        REFUSED,
        "taxel 1.5, allowed",
        (RUN, TRAIN),
    ),
    # polarities
    Lie("polarity flipped", event(lambda t, n, p: (t, n, 1 - p)), UNKNOWN, "either may come first"),
    Lie("polarity 1 and 2", event(lambda t, n, p: (t, n, p + 1)), REFUSED, "polarity 2, allowed", READING),
    Lie("polarity -1 and 1", event(lambda t, n, p: (t, n, 2 * p - 1)), SAME, "that is the other code"),
    Lie(
        "polarity -1 and 0", event(lambda t, n, p: (t, n, p - 1)), REFUSED, "polarities -1 and 0 in one file"
    ),
    # classes
    Lie("names of classes exchanged", classes(SWAPPED), UNKNOWN, "a label is what its author says"),
    Lie(
        "a class that is not known",
        classes({"cork": "wood"}),
        REFUSED,
        "class 'wood', the network knows",
        READING,
    ),
    Lie(
        "classes numbered from 1",
        classes({name: str(index + 1) for index, name in enumerate(CLASSES)}),
        REFUSED,
        "class '1', the network knows cork, foam, steel",
        READING,
    ),
    Lie(
        "recordings in another order",
        lambda data: data | {"test": data["test"][::-1]},
        SAME,
        "a name has its class",
    ),
    Lie("a class is missing in test", without("foam", "test"), SAME, "the others keep their numbers"),
    Lie(
        "a class is missing in training",
        without("steel", "train"),
        REFUSED,
        "label steel, the training",
        (TRAIN,),
    ),
    Lie(
        "classes of two kinds",
        classes({"cork": "1"}),
        REFUSED,
        "class '1', the network knows cork",
        (RUN,),
    ),
    Lie("numbers and names", classes({"cork": "1"}, "train"), REFUSED, "give numbers", (TRAIN,)),
    # times
    Lie("events twice", each(lambda rows: [*rows, *rows]), SAME, "720 duplicates in a bin"),
    Lie("events from last to first", each(lambda rows: rows[::-1]), SAME, "711 out of order"),
    Lie(
        "time runs backwards",
        event(lambda t, n, p: (SECONDS - t, n, p)),
        UNKNOWN,
        "grasps end as they begin",
    ),
    Lie(
        "negative times",
        event(lambda t, n, p: (t - 0.5, n, p)),
        REFUSED,
        "allowed are finite times from 0",
        READING,
    ),
    Lie(
        "a time that is none",
        first(lambda rows: [(float("nan"), 0, 0), *rows]),
        REFUSED,
        "time nan s",
        (RUN, TRAIN),
    ),
    Lie(
        "an endless time",
        first(lambda rows: [(float("inf"), 0, 0), *rows]),
        REFUSED,
        "time inf s",
        (RUN, TRAIN),
    ),
    Lie("milliseconds", event(lambda t, n, p: (1000 * t, n, p)), SAID, "write seconds"),
    Lie("microseconds", event(lambda t, n, p: (1e6 * t, n, p)), REFUSED, "write seconds", READING),
    Lie(
        "times of a clock",
        event(lambda t, n, p: (1.7e9 + t, n, p)),
        REFUSED,
        "count from the start",
        READING,
    ),
    Lie(
        "times from an hour on", event(lambda t, n, p: (3600 + t, n, p)), SAID, "count times from the start"
    ),
    Lie(
        "other bins are asked for",
        lambda data: data,
        REFUSED,
        "trained on bins of 0.05 s",
        (f"{RUN} --bin 0.02",),
    ),
    Lie("silence", each(lambda rows: rows[:0]), REFUSED, "no events in any recording", READING),
    Lie("one silent recording", first(lambda rows: rows[:0]), SAID, "1 recording without events"),
    # splits
    Lie(
        "test is training",
        lambda data: data | {"test": data["train"]},
        SAID,
        "that trained the network",
        READING,
    ),
    Lie(
        "training and test exchanged",
        lambda data: {"train": data["test"], "test": data["train"]},
        SAID,
        "these are the 18 recordings that trained the network",
        READING,
    ),
    Lie(
        "training and test exchanged, and classes renamed",
        lambda data: classes(SWAPPED)({"train": data["test"], "test": data["train"]}),
        SAID,
        "these are the 18 recordings that trained the network",
    ),
    Lie(
        "training and test exchanged before training",
        lambda data: {"train": data["test"], "test": data["train"]},
        UNKNOWN,
        "no split says which it is",
        (TRAIN,),
    ),
    Lie(
        "a test recording is a training recording",
        lambda data: data | {"test": [data["train"][0], *data["test"]]},
        SAID,
        "1 of 10 test recordings are training recordings, too",
        (TRAIN, "smallest --data lie --bin 0.05 --levels 2 -o out.loom"),
    ),
    Lie(
        "a test recording is a training recording, for a network",
        lambda data: data | {"test": [data["train"][0], *data["test"]]},
        UNKNOWN,
        "a network remembers a hash of them all, not one of each",
    ),
    Lie(
        "other recordings than trained the networks of a chart",
        lambda data: {"train": data["test"], "test": data["train"]},
        REFUSED,
        "was trained on other recordings",
        ("chart mlp.pt --data lie --grid bits=8 --jobs 1 -o chart",),
    ),
)


def answers(words: str) -> tuple[int, object, str]:
    """Exit code, decisions by name of the recording, and what is said on standard error."""
    code, out, err = commands.run(*words.split(), *(["--json"] if words.startswith("run ") else []))
    if code or not words.startswith("run "):
        return code, None, err
    found = commands.json.loads(out)
    return code, sorted(zip(found["labels"], map(tuple, found["counts"]), strict=True)), err


@pytest.mark.parametrize("lie", LIES, ids=lambda lie: lie.what)
def test_a_lie_is_refused_said_or_harmless(lie, place, monkeypatch):
    monkeypatch.chdir(place)
    write(place / "lie", lie.change(truth()))
    for line in lie.lines:
        code, found, err = answers(line)
        warned = "warning:" in err.replace("warning: lie: the network was trained on data;", "")
        match lie.due:
            case "refused":
                assert (code, lie.words in err.splitlines()[-1]) == (2, True), err
                assert len(err.splitlines()[-1]) <= 311
            case "said":
                assert lie.words in err, (line, err)
            case "same":
                expected = answers(line.replace("lie", "data"))[1]
                assert set(found) <= set(expected)
            case "unknown":
                assert (code, warned) == (0, False), err


def test_the_lies_change_the_answer(place, monkeypatch):
    """What nobody can know is no idle matter: another answer comes of it."""
    monkeypatch.chdir(place)
    expected = answers(RUN.replace("lie", "data"))[1]
    changed = []
    for lie in LIES:
        if lie.due == UNKNOWN and lie.lines == (RUN,):
            write(place / "lie", lie.change(truth()))
            changed.append(answers(RUN)[1] != expected)
    assert sum(changed) >= 4
