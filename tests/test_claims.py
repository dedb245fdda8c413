"""Numbers in the docs that come from a stored result are that result's: ``benchmarks/claims.toml`` says which."""

import csv
import json
import re
import statistics
import tomllib
from fractions import Fraction
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
CLAIMS, DEFINITIONS = tomllib.loads((ROOT / "benchmarks" / "claims.toml").read_text("utf-8")).values()
PAGES = (
    "README.md",
    *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")),
    "models/pretrained/README.md",
)
PLACE = re.compile(r"\{([^{}]+)\}")
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r"^\$ (spikeloom .+)\n((?:(?!\$ |```).*\n)*)", re.MULTILINE)
CODE = re.compile(r"`[^`]*`|\]\([^)]*\)")
UNITS = r"%|×|[µmnp]?[JWs]\b|[MGk]i?B?\b|(?:points?|times|cores?|operations|spikes|ticks|of \d[\d,]*)\b"
NUMBER = re.compile(rf"(?<!\w)\d[\d,.]*(?: ?(?:{UNITS})| *(?=\|))")
"""With a unit, of so many, or alone in a cell of a table."""

DRAWN = {"growth", "skins", "fuzz", "public", "convolutions"}  # results of made recordings or damages


@cache
def stored(name):
    """Content of a results file; rows of a CSV file by data, system and graph."""
    text = (RESULTS / name).read_text("utf-8")
    if name.endswith(".json"):
        return json.loads(text)
    rows = csv.DictReader(text.splitlines())
    return {f"{row['data']}/{row['system']}/{row['form']}": row for row in rows}


def value_at(content, path):
    """What is at ``a/b/c``; keys may hold slashes, ``*`` is every entry, ``key=value`` or a number one of a list."""
    if not path:
        return content
    if path.startswith("*"):
        entries = content.values() if isinstance(content, dict) else content
        return [value_at(each, path[2:]) for each in entries]
    if isinstance(content, list):
        head, _, rest = path.partition("/")
        if head.isdigit():
            return value_at(content[int(head)], rest)
        wanted = dict(each.split("=") for each in head.split(","))
        return value_at(
            next(each for each in content if all(str(each[key]) == value for key, value in wanted.items())),
            rest,
        )
    key = max((key for key in content if f"{path}/".startswith(f"{key}/")), key=len, default=path)
    return value_at(content[key], path[len(key) + 1 :])


def shown(content, place):
    """Text of ``path``, ``path; format`` or ``path; factor; format``."""
    path, *factor, form = (part.strip() for part in (place if ";" in place else f"{place}; text").split(";"))
    value, factor, (*word, form) = value_at(content, path), float(Fraction(*factor or "1")), form.split(" ")
    if form == "text":
        return str(value)
    if form == "spread":
        low, high = (factor * end for end in value["interval"])
        return f"{factor * value['mean']:.2f}, {factor * value['std']:.2f} ({low:.2f} … {high:.2f})"
    many = [factor * float(each) for each in (value if word else [value])]
    found = {"mean": [statistics.fmean(many)], "max": [max(many)], "range": [min(many), max(many)]}
    return " to ".join(format(round(each, 9), form) for each in found[word[0] if word else "mean"])


def plain(text):
    return " ".join(text.split())


def bound(claim):
    """Texts that a page must have."""
    content = value_at(stored(claim["result"]), claim.get("at", ""))
    for text in claim["texts"]:
        assert PLACE.search(text), f"{text}: binds no number"
        yield PLACE.sub(lambda place: shown(content, place[1]), text)


@pytest.mark.parametrize("claim", CLAIMS, ids=[f"{claim['page']}, {claim['result']}" for claim in CLAIMS])
def test_texts_are_those_of_the_stored_results(claim):
    page = plain((ROOT / claim["page"]).read_text("utf-8"))
    assert [text for text in bound(claim) if text not in page] == []


@pytest.mark.parametrize("page", PAGES)
def test_every_number_is_that_of_a_result_or_a_definition(page):
    text = plain(FENCED.sub("", (ROOT / page).read_text("utf-8")))
    defined = [
        each for definition in DEFINITIONS if definition["page"] == page for each in definition["texts"]
    ]
    assert all(each in text for each in defined)
    said = [*defined, *(each for claim in CLAIMS if claim["page"] == page for each in bound(claim))]
    known = [
        found.span() for each in (CODE.pattern, *map(re.escape, said)) for found in re.finditer(each, text)
    ]
    places = {place for span in known for place in range(*span)}
    loose = [found for found in NUMBER.finditer(text) if not places.issuperset(range(*found.span()))]
    assert [text[max(0, found.start() - 40) : found.end()] for found in loose] == []


@pytest.mark.parametrize("page", PAGES[1:-1])
def test_sessions_print_what_the_docs_show(page):
    for command, text in SHOWN.findall((ROOT / page).read_text("utf-8")):
        if text.strip(" \n…"):
            lines = "".join(
                "(.*\n)*" if line == "…" else f"{re.escape(line)}\n" for line in text.rstrip().splitlines()
            )
            assert re.fullmatch(lines, stored(f"shown/{Path(page).stem}.json")["figures"][command]), command


def results():
    """Name and content of what studies stored; each cell of the paper's tables has its own."""
    yield from stored("paper/cells.json").items()
    for file in sorted({*RESULTS.glob("*.json"), *RESULTS.glob("shown/*.json")} - {RESULTS / "faults.json"}):
        yield file.stem, stored(str(file.relative_to(RESULTS)))


@pytest.mark.parametrize(("name", "made"), [pytest.param(*each, id=each[0]) for each in results()])
def test_results_say_what_made_them(name, made):
    assert made["command"]
    assert made["spikeloom"]
    assert name in DRAWN or made.get("data_sha256") or made["data"]["sha256"]
