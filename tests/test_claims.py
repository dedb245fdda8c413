"""What the docs say of stored results is those results'; ``benchmarks/claims.py`` says how, and here it is tested."""

import importlib
import json
import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DRAWN = {
    "certified",
    "convolutions",
    "first-spike",
    "fuzz",
    "growth",
    "interrupts",
    "public",
    "silicon-predictions",
    "skins",
    "soundness",
}
"""Results of made recordings, damages and other results."""


@pytest.fixture(scope="module")
def claims():
    """The script, as one that is run finds its neighbours."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        yield importlib.import_module("claims")


def test_tables_sentences_and_results_agree(claims):
    assert list(claims.Tree().faults()) == []


VERIFY, LIMITS, SHIPPED = "docs/verify.md", "docs/limits.md", "benchmarks/results/shipped.json"
OURS = "| `objects_manual.t7` (not ours) | 127 of 144 | 126 of 144 | 142 of 144 |"
EDITS = {
    "a cell of a table": {VERIFY: (OURS, OURS.replace("142 of", "143 of"))},
    "a number in prose": {LIMITS: ("in 142 of 144 recordings", "in 144 of 144 recordings")},
    "a unit": {"docs/cost.md": ("| 145 to 522 mJ | 194 to", "| 145 to 522 µJ | 194 to")},
    "a p value": {"docs/reproduce.md": ("(p at most 0.0007)", "(p at most 0.0001)")},
    "a digit": {"docs/stability.md": ("The 58,500 single changes", "The 98,500 single changes")},
    "none, always": {"docs/cost.md": ("194 to 266 µJ | none |", "194 to 266 µJ | always |")},
    "a renamed row": {VERIFY: ("| `pretrained:objects` | 126", "| `pretrained:containers` | 126")},
    "an invented share": {LIMITS: ("## Known", "It keeps 99.9 % of all spikes.\n\n## Known")},
    "an invented energy": {"README.md": ("## Install", "A decision takes 3 nJ.\n\n## Install")},
    "lower, higher": {"docs/cost.md": ("The lower end of its price", "The higher end of its price")},
    "Not the most accurate": {LIMITS: ("**Not the most accurate**", "**The most accurate**")},
    "a dropped negation": {"docs/training.md": ("and no gain in accuracy at", "and a gain in accuracy at")},
    "a chip for a simulator": {
        "docs/simulate.md": ("(a chip or Intel's simulator; it does not say)", "(a Loihi chip)")
    },
    "a boast": {
        "README.md": ("spikeloom compiles a trained", "Better than every machine, it compiles a trained")
    },
    "every limit of every chip": {
        "README.md": ("It checks the chip's published limits", "It keeps every limit of every Intel chip")
    },
    "points in words": {
        "docs/training.md": (
            "Lasting currents save operations",
            "Lasting currents gain twenty points, save operations",
        )
    },
    "millions": {
        "docs/cost.md": ("takes less at the sensor's pace**,", "takes less, by millions of times**,")
    },
    "more perturbations": {"docs/stress.md": ("A seeded battery of 26", "A seeded battery of 30")},
    "most of the wrong": {"docs/questions.md": ("On Objects 12 of the 18", "On Objects 17 of the 18")},
    "a unit in a header": {
        "docs/precision.md": (
            "| Objects | right | equal | spikes |",
            "| Objects | right | equal | thousands |",
        )
    },
    "swapped headers, verify": {VERIFY: ("| checkpoint | float | chip |", "| checkpoint | chip | float |")},
    "swapped headers, stability": {
        "docs/stability.md": (
            "| Objects, `objects_manual` | Objects, counters |",
            "| Objects, counters | Objects, `objects_manual` |",
        )
    },
    "swapped headers, reproduce": {
        "docs/reproduce.md": ("| Objects, best | Objects, last |", "| Objects, last | Objects, best |")
    },
    "a bound text in a false context": {
        LIMITS: ("## Known", "On a chip that was measured it takes 145 to 522 mJ.\n\n## Known")
    },
    "a number as code": {LIMITS: ("## Known", "It keeps `99.9 %` of all spikes.\n\n## Known")},
    "an invented definition": {
        LIMITS: ("## Known", "It keeps 99.9 % of all spikes.\n\n## Known"),
        "benchmarks/claims.toml": (
            "[[definitions]]",
            '[[definitions]]\npage = "docs/limits.md"\nsource = "compiler/storage.py"\n'
            'texts = ["It keeps 99.9 % of all spikes."]\n\n[[definitions]]',
        ),
    },
    "a page with its result": {
        VERIFY: (OURS, OURS.replace("142 of", "143 of")),
        LIMITS: ("in 142 of 144 recordings", "in 143 of 144 recordings"),
        SHIPPED: ('"equal": 142,', '"equal": 143,'),
    },
    "a result that README pictures": {"benchmarks/results/smallest-objects.json": ("135", "144")},
    "the changelog": {"CHANGELOG.md": ("### Gone", "TrueNorth takes 3 nJ a decision.\n\n### Gone")},
    "the list of studies": {
        "benchmarks/README.md": ("| ways to store weights | 5 |", "| ways to store weights | 1 |")
    },
    "an invented refusal": {LIMITS: ("## Known", "Wide networks are refused.\n\n## Known")},
    "a picture twice": {"README.md": ("## Install", "![x](benchmarks/results/stress.png)\n\n## Install")},
    "a result that no page quotes": {"benchmarks/results/fuzz.json": ("0", "1")},
}
"""Files, and what is replaced by what: edits that auditors once tried; of the first 31 nine were noticed."""


@pytest.mark.parametrize("edits", EDITS.values(), ids=EDITS)
def test_planted_edits_are_noticed(claims, edits):
    changed = {}
    for name, (old, new) in edits.items():
        text = (ROOT / name).read_text("utf-8")
        assert old in text, f"{name}: {old}"
        changed[name] = text.replace(old, new, 1)
    assert next(claims.Tree(changed).faults(), None) is not None


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.stem)
def test_sessions_print_what_the_docs_show(claims, page):
    for command, text in claims.SESSION.findall(page.read_text("utf-8")):
        if text.strip(" \n…"):
            lines = "".join(
                "(.*\n)*" if line == "…" else f"{re.escape(line)}\n" for line in text.rstrip().splitlines()
            )
            printed = claims.Tree().stored(f"shown/{page.stem}.json")["figures"][command]
            assert re.fullmatch(lines, printed), command


def test_pictures_are_drawn_from_what_is_stored(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        drawing = [importlib.import_module(name) for name in ("systems", "counting")]
    for picture in [each for script in drawing for each in script.draw(tmp_path)]:
        stored = RESULTS / picture.name
        assert re.search(rb"drawn from \w{64}", picture.read_bytes())[0] in stored.read_bytes()
        again, before = (plt.imread(file) for file in (picture, stored))
        assert again.shape == before.shape
        assert np.abs(again - before).mean() < 0.01  # the edges of letters may differ


def results():
    """Name and content of what studies stored; each cell of the paper's tables has its own."""
    yield from json.loads((RESULTS / "paper" / "cells.json").read_text("utf-8")).items()
    for file in sorted({*RESULTS.glob("*.json"), *RESULTS.glob("shown/*.json")} - {RESULTS / "faults.json"}):
        yield file.stem, json.loads(file.read_text("utf-8"))


@pytest.mark.parametrize(("name", "made"), [pytest.param(*each, id=each[0]) for each in results()])
def test_results_say_what_made_them(name, made):
    assert made["command"]
    assert made["spikeloom"]
    assert name in DRAWN or made.get("data_sha256") or made["data"]["sha256"]
