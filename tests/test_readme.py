"""What the README shows is what the code does."""

import doctest
import re
from pathlib import Path

from runtime.cli import build_parser

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def test_python_session(monkeypatch):
    monkeypatch.chdir(ROOT)
    failed, tried = doctest.testfile(str(ROOT / "README.md"), module_relative=False, encoding="utf-8")
    assert tried > 5
    assert failed == 0


def test_the_two_commands_stand_at_the_top():
    first = README.split("```")[1].strip().splitlines()
    assert first == [
        "pip install -c constraints.txt -e . && spikeloom demo",
        "pip install -c constraints.txt -e '.[test]' && pytest",
    ]


def test_every_shown_command_is_one_that_the_parser_accepts():
    shown = re.findall(r"^\$ spikeloom (.+)$", README, flags=re.MULTILINE)
    assert len(shown) >= 3
    for words in shown:
        build_parser().parse_args(words.split())
