"""Count the small faults in the numeric modules that the tests notice.

    python benchmarks/plant_faults.py --tree . --list 60 --seed 2026 > faults.json
    python benchmarks/plant_faults.py --tree . --map map.json
    python benchmarks/plant_faults.py --tree . --faults faults.json --tests map.json --out scores.json

The first command draws faults, evenly over the modules. The second runs each test file once without any fault and
writes, for each module, the files to try: its own doctests, the test file named after it, then those that import it,
those named after its importers first, then nearest and quickest; tests that fail there are left out. The third plants
one fault at a time in the tree, runs these files up to the first failure, and puts the source back. A fault is found
again by its line, its neighbours and its function, in whatever file they are now, so that two trees can be compared:
take the faults from the older one. The second and third go on where they were stopped. Give them a clone of the tree
that nobody else works in. A line that has been rewritten is "gone", and the closest one there is gets printed: edit
``text``, ``mutated`` and ``function`` in a copy of the faults by hand.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
from collections import defaultdict, deque
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

NUMERIC = {
    "compiler": "dynamics interpret",
    "compiler/passes": "calibrate expand prune",
    "compiler/targets/loihi1": "bounds emit integers legalize lift registers remove",
    "compiler/targets/loihi1/layout": "choose core_needs partition place",
    "compiler/targets/loihi1/storage": "choose_storage compensate held_out ladder scales spike_exact weight_storage",
    "compiler/targets/truenorth": "legalize lower native",
    "models": "graphs",
    "models/networks": "layers lif quantised reference",
    "models/truenorth": "neurons",
    "runtime/studies": "neurobench",
    "runtime/equivalence": "reference tallies verdict verify",
    "runtime/machines": "votes",
    "runtime/machines/loihi1": "block_kernel blocks engine kernel rounding spec",
    "runtime/machines/loihi1/costs": "cost cumulative timing timing_kernel",
    "runtime/machines/truenorth": "cost engine kernel spec twins",
    "runtime/report": "numbers",
    "runtime/studies/anytime": "exits",
}
"""Modules to plant faults in, by folder."""

OTHER = "tests", "benchmarks", "docs", "examples", "build", "dist", "setup.py"
"""Folders without product code."""

OPERATORS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "+"), ast.FloorDiv: ("//", "*"), ast.BitAnd: ("&", "|"),
    ast.RShift: (">>", "<<"), ast.LShift: ("<<", ">>"), ast.And: ("and", "or"), ast.Or: ("or", "and"),
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"), ast.Eq: ("==", "!="),
}  # fmt: skip
EXTREMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}
WEIGHTS = {"arithmetic": 3, "comparison": 3, "constant": 3, "logic": 2, "slice": 2, "extreme": 1}
"""How often each kind is drawn where a module has it."""

HARMLESS = {"axis", "maxsize", "stacklevel", "indent", "ndmin"}
"""Keywords whose numbers say nothing about results, or fail at once."""

KERNEL = re.compile(r"\b(numba|njit|compiled|compiled_and_cached|intrinsic)\b")
"""How a file looks that has to do with machine code, which other files may have in their caches."""

MEMORY, PATIENCE = 12 << 30, 4
"""Bytes that a run may ask for, and its longest time by the clock, as a multiple of that by the processor."""
PYTEST = ["-m", "pytest", "-n0", "-p", "no:cacheprovider", "-q", "--tb=line", "--hypothesis-seed=0"]
Fault = dict[str, Any]
Edit = tuple[str, str, ast.expr | None, ast.expr]
"""Kind, new text, and the two expressions between which the old text stands (or the expression that is replaced)."""


def files(tree: Path, *but: str) -> list[Path]:
    """List the Python files of a tree, except for hidden folders and those named."""
    there = ((p, p.relative_to(tree).parts) for p in sorted(tree.rglob("*.py")))
    return [
        p for p, parts in there if not {*parts} & {*but} and not any(part.startswith(".") for part in parts)
    ]


def _walk(node: ast.AST, function: str) -> Iterator[tuple[str, ast.AST]]:
    """Nodes that compute something, with the function or class that they stand in."""
    children: list[ast.AST | None] = list(ast.iter_child_nodes(node))
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return
    if isinstance(node, ast.FunctionDef):
        if isinstance(node.returns, ast.Name) and node.returns.id == "str":
            return  # a text for people
        children = [*node.args.defaults, *node.args.kw_defaults, *node.body]
    elif isinstance(node, ast.ClassDef):
        children = [*node.body]
    elif isinstance(node, ast.AnnAssign):
        children = [node.value]
    elif (
        (isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) in {"__slots__", "__all__"})
        or (isinstance(node, ast.Call) and re.search(r"(Error|Warning|warn)$", ast.unparse(node.func)))
        or (isinstance(node, ast.keyword) and node.arg in HARMLESS)
    ):
        return
    yield function, node
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        function = f"{function}.{node.name}".lstrip(".")
    for child in children:
        if child is not None:
            yield from _walk(child, function)


def _number(node: ast.AST | None) -> bool:
    if isinstance(node, ast.UnaryOp):
        return _number(node.operand)
    return isinstance(node, ast.Constant) and type(node.value) is int


def _between(op: ast.AST, left: ast.expr, right: ast.expr, kind: str) -> Iterator[Edit]:
    literal = (ast.List, ast.Tuple, ast.JoinedStr, ast.ListComp)
    text = any(isinstance(side, ast.Constant) and isinstance(side.value, str) for side in (left, right))
    if type(op) in OPERATORS and not (kind == "arithmetic" and (text or isinstance(left, literal))):
        yield f"{kind} {OPERATORS[type(op)][0]}", OPERATORS[type(op)][1], left, right


def _edits(node: ast.AST) -> Iterator[Edit]:
    """What can be planted at one node."""
    match node:
        case ast.BinOp():
            yield from _between(node.op, node.left, node.right, "arithmetic")
        case ast.AugAssign():
            yield from _between(node.op, node.target, node.value, "arithmetic")
        case ast.Compare():
            for op, left, right in zip(
                node.ops, [node.left, *node.comparators], node.comparators, strict=False
            ):
                yield from _between(op, left, right, "comparison")
        case ast.BoolOp():
            for left, right in zip(node.values, node.values[1:], strict=False):
                yield from _between(node.op, left, right, "logic")
        case ast.UnaryOp(op=ast.Not()):
            yield "logic not", "", None, node
        case ast.Constant() if _number(node):
            yield "constant", str(int(str(node.value)) + 1), None, node
        case ast.Slice():
            for bound in (node.lower, node.upper):
                if bound is not None and not _number(bound):
                    yield "slice bound", " + 1", bound, bound
        case ast.Call(func=ast.Name(id=name)) | ast.Call(func=ast.Attribute(attr=name)) if name in EXTREMES:
            yield "extreme", EXTREMES[name], None, node.func


def faults_of(source: str) -> Iterator[tuple[int, Fault]]:
    """All faults of one file, each with the number of its line."""
    raw = source.encode().splitlines(keepends=True)
    starts = [0]
    for line in raw:
        starts.append(starts[-1] + len(line))
    whole, lines = source.encode(), source.splitlines()

    def at(line: int | None, column: int | None) -> int:
        return starts[(line or 0) - 1] + (column or 0)

    for function, node in _walk(ast.parse(source), ""):
        for kind, replacement, left, right in _edits(node):
            new = replacement
            first, end = at(right.lineno, right.col_offset), at(right.end_lineno, right.end_col_offset)
            if kind == "slice bound":
                simple = isinstance(right, ast.Name | ast.Attribute | ast.Call | ast.Subscript)
                old = whole[first:end].decode()
                new = f"{old} + 1" if simple else f"({old}) + 1"
            elif kind == "logic not":
                end = first + len("not ")
            elif kind == "extreme":
                first = end - len(EXTREMES[new])
            elif left is not None:
                gap = whole[at(left.end_lineno, left.end_col_offset) : first].decode()
                old = kind.split()[1]
                if "#" in gap or old not in gap:
                    continue
                first = at(left.end_lineno, left.end_col_offset) + len(gap[: gap.index(old)].encode())
                end = first + len(old)
            number = max(k for k, start in enumerate(starts) if start <= first)
            mutated = (
                whole[starts[number] : first] + new.encode() + whole[end : starts[number + 1]]
            ).decode()
            text = whole[starts[number] : starts[number + 1]].decode()
            try:
                ast.parse(
                    (whole[: starts[number]] + mutated.encode() + whole[starts[number + 1] :]).decode()
                )
            except SyntaxError:
                continue
            if end > starts[number + 1] or _bare(text) == _bare(mutated):
                continue
            around = [_bare(lines[k]) if 0 <= k < len(lines) else "" for k in (number - 1, number + 1)]
            yield (
                number,
                {
                    "function": function,
                    "kind": kind,
                    "text": text.strip(),
                    "mutated": mutated.strip(),
                    "near": around,
                },
            )


def draw(tree: Path, count: int, seed: int) -> list[Fault]:
    """Draw faults: modules in turn, in each of them a kind, then one of that kind."""
    random, pools = Random(seed), []
    drawn: list[Fault] = []
    for folder, stems in NUMERIC.items():
        for stem in stems.split():
            kinds = defaultdict(list)
            path = tree / folder / f"{stem}.py"
            for number, fault in faults_of(path.read_text(encoding="utf-8")):
                kinds[fault["kind"].split()[0]].append((number, {"module": f"{folder}/{stem}.py", **fault}))
            pools.append(kinds)
    random.shuffle(pools)
    places = Places(tree)
    while len(drawn) < count and any(pools):
        for kinds in pools[: count - len(drawn)]:
            if kinds:
                names = sorted(kinds)
                kind = random.choices(names, [WEIGHTS[name] for name in names])[0]
                number, fault = kinds[kind].pop(random.randrange(len(kinds[kind])))
                if not kinds[kind]:
                    del kinds[kind]
                found = places.find(fault)
                fault["nth"] = found.index((tree / fault["module"], number))
                drawn.append({"id": len(drawn), **fault})
    return drawn


def _bare(line: str) -> str:
    """Strip a line of its indentation and its comment."""
    return re.sub(r"\s+# .*$", "", line.strip())


class Places:
    """Where each line of the product stands."""

    def __init__(self, tree: Path) -> None:
        self.lines: dict[Path, list[str]] = {}
        self.where: dict[str, list[tuple[Path, int]]] = defaultdict(list)
        for path in files(tree, *OTHER):
            self.lines[path] = path.read_text(encoding="utf-8").splitlines()
            for number, line in enumerate(self.lines[path]):
                self.where[_bare(line)].append((path, number))

    def _function(self, path: Path, number: int) -> str:
        """Name of the innermost function around a line."""
        spans = [
            (node.lineno, node.name)
            for node in ast.walk(ast.parse("\n".join(self.lines[path])))
            if isinstance(node, ast.FunctionDef | ast.ClassDef)
            and node.lineno - 1 <= number < (node.end_lineno or 0)
        ]
        return max(spans)[1] if spans else ""

    def find(self, fault: Fault) -> list[tuple[Path, int]]:
        """Lines that may be the one of the fault, all equally likely; none if it is gone."""
        ranked = defaultdict(list)
        same = self.where.get(_bare(fault["text"]), [])
        for path, number in same:
            lines = ["", *map(_bare, self.lines[path]), ""]
            near = sum(
                a == b for a, b in zip((lines[number], lines[number + 2]), fault["near"], strict=True)
            )
            named = self._function(path, number) == fault["function"].split(".")[-1] != ""
            if named or near or (len(same) == 1 and len(fault["text"]) >= 20):
                ranked[named + near, path.name == Path(fault["module"]).name].append((path, number))
        return ranked[max(ranked)] if ranked else []


def imports(tree: Path) -> dict[Path, set[Path]]:
    """Which file of the tree imports which others, anywhere in it."""
    names, graph = {}, {}
    for path in files(tree):
        parts = [
            part for part in path.relative_to(tree).with_suffix("").parts if part not in {"src", "__init__"}
        ]
        names[".".join(parts[1:] if parts[:1] == ["tests"] else parts)] = path
    for path in files(tree):
        wanted: set[str] = set()
        package = ".".join(path.relative_to(tree).parent.parts).removeprefix("src.").split(".")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                wanted |= {alias.name.removeprefix("spikeloom.") for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                above = package[: len(package) - node.level + 1] if node.level else []
                start = ".".join([*above, *([node.module] if node.module else [])]).removeprefix(
                    "spikeloom."
                )
                wanted |= {
                    f"{start}.{a.name}" if f"{start}.{a.name}" in names else start for a in node.names
                }
        graph[path] = {names[name] for name in wanted if name in names} - {path}
    return graph


def map_tests(tree: Path, out: Path, limit: float, also: list[str]) -> None:
    """Run each file once without a fault, and say which of them a fault in a module should be shown to."""
    known = json.loads(out.read_text()) if out.exists() else {"seconds": {}, "failing": {}, "deselected": []}
    graph = imports(tree)
    tests = [p for p in graph if p.name.startswith("test_") and "tests" in p.parts]
    doctests = [
        p for p in files(tree, *OTHER) if re.search(r"^\s*>>> ", p.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    for path in sorted(tests + doctests):
        name = str(path.relative_to(tree))
        if name not in known["seconds"]:
            code, told, known["seconds"][name] = run(tree, [name], limit)
            print(name, known["seconds"][name], code, *told, sep="\n    ", flush=True)
            if code == 1:  # fails without a fault, on this machine
                known["deselected"] += [
                    t.split(" - ")[0].split(maxsplit=1)[1] for t in told if not t.startswith("E ")
                ]
            elif code not in {0, 5}:  # 5: all of them are slow
                known["failing"][name] = code
            out.write_text(json.dumps(known, indent=1))
    known["modules"] = {}
    for module, ranks in sorted(_ranked(tree, graph, tests, known["seconds"], also).items()):
        every = [module] * (tree / module in doctests) + [rank[-1] for rank in sorted(ranks)]
        known["modules"][module] = [test for test in every if test not in known["failing"]]
    out.write_text(json.dumps(known, indent=1))


def _ranked(
    tree: Path, graph: dict[Path, set[Path]], tests: list[Path], seconds: dict[str, float], also: list[str]
) -> dict[str, list[tuple[int, int, float, str]]]:
    """List the test files that reach each module, with their ranks."""
    importers: dict[Path, set[str]] = defaultdict(set)
    for path, others in graph.items():
        for other in others:
            importers[other] |= _names(path)
    order = defaultdict(list)
    for test in tests:
        distances, todo = {test: 0}, deque([test])
        while todo:
            for other in graph[here := todo.popleft()]:
                if other not in distances:
                    distances[other] = distances[here] + 1
                    todo.append(other)
        name = str(test.relative_to(tree))
        for path, distance in distances.items():
            if distance <= 2 and test.stem in _names(path):
                named = 0
            elif name in also or (distance <= 2 and test.stem in importers[path]):
                named = 1
            else:
                named = 2 if path.parent.name in test.stem else 3
            order[str(path.relative_to(tree))].append((named, distance, seconds[name], name))
    return order


def _names(path: Path) -> set[str]:
    """What the test file of a module may be called."""
    return {f"test_{path.stem}", f"test_{path.parent.name}_{path.stem}"}


def run(
    tree: Path, tests: list[str], limit: float, *, planted: bool = False, fresh: bool = False
) -> tuple[int | None, list[str], float]:
    """Run test files: exit status, None if out of time; the lines that say most; seconds.

    Seconds are those of the processor, as others may be using it too; who waits for ever is stopped all the same.
    With `fresh`, machine code is compiled anew, as a cached function may hold an older copy of another file's.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory(prefix="fault-", ignore_cleanup_errors=True) as work:
        own = {"HYPOTHESIS_STORAGE_DIRECTORY": f"{work}/examples", "TMPDIR": work}
        own |= {"PYTHONDONTWRITEBYTECODE": "1"} if planted else {}
        own |= {"NUMBA_CACHE_DIR": f"{work}/numba"} if fresh else {}
        log = Path(work) / "log"
        with log.open("wb") as told:
            process = subprocess.Popen(
                [sys.executable, *PYTEST, *tests],
                cwd=tree,
                env=os.environ | own,
                stdin=subprocess.DEVNULL,
                stdout=told,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            resource.prlimit(process.pid, resource.RLIMIT_CPU, (int(limit) + 1, int(limit) + 2))
            resource.prlimit(
                process.pid, resource.RLIMIT_AS, (MEMORY, MEMORY)
            )  # a fault may ask for any amount
            code: int | None = None
            try:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    code = process.wait(PATIENCE * limit)
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
        telling = [line for line in lines if line.startswith(("FAILED", "ERROR", "E  "))] or lines[-1:]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1)
    return None if code == -signal.SIGXCPU else code, [line[:300] for line in telling], seconds


def score(
    tree: Path, fault: Fault, tests: dict[str, Any], tried: list[str], limit: float, share: float
) -> Fault:
    """Plant one fault, run the tests, take it out again."""
    places = Places(tree)
    found = places.find(fault)
    if len(found) <= fault["nth"]:
        closest = difflib.get_close_matches(_bare(fault["text"]), places.where, 1, 0.7)
        return {
            "result": "gone",
            "closest": [(str(places.where[c][0][0].relative_to(tree)), c) for c in closest],
        }
    path, number = found[fault["nth"]]
    stamp, source = path.stat(), path.read_bytes()
    text = source.decode()
    lines = text.splitlines(keepends=True)
    line = lines[number]
    indent = line[: len(line) - len(line.lstrip())]
    lines[number] = f"{indent}{fault['mutated']}\n"
    module, chosen, budget = str(path.relative_to(tree)), [], share * limit
    for test in tests["modules"].get(module, []):
        if test not in tried and (seconds := tests["seconds"].get(test, 0)) <= budget:
            chosen.append(test)
            budget -= seconds
    if not chosen:
        return {"result": "survived", "module": module, "told": ["no test left"], "tests": tried}
    fresh = not fault["function"] or bool(KERNEL.search(text))
    try:
        path.write_text("".join(lines), encoding="utf-8")
        words = ["-x", *(f"--deselect={test}" for test in tests["deselected"]), *chosen]
        code, told, seconds = run(tree, words, limit, planted=True, fresh=fresh)
    finally:
        path.write_bytes(source)
        os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))  # caches go by the stamp
    result = {None: "timeout", 0: "survived", 5: "survived"}.get(code, "caught")
    return {
        "result": result,
        "module": module,
        "exit": code,
        "seconds": seconds,
        "told": told,
        "tests": tried + chosen,
    }


def summary(scores: list[Fault]) -> str:
    """All that was not caught, then one line."""
    said = [
        f"{s['result']} {s['id']}: {s['module']} {s['function']} [{s['kind']}]\n    {s['text']}\n    {s['mutated']}"
        + "".join(f"\n    closest: {path}: {line}" for path, line in s.get("closest", ()))
        for s in sorted(scores, key=lambda s: (s["result"], s["id"]))
        if s["result"] != "caught"
    ]
    n = {
        result: sum(s["result"] == result for s in scores)
        for result in ("caught", "timeout", "survived", "gone")
    }
    there = len(scores) - n["gone"]
    caught = f"{n['caught'] + n['timeout']} of {there} faults caught ({n['timeout']} by the time limit)"
    return "\n".join([*said, f"{caught}, {n['survived']} survived, {n['gone']} gone"])


def main() -> None:
    """Draw faults, map tests, or score."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tree", type=Path, required=True, help="checkout to read, and to plant faults in")
    parser.add_argument("--list", type=int, metavar="N", help="draw N faults, print them as JSON")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument(
        "--map", type=Path, metavar="JSON", help="run each test file once, write which to run for what"
    )
    parser.add_argument(
        "--also", nargs="*", default=[], metavar="FILE", help="test files that matter to all modules"
    )
    parser.add_argument("--faults", type=Path, metavar="JSON", help="what --list has printed")
    parser.add_argument("--tests", type=Path, metavar="JSON", help="what --map has written")
    parser.add_argument(
        "--out", type=Path, metavar="JSON", help="scores; those that are there already are kept"
    )
    parser.add_argument(
        "--again", action="store_true", help="show what survived to the test files that come next"
    )
    parser.add_argument("--limit", type=float, default=240, help="seconds for the tests of one fault (240)")
    parser.add_argument(
        "--share", type=float, default=0.5, help="part of them that the tests take without it (0.5)"
    )
    options = parser.parse_args()
    tree = options.tree.resolve()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    if options.list:
        print(json.dumps(draw(tree, options.list, options.seed), indent=1, ensure_ascii=False))
        return
    if subprocess.run(["git", "diff", "--quiet"], cwd=tree, check=False).returncode:
        parser.error(f"{tree} has changes that are not committed; was a fault left there? (git checkout .)")
    if options.map:
        map_tests(tree, options.map, options.share * options.limit, options.also)
        return
    if not (options.faults and options.tests and options.out):
        parser.error("give --list, or --map, or all of --faults, --tests and --out")
    tests = json.loads(options.tests.read_text())
    scores = {s["id"]: s for s in json.loads(options.out.read_text())} if options.out.exists() else {}
    for fault in json.loads(options.faults.read_text(encoding="utf-8")):
        known = scores.get(fault["id"], {})
        if not known or (options.again and known["result"] == "survived"):
            result = score(tree, fault, tests, known.get("tests", []), options.limit, options.share)
            scores[fault["id"]] = {**fault, "planned": fault["module"], **result}
            options.out.write_text(json.dumps([*scores.values()], indent=1, ensure_ascii=False))
            print(
                fault["id"],
                *(result.get(key, "") for key in ("result", "module", "seconds", "told")),
                flush=True,
            )
    print(summary([*scores.values()]))


if __name__ == "__main__":
    main()
