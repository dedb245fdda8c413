"""What the docs say of stored results: tables made from them, sentences bound to them, and what is said without proof.

    python benchmarks/claims.py            # what is wrong, a line each
    python benchmarks/claims.py --write    # make the tables again, and the digests of the results

``tables.toml`` has the tables, ``claims.toml`` the sentences. In both ``{path; factor; format}`` stands for the value
at a path of the result (from `at` on), times a factor, in Python's format; the factor may be left out, and the format
with it; ``file.json:path`` is of another result. A path takes ``*`` for every entry that has the rest, and
``key=value,key=value`` for that of a list. Before a format ``mean``, ``max``, ``range`` and ``count`` (of what is true)
are of a list; ``spread`` is mean (interval).

A sentence with a number, a comparison or a refusal must be bound: to a result (``claims``; `holds` are comparisons that
must be true of it), to a test that fails where it is false (``proofs``), or to a file whose numbers it repeats
(``definitions``). Every result has its digest in ``results/SHA256SUMS``.
"""

import csv
import hashlib
import json
import operator
import re
import statistics
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = "benchmarks/results"
DIGESTS = f"{RESULTS}/SHA256SUMS"
RECORDS = ("CHANGELOG.md", "benchmarks/README.md")

PLACE = re.compile(r"\{([^{}]+)\}")
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
SESSION = re.compile(r"^\$ (spikeloom .+)\n((?:(?!\$ |```).*\n)*)", re.MULTILINE)
CODE = re.compile(r"`([^`]*)`|\]\([^)]*\)")
FIGURE = re.compile(r"\d[\d,.]*(?: ?%| .*)?")
"""Inline code and links; code that is a figure, with its unit."""

WORDS = r"(?:two|three|four|five|six|seven|eight|nine|ten|twelve|twenty|(?:hundred|thousand|million)s?)"
COUNTED = (
    "points?|times|cores?|operations|spikes|ticks|perturbations|decisions|recordings|votes|seeds|graphs|"
    "emulators|simulators"
)
UNITS = rf"%|×|[µmnp]?[JWs]\b|[MGk]i?B?\b|(?:{COUNTED}|of \d[\d,]*)\b"
NUMBER = re.compile(
    rf"(?<!\w)\d[\d,.]*(?: ?(?:{UNITS})| *(?=\|))|\bof \d[\d,]*\b(?!\.\d)|\b{WORDS} (?:{COUNTED}|of)\b",
    re.IGNORECASE,
)
"""With a unit, of so many, or alone in a cell of a table; in words, too."""

COMPARED = re.compile(
    r"\b(?:better|worse|best|worst|lower|higher|highest|lowest|cheaper|cheapest|faster|fastest|slower|slowest|"
    r"most accurate|as well as|as good as|never|always|outperforms?|beats?|state of the art|"
    r"shown to be|without loss|guarantee[sd]?|every (?:limit|machine|chip|spike|decision|case|network|system))\b",
    re.IGNORECASE,
)
"""What needs a result, a test or a definition."""

REFUSED = re.compile(r"\bexit codes?\b|\brefuse[sd]?\b|\bis assumed\b", re.IGNORECASE)
"""What the program does where something is wrong or open; it needs a test."""

PICTURE = re.compile(r"!\[[^\]]*\]\((?:[^()]*/)?([^()/]+)\)")
"""Name of a picture on a page; each is shown once."""

RELATIONS = {"<": operator.lt, "<=": operator.le, "==": operator.eq, ">": operator.gt, ">=": operator.ge}


def plain(text: str) -> str:
    """Text on one line."""
    return " ".join(text.split())


def value_at(content: Any, path: str) -> Any:
    """What is at ``a/b/c``; keys may hold slashes."""
    if not path:
        return content
    head, _, rest = path.partition("/")
    if head == "*":
        entries = content.values() if isinstance(content, dict) else content
        return [value_at(each, rest) for each in entries if not isinstance(each, dict) or _has(each, rest)]
    if isinstance(content, list):
        if head.isdigit():
            return value_at(content[int(head)], rest)
        wanted = dict(each.split("=") for each in head.split(","))
        found = [
            each for each in content if all(str(each.get(key)) == value for key, value in wanted.items())
        ]
        return value_at(found[0], rest)
    key = max((key for key in content if f"{path}/".startswith(f"{key}/")), key=len, default=path)
    return value_at(content[key], path[len(key) + 1 :])


def _has(entry: Mapping[str, Any], path: str) -> bool:
    return not path or any(f"{path}/".startswith(f"{key}/") for key in entry)


def form_of(value: Any, times: float, form: str) -> str:
    """A value as a format has it."""
    *word, form = form.split(" ")
    if form == "text":
        return str(value)
    if form == "spread":
        low, high = (times * end for end in value["interval"])
        return f"{times * value['mean']:.2f} ({low:.2f} … {high:.2f})"
    if word == ["count"]:
        return format(sum(map(bool, value)), form)
    many = [times * float(each) for each in (value if word else [value])]
    if word:
        reduce: dict[str, Callable[[list[float]], list[float]]] = {
            "mean": lambda found: [statistics.fmean(found)],
            "max": lambda found: [max(found)],
            "range": lambda found: [min(found), max(found)],
        }
        many = reduce[word[0]](many)
    return " to ".join(format(round(each, 9), form) for each in many)


class Tree:
    """Files of the repository, some of them edited in memory."""

    def __init__(self, edits: Mapping[str, str] | None = None) -> None:
        self.edits = dict(edits or {})
        self.results: dict[str, Any] = {}

    def read(self, name: str) -> str:
        """Text of a file."""
        return self.edits[name] if name in self.edits else (ROOT / name).read_text("utf-8")

    def stored(self, name: str) -> Any:
        """Content of a results file; rows of a CSV file by data, system and graph."""
        if name not in self.results:
            text = self.read(f"{RESULTS}/{name}")
            if name.endswith(".json"):
                self.results[name] = json.loads(text)
            else:
                rows = csv.DictReader(text.splitlines())
                self.results[name] = {f"{row['data']}/{row['system']}/{row['form']}": row for row in rows}
        return self.results[name]

    def filled(self, template: str, result: str, at: str = "") -> str:
        """A template with its places filled: ``path``, ``path; format`` or ``path; factor; format``."""

        def text(place: re.Match[str]) -> str:
            parts = place[1].split(";") if ";" in place[1] else [place[1], "text"]
            path, *factor, form = map(str.strip, parts)
            other, _, path = path.rpartition(":")
            try:
                content = self.stored(other) if other else value_at(self.stored(result), at)
                return form_of(value_at(content, path), float(Fraction(*factor or "1")), form)
            except (ArithmeticError, LookupError, OSError, TypeError, ValueError):
                return f"(nothing at {place[1]})"

        return PLACE.sub(text, template)

    @cached_property
    def tables(self) -> list[dict[str, Any]]:
        """Entries of ``tables.toml``."""
        return list(tomllib.loads(self.read("benchmarks/tables.toml"))["tables"])

    @cached_property
    def claims(self) -> dict[str, list[dict[str, Any]]]:
        """Entries of ``claims.toml`` by kind."""
        return tomllib.loads(self.read("benchmarks/claims.toml"))

    @cached_property
    def pages(self) -> list[str]:
        """Pages that are checked."""
        docs = sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").glob("*.md"))
        return ["README.md", *docs, "models/pretrained/README.md", *RECORDS]

    def made(self, table: Mapping[str, Any]) -> list[str]:
        """Header and rows of a table; ``<0>`` in its row is the first label of each of `rows`, and so on."""
        lines = [table["header"]]
        for labels in table["rows"]:
            parts = [table["row"], table.get("result", ""), table.get("at", "")]
            for number, label in enumerate(labels):
                parts = [part.replace(f"<{number}>", label) for part in parts]
            lines.append(re.sub(r"\|  (?=\|)", "| ", self.filled(*parts)))
        return lines

    def bound(self, claim: Mapping[str, Any]) -> list[str]:
        """Sentences of a claim."""
        result, at = claim["result"], claim.get("at", "")
        return [plain(self.filled(text, result, at)) for text in claim["texts"]]

    def written(self, page: str) -> str:
        """A page with its tables made again."""
        lines = self.read(page).split("\n")
        for table in self.tables:
            if table["page"] == page:
                header, *rows = self.made(table)
                start = lines.index(header) + 2
                end = next(at for at in range(start, len(lines) + 1) if not lines[at].startswith("|"))
                lines[start:end] = rows
        return "\n".join(lines)

    def faults(self) -> Iterator[str]:
        """What is wrong with the pages and the results."""
        for page in sorted({table["page"] for table in self.tables}):
            yield from self._tables(page)
        for claim in self.claims["claims"]:
            yield from self._claim(claim)
        for kind, check in {"definitions": self._definition, "proofs": self._proof}.items():
            for entry in self.claims[kind]:
                yield from check(entry)
        for page in self.pages:
            yield from self._loose(page)
        shown = Counter(name for page in self.pages for name in PICTURE.findall(self.read(page)))
        yield from (f"{name}: shown {times} times" for name, times in shown.items() if times > 1)
        yield from self._digests()

    def _tables(self, page: str) -> Iterator[str]:
        text = self.read(page)
        headers = [table["header"] for table in self.tables if table["page"] == page]
        missing = [header for header in headers if text.split("\n").count(header) != 1]
        yield from (f"{page}: no table, or two, under {header}" for header in missing)
        if not missing and self.written(page) != text:
            yield f"{page}: a table is not that of its result; benchmarks/claims.py --write makes it again"

    def _claim(self, claim: Mapping[str, Any]) -> Iterator[str]:
        page = plain(self.read(claim["page"]))
        for text in self.bound(claim):
            if page.count(text) != 1:
                yield f"{claim['page']}: {page.count(text)} times instead of once: {text}"
        for condition in claim.get("holds", ()):
            said = self.filled(condition, claim["result"], claim.get("at", ""))
            left, relation, right = said.rsplit(" ", 2)
            try:
                holds = RELATIONS[relation](float(left), float(right))
            except ValueError:
                holds = False
            if not holds:
                yield f"{claim['result']}: not true: {condition}: {said}"

    def _definition(self, entry: Mapping[str, Any]) -> Iterator[str]:
        page = plain(self.read(entry["page"]))
        if not (ROOT / entry["source"]).is_file():
            yield f"{entry['page']}: no such file: {entry['source']}"
            return
        source = re.sub(r"(?<=\d)[_,](?=\d)", "", self.read(entry["source"]))
        known = {float(number) for number in re.findall(r"\d+(?:\.\d+)?(?:e-?\d+)?", source)}
        for text in entry["texts"]:
            if plain(text) not in page:
                yield f"{entry['page']}: lacks: {text}"
            for number in re.findall(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?!\w)", CODE.sub("", text)):
                value = float(number.replace(",", ""))
                if known.isdisjoint(round(value * times, 9) for times in (1, 0.01, 0.001)):
                    yield f"{entry['page']}: {entry['source']} has no {number}: {text}"

    def _proof(self, entry: Mapping[str, Any]) -> Iterator[str]:
        page = plain(self.read(entry["page"]))
        if missing := [text for text in entry["texts"] if plain(text) not in page]:
            yield f"{entry['page']}: lacks: {missing[0]}"
        for test in entry["tests"]:
            file, _, name = test.partition("::")
            if f"def {name}(" not in self.read(f"tests/{file}"):
                yield f"{entry['page']}: no such test: {test}"

    def _said(self, page: str) -> Iterator[str]:
        """Texts of a page that something stands behind."""
        for claim in self.claims["claims"]:
            if claim["page"] == page:
                yield from self.bound(claim)
        for kind in ("definitions", "proofs"):
            yield from (
                plain(text) for each in self.claims[kind] if each["page"] == page for text in each["texts"]
            )
        for table in self.tables:
            if table["page"] == page:
                yield from map(plain, self.made(table))

    def _loose(self, page: str) -> Iterator[str]:
        """Numbers and comparisons with nothing behind them."""
        text = plain(FENCED.sub("", self.read(page)))
        known = [found.span() for said in self._said(page) for found in re.finditer(re.escape(said), text)]
        known += [found.span() for found in CODE.finditer(text) if not FIGURE.fullmatch(found[1] or "")]
        places = {place for span in known for place in range(*span)}
        for pattern in (NUMBER, COMPARED) if page in RECORDS else (NUMBER, COMPARED, REFUSED):
            for found in pattern.finditer(text):
                if not places.issuperset(range(*found.span())):
                    yield f"{page}: nothing stands behind: …{text[max(0, found.start() - 60) : found.end() + 20]}…"

    def _digests(self) -> Iterator[str]:
        listed = dict(line.split("  ")[::-1] for line in self.read(DIGESTS).splitlines())
        found = digests(self)
        for name in sorted({*listed, *found}):
            if listed.get(name) != found.get(name):
                yield f"{RESULTS}/{name}: edited, or not what SHA256SUMS lists"


def digests(tree: Tree) -> dict[str, str]:
    """SHA-256 of each result."""
    found = {}
    for file in sorted((ROOT / RESULTS).rglob("*")):
        name = str(file.relative_to(ROOT))
        if file.is_file() and name != DIGESTS:
            data = tree.edits[name].encode() if name in tree.edits else file.read_bytes()
            found[str(file.relative_to(ROOT / RESULTS))] = hashlib.sha256(data).hexdigest()
    return found


def main() -> None:
    """Say what is wrong, or make tables and digests again."""
    tree = Tree()
    if sys.argv[1:] == ["--write"]:
        for page in {table["page"] for table in tree.tables}:
            (ROOT / page).write_text(tree.written(page), "utf-8")
        lines = [f"{digest}  {name}\n" for name, digest in digests(tree).items()]
        (ROOT / DIGESTS).write_text("".join(lines), "utf-8")
        tree = Tree()
    faults = list(tree.faults())
    print("\n".join(faults) or "every table, sentence and result is as it should be")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
