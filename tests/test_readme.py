"""What the README and the pages of docs/ show is what the code does; what they link to is there."""

import argparse
import doctest
import functools
import io
import itertools
import json
import os
import pkgutil
import re
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from spikeloom.runtime import cli

build_parser = functools.cache(cli.build_parser)

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = (README, *sorted((ROOT / "docs").glob("*.md")), ROOT / "models" / "pretrained" / "README.md")
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
TEXTS = {page: page.read_text("utf-8") for page in PAGES}

FENCED = re.compile(r"^```.*?^```$", flags=re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r"^\$ spikeloom (.+)$", flags=re.MULTILINE)
IN_A_LINE = re.compile(r"`([^`]+)`")
DOTTED = re.compile(r"`((?:compiler|runtime|models)\.[\w.]+)[(`]")
OTHERS = {"python", "pip", "pytest", "helm"}
"""Programs that have options of their own."""
LINK = re.compile(r"\]\(([^)\s]+)\)")
FILE = re.compile(r"\b(?:compiler|runtime|models|tests|benchmarks|examples)/[\w/.-]+\.(?:py|toml|sh|png|md)")


def subcommands(parser):
    """Name and parser of each command below one."""
    return next(
        (action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)), {}
    )


def options(parser):
    return {option for action in parser._actions for option in action.option_strings}


def every_parser(parser):
    yield parser
    for below in subcommands(parser).values():
        yield from every_parser(below)


def spoken(text):
    """Commands named in prose, with or without options, as lists of words."""
    for code in IN_A_LINE.findall(FENCED.sub("", text)):
        words = code.split()
        if words[0] == "spikeloom" and len(words) > 1:
            yield words[1:]


def anchors(text):
    """Anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", FENCED.sub("", text), flags=re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings]
    return [
        name if name not in plain[:i] else f"{name}-{plain[:i].count(name)}" for i, name in enumerate(plain)
    ]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_python_sessions(page, monkeypatch):
    monkeypatch.chdir(ROOT)
    failed, _ = doctest.testfile(str(page), module_relative=False, encoding="utf-8")
    assert failed == 0


def test_the_sessions_of_the_readme_print_what_it_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sessions = [block for block in FENCED.findall(TEXTS[README]) if SHOWN.search(block)]
    assert len(sessions) == 3
    for session in sessions:
        command, *lines = session.splitlines()[1:-1]
        assert cli.main(shlex.split(command.removeprefix("$ spikeloom "))) == 0
        shown = "".join("(.*\n)*" if line == "…" else f"{re.escape(line)}\n" for line in lines)
        assert re.fullmatch(shown, capsys.readouterr().out), command


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_what_a_page_speaks_of_exists(page):
    text, prose = TEXTS[page], FENCED.sub("", TEXTS[page])
    for words in SHOWN.findall(text):
        build_parser().parse_args(shlex.split(words))
    for words in spoken(text):
        parser, rest = build_parser(), words
        while rest and subcommands(parser) and rest[0].isalpha() and rest[0].islower():
            assert rest[0] in subcommands(parser), f"spikeloom {' '.join(words)}"
            parser, rest = subcommands(parser)[rest[0]], rest[1:]
        named = {word.split("=")[0] for word in rest if word.startswith("--")}
        assert named <= options(parser), f"spikeloom {' '.join(words)}"
    known = set().union(*(options(parser) for parser in every_parser(build_parser())))
    for code in IN_A_LINE.findall(prose):
        if OTHERS.isdisjoint(code.split()):
            assert {word.split("=")[0] for word in code.split() if word.startswith("--")} <= known, code
    for name in DOTTED.findall(prose):
        assert pkgutil.resolve_name(name) is not None
    for path in FILE.findall(text):
        assert (ROOT / path).exists(), path


def test_the_readme_lists_every_command():
    listed = re.findall(
        r"^\| `(\w+)` \|.*\|$", TEXTS[README].split("## Commands")[1].split("\n## ")[0], re.MULTILINE
    )
    assert sorted(listed) == sorted(subcommands(build_parser()))


def test_the_readme_links_every_page():
    linked = {link.split("#")[0] for link in LINK.findall(TEXTS[README])}
    assert {str(page.relative_to(ROOT)) for page in PAGES if page != README} <= linked


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_link_leads_somewhere(page):
    for link in LINK.findall(FENCED.sub("", TEXTS[page])):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), link
        if anchor:
            assert anchor in anchors(TEXTS[there]), link


@pytest.fixture
def environment(tmp_path):
    """Variables of a shell whose `spikeloom` is whatever this interpreter runs, installed or not."""
    command = tmp_path / "bin" / "spikeloom"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m spikeloom "$@"\n')
    command.chmod(0o755)
    path = f"{command.parent}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {"PATH": path, "PYTHONPATH": str(ROOT / "src"), "MPLBACKEND": "agg"}


def run_example(environment, *command, **options):
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=540, check=False, **options
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_square_sensor_example_reaches_a_decision(tmp_path, environment):
    made = tmp_path / "made"
    shown = run_example(environment, "bash", ROOT / "examples" / "square_sensor.sh", made)
    for name in ("coords.csv", "training.png", "square.pt", "square.loom", "grasp.csv"):
        assert (made / name).stat().st_size > 0
    assert "E0  specification = engine in every" in shown
    assert "grasp 1: class " in shown
    assert "1 grasp, 100 bins" in shown


def test_the_textures_example_reaches_a_netlist(tmp_path, environment):
    """On made-up textures, each of which excites three taxels; the real ones take ten minutes."""
    draw = np.random.default_rng(0)
    with zipfile.ZipFile(tmp_path / "made.zip", "w") as archive:
        for texture, speed, force in itertools.product(range(3), (1200, 3600, 6000), ("0.5", "1.0")):
            rate = np.full(10, 0.02)
            rate[3 * texture : 3 * texture + 3] = 0.1
            member = io.BytesIO()
            np.savez(member, spikes=(draw.random((720_000 // speed, 10)) < rate).astype(np.uint8))
            archive.writestr(f"texture{texture:02}_speed{speed}_force{force}.npz", member.getvalue())
    made = tmp_path / "made"
    script = ROOT / "examples" / "textures.sh"
    shown = run_example(environment, "bash", script, tmp_path / "made.zip", made, "20s")
    for name in ("taxels.csv", "small.pt", "small.loom", "small.html"):
        assert (made / name).stat().st_size > 0
    assert "left out in turn: speed=1200, force=0.5, speed=6000, force=1.0" in shown
    for ends in ("speed below 1200 or above 6000", "force below 0.5 or above 1.0"):
        assert f"not tested: {ends}; at these ends, when they are new, " in shown


def test_the_notebook_runs(tmp_path, environment):
    """Its code in one process, a line with ! by the shell."""
    cells = json.loads((ROOT / "examples" / "touch.ipynb").read_text("utf-8"))["cells"]
    code = "".join("".join(cell["source"]) + "\n" for cell in cells if cell["cell_type"] == "code")
    code = re.sub(r"^!(.+)$", r"subprocess.run('\1', shell=True, check=True)", code, flags=re.MULTILINE)
    (tmp_path / "square_snntorch.nir").write_bytes((ROOT / "examples" / "square_snntorch.nir").read_bytes())
    shown = run_example(environment, sys.executable, "-c", f"import subprocess\n{code}", cwd=tmp_path)
    assert "chip accuracy:   95.14 % (137 of 144" in shown
    for name in ("square.pt", "square.loom", "square.html"):
        assert (tmp_path / name).stat().st_size > 0
