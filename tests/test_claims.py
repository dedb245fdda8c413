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
CLAIMS = tomllib.loads((ROOT / "benchmarks" / "claims.toml").read_text("utf-8"))["claims"]
PLACE = re.compile(r"\{([^{}]+)\}")


@cache
def stored(name):
    """Content of a results file; rows of a CSV file by data, system and graph."""
    text = (ROOT / "benchmarks" / "results" / name).read_text("utf-8")
    if name.endswith(".json"):
        return json.loads(text)
    rows = csv.DictReader(text.splitlines())
    return {f"{row['data']}/{row['system']}/{row['form']}": row for row in rows}


def value_at(content, path):
    """What is at ``a/b/c``, where keys may hold slashes, ``*`` is every entry and ``key=value`` that of a list."""
    if not path:
        return content
    if path.startswith("*"):
        return [value_at(each, path[2:]) for each in content]
    if isinstance(content, list):
        head, _, rest = path.partition("/")
        wanted = dict(each.split("=") for each in head.split(","))
        return value_at(
            next(each for each in content if all(str(each[key]) == value for key, value in wanted.items())), rest
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


@pytest.mark.parametrize("claim", CLAIMS, ids=[f"{claim['page']}, {claim['result']}" for claim in CLAIMS])
def test_texts_are_those_of_the_stored_results(claim):
    page = plain((ROOT / claim["page"]).read_text("utf-8"))
    content = value_at(stored(claim["result"]), claim.get("at", ""))
    for text in claim["texts"]:
        assert PLACE.search(text), f"{text}: binds no number"
        assert PLACE.sub(lambda place: shown(content, place[1]), text) in page


def test_results_say_what_made_them():
    cells = list(stored("paper/cells.json").values())
    for made in (*cells, *(stored(claim["result"]) for claim in CLAIMS if claim["result"].endswith(".json"))):
        assert made["command"]
        assert made.get("spikeloom") or made["data_sha256"]
